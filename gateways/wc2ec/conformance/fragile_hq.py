"""A simulated external controller as fragile as the legacy ones: the judge of a gateway that plays Webots."""

from __future__ import annotations

import asyncio
import math
import struct
import time
from collections.abc import Iterable
from typing import NoReturn

from gateways.wc2ec.conformance import parser as wire
from gateways.wc2ec.conformance.parser import ControllerReader, Dialect, ParsedWc2EcMessage
from zbridge.simulation.fragile import Work
from zbridge.simulation.hq_program import HqProgram
from zbridge.simulation.judge import Ended, show

MOTOR_TYPES = (53, 46)
"""Rotational and linear motors; the numbers move with the Webots version."""
WHEEL_RAD_S = 10.0
"""Velocity of a wheel at full scale: what listeners and configurations here take as such."""
_SPLIT_S = 0.002


class FragileExternalController(HqProgram):
    """One start of an external controller: records every violation and dies of the deadly ones.

    ``split``: it writes a command field by field; ``flight_s``: how long after a disableSensor data may still come. A
    row of ``received``: monotonic seconds, command, sensor type, sensor number, name or value.
    """

    def __init__(
        self,
        *,
        dialect: Dialect = "deployed",
        split: bool = False,
        flight_s: float = 0.5,
    ) -> None:
        if dialect not in wire.DATA:
            raise ValueError(f"no such controller: dialect {dialect!r}")
        super().__init__()
        self.dialect: Dialect = dialect
        self.ready = asyncio.Event()
        """Set by the first data; before that it does nothing ("What crashes a peer" in ``fragile-robots.md``)."""
        self.devices: dict[int, tuple[int, str]] = {}
        """Type and name of what was registered, by number."""
        self.values: dict[int, float] = {}
        """The last value by number; also of sensors that were neither registered nor enabled."""
        self.counts: dict[int, int] = {}
        """How many values came, by number."""
        self.enabled: set[int] = set()
        """Numbers of the sensors that are enabled, in the draft."""
        self._names: set[str] = set()
        self._disabled: dict[int, float] = {}
        self._split, self._flight_s = split, flight_s
        self._reader = ControllerReader(dialect)

    def _phase_name(self) -> str:
        return "OVER" if self._over.is_set() else "CONNECTING" if self._conn is None else "CONNECTED"

    @property
    def motors(self) -> dict[str, int]:
        """Numbers of the registered motors by name."""
        return {name: number for number, (node_type, name) in self.devices.items() if node_type in MOTOR_TYPES}

    @property
    def agreed(self) -> str:
        ready = self.connected.is_set() and self.ready.is_set()
        return f"connected: {len(self.devices)} devices, wheels {self._wheels or 'none'}" if ready else ""

    @property
    def _wheels(self) -> dict[str, str]:
        """Names of the wheels by their side."""
        names = {side: next((name for name in self.motors if side in name), "") for side in ("left", "right")}
        return names if all(names.values()) else {}

    def shown(self) -> str:
        return f"{sum(self.counts.values())} values of {len(self.counts)} devices"

    async def neutral(self) -> None:
        await self.push(0.0, 0.0)

    async def push(self, forward: float, turn: float) -> None:
        """Set both wheels, those of two motors whose names say left and right, once ("Towards HQ programs")."""
        for side, sign in (("left", -1.0), ("right", 1.0)):
            if side in self._wheels:
                await self.set(self._wheels[side], WHEEL_RAD_S * max(-1.0, min(1.0, forward + sign * turn)))

    async def end(self) -> None:
        """Leave, by closing the connection: the protocol has no message for it ("Versions and dialects")."""
        if self._conn is not None:
            self._event("the external controller left")
            self._stop()
            await self._over.wait()

    # Commands; all raise ConnectionError without a connection

    async def set(self, device: str | int, value: float) -> None:
        """Send setValue to a device by name or number ("Versions and dialects", 130); KeyError if it is not registered.

        Waits until it is ready: before that a controller does nothing.
        """
        self._only("deployed")
        if self._conn is not None:
            await self.ready.wait()
        names = {name: number for number, (_, name) in self.devices.items()}
        number = names[device] if isinstance(device, str) else device
        await self._send(wire.SET_VALUE, self.devices[number][0], number, [struct.pack("<d", value)])

    async def enable(self, number: int) -> None:
        """Send enableSensor ("Versions and dialects", 128)."""
        self._only("draft")
        self.enabled.add(number)
        await self._send(wire.ENABLE, wire.LIGHT_TYPE, number, [])

    async def disable(self, number: int) -> None:
        """Send disableSensor ("Versions and dialects", 129)."""
        self._only("draft")
        await self._send(wire.DISABLE, wire.LIGHT_TYPE, number, [])
        if number in self.enabled:
            self._disabled[number] = time.monotonic()
        self.enabled.discard(number)

    async def change(self, number: int, index: int, value: float) -> None:
        """Send changeSensor, one configuration value ("Versions and dialects", 130)."""
        self._only("draft")
        await self._send(wire.CHANGE, wire.LIGHT_TYPE, number, [bytes([index]), struct.pack("<d", value)])

    async def configure(self, number: int, values: list[float]) -> None:
        """Send setSensor, all configuration values ("Versions and dialects", 131)."""
        self._only("draft")
        await self._send(wire.SET, wire.LIGHT_TYPE, number, [struct.pack("<d", value) for value in values])

    def _only(self, dialect: Dialect) -> None:
        if self.dialect != dialect:
            raise ValueError(f"no command of dialect {self.dialect}")

    async def _send(self, command: int, node_type: int, number: int, body: list[bytes]) -> None:
        """Send a command joined or field by field ("Versions and dialects": three bytes and a body)."""
        fields = [bytes([command]), bytes([node_type]), bytes([number]), *body]
        async with self._sending:
            for place, part in enumerate(fields if self._split else [b"".join(fields)]):
                if place:
                    await asyncio.sleep(_SPLIT_S)
                if self._conn is None:
                    raise ConnectionError("the external controller is not connected")
                await asyncio.get_running_loop().sock_sendall(self._conn, part)

    # The connection

    def _work(self) -> Iterable[Work]:
        if self.dialect == "draft":
            self.ready.set()
        return (self._live(),)

    def _before_close(self) -> None:
        self.ready.set()

    async def _live(self) -> None:
        """Read and judge until the connection is over."""
        while True:
            await self._read()

    def _judge_end(self, end: str) -> NoReturn:
        if self._reader.rest:
            self._violate(f"the connection ended within a message: {show(self._reader.rest)}")
        raise Ended(f"the controller closed: {end}")

    # Messages

    def _receive(self, message: ParsedWc2EcMessage) -> None:
        value, raw = message.value, show(message.raw)
        self.received.append((time.monotonic(), message.command, message.node_type, message.number, value))
        self._report(message.problem, raw, deadly=message.deadly)
        if isinstance(value, str):
            self._register(message, value, raw)
        elif isinstance(value, float):
            self._measure(message, value, raw)
        else:
            self._event(f"error: {raw}")  # harmless, and sent by nobody

    def _register(self, message: ParsedWc2EcMessage, name: str, raw: str) -> None:
        """Take a registration ("Towards HQ programs": each name once; "Limits": 255 numbers)."""
        number = message.number
        if name in self._names:
            self._die(f"{name!r} registered again: {raw}")
        if number in self.devices:
            self._violate(f"number {number} registered again, {self.devices[number][1]!r} before: {raw}")
        if number > wire.MOST_NUMBER:
            self._violate(f"number {number} is no device index: {raw}")
        if not name:
            self._violate(f"a device without a name: {raw}")
        if self.counts:
            self._event(f"{name!r} registered after data")
        self._names.add(name)
        self.devices[number] = message.node_type, name

    def _measure(self, message: ParsedWc2EcMessage, value: float, raw: str) -> None:
        number = message.number
        if self.dialect == "draft":  # 128, 129
            disabled_s = time.monotonic() - self._disabled.get(number, -math.inf)
            if number not in self.enabled and disabled_s > self._flight_s:
                self._violate(f"data of sensor {number}, which is not enabled: {raw}")
        elif number not in self.devices:
            self._violate(f"data of number {number}, which is not registered: {raw}")
        elif self.devices[number][0] != message.node_type:
            node_type, name = self.devices[number]
            self._violate(f"data of type {message.node_type}: {name!r} was registered with type {node_type}: {raw}")
        if not math.isfinite(value):
            self._event(f"{value} measured by number {number}")
        self.ready.set()
        self.values[number] = value
        self.counts[number] = self.counts.get(number, 0) + 1
