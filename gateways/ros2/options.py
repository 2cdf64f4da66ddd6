"""``[device.options]`` of a ROS 2 robot: where its topics are, and what full scale means. Sans-IO."""

from __future__ import annotations

from typing import Annotated

import msgspec

from gateways.ros2.messages import RECEIVED
from zbridge.protocol import ConfigError, Positive
from zbridge.ros2.rmw_zenoh import is_ros_name
from zbridge.ros2.types import DISTROS


class RosOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device.options]``; the template of ``zbridge init`` explains each. A topic ``""`` is not used."""

    namespace: str = ""
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    distro: str = "jazzy"
    scan: str = "scan"
    odom: str = "odom"
    map: str = "map"
    imu: str = "imu"
    battery_state: str = "battery_state"
    image: str = "image/compressed"
    cmd_vel: str = "cmd_vel"
    cmd_vel_hz: Annotated[float, msgspec.Meta(ge=1, le=100)] = 10.0
    speed_full_mps: Positive = 0.5
    turn_full_radps: Positive = 1.0
    sideways: bool = False
    shared: bool = False
    scan_yaw_deg: Annotated[float, msgspec.Meta(ge=-360, le=360)] = 0.0
    silent_s: Annotated[float, msgspec.Meta(ge=0.5, le=60)] = 2.0

    def __post_init__(self) -> None:
        """Raise ConfigError for names that ROS does not have, and for an unknown distribution."""
        if self.distro not in DISTROS:
            raise ConfigError(f"distro = {self.distro!r}: expected one of {', '.join(DISTROS)}")
        if self.namespace.strip("/") and not is_ros_name(self.full_namespace):
            raise ConfigError(f"namespace = {self.namespace!r}: expected a name like '/r1'")
        names = {option: self.topic(option) for option in (*RECEIVED, "cmd_vel")}
        for option, name in names.items():
            if name is not None and not is_ros_name(name):
                raise ConfigError(f"{option} = {getattr(self, option)!r}: expected a name like {option!r}")
        used = [name for name in names.values() if name is not None]
        if len(set(used)) < len(used):
            raise ConfigError(f"{', '.join(used)}: expected a topic of its own for each")
        if not any(names[option] for option in RECEIVED):
            raise ConfigError("scan, odom ...: expected at least one topic, which shows that the robot is there")

    @property
    def full_namespace(self) -> str:
        """The namespace as ROS writes it: ``/r1``, or ``/``."""
        return f"/{self.namespace.strip('/')}"

    def topic(self, option: str) -> str | None:
        """Return the full name of a topic, ``/r1/scan``; None if it is not used. One with ``/`` first is full."""
        name: str = getattr(self, option)
        if not name:
            return None
        return name if name.startswith("/") else f"{self.full_namespace.rstrip('/')}/{name}"
