"""Fleet messages as ROS messages: units and axes after REP 103, frames after REP 105, NaN in scans after REP 117.

Sans-IO. A pose is the robot's own, in its map: ``map`` and ``odom`` are the same here. A function returns None where a
message has no sense as a ROS message: numbers that are not finite, a scan or map without content.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from zbridge.fleet.messages import Battery, Image, Map, Motion, Pose, Reading, Scan, Scanner
from zbridge.ros2 import Types
from zbridge.views.ros2.description import Frames
from zbridge.views.ros2.forms import MessageTemplate, ScanTemplate

POSITION_VARIANCE = 0.05**2
"""Of x and y of a pose, m2. No robot of ours tells how good its pose is: an estimate."""
HEADING_VARIANCE = 0.05**2
"""Of the heading of a pose, rad2."""
SPEED_VARIANCE = 0.1**2
"""Of a speed, as a part of full scale, squared."""
TURN_VARIANCE = 0.05**2
"""Of a turn rate, rad2/s2."""
UNMEASURED = 1e6
"""The variance of what nobody measured."""
_NO_ESTIMATE = -1.0
"""In the first place of an Imu's covariance: this part is not known."""
_ORIGIN, _NOTHING = Pose(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
_SECOND_NS = 1_000_000_000
_CELLS = np.array([-1, 0, 100] + [-1] * 253, np.int8)
"""Occupancy by the fleet's cell: unknown, free, occupied."""
_LONGEST_SCAN_S = 1.0
_UNKNOWN_STATUS, _CHARGING, _DISCHARGING = 0, 1, 2
"""``POWER_SUPPLY_STATUS`` of BatteryState."""
_FIELD_OF_VIEW_RAD, _RANGE_MIN_M, _RANGE_MAX_M = 0.26, 0.0, 10.0
"""Of a distance sensor, which tells neither."""


class Speeds(msgspec.Struct, frozen=True):
    """How a robot moves: m/s, rad/s; None where nobody measured it. full_mps: its full scale."""

    forward_mps: float | None
    turn_radps: float | None
    full_mps: float


def speeds_of(motion: Motion | None, full_mps: float) -> Speeds:
    """Read a motion: its speed is a fraction of full scale."""
    if motion is None:
        return Speeds(None, None, full_mps)
    forward = motion.speed * full_mps if motion.speed is not None and math.isfinite(motion.speed) else None
    turn = motion.gyro[2] if motion.gyro is not None and math.isfinite(motion.gyro[2]) else None
    return Speeds(forward, turn, full_mps)


class Shapes:
    """Makes the ROS messages of one robot for one distribution."""

    def __init__(self, types: Types, frames: Frames) -> None:
        self._make = types.message
        self._write = types.encode
        self.frames = frames
        self._scan = ScanTemplate(frames.laser)

    def __repr__(self) -> str:
        return f"<Shapes of {self.frames.prefix}>"

    def header(self, stamp_ns: int, frame: str) -> Any:
        """Make a header."""
        return self._make("std_msgs/msg/Header", stamp=self.time(stamp_ns), frame_id=frame)

    def time(self, stamp_ns: int) -> Any:
        """Make a time."""
        seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def laser_scan(self, scan: Scan, scanner: Scanner | None, stamp_ns: int, period_s: float) -> bytes | None:
        """Write a LaserScan: as many ranges as its angles say, counter-clockwise. period_s: between two scans, or 0."""
        ranges = scan.ranges if isinstance(scan.ranges, bytes) else scan.ranges.astype("<f4").tobytes()
        count, first, step = len(ranges) // 4, scan.angle_min, scan.angle_increment
        whole = count and not len(ranges) % 4 and step
        if not whole or not math.isfinite(first + step + scan.range_min + scan.range_max):
            return None
        last = first + step * (count - 1)
        if step < 0:
            first, last, step, ranges = last, first, -step, np.frombuffer(ranges, "<f4")[::-1].tobytes()
        between_s = _between_s(count, scan, scanner, period_s)
        limits = max(0.0, scan.range_min), scan.range_max
        return self._scan.fill(stamp_ns, (first, last, step, between_s, period_s, *limits), ranges)

    def pose_stamped(self, pose: Pose, stamp_ns: int) -> bytes | None:
        """Write a PoseStamped in the robot's map."""
        return self._pose_form.fill(stamp_ns, *_place(pose)) if _is_finite(pose) else None

    @cached_property
    def _pose_form(self) -> MessageTemplate:
        def make(stamp_ns: int, *place: float) -> Any:
            header = self.header(stamp_ns, self.frames.map)
            return self._make("geometry_msgs/msg/PoseStamped", header=header, pose=self._pose(*place))

        return MessageTemplate(self._write, make, 4)

    def odometry(self, pose: Pose | None, speeds: Speeds, stamp_ns: int, spread: float = 1.0) -> bytes | None:
        """Write an Odometry. pose: in the frame odom, None: unknown; spread: its variances are so many times larger."""
        if pose is not None and not _is_finite(pose):
            return None
        position, heading = (UNMEASURED, UNMEASURED)
        if pose is not None:
            position, heading = POSITION_VARIANCE * spread, HEADING_VARIANCE * spread
        forward = UNMEASURED if speeds.forward_mps is None else SPEED_VARIANCE * speeds.full_mps**2
        turn = UNMEASURED if speeds.turn_radps is None else TURN_VARIANCE
        speed = speeds.forward_mps or 0.0, speeds.turn_radps or 0.0
        place = _place(pose or _ORIGIN)
        return self._odometry_form.fill(stamp_ns, *place, position, position, heading, *speed, forward, turn)

    @cached_property
    def _odometry_form(self) -> MessageTemplate:
        def make(stamp_ns: int, *numbers: float) -> Any:
            place, (x, y, heading, forward, turn), speeds = numbers[:4], numbers[4:9], numbers[9:]
            return self._make(
                "nav_msgs/msg/Odometry",
                header=self.header(stamp_ns, self.frames.odom),
                child_frame_id=self.frames.base,
                pose=self._make(
                    "geometry_msgs/msg/PoseWithCovariance",
                    pose=self._pose(*place),
                    covariance=_diagonal(x, y, UNMEASURED, UNMEASURED, UNMEASURED, heading),
                ),
                twist=self._make(
                    "geometry_msgs/msg/TwistWithCovariance",
                    twist=self._make(
                        "geometry_msgs/msg/Twist", linear=self._vector(forward), angular=self._vector(z=turn)
                    ),
                    covariance=_diagonal(speeds[0], UNMEASURED, UNMEASURED, UNMEASURED, UNMEASURED, speeds[1]),
                ),
            )

        return MessageTemplate(self._write, make, 11)

    def occupancy_grid(self, fleet_map: Map, stamp_ns: int) -> Any | None:
        """Make an OccupancyGrid: -1 unknown, 0 free, 100 occupied; rows along y."""
        cells = np.asarray(fleet_map.cells, np.uint8).reshape(-1)
        numbers = (fleet_map.cell, *fleet_map.origin)
        if not len(cells) or len(cells) != fleet_map.rows * fleet_map.columns or not all(map(math.isfinite, numbers)):
            return None
        x, y = fleet_map.origin
        return self._make(
            "nav_msgs/msg/OccupancyGrid",
            header=self.header(stamp_ns, self.frames.map),
            info=self._make(
                "nav_msgs/msg/MapMetaData",
                map_load_time=self.time(stamp_ns),
                resolution=fleet_map.cell,
                width=fleet_map.columns,
                height=fleet_map.rows,
                origin=self._pose(x, y, 0.0, 1.0),
            ),
            data=_CELLS[cells],
        )

    def imu(self, motion: Motion, stamp_ns: int) -> bytes | None:
        """Write an Imu of what a motion has of acceleration and gyro; no orientation."""
        gyro, acceleration = motion.gyro, motion.acceleration
        if gyro is None and acceleration is None:
            return None
        known = tuple(0.0 if vector is not None else _NO_ESTIMATE for vector in (gyro, acceleration))
        return self._imu_form.fill(stamp_ns, *(gyro or _NOTHING), *(acceleration or _NOTHING), *known)

    @cached_property
    def _imu_form(self) -> MessageTemplate:
        def make(stamp_ns: int, *numbers: float) -> Any:
            return self._make(
                "sensor_msgs/msg/Imu",
                header=self.header(stamp_ns, self.frames.base),
                orientation=self._turned(0.0, 1.0),
                orientation_covariance=_first(_NO_ESTIMATE),
                angular_velocity=self._vector(*numbers[:3]),
                angular_velocity_covariance=_first(numbers[6]),
                linear_acceleration=self._vector(*numbers[3:6]),
                linear_acceleration_covariance=_first(numbers[7]),
            )

        return MessageTemplate(self._write, make, 8)

    def battery_state(self, battery: Battery, stamp_ns: int) -> Any | None:
        """Make a BatteryState; NaN is what the robot does not tell."""
        status = _UNKNOWN_STATUS if battery.charging is None else _CHARGING if battery.charging else _DISCHARGING
        return self._make(
            "sensor_msgs/msg/BatteryState",
            header=self.header(stamp_ns, self.frames.base),
            voltage=_or_nan(battery.voltage),
            temperature=math.nan,
            current=_or_nan(battery.current),
            charge=math.nan,
            capacity=math.nan,
            design_capacity=math.nan,
            percentage=_or_nan(battery.level),
            power_supply_status=status,
            present=True,
        )

    def compressed_image(self, image: Image, stamp_ns: int) -> Any | None:
        """Make a CompressedImage of a picture, its bytes as they are."""
        if not image.data:
            return None
        return self._make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp_ns, self.frames.camera),
            format=image.format,
            data=np.frombuffer(image.data, np.uint8),
        )

    def range_of(self, name: str, reading: Reading, stamp_ns: int) -> Any | None:
        """Make a Range of a distance sensor; a fault is NaN."""
        value = math.nan if reading.fault else reading.value
        return self._make(
            "sensor_msgs/msg/Range",
            header=self.header(stamp_ns, self.frames.sensor(name)),
            radiation_type=1,  # infrared, as far as it says what it is
            field_of_view=_FIELD_OF_VIEW_RAD,
            min_range=_RANGE_MIN_M,
            max_range=_RANGE_MAX_M,
            range=value,
        )

    def joint_states(self, positions: Mapping[str, float], stamp_ns: int) -> Any | None:
        """Make a JointState: rad, or m for a linear joint."""
        return self._make(
            "sensor_msgs/msg/JointState",
            header=self.header(stamp_ns, ""),
            name=list(positions),
            position=np.array(list(positions.values()), np.float64),
        )

    def transforms(self, pairs: Mapping[tuple[str, str], tuple[Pose, float]], stamp_ns: int) -> Any:
        """Make a TFMessage: for each frame and its child where the child is, and how high."""
        found = ((pair, _place(at), height_m) for pair, (at, height_m) in pairs.items())
        made = [self._transform(pair, stamp_ns, x, y, height_m, *turned) for pair, (x, y, *turned), height_m in found]
        return self._make("tf2_msgs/msg/TFMessage", transforms=made)

    def _transform(
        self, pair: tuple[str, str], stamp_ns: int, x: float, y: float, height_m: float, *turned: float
    ) -> Any:
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, pair[0]),
            child_frame_id=pair[1],
            transform=self._make(
                "geometry_msgs/msg/Transform",
                translation=self._vector(x, y, height_m),
                rotation=self._turned(*turned),
            ),
        )

    def moved(self, pose: Pose, stamp_ns: int) -> bytes | None:
        """Write the TFMessage of where the robot is."""
        return self._moved_form.fill(stamp_ns, *_place(pose)) if _is_finite(pose) else None

    @cached_property
    def _moved_form(self) -> MessageTemplate:
        def make(stamp_ns: int, x: float, y: float, *turned: float) -> Any:
            moved = self._transform((self.frames.odom, self.frames.base), stamp_ns, x, y, 0.0, *turned)
            return self._make("tf2_msgs/msg/TFMessage", transforms=[moved])

        return MessageTemplate(self._write, make, 4)

    def text(self, text: str) -> Any:
        """Make a String."""
        return self._make("std_msgs/msg/String", data=text)

    def _pose(self, x: float, y: float, z: float, w: float) -> Any:
        position = self._make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        return self._make("geometry_msgs/msg/Pose", position=position, orientation=self._turned(z, w))

    def _turned(self, z: float, w: float) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _between_s(count: int, scan: Scan, scanner: Scanner | None, period_s: float) -> float:
    """Return the seconds between two rays; 0 where they are unknown, or would take longer than a whole scan does."""
    between_s = scanner.time_increment_s if scanner is not None and scan.angle_increment > 0 else 0.0
    longest_s = period_s or _LONGEST_SCAN_S
    return between_s if 0.0 < between_s * (count - 1) <= longest_s else 0.0


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _place(pose: Pose) -> tuple[float, float, float, float]:
    """Return x and y, and z and w of the quaternion."""
    half = pose.heading / 2
    return pose.x, pose.y, math.sin(half), math.cos(half)


def _is_finite(pose: Pose) -> bool:
    return math.isfinite(pose.x) and math.isfinite(pose.y) and math.isfinite(pose.heading)


def _diagonal(*variances: float) -> Any:
    return np.diag(np.array(variances, np.float64)).reshape(-1)


def _first(value: float) -> Any:
    covariance = np.zeros(9)
    covariance[0] = value
    return covariance
