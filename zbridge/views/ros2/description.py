"""The names of the frames of a robot, after REP 105, and a minimal URDF of its configured size. Sans-IO."""

from __future__ import annotations

from zbridge.ros2 import ros_name
from zbridge.views.ros2.settings import RobotBody


class Frames:
    """The names of one robot's frames. prefix: the robot, as a part of a ROS name.

    odom: where odometry counts from; base: the robot, on the ground; laser: the scanner.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.map, self.odom = f"{prefix}/map", f"{prefix}/odom"
        self.camera, self.laser = f"{prefix}/camera", f"{prefix}/laser"
        self.base = f"{prefix}/base_link"

    def __repr__(self) -> str:
        return f"<Frames of {self.prefix}>"

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
