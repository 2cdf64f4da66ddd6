"""What drives the robot is lost while the robot moves: the stop is at the robot's socket in time."""

from __future__ import annotations

import subprocess

import pytest

from tests.e2e.measured import lost_hq
from tests.e2e.measured.lost_driver import measure
from tests.e2e.rigs.processes import NotHereError, apart, module

ROWS = [
    ("killed", 2.0),  # where others see the loss it is long before the deadman
    ("router-killed", 2.0),
    ("frozen", 0.2),
    ("gateway-frozen", 0.2),  # shorter and longer than the time after which a motion is repeated
    ("gateway-frozen", 1.0),
]


@pytest.mark.parametrize(("way", "deadman_s"), ROWS)
def test_a_robot_whose_driver_is_lost_is_stopped_in_time_and_stays_at_rest(way: str, deadman_s: float) -> None:
    result = measure(way, repetitions=2, deadman_s=deadman_s)
    assert len(result.since_loss_s) == 2, result
    assert result.clean, result


@pytest.mark.parametrize(
    ("program", "ways"),
    [
        ("tcpudp", ["killed", "frozen", "hq-killed", "hq-frozen"]),
        ("alf", ["killed", "frozen", "hq-killed", "hq-frozen"]),
        ("wc2ec-repeats", ["frozen"]),
        ("wc2ec-holds", ["killed", "hq-killed", "hq-frozen"]),
    ],
)
def test_a_robot_whose_hq_program_or_its_listener_is_lost_is_stopped(program: str, ways: list[str]) -> None:
    results = list(lost_hq.measure(program, ways, repetitions=1))
    assert len(results) == len(ways)
    for result in results:
        assert result.clean, result


@pytest.mark.parametrize(
    "program", [("lost_driver",), ("lost_hq", "--program", "tcpudp"), ("lost_hq", "--program", "alf")], ids=" ".join
)
def test_a_robot_whose_driver_is_unplugged_is_stopped_within_the_deadman(program: tuple[str, ...]) -> None:
    try:
        apart()
    except NotHereError as error:
        pytest.skip(f"no network namespace for the driver: {error}")
    command = module(f"tests.e2e.measured.{program[0]}", *program[1:], "--way", "cut", "--repetitions", 1)
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
