"""A simulated Khepera in the simulated room: it answers requests, turns its wheels, and stops during a silence."""

from __future__ import annotations

import asyncio
import math

import numpy as np

from khepera.messages import (
    LINES,
    LedSet,
    Positions,
    Proximity,
    ReadPositions,
    ReadProximity,
    ReadSpeeds,
    ReadVersion,
    SetLed,
    SetSpeeds,
    Speeds,
    SpeedsSet,
    Version,
)
from khepera.translate import BEARINGS_DEG, DISTANCE_M, LIGHT, PULSE_M, UNIT_M_S
from zbridge.protocol import Address, ConfigError, ProtocolError, Simulation
from zbridge.simulation.world import Body, cast
from zbridge.wire import Line

STEP_S = 0.01
SILENCE_S = 1.0
"""Seconds without a request after which it stops."""
TRACK_M, RADIUS_M = 0.053, 0.0275
_ANGLES = np.radians(list(BEARINGS_DEG.values()))


class Khepera:
    """The robot, without a link."""

    def __init__(self) -> None:
        self.body = Body(radius=RADIUS_M)
        self.speeds = SetSpeeds(0, 0)
        self.leds: dict[int, bool] = {}
        self._left_m = self._right_m = 0.0
        self._silent_s = 0.0

    def answer(self, line: bytes) -> bytes:
        """Carry out one line and return its answer, empty for a line that is no request."""
        try:
            request = LINES.read(line)
        except ProtocolError:
            return b""
        answer = self._answer(request)
        self._silent_s = 0.0
        return b"" if answer is None else LINES.write(answer)

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        self._silent_s += dt
        if self._silent_s > SILENCE_S:
            self.speeds = SetSpeeds(0, 0)
        left, right = self.speeds.left * UNIT_M_S, self.speeds.right * UNIT_M_S
        self._left_m += left * dt
        self._right_m += right * dt
        self.body.step((left + right) / 2, 0.0, (right - left) / TRACK_M, dt)

    def _answer(self, request: Line) -> Line | None:
        match request:
            case ReadVersion():
                return Version(5, 1)
            case SetSpeeds():
                self.speeds = request
                return SpeedsSet()
            case ReadSpeeds():
                return Speeds(self.speeds.left, self.speeds.right)
            case ReadPositions():
                return Positions(round(self._left_m / PULSE_M), round(self._right_m / PULSE_M))
            case ReadProximity():
                return self._proximity()
            case SetLed():
                was_on = self.leds.get(request.number, False)
                self.leds[request.number] = request.action == 1 or (request.action == 2 and not was_on)
                return LedSet()
        return None

    def _proximity(self) -> Proximity:
        metres = cast(self.body.x, self.body.y, self.body.heading + _ANGLES, 1.0) - RADIUS_M
        light = np.interp(metres, DISTANCE_M[::-1], LIGHT[::-1], right=0)
        return Proximity(*(math.floor(value) for value in light))


async def simulate(simulation: Simulation) -> None:
    """Serve one Khepera on a TCP port until cancelled."""
    if simulation.version or simulation.dialect or simulation.udp or simulation.fragile:
        raise ConfigError("a simulated Khepera has no versions, dialects, datagrams or fragile variant")
    robot = Khepera()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                writer.write(robot.answer(line))
                await writer.drain()
        except (ConnectionError, ValueError):  # disconnected, or a line without an end
            pass
        finally:
            writer.close()

    (address,) = simulation.addresses
    async with await asyncio.start_server(serve, address.host, address.port) as server:
        simulation.ready((Address(*server.sockets[0].getsockname()[:2]),))
        clock = asyncio.get_running_loop().time
        lived = clock()
        while True:
            await asyncio.sleep(STEP_S)
            before, lived = lived, clock()
            robot.step(lived - before)
