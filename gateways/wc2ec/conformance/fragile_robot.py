"""A simulated Webots controller as fragile as the deployed ones: the judge of a gateway that plays the external one.

It records each violation of what the protocol page ``wc2ec.md`` demands towards Webots, and dies of what kills it. It
shares no code with the gateway: not its messages, sessions or translation. Section names in the docstrings are those
of that page.
"""

from __future__ import annotations

import asyncio
import logging
import random
import socket
import time
from collections.abc import Callable, Sequence
from typing import NoReturn

from gateways.wc2ec.conformance import parser as wire
from gateways.wc2ec.conformance.machine import Motor, Robot
from gateways.wc2ec.conformance.parser import DEFAULT, Device, Dialect, Heard, Reader, Times, Value
from zbridge.simulation.fragile import FragileServer, log_violations, print_line
from zbridge.simulation.judge import Ended, show
from zbridge.simulation.sockets import drain, reset_on_close
from zbridge.simulation.ticker import Ticker

_MOST_MOVE_S = 0.1
"""Longest time for which the robot moves in one step, however late it is."""
_VALUES = 3
_log = logging.getLogger(__name__)


_DEPLOYED = Times()


class FragileController(FragileServer):
    """One start of a simulation: serves one external controller, records every violation, dies of the deadly ones.

    It ends when its external controller leaves ("Roles").
    """

    def __init__(
        self,
        dialect: Dialect,
        *,
        devices: Sequence[Device] | None = None,
        seed: int = 1,
        values: int = _VALUES,
        times: Times = _DEPLOYED,
        keep: int = 100_000,
        note: Callable[[str], None] | None = None,
    ) -> None:
        """Set up the controller.

        ``devices``: default those of ``DEFAULT``; ``values``: configuration values of a sensor of the draft; ``keep``:
        most entries of every list; ``note``: called with each violation.
        """
        if dialect not in DEFAULT:
            raise ValueError(f"no such controller: dialect {dialect!r}")
        super().__init__(keep=keep, note=note)
        self.dialect: Dialect = dialect
        self.devices = tuple(DEFAULT[dialect] if devices is None else devices)
        wire.check(dialect, self.devices)
        self.received: list[tuple[float, int, int, int, Value]] = []
        """Monotonic seconds, command, sensor type, sensor number, value; good or bad, if the controller took it."""
        self.robot = Robot(self.devices, random.Random(f"{seed} robot"), values)
        self.registered = dialect == "draft"
        """Whether the last registration was sent."""
        self._reader = Reader(dialect, self.devices, values)
        self._cuts = random.Random(f"{seed} cuts")
        self._times = times
        self._conn: socket.socket | None = None
        self._broken: OSError | None = None
        self._part_s, self._part_noted = 0.0, False

    def __repr__(self) -> str:
        phase = self._phase_name()
        return f"<FragileController {self.dialect} {phase} violations={len(self.violations)} alive={self.alive}>"

    @property
    def motors(self) -> dict[str, Motor]:
        """The motors by name, as they are now."""
        return self.robot.motors

    @property
    def stuck(self) -> bool:
        """Whether it takes no command any more, because of a 130 to no motor."""
        return self._reader.blocked

    async def cut(self) -> None:
        """Reset the connection and end, as a simulation that is killed would."""
        if self._conn is None or self._over.is_set():
            return
        reset_on_close(self._conn)
        self._event("the controller cut the connection")
        self._stop()
        await self._over.wait()

    # The connection

    def _begin(self, conn: socket.socket) -> None:
        self._conn = conn
        self._start(self._live(conn))

    def _phase_name(self) -> str:
        return "over" if self._over.is_set() else "listening" if self._conn is None else "connected"

    async def _live(self, conn: socket.socket) -> None:
        """Register, then read, judge, move and measure in steps, one thing after the other as Webots does."""
        ticker = Ticker(self._times.step_s)
        await self._register(conn)
        while True:
            self._listen(conn)
            self._wait(min(ticker.passed_s, self._times.step_s))
            self.robot.step(min(ticker.passed_s, _MOST_MOVE_S))
            measured = self.robot.measure()
            await self._send(conn, [wire.measurement(self.dialect, *one) for one in measured])
            await ticker.tick()

    async def _register(self, conn: socket.socket) -> None:
        """Register all devices, the last one after ``register_s`` ("Sequence"); a command before it is too early."""
        if self.registered:
            return
        registrations = [wire.registration(device) for device in self.devices]
        await self._send(conn, registrations[:-1])
        await asyncio.sleep(self._times.register_s)
        self._listen(conn)
        await self._send(conn, registrations[-1:])
        self.registered = True

    async def _send(self, conn: socket.socket, messages: list[bytes]) -> None:
        """Send messages, joined and split as the seed says."""
        if self._broken or not messages:
            return
        try:
            async with asyncio.timeout(self._times.send_s):
                for piece in wire.pieces(b"".join(messages), self._cuts):
                    await asyncio.get_running_loop().sock_sendall(conn, piece)
        except TimeoutError:
            raise Ended(f"the external controller read nothing for {self._times.send_s:g} s") from None
        except OSError as error:
            self._broken = error  # reported once: the next read takes what is left, and sees an end

    # Commands

    def _listen(self, conn: socket.socket) -> None:
        """Take all that came since the last step as one read, and the end of the connection."""
        data, end = drain(conn)
        if data:
            self._part_s, self._part_noted = 0.0, False
        for heard in self._reader.take(data):
            self._hear(heard)
        if end or self._broken:
            self._part(repr(self._broken) if self._broken else end)

    def _part(self, end: str) -> NoReturn:
        """Judge an end of the connection, and exit ("Roles": it exits when that one disconnects)."""
        if self._reader.rest:
            self._violate(f"the connection ended within a command: {show(self._reader.rest)}")
        moving = "moving" if self.robot.moving else "at rest"
        raise Ended(f"the external controller left the robot {moving}: {end}")

    def _wait(self, passed_s: float) -> None:
        """Judge a part of a command that nothing follows."""
        self._part_s += passed_s
        if self._reader.rest and self._part_s > self._times.part_s and not self._part_noted:
            self._part_noted = True
            self._violate(f"part of a command, and no more for {self._part_s:.2f} s: {show(self._reader.rest)}")

    def _hear(self, heard: Heard) -> None:
        self.received.append((time.monotonic(), heard.command, heard.node_type, heard.number, heard.value))
        del self.received[: -self._keep]
        raw = show(heard.raw)
        if heard.deadly:
            self._die(f"{heard.problem}: {raw}")
        if not self.registered:
            self._violate(f"a command before the last registration: {raw}")
        if heard.problem:
            self._violate(f"{heard.problem}: {raw}")
        elif self.dialect == "deployed":
            self.robot.set_motor(heard)
        elif needless := self.robot.set_sensor(heard):
            self._event(needless)


async def simulate_fragile(
    host: str,
    port: int,
    *,
    dialect: Dialect,
    seed: int,
    ready: Callable[[int], None],
    devices: Sequence[Device] | None = None,
    times: Times = _DEPLOYED,
) -> None:
    """Run a fragile controller until its external controller left, dead or cancelled; log each violation.

    It prints why it ended, if it was not cancelled. ``ready`` is called with the port once it listens.
    """
    note = log_violations(_log)
    controller = FragileController(dialect, devices=devices, seed=seed, times=times, note=note)
    await controller.serve(host, port, ready)
    print_line(controller.ending)
