"""A simulated external controller as fragile as the deployed ones: the judge of a gateway that plays Webots.

It records each violation of what the protocol page ``wc2ec.md`` demands towards external controllers, and dies of what
ends them. It shares no code with the gateway: not its messages, sessions or translation. Section names in the
docstrings are those of that page.
"""

from __future__ import annotations

import asyncio
import math
import socket
import struct
import time
from collections.abc import Callable

import msgspec

from gateways.wc2ec.conformance import parser as wire
from gateways.wc2ec.conformance.parser import (
    CHANGE,
    DISABLE,
    ENABLE,
    LIGHT_TYPE,
    NO_FIELD,
    SET,
    SET_VALUE,
    Dialect,
)
from zbridge.simulation.judge import Ended, Judge, show
from zbridge.simulation.sockets import connected

REGISTER, ERROR = 0, 127
MOTOR_TYPES = (53, 46)
"""Rotational and linear motors; the numbers move with the Webots version."""

_DATA = {"deployed": 1, "draft": 0}
_HEADER, _MEASUREMENT = 3, struct.Struct("<BBBd")
_FIRST_OF_EC = 128
_SPLIT_S = 0.002
_READ_BYTES = 65536


class Told(msgspec.Struct, frozen=True):
    """One message of a Webots controller; ``deadly``: why the external controller ends its task, empty if it does not.

    ``value``: the name of a registration, the float of a measurement.
    """

    command: int
    node_type: int
    number: int
    value: str | float | None
    raw: bytes
    deadly: str = ""


class Reader:
    """Cuts the stream of a Webots controller ("no length, the body follows from command and type")."""

    def __init__(self, dialect: Dialect) -> None:
        """Set up for a dialect."""
        self.rest = b""
        self._dialect: Dialect = dialect
        self._data = _DATA[dialect]
        self._dead = False

    def take(self, data: bytes) -> list[Told]:
        """Read the messages that end in ``data``; nothing can be read after what has no length."""
        told: list[Told] = []
        self.rest += data
        while self.rest and not self._dead:
            if lost := self._lost():
                command, node_type, number = [*self.rest[:_HEADER], NO_FIELD, NO_FIELD][:_HEADER]
                told.append(Told(command, node_type, number, None, self.rest, lost))
                self._dead = True
            elif len(self.rest) < _HEADER or len(self.rest) < self._size():
                break
            else:
                size = self._size()
                raw, self.rest = self.rest[:size], self.rest[size:]
                command, node_type, number = raw[:_HEADER]
                told.append(Told(command, node_type, number, self._value(raw), raw))
        return told

    def _lost(self) -> str:
        """Tell why the framing is lost, empty if it is not ("check the range"; "Dialect ...": the commands)."""
        command = self.rest[0]
        if command >= _FIRST_OF_EC:
            return f"command {command}, which is of the external controller's half"
        if command != self._data and (self._dialect == "draft" or command not in (REGISTER, ERROR)):
            return f"unknown command {command}"
        if self._dialect == "draft" and len(self.rest) > 1 and self.rest[1] != LIGHT_TYPE:
            return f"unknown sensor type {self.rest[1]}"
        return ""

    def _size(self) -> int:
        """Give the size of the message, or as much as must be there to know it."""
        if self.rest[0] == self._data:
            return _MEASUREMENT.size
        if self.rest[0] == ERROR:
            return _HEADER
        return _HEADER + 1 + (self.rest[_HEADER] if len(self.rest) > _HEADER else 0)

    def _value(self, raw: bytes) -> str | float | None:
        if raw[0] == self._data:
            value: float = _MEASUREMENT.unpack(raw)[3]
            return value
        return None if raw[0] == ERROR else raw[_HEADER + 1 :].decode("utf-8", "backslashreplace")


class FragileController(Judge):
    """One start of an external controller: records every violation and dies of the deadly ones."""

    def __init__(
        self,
        *,
        dialect: Dialect = "deployed",
        split: bool = False,
        flight_s: float = 0.5,
        keep: int = 10_000,
        note: Callable[[str], None] | None = None,
    ) -> None:
        """Set up the controller.

        ``split``: it writes a command field by field; ``flight_s``: how long after a disableSensor data may still come;
        ``keep``: most entries of every list; ``note``: called with each violation.
        """
        if dialect not in _DATA:
            raise ValueError(f"no such controller: dialect {dialect!r}")
        super().__init__(keep=keep, note=note)
        self.dialect: Dialect = dialect
        self.received: list[tuple[float, int, int, int, str | float | None]] = []
        """Monotonic seconds, command, sensor type, sensor number, name or value; good or bad."""
        self.connected = asyncio.Event()
        self.ready = asyncio.Event()
        """Set by the first data after the connection: before that it does nothing ("The gateway as Webots ...")."""
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
        self._reader = Reader(dialect)
        self._conn: socket.socket | None = None
        self._sending, self._over = asyncio.Lock(), asyncio.Event()
        self._work: asyncio.Task[None] | None = None

    def __repr__(self) -> str:
        state = "over" if self._over.is_set() else "connected" if self.connected.is_set() else "connecting"
        return f"<FragileController {self.dialect} {state} violations={len(self.violations)} alive={self.alive}>"

    @property
    def motors(self) -> dict[str, int]:
        """Numbers of the registered motors by name."""
        return {name: number for number, (node_type, name) in self.devices.items() if node_type in MOTOR_TYPES}

    async def run(self, host: str, port: int) -> None:
        """Connect once and play until dead, until the controller closed, or until cancelled.

        Raise OSError if nobody listens ("it never retries").
        """
        async with connected(host, port) as conn:
            self._conn = conn
            self.connected.set()
            if self.dialect == "draft":
                self.ready.set()
            try:
                async with asyncio.TaskGroup() as tasks:
                    self._work = tasks.create_task(self._live(conn))
            finally:
                self._conn = None
                self._over.set()
                self.ready.set()

    async def end(self) -> None:
        """Leave, by closing the connection: the protocol has no message for it ("Roles")."""
        if self._work is not None and self._conn is not None:
            self._event("the external controller left")
            self._work.cancel()
            await self._over.wait()

    # Commands; all raise ConnectionError without a connection

    async def set(self, device: str | int, value: float) -> None:
        """Send setValue to a device by name or number ("Dialect `deployed`" 130); KeyError if it is not registered.

        Waits until it is ready: before that a controller does nothing.
        """
        self._only("deployed")
        if self._conn is not None:
            await self.ready.wait()
        names = {name: number for number, (_, name) in self.devices.items()}
        number = names[device] if isinstance(device, str) else device
        await self._send(SET_VALUE, self.devices[number][0], number, [struct.pack("<d", value)])

    async def enable(self, number: int) -> None:
        """Send enableSensor ("Dialect `draft`" 128)."""
        self._only("draft")
        self.enabled.add(number)
        await self._send(ENABLE, LIGHT_TYPE, number, [])

    async def disable(self, number: int) -> None:
        """Send disableSensor ("Dialect `draft`" 129)."""
        self._only("draft")
        await self._send(DISABLE, LIGHT_TYPE, number, [])
        if number in self.enabled:
            self._disabled[number] = time.monotonic()
        self.enabled.discard(number)

    async def change(self, number: int, index: int, value: float) -> None:
        """Send changeSensor, one configuration value ("Dialect `draft`" 130)."""
        self._only("draft")
        await self._send(CHANGE, LIGHT_TYPE, number, [bytes([index]), struct.pack("<d", value)])

    async def configure(self, number: int, values: list[float]) -> None:
        """Send setSensor, all configuration values ("Dialect `draft`" 131)."""
        self._only("draft")
        await self._send(SET, LIGHT_TYPE, number, [struct.pack("<d", value) for value in values])

    def _only(self, dialect: Dialect) -> None:
        if self.dialect != dialect:
            raise ValueError(f"no command of dialect {self.dialect}")

    async def _send(self, command: int, node_type: int, number: int, body: list[bytes]) -> None:
        """Send a command joined or field by field ("Commands arrive split (1+1+1+8 bytes) or joined")."""
        fields = [bytes([command]), bytes([node_type]), bytes([number]), *body]
        async with self._sending:
            for place, part in enumerate(fields if self._split else [b"".join(fields)]):
                if place:
                    await asyncio.sleep(_SPLIT_S)
                if self._conn is None:
                    raise ConnectionError("the external controller is not connected")
                await asyncio.get_running_loop().sock_sendall(self._conn, part)

    # The connection

    async def _live(self, conn: socket.socket) -> None:
        """Read and judge until the connection is over ("EOF ... ends its task silently")."""
        try:
            while data := await self._read(conn):
                for told in self._reader.take(data):
                    self._hear(told)
            if self._reader.rest:
                self._violate(f"the connection ended within a message: {show(self._reader.rest)}")
        except Ended as ended:
            self._event(str(ended))

    async def _read(self, conn: socket.socket) -> bytes:
        how = "EOF"
        try:
            if data := await asyncio.get_running_loop().sock_recv(conn, _READ_BYTES):
                return data
        except OSError as error:
            how = repr(error)
        self._event(f"the controller closed: {how}")
        return b""

    # Messages

    def _hear(self, told: Told) -> None:
        self.received.append((time.monotonic(), told.command, told.node_type, told.number, told.value))
        del self.received[: -self._keep]
        raw = show(told.raw)
        if told.deadly:
            self._die(f"{told.deadly}: {raw}")
        if isinstance(told.value, str):
            self._register(told, told.value, raw)
        elif told.value is None:
            self._event(f"error: {raw}")  # "sent by nobody; harmless"
        else:
            self._measure(told, told.value, raw)

    def _register(self, told: Told, name: str, raw: str) -> None:
        """Take a registration ("Register each name once (a duplicate kills the deployed EC)"; "index (0..254)")."""
        if name in self._names:
            self._die(f"{name!r} registered again: {raw}")
        if told.number in self.devices:
            self._violate(f"number {told.number} registered again, {self.devices[told.number][1]!r} before: {raw}")
        if told.number > wire.MOST_NUMBER:
            self._violate(f"number {told.number} is no device index: {raw}")
        if not name:
            self._violate(f"a device without a name: {raw}")
        if self.counts:
            self._event(f"{name!r} registered after data")
        self._names.add(name)
        self.devices[told.number] = told.node_type, name

    def _measure(self, told: Told, value: float, raw: str) -> None:
        number = told.number
        if self.dialect == "draft":
            self._unasked(number, raw)
        elif number not in self.devices:
            self._violate(f"data of number {number}, which is not registered: {raw}")
        elif self.devices[number][0] != told.node_type:
            node_type, name = self.devices[number]
            self._violate(f"data of type {told.node_type}: {name!r} was registered with type {node_type}: {raw}")
        if not math.isfinite(value):
            self._event(f"{value} measured by number {number}")
        self.ready.set()
        self.values[number] = value
        self.counts[number] = self.counts.get(number, 0) + 1

    def _unasked(self, number: int, raw: str) -> None:
        """Judge data of a sensor that is not enabled ("Dialect `draft`" 128, 129)."""
        disabled_s = time.monotonic() - self._disabled.get(number, -math.inf)
        if number not in self.enabled and disabled_s > self._flight_s:
            self._violate(f"data of sensor {number}, which is not enabled: {raw}")
