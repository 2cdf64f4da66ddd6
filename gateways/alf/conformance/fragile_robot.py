"""A simulated ALF vehicle as fragile as the legacy ones: the judge of a gateway that plays HQ."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterable
from functools import partial

from gateways.alf.conformance import parser as wire
from gateways.alf.conformance.machine import JudgedVehicle
from gateways.alf.conformance.parser import AlfTimes, Dialect, Fields, ParsedAlfMessage, Phase, Repeats, show
from zbridge.simulation.fragile import FragileServer, Work, log_violations
from zbridge.simulation.judge import Chances
from zbridge.simulation.sockets import drain, reset_on_close
from zbridge.simulation.timing import Ticker

_MOST_MOVE_S = 0.1
"""Longest time for which the vehicle moves in one cycle, however late it is."""
_DEPLOYED = AlfTimes()


class FragileVehicle(FragileServer):
    """One server of a vehicle: serves one connection, records every violation and dies of the deadly ones.

    ``laser``: sends 2 and 1; ``drive``: sends 4 and takes 3; ``machine``: shared with the vehicle's other server,
    default its own. A row of ``received``: monotonic seconds, id, fields.
    """

    KEEP = 100_000
    _phase: Phase
    _reader: wire.CommandReader

    def __init__(
        self,
        dialect: Dialect,
        *,
        laser: bool,
        drive: bool,
        points: int = wire.POINTS,
        seed: int = 1,
        times: AlfTimes = _DEPLOYED,
        machine: JudgedVehicle | None = None,
    ) -> None:
        if not (laser or drive) or dialect not in ("text", "binary"):
            raise ValueError(f"no such server: dialect {dialect!r}, laser {laser}, drive {drive}")
        super().__init__()
        self.dialect: Dialect = dialect
        self.laser, self.drive = laser, drive
        chance = Chances(seed)
        self.machine = machine or JudgedVehicle(chance["machine"], points)
        self._times, self._repeats = times, Repeats(times)
        self._reader = wire.CommandReader(dialect, {wire.DRIVE, wire.END} if drive else {wire.END})
        self._phase = Phase.WAITING
        self._sequence = 0
        self._booted_s = time.monotonic() - chance["clock"].uniform(10, 3600)
        self._command: Fields | None = None
        self._commands = 0
        self._idle_s = self._waited_s = self._late_s = 0.0

    async def end(self) -> None:
        """Send END, and wait for the end of the connection: END back within 1 s, then the close ("Links")."""
        async with self._sending:
            if self._phase is Phase.CONNECTED:
                self._phase, self._waited_s = Phase.ENDING, 0.0
                self._write_now(wire.end(self.dialect))
        if self._phase is not Phase.WAITING:
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
        self._phase = Phase.CONNECTED
        if self.laser:
            self._start(self._measure())
        if self.drive:
            self._start(self._repeat(wire.INFO, Ticker(self._times.info_s, first_s=0.0)))

    def _work(self) -> Iterable[Work]:
        return (self._live(),)

    def _before_close(self) -> None:
        if self._phase is Phase.CONNECTED and self.alive and not self._midway:
            self._write_now(wire.end(self.dialect))
        self._phase = Phase.OVER

    def _finish(self, why: str) -> None:
        self._event(why)
        self._shut()
        self._phase, self._conn = Phase.OVER, None
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
                self._take(*drain(self._conn))
                self._judge_delay(passed_s)
            self._move(min(ticker.passed_s, _MOST_MOVE_S))

    def _judge_end(self, end: str) -> None:
        """Judge an end of the connection ("Links": END is answered, and the link closed)."""
        if self._phase is not Phase.CLOSING and self._reader.rest:
            self._violate(f"the connection ended within a message: {show(self._reader.rest, self.dialect)}")
        if self._phase is Phase.ENDING:
            self._violate("the HQ closed without answering END")
        how = "after END" if self._phase is Phase.CLOSING else "without END"
        self._finish(f"the HQ closed the connection {how}: {end}")

    def _judge_delay(self, passed_s: float) -> None:
        """Judge what is overdue: drive commands, END, the close."""
        if self._phase is Phase.CONNECTED and self.drive:
            if problem := self._repeats.cycle(passed_s, self._commands):
                late = f" (this process woke {self._late_s * 1000:.0f} ms late)"
                self._violate(problem + late * (self._late_s > self._times.cycle_s / 4))
            if self._commands:
                self._late_s = 0.0
        elif self._phase is Phase.ENDING and self._waited_s > self._times.answer_s:
            self._violate(f"no END within {self._times.answer_s:g} s of the vehicle's")
            self._finish("the vehicle closed")
        elif self._phase is Phase.CLOSING and self._waited_s > self._times.close_s:
            self._violate(f"the HQ did not close within {self._times.close_s:g} s of its END")
            self._finish("the vehicle closed")

    # Messages of the HQ

    def _receive(self, message: ParsedAlfMessage) -> None:
        self.received.append((time.monotonic(), message.kind, message.fields))
        raw = show(message.raw, self.dialect)
        if self._phase is Phase.CLOSING:
            return self._violate(f"a message after END: {raw}")
        self._report(message.problem, raw, deadly=message.deadly)
        if message.kind == wire.END:
            self._leave()
        elif self._phase is Phase.CONNECTED:
            self._obey(message)
        elif self._waited_s > self._times.flight_s:
            self._violate(f"a message {self._waited_s:.2f} s after the vehicle's END: {raw}")
        return None

    def _obey(self, message: ParsedAlfMessage) -> None:
        """Take a command; apply the last one again on any message ("Translation of commands")."""
        if message.kind == wire.DRIVE and self._reader.whole(message):
            speed = message.fields[0]
            if self._command is None and speed:
                self._violate(f"the first command has speed {speed}: {show(message.raw, self.dialect)}")
            if self.dialect == "binary" and speed > wire.FULL_PERCENT and message.fields != self._command:
                self._event(f"speed {speed} counts as 100")
            self._command = message.fields
            self._commands += 1
        if self._command is not None:
            self.machine.obey(self.dialect, self._command)
            self._idle_s = 0.0

    def _leave(self) -> None:
        """Take the HQ's END: answer it unless it is an answer, close this side, wait for the other (255)."""
        if self._command is not None and self._command[0]:
            self._event(f"END while the last command had speed {self._command[0]}")
        answer = self._phase is Phase.CONNECTED
        self._phase, self._waited_s = Phase.CLOSING, 0.0
        if self._sending.locked():
            self._start(self._close_later(answer))
        else:
            self._close(answer)

    async def _close_later(self, answer: bool) -> None:
        async with self._sending:
            self._close(answer)

    def _close(self, answer: bool) -> None:
        """Close this side only: what the HQ still sends is to be judged."""
        if answer and self._conn is not None:
            self._write_now(wire.end(self.dialect))
        self._shut(socket.SHUT_WR)

    def _move(self, dt: float) -> None:
        """Move; stop the motor after some time without a command, connected or not ("Translation of commands")."""
        if not self.drive:
            return
        was_idle_s, self._idle_s = self._idle_s, self._idle_s + dt
        if self._command is not None and was_idle_s <= self._times.motor_s < self._idle_s:
            moving = "moving" if self.machine.moving else "at rest"
            self._event(f"{self._times.motor_s:g} s without a command: the motor stopped by itself, {moving}")
            self.machine.stop()
        self.machine.step(dt)

    # Messages of the vehicle

    async def _measure(self) -> None:
        """Send 2 once, then 1 ten times a second."""
        await self._send(wire.INIT)
        await self._repeat(wire.SCAN, Ticker(self._times.scan_s))

    async def _repeat(self, kind: int, ticker: Ticker) -> None:
        while self._phase is Phase.CONNECTED:
            await ticker.tick()
            await self._send(kind)

    def _fields(self, kind: int) -> list[int | float]:
        if kind == wire.INIT:
            return self.machine.geometry()
        if kind == wire.INFO:
            return self.machine.feel(self.dialect)
        stamp_ms = int(1000 * (time.monotonic() - self._booted_s)) % 2**32
        self._sequence += 1
        return [self._sequence - 1, stamp_ms, *self.machine.measure()]

    async def _send(self, kind: int) -> None:
        """Send a message whole, unless the conversation is ending."""
        data = wire.write(self.dialect, kind, self._fields(kind))
        async with self._sending:
            if self._phase is Phase.CONNECTED:
                try:
                    await self._write(data, self._times.send_s)
                except TimeoutError:
                    self._finish(f"the HQ read nothing for {self._times.send_s:g} s")


def fragile_vehicle(dialect: Dialect, *, servers: int, seed: int, times: AlfTimes = _DEPLOYED) -> list[FragileVehicle]:
    """Make the servers of one vehicle: one for everything, or one that drives and one that measures ("Links")."""
    server = partial(FragileVehicle, dialect, seed=seed, times=times)
    drive = server(laser=servers == 1, drive=True)
    made = {"vehicle" if servers == 1 else "drive": drive}
    if servers > 1:
        made["laser"] = server(laser=True, drive=False, machine=drive.machine)
    for name, one in made.items():
        one.note = log_violations(name)
    return list(made.values())
