"""The devices of one Webots robot: what is registered or configured, under which names. Sans-IO.

Source: "Versions and dialects" and "Translation from the robot" (names in keys) of the protocol page.
"""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec

from zbridge.fleet.messages import Device, Devices
from zbridge.protocol import Exported, Form, Kept

DISTANCE, LIGHT, ROTATIONAL, LINEAR = "distance", "light", "rotational", "linear"
_SENSOR_KINDS = {37: DISTANCE, 38: DISTANCE}
"""Node types of Webots. The numbers change with the version of Webots, so only the shown kind depends on them."""


class WebotsDevice(msgspec.Struct, frozen=True):
    """One device. ``type``: its type byte; ``kind``: what that means.

    ``name``: in keys; bytes that are not UTF-8 are kept as surrogates.
    """

    name: str
    number: int
    type: int
    kind: str

    @property
    def shown(self) -> str:
        """The name for people."""
        return self.name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")

    @property
    def motor(self) -> bool:
        """Whether the device can be set."""
        return self.kind in (ROTATIONAL, LINEAR)


class RegisteredDevices(Kept):
    """The devices of one session, by number and by name."""

    kept: ClassVar[dict[str, Any]] = {
        "collisions": list[str],
        "_by_number": Form(
            lambda table: [_write_device(device) for device in table.values()], lambda raw: _read_devices(raw)
        ),
    }

    def __init__(self) -> None:
        self.collisions: list[str] = []
        self._by_number: dict[int, WebotsDevice] = {}
        self._by_name: dict[str, WebotsDevice] = {}

    def __repr__(self) -> str:
        return f"<RegisteredDevices of {len(self._by_number)}>"

    def restore(self, state: Exported) -> None:
        super().restore(state)
        self._by_name = {device.name: device for device in self._by_number.values()}

    def add(self, device: WebotsDevice) -> WebotsDevice | None:
        """Enter a device; give it as entered (a number is added to a taken name). None: its number is taken."""
        if device.number in self._by_number:
            return None
        if device.name in self._by_name:
            taken = self._by_name[device.name].number
            self.collisions.append(f"{device.shown!r} is device {taken} and {device.number}")
            suffix = f"#{device.number}"
            while device.name in self._by_name:
                device = msgspec.structs.replace(device, name=device.name + suffix)
        self._by_number[device.number] = self._by_name[device.name] = device
        return device

    def numbered(self, number: int) -> WebotsDevice | None:
        """Find a device by its number; None: there is none."""
        return self._by_number.get(number)

    def named(self, name: str) -> WebotsDevice | None:
        """Find a device by its name in keys; None: there is none."""
        return self._by_name.get(name)

    def motors(self, kind: str) -> list[WebotsDevice]:
        """List the motors of one kind."""
        return [device for device in self._by_number.values() if device.kind == kind]

    def message(self, stamp_ns: int) -> Devices:
        """Return the table as a fleet message."""
        entries = (Device(device.shown, device.number, device.kind) for device in self._by_number.values())
        return Devices(tuple(entries), stamp_ns=stamp_ns)


def kind_of(kind_byte: int, motor_types: dict[str, tuple[int, ...]]) -> str:
    """Return the kind that a type byte means; motor types come first."""
    for kind, types in motor_types.items():
        if kind_byte in types:
            return kind
    return _SENSOR_KINDS.get(kind_byte, f"type{kind_byte}")


def _write_device(device: WebotsDevice) -> list[Any]:
    """Write a device as MessagePack holds it: a name may have bytes that are not UTF-8."""
    name = device.name.encode("utf-8", "surrogateescape")
    shown = None if device.shown == device.name else device.shown
    return [name, shown, device.number, device.type, device.kind]


def _read_devices(raw: Any) -> dict[int, WebotsDevice]:
    devices = {}
    for written, _, number, kind_byte, kind in msgspec.convert(raw, list[tuple[bytes, str | None, int, int, str]]):
        devices[number] = WebotsDevice(written.decode("utf-8", "surrogateescape"), number, kind_byte, kind)
    return devices
