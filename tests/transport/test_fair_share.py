from __future__ import annotations

import pytest

from zbridge.transport.reading import BURST_S, FairShare


def test_work_within_the_share_is_never_held_up() -> None:
    share, now = FairShare(0.25), 100.0
    for _ in range(1000):
        now += 0.01
        assert share.spent(0.0024, now) == 0.0


def test_a_burst_after_a_quiet_time_is_free_and_what_exceeds_it_rests_until_the_share_has_grown_again() -> None:
    share = FairShare(0.25)
    assert share.spent(BURST_S, 100.0) == 0.0
    assert share.spent(0.01, 100.0) == pytest.approx(0.04)
    assert share.spent(0.0, 100.04) == pytest.approx(0.0)


def test_one_that_works_whenever_it_may_gets_its_part_in_the_long_run() -> None:
    share, now, worked = FairShare(0.25), 0.0, 0.0
    while now < 100.0:
        now += 0.002
        worked += 0.002
        now += share.spent(0.002, now)
    assert worked / now == pytest.approx(0.25, rel=0.02)


def test_quiet_times_are_not_saved_up() -> None:
    share = FairShare(0.5)
    share.spent(0.0, 0.0)
    assert share.spent(BURST_S + 1.0, 1e6) == pytest.approx(2.0)
