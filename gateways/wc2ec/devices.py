"""The devices of one Webots robot: what is registered or configured, under which names. Sans-IO.

Source: the dialects of the protocol page; names in keys are the design's.
"""

from __future__ import annotations

import msgspec

from zbridge.fleet.messages import Device as Entry
from zbridge.fleet.messages import Devices

DISTANCE, LIGHT, ROTATIONAL, LINEAR = "distance", "light", "rotational", "linear"
_SENSOR_KINDS = {37: DISTANCE, 38: DISTANCE}
"""Webots node types; their numbers move with the version, so they only give a name to the kind."""


class Device(msgspec.Struct, frozen=True):
    """One device: its name in keys, as people see it, its number, its type byte and what kind it is."""

    name: str
    shown: str
    number: int
    type: int
    kind: str

    @property
    def motor(self) -> bool:
        """Whether it can be set."""
        return self.kind in (ROTATIONAL, LINEAR)


class Table:
    """The devices of one session, by number and by name."""

    def __init__(self) -> None:
        self.collisions: list[str] = []
        self._by_number: dict[int, Device] = {}
        self._by_name: dict[str, Device] = {}

    def __repr__(self) -> str:
        return f"<Table of {len(self._by_number)} devices>"

    def add(self, device: Device) -> Device | None:
        """Enter a device; None where its number has one already. A name that is taken gets its number behind it."""
        if device.number in self._by_number:
            return None
        if device.name in self._by_name:
            taken = self._by_name[device.name].number
            self.collisions.append(f"{device.shown!r} is device {taken} and {device.number}")
            suffix = f"#{device.number}"
            while device.name in self._by_name:
                device = msgspec.structs.replace(device, name=device.name + suffix, shown=device.shown + suffix)
        self._by_number[device.number] = self._by_name[device.name] = device
        return device

    def numbered(self, number: int) -> Device | None:
        """Find a device by its number."""
        return self._by_number.get(number)

    def named(self, name: str) -> Device | None:
        """Find a device by its name in keys."""
        return self._by_name.get(name)

    def motors(self, kind: str) -> list[Device]:
        """List the motors of one kind."""
        return [device for device in self._by_number.values() if device.kind == kind]

    def message(self, stamp_ns: int) -> Devices:
        """Show the table."""
        entries = (Entry(device.shown, device.number, device.kind) for device in self._by_number.values())
        return Devices(tuple(entries), stamp_ns=stamp_ns)


def registered(raw: bytes, number: int, kind_byte: int, kind: str) -> Device:
    """Make a device of a registration; bytes that are not UTF-8 stay what they are in the key."""
    name = raw.decode("utf-8", "surrogateescape")
    return Device(name, raw.decode("utf-8", "backslashreplace"), number, kind_byte, kind)


def unnamed(number: int, kind_byte: int, kind: str) -> Device:
    """Make a device that nobody has named."""
    name = f"{kind}-{number}"
    return Device(name, name, number, kind_byte, kind)


def kind_of(kind_byte: int, motor_types: dict[str, tuple[int, ...]]) -> str:
    """Name the kind of a type byte."""
    for kind, types in motor_types.items():
        if kind_byte in types:
            return kind
    return _SENSOR_KINDS.get(kind_byte, f"type{kind_byte}")
