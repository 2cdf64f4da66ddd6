"""A process that did not run for a while takes nothing that was queued meanwhile for motion."""

from __future__ import annotations

from zbridge.hq.freeze import CATCH_UP_S, FROZEN_S, FreezeWatch


def test_beats_in_time_are_no_freeze_and_time_before_the_watch_begins_does_not_count() -> None:
    frozen: list[float] = []
    watch = FreezeWatch(10.0, frozen.append)
    watch.begin(100.0)
    for number in range(100):
        watch.beat(100.0 + number * 0.5)
        assert not watch.stale(100.0 + number * 0.5 + FROZEN_S - 0.01)
    assert frozen == []


def test_input_after_a_freeze_is_stale_until_the_queue_is_read_and_the_freeze_is_reported_once() -> None:
    frozen: list[float] = []
    watch = FreezeWatch(10.0, frozen.append)
    watch.beat(14.0)
    assert watch.stale(14.0), "a beat that comes late finds the freeze itself"
    watch.beat(14.1)
    assert watch.stale(14.0 + CATCH_UP_S - 0.01)
    assert not watch.stale(14.0 + CATCH_UP_S)
    assert frozen == [4.0]
    assert watch.stale(20.0)
    assert len(frozen) == 2
