"""The simulated Webots robot of the judge: its motors turn and its sensors measure. Sans-IO: no channel, no clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from random import Random

import numpy as np
import numpy.typing as npt

from gateways.wc2ec.conformance.parser import CHANGE, DISABLE, ENABLE, DeviceKind, ParsedWc2EcMessage, SimulatedDevice
from zbridge.simulation.world import Body, cast

_WHEEL_M, _TRACK_M = 0.05, 0.3
_REACH_M, _FULL_READING = 2.0, 1000.0
_LINEAR_M_S = 0.2


class JudgedMotor:
    """A motor: rotational ones turn at once at the velocity they are set to, linear ones go to a position."""

    def __init__(self, device: SimulatedDevice) -> None:
        self.device = device
        self.velocity = 0.0
        """As it is now: rad/s, or m/s of a linear one."""
        self.position = 0.0
        """As it is now: rad, or m."""
        self.target = 0.0
        """The last value that it was set to: rad/s, or m."""

    def __repr__(self) -> str:
        return f"<JudgedMotor {self.device.name!r} {self.velocity:g} at {self.position:g}, set to {self.target:g}>"

    def set(self, value: float) -> None:
        self.target = value
        if self.device.kind is DeviceKind.ROTATIONAL:
            self.velocity = value

    def step(self, dt: float) -> None:
        way = self.target - self.position
        if self.device.kind is DeviceKind.LINEAR and abs(way) <= _LINEAR_M_S * dt:
            self.position, self.velocity = self.target, way / dt if way else 0.0
        else:
            if self.device.kind is DeviceKind.LINEAR:
                self.velocity = math.copysign(_LINEAR_M_S, way)
            self.position += self.velocity * dt


class JudgedWebots:
    """One robot, at a seeded place; ``values``: how many configuration values each light sensor has.

    Its wheels are the rotational motors whose names have ``left`` or ``right`` in them.
    """

    def __init__(self, devices: Sequence[SimulatedDevice], random: Random, values: int) -> None:
        self.place = Body.somewhere(random)
        self.motors = {device.name: JudgedMotor(device) for device in devices if device.motor}
        lights = [device.number for device in devices if device.kind is DeviceKind.LIGHT]
        self.enabled: set[int] = set()
        """Numbers of the light sensors that are enabled."""
        self.configuration = {number: [0.0] * values for number in lights}
        """Configuration values by number of the light sensor."""
        self._sensors = [device for device in devices if device.kind in (DeviceKind.DISTANCE, DeviceKind.LIGHT)]
        self._numbers = {motor.device.number: motor for motor in self.motors.values()}
        turning = [motor for motor in self.motors.values() if motor.device.kind is DeviceKind.ROTATIONAL]
        self._left = [motor for motor in turning if "left" in motor.device.name.lower()]
        self._right = [motor for motor in turning if "right" in motor.device.name.lower()]

    @property
    def moving(self) -> bool:
        """Whether any rotational motor turns."""
        return any(motor.velocity for motor in self._numbers.values() if motor.device.kind is DeviceKind.ROTATIONAL)

    def set_motor(self, message: ParsedWc2EcMessage) -> None:
        """Obey a setValue that is all right."""
        assert isinstance(message.value, float)
        self._numbers[message.number].set(message.value)

    def set_sensor(self, message: ParsedWc2EcMessage) -> str:
        """Obey a command of the draft that is all right; return what it does without need, empty if nothing."""
        number, had = message.number, message.number in self.enabled
        if message.command == ENABLE:
            self.enabled.add(number)
            return f"light sensor {number} enabled again" * had
        if message.command == DISABLE:
            self.enabled.discard(number)
            return f"light sensor {number} disabled that was not enabled" * (not had)
        assert isinstance(message.value, tuple)
        if message.command == CHANGE:
            self.configuration[number][int(message.value[0])] = message.value[1]
        else:
            self.configuration[number] = list(message.value)
        return ""

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds as the motors turn."""
        for motor in self._numbers.values():
            motor.step(dt)
        if self._left and self._right:
            left, right = (
                _WHEEL_M * sum(motor.velocity for motor in side) / len(side) for side in (self._left, self._right)
            )
            self.place.step((left + right) / 2, 0.0, (right - left) / _TRACK_M, dt)

    def measure(self) -> list[tuple[SimulatedDevice, float]]:
        """Measure all round: 0..1000 up to 2 m with distance sensors, a lamp in the middle with enabled lights."""
        bearings = np.arange(len(self._sensors), dtype=np.float64) * (2 * math.pi / max(len(self._sensors), 1))
        angles: npt.NDArray[np.float64] = bearings + self.place.heading
        ranges_m = cast(self.place.x, self.place.y, angles, _REACH_M)
        lamp = 1 / (1 + self.place.x**2 + self.place.y**2)
        measured: list[tuple[SimulatedDevice, float]] = []
        for device, bearing, range_m in zip(self._sensors, bearings.tolist(), ranges_m.tolist(), strict=True):
            if device.kind is DeviceKind.DISTANCE:
                value = range_m / _REACH_M * _FULL_READING
            elif device.number in self.enabled:
                value = lamp * (1.5 + math.cos(self.place.heading + bearing)) * 10
            else:
                continue
            measured.append((device, value))
        return measured
