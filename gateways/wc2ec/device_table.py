"""The devices that external controllers see of a robot, sectors of its scan among them. Sans-IO.

Each device keeps its name and number while any controller knows it: controllers learn each number once. Only when no
number is left, devices that the robot has no longer and that no controller knows give theirs up.
Source: "Towards HQ programs" and "Limits" of the protocol page.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import msgspec

from gateways.wc2ec.devices import DISTANCE, LINEAR, ROTATIONAL
from gateways.wc2ec.messages import RegisterSensor, Wc2EcDialect, write
from gateways.wc2ec.options import Wc2EcHqOptions
from gateways.wc2ec.translate import NAME
from zbridge.fleet.messages import Device, Scan, Scanner
from zbridge.fleet.view import RobotView
from zbridge.protocol import Count, Kept, Sectors

LEFT, RIGHT = "left", "right"
"""The motors of a robot that has none of its own."""


class SectorSensors:
    """``count`` sensors named ``sector0`` (ahead) and up, counter-clockwise. unit_m: metres for a value of 1."""

    def __init__(self, count: int, unit_m: float) -> None:
        self.names = [f"sector{number}" for number in range(count)]
        self._unit_m = unit_m
        self._sectors = Sectors(count)

    def __repr__(self) -> str:
        return f"<SectorSensors {len(self.names)}>"

    def covered(self, geometry: Scan | Scanner) -> list[str]:
        """Return the names of the sectors in which a scan, or a scanner, has points."""
        return [self.names[sector] for sector in self._sectors.covered(geometry)]

    def values(self, scan: Scan) -> dict[str, float]:
        """Return the value of each sector that a scan covers: the nearest point, in ``unit_m``."""
        nearest_m = self._sectors.nearest_m(scan)
        return {self.names[sector]: range_m / self._unit_m for sector, range_m in nearest_m.items()}


NUMBERS = 255
"""Device numbers there are: 0 to 254."""
_NAME_BYTES = 255
_ESCAPED = re.compile(r"\\x([89a-f][0-9a-f])")


class ShownDevice(msgspec.Struct, frozen=True):
    """A device as controllers know it: the name it has in keys, its number, type byte and kind."""

    name: str
    number: int
    type: int
    kind: str

    @property
    def motor(self) -> bool:
        """Whether it can be set."""
        return self.kind in (ROTATIONAL, LINEAR)


class DeviceTable(Kept):
    """The devices of one robot. Those of the draft are listed in the options; others are learnt from the bus.

    registered: returns the numbers that some controller knows. unregistered: counts devices that find no number.
    """

    kept: ClassVar[dict[str, Any]] = {
        "by_name": dict[str, ShownDevice],
        "by_number": dict[int, ShownDevice],
        "registrations": dict[int, bytes],
    }

    def __init__(
        self,
        options: Wc2EcHqOptions,
        view: RobotView,
        registered: Callable[[], set[int]],
        unregistered: Count,
    ) -> None:
        self.by_name: dict[str, ShownDevice] = {}
        self.by_number: dict[int, ShownDevice] = {}
        self.registrations: dict[int, bytes] = {}
        """The message that registers each device."""
        self._options = options
        self._view = view
        self.sectors = SectorSensors(options.sectors, options.sector_unit_m)
        self._registered = registered
        self._unregistered = unregistered
        self._dialect = Wc2EcDialect(options.dialect)
        self._draft = self._dialect is Wc2EcDialect.DRAFT
        for device in options.devices:
            self._enter(device.name, device.number, device.kind)

    def __repr__(self) -> str:
        return f"<DeviceTable of {len(self.by_number)}>"

    def learn(self) -> None:
        """Enter what the robot has now; a robot without motors of its own gets ``left`` and ``right``."""
        view = self._view
        if self._draft or view.protocol is None:
            return
        devices = view.devices.devices if view.devices is not None else None
        if len(self.by_number) >= NUMBERS:
            self._forget_gone(devices or ())
        for device in devices or ():
            self._enter(name_in_keys(device.name), device.number, device.kind)
        if view.protocol != NAME or devices is not None:
            for name, reading in view.readings.items():
                self._enter(name, reading.device, reading.kind or DISTANCE)
            if self._complete and not any(device.motor for device in self.by_name.values()):
                self._enter(LEFT, None, ROTATIONAL)
                self._enter(RIGHT, None, ROTATIONAL)
        if view.protocol != NAME:
            for name in self._sector_names():
                self._enter(name, None, DISTANCE)

    def _sector_names(self) -> list[str]:
        """Return the sectors to show, all before the first scan: a controller without sensors is never ready."""
        for geometry in (self._view.scan, self._view.scanner):
            names = self.sectors.covered(geometry) if geometry is not None else []
            if names:
                return names
        return [] if self._view.readings else self.sectors.names

    def _forget_gone(self, devices: Iterable[Device]) -> None:
        """Give up the numbers of devices that the robot has no longer and that no controller knows."""
        names = (name_in_keys(device.name) for device in devices)
        there = {LEFT, RIGHT, *self._view.readings, *self._sector_names(), *names}
        known = self._registered()
        for name, device in tuple(self.by_name.items()):
            if name not in there and device.number not in known:
                del self.by_name[name], self.by_number[device.number], self.registrations[device.number]

    @property
    def _complete(self) -> bool:
        """Whether all devices are known: a Webots robot registers until it is established, its motors perhaps last."""
        status = self._view.status
        return self._view.protocol != NAME or (status is not None and status.state == "established")

    def _enter(self, name: str, number: int | None, kind: str) -> None:
        """Enter a device under its number, or the lowest free one if that is taken or None."""
        if name in self.by_name:
            return
        if number is None or number in self.by_number or not 0 <= number < NUMBERS:
            number = next((free for free in range(NUMBERS) if free not in self.by_number), None)
        if number is None or not 0 < len(_bytes(name)) <= _NAME_BYTES:
            self._unregistered.value += 1
            return
        device = ShownDevice(name, number, 0 if self._draft else self._type(kind), kind)
        self.by_name[name] = self.by_number[number] = device
        if not self._draft:
            registration = RegisterSensor(device.type, number, _bytes(name))
            self.registrations[number] = write(registration, self._dialect)

    def _type(self, kind: str) -> int:
        types = {
            ROTATIONAL: self._options.rotational_type,
            LINEAR: self._options.linear_type,
            DISTANCE: self._options.distance_type,
        }
        digits = kind.removeprefix("type")
        known = digits.isdecimal() and len(digits) <= 3 and int(digits) < 256
        return types.get(kind, int(digits) if known else self._options.distance_type)


def name_in_keys(shown: str) -> str:
    """Return the name in keys of a device that the device table shows: bytes that are not UTF-8 are escaped there."""
    return _ESCAPED.sub(lambda escaped: chr(0xDC00 + int(escaped[1], 16)), shown)


def _bytes(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")
