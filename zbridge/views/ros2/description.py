"""A minimal URDF of a robot's configured size, so that RViz shows something. Sans-IO."""

from __future__ import annotations

from zbridge.views.ros2.frames import Frames
from zbridge.views.ros2.settings import Body

_LASER_M = 0.05
"""Radius and height of what is drawn for a scanner."""


def urdf(robot: str, frames: Frames, body: Body) -> str:
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
