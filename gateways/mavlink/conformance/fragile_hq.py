"""A simulated ground station as fragile as deployed ones: the judge of a gateway that plays the vehicle."""

from __future__ import annotations

import enum
import time
from collections.abc import Iterable
from typing import NoReturn

from gateways.mavlink.conformance.machine import ARM, GUIDED, HOLD, MANUAL, SET_MODE
from gateways.mavlink.conformance.parser import MavlinkReader, ParsedMavlinkFrame, write_frame
from gateways.mavlink.conformance.programs import PROGRAMS, Drives, JudgedStation, Program
from gateways.mavlink.conformance.vehicle_rules import ACCEPTED, VehicleRules, VehicleTimes
from zbridge.simulation.fragile import Work
from zbridge.simulation.hq_program import HqProgram
from zbridge.simulation.judge import Ended, show
from zbridge.simulation.sockets import drain
from zbridge.simulation.timing import Ticker

_CYCLE_S = 0.01
_DEPLOYED = VehicleTimes()
_COMMAND_S = 4.0
"""Longest time for which a command is waited for."""


class _StationPhase(enum.Enum):
    CONNECTING = enum.auto()
    CONNECTED = enum.auto()
    OVER = enum.auto()


class FragileStation(HqProgram):
    """One connection of a ground station: records every violation.

    ``program``: which one it plays; ``by``: how it drives, default as the program does; ``full``: m/s and rad/s of full
    scale; ``rest_z``: the stick's z at rest, 500 with QGC's default joystick; ``ftp``: MAVProxy's module is loaded. A
    row of ``received``: monotonic seconds, name, fields.
    """

    KEEP = 100_000
    _phase: _StationPhase
    _reader: MavlinkReader

    def __init__(
        self,
        program: Program = "mavsdk",
        *,
        by: Drives | None = None,
        full: tuple[float, float] = (1.0, 1.0),
        rest_z: int = 0,
        ftp: bool = False,
        times: VehicleTimes = _DEPLOYED,
    ) -> None:
        super().__init__()
        self.name, habits = program, PROGRAMS[program]
        self.rules = VehicleRules(habits.source, times, self._violate)
        self.station = JudgedStation(habits, self.rules, by=by, full=full, rest_z=rest_z, ftp=ftp)
        self.results: list[tuple[int, int | None]] = []
        """Number and result of each command that was waited for; None after a timeout."""
        self.texts: list[tuple[int, str]] = []
        """Severity and text of each STATUSTEXT."""
        self.station.events = self.events
        self._phase, self._reader = _StationPhase.CONNECTING, MavlinkReader()
        self._seq = 0

    @property
    def armed(self) -> bool:
        """Whether HEARTBEAT shows it armed."""
        return self.station.armed

    @property
    def mode(self) -> int:
        """As HEARTBEAT shows it."""
        return self.station.mode

    # What a person or a test does

    async def command(self, number: int, *params: float) -> int | None:
        """Send a command, repeated as the program does; return its result, None after a timeout."""
        sent = self.station.command(number, *params)
        end, ticker = time.monotonic() + _COMMAND_S, Ticker(_CYCLE_S)
        while not sent.over and not self._over.is_set() and time.monotonic() < end:
            await ticker.tick()
        self.results.append((number, sent.result))
        return sent.result

    async def set_mode(self, mode: int) -> int | None:
        """Ask for a mode; return the result."""
        return await self.command(SET_MODE, 1.0, float(mode))

    async def arm(self) -> int | None:
        """Ask to be armed; return the result."""
        return await self.command(ARM, 1.0)

    async def disarm(self) -> int | None:
        """Disarm; return the result."""
        return await self.command(ARM, 0.0)

    async def hold(self) -> int | None:
        """Stop sending motion, and ask for HOLD; return the result."""
        self.station.motion = None
        return await self.set_mode(HOLD)

    def drive(self, forward: float, turn: float = 0.0) -> None:
        """Repeat another setpoint or stick from now on: fractions of full scale, ``turn`` counter-clockwise."""
        self.station.motion = (forward, turn)

    def let_go(self) -> None:
        """Send no motion any more, as a program does that hangs without a thread of its own."""
        self.station.motion = None

    def others_drive(self) -> None:
        """Note that somebody else drives or ordered a stop: HEARTBEAT must show HOLD, disarmed."""
        self.rules.others_drive()

    def away(self, away: bool = True) -> None:
        """Note that the robot is gone, or back."""
        self.rules.away(away)

    @property
    def agreed(self) -> str:
        vehicle = self.rules.vehicle
        return f"connected to vehicle {vehicle[0]}, as {self.name}" if vehicle and self.station.heard else ""

    def shown(self) -> str:
        armed = "armed" if self.armed else "disarmed"
        return f"mode {self.mode}, {armed}, {len(self.station.params)} parameters" + ", lost" * self.station.lost

    async def neutral(self) -> None:
        """Centre the stick; the first time also choose the mode and arm."""
        self.drive(0.0)
        if not self.armed:
            mode = GUIDED if self.station.by == "setpoint" else MANUAL
            if await self.set_mode(mode) == ACCEPTED:
                await self.arm()

    async def push(self, forward: float, turn: float) -> None:
        self.drive(forward, turn)

    # The connection

    def _work(self) -> Iterable[Work]:
        self._phase = _StationPhase.CONNECTED
        return (self._live(),)

    def _before_close(self) -> None:
        self._phase = _StationPhase.OVER

    async def _live(self) -> None:
        """Read, judge and send in cycles. A late cycle counts as one of the right length."""
        ticker = Ticker(_CYCLE_S)
        while True:
            await ticker.tick()
            now = time.monotonic()
            self.rules.step(now, min(ticker.passed_s, _CYCLE_S * 2), ticker.late_s)
            self.station.step(now)
            self._take(*drain(self._tcp))
            data = b"".join(self._write_one() for _ in range(len(self.station.out)))
            if data:
                await self._write(data)

    def _write_one(self) -> bytes:
        name, fields = self.station.out.popleft()
        self._seq = (self._seq + 1) % 256
        return write_frame(name, fields, self.station.program.source, self._seq)

    def _receive(self, message: ParsedMavlinkFrame) -> None:
        self.received.append((time.monotonic(), message.name, message.fields))
        self._report(message.problem, show(message.raw))
        if not message.fields:
            return
        if message.name == "STATUSTEXT":
            self.texts.append((message.fields["severity"], message.fields["text"]))
        self.rules.receive(message)
        self.station.receive(message)

    def _judge_end(self, end: str) -> NoReturn:
        if self._reader.rest:
            self._violate(f"the connection ended within a frame: {show(self._reader.rest)}")
        raise Ended(f"the gateway closed: {end}")
