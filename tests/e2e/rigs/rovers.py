"""A fragile rover on a thread of the test, which may be its RC pilot, its radio or its mission meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import math
import queue
import threading
from typing import Any

import msgspec

from gateways.mavlink.conformance.fragile_robot import FragileRover
from gateways.mavlink.conformance.machine import GatewayAsStation
from gateways.mavlink.conformance.rover import RoverQuirks
from tests.e2e.conftest import HOST, device
from tests.e2e.rigs.fragile import ARMS, JUDGED

ALL = RoverQuirks(lacks=frozenset())
"""It measures distances too: a wall 2 m ahead, and 5 m to the right."""


class RoverOnThread:
    """Serves one fragile rover until the stack ends. expected: of its gateway, where it is not as usual."""

    def __init__(self, stack: contextlib.ExitStack, quirks: RoverQuirks = ALL, **expected: Any) -> None:
        gateway: GatewayAsStation = msgspec.structs.replace(JUDGED, **expected)
        self.judge = FragileRover(expected=gateway, quirks=quirks)
        self.machine = self.judge.machine
        self._ports: queue.Queue[int] = queue.Queue()
        self._ended = threading.Event()
        thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._ended.set)
        self.device = device(self._ports.get(timeout=10.0), "mavlink", ARMS)
        """The table of a configuration."""

    async def _serve(self) -> None:
        serving = asyncio.create_task(self.judge.serve(HOST, 0, self._ports.put))
        await asyncio.to_thread(self._ended.wait)
        serving.cancel()
        await asyncio.wait([serving])

    @property
    def forward(self) -> float:
        """The speed that it is to reach, m/s."""
        return self.machine.commanded[0]

    @property
    def connections(self) -> int:
        """How many have ended."""
        return sum("connection" in event for event in self.judge.events)

    def drives(self, forward: float) -> bool:
        """Whether it is to reach a speed, and moves that way."""
        return abs(self.forward - forward) < 0.02 and self.machine.speed * forward > 0

    def sent(self, name: str) -> list[float]:
        """List when messages of this name came."""
        return [row[0] for row in tuple(self.judge.received) if row[1] == name]


def ahead_m(before: dict[str, Any], after: dict[str, Any]) -> float:
    """Return how far a pose lies ahead of another one."""
    heading = before["heading"]
    return float((after["x"] - before["x"]) * math.cos(heading) + (after["y"] - before["y"]) * math.sin(heading))
