"""Kinematics: what a drive means for the wheels of a robot, and back. Sans-IO.

A drive holds fractions of full scale (-1..1, after REP 103: forward, left and counter-clockwise positive); a robot
takes speeds. The classes are tables of a configuration too: a protocol's options may contain them or extend them.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from zbridge.errors import Unsupported
from zbridge.fleet.messages import Drive

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
Factor = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


def within_full_scale(forward: float, left: float, turn: float) -> Drive:
    """Return a drive. Above full scale all parts are scaled down alike: the curve stays."""
    most = max(1.0, abs(forward), abs(left), abs(turn))
    forward, left, turn = (max(-1.0, min(1.0, part / most)) for part in (forward, left, turn))
    return Drive(forward=forward, left=left, turn=turn)


class Differential(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Two sides of wheels, ``track_m`` apart.

    ``speed_full_m_s``: speed over ground at ``forward`` = 1. ``turn_full_rad_s``: yaw rate at ``turn`` = 1.
    """

    track_m: Positive
    speed_full_m_s: Positive = 0.5
    turn_full_rad_s: Positive = 1.0

    def sides_m_s(self, drive: Drive) -> tuple[float, float]:
        """Return the speeds of the left and the right side over ground, m/s.

        Raise Unsupported for a drive that only moves sideways; a sideways part beside others is left out.
        """
        if drive.left and not (drive.forward or drive.turn):
            raise Unsupported("left: a robot with two sides of wheels does not move sideways")
        along_m_s = drive.forward * self.speed_full_m_s
        across_m_s = drive.turn * self.turn_full_rad_s * self.track_m / 2
        return along_m_s - across_m_s, along_m_s + across_m_s

    def drive(self, left_m_s: float, right_m_s: float) -> Drive:
        """Return the drive that makes the two sides this fast; scaled down to full scale where they are faster."""
        forward = (left_m_s + right_m_s) / 2 / self.speed_full_m_s
        turn = (right_m_s - left_m_s) / self.track_m / self.turn_full_rad_s
        return within_full_scale(forward, 0.0, turn)


class Factors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What ``forward``, ``left`` and ``turn`` = 1 each add to the value of one motor, in the motor's unit."""

    forward: Factor = 0.0
    left: Factor = 0.0
    turn: Factor = 0.0

    def value(self, drive: Drive) -> float:
        """Return the value of the motor for a drive, in the motor's unit."""
        return drive.forward * self.forward + drive.left * self.left + drive.turn * self.turn
