"""What external controllers are shown of a robot of any protocol, and what they command. Sans-IO.

Source: "The gateway as Webots controller" and the dialects of the protocol page.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal

import msgspec

from gateways.wc2ec.devices import DISTANCE, LINEAR, ROTATIONAL
from gateways.wc2ec.messages import (
    MAX_FRAME,
    ChangeSensor,
    Dialect,
    DisableSensor,
    EnableSensor,
    RegisterSensor,
    SensorData,
    SetSensor,
    SetValue,
    Wc2EcMessage,
    write,
)
from gateways.wc2ec.session import ControllerSession
from gateways.wc2ec.settings import Byte, DeviceOption
from gateways.wc2ec.translate import NAME
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Device,
    Devices,
    Drive,
    FleetMessage,
    Motor,
    Reading,
    Scan,
    Scanner,
    SensorSetting,
    Status,
)
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import (
    ConfigError,
    Differential,
    HqSide,
    Limits,
    Metrics,
    Positive,
    ProtocolError,
    Sectors,
    Send,
    Telemetry,
)

DEADMAN_S = 0.5
NUMBERS = 255
"""Devices there can be: numbers 0 to 254."""
LEFT, RIGHT = "left", "right"
"""The motors of a robot that has none of its own."""
FAULT = -1.0
"""What a distance sensor shows of which nothing is known: deployed controllers take it as a fault, while anything from
0 to 1000 would be a lie ("The gateway as Webots controller")."""
_MOST = 1e9
_NAME_BYTES = 255
_ESCAPED = re.compile(r"\\x([89a-f][0-9a-f])")


class Wheels(Differential, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The two sides of wheels that are shown of a robot without motors."""

    wheel_radius_m: Positive = 0.05
    track_m: Positive = 0.3


class HqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[hq]] options`` of this protocol; the template of ``zbridge init`` explains each."""

    dialect: Literal["deployed", "draft"] = "deployed"
    hold: bool = True
    join_s: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.03
    sectors: Annotated[int, msgspec.Meta(ge=1, le=128)] = 8
    sector_unit_m: Positive = 1.0
    wheels: Wheels = Wheels()
    distance_type: Byte = 37
    rotational_type: Byte = 53
    linear_type: Byte = 46
    devices: tuple[DeviceOption, ...] = ()
    values: Byte = 3

    def __post_init__(self) -> None:
        """Raise ConfigError for what cannot go together."""
        if (self.dialect == "draft") is not bool(self.devices):
            raise ConfigError("devices: must be listed for the draft, which has no names, and for it alone")
        for field in ("number", "name"):
            if len({getattr(device, field) for device in self.devices}) < len(self.devices):
                raise ConfigError(f"devices: a {field} twice")


class Shown(msgspec.Struct, frozen=True):
    """A device as controllers know it."""

    name: str
    number: int
    type: int
    kind: str

    @property
    def motor(self) -> bool:
        """Whether it can be set."""
        return self.kind in (ROTATIONAL, LINEAR)


class HqClient(ControllerSession):
    """The session of one controller: what it was told there is, what it wants to know, what it set."""

    handled = frozenset({SetValue})

    def __init__(self, dialect: Dialect, *, values: int, bounds: Limits) -> None:
        super().__init__(dialect, values=values, bounds=bounds)
        self.registered: set[int] = set()
        self.enabled: set[int] = set()
        self.wheels = {LEFT: 0.0, RIGHT: 0.0}
        self.fresh: set[str] = set()
        """The wheels that were set since the last drive."""
        self.joined_at = math.inf
        """When what was set becomes a drive, whatever else is set or not."""
        self.said_at = -math.inf
        """When the last value came."""

    def accept(self, message: Wc2EcMessage, now: float) -> bool:
        self.said_at = now
        return super().accept(message, now)


class Wc2EcHq(HqSide):
    """One listener. Its devices keep their names and numbers; only where no number is left, those that are gone give
    theirs up."""

    name = NAME
    deadman_s = DEADMAN_S

    def __init__(self, options: HqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self.hold = options.hold
        self._dialect = Dialect(options.dialect)
        self._draft = self._dialect is Dialect.DRAFT
        self.follows = ("scan",) if self._draft else ("scan", "scanner", "devices", "sensor/*")
        self._sessions: list[HqClient] = []
        self._by_name: dict[str, Shown] = {}
        self._by_number: dict[int, Shown] = {}
        self._registrations: dict[int, bytes] = {}
        self._unregistered = (metrics or Metrics()).count("hq_devices_left_out")
        self._sectors = Sectors(options.sectors)
        self._frames: dict[int, tuple[float, bytes]] = {}
        """The data that was encoded last of each device."""
        self._gone: dict[str, Reading] = {}
        """The last readings of a robot that was lost since: nothing is known of it by them."""
        self._scan_gone: Scan | None = None
        for device in options.devices:
            self._enter(device.name, device.number, device.kind)

    # Clients

    def session(self, number: int, bounds: Limits) -> HqClient:
        self._sessions = [session for session in self._sessions if not session.over]
        session = HqClient(
            self._dialect,
            values=self.options.values,
            bounds=msgspec.structs.replace(bounds, frame_bytes=MAX_FRAME),
        )
        self._sessions.append(session)
        return session

    def begin(self, session: HqClient, now: float) -> None:
        self._learn()
        self._register(session, now)

    def presence(self, there: bool) -> Send | None:
        """Show what is known of a robot that is there; of one that is lost that nothing is."""
        if there:
            known = ((device, self._known(device)) for device in self._by_name.values())
            return self._data((device, value) for device, value in known if value is not None)
        self._gone, self._scan_gone = dict(self.view.readings), self.view.scan
        return self._data((device, FAULT) for device in self._by_name.values() if device.kind == DISTANCE)

    def wanted(self) -> tuple[Topic, ...]:
        if not self._draft:
            return ()
        enabled = set().union(*(session.enabled for session in self._sessions if not session.over))
        return tuple(topics.SENSOR(self._by_number[number].name) for number in sorted(enabled))

    # Values

    def _first(self, device: Shown) -> float | None:
        """Give what a controller is told first of a device, which is ready only then; None of a motor."""
        if device.motor:
            return None
        known = self._known(device) if self.view.missing is None else None
        return known if known is not None else FAULT if device.kind == DISTANCE else 0.0

    def _known(self, device: Shown) -> float | None:
        """Give the last value of a device since the robot is there; None where there is none."""
        reading, scan = self.view.readings.get(device.name), self.view.scan
        if reading is not None and reading is not self._gone.get(device.name):
            return _shown(device, reading.value, fault=reading.fault)
        if scan is None or scan is self._scan_gone or self.view.protocol in (None, NAME):
            return None
        nearest = self._nearest(scan).get(device.name)
        return None if nearest is None else _shown(device, nearest)

    # Devices

    def _learn(self) -> None:
        """Enter what the robot has; a robot without motors of its own gets two."""
        if self._draft or self.view.protocol is None:
            return
        devices = self.view.devices.devices if self.view.devices is not None else None
        if len(self._by_number) >= NUMBERS:
            self._forget_gone(devices or ())
        for device in devices or ():
            self._enter(_name(device.name), device.number, device.kind)
        if self.view.protocol != NAME or devices is not None:
            for name, reading in self.view.readings.items():
                self._enter(name, reading.device, reading.kind or DISTANCE)
            if self._complete and not any(device.motor for device in self._by_name.values()):
                self._enter(LEFT, None, ROTATIONAL)
                self._enter(RIGHT, None, ROTATIONAL)
        if self.view.protocol != NAME:
            for name in self._sector_names():
                self._enter(name, None, DISTANCE)

    def _sector_names(self) -> list[str]:
        """List the sectors there are, whether a scan has come or not: a controller without sensors is never ready."""
        for geometry in (self.view.scan, self.view.scanner):
            names = [f"sector{sector}" for sector in self._sectors.covered(geometry)] if geometry is not None else []
            if names:
                return names
        return [] if self.view.readings else [f"sector{number}" for number in range(self.options.sectors)]

    def _forget_gone(self, devices: Iterable[Device]) -> None:
        """Give up the numbers of devices that the robot had once, and that no controller knows."""
        there = {LEFT, RIGHT, *self.view.readings, *self._sector_names(), *(_name(device.name) for device in devices)}
        known = set[int]().union(*(session.registered for session in self._sessions if not session.over))
        for name, device in tuple(self._by_name.items()):
            if name not in there and device.number not in known:
                del self._by_name[name], self._by_number[device.number], self._registrations[device.number]

    @property
    def _complete(self) -> bool:
        """Whether the table is whole: a Webots robot registers until it is established, motors last maybe."""
        status = self.view.status
        return self.view.protocol != NAME or (status is not None and status.state == "established")

    def _enter(self, name: str, number: int | None, kind: str) -> None:
        if name in self._by_name:
            return
        if number is None or number in self._by_number or not 0 <= number < NUMBERS:
            number = next((free for free in range(NUMBERS) if free not in self._by_number), None)
        if number is None or not 0 < len(_bytes(name)) <= _NAME_BYTES:
            self._unregistered.value += 1
        else:
            device = Shown(name, number, 0 if self._draft else self._type(kind), kind)
            self._by_name[name] = self._by_number[number] = device
            if not self._draft:
                registration = RegisterSensor(device.type, number, _bytes(name))
                self._registrations[number] = write(registration, self._dialect)

    def _type(self, kind: str) -> int:
        types = {
            ROTATIONAL: self.options.rotational_type,
            LINEAR: self.options.linear_type,
            DISTANCE: self.options.distance_type,
        }
        digits = kind.removeprefix("type")
        known = digits.isdecimal() and len(digits) <= 3 and int(digits) < 256
        return types.get(kind, int(digits) if known else self.options.distance_type)

    def _register(self, session: HqClient, now: float) -> None:
        """Register what the controller does not know yet, each name once; a value of each sensor follows at once."""
        new = [device for device in self._by_number.values() if device.number not in session.registered]
        if new and not self._draft:
            session.outbox.put_exempt(b"".join(self._registrations[device.number] for device in new))
        session.registered.update(device.number for device in new)
        for device in new:
            value = self._first(device)
            if value is not None:
                self._stand(session, device, self._frame(device, value), now)

    # The robot, shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        if isinstance(message, Reading):
            return self._reading(topics.unescape(topic.path.rpartition("/")[2]), message)
        if isinstance(message, Scan):
            return self._scan(message)
        if isinstance(message, Devices | Scanner | Status):
            before = len(self._by_name)
            self._learn()
            return self._register if len(self._by_name) > before else None
        return None

    def _reading(self, name: str, message: Reading) -> Send | None:
        if name not in self._by_name:
            self._learn()
        device = self._by_name.get(name)
        if device is None or self.view.missing is not None:
            return None
        return self._data(((device, _shown(device, message.value, fault=message.fault)),))

    def _scan(self, scan: Scan) -> Send | None:
        """Cut a scan of a robot without distance sensors into sectors: the nearest point of each."""
        if self.view.protocol in (None, NAME) or not len(scan.ranges):
            return None
        self._learn()
        if self.view.missing is not None:
            return None
        shown = [(self._by_name.get(name), value) for name, value in self._nearest(scan).items()]
        return self._data((device, _shown(device, value)) for device, value in shown if device is not None)

    def _nearest(self, scan: Scan) -> dict[str, float]:
        """Give the nearest point of each sector that a scan covers, in the unit of the controllers."""
        unit_m = self.options.sector_unit_m
        return {f"sector{sector}": range_m / unit_m for sector, range_m in self._sectors.nearest_m(scan).items()}

    def _data(self, values: Iterable[tuple[Shown, float | None]]) -> Send | None:
        """Encode sensor data once for every controller."""
        frames = [(device, self._frame(device, value)) for device, value in values if value is not None]
        if not frames:
            return None

        def send(session: HqClient, now: float) -> None:
            for device, frame in frames:
                self._stand(session, device, frame, now)

        return send

    def _frame(self, device: Shown, value: float) -> bytes:
        last = self._frames.get(device.number)
        if last is None or last[0] != value:
            last = (value, write(SensorData(device.type, device.number, value), self._dialect))
            self._frames[device.number] = last
        return last[1]

    def _stand(self, session: HqClient, device: Shown, frame: bytes, now: float) -> None:
        """Let a value stand until it is written, if the controller wants it; the newest wins."""
        if device.number not in session.registered:
            self._register(session, now)
        if not self._draft or device.number in session.enabled:
            session.outbox.set(f"sensor {device.number}", (frame,), now)

    # What controllers command

    def take(self, session: HqClient, message: Wc2EcMessage) -> tuple[Telemetry, ...]:
        device = self._by_number.get(message.number)
        if device is None:
            raise ProtocolError(f"device {message.number} is not registered")
        return _TAKEN[type(message)](self, session, device, message)

    def _set(self, session: HqClient, device: Shown, message: SetValue) -> tuple[Telemetry, ...]:
        if not device.motor:
            raise ProtocolError(f"device {device.number} ({device.name!r}) is no motor")
        if not abs(message.value) <= _MOST:
            raise ProtocolError(f"{message.value} is no value of a motor")
        if self._has_motors:
            return ((topics.CMD_MOTOR(device.name), Motor(message.value)),)
        if device.name not in session.wheels:
            raise ProtocolError(f"the robot has no motor {device.name!r} any more")
        session.wheels[device.name] = message.value
        session.fresh.add(device.name)
        if session.fresh == session.wheels.keys() or not any(session.wheels.values()):
            return self._joined(session)
        session.joined_at = min(session.joined_at, session.said_at + self.options.join_s)
        return self.expire(session, session.said_at)

    def deadline(self, session: HqClient) -> float:
        return session.joined_at

    def expire(self, session: HqClient, now: float) -> tuple[Telemetry, ...]:
        """Drive with what was set of the wheels: a deployed controller sets them one after the other."""
        return self._joined(session) if now >= session.joined_at else ()

    def _joined(self, session: HqClient) -> tuple[Telemetry, ...]:
        session.fresh.clear()
        session.joined_at = math.inf
        return () if self._has_motors else ((topics.CMD_DRIVE, self._drive(**session.wheels)),)

    @property
    def _has_motors(self) -> bool:
        """Whether the robot has motors of its own now."""
        devices = self.view.devices.devices if self.view.devices is not None else ()
        return any(device.kind in (ROTATIONAL, LINEAR) for device in devices)

    def _drive(self, left: float, right: float) -> Drive:
        """Turn velocities of two sides, rad/s, into a drive, to full scale where they are more."""
        wheels = self.options.wheels
        return wheels.drive(wheels.wheel_radius_m * left, wheels.wheel_radius_m * right)

    def _enable(self, session: HqClient, device: Shown, message: EnableSensor) -> tuple[Telemetry, ...]:
        session.enabled.add(device.number)
        return ()

    def _disable(self, session: HqClient, device: Shown, message: DisableSensor) -> tuple[Telemetry, ...]:
        session.enabled.discard(device.number)
        session.outbox.clear(f"sensor {device.number}")
        return ()

    def _change(self, session: HqClient, device: Shown, message: ChangeSensor) -> tuple[Telemetry, ...]:
        return _setting(device, SensorSetting(index=message.index, value=message.value), message.value)

    def _configure(self, session: HqClient, device: Shown, message: SetSensor) -> tuple[Telemetry, ...]:
        values = tuple(message.values.tolist())
        return _setting(device, SensorSetting(values=values), *values)


def _shown(device: Shown, value: float, *, fault: bool = False) -> float | None:
    """Give the value that a controller is shown: a fault where it is no distance; None where it is no other number."""
    if device.kind == DISTANCE:
        return FAULT if fault or not math.isfinite(value) else value
    return value if math.isfinite(value) else None


def _setting(device: Shown, setting: SensorSetting, *values: float) -> tuple[Telemetry, ...]:
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f"{values} to sensor {device.number}: no numbers")
    return ((topics.CMD_SENSOR(device.name), setting),)


def _name(shown: str) -> str:
    """Read the name in keys back from how the device table shows it: with bytes that are not UTF-8 escaped."""
    return _ESCAPED.sub(lambda escaped: chr(0xDC00 + int(escaped[1], 16)), shown)


def _bytes(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


_TAKEN: dict[type[Wc2EcMessage], Callable[[Wc2EcHq, HqClient, Shown, Any], tuple[Telemetry, ...]]] = {
    SetValue: Wc2EcHq._set,
    EnableSensor: Wc2EcHq._enable,
    DisableSensor: Wc2EcHq._disable,
    ChangeSensor: Wc2EcHq._change,
    SetSensor: Wc2EcHq._configure,
}
