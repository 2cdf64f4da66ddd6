"""A simulated Webots controller as fragile as the legacy ones: the judge of a gateway that plays the external one."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Sequence
from typing import NoReturn

from gateways.wc2ec.conformance import parser as wire
from gateways.wc2ec.conformance.machine import JudgedMotor, JudgedWebots
from gateways.wc2ec.conformance.parser import (
    DEFAULT,
    Dialect,
    ExternalReader,
    ParsedWc2EcMessage,
    SimulatedDevice,
    Wc2EcTimes,
)
from zbridge.simulation.fragile import FragileServer
from zbridge.simulation.judge import Chances, Ended, show
from zbridge.simulation.sockets import drain, reset_on_close
from zbridge.simulation.timing import Ticker

_MOST_MOVE_S = 0.1
"""Longest time for which the robot moves in one step, however late it is."""
_DEPLOYED = Wc2EcTimes()


class FragileWebotsController(FragileServer):
    """One start of a simulation: serves one external controller, records every violation, dies of the deadly ones.

    It ends when its external controller leaves ("Links"). ``devices``: default those of ``DEFAULT``; ``values``:
    configuration values of a sensor of the draft. A row of ``received``: monotonic seconds, command, sensor type,
    sensor number, value; of a command that it read, valid or not.
    """

    KEEP = 100_000
    _reader: ExternalReader

    def __init__(
        self,
        dialect: Dialect,
        *,
        devices: Sequence[SimulatedDevice] | None = None,
        seed: int = 1,
        values: int = 3,
        times: Wc2EcTimes = _DEPLOYED,
    ) -> None:
        if dialect not in DEFAULT:
            raise ValueError(f"no such controller: dialect {dialect!r}")
        super().__init__()
        self.dialect: Dialect = dialect
        self.devices = tuple(DEFAULT[dialect] if devices is None else devices)
        wire.check(dialect, self.devices)
        chance = Chances(seed)
        self.robot = JudgedWebots(self.devices, chance["robot"], values)
        self.registered = dialect == "draft"
        """Whether the last registration was sent."""
        self._reader = ExternalReader(dialect, self.devices, values)
        self._times, self._cuts = times, chance["cuts"]
        self._part_s, self._part_noted = 0.0, False

    def _phase_name(self) -> str:
        return "OVER" if self._over.is_set() else "LISTENING" if self._conn is None else "CONNECTED"

    @property
    def motors(self) -> dict[str, JudgedMotor]:
        """The motors by name, as they are now."""
        return self.robot.motors

    @property
    def stuck(self) -> bool:
        """Whether it obeys no more commands, because of a 130 to no motor."""
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
        self._start(self._live())

    async def _live(self) -> None:
        """Register, then read, judge, move and measure in steps, one thing after the other as Webots does."""
        ticker = Ticker(self._times.step_s)
        await self._register()
        while True:
            self._read()
            self._judge_delay(min(ticker.passed_s, self._times.step_s))
            self.robot.step(min(ticker.passed_s, _MOST_MOVE_S))
            await self._send([wire.measurement(self.dialect, *one) for one in self.robot.measure()])
            await ticker.tick()

    async def _register(self) -> None:
        """Register all devices, the last one after ``register_s`` ("Handshake"); a command before it is too early."""
        if self.registered:
            return
        registrations = [wire.registration(device) for device in self.devices]
        await self._send(registrations[:-1])
        await asyncio.sleep(self._times.register_s)
        self._read()
        await self._send(registrations[-1:])
        self.registered = True

    async def _send(self, messages: list[bytes]) -> None:
        """Send messages, joined and split as the seed says."""
        if self._broken or not messages:
            return
        try:
            async with asyncio.timeout(self._times.send_s):
                for piece in wire.pieces(b"".join(messages), self._cuts):
                    await self._write(piece)
        except TimeoutError:
            raise Ended(f"the external controller read nothing for {self._times.send_s:g} s") from None

    # Commands

    def _read(self) -> None:
        """Take all that came since the last step as one read, and the end of the connection."""
        data, end = drain(self._tcp)
        if data:
            self._part_s, self._part_noted = 0.0, False
        self._take(data, self._broken or end)

    def _judge_end(self, end: str) -> NoReturn:
        """Judge an end of the connection, and exit ("Links": it exits after a disconnect)."""
        if self._reader.rest:
            self._violate(f"the connection ended within a command: {show(self._reader.rest)}")
        moving = "moving" if self.robot.moving else "at rest"
        raise Ended(f"the external controller left the robot {moving}: {end}")

    def _judge_delay(self, passed_s: float) -> None:
        """Judge a part of a command that nothing follows."""
        self._part_s += passed_s
        if self._reader.rest and self._part_s > self._times.part_s and not self._part_noted:
            self._part_noted = True
            self._violate(f"part of a command, and no more for {self._part_s:.2f} s: {show(self._reader.rest)}")

    def _receive(self, message: ParsedWc2EcMessage) -> None:
        self.received.append((time.monotonic(), message.command, message.node_type, message.number, message.value))
        raw = show(message.raw)
        if not self.registered and not message.deadly:
            self._violate(f"a command before the last registration: {raw}")
        if self._report(message.problem, raw, deadly=message.deadly):
            return
        if self.dialect == "deployed":
            self.robot.set_motor(message)
        elif needless := self.robot.set_sensor(message):
            self._event(needless)
