"""A simulated Webots robot, in either dialect: two wheels, a lift, a ring of distance sensors, or light sensors.

Deterministic with a seed: the same commands at the same times give the same world.
Source: "Versions and dialects" of the protocol page.
"""

from __future__ import annotations

import logging
import math
import random

import numpy as np

from gateways.wc2ec.messages import (
    ChangeSensor,
    DisableSensor,
    EnableSensor,
    RegisterSensor,
    SensorData,
    SetSensor,
    SetValue,
    Wc2EcDialect,
    Wc2EcMessage,
)
from gateways.wc2ec.session import ControllerRole
from zbridge.protocol import Truth
from zbridge.simulation.simulator import STEP_S, Simulator
from zbridge.simulation.world import Body, cast
from zbridge.transport import Conversation

log = logging.getLogger("gateways.wc2ec.simulator")

WHEEL_RADIUS_M, TRACK_M = 0.05, 0.3
FASTEST_RAD_S = 20.0
LIFT_M_S = 0.1
RANGE_M = 1.0
FULL = 1000.0
"""A distance sensor's value at the end of its range."""
VALUES = 3
"""Configuration values of a light sensor: gain, offset, and an unused one."""
LAMP = (2.0, -2.0, 50.0)
"""Position of the lamp (m), and its irradiance at a metre."""
_DISTANCE, _LINEAR, _ROTATIONAL, _LIGHT = 37, 46, 53, 0
_RING = 8
_LIGHTS = 4
_LEFT, _RIGHT, _LIFT = _RING, _RING + 1, _RING + 2
_BEARINGS = np.arange(_RING) * 2 * math.pi / _RING
DEVICES = (
    *(RegisterSensor(_DISTANCE, number, b"ds%d" % number) for number in range(_RING)),
    RegisterSensor(_ROTATIONAL, _LEFT, b"left wheel"),
    RegisterSensor(_ROTATIONAL, _RIGHT, b"right wheel"),
    RegisterSensor(_LINEAR, _LIFT, b"lift"),
)


class WebotsMachine:
    """The robot itself: what commands make it do, and what it measures. Knows no connection."""

    def __init__(self, seed: int) -> None:
        rng = random.Random(seed)
        self.body = Body.somewhere(rng)
        self.velocities = {_LEFT: 0.0, _RIGHT: 0.0}
        self.lift_m = 0.0
        self.settings = {number: [1.0, 0.0, 0.0] for number in range(_LIGHTS)}
        self.enabled: set[int] = set()
        self._lift_to_m = 0.0

    def __repr__(self) -> str:
        return f"<WebotsMachine {self.body} wheels {self.velocities}>"

    def take(self, message: Wc2EcMessage) -> None:
        match message:
            case SetValue(number=number, value=value) if number in self.velocities and math.isfinite(value):
                self.velocities[number] = max(-FASTEST_RAD_S, min(FASTEST_RAD_S, value))
            case SetValue(number=number, value=value) if number == _LIFT and math.isfinite(value):
                self._lift_to_m = value
            case EnableSensor(number=number) if number in self.settings:
                self.enabled.add(number)
            case DisableSensor(number=number):
                self.enabled.discard(number)
            case ChangeSensor(number=number, index=index, value=value) if number in self.settings and index < VALUES:
                self.settings[number][index] = value
            case SetSensor(number=number, values=values) if number in self.settings:
                self.settings[number] = values.tolist()

    @property
    def wheels_m_s(self) -> tuple[float, float]:
        """The speeds of the left and the right wheel over ground."""
        return self.velocities[_LEFT] * WHEEL_RADIUS_M, self.velocities[_RIGHT] * WHEEL_RADIUS_M

    def step(self, dt: float) -> None:
        left, right = self.wheels_m_s
        self.body.step((left + right) / 2, 0.0, (right - left) / TRACK_M, dt)
        way = self._lift_to_m - self.lift_m
        self.lift_m += max(-LIFT_M_S * dt, min(LIFT_M_S * dt, way))

    def distances(self) -> list[SensorData]:
        """Read the distance sensors: 0 at the sensor, FULL at the end of the range."""
        ranges = cast(self.body.x, self.body.y, self.body.heading + _BEARINGS, RANGE_M)
        return [SensorData(_DISTANCE, number, value) for number, value in enumerate((ranges / RANGE_M * FULL).tolist())]

    def lights(self) -> list[SensorData]:
        """Read the enabled light sensors: irradiance times gain plus offset."""
        x, y, power = LAMP
        readings = []
        for number in sorted(self.enabled):
            angle = self.body.heading + number * math.pi / 2
            away = math.hypot(x - self.body.x - 0.1 * math.cos(angle), y - self.body.y - 0.1 * math.sin(angle))
            gain, offset, _ = self.settings[number]
            readings.append(SensorData(_LIGHT, number, power / (away * away + 0.01) * gain + offset))
        return readings


class ControllerSimulator(Simulator[Wc2EcMessage]):
    """Serves one machine to the external controllers that connect."""

    def __init__(self, seed: int, dialect: Wc2EcDialect) -> None:
        super().__init__(log)
        self.machine = WebotsMachine(seed)
        self.body = self.machine.body
        self._dialect = dialect

    def session(self, peer: str, link: str) -> ControllerRole:
        session = ControllerRole(self._dialect, values=VALUES)
        session.name = f"controller {peer}"
        return session

    def truth(self) -> Truth:
        body, wheels = self.machine.body, self.machine.wheels_m_s
        return Truth(body.x, body.y, body.heading, wheels, neutral=not any(wheels))

    def greet(self, client: Conversation, link: str) -> None:
        """Register the devices, before any data."""
        if self._dialect is Wc2EcDialect.DEPLOYED:
            self.send(client, *DEVICES)

    def take(self, client: Conversation, message: Wc2EcMessage) -> None:
        self.machine.take(message)

    def step(self, steps: int) -> None:
        self.machine.step(STEP_S)
        self.tell(*(self.machine.distances() if self._dialect is Wc2EcDialect.DEPLOYED else self.machine.lights()))
