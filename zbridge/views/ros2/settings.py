"""What ``zbridge ros2`` is told on its command line and in its file, checked as a whole before anything starts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, TypeVar

import msgspec

from zbridge.bus import BusSettings
from zbridge.errors import ConfigError
from zbridge.fleet.topics import is_name
from zbridge.ros2 import DISTROS

T = TypeVar("T")

ROS_ROUTER = "tcp/localhost:7447"
"""Where ``ros2 run rmw_zenoh_cpp rmw_zenohd`` listens."""
Above = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]
Metres = Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a scanner or another sensor is on the robot: metres from the robot's middle on the ground, radians."""

    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.2
    yaw: Annotated[float, msgspec.Meta(ge=-math.tau, le=math.tau)] = 0.0


class Body(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What ROS has to know of a robot, and no robot of ours tells.

    speed_full_mps, turn_full_radps: its speeds at full scale. wheelbase_m: of a robot that steers, between its axles;
    None: it turns on the spot. steer_full_rad: how far its wheels turn at full lock; an ALF vehicle is told 90 degrees
    then. length_m, width_m, height_m: what RViz shows. sensors: where those of these names are, and the ``camera``; of
    others no frame is told. map_to_odom: tell ROS that odometry begins at the map's origin; false where a program of
    ROS's, as slam_toolbox, tells it.
    """

    speed_full_mps: Above = 1.0
    turn_full_radps: Above = 1.0
    wheelbase_m: Above | None = None
    steer_full_rad: Annotated[float, msgspec.Meta(gt=0.0, le=1.6)] = math.pi / 2
    length_m: Above = 0.4
    width_m: Above = 0.3
    height_m: Above = 0.2
    laser: Mount = Mount()
    sensors: dict[str, Mount] = {}
    map_to_odom: bool = True


class File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file, TOML. others: of robots that have no table of their own below ``robot``."""

    domain: int | None = None
    distro: str | None = None
    ros: tuple[str, ...] | None = None
    robots: tuple[str, ...] | None = None
    drive: bool | None = None
    realm: str | None = None
    bus: BusSettings | None = None
    others: Body = Body()
    robot: dict[str, Body] = {}


class Options(msgspec.Struct, frozen=True):
    """The options as they are given; None and empty: not given, the file's or the default."""

    domain: int | None = None
    distro: str | None = None
    ros: Sequence[str] = ()
    robots: Sequence[str] = ()
    drive: bool = False
    realm: str | None = None


class Plan(msgspec.Struct, frozen=True):
    """What the view starts from. robots: those that are shown, empty for all."""

    domain: int
    distro: str
    ros: BusSettings
    realm: str
    robots: frozenset[str]
    drive: bool
    others: Body
    bodies: Mapping[str, Body]

    def body(self, robot: str) -> Body:
        """Return what is known of a robot."""
        return self.bodies.get(robot, self.others)


def plan(options: Options, file: File) -> Plan:
    """Check the options and the file together; raise ConfigError, which names what is wrong."""
    domain = _first(options.domain, file.domain, 0)
    if not 0 <= domain <= 232:  # as DDS has it
        raise ConfigError(f"domain = {domain}: expected 0 to 232")
    distro = _first(options.distro, file.distro, "jazzy")
    if distro not in DISTROS:
        raise ConfigError(f"distro = {distro!r}: expected one of {', '.join(DISTROS)}")
    robots = frozenset(options.robots or file.robots or ())
    for name in sorted(robots | file.robot.keys()):
        if not is_name(name):
            raise ConfigError(f"robot {name!r}: expected letters, digits, '_', '.' and '-' only")
    connect = tuple(options.ros or file.ros or (ROS_ROUTER,))
    try:
        ros = msgspec.convert({"mode": "client", "connect": connect, "multicast": False}, BusSettings)
    except msgspec.ValidationError as error:
        raise ConfigError(f"ros = {list(connect)}: expected Zenoh endpoints like {ROS_ROUTER!r}") from error
    return Plan(
        domain=domain,
        distro=distro,
        ros=ros,
        realm=_first(options.realm, file.realm, "fleet"),
        robots=robots,
        drive=options.drive or bool(file.drive),
        others=file.others,
        bodies=file.robot,
    )


def _first(given: T | None, written: T | None, default: T) -> T:
    if given is not None:
        return given
    return written if written is not None else default
