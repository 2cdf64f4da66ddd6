"""A simulated ARCOS robot in the simulated room: it is opened, reports ten times a second, and has a watchdog."""

from __future__ import annotations

import math

import numpy as np
from zbridge.protocol import ProtocolError, Simulation, Truth
from zbridge.simulation import SimulatedRobot, serve
from zbridge.simulation.world import Body, cast
from zbridge.wire import FrameBuffer, Message

from arcos.messages import PACKETS, Command, Do, Report, Setting, Sonar, Synced, read_command, write
from arcos.translate import BEARINGS_DEG, BUMPERS, FULL_TURN, MM_PER_M, WRAP

REPORT_S, WATCHDOG_S = 0.1, 2.0
TRACK_M, RADIUS_M, RING_M, RANGE_M = 0.33, 0.22, 0.2, 5.0
NEW_SONARS = 4
"""Readings in a report: the sonars take turns."""
BATTERY = 125
_ANGLES = np.radians(BEARINGS_DEG)
_SIDES = {side: sum(bit for name, bit in BUMPERS.items() if side in name) for side in ("front", "rear")}


class Arcos(SimulatedRobot):
    """The robot, without a link. place: x, y, heading. at_wrap: its counters are about to begin anew."""

    def __init__(self, place: tuple[float, float, float] | None = None, *, at_wrap: bool = False) -> None:
        self.body = Body.placed(place, radius=RADIUS_M)
        self.motors = self.opened = False
        self._origin = (self.body.x, self.body.y, self.body.heading)
        self._first_mm = WRAP // 2 - 100 if at_wrap else 0
        self._packets = FrameBuffer(PACKETS.end, PACKETS.most)
        self._sync = 0  # the step of the handshake that comes next; 3: OPEN
        self._mm_s = self._deg_s = 0
        self._sonars, self._next_sonar = False, 0
        self._silent_s = self._unreported_s = 0.0

    def connected(self) -> bytes:
        """Begin with a new client; the robot stays open, as it does not notice that a cable was pulled."""
        self._packets = FrameBuffer(PACKETS.end, PACKETS.most)
        return b""

    def receive(self, data: bytes) -> bytes:
        """Carry out every whole packet, and return the answers."""
        return b"".join(map(self._answer, self._packets.feed(data)))

    def step(self, dt: float) -> bytes:
        self._silent_s += dt
        if self._watchdog:
            self._mm_s = self._deg_s = 0
        self.body.step(self._mm_s / MM_PER_M, 0.0, math.radians(self._deg_s), dt)
        self._unreported_s += dt
        if not self.opened or self._unreported_s < REPORT_S:
            return b""
        self._unreported_s -= REPORT_S
        return write(self._report())

    def truth(self) -> Truth:
        neutral = not (self._mm_s or self._deg_s)
        wraps = sum(abs((round(count) + WRAP // 2) // WRAP) for count in self._counters_mm())
        body = self.body
        return Truth(body.x, body.y, body.heading, self._wheels_m_s(), neutral, wraps, self._watchdog)

    @property
    def _watchdog(self) -> bool:
        return self.opened and self._silent_s > WATCHDOG_S

    # What it is sent

    def _answer(self, packet: bytes) -> bytes:
        try:
            command = read_command(packet)
        except ProtocolError:
            return b""
        self._silent_s = 0.0
        if self.opened:
            self._carry_out(command)
            return b""
        return self._synchronise(command)

    def _synchronise(self, command: Message) -> bytes:
        match command:
            case Command(Do.OPEN) if self._sync == 3:
                self._open()
            case Command(2) if self._sync >= 2:
                self._sync = 3
                return write(Synced(2, b"Robby\0Pioneer\0p3dx\0"))
            case Command(number) if number < 2 and number <= self._sync:
                self._sync = number + 1
                return write(Synced(number))
        return b""

    def _open(self) -> None:
        """Begin at the origin, with the motors off."""
        self.opened, self.motors, self._sonars = True, False, False
        self._origin = (self.body.x, self.body.y, self.body.heading)
        self._unreported_s = 0.0

    def _carry_out(self, command: Message) -> None:
        match command:
            case Command(Do.CLOSE):
                self.opened, self._sync = False, 0
                self._mm_s = self._deg_s = 0
            case Setting(Do.ENABLE, _, on):
                self.motors = bool(on)
                self._mm_s = self._deg_s = 0
            case Setting(Do.SONAR, _, on):
                self._sonars = bool(on)
            case Setting(Do.VEL, sign, size) if self.motors:
                self._mm_s = size if sign == 0x3B else -size
            case Setting(Do.RVEL, sign, size) if self.motors:
                self._deg_s = size if sign == 0x3B else -size

    # What it sends

    def _report(self) -> Report:
        x, y = ((round(count) + WRAP // 2) % WRAP - WRAP // 2 for count in self._counters_mm())
        heading = round(math.remainder(self.body.heading - self._origin[2], 2 * math.pi) * FULL_TURN / 2 / math.pi)
        left, right = (round(speed * MM_PER_M) for speed in self._wheels_m_s())
        kind = 0x33 if self._mm_s or self._deg_s else 0x32
        readings = self._readings()
        return Report(
            kind, x, y, heading, left, right, BATTERY, self._bumpers(), 0, int(self.motors), 0, readings, bytes(5)
        )

    def _counters_mm(self) -> tuple[float, float]:
        """Return how far it has moved since it was opened, along its first heading and across it."""
        x, y, heading = self._origin
        x, y, cos, sin = self.body.x - x, self.body.y - y, math.cos(heading), math.sin(heading)
        return self._first_mm + (x * cos + y * sin) * MM_PER_M, (y * cos - x * sin) * MM_PER_M

    def _wheels_m_s(self) -> tuple[float, float]:
        ahead, across = self._mm_s / MM_PER_M, math.radians(self._deg_s) * TRACK_M / 2
        return ahead - across, ahead + across

    def _bumpers(self) -> int:
        if not self.body.blocked:
            return 0
        return _SIDES["rear"] if self._mm_s < 0 else _SIDES["front"]

    def _readings(self) -> tuple[Sonar, ...]:
        if not self._sonars:
            return ()
        first, self._next_sonar = self._next_sonar, (self._next_sonar + NEW_SONARS) % len(_ANGLES)
        angles = self.body.heading + _ANGLES[first : first + NEW_SONARS]
        metres = np.clip(cast(self.body.x, self.body.y, angles, 10.0) - RING_M, 0.1, RANGE_M)
        return tuple(Sonar(number, round(float(range_m) * MM_PER_M)) for number, range_m in enumerate(metres, first))


async def simulate(simulation: Simulation) -> None:
    """Serve one robot on a TCP port until cancelled."""
    await serve(simulation, Arcos(simulation.place, at_wrap=simulation.at_wrap))
