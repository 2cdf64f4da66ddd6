"""STOP ALL says what is true: who confirmed, who is away or missing, and who moves nevertheless."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from tests.client import World
from zbridge.client.stops import NAMED, Outcome, StopWaits, new_stop
from zbridge.errors import BusError, NotReady, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Motion, Pose, Status
from zbridge.views.console.fleet_stop import StopReport, judge, stop_fleet

CONFIRMED = "stopped (their gateways sent it)"
MOVES = "still moves by its own pose or speed"


@pytest.mark.parametrize(
    ("outcomes", "moving", "alive", "text"),
    [
        ({"r1": None, "r2": None}, set(), {"r1", "r2"}, f"2 of 2 {CONFIRMED}"),
        (
            {"r1": None, "r2": None},
            {"r2"},
            {"r1", "r2"},
            f"2 of 2 {CONFIRMED}; r2 {MOVES}",
        ),
        ({"r1": NotReady("offline"), "r2": None}, set(), {"r1", "r2"}, f"1 of 2 {CONFIRMED}; r1 away"),
        ({"r1": BusError("silence")}, set(), {"r1"}, f"0 of 1 {CONFIRMED}; r1 not confirmed"),
        (
            {"r1": BusError("silence")},
            set(),
            set(),
            f"0 of 1 {CONFIRMED}; r1 without a gateway, which nothing can stop from here",
        ),
        ({"r1": Unsupported("no stop")}, set(), {"r1"}, f"0 of 1 {CONFIRMED}; r1 refused it"),
        (
            {"r1": StopWaits("it waits")},
            set(),
            {"r1"},
            f"0 of 1 {CONFIRMED}; r1 not reached yet: its link is stalled",
        ),
        ({}, set(), set(), "No robot is known: the stop was sent to all, and nobody confirmed it"),
    ],
)
def test_the_sentence_tells_each_robot_that_needs_somebody(
    outcomes: dict[str, Outcome], moving: set[str], alive: set[str], text: str
) -> None:
    report = judge(outcomes, moving, alive.__contains__)
    assert report == StopReport(text, good=text == f"2 of 2 {CONFIRMED}")


def test_robots_in_the_same_trouble_are_named_together_and_not_without_end() -> None:
    outcomes: dict[str, Outcome] = {f"r{number:02}": BusError("silence") for number in range(NAMED + 3)}
    text = judge(outcomes, (), outcomes.__contains__).text
    assert text.startswith(f"0 of 23 {CONFIRMED}; r00, r01, ")
    assert text.endswith("r19 and 3 more not confirmed")


@contextlib.asynccontextmanager
async def publishing(world: World, robot: str, *messages: FleetMessage) -> AsyncIterator[None]:
    """Have a robot publish these by turns, ten times a second."""
    gateway = world.gateways[robot]

    async def go_on() -> None:
        while True:
            for message in messages:
                gateway.publish(topics.POSE if isinstance(message, Pose) else topics.MOTION, message)
                await asyncio.sleep(0.1)

    task = asyncio.create_task(go_on())
    try:
        yield
    finally:
        task.cancel()


async def stopped(world: World, *roster: str) -> StopReport:
    stop = new_stop("ann", "STOP ALL", latch=True)
    return await stop_fleet(world.fleet, world.bus.join("console"), stop, roster, world.gateways.__contains__)


@pytest.mark.jumping
async def test_all_are_latched_and_one_of_the_roster_that_is_not_there_is_missing() -> None:
    world = World("r1", "r2")
    report = await stopped(world, "r1", "r3")
    assert report.text == f"2 of 3 {CONFIRMED}; r3 without a gateway, which nothing can stop from here"
    assert not report.good
    assert [gateway.control.state for gateway in world.gateways.values()] == ["latched", "latched"]
    assert all(latch.fleet for gateway in world.gateways.values() for latch in gateway.control.latches)


@pytest.mark.jumping
@pytest.mark.parametrize(
    ("messages", "moves"),
    [
        ((Motion(speed=0.3),), True),
        ((Motion(speed=-0.3),), True),
        ((Motion(speed=0.01),), False),
        ((Motion(speed=None),), False),
        (tuple(Pose(0.1 * step, 0.0, 0.0) for step in range(100)), True),
        (tuple(Pose(0.0, 0.0, 0.1 * step) for step in range(100)), True),
        ((Pose(1.0, 2.0, 3.14159), Pose(1.0, 2.0, -3.14159)), False),
        ((Pose(1.0, 2.0, 3.0), Pose(1.005, 2.0, 3.01)), False),
    ],
)
async def test_a_robot_that_moves_by_its_own_pose_or_speed_is_named(
    messages: tuple[FleetMessage, ...], moves: bool
) -> None:
    world = World("r1", "r2")
    async with publishing(world, "r2", *messages):
        report = await stopped(world)
    assert report.text == f"2 of 2 {CONFIRMED}" + f"; r2 {MOVES}" * moves


@pytest.mark.jumping
async def test_who_rolls_out_after_the_stop_does_not_move() -> None:
    world = World("r1")

    async def roll_out() -> None:
        for step in range(4):
            world.gateways["r1"].publish(topics.POSE, Pose(0.1 * step, 0.0, 0.0))
            await asyncio.sleep(0.1)

    rolling = asyncio.create_task(roll_out())
    report = await stopped(world)
    await rolling
    assert report.good, report


@pytest.mark.jumping
async def test_a_robot_that_is_away_is_not_counted_as_stopped() -> None:
    world = World("r1", "r2")
    world.gateways["r2"].publish(topics.STATUS, Status(state="offline", reason="connection refused"))
    assert (await stopped(world)).text == f"1 of 2 {CONFIRMED}; r2 away"
