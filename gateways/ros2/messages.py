"""The messages of a ROS 2 robot: those received, a class for each topic, and the velocities sent. Sans-IO.

The bodies of received messages are those of rosbags: fields as in the ``.msg`` files, arrays as numpy arrays.
"""

from __future__ import annotations

from typing import Any

import msgspec

from zbridge.protocol import KeyedSample
from zbridge.ros2.types import Types

TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
_NS_PER_S = 1_000_000_000


class LinkEvent(msgspec.Struct, frozen=True):
    """News of the link: it is open, a token appeared or is gone, samples were dropped, one of our own came back."""

    sample: KeyedSample


class Received(msgspec.Struct, frozen=True):
    """One message of a topic. body: of rosbags; ``stamp_ns`` of its header."""

    body: Any

    @property
    def stamp_ns(self) -> int:
        """The stamp of the header on the robot's clock, ns: Unix time, or the time of a simulation."""
        stamp = self.body.header.stamp
        return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


class LaserScan(Received, frozen=True):
    """sensor_msgs/msg/LaserScan."""


class Odometry(Received, frozen=True):
    """nav_msgs/msg/Odometry."""


class OccupancyGrid(Received, frozen=True):
    """nav_msgs/msg/OccupancyGrid."""


class Imu(Received, frozen=True):
    """sensor_msgs/msg/Imu."""


class BatteryState(Received, frozen=True):
    """sensor_msgs/msg/BatteryState."""


class CompressedImage(Received, frozen=True):
    """sensor_msgs/msg/CompressedImage."""


class TwistCommand(Received, frozen=True):
    """What another node wrote to the topic of commands: geometry_msgs/msg/Twist or TwistStamped."""


RECEIVED: dict[str, tuple[type[Received], str]] = {
    "scan": (LaserScan, "sensor_msgs/msg/LaserScan"),
    "odom": (Odometry, "nav_msgs/msg/Odometry"),
    "map": (OccupancyGrid, "nav_msgs/msg/OccupancyGrid"),
    "imu": (Imu, "sensor_msgs/msg/Imu"),
    "battery_state": (BatteryState, "sensor_msgs/msg/BatteryState"),
    "image": (CompressedImage, "sensor_msgs/msg/CompressedImage"),
}
"""For each option that names a topic: the class of its messages, and their type."""
TRANSIENT_LOCAL = frozenset({"map"})
"""Topics with the durability of the name: a late subscriber gets the last message."""
LIVE = (LaserScan, Odometry, Imu)
"""Messages that robots send as soon as they measure: their stamps are the robot's clock."""


class Velocity(msgspec.Struct, frozen=True):
    """The content of a Twist: m/s forward and to the left, rad/s counter-clockwise."""

    forward: float = 0.0
    left: float = 0.0
    turn: float = 0.0


STOPPED = Velocity()


def write_twist(types: Types, type_name: str, velocity: Velocity) -> bytes:
    """Write a velocity as CDR of one of the two types; the stamp of a TwistStamped is zero."""
    twist = {"linear": {"x": velocity.forward, "y": velocity.left}, "angular": {"z": velocity.turn}}
    if type_name == TWIST_STAMPED:
        return types.encode(types.message(TWIST_STAMPED, header={"frame_id": "base_link"}, twist=twist))
    return types.encode(types.message(TWIST, **twist))
