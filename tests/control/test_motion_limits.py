"""Limits on motion: growth is bounded, slowing down is not, and neutral always passes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.control.motion_limits import STEP_S, MotionLimits
from zbridge.errors import Refused
from zbridge.fleet.messages import Drive

NEUTRAL = Drive()
FORWARD = Drive(forward=1.0)

fractions = st.floats(-1, 1)
drives = st.builds(Drive, forward=fractions, left=fractions, turn=fractions, light=st.none() | st.booleans())
courses = st.lists(st.tuples(st.floats(0, 1), drives | st.just(NEUTRAL)), max_size=30)
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


@given(rates, slews, courses)
def test_neutral_is_never_refused_or_changed_and_without_limits_nothing_is(rate_hz, slew_per_s, course) -> None:
    limits, unlimited, now = MotionLimits(rate_hz, slew_per_s), MotionLimits(), 0.0
    for wait_s, drive in course:
        now += wait_s
        passed(limits, drive, now)
        assert passed(unlimited, drive, now) is drive
        for neutral in (NEUTRAL, Drive(light=True)):
            assert limits.limit(neutral, now) is neutral


# Rate


def test_refused_drives_and_neutral_use_nothing_up_and_silence_saves_no_more_than_a_burst() -> None:
    limits = MotionLimits(rate_hz=8)
    for _ in range(100):
        passed(limits, NEUTRAL, 0.0)
    assert [step for step in range(64) if passed(limits, FORWARD, step / 64)] == [0, 1, 8, 16, 24, 32, 40, 48, 56]
    assert [passed(limits, FORWARD, 1e6) is not None for _ in range(4)] == [True, True, False, False]
    with pytest.raises(Refused, match=r"^more than 8 commands a second$"):
        limits.limit(FORWARD, 1e6)


# Slew


STEPS = {
    "a wish is reached in time": [(0.125 * n, 1.0, min(1.0, 0.125 * n)) for n in range(1, 10)],
    "slowing down is at once, and growing begins there": [(0.25, 0.25, 0.25), (0.25, 0.125, 0.125), (0.375, 1, 0.25)],
    "stopping is at once": [(0.25, 1.0, 0.25), (0.25, 0.0, 0.0)],
    "turning round goes to zero first": [(0.25, 1.0, 0.25), (0.375, -1.0, -0.125)],
    "a long silence allows no jump": [(1e6, 1.0, STEP_S)],
}


@pytest.mark.parametrize("steps", STEPS.values(), ids=STEPS)
def test_a_drive_is_limited_to_one_full_scale_a_second(steps: list[tuple[float, float, float]]) -> None:
    limits = MotionLimits(slew_per_s=1.0)
    limits.sent(NEUTRAL, 0.0)
    for at, wanted, sent in steps:
        assert passed(limits, Drive(forward=wanted, turn=-wanted), at) == Drive(forward=sent, turn=-sent)


def test_a_drive_that_was_refused_or_not_sent_counts_for_no_growth_and_a_stop_ends_what_was_sent() -> None:
    limits = MotionLimits(rate_hz=8, slew_per_s=1.0)
    limits.sent(NEUTRAL, 0.0)
    limits.limit(FORWARD, 0.0625)
    assert passed(limits, FORWARD, 0.0625) == Drive(forward=0.0625)
    assert passed(limits, FORWARD, 0.125) is None
    assert passed(limits, FORWARD, 0.1875) == Drive(forward=0.1875)
    limits.stopped()
    assert passed(limits, FORWARD, 0.3125) == Drive(forward=0.125), "a robot that was stopped begins from standing"
