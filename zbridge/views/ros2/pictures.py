"""What a robot's fleet messages are on ROS's side: which topics there are, and what is put on them. Sans-IO."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from typing import Any

import msgspec

from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Battery,
    Control,
    Device,
    FleetMessage,
    Image,
    Map,
    Motion,
    Pose,
    Reading,
    Scan,
    Scanner,
    Status,
)
from zbridge.fleet.payload import measured_ns
from zbridge.metrics import Metrics
from zbridge.protocol.kinematics import Odometry
from zbridge.ros2.rmw_zenoh import KEEP_LAST_10, LATCHED, SENSOR_DATA, RosQoS, ros_name
from zbridge.ros2.types import Types
from zbridge.views.ros2.diagnostics import Diagnostic, entries_of
from zbridge.views.ros2.settings import RobotBody
from zbridge.views.ros2.shapes import Frames, Shapes, Speeds, header, speeds_of, urdf

LONGEST_S = 3.0
"""Nothing is added up over a longer pause: nobody knows what happened."""
SPREAD_PER_M = 4.0
"""The variance of the result grows by so many times that of a pose with each metre or radian."""


class Reckoning:
    """Adds up from the first motion on. spread: how many times larger the variance is than that of a pose."""

    def __init__(self) -> None:
        self.pose = Pose(0.0, 0.0, 0.0)
        self.spread = 1.0
        self._odometry = Odometry(1.0)
        self._at_ns: int | None = None

    def __repr__(self) -> str:
        return f"<Reckoning {self.pose.x:.2f} {self.pose.y:.2f} {self.pose.heading:.2f}>"

    def add(self, speeds: Speeds, stamp_ns: int) -> Pose | None:
        """Add a motion that was measured at ``stamp_ns``; None if it has no speed or no turn rate."""
        if speeds.forward_mps is None or speeds.turn_radps is None:
            return None
        before, self._at_ns = self._at_ns, stamp_ns
        passed_s = (stamp_ns - before) / 1e9 if before is not None else 0.0
        if 0.0 < passed_s <= LONGEST_S:
            way, turned = speeds.forward_mps * passed_s, speeds.turn_radps * passed_s
            self.pose = self._odometry.moved(way, turned, stamp_ns)
            self.spread = min(self.spread + SPREAD_PER_M * (abs(way) + abs(turned)), 1e6)
        return self.pose


SENSORS = "sensor/*"
"""The readings of all sensors, as a path below a robot."""
MOST_SENSORS = 64
"""Sensors of one robot that have a topic."""
AHEAD_NS = 1_000_000_000
"""A stamp may be so far ahead of our clock: clocks of machines differ. A later one becomes now, counted."""
_END_NS = (2**31 - 1) * 1_000_000_000
"""From here on ROS has no number for a second."""
_LONGEST_PERIOD_S = 10.0
_KINDS = {"distance": "range", "rotational": "joint", "linear": "joint"}


class RosTopic(msgspec.Struct, frozen=True):
    """A topic that a robot's node publishes. name: below the robot; paths: below the robot, on the fleet's bus.

    everywhere: it is also published without the robot's name, where ROS's programs look for it.
    """

    name: str
    type_name: str
    qos: RosQoS = KEEP_LAST_10
    paths: tuple[str, ...] = ()
    everywhere: bool = False


TOPICS = (
    RosTopic("scan", "sensor_msgs/msg/LaserScan", SENSOR_DATA, (topics.SCAN.path, topics.SCANNER.path)),
    RosTopic("odom", "nav_msgs/msg/Odometry", KEEP_LAST_10, (topics.POSE.path, topics.MOTION.path)),
    RosTopic("pose", "geometry_msgs/msg/PoseStamped", KEEP_LAST_10, (topics.POSE.path,)),
    RosTopic("imu", "sensor_msgs/msg/Imu", SENSOR_DATA, (topics.MOTION.path,)),
    RosTopic("battery_state", "sensor_msgs/msg/BatteryState", KEEP_LAST_10, (topics.BATTERY.path,)),
    RosTopic("image/compressed", "sensor_msgs/msg/CompressedImage", SENSOR_DATA, (topics.IMAGE.path,)),
    RosTopic("map", "nav_msgs/msg/OccupancyGrid", LATCHED, (topics.MAP.path,)),
    RosTopic("tf", "tf2_msgs/msg/TFMessage", RosQoS(depth=100), (topics.POSE.path, topics.MOTION.path), True),
    RosTopic("tf_static", "tf2_msgs/msg/TFMessage", LATCHED, (), True),
    RosTopic(
        "diagnostics",
        "diagnostic_msgs/msg/DiagnosticArray",
        KEEP_LAST_10,
        (topics.STATUS.path, topics.CONTROL.path),
        True,
    ),
    RosTopic("robot_description", "std_msgs/msg/String", LATCHED),
)
"""The topics of every robot; those of its sensors are found in its table of devices."""
JOINTS = RosTopic("joint_states", "sensor_msgs/msg/JointState", KEEP_LAST_10, (SENSORS,))

Made = Iterator[tuple[str, Any]]
"""Names of topics and the ROS messages for them."""


class RosPictures:
    """Makes the ROS messages of one robot: all of a topic that somebody listens to."""

    def __init__(self, robot: str, types: Types, body: RobotBody, metrics: Metrics) -> None:
        self.robot = robot
        self.frames = Frames(ros_name(robot))
        self._types = types
        self._body = body
        self._shapes = Shapes(types, self.frames)
        self._clamped = metrics.count("ros2_stamps_clamped")
        self._unusable = metrics.count("ros2_unusable")
        self._motion: Motion | None = None
        self._has_pose = False
        self._reckoning = Reckoning()
        self._scan_at_ns: int | None = None
        self._states: dict[type, Any] = {}
        """The last Scanner, Status and Control."""
        self._positions: dict[str, float] = {}
        self._names: dict[str, str] = {}

    def sensors(self, devices: tuple[Device, ...]) -> list[RosTopic]:
        """Return the topics of a robot's sensors; names that are one in ROS have one topic."""
        found: dict[str, RosTopic] = {}
        self._names = {}
        for device in devices:
            kind = _KINDS.get(device.kind)
            if kind is None or len(self._names) >= MOST_SENSORS:
                continue
            self._names[device.name] = name = ros_name(device.name)
            if kind == "range":
                found[name] = RosTopic(f"range/{name}", "sensor_msgs/msg/Range", SENSOR_DATA, (SENSORS,))
            else:
                found[JOINTS.name] = JOINTS
        self._positions = {name: at for name, at in self._positions.items() if name in self._names.values()}
        return list(found.values())

    def fixed(self, now_ns: int) -> Made:
        """Make what never changes."""
        mounts = {self.frames.sensor(name): mount for name, mount in self._body.sensors.items()}
        mounts[self.frames.laser] = self._body.laser
        pairs = {(self.frames.base, frame): (Pose(at.x, at.y, at.yaw), at.z) for frame, at in mounts.items()}
        if self._body.map_to_odom:
            pairs[self.frames.map, self.frames.odom] = (Pose(0.0, 0.0, 0.0), 0.0)
        yield "tf_static", self._shapes.transforms(pairs, now_ns)
        description = urdf(self.robot, self.frames, self._body)
        yield "robot_description", self._types.message("std_msgs/msg/String", data=description)

    def make(self, path: str, message: FleetMessage, now_ns: int, wanted: Container[str]) -> Made:
        """Make the messages of the topics ``wanted`` of a fleet message that came on a path."""
        maker = _MAKERS.get(type(message))
        if maker is None:
            return
        stamp_ns = measured_ns(message.stamp_ns, now_ns, min(now_ns + AHEAD_NS, _END_NS))
        self._clamped.value += isinstance(message.stamp_ns, int) and message.stamp_ns != stamp_ns
        for name, made in maker(self, path, message, stamp_ns, wanted):
            if made is not None:
                yield name, made
            else:
                self._unusable.value += 1

    def diagnostics(self, more: list[Diagnostic], now_ns: int) -> Any:
        """Make a DiagnosticArray of what is known, and of ``more``."""
        status = [
            {
                "level": entry.level,
                "name": entry.name,
                "message": entry.message,
                "hardware_id": self.robot,
                "values": [{"key": key, "value": value} for key, value in entry.values],
            }
            for entry in (*entries_of(self.robot, self._states.get(Status), self._states.get(Control)), *more)
        ]
        return self._types.message("diagnostic_msgs/msg/DiagnosticArray", header=header(now_ns, ""), status=status)

    def _on_scan(self, path: str, scan: Scan, stamp_ns: int, wanted: Container[str]) -> Made:
        before, self._scan_at_ns = self._scan_at_ns, stamp_ns
        period_s = (stamp_ns - before) / 1e9 if before is not None else 0.0
        period_s = period_s if 0.0 < period_s < _LONGEST_PERIOD_S else 0.0
        if "scan" in wanted:
            yield "scan", self._shapes.laser_scan(scan, self._states.get(Scanner), stamp_ns, period_s)

    def _on_pose(self, path: str, pose: Pose, stamp_ns: int, wanted: Container[str]) -> Made:
        self._has_pose = True
        if "pose" in wanted:
            yield "pose", self._shapes.pose_stamped(pose, stamp_ns)
        yield from self._moved(pose, 1.0, stamp_ns, wanted)

    def _on_motion(self, path: str, motion: Motion, stamp_ns: int, wanted: Container[str]) -> Made:
        self._motion = motion
        if "imu" in wanted and (motion.gyro is not None or motion.acceleration is not None):
            yield "imu", self._shapes.imu(motion, stamp_ns)
        if not self._has_pose:
            pose = self._reckoning.add(speeds_of(motion, self._body.speed_full_mps), stamp_ns)
            yield from self._moved(pose, self._reckoning.spread, stamp_ns, wanted)

    def _moved(self, pose: Pose | None, spread: float, stamp_ns: int, wanted: Container[str]) -> Made:
        if "odom" in wanted:
            speeds = speeds_of(self._motion, self._body.speed_full_mps)
            yield "odom", self._shapes.odometry(pose, speeds, stamp_ns, spread)
        if "tf" in wanted and pose is not None:
            yield "tf", self._shapes.moved(pose, stamp_ns)

    def _on_reading(self, path: str, reading: Reading, stamp_ns: int, wanted: Container[str]) -> Made:
        name = self._names.get(topics.unescape(path.rpartition("/")[2]))
        kind = _KINDS.get(reading.kind or "")
        if name is None or kind is None:
            return
        if kind == "range":
            if f"range/{name}" in wanted:
                yield f"range/{name}", self._shapes.range_of(name, reading, stamp_ns)
        elif reading.fault:  # a joint has no number for what nobody knows
            self._positions.pop(name, None)
        elif JOINTS.name in wanted:
            self._positions[name] = reading.value
            yield JOINTS.name, self._shapes.joint_states(self._positions, stamp_ns)

    def _on_state(self, path: str, state: Scanner | Status | Control, stamp_ns: int, wanted: Container[str]) -> Made:
        self._states[type(state)] = state
        return iter(())


_Maker = Callable[[RosPictures, str, Any, int, Container[str]], Made]


def _single(name: str, shape: Callable[[Shapes, Any, int], Any]) -> _Maker:
    """Make the one ROS message of a fleet message."""

    def make(pictures: RosPictures, path: str, message: Any, stamp_ns: int, wanted: Container[str]) -> Made:
        if name in wanted:
            yield name, shape(pictures._shapes, message, stamp_ns)

    return make


_MAKERS: dict[type[FleetMessage], _Maker] = {
    Scan: RosPictures._on_scan,
    Scanner: RosPictures._on_state,
    Pose: RosPictures._on_pose,
    Motion: RosPictures._on_motion,
    Map: _single("map", Shapes.occupancy_grid),
    Battery: _single("battery_state", Shapes.battery_state),
    Image: _single("image/compressed", Shapes.compressed_image),
    Reading: RosPictures._on_reading,
    Status: RosPictures._on_state,
    Control: RosPictures._on_state,
}
