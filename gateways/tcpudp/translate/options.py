"""``[device] options`` of this protocol, and the kinds of values that listeners of it share. Sans-IO."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from gateways.tcpudp.versions import ANNOUNCED

NAME = "tcpudp"

FeatureName = Literal["udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"]
PacketId = Annotated[int, msgspec.Meta(ge=0, le=255)]
Scale = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
Angle = Annotated[float, msgspec.Meta(ge=-7, le=7)]
Length = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device] options`` of this protocol; the template of ``zbridge init`` explains each."""

    udp: bool = True
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=0.25)] = 0.01
    force: tuple[FeatureName | PacketId, ...] = ()
    announce: tuple[FeatureName, ...] = tuple(feature.value for feature in ANNOUNCED)
    combine: Literal["exclusive", "both"] = "exclusive"
    speed_full: Scale = 1.0
    turn_full: Scale = 1.0
    length_unit_m: Scale = 0.01
    heading_offset: Angle = math.pi / 2
    map_cell_m: Scale = 0.01
    map_origin: tuple[Length, Length] | None = None
