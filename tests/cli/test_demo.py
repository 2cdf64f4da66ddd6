"""The drivers of ``zbridge demo``: after a pause of the program they drive on, after a stop they do not."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from tests.client import DEADMAN_S, LEASE_S, World
from tests.clock import JumpingLoop
from zbridge.cli.demo import FIGURE_S, wander
from zbridge.fleet.messages import Drive

pytestmark = pytest.mark.jumping

ROUND_S = 2 * FIGURE_S + 0.7
"""Some figures, and a part of one: in the midst of motion."""
AHEAD = Drive(forward=0.6)


@contextlib.asynccontextmanager
async def wandering() -> AsyncIterator[World]:
    """Let the demo drive a robot, beside its gateway, for a while."""
    world = World()
    task = asyncio.create_task(wander(world.robot))
    await asyncio.sleep(ROUND_S)
    assert AHEAD in world.gateway.driven
    world.machine.commands.clear()
    try:
        yield world
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@pytest.mark.parametrize("pause_s", [0.7, DEADMAN_S, LEASE_S + 0.5, 30.0])
@pytest.mark.parametrize("times", [1, 3])
async def test_after_a_pause_the_robot_is_stopped_and_then_driven_again(pause_s: float, times: int) -> None:
    async with wandering() as world:
        for _ in range(times):
            stops = world.machine.stops
            loop = asyncio.get_running_loop()
            assert isinstance(loop, JumpingLoop)
            loop.pause(pause_s)
            world.machine.commands.clear()
            await asyncio.sleep(ROUND_S)
            assert world.machine.stops > stops
            if pause_s < LEASE_S:  # a new lease needs none
                assert world.gateway.driven[0] == Drive(), "neutral before motion"
            assert AHEAD in world.gateway.driven
            assert world.gateway.control.holder == "demo"


async def test_a_robot_that_accepts_nothing_for_a_while_is_waited_for() -> None:
    async with wandering() as world:
        world.machine.refusal = "busy"
        await asyncio.sleep(3 * ROUND_S)
        assert world.gateway.driven == []
        world.machine.refusal = None
        await asyncio.sleep(ROUND_S)
        assert AHEAD in world.gateway.driven


async def test_a_robot_that_somebody_stopped_or_took_is_left_to_them() -> None:
    async with wandering() as world:
        await world.others.stop()
        world.machine.commands.clear()
        await asyncio.sleep(10 * ROUND_S)
        assert world.gateway.driven == []
    async with wandering() as world, world.others.control("ann"):
        world.machine.commands.clear()
        await asyncio.sleep(10 * ROUND_S)
        assert world.gateway.driven == []
