"""Commands of a ROS 2 robot: velocities as Twist and TwistStamped. Sans-IO."""

from __future__ import annotations

import msgspec

from gateways.ros2.messages import TWIST, TWIST_STAMPED
from zbridge.ros2 import Types


class Velocity(msgspec.Struct, frozen=True):
    """What a Twist says: m/s forward and to the left, rad/s counter-clockwise."""

    forward: float = 0.0
    left: float = 0.0
    turn: float = 0.0


REST = Velocity()


def write_twist(types: Types, type_name: str, velocity: Velocity) -> bytes:
    """Write a velocity as CDR of one of the two types; the stamp of a TwistStamped is zero."""
    linear = types.message("geometry_msgs/msg/Vector3", x=velocity.forward, y=velocity.left)
    angular = types.message("geometry_msgs/msg/Vector3", z=velocity.turn)
    twist = types.message(TWIST, linear=linear, angular=angular)
    if type_name == TWIST_STAMPED:
        header = types.message("std_msgs/msg/Header", frame_id="base_link")
        twist = types.message(TWIST_STAMPED, header=header, twist=twist)
    return types.encode(twist)
