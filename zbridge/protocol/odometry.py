"""Odometry: the pose of a robot, integrated from the rotation of its wheels. Sans-IO."""

from __future__ import annotations

import math

from zbridge.fleet.messages import Pose


class Odometry:
    """A pose that begins at the origin, heading along x. ``track_m``: between the two sides of wheels."""

    def __init__(self, track_m: float) -> None:
        self._track_m = track_m
        self._sides_m: tuple[float, float] | None = None
        self._x = self._y = self._heading = 0.0

    def __repr__(self) -> str:
        return f"<Odometry x={self._x:.3f} y={self._y:.3f} heading={self._heading:.3f}>"

    def restart(self) -> None:
        """Treat the next positions as those of the current pose: the robot's counters may have been reset."""
        self._sides_m = None

    def sides(self, left_m: float, right_m: float, stamp_ns: int) -> Pose:
        """Return the pose for the distances that the two sides have covered since their counters began, metres."""
        left_before, right_before = self._sides_m or (left_m, right_m)
        self._sides_m = (left_m, right_m)
        left, right = left_m - left_before, right_m - right_before
        return self.moved((left + right) / 2, (right - left) / self._track_m, stamp_ns)

    def moved(self, way_m: float, turned_rad: float, stamp_ns: int) -> Pose:
        """Return the pose after a path of ``way_m`` on which the robot turned by ``turned_rad``, counter-clockwise."""
        along = self._heading + turned_rad / 2
        self._x += way_m * math.cos(along)
        self._y += way_m * math.sin(along)
        self._heading = math.remainder(self._heading + turned_rad, 2 * math.pi)
        return Pose(self._x, self._y, self._heading, stamp_ns=stamp_ns)
