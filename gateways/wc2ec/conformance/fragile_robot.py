"""A simulated Webots controller as fragile as the deployed ones: the judge of a gateway that plays the external one.

It notes each thing the protocol page ``wc2ec.md`` forbids towards Webots, and dies of what kills it. By intention it
shares no code with the gateway: not its messages, sessions or translation. Section names in the docstrings are those
of that page.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import socket
import struct
import sys
import time
from collections.abc import Callable, Sequence
from typing import NoReturn

from gateways.wc2ec.conformance import parser as wire
from gateways.wc2ec.conformance.parser import DEFAULT, Device, Dialect, Heard, Motor, Reader, Robot, Times, Value, show
from zbridge.simulation.judge import Judge

_READ_BYTES = 65536
_READS = 16
_FROZEN_KEPT = 16
_MOST_MOVE_S = 0.1
_VALUES = 3
_log = logging.getLogger(__name__)


class _Gone(Exception):
    """The controller's process has ended, and why."""


_DEPLOYED = Times()


class FragileController(Judge):
    """One start of a simulation: serves one external controller, notes every violation and dies of the deadly ones."""

    _DEATH = _Gone

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

        ``devices``: else those of ``DEFAULT``; ``values``: configuration values of a sensor of the draft; ``keep``:
        bound of every list; ``note``: called with each violation.
        """
        if dialect not in DEFAULT:
            raise ValueError(f"no such controller: dialect {dialect!r}")
        super().__init__(keep=keep, note=note)
        self.dialect: Dialect = dialect
        self.devices = tuple(DEFAULT[dialect] if devices is None else devices)
        wire.check(dialect, self.devices)
        self.received: list[tuple[float, int, int, int, Value]] = []
        """Monotonic seconds, command, sensor type, sensor number, value; good or bad, if the controller took it."""
        self.ending = ""
        """Why it ended by itself."""
        self.robot = Robot(self.devices, random.Random(f"{seed} robot"), values)
        self.registered = dialect == "draft"
        """Whether the last registration was sent."""
        self._reader = Reader(dialect, self.devices, values)
        self._cuts = random.Random(f"{seed} cuts")
        self._times = times
        self._conn: socket.socket | None = None
        self._broken: OSError | None = None
        self._work: asyncio.Task[None] | None = None
        self._over = asyncio.Event()
        self._part_s, self._part_noted = 0.0, False

    def __repr__(self) -> str:
        state = "over" if self._over.is_set() else "listening" if self._conn is None else "standing"
        return f"<FragileController {self.dialect} {state} violations={len(self.violations)} alive={self.alive}>"

    @property
    def motors(self) -> dict[str, Motor]:
        """The motors by name, as they are now."""
        return self.robot.motors

    @property
    def stuck(self) -> bool:
        """Whether it takes no command any more, because of a 130 to no motor."""
        return self._reader.blocked

    async def serve(self, host: str, port: int, ready: Callable[[int], None]) -> None:
        """Serve on ``port`` (0: any, told to ``ready``) until the external controller left, or dead or cancelled."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        loop = asyncio.get_running_loop()
        try:
            with contextlib.ExitStack() as sockets:
                server = sockets.enter_context(socket.create_server((host, port), family=family))
                server.setblocking(False)
                ready(server.getsockname()[1])
                conn, _ = await loop.sock_accept(server)
                self._conn = sockets.enter_context(conn)
                conn.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                async with asyncio.TaskGroup() as tasks:
                    others = tasks.create_task(self._freeze(server, sockets))
                    self._work = tasks.create_task(self._live(conn))
                    self._work.add_done_callback(lambda _: others.cancel())
        finally:
            self._over.set()

    async def cut(self) -> None:
        """Break the connection without a word and end, as a simulation that is killed would."""
        if self._conn is None or self._work is None or self._work.done():
            return
        self._conn.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._event("the controller cut the connection")
        self._work.cancel()
        await self._over.wait()

    # The connection

    async def _freeze(self, server: socket.socket, sockets: contextlib.ExitStack) -> None:
        """Take all other connections and say nothing ("one external controller each")."""
        frozen: list[socket.socket] = []
        while True:
            conn, peer = await asyncio.get_running_loop().sock_accept(server)
            self._event(f"second connection, from {peer[0]}:{peer[1]}")
            frozen.append(sockets.enter_context(conn))
            for old in frozen[:-_FROZEN_KEPT]:
                old.close()
            del frozen[:-_FROZEN_KEPT]

    async def _live(self, conn: socket.socket) -> None:
        """Register, then read, judge, move and measure in steps, one thing after the other as Webots does."""
        due = last = time.monotonic()
        try:
            await self._register(conn)
            while True:
                now = time.monotonic()
                self._listen(conn)
                self._wait(min(now - last, self._times.step_s))
                self.robot.step(min(now - last, _MOST_MOVE_S))
                last = now
                measured = self.robot.measure()
                await self._send(conn, [wire.measurement(self.dialect, *one) for one in measured])
                due = max(due + self._times.step_s, time.monotonic())
                await asyncio.sleep(due - time.monotonic())
        except _Gone as gone:
            self.ending = str(gone)
            self._event(self.ending)

    async def _register(self, conn: socket.socket) -> None:
        """Register all devices, the last one after a while ("Sequence"); what came before it came too early."""
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
            raise _Gone(f"the external controller read nothing for {self._times.send_s:g} s") from None
        except OSError as error:
            self._broken = error  # the kernel tells once: the next read takes what is left, and sees an end

    # Commands

    def _listen(self, conn: socket.socket) -> None:
        """Take all that came since the last step as one read, and how it ended if it did."""
        data, end = _drain(conn)
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
        raise _Gone(f"the external controller left the robot {moving}: {end}")

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

    It prints why it ended, if it was not cancelled. ``ready`` is told the port once it is listened on.
    """

    def note(text: str) -> None:
        _log.error("violation: %s", text)

    controller = FragileController(dialect, devices=devices, seed=seed, times=times, note=note)
    await controller.serve(host, port, ready)
    sys.stdout.write(f"{controller.ending}\n")
    sys.stdout.flush()


def _drain(conn: socket.socket) -> tuple[bytes, str]:
    """Read what there is; how the connection ended, empty if it stands."""
    data = b""
    for _ in range(_READS):
        try:
            part = conn.recv(_READ_BYTES)
        except BlockingIOError:
            break
        except OSError as error:
            return data, repr(error)
        if not part:
            return data, "closed"
        data += part
    return data, ""
