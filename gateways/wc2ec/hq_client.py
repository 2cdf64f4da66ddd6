"""One external controller: its session, and its messages as fleet commands. Sans-IO.

A robot without motors is shown two, ``left`` and ``right``. Legacy controllers set them one after the other: what is
set within ``join_s`` becomes one drive; a stop never waits. Source: "Towards HQ programs" of the protocol page.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec

from gateways.wc2ec.device_table import LEFT, RIGHT, ShownDevice
from gateways.wc2ec.devices import LINEAR, ROTATIONAL
from gateways.wc2ec.messages import (
    MAX_FRAME,
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
from zbridge.fleet.messages import Motor, SensorSetting
from zbridge.fleet.view import RobotView
from zbridge.protocol import Limits, ProtocolError, Telemetry

_MOST = 1e9
Commands = tuple[Telemetry, ...]


class Wc2EcClient(ControllerRole):
    """One controller: which devices it knows, which it enabled (draft), and how it set the two wheels.

    Translates its messages, which raise ProtocolError where they have no meaning.
    """

    kept: ClassVar[dict[str, Any]] = {
        "registered": set[int],
        "enabled": set[int],
        "wheels": dict[str, float],
        "fresh": set[str],
        "joined_at": float,
        "received_at": float,
    }
    handled = frozenset({SetValue})

    def __init__(self, options: Wc2EcHqOptions, view: RobotView, bounds: Limits) -> None:
        bounds = msgspec.structs.replace(bounds, frame_bytes=MAX_FRAME)
        super().__init__(Wc2EcDialect(options.dialect), values=options.values, bounds=bounds)
        self._options = options
        self._view = view
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

    def joined(self, now: float) -> Commands:
        """Drive with the wheels as they are set, if ``join_s`` is over."""
        if now < self.joined_at:
            return ()
        self.fresh.clear()
        self.joined_at = math.inf
        if self._has_motors:
            return ()
        wheels = self._options.wheels
        sides_m_s = (wheels.wheel_radius_m * self.wheels[side] for side in (LEFT, RIGHT))
        return ((topics.CMD_DRIVE, wheels.drive(*sides_m_s)),)

    def set_motor(self, device: ShownDevice, message: SetValue) -> Commands:
        """Set a motor; one of the two wheels waits for the other."""
        if not device.motor:
            raise ProtocolError(f"device {device.number} ({device.name!r}) is no motor")
        if not abs(message.value) <= _MOST:
            raise ProtocolError(f"{message.value} is no value of a motor")
        if self._has_motors:
            return ((topics.CMD_MOTOR(device.name), Motor(message.value)),)
        if device.name not in self.wheels:
            raise ProtocolError(f"the robot has no motor {device.name!r} any more")
        self.wheels[device.name] = message.value
        self.fresh.add(device.name)
        whole = self.fresh == self.wheels.keys() or not any(self.wheels.values())
        join_s = 0.0 if whole else self._options.join_s
        self.joined_at = min(self.joined_at, self.received_at + join_s)
        return self.joined(self.received_at)

    @property
    def _has_motors(self) -> bool:
        """Whether the robot has motors of its own now."""
        devices = self._view.devices.devices if self._view.devices is not None else ()
        return any(device.kind in (ROTATIONAL, LINEAR) for device in devices)


def _enable(client: Wc2EcClient, device: ShownDevice, message: EnableSensor) -> Commands:
    client.enabled.add(device.number)
    return ()


def _disable(client: Wc2EcClient, device: ShownDevice, message: DisableSensor) -> Commands:
    client.enabled.discard(device.number)
    client.outbox.clear(f"sensor {device.number}")
    return ()


def _change(client: Wc2EcClient, device: ShownDevice, message: ChangeSensor) -> Commands:
    return _setting(device, SensorSetting(index=message.index, value=message.value), message.value)


def _configure(client: Wc2EcClient, device: ShownDevice, message: SetSensor) -> Commands:
    values = tuple(message.values.tolist())
    return _setting(device, SensorSetting(values=values), *values)


def _setting(device: ShownDevice, setting: SensorSetting, *values: float) -> Commands:
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f"{values} to sensor {device.number}: no numbers")
    return ((topics.CMD_SENSOR(device.name), setting),)


TRANSLATE: dict[type[Wc2EcMessage], Callable[[Wc2EcClient, ShownDevice, Any], Commands]] = {
    SetValue: Wc2EcClient.set_motor,
    EnableSensor: _enable,
    DisableSensor: _disable,
    ChangeSensor: _change,
    SetSensor: _configure,
}
