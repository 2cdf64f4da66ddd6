"""A simulated ALF vehicle as fragile as the deployed ones: the judge of a gateway that plays HQ.

It records each violation of what the protocol page ``alf.md`` demands towards vehicles, and dies of what kills them. It
shares no code with the gateway: not its messages, sessions or translation. Section names in the docstrings are those
of that page.
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import logging
import random
import socket
import time
from collections.abc import Callable, Iterable
from functools import partial

from gateways.alf.conformance import parser as wire
from gateways.alf.conformance.machine import Machine
from gateways.alf.conformance.parser import Dialect, Heard, Repeats, Scale, Times, show
from zbridge.simulation.fragile import FragileServer, Work, log_violations, print_death
from zbridge.simulation.sockets import drain, reset_on_close
from zbridge.simulation.ticker import Ticker

_MOST_MOVE_S = 0.1
"""Longest time for which the vehicle moves in one cycle, however late it is."""
_log = logging.getLogger(__name__)


class _Phase(enum.Enum):
    LISTENING = enum.auto()
    CONNECTED = enum.auto()
    ENDING = enum.auto()
    """The vehicle sent END, the HQ has not."""
    CLOSING = enum.auto()
    """Both sent END."""
    OVER = enum.auto()


_DEPLOYED = Times()
_COUNTS = Scale()


class FragileVehicle(FragileServer):
    """One server of a vehicle: serves one connection, records every violation and dies of the deadly ones.

    ``laser``: sends 2 and 1; ``drive``: sends 4 and takes 3; ``speed_full``: full speed in ``text``; ``scale``: of
    message 4 in ``binary``; ``machine``: shared with the vehicle's other server, default its own; ``keep``: most
    entries of every list; ``note``: called with each violation.
    """

    def __init__(
        self,
        dialect: Dialect,
        *,
        laser: bool,
        drive: bool,
        points: int = wire.POINTS,
        seed: int = 1,
        speed_full: int = wire.FULL_PERCENT,
        scale: Scale = _COUNTS,
        times: Times = _DEPLOYED,
        machine: Machine | None = None,
        keep: int = 100_000,
        note: Callable[[str], None] | None = None,
    ) -> None:
        if not (laser or drive) or dialect not in ("text", "binary"):
            raise ValueError(f"no such server: dialect {dialect!r}, laser {laser}, drive {drive}")
        super().__init__(keep=keep, note=note)
        self.dialect: Dialect = dialect
        self.laser, self.drive = laser, drive
        self.received: list[tuple[float, int, tuple[int, ...]]] = []
        full = speed_full if dialect == "text" else wire.FULL_PERCENT
        self.machine = machine or Machine(random.Random(f"{seed} machine"), points, full)
        self.repeats = Repeats(times)
        self._scale, self._times = scale, times
        self._reader = wire.reader(dialect, {wire.DRIVE, wire.END} if drive else {wire.END}, full)
        self._phase = _Phase.LISTENING
        self._conn: socket.socket | None = None
        self._broken: OSError | None = None
        self._sending, self._midway = asyncio.Lock(), False
        self._sequence = 0
        self._booted_s = time.monotonic() - random.Random(f"{seed} clock").uniform(10, 3600)
        self._command: tuple[int, ...] | None = None
        self._commands = 0
        self._idle_s = self._waited_s = self._late_s = 0.0

    def __repr__(self) -> str:
        roles = "+".join(["drive"] * self.drive + ["laser"] * self.laser)
        state = f"{self._phase.name} violations={len(self.violations)} alive={self.alive}"
        return f"<FragileVehicle {self.dialect} {roles} {state}>"

    async def end(self) -> None:
        """Send END, and wait for the end of the connection: END back within 1 s, then the close ("Roles")."""
        async with self._sending:
            if self._phase is _Phase.CONNECTED:
                self._phase, self._waited_s = _Phase.ENDING, 0.0
                self._send_end()
        if self._phase is not _Phase.LISTENING:
            await self._over.wait()

    async def cut(self) -> None:
        """Reset the connection, as a computer that loses its power would."""
        async with self._sending:
            if self._conn is not None:
                reset_on_close(self._conn)
                self._conn.close()
                self._finish("the vehicle cut the connection")

    # The connection

    def _begin(self, conn: socket.socket) -> None:
        self._conn, self._phase = conn, _Phase.CONNECTED
        self._start(self._talk())

    def _phase_name(self) -> str:
        return self._phase.name.lower()

    def _work(self) -> Iterable[Work]:
        return (self._live(),)

    def _before_close(self) -> None:
        if self._phase is _Phase.CONNECTED and self.alive and not self._midway:
            self._send_end()
        self._phase = _Phase.OVER

    def _finish(self, why: str) -> None:
        """Leave the connection. The socket is closed at the end of the server: a send may be waiting for it."""
        self._event(why)
        if self._conn is not None:
            with contextlib.suppress(OSError):
                self._conn.shutdown(socket.SHUT_RDWR)
        self._phase, self._conn = _Phase.OVER, None
        self._over.set()

    async def _live(self) -> None:
        """Read, judge and move in cycles. A late cycle counts as one of the right length."""
        ticker = Ticker(self._times.cycle_s)
        while True:
            await ticker.tick()
            self._late_s = max(self._late_s, ticker.late_s)
            if self._conn is not None:
                passed_s = min(ticker.passed_s, self._times.cycle_s)
                self._commands, self._waited_s = 0, self._waited_s + passed_s
                self._listen(self._conn)
                self._wait(passed_s)
            self._move(min(ticker.passed_s, _MOST_MOVE_S))

    def _listen(self, conn: socket.socket) -> None:
        """Take all that came since the last cycle, and the end of the connection."""
        data, end = drain(conn)
        for heard in self._reader.take(data):
            self._hear(heard)
        if end:
            self._part(repr(self._broken) if self._broken else end)

    def _part(self, end: str) -> None:
        """Judge an end of the connection ("Roles", END: both sides then close)."""
        if self._phase is not _Phase.CLOSING and self._reader.rest:
            self._violate(f"the connection ended within a message: {show(self._reader.rest, self.dialect)}")
        if self._phase is _Phase.ENDING:
            self._violate("the HQ closed without answering END")
        how = "after END" if self._phase is _Phase.CLOSING else "without END"
        self._finish(f"the HQ closed the connection {how}: {end}")

    def _wait(self, passed_s: float) -> None:
        """Judge what is overdue: drive commands, END, the close."""
        if self._phase is _Phase.CONNECTED and self.drive:
            if problem := self.repeats.cycle(passed_s, self._commands):
                late = f" (this process woke {self._late_s * 1000:.0f} ms late)"
                self._violate(problem + late * (self._late_s > self._times.cycle_s / 4))
            if self._commands:
                self._late_s = 0.0
        elif self._phase is _Phase.ENDING and self._waited_s > self._times.answer_s:
            self._violate(f"no END within {self._times.answer_s:g} s of the vehicle's")
            self._finish("the vehicle closed")
        elif self._phase is _Phase.CLOSING and self._waited_s > self._times.close_s:
            self._violate(f"the HQ did not close within {self._times.close_s:g} s of its END")
            self._finish("the vehicle closed")

    # Messages of the HQ

    def _hear(self, heard: Heard) -> None:
        self.received.append((time.monotonic(), heard.kind, heard.fields))
        del self.received[: -self._keep]
        raw = show(heard.raw, self.dialect)
        if self._phase is _Phase.CLOSING:
            return self._violate(f"a message after END: {raw}")
        if heard.deadly:
            self._die(f"{heard.problem}: {raw}")
        if heard.problem:
            self._violate(f"{heard.problem}: {raw}")
        if heard.kind == wire.END:
            self._leave()
        elif self._phase is _Phase.CONNECTED:
            self._obey(heard)
        elif self._waited_s > self._times.flight_s:
            self._violate(f"a message {self._waited_s:.2f} s after the vehicle's END: {raw}")
        return None

    def _obey(self, heard: Heard) -> None:
        """Take a command; apply the last one again on any message ("The gateway as HQ": stale commands)."""
        if heard.kind == wire.DRIVE and heard.whole and self.drive:
            if self._command is None and heard.fields[0]:
                self._violate(f"the first command has speed {heard.fields[0]}: {show(heard.raw, self.dialect)}")
            if self.dialect == "binary" and heard.fields[0] > wire.FULL_PERCENT and heard.fields != self._command:
                self._event(f"speed {heard.fields[0]} counts as 100")
            self._command = heard.fields
            self._commands += 1
        if self._command is not None:
            self.machine.obey(self.dialect, self._command)
            self._idle_s = 0.0

    def _leave(self) -> None:
        """Take the HQ's END: answer it unless it is an answer, close this side, wait for the other (255)."""
        if self._command is not None and self._command[0]:
            self._event(f"END while the last command had speed {self._command[0]}")
        answer = self._phase is _Phase.CONNECTED
        self._phase, self._waited_s = _Phase.CLOSING, 0.0
        if self._sending.locked():
            self._start(self._close_later(answer))
        else:
            self._close(answer)

    async def _close_later(self, answer: bool) -> None:
        async with self._sending:
            self._close(answer)

    def _close(self, answer: bool) -> None:
        """Close this side only: what the HQ still sends is to be judged."""
        if answer:
            self._send_end()
        if self._conn is not None:
            with contextlib.suppress(OSError):
                self._conn.shutdown(socket.SHUT_WR)

    def _move(self, dt: float) -> None:
        """Move; stop the motor after some time without a command, connected or not ("Dialect `text`", 3)."""
        if not self.drive:
            return
        was_idle_s, self._idle_s = self._idle_s, self._idle_s + dt
        if self._command is not None and was_idle_s <= self._times.motor_s < self._idle_s:
            moving = "moving" if self.machine.moving else "at rest"
            self._event(f"{self._times.motor_s:g} s without a command: the motor stopped by itself, {moving}")
            self.machine.stop()
        self.machine.step(dt)

    # Messages of the vehicle

    async def _talk(self) -> None:
        """Send 2 once, 4 at once and then every second, 1 ten times a second ("Dialect `text`")."""
        if self.laser:
            await self._tell(wire.INIT)
            self._start(self._repeat(wire.SCAN, Ticker(self._times.scan_s)))
        if self.drive:
            self._start(self._repeat(wire.INFO, Ticker(self._times.info_s, first_s=0.0)))

    async def _repeat(self, kind: int, ticker: Ticker) -> None:
        while self._phase is _Phase.CONNECTED:
            await ticker.tick()
            await self._tell(kind)

    def _send_end(self) -> None:
        """Send END between two messages, without waiting: it is too short to be sent in part."""
        if self._conn is not None:
            with contextlib.suppress(OSError):
                self._conn.send(wire.write(self.dialect, wire.END, [1]))

    async def _tell(self, kind: int) -> None:
        if kind == wire.INIT:
            fields = self.machine.geometry()
        elif kind == wire.INFO:
            fields = self.machine.feel(self.dialect, self._scale)
        else:
            stamp_ms = int(1000 * (time.monotonic() - self._booted_s)) % 2**32
            fields = [self._sequence, stamp_ms, *self.machine.measure()]
            self._sequence += 1
        await self._send(wire.write(self.dialect, kind, fields))

    async def _send(self, data: bytes) -> None:
        """Send a message whole, unless the conversation is ending."""
        async with self._sending:
            conn = self._conn
            if conn is None or self._phase is not _Phase.CONNECTED:
                return
            try:
                self._midway = True
                async with asyncio.timeout(self._times.send_s):
                    await asyncio.get_running_loop().sock_sendall(conn, data)
                self._midway = False
            except TimeoutError:
                self._finish(f"the HQ read nothing for {self._times.send_s:g} s")
            except OSError as error:
                self._broken = error  # reported once: the next read only sees an end


async def simulate_fragile(
    host: str,
    port: int,
    *,
    dialect: Dialect,
    laser_port: int | None,
    seed: int,
    ready: Callable[[int, int | None], None],
    times: Times = _DEPLOYED,
    points: int = wire.POINTS,
) -> None:
    """Run a fragile vehicle until cancelled or dead; log each violation, and print what it died of.

    Without ``laser_port`` one server does everything; with it (0: any) ``port`` drives and ``laser_port`` measures.
    ``ready`` is called with both ports once both listen.
    """
    one = laser_port is None
    server = partial(FragileVehicle, dialect, seed=seed, times=times)
    drive = server(laser=one, drive=True, points=points, note=log_violations(_log, "vehicle" if one else "drive"))
    if laser_port is None:
        await _run(drive, host, port, lambda number: ready(number, None))
        return
    laser = server(laser=True, drive=False, machine=drive.machine, note=log_violations(_log, "laser"))
    ports: dict[str, int] = {}

    def listening(name: str, number: int) -> None:
        ports[name] = number
        if len(ports) == 2:
            ready(ports["drive"], ports["laser"])

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(_run(drive, host, port, lambda number: listening("drive", number)))
        tasks.create_task(_run(laser, host, laser_port, lambda number: listening("laser", number)))


async def _run(vehicle: FragileVehicle, host: str, port: int, ready: Callable[[int], None]) -> None:
    await vehicle.serve(host, port, ready)
    print_death(vehicle)
