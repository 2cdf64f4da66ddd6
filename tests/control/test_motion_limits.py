"""Limits on motion: growth is bounded, slowing down is not, and neutral always passes."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.control.motion_limits import STEP_S, MotionLimits
from zbridge.errors import Refused
from zbridge.fleet.messages import Drive

NEUTRAL = Drive()
PARTS = ("forward", "left", "turn")
ROUNDING = 1e-9

fractions = st.floats(-1, 1)
drives = st.builds(Drive, forward=fractions, left=fractions, turn=fractions, light=st.none() | st.booleans())
waits_s = st.floats(0, 1)
courses = st.lists(st.tuples(waits_s, drives | st.just(NEUTRAL)), max_size=30)
slews = st.floats(0.01, 20)
rates = st.floats(0.1, 100)


def passed(limits: MotionLimits, drive: Drive, now: float) -> Drive | None:
    """Give what is sent, and note it; None where the limits refuse it."""
    try:
        sent = limits.limit(drive, now)
    except Refused:
        return None
    limits.sent(sent, now)
    return sent


@given(courses)
def test_without_limits_everything_passes_unchanged(course: list[tuple[float, Drive]]) -> None:
    limits, now = MotionLimits(), 0.0
    for wait_s, drive in course:
        now += wait_s
        assert passed(limits, drive, now) is drive


@given(rates, slews, courses)
def test_neutral_is_never_refused_and_never_changed(rate_hz, slew_per_s, course) -> None:
    limits, now = MotionLimits(rate_hz, slew_per_s), 0.0
    for wait_s, drive in course:
        now += wait_s
        passed(limits, drive, now)
        for neutral in (NEUTRAL, Drive(light=True)):
            assert limits.limit(neutral, now) is neutral


# Rate


@given(rates, courses)
def test_no_more_than_the_rate_and_a_burst_of_two_passes_in_any_time(rate_hz, course) -> None:
    limits, now = MotionLimits(rate_hz=rate_hz), 0.0
    times = []
    for wait_s, drive in course:
        now += wait_s / rate_hz
        sent = passed(limits, drive, now)
        assert sent in (drive, None)
        if drive.moving and sent is not None:
            times.append(now)
    for first, start in enumerate(times):
        for last, end in enumerate(times[first:], 1):
            assert last <= 2 + (end - start) * rate_hz + ROUNDING


def test_a_drive_that_comes_too_fast_is_refused_with_the_rate() -> None:
    limits = MotionLimits(rate_hz=10)
    assert passed(limits, Drive(forward=1.0), 5.0)
    assert passed(limits, Drive(forward=1.0), 5.0)
    with pytest.raises(Refused, match=r"^more than 10 commands a second$"):
        limits.limit(Drive(forward=1.0), 5.05)


def test_refused_drives_use_nothing_up() -> None:
    limits = MotionLimits(rate_hz=8)
    accepted = [step for step in range(64) if passed(limits, Drive(forward=1.0), step / 64)]
    assert accepted == [0, 1, 8, 16, 24, 32, 40, 48, 56]


def test_neutral_uses_nothing_up() -> None:
    limits = MotionLimits(rate_hz=1)
    for _ in range(100):
        passed(limits, NEUTRAL, 0.0)
    assert passed(limits, Drive(forward=1.0), 0.0)
    assert passed(limits, Drive(forward=1.0), 0.0)
    assert passed(limits, Drive(forward=1.0), 0.0) is None


@given(st.floats(1, 1000))
def test_a_sender_slower_than_the_rate_is_never_refused(rate_hz: float) -> None:
    limits = MotionLimits(rate_hz=rate_hz)
    assert all(passed(limits, Drive(turn=1.0), step * 1.01 / rate_hz) for step in range(50))


def test_a_long_silence_saves_up_no_more_than_a_burst() -> None:
    limits = MotionLimits(rate_hz=10)
    passed(limits, Drive(forward=1.0), 0.0)
    assert [passed(limits, Drive(forward=1.0), 1e6) is not None for _ in range(4)] == [True, True, False, False]


# Slew


@given(slews, courses)
def test_growth_is_bounded_and_slowing_down_is_not(slew_per_s: float, course: list[tuple[float, Drive]]) -> None:
    limits, now, last, last_at = MotionLimits(slew_per_s=slew_per_s), 0.0, NEUTRAL, -math.inf
    for wait_s, drive in course:
        now += wait_s
        sent = passed(limits, drive, now)
        assert sent is not None
        step = slew_per_s * min(now - last_at, STEP_S)
        for part in PARTS:
            before, wanted, got = (getattr(each, part) for each in (last, drive, sent))
            assert abs(got) <= abs(wanted), "never faster than wanted"
            assert got == 0 or (got > 0) == (wanted > 0), "never the other way"
            if before * wanted > 0 and abs(wanted) <= abs(before):
                assert got == wanted, "slowing down takes no time"
            grown_from = abs(before) if before * wanted > 0 else 0.0
            assert abs(got) <= max(grown_from, 0.0) + step + ROUNDING, "growth is bounded, also after turning round"
        assert sent.light == drive.light
        last, last_at = sent, now


@given(slews, st.lists(st.tuples(st.floats(0, STEP_S), drives), min_size=1, max_size=30))
def test_over_any_course_growth_is_bounded_by_the_time_it_took(slew_per_s, course) -> None:
    limits, now = MotionLimits(slew_per_s=slew_per_s), 0.0
    limits.sent(NEUTRAL, now)
    taken = [(now, NEUTRAL)]
    for wait_s, drive in course:
        now += wait_s
        sent = passed(limits, drive, now)
        assert sent is not None
        taken.append((now, sent))
    for first, (start, before) in enumerate(taken):
        for end, after in taken[first:]:
            for part in PARTS:
                growth = abs(getattr(after, part)) - abs(getattr(before, part))
                assert growth <= slew_per_s * (end - start) + ROUNDING


@given(slews, drives)
def test_stopping_takes_no_time_at_any_speed(slew_per_s: float, drive: Drive) -> None:
    limits = MotionLimits(slew_per_s=slew_per_s)
    limits.sent(drive, 0.0)
    for part in PARTS:
        wanted = Drive(**{other: getattr(drive, other) for other in PARTS if other != part})
        assert getattr(limits.limit(wanted, 0.0), part) == 0


def test_a_constant_wish_is_reached_in_the_time_the_slew_takes() -> None:
    limits = MotionLimits(slew_per_s=1.0)
    limits.sent(NEUTRAL, 0.0)
    reached = [passed(limits, Drive(forward=1.0, turn=-0.25), step / 8) for step in range(1, 10)]
    assert [drive.forward for drive in reached if drive] == [0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0, 1.0]
    assert [drive.turn for drive in reached if drive] == [-0.125, -0.25, -0.25, *[-0.25] * 6]


def test_turning_round_goes_to_zero_at_once_and_grows_from_there() -> None:
    limits = MotionLimits(slew_per_s=1.0)
    limits.sent(Drive(forward=1.0), 0.0)
    assert limits.limit(Drive(forward=-1.0), 0.125) == Drive(forward=-0.125)
    assert limits.limit(Drive(forward=-0.0625), 0.125) == Drive(forward=-0.0625)


def test_a_long_silence_allows_no_jump() -> None:
    limits = MotionLimits(slew_per_s=2.0)
    assert limits.limit(Drive(forward=1.0), 0.0) == Drive(forward=2.0 * STEP_S)
    limits.sent(NEUTRAL, 0.0)
    assert limits.limit(Drive(forward=1.0), 1e6) == Drive(forward=2.0 * STEP_S)


def test_a_robot_that_was_stopped_begins_from_standing() -> None:
    limits = MotionLimits(slew_per_s=1.0)
    limits.sent(Drive(forward=1.0, left=-1.0, turn=1.0), 0.0)
    limits.at_rest()
    assert limits.limit(Drive(forward=1.0, left=-1.0, turn=1.0), 0.125) == Drive(forward=0.125, left=-0.125, turn=0.125)


def test_a_drive_that_was_not_sent_counts_for_nothing() -> None:
    limits = MotionLimits(slew_per_s=1.0)
    limits.sent(NEUTRAL, 0.0)
    for _ in range(10):
        limits.limit(Drive(forward=1.0), 0.125)
    assert limits.limit(Drive(forward=1.0), 0.125) == Drive(forward=0.125)


def test_a_drive_that_is_refused_counts_for_no_growth() -> None:
    limits = MotionLimits(rate_hz=8, slew_per_s=1.0)
    limits.sent(NEUTRAL, 0.0)
    passed(limits, Drive(forward=1.0), 0.0625)
    assert passed(limits, Drive(forward=1.0), 0.0625) == Drive(forward=0.0625)
    assert passed(limits, Drive(forward=1.0), 0.125) is None
    assert passed(limits, Drive(forward=1.0), 0.1875) == Drive(forward=0.1875)


def test_a_slowing_robot_may_grow_again_from_where_it_is() -> None:
    limits = MotionLimits(slew_per_s=1.0)
    limits.sent(Drive(forward=1.0), 0.0)
    assert passed(limits, Drive(forward=0.25), 0.0) == Drive(forward=0.25)
    assert passed(limits, Drive(forward=1.0), 0.125) == Drive(forward=0.375)
