"""A simulated robot of a protocol's author: bytes in, bytes out, and time. Serves it on TCP.

Knows no protocol. The gateways of this package simulate several clients and links
(:mod:`zbridge.simulation.simulator`); a robot on a serial line has one of each.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod

import msgspec

from zbridge.errors import ConfigError, ProtocolError
from zbridge.log import Log
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation, Truth

log = Log(__name__)

STEP_S = 0.01
"""Seconds between two steps of a simulated robot."""
_READ = 4096
_MOST_STEP_S = 0.1
"""Longest step, where this process was paused."""


class SimulatedRobot(ABC):
    """One robot without a link."""

    @abstractmethod
    def receive(self, data: bytes) -> bytes:
        """Obey bytes, cut anywhere; return the robot's answers."""

    @abstractmethod
    def step(self, dt: float) -> bytes:
        """Advance by ``dt`` seconds; return what the robot sends by itself."""

    @abstractmethod
    def truth(self) -> Truth:
        """Return how the robot really is."""

    def connected(self) -> bytes:
        """Begin with a new client, and forget half a message of the one before; return what the robot sends first."""
        return b""


async def serve(simulation: Simulation, robot: SimulatedRobot) -> None:
    """Serve one robot on TCP until cancelled; one client at a time, any more are closed at once.

    Raises ConfigError for options that such a robot does not have, OSError if the address cannot be bound.
    """
    if (
        simulation.version
        or simulation.dialect
        or simulation.udp
        or simulation.fragile
        or len(simulation.addresses) > 1
    ):
        raise ConfigError("this simulated robot has one link, and no versions, dialects, datagrams or fragile variant")
    (address,), writers = simulation.addresses, set[asyncio.StreamWriter]()

    async def serve_client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if writers:
            writer.close()
            return
        writers.add(writer)
        try:
            writer.write(robot.connected())
            while data := await reader.read(_READ):
                writer.write(robot.receive(data))
                await writer.drain()
        except ConnectionError:
            pass
        except ProtocolError as error:  # what it was sent can be no frame
            log.debug("client_closed", "the client is closed: {error}", error=error)
        finally:
            writers.discard(writer)
            writer.close()

    async with await asyncio.start_server(serve_client, address.host, address.port) as server:
        simulation.ready((Address(*server.sockets[0].getsockname()[:2]),))
        try:
            await _live(simulation, robot, writers)
        finally:
            for writer in writers:
                writer.close()  # its task ends by itself, and is not cancelled


async def _live(simulation: Simulation, robot: SimulatedRobot, writers: set[asyncio.StreamWriter]) -> None:
    clock = asyncio.get_running_loop().time
    now, lived_s = clock(), 0.0
    while True:
        await asyncio.sleep(STEP_S)
        before, now = now, clock()
        dt = min(now - before, _MOST_STEP_S)
        sent = robot.step(dt)
        lived_s += dt
        simulation.report(msgspec.structs.replace(robot.truth(), lived_s=lived_s))
        for writer in writers:
            writer.write(sent)
