"""An old HQ program drives the robot, and it or its listener is lost: the stop is at the robot within the deadman."""

from __future__ import annotations

import pytest

from tests.e2e.loss import LATE_S, NotHereError
from tests.e2e.lost_hq import hold_on, measure


def _assert_stopped(program: str, ways: list[str], repetitions: int) -> None:
    for result in measure(program, ways, repetitions=repetitions):
        assert len(result.since_loss_s) == repetitions, result
        assert result.clean, result


@pytest.mark.parametrize(
    ("program", "ways", "repetitions"),
    [
        ("tcpudp", ["killed", "frozen", "hq-killed", "hq-frozen"], 1),
        ("alf", ["killed", "frozen", "hq-killed", "hq-frozen"], 1),
        ("wc2ec-repeats", ["frozen"], 1),
        ("wc2ec-holds", ["killed", "hq-killed", "hq-frozen"], 1),
    ],
)
def test_a_robot_whose_hq_program_or_its_listener_is_lost_is_stopped(program, ways, repetitions) -> None:
    _assert_stopped(program, ways, repetitions)


@pytest.mark.parametrize("program", ["tcpudp", "alf"])
def test_a_robot_whose_hq_program_is_unplugged_is_stopped_within_the_deadman(program: str) -> None:
    try:
        _assert_stopped(program, ["cut"], 1)
    except NotHereError as error:
        pytest.skip(f"no network namespace for the program: {error}")


def test_a_robot_whose_controller_is_frozen_moves_on_while_its_connection_stands_and_stops_when_it_ends() -> None:
    frozen_s = 1.5  # three times the deadman
    moved_s, stopped_s, contended_s = hold_on(frozen_s)
    assert moved_s > frozen_s - 0.5  # a motion is repeated every 0.25 s
    assert stopped_s < LATE_S + contended_s
