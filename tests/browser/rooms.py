"""A simulated robot whose body the test knows, behind a real gateway, and a real console."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import Browser
from tests.e2e.conftest import Bench, device, until
from tests.ports import HOST, free_port
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation, find_protocol
from zbridge.simulation.world import Body
from zbridge.toml import as_toml


class Room:
    """One robot named r1 in its simulated room, and a browser before the console."""

    def __init__(self, bench: Bench, body: Body, browser: Browser) -> None:
        self.bench, self.body, self.browser = bench, body, browser

    async def moves(self, metres: float = 0.05, within_s: float = 10.0) -> None:
        """Wait until the robot has moved by itself."""
        begun = (self.body.x, self.body.y)
        async with asyncio.timeout(within_s):
            while math.dist(begun, (self.body.x, self.body.y)) < metres:  # noqa: ASYNC110
                await asyncio.sleep(0.02)

    async def rests(self, seconds: float = 0.5, within_s: float = 5.0) -> None:
        """Wait until the robot rests for so long."""
        loop = asyncio.get_running_loop()
        at, since, ends = (self.body.x, self.body.y), loop.time(), loop.time() + within_s
        while loop.time() - since < seconds:
            assert loop.time() < ends, f"it still moves: {self.body}"
            await asyncio.sleep(0.02)
            if at != (self.body.x, self.body.y):
                at, since = (self.body.x, self.body.y), loop.time()


@contextlib.asynccontextmanager
async def simulated(protocol: str, monkeypatch: pytest.MonkeyPatch, body: Body) -> AsyncIterator[list[int]]:
    """Run a simulated robot with this body; give the ports of its links."""
    monkeypatch.setattr(Body, "somewhere", classmethod(lambda cls, rng, **more: body))
    found, ready = find_protocol(protocol), asyncio.get_running_loop().create_future()
    addresses = tuple(Address(HOST, free_port()) for _ in range(found.links))
    running = asyncio.create_task(found.simulate(Simulation(addresses, seed=1, ready=ready.set_result)))
    try:
        yield [address.port for address in await ready]
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def console(bench: Bench, endpoint: str) -> str:
    """Start a console; give its address."""
    command = ("console", "--listen", f"{HOST}:0", "--roster", str(bench.folder / "roster"))
    process: Any = bench.zbridge(*command, "--connect", endpoint)
    return str((await asyncio.to_thread(process.stdout.readline)).split()[-1])


def configured(protocol: str, ports: list[int]) -> str:
    """Write the ``[device]`` of a gateway of a simulated robot."""
    options = find_protocol(protocol).simulated
    lines = "\n".join(f"{name} = {as_toml(value)}" for name, value in options.items())
    return device(ports[0], protocol, lines, *ports[1:])


@contextlib.asynccontextmanager
async def room(
    protocol: str, chromium: Any, folder: Path, monkeypatch: pytest.MonkeyPatch, body: Body, *parts: str
) -> AsyncIterator[Room]:
    """Run it all. parts: of the gateway's configuration, besides the device."""
    with contextlib.ExitStack() as stack:
        bench = Bench(folder, stack)
        async with simulated(protocol, monkeypatch, body) as ports:
            bench.gateway(configured(protocol, ports), *parts)
            at = await console(bench, bench.endpoint)
            await asyncio.to_thread(until, lambda: bench.fleet.state() == "established", 20.0, "established")
            browser = Browser(chromium, at)
            yield Room(bench, body, browser)
            assert browser.complaints == []
