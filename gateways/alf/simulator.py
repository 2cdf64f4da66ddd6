"""An ALF vehicle to play with: steers like a car, measures the room with its laser, stops when nobody drives it.

It speaks either dialect, on one port or two. Deterministic with a seed: the same commands at the same times give
the same world. Source: "Versions and dialects" and "Translation of commands" of the protocol page.
"""

from __future__ import annotations

import logging
import math
import random

import numpy as np

from gateways.alf.messages import AlfDialect, AlfMessage, DriveCommand, DriveInfo, Measurement, ScannerInit
from gateways.alf.session import VehicleRole
from gateways.alf.translate import DRIVE, LASER, VEHICLE
from zbridge.protocol import Truth
from zbridge.simulation.simulator import STEP_S, Simulator
from zbridge.simulation.world import Body, cast
from zbridge.transport import Conversation

log = logging.getLogger("gateways.alf.simulator")

SPEED_M_S = 1.0
"""Speed over ground at 100 percent."""
WHEELBASE_M = 0.35
LOCK_RAD = math.radians(30.0)
"""Steering angle at full lock."""
ACCELERATION_M_S2 = 2.0
SILENT_S = 2.0
"""Seconds without a command until the motor stops: 20 cycles of 20 ticks at 200 Hz ("Translation of commands")."""
SCANNER = ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600)
POINTS, FIRST_VALID, LAST_VALID = 769, 44, 725
NOISE_MM = 5.0
STANDARD_GRAVITY = 9.80665
TEMPERATURE = 36.5
_SCAN_EVERY, _INFO_EVERY = 5, 50
_ANGLES = np.radians(SCANNER.angle_min_deg + SCANNER.angle_increment_deg * np.arange(POINTS))
_FULL_LOCK_DEG = 90
_MOST_SPEED, _MOST_TEXT_SPEED = 100, 255


class Car:
    """The vehicle itself: what commands make it do, and what it measures. Knows no connection."""

    def __init__(self, seed: int, dialect: AlfDialect) -> None:
        rng = random.Random(seed)
        self.body = Body.somewhere(rng, radius=0.25)
        self.light = False
        self.speed_m_s = 0.0
        self._dialect = dialect
        self._noise = np.random.default_rng(seed)
        self._wanted_m_s = 0.0
        self._wheels_rad = 0.0
        self._silent_s = 0.0
        self._sequence = 0
        self._clock_ms = 0
        self._acceleration = 0.0
        self._turn_rad_s = 0.0

    def __repr__(self) -> str:
        return f"<Car {self.body} at {self.speed_m_s:.2f} m/s>"

    @property
    def neutral(self) -> bool:
        return not self._wanted_m_s

    def take(self, command: DriveCommand) -> None:
        straight = _FULL_LOCK_DEG if self._dialect is AlfDialect.BINARY else 0
        right_deg = max(-_FULL_LOCK_DEG, min(_FULL_LOCK_DEG, command.steering - straight))
        most = _MOST_SPEED if self._dialect is AlfDialect.BINARY else _MOST_TEXT_SPEED
        speed = min(most, command.speed) / _MOST_SPEED * SPEED_M_S
        self._wanted_m_s = -speed if command.direction else speed
        self._wheels_rad = -right_deg / _FULL_LOCK_DEG * LOCK_RAD
        self.light = command.light
        self._silent_s = 0.0

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds: Ackermann steering, limited acceleration, walls."""
        self._clock_ms += round(dt * 1000)
        self._silent_s += dt
        wanted = self._wanted_m_s if self._silent_s <= SILENT_S else 0.0
        change = max(-ACCELERATION_M_S2 * dt, min(ACCELERATION_M_S2 * dt, wanted - self.speed_m_s))
        self.speed_m_s += change
        self._acceleration = change / dt
        self._turn_rad_s = self.speed_m_s / WHEELBASE_M * math.tan(self._wheels_rad)
        self.body.step(self.speed_m_s, 0.0, self._turn_rad_s, dt)
        if self.body.blocked:
            self.speed_m_s = 0.0

    def measure(self) -> Measurement:
        """Sweep with the laser: mm, 0 for no measurement."""
        self._sequence += 1
        range_max = SCANNER.range_max_mm / 1000
        ranges = cast(self.body.x, self.body.y, self.body.heading + _ANGLES, range_max)
        noise = self._noise.normal(0.0, NOISE_MM, POINTS)
        points = np.where(ranges < range_max, np.rint(ranges * 1000 + noise), 0).astype(np.int64)
        points[:FIRST_VALID] = points[LAST_VALID + 1 :] = 0
        return Measurement(self._sequence, self._clock_ms, np.maximum(points, 0), FIRST_VALID, LAST_VALID)

    def info(self) -> DriveInfo:
        """Return how it moves, in the units of its dialect."""
        g, degrees = STANDARD_GRAVITY, math.degrees(self._turn_rad_s)
        lateral = -self.speed_m_s * self._turn_rad_s / g
        values = (self._acceleration / g, lateral, 1.0, 0.0, 0.0, degrees)
        if self._dialect is AlfDialect.BINARY:
            values = tuple(round(value * (1000 if place < 3 else 10)) for place, value in enumerate(values))  # type: ignore[assignment]
        return DriveInfo(round(abs(self.speed_m_s) / SPEED_M_S * _MOST_SPEED), *values, TEMPERATURE)


class VehicleSimulator(Simulator[AlfMessage]):
    """Serves one car: on one link, or drive commands on the first and measurements on the second ("Links")."""

    def __init__(self, seed: int, dialect: AlfDialect, links: int) -> None:
        super().__init__(log, links=(DRIVE, LASER) if links > 1 else (VEHICLE,))
        self.car = Car(seed, dialect)
        self.body = self.car.body
        self._dialect = dialect
        self._drive, self._laser = (DRIVE, LASER) if links > 1 else (VEHICLE, VEHICLE)

    def session(self, peer: str, link: str) -> VehicleRole:
        session = VehicleRole(self._dialect)
        session.name = f"hq {peer}"
        return session

    def truth(self) -> Truth:
        body = self.car.body
        return Truth(body.x, body.y, body.heading, neutral=self.car.neutral)

    def greet(self, client: Conversation, link: str) -> None:
        """Describe the scanner, before anything is measured."""
        if link == self._laser:
            self.send(client, SCANNER)

    def take(self, client: Conversation, message: AlfMessage) -> None:
        if isinstance(message, DriveCommand):
            self.car.take(message)

    def step(self, steps: int) -> None:
        self.car.step(STEP_S)
        if steps % _SCAN_EVERY == 0:
            self.tell(self.car.measure(), link=self._laser)
        if steps % _INFO_EVERY == 0:
            self.tell(self.car.info(), link=self._drive)
