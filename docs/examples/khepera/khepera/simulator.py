"""A simulated Khepera in the simulated room: it answers requests, turns its wheels, and stops during a silence."""

from __future__ import annotations

import math

import numpy as np
from zbridge.protocol import ProtocolError, Simulation, Truth
from zbridge.simulation import SimulatedRobot, serve
from zbridge.simulation.world import Body, cast
from zbridge.wire import FrameBuffer, Line

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
from khepera.translate import BEARINGS_DEG, DISTANCE_M, LIGHT, PULSE_M, STILL, UNIT_M_S, WRAP

SILENCE_S = 1.0
"""Seconds without a request after which it stops."""
TRACK_M, RADIUS_M = 0.053, 0.0275
LONGEST = 128
_ANGLES = np.radians(list(BEARINGS_DEG.values()))


class Khepera(SimulatedRobot):
    """The robot, without a link. place: x, y, heading. at_wrap: its counters are about to begin anew."""

    def __init__(self, place: tuple[float, float, float] | None = None, *, at_wrap: bool = False) -> None:
        self.body = Body.placed(place, radius=RADIUS_M)
        self.speeds = STILL
        self.leds: dict[int, bool] = {}
        self._pulses = [float(WRAP // 2 - 100 if at_wrap else 0)] * 2
        self._lines = FrameBuffer(LINES.end, LONGEST)
        self._silent_s = 0.0

    def connected(self) -> bytes:
        self._lines = FrameBuffer(LINES.end, LONGEST)
        return b""

    def receive(self, data: bytes) -> bytes:
        """Carry out every whole line, and return the answers; a line that is no request has none."""
        return b"".join(map(self._answer, self._lines.feed(data)))

    def step(self, dt: float) -> bytes:
        self._silent_s += dt
        if self._silent_s > SILENCE_S:
            self.speeds = STILL
        left, right = self._speeds_m_s()
        self._pulses[0] += left * dt / PULSE_M
        self._pulses[1] += right * dt / PULSE_M
        self.body.step((left + right) / 2, 0.0, (right - left) / TRACK_M, dt)
        return b""

    def truth(self) -> Truth:
        wraps = sum(pulses >= WRAP // 2 for pulses in self._pulses)
        neutral, silent = self.speeds == STILL, self._silent_s > SILENCE_S
        return Truth(self.body.x, self.body.y, self.body.heading, self._speeds_m_s(), neutral, wraps, silent)

    def _speeds_m_s(self) -> tuple[float, float]:
        return self.speeds.left * UNIT_M_S, self.speeds.right * UNIT_M_S

    def _answer(self, line: bytes) -> bytes:
        try:
            request = LINES.read(line)
        except ProtocolError:
            return b""
        answer = self._carry_out(request)
        self._silent_s = 0.0
        return b"" if answer is None else LINES.write(answer)

    def _carry_out(self, request: Line) -> Line | None:
        match request:
            case ReadVersion():
                return Version(5, 1)
            case SetSpeeds():
                self.speeds = request
                return SpeedsSet()
            case ReadSpeeds():
                return Speeds(self.speeds.left, self.speeds.right)
            case ReadPositions():
                return Positions(*((round(pulses) + WRAP // 2) % WRAP - WRAP // 2 for pulses in self._pulses))
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
    await serve(simulation, Khepera(simulation.place, at_wrap=simulation.at_wrap))
