"""``[device.options]`` of a rover. Sans-IO."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from gateways.mavlink.numbers import RoverMode
from zbridge.protocol import Positive

SystemId = Annotated[int, msgspec.Meta(ge=1, le=255)]
Rate = Annotated[float, msgspec.Meta(ge=0, le=50)]
SLOWEST_HZ = 0.01
"""Of a stream that is asked for: the interval is a float, and a vehicle counts it in µs as an integer of 32 bits."""


class RoverOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The template of ``zbridge init`` explains each."""

    system_id: SystemId = 255
    component_id: SystemId = 190
    vehicle_id: SystemId | None = None
    drive: Literal["guided", "manual"] = "guided"
    arm: Literal["operator", "drive"] = "operator"
    speed_full_m_s: Positive = 1.0
    turn_full_rad_s: Positive = 1.0
    position_hz: Rate = 5.0
    ranges_hz: Rate = 5.0
    status_hz: Rate = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError for a rate that is neither 0 nor one a vehicle knows."""
        if any(0 < rate < SLOWEST_HZ for rate in (self.position_hz, self.ranges_hz, self.status_hz)):
            raise ValueError(f"position_hz, ranges_hz, status_hz: expected 0, or at least {SLOWEST_HZ:g}")

    @property
    def mode(self) -> RoverMode:
        """The mode in which the gateway drives."""
        return RoverMode.MANUAL if self.drive == "manual" else RoverMode.GUIDED
