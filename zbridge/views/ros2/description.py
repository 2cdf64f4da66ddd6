"""The names of the frames of a robot, after REP 105, and a minimal URDF of its configured size. Sans-IO."""

from __future__ import annotations

import msgspec

from zbridge.ros2 import ros_name
from zbridge.views.ros2.settings import RobotBody


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


_LASER_M = 0.05
"""Radius and height of what is drawn for a scanner."""


def urdf(robot: str, frames: Frames, body: RobotBody) -> str:
    """Write a box on the ground, and a cylinder where the scanner is. Frames have the robot's prefix."""
    laser = body.laser
    return f"""<?xml version="1.0"?>
<robot name="{robot}">
  <link name="{frames.base}">
    <visual>
      <origin xyz="0 0 {body.height_m / 2:g}"/>
      <geometry><box size="{body.length_m:g} {body.width_m:g} {body.height_m:g}"/></geometry>
      <material name="body"><color rgba="0.2 0.4 0.8 1"/></material>
    </visual>
  </link>
  <link name="{frames.laser}">
    <visual>
      <geometry><cylinder radius="{_LASER_M}" length="{_LASER_M}"/></geometry>
      <material name="laser"><color rgba="0.1 0.1 0.1 1"/></material>
    </visual>
  </link>
  <joint name="{frames.laser}_joint" type="fixed">
    <parent link="{frames.base}"/>
    <child link="{frames.laser}"/>
    <origin xyz="{laser.x:g} {laser.y:g} {laser.z:g}" rpy="0 0 {laser.yaw:g}"/>
  </joint>
</robot>
"""
