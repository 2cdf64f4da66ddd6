"""The names of a robot's frames, after REP 105. Sans-IO."""

from __future__ import annotations

import msgspec

from zbridge.ros2 import ros_name


class Frames(msgspec.Struct, frozen=True):
    """The names of one robot's frames. prefix: the robot, as a part of a ROS name."""

    prefix: str

    @property
    def map(self) -> str:
        """The robot's map."""
        return f"{self.prefix}/map"

    @property
    def odom(self) -> str:
        """Where odometry counts from."""
        return f"{self.prefix}/odom"

    @property
    def base(self) -> str:
        """The robot, on the ground."""
        return f"{self.prefix}/base_link"

    @property
    def camera(self) -> str:
        """The camera."""
        return f"{self.prefix}/camera"

    @property
    def laser(self) -> str:
        """The scanner."""
        return f"{self.prefix}/laser"

    def sensor(self, name: str) -> str:
        """Name the frame of a sensor."""
        return f"{self.prefix}/{ros_name(name)}"
