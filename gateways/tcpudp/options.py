"""Options of this protocol in a configuration: of a robot, and of a listener for HQ programs. Sans-IO."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from gateways.tcpudp.session.robot_role import CLIENT_PORT
from gateways.tcpudp.settings import ANNOUNCED
from zbridge.protocol import Positive

NAME = "tcpudp"

FeatureName = Literal["udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"]
PacketId = Annotated[int, msgspec.Meta(ge=0, le=255)]
Angle = Annotated[float, msgspec.Meta(ge=-7, le=7)]
Length = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]


class TcpUdpOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device] options`` of this protocol; the template of ``zbridge init`` explains each."""

    udp: bool = True
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=0.25)] = 0.01
    force: tuple[FeatureName | PacketId, ...] = ()
    announce: tuple[FeatureName, ...] = tuple(feature.value for feature in ANNOUNCED)
    combine: Literal["exclusive", "both"] = "exclusive"
    speed_full: Positive = 1.0
    turn_full: Positive = 1.0
    length_unit_m: Positive = 0.01
    heading_offset: Angle = math.pi / 2
    map_cell_m: Positive = 0.01
    map_origin: tuple[Length, Length] | None = None


VersionName = Literal["1.1", "1.2", "1.3", "1.4"]


class TcpUdpHqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[hq]] options`` of this protocol; the template of ``zbridge init`` explains each."""

    versions: Annotated[tuple[VersionName, ...], msgspec.Meta(min_length=1)] = ("1.1", "1.2", "1.3")
    udp: bool = True
    client_port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = CLIENT_PORT
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.01
    quiet_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 2.0
    known: tuple[PacketId, ...] = ()
    unasked: bool = False
    skip_map_flag: bool = False
    slam_map_size: Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)] = 1000
    slam_map_interval: Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)] = 10
    speed_full: Positive = 1.0
    turn_full: Positive = 1.0
    length_unit_m: Positive = 0.01
    heading_offset: Angle = math.pi / 2
    map_origin: tuple[Length, Length] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a map without cells."""
        if self.slam_map_size < self.slam_map_interval:
            raise ValueError("slam_map_size is smaller than slam_map_interval: a map of no cells")
