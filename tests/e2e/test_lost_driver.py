"""The driver is lost while the robot moves: the stop is at the robot's socket within the deadman and 50 ms."""

from __future__ import annotations

import pytest

from tests.e2e.lost_driver import NotHereError, measure


@pytest.mark.parametrize("way", ["killed", "frozen", "cut"])
def test_a_robot_whose_driver_is_lost_is_stopped_within_the_deadman(way: str) -> None:
    try:
        result = measure(way, repetitions=2, deadman_s=0.2)
    except NotHereError as error:
        pytest.skip(f"no network namespace for the driver: {error}")
    assert len(result.since_motion_s) == 2
    assert result.clean, result


@pytest.mark.parametrize("deadman_s", [0.2, 1.0])  # shorter and longer than the time after which a motion is repeated
def test_a_gateway_that_was_frozen_sends_its_stop_before_anything_else(deadman_s: float) -> None:
    result = measure("gateway-frozen", repetitions=2, deadman_s=deadman_s)
    assert result.clean, result
