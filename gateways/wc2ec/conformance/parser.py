"""The messages of both judges, sans-IO: streams cut into messages, commands judged, messages written."""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Collection
from random import Random
from typing import Literal

import msgspec

from zbridge.simulation.judge import MessageReader

Dialect = Literal["deployed", "draft"]
Value = str | float | tuple[float, ...] | None
"""What a message carries: the name of a registration, the float of a measurement or of ``setValue``, of
``changeSensor`` which value and its float, of ``setSensor`` all.
"""

ENABLE, DISABLE, CHANGE, SET = 128, 129, 130, 131
SET_VALUE = 130
"""The only command of ``deployed``; the draft has the same number for ``changeSensor``."""
REGISTER, ERROR = 0, 127
DATA = {"deployed": 1, "draft": 0}
"""The command of a measurement."""
LIGHT_TYPE = 0
MOST_NUMBER = 254
NO_FIELD = -1
"""Stands for a header field that was not there yet when the command was judged."""

_FIRST_OF_EC, _NAME_BYTES = 128, 255
_HEADER, _FLOAT = 3, struct.Struct("<BBBd")
_COMMANDS = {"deployed": (SET_VALUE,), "draft": (ENABLE, DISABLE, CHANGE, SET)}


class DeviceKind(enum.Enum):
    """What a device is for the legacy controller, whatever its type byte ("Decisions where the document is silent")."""

    DISTANCE = enum.auto()
    LIGHT = enum.auto()
    ROTATIONAL = enum.auto()
    LINEAR = enum.auto()
    OTHER = enum.auto()


class SimulatedDevice(msgspec.Struct, frozen=True):
    """One device of the robot."""

    name: str
    number: int
    node_type: int
    kind: DeviceKind

    @property
    def motor(self) -> bool:
        """Whether 130 may be sent to it."""
        return self.kind in (DeviceKind.ROTATIONAL, DeviceKind.LINEAR)


DEFAULT: dict[Dialect, tuple[SimulatedDevice, ...]] = {
    "deployed": (
        *(SimulatedDevice(f"ds{number}", number, 37, DeviceKind.DISTANCE) for number in range(8)),
        SimulatedDevice("left wheel motor", 8, 53, DeviceKind.ROTATIONAL),
        SimulatedDevice("right wheel motor", 9, 53, DeviceKind.ROTATIONAL),
        SimulatedDevice("lift", 10, 46, DeviceKind.LINEAR),
    ),
    "draft": tuple(SimulatedDevice(f"light{number}", number, LIGHT_TYPE, DeviceKind.LIGHT) for number in range(4)),
}


class Wc2EcTimes(msgspec.Struct, frozen=True, kw_only=True):
    """The controller's times in seconds, and how patient the judge is."""

    step_s: float = 0.02
    """From one read, and one round of data, to the next."""
    register_s: float = 0.02
    """From the connection to the last registration."""
    part_s: float = 1.0
    """Longest time from a part of a command to more of it, by a clock that stands still while this process is late."""
    send_s: float = 5.0
    """Longest time one round of data may take to send."""


class ParsedWc2EcMessage(msgspec.Struct, frozen=True):
    """One message: header and value, what is wrong with it, and whether it kills the judge."""

    command: int
    node_type: int
    number: int
    value: Value
    raw: bytes
    problem: str = ""
    deadly: bool = False


def check(dialect: Dialect, devices: Collection[SimulatedDevice]) -> None:
    """Refuse devices that a controller cannot have with ValueError ("Versions and dialects", "Towards HQ programs")."""
    for device in devices:
        if not 0 <= device.number <= MOST_NUMBER or not 0 <= device.node_type <= 255:
            raise ValueError(f"{device!r}: number or type out of range")
        if len(device.name.encode()) > _NAME_BYTES:
            raise ValueError(f"a name of {len(device.name.encode())} bytes")
        if dialect == "draft" and (device.kind is not DeviceKind.LIGHT or device.node_type != LIGHT_TYPE):
            raise ValueError(f"{device!r}: the draft has light sensors only")
    if len({device.number for device in devices}) < len(devices) or len({one.name for one in devices}) < len(devices):
        raise ValueError("two devices with one name or number")


class _Wc2EcReader(MessageReader[ParsedWc2EcMessage]):
    """Cuts the stream of either side ("Versions and dialects": the body depends on the command)."""

    def __init__(self, dialect: Dialect) -> None:
        super().__init__()
        self._dialect: Dialect = dialect

    def _lost(self, data: bytes) -> str:
        """Return why the framing is lost, empty if it is not ("Limits"; "Versions and dialects": the commands)."""
        if problem := self._unknown(data[0]):
            return problem
        if self._dialect == "draft" and len(data) > 1 and data[1] != LIGHT_TYPE:
            return f"unknown sensor type {data[1]}"
        return ""

    def _unknown(self, command: int) -> str:
        """Return why a command is not to be framed, empty if it is known."""
        raise NotImplementedError

    def _lose(self, problem: str, after: int) -> ParsedWc2EcMessage:
        command, node_type, number = [*self.rest[:_HEADER], NO_FIELD, NO_FIELD][:_HEADER]
        self.dead = True
        return ParsedWc2EcMessage(command, node_type, number, None, self.rest, problem, deadly=True)


class ExternalReader(_Wc2EcReader):
    """Cuts and judges the stream of an external controller, one read at a time.

    What it cannot frame it throws away with the rest of the read. ``blocked``: a 130 went to no motor, and every later
    command is stuck ("What crashes a peer" in ``fragile-robots.md``). ``values``: how many configuration values a
    sensor of the draft has.
    """

    def __init__(self, dialect: Dialect, devices: Collection[SimulatedDevice], values: int) -> None:
        super().__init__(dialect)
        self.blocked = False
        self._values = values
        self._devices = {device.number: device for device in devices}

    def take(self, data: bytes) -> list[ParsedWc2EcMessage]:
        """Read the commands that end in ``data``, which is one read of the controller."""
        commands = super().take(data)
        if self.dead:
            self.rest = b""
        return commands

    def _unknown(self, command: int) -> str:
        if command < _FIRST_OF_EC:
            return f"command {command}, which is of the controller's half"
        return "" if command in _COMMANDS[self._dialect] else f"unknown command {command}"

    def _lose(self, problem: str, after: int) -> ParsedWc2EcMessage:
        lost = super()._lose(problem, after)
        self.dead, self.rest = after > 0, b""
        if self.dead:
            problem += ", after a valid one in the same read: it loops for ever"
        return msgspec.structs.replace(lost, problem=problem, deadly=self.dead)

    def _size(self, data: bytes) -> int:
        if self._dialect == "deployed":
            return _FLOAT.size
        return _HEADER + {ENABLE: 0, DISABLE: 0, CHANGE: 9, SET: 8 * self._values}[data[0]]

    def _read(self, raw: bytes) -> ParsedWc2EcMessage:
        return self._deployed(raw) if self._dialect == "deployed" else self._draft(raw)

    def _deployed(self, raw: bytes) -> ParsedWc2EcMessage:
        """Judge a setValue ("Translation of commands": only to registered motors, no NaN and no infinities)."""
        command, node_type, number, value = _FLOAT.unpack(raw)
        device = self._devices.get(number)
        if device is None:
            problem = f"130 to number {number}, which is not registered"
        elif not device.motor:
            problem = f"130 to {device.name!r}, which is no motor"
        elif device.node_type != node_type:
            problem = f"130 to type {node_type} number {number}: {device.name!r} is of type {device.node_type}"
        else:
            problem = "" if math.isfinite(value) else f"{value} to motor {device.name!r}"
            return ParsedWc2EcMessage(command, node_type, number, value, raw, problem)
        self.dead = self.blocked = True
        return ParsedWc2EcMessage(command, node_type, number, value, raw, f"{problem}: every later command is stuck")

    def _draft(self, raw: bytes) -> ParsedWc2EcMessage:
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
        return ParsedWc2EcMessage(command, node_type, number, value, raw, problem)


class ControllerReader(_Wc2EcReader):
    """Cuts the stream of a Webots controller; nothing can be read after what has no length."""

    def _unknown(self, command: int) -> str:
        if command >= _FIRST_OF_EC:
            return f"command {command}, which is of the external controller's half"
        known = command == DATA[self._dialect] or (self._dialect == "deployed" and command in (REGISTER, ERROR))
        return "" if known else f"unknown command {command}"

    def _size(self, data: bytes) -> int:
        if data[0] == DATA[self._dialect]:
            return _FLOAT.size
        if data[0] == ERROR:
            return _HEADER
        return _HEADER + 1 + (data[_HEADER] if len(data) > _HEADER else 0)

    def _read(self, raw: bytes) -> ParsedWc2EcMessage:
        command, node_type, number = raw[:_HEADER]
        value: Value = None
        if command == DATA[self._dialect]:
            value = _FLOAT.unpack(raw)[3]
        elif command == REGISTER:
            value = raw[_HEADER + 1 :].decode("utf-8", "backslashreplace")
        return ParsedWc2EcMessage(command, node_type, number, value, raw)


def registration(device: SimulatedDevice) -> bytes:
    """Write a registration ("Versions and dialects": deployed, 0)."""
    name = device.name.encode()
    return struct.pack("<BBBB", REGISTER, device.node_type, device.number, len(name)) + name


def measurement(dialect: Dialect, device: SimulatedDevice, value: float) -> bytes:
    """Write sensorData ("Versions and dialects": deployed, 1; draft, 0)."""
    return _FLOAT.pack(DATA[dialect], device.node_type, device.number, value)


def pieces(data: bytes, random: Random, most: int = 3) -> list[bytes]:
    """Cut what is sent together anywhere: a message may be split over segments, or share one."""
    cuts = sorted(random.randrange(len(data) + 1) for _ in range(random.randrange(most)))
    parts = [data[start:end] for start, end in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    return [part for part in parts if part]
