"""Options of WC2EC in a configuration: of a robot, and of a listener for external controllers. Sans-IO.

A robot's options name its devices, the meaning of their values, and its kinematics. Source: "Versions and dialects",
"Translation from the robot" and "Translation of commands" of the protocol page; the templates of ``zbridge init``
explain each option.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import msgspec

from gateways.wc2ec.devices import LIGHT
from zbridge.protocol import ConfigError, Differential, Factors, Positive

Byte = Annotated[int, msgspec.Meta(ge=0, le=255)]
Bearing = Annotated[float, msgspec.Meta(ge=-360, le=360)]
Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class DeviceOption(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A device of the draft dialect, which has no names on the wire.

    name: on the bus. number: the number on the wire. kind: of the device.
    """

    name: str
    number: Byte
    kind: str = LIGHT


class WheelMotors(Differential, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Two sides of wheels: how a drive moves the robot.

    left, right: names of the motors. wheel_radius_m: radius of the wheels.
    """

    left: tuple[str, ...]
    right: tuple[str, ...]
    wheel_radius_m: Positive


class MotorTypes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Type bytes that are motors.

    rotational: type bytes of rotational motors. linear: type bytes of linear motors.
    """

    rotational: tuple[Byte, ...] = (53,)
    linear: tuple[Byte, ...] = (46,)


class MotorNames(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Names that are motors, whatever their type byte.

    rotational: names of rotational motors. linear: names of linear motors.
    """

    rotational: tuple[str, ...] = ()
    linear: tuple[str, ...] = ()


class Wc2EcOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device.options]``; the template of ``zbridge init`` explains each."""

    dialect: Literal["deployed", "draft"] = "deployed"
    devices: tuple[DeviceOption, ...] = ()
    motor_types: MotorTypes = MotorTypes()
    motors: MotorNames = MotorNames()
    differential: WheelMotors | None = None
    factors: dict[str, Factors] = {}
    bounds: dict[str, tuple[Number, Number]] = {}
    bounds_default: tuple[Number, Number] | None = None
    tables: dict[str, tuple[tuple[Number, Number], ...]] = {}
    bearings_deg: dict[str, Bearing] = {}
    scan_range_m: tuple[Number, Positive] = (0.0, 10.0)
    pinned: tuple[str, ...] = ()
    values: Annotated[int, msgspec.Meta(ge=0, le=255)] = 3

    def __post_init__(self) -> None:
        """Raise ConfigError for options that contradict each other."""
        require_devices(self.dialect, self.devices)
        unknown = sorted(set(self.pinned) - {device.name for device in self.devices})
        if unknown:
            raise ConfigError(f"pinned: {unknown[0]!r} is none of the devices")
        ranges = {"bounds_default": self.bounds_default, "scan_range_m": self.scan_range_m}
        ranges |= {f"bounds.{name}": bounds for name, bounds in self.bounds.items()}
        for name, pair in ranges.items():
            if pair is not None and pair[0] > pair[1]:
                raise ConfigError(f"{name} = {list(pair)}: expected the lower one first")
        if self.differential is not None and set(self.differential.left) & set(self.differential.right):
            raise ConfigError("differential: a motor on both sides")
        if self.differential is not None and self.factors:
            raise ConfigError("factors: either differential or factors")
        for name, table in self.tables.items():
            if len(table) < 2 or any(low[0] >= high[0] for low, high in pairwise(table)):
                raise ConfigError(f"tables.{name}: expected at least two pairs with rising first values")


def require_devices(dialect: str, devices: tuple[DeviceOption, ...]) -> None:
    """Raise ConfigError unless the draft, and it alone, lists its devices, each with a number and a name of its own."""
    if (dialect == "draft") is not bool(devices):
        raise ConfigError("devices: must be listed for the draft, which has no names, and for it alone")
    for field in ("number", "name"):
        if len({getattr(device, field) for device in devices}) < len(devices):
            raise ConfigError(f"devices: a {field} twice")


class Wheels(Differential, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The motors "left" and "right" that are shown of a robot without motors.

    wheel_radius_m: radius of the wheels. track_m: distance between the left and the right wheels.
    """

    wheel_radius_m: Positive = 0.05
    track_m: Positive = 0.3


class Wc2EcHqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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
