"""A process that did not run for a while takes nothing that was queued meanwhile for motion."""

from __future__ import annotations

from zbridge.hq.freeze import CATCH_UP_S, FROZEN_S, FreezeWatch


def watched() -> tuple[FreezeWatch, list[float]]:
    frozen: list[float] = []
    return FreezeWatch(10.0, frozen.append), frozen


def test_beats_in_time_are_no_freeze() -> None:
    watch, frozen = watched()
    for number in range(100):
        watch.beat(10.0 + number * 0.5)
        assert not watch.stale(10.0 + number * 0.5 + FROZEN_S - 0.01)
    assert frozen == []


def test_input_after_a_freeze_is_stale_until_the_queue_is_read() -> None:
    watch, frozen = watched()
    watch.beat(10.1)
    woken = 10.1 + 4.0
    assert watch.stale(woken)
    watch.beat(woken + 0.1)
    assert watch.stale(woken + CATCH_UP_S - 0.01)
    assert not watch.stale(woken + CATCH_UP_S)
    assert [round(seconds, 3) for seconds in frozen] == [4.0], "reported once"


def test_the_beat_that_comes_late_finds_the_freeze_itself() -> None:
    watch, frozen = watched()
    watch.beat(11.0)
    assert watch.stale(11.0)
    assert len(frozen) == 1


def test_time_before_the_watch_begins_does_not_count() -> None:
    watch, frozen = watched()
    watch.begin(100.0)
    assert not watch.stale(100.1)
    assert frozen == []
    assert repr(watch) == "<FreezeWatch beat at 100.0, stale until -inf>"
