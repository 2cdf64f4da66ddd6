"""Twists as fractions of what a robot can do. Sans-IO."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from zbridge.errors import Malformed, Unsupported
from zbridge.fleet.messages import Drive
from zbridge.protocol.kinematics import within_full_scale
from zbridge.ros2.types import Types
from zbridge.views.ros2.settings import RobotBody

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
MOST_BYTES: Mapping[str, int] = {TWIST: 64, STAMPED: 512}
"""Bounds of the payloads; a stamped one has the name of a frame."""
_LITTLE_ENDIAN = b"\0\1"
_TWIST = struct.Struct("<4x6d")
"""A Twist in CDR: linear x, y, z, and angular x, y, z."""
_STILL = 1e-6
"""m/s and rad/s below this are zero."""
_LARGEST = 1e6
"""m/s and rad/s above this are no command: most random bytes say so."""


def read_twist(types: Types, type_name: str, payload: bytes, body: RobotBody) -> Drive:
    """Read a Twist or TwistStamped; its stamp says nothing here: clocks of machines are never compared.

    Raises ProtocolError for what is none, Malformed for numbers that no command has, Unsupported for a turn on the spot
    of a robot that steers.
    """
    if type_name == TWIST and len(payload) == _TWIST.size and payload.startswith(_LITTLE_ENDIAN):  # nearly all
        values = _TWIST.unpack(payload)
    else:
        message = types.decode(type_name, payload)
        twist = message.twist if type_name == STAMPED else message
        linear, angular = twist.linear, twist.angular
        values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if not all(abs(value) <= _LARGEST for value in values):  # false for NaN
        raise Malformed(f"cmd_vel: expected numbers of {_LARGEST:g} at most")
    return drive_of(values[0], values[1], values[5], body)


def drive_of(forward_mps: float, left_mps: float, turn_radps: float, body: RobotBody) -> Drive:
    """Scale speeds to a Drive; raise Unsupported for what a robot that steers cannot do.

    Above full scale all parts are scaled down alike: the curve stays. A robot that steers turns its wheels so that it
    runs the circle of radius v / omega: by atan(wheelbase x omega / v).
    """
    forward_mps, left_mps, turn_radps = (
        0.0 if abs(value) < _STILL else value for value in (forward_mps, left_mps, turn_radps)
    )
    forward, left = forward_mps / body.speed_full_mps, left_mps / body.speed_full_mps
    if body.wheelbase_m is None:
        return within_full_scale(forward, left, turn_radps / body.turn_full_radps)
    if left_mps:
        raise Unsupported("cmd_vel: linear.y: a robot that steers does not move sideways")
    if turn_radps and not forward_mps:
        raise Unsupported("cmd_vel: angular.z without linear.x: a robot that steers does not turn on the spot")
    angle = math.atan(body.wheelbase_m * turn_radps / abs(forward_mps)) if forward_mps else 0.0
    return Drive(forward=_held(forward), turn=_held(angle / body.steer_full_rad))


def _held(value: float) -> float:
    return max(-1.0, min(1.0, value))
