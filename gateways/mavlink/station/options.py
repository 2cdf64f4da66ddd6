"""The settings of a listener for ground stations."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from zbridge.protocol import Positive

SystemId = Annotated[int, msgspec.Meta(ge=1, le=250)]


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the origin of the robot's map is. latitude, longitude: degrees. altitude: m. compass: of +x, degrees."""

    latitude: Annotated[float, msgspec.Meta(ge=-85, le=85)]
    longitude: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    altitude: Annotated[float, msgspec.Meta(ge=-1000, le=10_000)] = 0.0
    compass: Annotated[float, msgspec.Meta(ge=0, le=360)] = 90.0


class MavlinkHqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[hq]] options`` of this protocol; the template of ``zbridge init`` explains each.

    system_id has no default: ground stations take two robots with one id for one.
    """

    system_id: SystemId
    kind: Literal["rover", "boat"] = "rover"
    speed_full_m_s: Positive = 1.0
    turn_full_rad_s: Positive = 1.0
    origin: Origin | None = None
    dead: Annotated[int, msgspec.Meta(ge=0, le=400)] = 60
    stale_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.0

    @property
    def compass_rad(self) -> float:
        """Return the compass direction of the map's +x, clockwise from north; east without an origin."""
        return math.radians(self.origin.compass if self.origin is not None else 90.0)
