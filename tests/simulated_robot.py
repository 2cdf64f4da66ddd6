"""Simulated robots inside a test's own event loop."""

from __future__ import annotations

import asyncio
import contextlib

from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation, find_protocol


async def simulated(protocol: str, stack: contextlib.AsyncExitStack) -> list[str]:
    """Start a simulated robot; return where it listens. It ends with the stack."""
    found = find_protocol(protocol)
    listens: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    at = found.links * (Address("127.0.0.1", 0),)
    robot = asyncio.create_task(found.simulate(Simulation(at, 1, None, None, False, False, listens.set_result)))
    stack.callback(robot.cancel)
    return [str(address) for address in await listens]
