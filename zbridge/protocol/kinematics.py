"""Kinematics: what a drive means for the wheels of a robot, and back; the pose that follows. Sans-IO.

A drive holds fractions of full scale (-1..1, after REP 103: forward, left and counter-clockwise positive); a robot
takes speeds. The classes are tables of a configuration too: a protocol's options may contain them or extend them.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec

from zbridge.errors import ProtocolError, Unsupported
from zbridge.fleet.messages import Drive, Pose
from zbridge.protocol.kept import Kept

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
Factor = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


def within_full_scale(forward: float, left: float, turn: float) -> Drive:
    """Return a drive. Above full scale all parts are scaled down alike: the curve stays."""
    most = max(1.0, abs(forward), abs(left), abs(turn))
    forward, left, turn = (max(-1.0, min(1.0, part / most)) for part in (forward, left, turn))
    return Drive(forward=forward, left=left, turn=turn)


class Differential(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Two sides of wheels.

    track_m: distance between the left and the right wheels. speed_full_m_s: over ground at ``forward`` = 1.
    turn_full_rad_s: yaw rate at ``turn`` = 1.
    """

    track_m: Positive
    speed_full_m_s: Positive = 0.5
    turn_full_rad_s: Positive = 1.0

    def velocity(self, drive: Drive) -> tuple[float, float]:
        """Return the speed ahead, m/s, and the turn rate, rad/s, counter-clockwise.

        Raise Unsupported for a drive that only moves sideways; a sideways part beside others is left out.
        """
        if drive.left and not (drive.forward or drive.turn):
            raise Unsupported("left: a robot with two sides of wheels does not move sideways")
        return drive.forward * self.speed_full_m_s, drive.turn * self.turn_full_rad_s

    def sides_m_s(self, drive: Drive) -> tuple[float, float]:
        """Return the speeds of the left and the right side over ground, m/s; raise Unsupported as :meth:`velocity`."""
        along_m_s, turn_rad_s = self.velocity(drive)
        across_m_s = turn_rad_s * self.track_m / 2
        return along_m_s - across_m_s, along_m_s + across_m_s

    def drive(self, left_m_s: float, right_m_s: float) -> Drive:
        """Return the drive that makes the two sides this fast; scaled down to full scale where they are faster."""
        forward = (left_m_s + right_m_s) / 2 / self.speed_full_m_s
        turn = (right_m_s - left_m_s) / self.track_m / self.turn_full_rad_s
        return within_full_scale(forward, 0.0, turn)


class Factors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What each part of a drive adds to the value of one motor.

    forward, left, turn: value added when this part of the drive is 1, in the motor's unit.
    """

    forward: Factor = 0.0
    left: Factor = 0.0
    turn: Factor = 0.0

    def value(self, drive: Drive) -> float:
        """Return the value of the motor for a drive, in the motor's unit."""
        return drive.forward * self.forward + drive.left * self.left + drive.turn * self.turn


class Odometry(Kept):
    """A pose that begins at the origin, heading along x, from what a robot counts itself.

    track_m: between the two sides of wheels; :meth:`sides` alone needs it. unit_m: metres of one unit of the robot's
    counters. wrap: the number of values of a counter (``2**16``), after which it begins anew; None: it never does.
    """

    kept: ClassVar[dict[str, Any]] = {"_x": float, "_y": float, "_heading": float, "_counted": tuple[float, ...] | None}

    def __init__(self, track_m: float = math.inf, *, unit_m: float = 1.0, wrap: float | None = None) -> None:
        self._track_m, self._unit_m, self._wrap = track_m, unit_m, wrap
        self._counted: tuple[float, ...] | None = None
        self._x = self._y = self._heading = 0.0

    def __repr__(self) -> str:
        return f"<Odometry x={self._x:.3f} y={self._y:.3f} heading={self._heading:.3f}>"

    def restart(self) -> None:
        """Treat the next counters as those of the current pose: the robot may have reset them."""
        self._counted = None

    def sides(self, left: float, right: float, stamp_ns: int) -> Pose:
        """Return the pose for the distances that the two sides have covered since their counters began, in units."""
        left_before, right_before = self._since((left, right))
        left_m, right_m = self._way_m(left, left_before), self._way_m(right, right_before)
        return self.moved((left_m + right_m) / 2, (right_m - left_m) / self._track_m, stamp_ns)

    def placed(self, x: float, y: float, heading_rad: float, stamp_ns: int) -> Pose:
        """Return the pose of a robot that reckons its own: ``x``, ``y`` in units, on its own axes."""
        x_before, y_before, heading_before = self._since((x, y, heading_rad))
        x_m, y_m, axes_rad = self._way_m(x, x_before), self._way_m(y, y_before), self._heading - heading_before
        self._x += x_m * math.cos(axes_rad) - y_m * math.sin(axes_rad)
        self._y += x_m * math.sin(axes_rad) + y_m * math.cos(axes_rad)
        return self.moved(0.0, math.remainder(heading_rad - heading_before, 2 * math.pi), stamp_ns)

    def moved(self, way_m: float, turned_rad: float, stamp_ns: int) -> Pose:
        """Return the pose after a path of ``way_m`` on which the robot turned by ``turned_rad``, counter-clockwise.

        Raise ProtocolError for numbers that are not finite, as the other methods do; the pose stays as it was.
        """
        _require_finite(way_m, turned_rad)
        along = self._heading + turned_rad / 2
        self._x += way_m * math.cos(along)
        self._y += way_m * math.sin(along)
        self._heading = math.remainder(self._heading + turned_rad, 2 * math.pi)
        return Pose(self._x, self._y, self._heading, stamp_ns=stamp_ns)

    def _since(self, counted: tuple[float, ...]) -> tuple[float, ...]:
        """Note what is counted now; return what was before, the same where the counters begin."""
        _require_finite(*counted)
        before, self._counted = self._counted or counted, counted
        return before

    def _way_m(self, counter: float, before: float) -> float:
        """Return the distance between two values of a counter, the shorter way where it wraps."""
        way = counter - before
        return (way if self._wrap is None else math.remainder(way, self._wrap)) * self._unit_m


def _require_finite(*numbers: float) -> None:
    if not all(map(math.isfinite, numbers)):
        raise ProtocolError(f"{numbers}: expected finite numbers")
