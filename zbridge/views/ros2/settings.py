"""The settings of ``zbridge ros2``, checked as a whole before anything starts."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from zbridge.bus import BusSettings
from zbridge.errors import ConfigError, LinkError
from zbridge.fleet.topics import is_name
from zbridge.protocol.address import Address
from zbridge.ros2.types import DISTROS

ROS_ROUTER = "tcp/localhost:7447"
"""Where ``ros2 run rmw_zenoh_cpp rmw_zenohd`` listens."""
Above = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]
Metres = Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a scanner or another sensor is on the robot.

    x, y, z: metres from the robot's middle on the ground. yaw: radians.
    """

    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.2
    yaw: Annotated[float, msgspec.Meta(ge=-math.tau, le=math.tau)] = 0.0


class RobotBody(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What ROS has to know of a robot, and robots do not report.

    speed_full_mps, turn_full_radps: its speeds at full scale. wheelbase_m: of a robot that steers, between its axles;
    absent: it turns on the spot. steer_full_rad: how far its wheels turn at full lock; an ALF vehicle gets 90 degrees
    then. length_m, width_m, height_m: what RViz shows. laser: where the scanner is. sensors: where those of these
    names are, and the ``camera``; of others no frame is told. map_to_odom: tell ROS that odometry begins at the map's
    origin; false where a program of ROS's, as slam_toolbox, tells it.
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


class Ros2Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file, TOML; options win over it.

    domain: ROS_DOMAIN_ID. distro: distribution of ROS 2. ros: ROS's routers, never the fleet's; empty: the one on this
    machine. robots: those that are shown, empty for all. drive: let publishers drive. realm: the first chunk of all
    keys. bus: as in a robot's file. metrics: host:port at which Prometheus
    reads; empty: none. others: of robots that have no table of their own below ``robot``.
    robot: tables of single robots.
    """

    domain: int = 0
    distro: str = "jazzy"
    ros: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    drive: bool = False
    realm: str = "fleet"
    bus: BusSettings | None = None
    metrics: str = ""
    others: RobotBody = RobotBody()
    robot: dict[str, RobotBody] = {}

    def body(self, robot: str) -> RobotBody:
        return self.robot.get(robot, self.others)


class Ros2Plan(Ros2Settings, frozen=True):
    """Settings that are sound. router: how ROS's router is reached. endpoint: of the metrics."""

    router: BusSettings = BusSettings()
    endpoint: Address | None = None


def plan(settings: Ros2Settings) -> Ros2Plan:
    """Check the settings; raise ConfigError, which names what is wrong."""
    if not 0 <= settings.domain <= 232:  # as DDS has it
        raise ConfigError(f"domain = {settings.domain}: expected 0 to 232")
    if settings.distro not in DISTROS:
        raise ConfigError(f"distro = {settings.distro!r}: expected one of {', '.join(DISTROS)}")
    for name in sorted({*settings.robots, *settings.robot}):
        if not is_name(name):
            raise ConfigError(f"robot {name!r}: expected letters, digits, '_', '.' and '-' only")
    try:
        metrics = Address.parse(f"tcp://{settings.metrics}") if settings.metrics else None
    except LinkError as error:
        raise ConfigError(f"metrics = {settings.metrics!r}: expected host:port") from error
    connect = settings.ros or (ROS_ROUTER,)
    try:
        router = msgspec.convert({"mode": "client", "connect": connect, "multicast": False}, BusSettings)
    except msgspec.ValidationError as error:
        raise ConfigError(f"ros = {list(connect)}: expected Zenoh endpoints like {ROS_ROUTER!r}") from error
    return Ros2Plan(**msgspec.structs.asdict(settings), router=router, endpoint=metrics)
