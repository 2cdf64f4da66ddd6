"""A process that did not run for a while takes nothing that was queued meanwhile for motion."""

from __future__ import annotations

import pytest

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


def test_a_suspended_machine_is_a_freeze_although_the_time_of_the_loop_stood_still() -> None:
    frozen: list[float] = []
    suspended = [3.0]
    watch = FreezeWatch(10.0, frozen.append, lambda: suspended[0])
    watch.beat(10.2)
    assert frozen == [], "what was before it began is not counted"
    suspended[0] += 2.0
    assert watch.stale(10.25)
    assert frozen == [pytest.approx(2.05)]
    assert watch.stale(10.25 + CATCH_UP_S / 2)
    assert not watch.stale(10.25 + CATCH_UP_S)
    watch.beat(10.7)
    assert len(frozen) == 1
