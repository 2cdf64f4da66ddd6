"""What a listener for external controllers can be told in a configuration."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from gateways.wc2ec.settings import Byte, DeviceOption, require_devices
from zbridge.protocol import Differential, Positive


class Wheels(Differential, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The two sides of wheels that are shown of a robot without motors."""

    wheel_radius_m: Positive = 0.05
    track_m: Positive = 0.3


class HqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[hq]] options`` of this protocol; the template of ``zbridge init`` explains each."""

    dialect: Literal["deployed", "draft"] = "deployed"
    hold: bool = True
    join_s: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.03
    sectors: Annotated[int, msgspec.Meta(ge=1, le=128)] = 8
    sector_unit_m: Positive = 1.0
    wheels: Wheels = Wheels()
    distance_type: Byte = 37
    rotational_type: Byte = 53
    linear_type: Byte = 46
    devices: tuple[DeviceOption, ...] = ()
    values: Byte = 3

    def __post_init__(self) -> None:
        """Raise ConfigError for options that contradict each other."""
        require_devices(self.dialect, self.devices)
