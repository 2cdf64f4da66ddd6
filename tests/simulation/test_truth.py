"""How fast a simulated robot truly was, by its own time: a process that was paused catches up, and is no faster."""

from itertools import accumulate

import pytest

from zbridge.protocol import Truth
from zbridge.simulation.checks.truth import rates
from zbridge.simulation.simulator import STEP_S

M_S, RAD_S = 0.4, 0.2


def reported(*pauses_s: float) -> list[tuple[float, Truth]]:
    """Drive ahead for so many steps, each reported so late after the one before."""
    return [
        (at, Truth(steps * STEP_S * M_S, 0.0, 0.0, lived_s=steps * STEP_S))
        for steps, at in enumerate(accumulate(pauses_s))
    ]


@pytest.mark.parametrize(
    "pauses_s",
    [[STEP_S] * 60, [*[STEP_S] * 30, *[1e-4] * 30], [*[STEP_S] * 20, 0.8, *[1e-4] * 39]],
    ids=["even", "quick", "late"],
)
def test_a_robot_that_catches_up_is_as_fast_as_one_that_was_never_late(pauses_s: list[float]) -> None:
    assert rates(reported(*pauses_s)) == (pytest.approx(M_S), 0.0)


def test_a_robot_that_does_not_say_its_own_time_is_measured_by_that_of_its_reports() -> None:
    truths = [(steps * 0.1, Truth(0.0, 0.0, steps * 0.1 * RAD_S)) for steps in range(12)]
    assert rates(truths) == (0.0, pytest.approx(RAD_S))


def test_a_robot_that_stood_for_a_moment_is_as_fast_as_when_it_drove() -> None:
    ways = accumulate([0.0] * 20 + [STEP_S * M_S] * 100)
    truths = [(0.0, Truth(x, 0.0, 0.0, lived_s=steps * STEP_S)) for steps, x in enumerate(ways)]
    assert rates(truths)[0] == pytest.approx(M_S, rel=0.01)


def test_of_a_drive_that_was_too_short_nothing_is_known() -> None:
    assert rates([]) == rates(reported(*[STEP_S] * 5)) == (0.0, 0.0)
