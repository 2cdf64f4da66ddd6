"""Names of topics, types and nodes, as ROS writes them and as they stand in keys."""

from __future__ import annotations

import re

_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(rf"(/{_TOKEN})+")
_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
_DDS = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]*)_")
_OUTSIDE = re.compile(r"[^A-Za-z0-9_]")


def is_ros_name(name: str) -> bool:
    """Tell whether this is the full name of a topic, a service or a namespace: ``/r1/scan``."""
    return _NAME.fullmatch(name) is not None


def ros_name(name: str) -> str:
    """Write any name as one part of a ROS name: letters, digits and ``_``, no digit first, empty as ``_``.

    Different names may give the same part: who writes several has to look.
    """
    part = _OUTSIDE.sub("_", name)
    return part if part and not part[0].isdigit() else f"_{part}"


def dds_type(ros_type: str) -> str:
    """Write a type as it stands in keys: ``sensor_msgs::msg::dds_::Imu_`` of ``sensor_msgs/msg/Imu``; or ValueError."""
    match = _TYPE.fullmatch(ros_type)
    if match is None:
        raise ValueError(f"type {ros_type!r}: expected package/msg/Name")
    package, kind, name = match.groups()
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds_type: str) -> str | None:
    """Read a type as it stands in keys; None where it is none."""
    match = _DDS.fullmatch(dds_type)
    return "/".join(match.groups()) if match is not None else None


def topic_key(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """Write the key of a topic or service. name: ``/r1/scan``; type_name: ``sensor_msgs/msg/LaserScan``."""
    return f"{domain}/{name.strip('/')}/{dds_type(type_name)}/{type_hash}"
