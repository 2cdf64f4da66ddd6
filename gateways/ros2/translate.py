"""Translates between ROS messages and fleet messages, both ways: one ROS 2 robot. Sans-IO.

Both sides have SI units and axes after REP 103; what differs is full scale, and what is not valid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from gateways.ros2.messages import (
    STOPPED,
    BatteryState,
    CompressedImage,
    Imu,
    LaserScan,
    OccupancyGrid,
    Odometry,
    Received,
    Velocity,
)
from gateways.ros2.options import RosOptions
from gateways.ros2.session import RosRole
from zbridge.fleet import topics
from zbridge.fleet.messages import Battery, Drive, FleetMessage, Image, Map, Motion, Pose, Scan, Scanner
from zbridge.fleet.topics import Topic
from zbridge.protocol import (
    Metrics,
    NotReady,
    Outcome,
    ProtocolError,
    RobotSide,
    Telemetry,
    Translate,
    Unsupported,
)
from zbridge.ros2.types import types_of

OLDEST_NS = 1_000_000_000
"""A stamp is believed if it is at most this much before its arrival."""
AHEAD_NS = 100_000_000
"""A stamp that is this much after its arrival is from a clock that is wrong, and is counted."""
MOST_POINTS = 100_000
MOST_CELLS = 16_000_000
MOST_IMAGE_BYTES = 4 * 2**20
FREE_BELOW, OCCUPIED_FROM = 25, 65
"""Percents of occupancy, as ROS's map_saver has them; between them a cell is unknown."""
_UNKNOWN, _FREE, _OCCUPIED = 0, 1, 2
_FAR_M = 1e6
_LARGEST = 1e9
_LEVEL_RAD = 1e-3
_NS_PER_MS = 1_000_000


class RosRobot(RobotSide):
    """One ROS 2 robot: the nodes on the other side of its router."""

    driving: RosRole | None = None
    link_names = ("router",)
    closing_harmless = True

    def __init__(self, options: RosOptions, links: int = 1, metrics: Metrics | None = None) -> None:
        metrics = metrics or Metrics()
        self.options = options
        self._types = types_of(options.distro)
        self.dialect = options.distro  # type: ignore[misc]
        self._geometry: tuple[float, ...] = ()
        """Of the last scanner that was shown."""
        self._known: dict[str, FleetMessage] = {}
        self._speed: float | None = None
        self._has_imu = False
        self._ahead = metrics.count("stamps_ahead", help="Time stamps after their arrival; the arrival is used.")
        self._astray = metrics.count("stamps_astray", help="Time stamps that are too old; the arrival is used.")
        self._overruled = metrics.count("commands_overruled", help="Commands of other nodes that were overruled.")

    def session(self, link: str, peer: str) -> RosRole:
        self.driving = RosRole(self.options, self._types, self._overruled)
        self._geometry, self._speed, self._has_imu = (), None, False
        self._known.clear()
        return self.driving

    # Messages to telemetry

    def translator(self, kind: type) -> Translate:
        return partial(_TELEMETRY[kind], self)

    def _scan(self, message: LaserScan, stamp_ns: int) -> tuple[Telemetry, ...]:
        body, yaw = message.body, math.radians(self.options.scan_yaw_deg)
        ranges = np.array(body.ranges, np.float32)
        count, increment = len(ranges), float(body.angle_increment)
        first, low, high = float(body.angle_min) + yaw, float(body.range_min), float(body.range_max)
        _require(0 < count <= MOST_POINTS, f"scan of {count} points")
        _require(_finite(first, low, increment) and abs(first) < 1e3, f"scan from {first:g} in steps of {increment:g}")
        _require(count == 1 or 1e-6 < abs(increment) * count < 100.0, f"scan of {count} points every {increment:g} rad")
        _require(0 <= low < high, f"scan of ranges {low:g} to {high:g} m")
        high = min(high, _FAR_M)
        if increment < 0:  # the lidar hangs upside down, or turns clockwise
            first, increment, ranges = first + increment * (count - 1), -increment, ranges[::-1].copy()
        with np.errstate(invalid="ignore"):
            ranges[~((ranges >= low) & (ranges <= high))] = np.nan
        stamp, device_ms = self._stamps(message, stamp_ns)
        scan = Scan(first, increment, low, high, ranges, stamp_ns=stamp, device_ms=device_ms)
        geometry = (first, first + increment * (count - 1), increment, float(body.time_increment), low, high, count)
        if self._geometry == geometry:
            return ((topics.SCAN, scan),)
        _require(math.isfinite(geometry[3]), "scan with a time increment that is no number")
        self._geometry = geometry
        return ((topics.SCANNER, Scanner(*geometry, stamp_ns=stamp)), (topics.SCAN, scan))

    def _odometry(self, message: Odometry, stamp_ns: int) -> tuple[Telemetry, ...]:
        at, q = message.body.pose.pose.position, message.body.pose.pose.orientation
        linear, angular = message.body.twist.twist.linear, message.body.twist.twist.angular
        heading = _yaw(q)
        _require(_finite(at.x, at.y, linear.x, angular.z), "odometry that is no number")
        stamp, device_ms = self._stamps(message, stamp_ns)
        pose = Pose(float(at.x), float(at.y), heading, stamp_ns=stamp, device_ms=device_ms)
        self._speed = max(-1.0, min(1.0, float(linear.x) / self.options.speed_full_mps))
        shown: list[Telemetry] = [(topics.POSE, pose)]
        if not self._has_imu:
            gyro = (0.0, 0.0, float(angular.z))
            shown.append((topics.MOTION, Motion(self._speed, gyro=gyro, stamp_ns=stamp, device_ms=device_ms)))
        return self._keep(shown)

    def _imu(self, message: Imu, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Acceleration and gyro; a covariance that begins with -1 says that there is no such measurement."""
        body = message.body
        acceleration = _vector(body.linear_acceleration, body.linear_acceleration_covariance)
        gyro = _vector(body.angular_velocity, body.angular_velocity_covariance)
        stamp, device_ms = self._stamps(message, stamp_ns)
        self._has_imu = True
        return ((topics.MOTION, Motion(self._speed, acceleration, gyro, stamp_ns=stamp, device_ms=device_ms)),)

    def _map(self, message: OccupancyGrid, stamp_ns: int) -> tuple[Telemetry, ...]:
        info = message.body.info
        rows, columns, cell = int(info.height), int(info.width), float(info.resolution)
        x, y = float(info.origin.position.x), float(info.origin.position.y)
        percents = np.asarray(message.body.data, np.int8)
        _require(rows * columns == len(percents) <= MOST_CELLS, f"map of {rows} x {columns}: {len(percents)} cells")
        _require(_finite(cell, x, y) and cell > 0, f"map of cells of {cell:g} m at {x:g}, {y:g}")
        _require(abs(_yaw(info.origin.orientation)) < _LEVEL_RAD, "a map that is turned")
        cells = np.full(len(percents), _UNKNOWN, np.uint8)
        cells[(percents >= 0) & (percents <= FREE_BELOW)] = _FREE
        cells[percents >= OCCUPIED_FROM] = _OCCUPIED
        return self._keep(
            [(topics.MAP, Map(rows, columns, cell, (x, y), cells.reshape(rows, columns), stamp_ns=stamp_ns))]
        )

    def _battery(self, message: BatteryState, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Translate a battery. An unknown value is NaN; the states of charging are the message's constants."""
        body = message.body
        level, charging = _known(body.percentage), _CHARGING.get(int(body.power_supply_status))
        _require(level is None or 0.0 <= level <= 1.0, f"a battery that is {level} full")
        stamp, device_ms = self._stamps(message, stamp_ns)
        voltage, current = _known(body.voltage), _known(body.current)
        battery = Battery(level, voltage, current, charging, stamp_ns=stamp, device_ms=device_ms)
        return ((topics.BATTERY, battery),)

    def _image(self, message: CompressedImage, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Translate an image whose format may say more than its name: ``rgb8; jpeg compressed bgr8``."""
        words = str(message.body.format).lower()
        found = next((name for word, name in _FORMATS if word in words), None)
        if found is None:
            raise ProtocolError(f"an image as {words[:40]!r}")
        _require(len(message.body.data) <= MOST_IMAGE_BYTES, f"an image of {len(message.body.data)} bytes")
        stamp, device_ms = self._stamps(message, stamp_ns)
        image = Image(found, message.body.data.tobytes(), stamp_ns=stamp, device_ms=device_ms)
        return ((topics.IMAGE, image),)

    def _keep(self, shown: list[Telemetry]) -> tuple[Telemetry, ...]:
        """Remember the answers to queries."""
        self._known |= {topic.path: message for topic, message in shown}
        return tuple(shown)

    def _stamps(self, message: Received, arrived_ns: int) -> tuple[int, int]:
        """Return the time of measurement on the gateway's clock, and the robot's own time in ms.

        The robot's clock may be simulated, wrong, or jump: a stamp that does not fit the arrival is not used.
        """
        stamp_ns = message.stamp_ns
        device_ms = max(0, stamp_ns // _NS_PER_MS)
        if arrived_ns - OLDEST_NS <= stamp_ns <= arrived_ns:
            return stamp_ns, device_ms
        if stamp_ns > arrived_ns + AHEAD_NS:
            self._ahead.value += 1
        elif stamp_ns < arrived_ns:
            self._astray.value += 1
        return arrived_ns, device_ms

    # Commands to messages

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if not isinstance(command, Drive):
            raise Unsupported("a ROS 2 robot takes drives only")
        if command.left and not self.options.sideways and not (command.forward or command.turn):
            raise Unsupported("left: this robot does not move sideways")
        options = self.options
        velocity = Velocity(
            command.forward * options.speed_full_mps,
            command.left * options.speed_full_mps if options.sideways else 0.0,
            command.turn * options.turn_full_radps,
        )
        self._connected().drive(velocity, now)
        left_out = ["left"] if command.left and not options.sideways else []
        left_out += ["light"] if command.light is not None else []
        return Outcome(left_out=f"{' and '.join(left_out)}: this robot has none" if left_out else None)

    def stop(self, now: float, until: float) -> None:
        session = self._connected()
        if self.options.shared and until <= now and not session.moving:
            return  # another node may be driving it
        session.drive(STOPPED, now, until=until, urgent=True)

    def ask(self, topic: Topic) -> None:
        raise Unsupported(f"a ROS 2 robot cannot be asked for its {topic.path}")

    def known(self, topic: Topic) -> FleetMessage | None:
        return self._known.get(topic.path)

    def _connected(self) -> RosRole:
        if self.driving is None or self.driving.over:
            raise NotReady("offline")
        return self.driving


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise ProtocolError(otherwise)


def _finite(*values: float) -> bool:
    return all(math.isfinite(value) and abs(value) <= _LARGEST for value in values)


def _yaw(q: Any) -> float:
    """Return the heading of a quaternion; raise ProtocolError for one that is no rotation. All zeros: none."""
    if not _finite(q.x, q.y, q.z, q.w):
        raise ProtocolError("an orientation that is no number")
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _vector(vector: Any, covariance: Any) -> tuple[float, float, float] | None:
    if covariance[0] == -1.0:
        return None
    x, y, z = float(vector.x), float(vector.y), float(vector.z)
    _require(_finite(x, y, z), "an imu that measures no numbers")
    return x, y, z


def _known(value: float) -> float | None:
    return float(value) if _finite(value) else None


_CHARGING = {1: True, 2: False, 3: False, 4: False}
"""power_supply_status: charging, discharging, not charging, full; 0 is unknown."""
_FORMATS = (("jpeg", "jpeg"), ("jpg", "jpeg"), ("png", "png"))
_TELEMETRY: dict[type[Received], Callable[[RosRobot, Any, int], tuple[Telemetry, ...]]] = {
    LaserScan: RosRobot._scan,
    Odometry: RosRobot._odometry,
    Imu: RosRobot._imu,
    OccupancyGrid: RosRobot._map,
    BatteryState: RosRobot._battery,
    CompressedImage: RosRobot._image,
}
