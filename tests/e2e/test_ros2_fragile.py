"""Fragile robots of every protocol, driven from ROS's side: each obeys, comes to rest, and complains of nothing."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.e2e.conftest import repeated
from tests.e2e.rigs.ros2_scene import FULL_MPS, STAMPED, TWIST, FragileInFleet, RosScene

FORWARD_MPS, TURN_RADPS = 0.25, 0.5


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosScene]:
    with contextlib.ExitStack() as stack:
        yield RosScene(stack, tmp_path_factory.mktemp("ros2"))


def straight_then_turns(rows: list[Any]) -> bool:
    """Packet 11 forward at half speed, or 12 to the left: this robot does the one or the other, by its options."""
    return ["tcp", 11, "000000000000803f0000003f"] in [row[1:] for row in rows]


def steers(rows: list[Any]) -> bool:
    """Half speed forward, the wheels by atan(0.3 x 0.5 / 0.25) = 31 degrees to the left, which is negative here."""
    return any(fields[:3] == [50, 0, -31] for _, kind, fields in rows if kind == 3)


def wheels_differ(rows: list[Any]) -> bool:
    """0.25 m/s and 0.5 rad/s: wheels of 5 cm, 0.3 m apart, turn at (0.25 - 0.075) / 0.05 and (0.25 + 0.075) / 0.05."""
    values = {(number, round(value, 3)) for _, command, _, number, value in rows if isinstance(value, float)}
    return {(8, 3.5), (9, 6.5)} <= values


CURVES: dict[str, tuple[float, Callable[[list[Any]], bool]]] = {
    "tcpudp": (0.5, straight_then_turns),
    "alf": (0.5, steers),
    "wc2ec": (0.65, wheels_differ),
}
"""For each protocol the speed that a robot tells in a curve, and what it received."""


@pytest.mark.parametrize("protocol", CURVES)
def test_a_twist_drives_a_fragile_robot_and_its_silence_or_end_stops_it(scene: RosScene, protocol: str) -> None:
    robot, (speed, was_told) = FragileInFleet(scene, protocol), CURVES[protocol]
    for type_name in (TWIST, STAMPED):
        with scene.publishing(protocol, type_name) as publisher:
            with repeated(lambda: publisher.twist(FORWARD_MPS)):
                robot.moves(FORWARD_MPS / FULL_MPS)
            silent_at = time.monotonic()
            assert robot.rests() > silent_at, "it was still driven"
            scene.told(f"{protocol}: cmd_vel", "silent for 0.5 s while it drove")
            with repeated(publisher.twist):
                scene.told(f"{protocol}: cmd_vel", "/teleop=may drive")
            with repeated(lambda: publisher.twist(FORWARD_MPS, TURN_RADPS)):
                robot.moves(speed)
                publisher.hide()
                robot.rests()
    assert was_told(robot.judged()["received"])
