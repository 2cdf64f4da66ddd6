"""One external controller: its session, and its messages as fleet commands. Sans-IO.

A robot without motors is shown two, ``left`` and ``right``. Legacy controllers set them one after the other: what is
set within ``join_s`` becomes one drive; a stop never waits. Source: "The gateway as Webots controller".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

from gateways.wc2ec.device_table import LEFT, RIGHT, DeviceTable, ShownDevice
from gateways.wc2ec.devices import LINEAR, ROTATIONAL
from gateways.wc2ec.messages import (
    ChangeSensor,
    DisableSensor,
    EnableSensor,
    SetSensor,
    SetValue,
    Wc2EcDialect,
    Wc2EcMessage,
)
from gateways.wc2ec.options import Wc2EcHqOptions
from gateways.wc2ec.session import ControllerRole
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Motor, SensorSetting
from zbridge.fleet.view import RobotView
from zbridge.protocol import Limits, ProtocolError, Telemetry


class Wc2EcClient(ControllerRole):
    """One controller: which devices it knows, which it enabled (draft), and how it set the two wheels."""

    kept: ClassVar[dict[str, Any]] = {
        "registered": set[int],
        "enabled": set[int],
        "wheels": dict[str, float],
        "fresh": set[str],
        "joined_at": float,
        "received_at": float,
    }
    handled = frozenset({SetValue})

    def __init__(self, dialect: Wc2EcDialect, *, values: int, bounds: Limits) -> None:
        super().__init__(dialect, values=values, bounds=bounds)
        self.registered: set[int] = set()
        self.enabled: set[int] = set()
        self.wheels = {LEFT: 0.0, RIGHT: 0.0}
        self.fresh: set[str] = set()
        """The wheels that were set since the last drive."""
        self.joined_at = math.inf
        """When the values set so far become a drive, at the latest."""
        self.received_at = -math.inf
        """When the last value came."""

    def accept(self, message: Wc2EcMessage, now: float) -> bool:
        self.received_at = now
        return super().accept(message, now)


_MOST = 1e9


class ControllerCommands:
    """Translates the messages of one listener's controllers."""

    def __init__(self, options: Wc2EcHqOptions, view: RobotView, table: DeviceTable) -> None:
        self._options = options
        self._view = view
        self._table = table

    def __repr__(self) -> str:
        return f"<ControllerCommands to {self._table!r}>"

    def take(self, session: Wc2EcClient, message: Wc2EcMessage) -> tuple[Telemetry, ...]:
        """Translate a message; raise ProtocolError if it has no meaning."""
        device = self._table.by_number.get(message.number)
        if device is None:
            raise ProtocolError(f"device {message.number} is not registered")
        return _TRANSLATE[type(message)](self, session, device, message)

    def expire(self, session: Wc2EcClient, now: float) -> tuple[Telemetry, ...]:
        """Drive with the wheels as they are set, if ``join_s`` is over."""
        return self._joined(session) if now >= session.joined_at else ()

    def _set(self, session: Wc2EcClient, device: ShownDevice, message: SetValue) -> tuple[Telemetry, ...]:
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
        session.joined_at = min(session.joined_at, session.received_at + self._options.join_s)
        return self.expire(session, session.received_at)

    def _joined(self, session: Wc2EcClient) -> tuple[Telemetry, ...]:
        session.fresh.clear()
        session.joined_at = math.inf
        return () if self._has_motors else ((topics.CMD_DRIVE, self._drive(**session.wheels)),)

    @property
    def _has_motors(self) -> bool:
        """Whether the robot has motors of its own now."""
        devices = self._view.devices.devices if self._view.devices is not None else ()
        return any(device.kind in (ROTATIONAL, LINEAR) for device in devices)

    def _drive(self, left: float, right: float) -> Drive:
        """Convert the velocities of two sides, rad/s, to a drive; both parts are scaled down if one exceeds 1."""
        wheels = self._options.wheels
        return wheels.drive(wheels.wheel_radius_m * left, wheels.wheel_radius_m * right)

    def _enable(self, session: Wc2EcClient, device: ShownDevice, message: EnableSensor) -> tuple[Telemetry, ...]:
        session.enabled.add(device.number)
        return ()

    def _disable(self, session: Wc2EcClient, device: ShownDevice, message: DisableSensor) -> tuple[Telemetry, ...]:
        session.enabled.discard(device.number)
        session.outbox.clear(f"sensor {device.number}")
        return ()

    def _change(self, session: Wc2EcClient, device: ShownDevice, message: ChangeSensor) -> tuple[Telemetry, ...]:
        return _setting(device, SensorSetting(index=message.index, value=message.value), message.value)

    def _configure(self, session: Wc2EcClient, device: ShownDevice, message: SetSensor) -> tuple[Telemetry, ...]:
        values = tuple(message.values.tolist())
        return _setting(device, SensorSetting(values=values), *values)


def _setting(device: ShownDevice, setting: SensorSetting, *values: float) -> tuple[Telemetry, ...]:
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f"{values} to sensor {device.number}: no numbers")
    return ((topics.CMD_SENSOR(device.name), setting),)


_Translate = Callable[[ControllerCommands, Wc2EcClient, ShownDevice, Any], tuple[Telemetry, ...]]
_TRANSLATE: dict[type[Wc2EcMessage], _Translate] = {
    SetValue: ControllerCommands._set,
    EnableSensor: ControllerCommands._enable,
    DisableSensor: ControllerCommands._disable,
    ChangeSensor: ControllerCommands._change,
    SetSensor: ControllerCommands._configure,
}
