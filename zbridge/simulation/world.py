"""The room in which simulated robots live: walls and boxes, measured by rays. Sans-IO.

Lengths in metres, angles in radians, axes after REP 103. Knows no protocol.
"""

from __future__ import annotations

import math
import random

import msgspec
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

HALF_SIDE_M = 5.0
"""Half the side of the room, whose centre is the origin."""


class Box(msgspec.Struct, frozen=True):
    """An axis-parallel obstacle."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    def near(self, x: float, y: float, radius: float) -> bool:
        """Return whether a disc overlaps the box."""
        dx = x - min(max(x, self.x_min), self.x_max)
        dy = y - min(max(y, self.y_min), self.y_max)
        return dx * dx + dy * dy < radius * radius


BOXES = (Box(1.5, 1.0, 2.5, 2.5), Box(-3.0, -2.5, -2.0, -1.0), Box(-2.5, 2.5, -1.0, 3.2))
_WALL = 1.0
_WALLS = (
    Box(-HALF_SIDE_M - _WALL, -HALF_SIDE_M, -HALF_SIDE_M, HALF_SIDE_M),
    Box(HALF_SIDE_M, -HALF_SIDE_M, HALF_SIDE_M + _WALL, HALF_SIDE_M),
    Box(-HALF_SIDE_M, -HALF_SIDE_M - _WALL, HALF_SIDE_M, -HALF_SIDE_M),
    Box(-HALF_SIDE_M, HALF_SIDE_M, HALF_SIDE_M, HALF_SIDE_M + _WALL),
)
SOLID = BOXES + _WALLS
_EDGES: Floats = np.array([(box.x_min, box.y_min, box.x_max, box.y_max) for box in SOLID])


class Body:
    """A round robot: its place, and how it moves. ``radius`` in metres."""

    def __init__(self, x: float = 0.0, y: float = 0.0, heading: float = 0.0, radius: float = 0.2) -> None:
        self.x = x
        self.y = y
        self.heading = heading
        self.radius = radius
        self.blocked = False
        """Whether it touches a wall or a box: bumpers are pressed."""

    @classmethod
    def placed(cls, place: tuple[float, float, float] | None, *, radius: float = 0.2) -> Body:
        """Make a robot at (x, y, heading); None: at the origin, heading along x."""
        return cls(*(place or (0.0, 0.0, 0.0)), radius)

    @classmethod
    def somewhere(cls, rng: random.Random, *, heading: float = 0.0, radius: float = 0.2) -> Body:
        """Place a robot near the middle of the room, within 0.3 rad of ``heading``, as the seed says."""
        return cls(rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3) + heading, radius)

    def place(self, place: tuple[float, float, float] | None) -> None:
        """Place the robot at (x, y, heading); None: it stays where it is."""
        if place is not None:
            self.x, self.y, self.heading = place

    def __repr__(self) -> str:
        return f"<Body x={self.x:.2f} y={self.y:.2f} heading={self.heading:.2f}>"

    def step(self, forward: float, left: float, turn: float, dt: float) -> None:
        """Move for ``dt`` seconds at speeds in the robot's frame (m/s, m/s, rad/s); walls and boxes stop it."""
        self.heading = math.remainder(self.heading + turn * dt, 2 * math.pi)
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x = self.x + (forward * cos - left * sin) * dt
        y = self.y + (forward * sin + left * cos) * dt
        self.blocked = any(box.near(x, y, self.radius) for box in SOLID)
        if not self.blocked:
            self.x, self.y = x, y


def cast(x: float, y: float, angles: Floats, range_max: float) -> Floats:
    """Measure from (x, y) along ``angles`` (float64[n], world frame) to the first solid; at most ``range_max``."""
    with np.errstate(divide="ignore", invalid="ignore"):
        towards_x, towards_y = 1 / np.cos(angles)[:, None], 1 / np.sin(angles)[:, None]
        x_near, x_far = (_EDGES[:, 0] - x) * towards_x, (_EDGES[:, 2] - x) * towards_x
        y_near, y_far = (_EDGES[:, 1] - y) * towards_y, (_EDGES[:, 3] - y) * towards_y
    enter = np.maximum(np.minimum(x_near, x_far), np.minimum(y_near, y_far))
    leave = np.minimum(np.maximum(x_near, x_far), np.maximum(y_near, y_far))
    hit = (enter <= leave) & (enter > 0)
    ranges: Floats = np.where(hit, enter, np.inf).min(axis=1)
    return np.minimum(ranges, range_max)


class Grid:
    """An occupancy map that sweeps fill: cells[column, row], 0 unknown, 1 free, 2 occupied."""

    def __init__(self, side: int, cell: float) -> None:
        self.side = side
        self.cell = cell
        self.cells: npt.NDArray[np.uint8] = np.zeros((side, side), np.uint8)

    def see(self, x: float, y: float, angles: Floats, ranges: Floats, range_max: float) -> None:
        """Enter one sweep: free along every ray (angles in the world frame), occupied at its end if in range."""
        steps = np.arange(0.0, 1.0, self.cell / (2 * range_max))
        reach = np.minimum(ranges, range_max) - self.cell
        along = steps[None, :] * np.maximum(reach, 0.0)[:, None]
        self._mark(x + along * np.cos(angles)[:, None], y + along * np.sin(angles)[:, None], 1)
        hit = ranges < range_max
        self._mark(x + ranges[hit] * np.cos(angles[hit]), y + ranges[hit] * np.sin(angles[hit]), 2)

    def _mark(self, x: Floats, y: Floats, value: int) -> None:
        half = self.side * self.cell / 2
        column = np.floor((x + half) / self.cell).astype(np.int64)
        row = np.floor((y + half) / self.cell).astype(np.int64)
        inside = (column >= 0) & (column < self.side) & (row >= 0) & (row < self.side)
        self.cells[column[inside], row[inside]] = value
