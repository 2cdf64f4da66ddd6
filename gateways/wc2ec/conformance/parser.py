"""The messages of both judges, sans-IO: streams cut into commands, commands judged, messages written.

Shares no code with the gateway's messages, so that an error there cannot hide here.
Section names in the docstrings are those of the protocol page ``wc2ec.md``.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Collection
from random import Random
from typing import Literal

import msgspec

Dialect = Literal["deployed", "draft"]
Value = float | tuple[float, ...] | None
"""What a command carries: ``setValue`` its float, ``changeSensor`` which and what, ``setSensor`` all."""

ENABLE, DISABLE, CHANGE, SET = 128, 129, 130, 131
SET_VALUE = 130
"""The only command of ``deployed``; the draft has the same number for ``changeSensor``."""
LIGHT_TYPE = 0
MOST_NUMBER = 254
NO_FIELD = -1
"""Stands for a header field that was not there yet when the command was judged."""

_FIRST_OF_EC, _HEADER, _NAME_BYTES = 128, 3, 255
_COMMANDS = {"deployed": (SET_VALUE,), "draft": (ENABLE, DISABLE, CHANGE, SET)}


class Kind(enum.Enum):
    """What a device is for the deployed controller, whatever its Webots node type ("the numbers move")."""

    DISTANCE = enum.auto()
    LIGHT = enum.auto()
    ROTATIONAL = enum.auto()
    LINEAR = enum.auto()
    OTHER = enum.auto()


class Device(msgspec.Struct, frozen=True):
    """One device of the robot; ``reading`` is what it always measures, None if the world is to say."""

    name: str
    number: int
    node_type: int
    kind: Kind
    reading: float | None = None

    @property
    def motor(self) -> bool:
        """Whether 130 may be sent to it."""
        return self.kind in (Kind.ROTATIONAL, Kind.LINEAR)


DEFAULT: dict[Dialect, tuple[Device, ...]] = {
    "deployed": (
        *(Device(f"ds{number}", number, 37, Kind.DISTANCE) for number in range(8)),
        Device("left wheel motor", 8, 53, Kind.ROTATIONAL),
        Device("right wheel motor", 9, 53, Kind.ROTATIONAL),
        Device("lift", 10, 46, Kind.LINEAR),
    ),
    "draft": tuple(Device(f"light{number}", number, LIGHT_TYPE, Kind.LIGHT) for number in range(4)),
}


class Times(msgspec.Struct, frozen=True, kw_only=True):
    """The controller's times in seconds, and how patient the judge is."""

    step_s: float = 0.02
    """From one read, and one round of data, to the next."""
    register_s: float = 0.02
    """From the connection to the last registration."""
    part_s: float = 1.0
    """Longest time from a part of a command to more of it, by a clock that stands still while this process is late."""
    send_s: float = 5.0
    """Longest time one round of data may take to send."""


class Heard(msgspec.Struct, frozen=True):
    """One command: header and value, what is wrong with it, and whether it kills or blocks the controller."""

    command: int
    node_type: int
    number: int
    value: Value
    raw: bytes
    problem: str = ""
    deadly: bool = False
    blocks: bool = False


def check(dialect: Dialect, devices: Collection[Device]) -> None:
    """Refuse devices that a controller cannot have with ValueError ("Dialect ...", "Register each name once")."""
    for device in devices:
        if not 0 <= device.number <= MOST_NUMBER or not 0 <= device.node_type <= 255:
            raise ValueError(f"{device!r}: number or type out of range")
        if len(device.name.encode()) > _NAME_BYTES:
            raise ValueError(f"a name of {len(device.name.encode())} bytes")
        if dialect == "draft" and (device.kind is not Kind.LIGHT or device.node_type != LIGHT_TYPE):
            raise ValueError(f"{device!r}: the draft has light sensors only")
    if len({device.number for device in devices}) < len(devices) or len({one.name for one in devices}) < len(devices):
        raise ValueError("two devices with one name or number")


class Reader:
    """Cuts and judges the stream of an external controller, one read at a time.

    What it cannot frame it throws away with the rest of the read. ``blocked``: a 130 went to no motor, and "every later
    command is stuck".
    """

    def __init__(self, dialect: Dialect, devices: Collection[Device], values: int) -> None:
        """Set up; ``values``: how many configuration values a sensor of the draft has."""
        self.rest = b""
        self.blocked = self.dead = False
        self._dialect, self._values = dialect, values
        self._devices = {device.number: device for device in devices}

    def take(self, data: bytes) -> list[Heard]:
        """Read the commands that end in ``data``, which is one read of the controller."""
        heard: list[Heard] = []
        self.rest += data
        while self.rest and not self.blocked and not self.dead:
            lost = self._lost()
            if lost:
                command, node_type, number = [*self.rest[:_HEADER], NO_FIELD, NO_FIELD][:_HEADER]
                self.dead = bool(heard)
                problem = lost + ", after a valid one in the same read: it loops for ever" * self.dead
                heard.append(Heard(command, node_type, number, None, self.rest, problem, self.dead))
                self.rest = b""
            elif len(self.rest) < _HEADER or len(self.rest) < self._size():
                break
            else:
                size = self._size()
                raw, self.rest = self.rest[:size], self.rest[size:]
                heard.append(self._judge(raw))
                self.blocked = heard[-1].blocks
        if self.blocked or self.dead:
            self.rest = b""
        return heard

    def _lost(self) -> str:
        """Tell why the framing is lost, empty if it is not ("check the range"; "no length")."""
        command = self.rest[0]
        if command < _FIRST_OF_EC:
            return f"command {command}, which is of the controller's half"
        if command not in _COMMANDS[self._dialect]:
            return f"unknown command {command}"
        if self._dialect == "draft" and len(self.rest) > 1 and self.rest[1] != LIGHT_TYPE:
            return f"unknown sensor type {self.rest[1]}"
        return ""

    def _size(self) -> int:
        if self._dialect == "deployed":
            return _HEADER + 8
        return _HEADER + {ENABLE: 0, DISABLE: 0, CHANGE: 9, SET: 8 * self._values}[self.rest[0]]

    def _judge(self, raw: bytes) -> Heard:
        return self._deployed(raw) if self._dialect == "deployed" else self._draft(raw)

    def _deployed(self, raw: bytes) -> Heard:
        """Judge a setValue ("send 130 only to registered motors"; "NaN and infinities")."""
        command, node_type, number, value = struct.unpack("<BBBd", raw)
        device = self._devices.get(number)
        problem = ""
        if device is None:
            problem = f"130 to number {number}, which is not registered"
        elif not device.motor:
            problem = f"130 to {device.name!r}, which is no motor"
        elif device.node_type != node_type:
            problem = f"130 to type {node_type} number {number}: {device.name!r} is of type {device.node_type}"
        if problem:
            problem += ": every later command is stuck"
            return Heard(command, node_type, number, value, raw, problem, blocks=True)
        assert device is not None
        problem = "" if math.isfinite(value) else f"{value} to motor {device.name!r}"
        return Heard(command, node_type, number, value, raw, problem)

    def _draft(self, raw: bytes) -> Heard:
        command, node_type, number = raw[:_HEADER]
        value: Value = None
        floats: tuple[float, ...] = ()
        problem = ""
        if command == CHANGE:
            index, changed = struct.unpack("<Bd", raw[_HEADER:])
            floats, value = (changed,), (index, changed)
            if index >= self._values:
                problem = f"value {index} of {self._values}"
        elif command == SET:
            floats = value = struct.unpack(f"<{self._values}d", raw[_HEADER:])
        if number not in self._devices:
            problem = f"command {command} to light sensor {number}, which is not there"
        elif not all(map(math.isfinite, floats)):
            problem = f"a configuration value that is no number, {floats}"
        return Heard(command, node_type, number, value, raw, problem)


def registration(device: Device) -> bytes:
    """Write a registration ("Dialect `deployed`" 0)."""
    name = device.name.encode()
    return struct.pack("<BBBB", 0, device.node_type, device.number, len(name)) + name


def measurement(dialect: Dialect, device: Device, value: float) -> bytes:
    """Write sensorData ("Dialect `deployed`" 1, "Dialect `draft`" 0)."""
    return struct.pack("<BBBd", 1 if dialect == "deployed" else 0, device.node_type, device.number, value)


def pieces(data: bytes, random: Random, most: int = 3) -> list[bytes]:
    """Cut what is sent together anywhere: a message may be split over segments, or share one."""
    cuts = sorted(random.randrange(len(data) + 1) for _ in range(random.randrange(most)))
    parts = [data[start:end] for start, end in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    return [part for part in parts if part]
