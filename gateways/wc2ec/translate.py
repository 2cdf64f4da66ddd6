"""Translates between WC2EC messages and fleet messages, both ways: one Webots robot. Sans-IO.

Source: "Versions and dialects", "Translation from the robot" and "Translation of commands" of the protocol page.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import msgspec

from gateways.wc2ec import messages
from gateways.wc2ec.devices import (
    LIGHT,
    LINEAR,
    ROTATIONAL,
    RegisteredDevices,
    WebotsDevice,
    kind_of,
)
from gateways.wc2ec.options import Wc2EcOptions
from gateways.wc2ec.session import ExternalRole
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Motor, Reading, SensorSetting, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol import (
    BearingScan,
    Malformed,
    Metrics,
    NotReady,
    Outcome,
    ProtocolError,
    RobotSide,
    Telemetry,
    Translate,
    Unsupported,
)

NAME = "wc2ec"
STOP_REPEAT_S = 0.1


def _interpolation(table: tuple[tuple[float, float], ...]) -> Callable[[float], float]:
    """Return the function that a table of pairs means: linear between them, constant beyond."""
    import numpy as np

    measured, meant = np.array(table).T
    return lambda value: float(np.interp(value, measured, meant))


class Wc2EcRobot(RobotSide):
    """One Webots robot, seen from its external controller."""

    hands_over = True
    driving: ExternalRole | None = None
    kept: ClassVar[dict[str, Any]] = {"_table": RegisteredDevices, "_ring": BearingScan | None}
    link_names = ("robot",)

    def __init__(self, options: Wc2EcOptions, links: int = 1, metrics: Metrics | None = None) -> None:
        metrics = metrics or Metrics()
        self.options = options
        self.dialect = options.dialect  # type: ignore[misc]
        self._dialect = messages.Wc2EcDialect(options.dialect)
        self._table = RegisteredDevices()
        self._subscribed: set[str] = set(options.pinned)
        self._ring: BearingScan | None = None
        self._tables = {name: _interpolation(table) for name, table in options.tables.items()}
        self._faults = metrics.count("sensor_faults", help="Implausible readings of WC2EC sensors.")
        self._unregistered = metrics.count(
            "sensor_unregistered", help="Readings of WC2EC devices that were not registered."
        )
        self._motor_types = {ROTATIONAL: options.motor_types.rotational, LINEAR: options.motor_types.linear}
        self._motor_names = {ROTATIONAL: options.motors.rotational, LINEAR: options.motors.linear}

    @property
    def on_demand(self) -> tuple[Topic, ...]:
        """Sensors of the draft: they measure while somebody listens."""
        if self._dialect is messages.Wc2EcDialect.DEPLOYED:
            return ()
        return tuple(topics.SENSOR(device.name) for device in self.options.devices)

    def session(self, link: str, peer: str) -> ExternalRole:
        self.driving = ExternalRole(self._dialect)
        self._table = RegisteredDevices()
        bearings_deg = self.options.bearings_deg
        self._ring = BearingScan(bearings_deg, self.options.scan_range_m) if bearings_deg else None
        for option in self.options.devices if self._dialect is messages.Wc2EcDialect.DRAFT else ():
            self._table.add(WebotsDevice(option.name, option.number, 0, option.kind))
        return self.driving

    def begun(self, stamp_ns: int) -> tuple[Telemetry, ...]:
        if self._dialect is messages.Wc2EcDialect.DRAFT:
            session = self._connected()
            devices = [device for device in map(self._table.named, sorted(self._subscribed)) if device is not None]
            frames = tuple(session.encode(messages.EnableSensor(device.type, device.number)) for device in devices)
            if frames:
                session.outbox.set("enable", frames, -math.inf)
            return ((topics.DEVICES, self._table.message(stamp_ns)),)
        return ()

    def listened(self, topic: Topic, on: bool) -> None:
        device = next((d for d in self.options.devices if topics.SENSOR(d.name).path == topic.path), None)
        if device is None or device.name in self.options.pinned:
            return
        if on:
            self._subscribed.add(device.name)
        else:
            self._subscribed.discard(device.name)
        if self.ready:
            self._send((messages.EnableSensor if on else messages.DisableSensor)(0, device.number))

    # Messages to telemetry

    def translator(self, kind: type) -> Translate:
        return partial(_TELEMETRY[kind], self)

    def _registration(self, message: messages.RegisterSensor, stamp_ns: int) -> tuple[Telemetry, ...]:
        kind = kind_of(message.kind, self._motor_types)
        device = WebotsDevice(message.name.decode("utf-8", "surrogateescape"), message.number, message.kind, kind)
        for motor, names in self._motor_names.items():
            if device.name in names:
                device = msgspec.structs.replace(device, kind=motor)
        entered = self._table.add(device)
        if entered is None:
            raise ProtocolError(f"device {message.number} registered again, as {device.shown!r}")
        if entered.kind == ROTATIONAL and self.ready:  # not known when the robot was stopped: one read may bring all
            self._set_motor(entered, 0.0, 0.0, urgent=True)
        shown: list[Telemetry] = [(topics.DEVICES, self._table.message(stamp_ns))]
        if entered.name != device.name:
            text = f"{self._table.collisions[-1]}: the second is shown as {entered.shown!r}"
            shown.append((topics.TEXT, Text(text, stamp_ns=stamp_ns)))
        return tuple(shown)

    def _reading(self, message: messages.SensorData, stamp_ns: int) -> tuple[Telemetry, ...]:
        device = self._table.numbered(message.number)
        if device is None:
            self._unregistered.value += 1
            kind = LIGHT if self._dialect is messages.Wc2EcDialect.DRAFT else kind_of(message.kind, self._motor_types)
            device = WebotsDevice(f"{kind}-{message.number}", message.number, message.kind, kind)
        options, name = self.options, device.name
        value = message.value
        low, high = options.bounds.get(name) or options.bounds_default or (-math.inf, math.inf)
        fault = not low <= value <= high or math.isinf(value)
        self._faults.value += fault
        table = self._tables.get(name)
        if table is not None and not fault:
            value = table(value)
        reading = Reading(value, device.kind, device.number, fault, stamp_ns=stamp_ns)
        if self._ring is None:
            return ((topics.SENSOR(device.name), reading),)
        scan = self._ring.take(name, math.nan if fault else value, stamp_ns)
        return ((topics.SENSOR(device.name), reading), *(((topics.SCAN, scan),) if scan is not None else ()))

    def _error(self, message: messages.Error, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.TEXT, Text(f"error of device {message.number}", stamp_ns=stamp_ns)),)

    # Commands to messages

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        chunk = topic.path.rpartition("/")[2]
        if isinstance(command, Drive):
            return self._drive(command, now)
        if isinstance(command, Motor):
            self._motor(topics.unescape(chunk), command.value, now)
        elif isinstance(command, SensorSetting):
            self._configure(topics.unescape(chunk), command)
        else:
            raise Unsupported("a Webots robot has no such command")
        return Outcome()

    @property
    def accepts(self) -> tuple[str, ...]:
        if self._dialect is messages.Wc2EcDialect.DRAFT:
            return ("sensor",)
        rotational = self._table.motors(ROTATIONAL)
        driven = self._driven
        drives = bool(driven) and driven <= {device.name for device in rotational}
        motors = bool(rotational or self._table.motors(LINEAR))
        return (*(("drive",) if drives else ()), *(("motor",) if motors else ()))

    def stop(self, now: float, until: float) -> None:
        """Set every rotational motor to 0. Linear motors keep their position: values that wait for them are dropped."""
        if self._dialect is messages.Wc2EcDialect.DEPLOYED:
            for device in self._table.motors(LINEAR):
                self._connected().outbox.clear(_slot(device))
            for device in self._table.motors(ROTATIONAL):
                self._set_motor(device, 0.0, now, period_s=STOP_REPEAT_S, until=until, urgent=True)

    def stop_frames(self) -> tuple[bytes, ...]:
        if self._dialect is not messages.Wc2EcDialect.DEPLOYED:
            return ()
        session, motors = self._connected(), self._table.motors(ROTATIONAL)
        return tuple(session.encode(messages.SetValue(device.type, device.number, 0.0)) for device in motors)

    def ask(self, topic: Topic) -> None:
        raise Unsupported(f"a Webots robot cannot be asked for its {topic.path}")

    def _drive(self, command: Drive, now: float) -> Outcome:
        velocities = self._velocities(command)
        missing = sorted(self._driven - {device.name for device in self._table.motors(ROTATIONAL)})
        if missing:
            raise Unsupported(f"no rotational motor is registered as {', '.join(missing)}")
        for name, velocity in velocities.items():
            device = self._table.named(name)
            assert device is not None
            self._set_motor(device, velocity, now)
        left_out = [name for name in ("left",) if command.left and self.options.differential is not None]
        left_out += ["light"] if command.light is not None else []
        return Outcome(left_out=f"{' and '.join(left_out)}: this robot has none" if left_out else None)

    @property
    def _driven(self) -> frozenset[str]:
        """The motors that a drive moves, by the configuration."""
        wheels = self.options.differential
        return frozenset((*wheels.left, *wheels.right) if wheels is not None else self.options.factors)

    def _velocities(self, command: Drive) -> dict[str, float]:
        """Return the velocity of every driven motor, rad/s."""
        wheels = self.options.differential
        if wheels is not None:
            left, right = (side_m_s / wheels.wheel_radius_m for side_m_s in wheels.sides_m_s(command))
            return {**dict.fromkeys(wheels.left, left), **dict.fromkeys(wheels.right, right)}
        if not self.options.factors:
            raise Unsupported("no kinematics in the configuration (differential or factors)")
        return {name: factors.value(command) for name, factors in self.options.factors.items()}

    def _set_motor(
        self,
        device: WebotsDevice,
        value: float,
        now: float,
        *,
        period_s: float = math.inf,
        until: float = math.inf,
        urgent: bool = False,
    ) -> None:
        """Set a motor to a value; a newer value of the same motor replaces one that still waits."""
        if self._dialect is not messages.Wc2EcDialect.DEPLOYED:
            raise Unsupported("the draft dialect has no motors")
        if not math.isfinite(value):
            raise Malformed(f"{device.shown}: {value} is no value of a motor")
        session = self._connected()
        frame = session.encode(messages.SetValue(device.type, device.number, value))
        session.outbox.set(_slot(device), (frame,), now, period_s=period_s, until=until, urgent=urgent)

    def _motor(self, name: str, value: float, now: float) -> None:
        device = self._table.named(name)
        if device is None or not device.motor:
            raise Unsupported(f"no motor is registered as {name!r}")
        self._set_motor(device, value, now)

    def _configure(self, name: str, setting: SensorSetting) -> None:
        device = self._table.named(name)
        if device is None:
            raise Unsupported(f"no sensor is named {name!r}")
        if self._dialect is not messages.Wc2EcDialect.DRAFT:
            raise Unsupported("only the draft dialect has settings of sensors")
        header = device.type, device.number
        changes: list[messages.Wc2EcMessage] = []
        if setting.enable is not None:
            changes.append((messages.EnableSensor if setting.enable else messages.DisableSensor)(*header))
        if (setting.index is None) is not (setting.value is None):
            raise Malformed("index and value: one without the other")
        if setting.index is not None and setting.value is not None:
            if not 0 <= setting.index < self.options.values:
                raise Malformed(f"index {setting.index}: expected 0 to {self.options.values - 1}")
            changes.append(messages.ChangeSensor(*header, setting.index, setting.value))
        if setting.values is not None:
            if len(setting.values) != self.options.values:
                raise Malformed(f"{len(setting.values)} values: expected {self.options.values}")
            import numpy as np

            changes.append(messages.SetSensor(*header, np.array(setting.values)))
        if not changes:
            raise Malformed("a setting without any field")
        if not all(map(math.isfinite, (setting.value or 0.0, *(setting.values or ())))):
            raise Malformed("a value that is no number")
        for message in changes:
            self._send(message)

    def _send(self, message: messages.Wc2EcMessage) -> None:
        self._connected().send(message)

    def _connected(self) -> ExternalRole:
        if self.driving is None:
            raise NotReady("offline")
        return self.driving


def _slot(device: WebotsDevice) -> str:
    """Name the slot of a motor in the outbox."""
    return f"motor {device.number}"


_TELEMETRY: dict[type[messages.Wc2EcMessage], Callable[[Wc2EcRobot, Any, int], tuple[Telemetry, ...]]] = {
    messages.RegisterSensor: Wc2EcRobot._registration,
    messages.SensorData: Wc2EcRobot._reading,
    messages.Error: Wc2EcRobot._error,
}
