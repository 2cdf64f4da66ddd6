"""The simulated vehicle of the judge: it drives and measures. Sans-IO: no channel, no clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from random import Random

import numpy as np

from gateways.alf.conformance.parser import ANGLES, FULL_PERCENT, POINTS, Dialect
from zbridge.simulation.world import Body, cast

_ANGLE_MIN_DEG, _STEP_DEG = -135.0, 360 / 1024
_RANGES_MM = (20, 5600)
_FIRST_VALID, _LAST_VALID = 44, 725
_FULL_M_S, _WHEELBASE_M, _WHEEL_RAD, _LAG_S = 1.0, 0.3, math.radians(30), 0.2
_GRAVITY_M_S2 = 9.81
_COUNTS_PER_G, _COUNTS_PER_DEG_S = 1000.0, 10.0
"""Of message 4 in ``binary`` ("Translation from the robot")."""


class JudgedVehicle:
    """One vehicle, at a seeded place; ``points``: of a measurement."""

    def __init__(self, random: Random, points: int = POINTS) -> None:
        self.place = Body.somewhere(random)
        self.light = False
        self.points = points
        self._random = random
        self._valid = (points * _FIRST_VALID // POINTS, points * _LAST_VALID // POINTS)
        self._target_m_s = self._wheel_rad = 0.0
        self._speed_m_s = self._turn_rad_s = self._gain_m_s2 = 0.0

    @property
    def moving(self) -> bool:
        """Whether the motor is commanded to turn."""
        return self._target_m_s != 0.0

    def obey(self, dialect: Dialect, fields: Sequence[float]) -> None:
        """Take the fields of message 3 ("Translation of commands": to the right positive, binary adds 90)."""
        speed, direction, angle, light = fields
        speed = min(speed, FULL_PERCENT) if dialect == "binary" else speed
        low, high = ANGLES[dialect]
        self._wheel_rad = (2 * (min(max(angle, low), high) - low) / (high - low) - 1) * _WHEEL_RAD
        self._target_m_s = (-1 if direction else 1) * speed / FULL_PERCENT * _FULL_M_S
        self.light = bool(light)

    def stop(self) -> None:
        self._target_m_s = 0.0

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds as steered."""
        gain = (self._target_m_s - self._speed_m_s) * min(dt / _LAG_S, 1.0)
        self._gain_m_s2 = gain / dt if dt > 0 else 0.0
        self._speed_m_s += gain
        self._turn_rad_s = -self._speed_m_s / _WHEELBASE_M * math.tan(self._wheel_rad)
        self.place.step(self._speed_m_s, 0.0, self._turn_rad_s, dt)

    def geometry(self) -> list[int | float]:
        """Return the fields of message 2: degrees, ms, mm ("Versions and dialects", 2)."""
        angle_max = _ANGLE_MIN_DEG + self._valid[1] * _STEP_DEG
        return [_ANGLE_MIN_DEG, angle_max, _STEP_DEG, 100, *_RANGES_MM]

    def measure(self) -> list[int]:
        """Return the points in mm and both valid indices: outside them anything, inside also 0 and codes below 20."""
        angles = self.place.heading + np.radians(_ANGLE_MIN_DEG + np.arange(self.points) * _STEP_DEG)
        ranges_mm = np.rint(1000 * cast(self.place.x, self.place.y, angles, _RANGES_MM[1] / 1000)).astype(np.int64)
        ranges_mm[ranges_mm >= _RANGES_MM[1]] = 0
        points: list[int] = ranges_mm.tolist()
        first, last = self._valid
        for index in range(self.points):
            if not first <= index <= last:
                points[index] = self._random.randint(*_RANGES_MM)
            elif self._random.random() < 0.01:
                points[index] = self._random.randrange(_RANGES_MM[0])
        return [*points, first, last]

    def feel(self, dialect: Dialect) -> list[int | float]:
        """Return the fields of 4 ("Translation from the robot": lateral to the right, vertical towards the ground)."""
        lateral_m_s2 = -self._speed_m_s * self._turn_rad_s
        accelerations_g = [self._gain_m_s2 / _GRAVITY_M_S2, lateral_m_s2 / _GRAVITY_M_S2, 1.0]
        gyro_deg_s = [0.0, 0.0, math.degrees(self._turn_rad_s)]
        speed = min(round(abs(self._speed_m_s) / _FULL_M_S * FULL_PERCENT), 255)
        temperature = 36.53 + self._random.uniform(-0.5, 0.5)
        if dialect == "text":
            return [speed, *accelerations_g, *gyro_deg_s, temperature]
        counts = [value * _COUNTS_PER_G for value in accelerations_g]
        counts += [value * _COUNTS_PER_DEG_S for value in gyro_deg_s]
        return [speed, *(min(max(round(count), -32768), 32767) for count in counts), temperature]
