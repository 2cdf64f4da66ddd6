"""Fleet messages as ROS messages: units and axes after REP 103, frames after REP 105, NaN in scans after REP 117.

Sans-IO. A pose is the robot's own, in its map: ``map`` and ``odom`` are the same here. A function returns None where a
message has no sense as a ROS message: numbers that are not finite, a scan or map without content.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from zbridge.fleet.messages import Battery, Image, Map, Motion, Pose, Reading, Scan, Scanner
from zbridge.ros2 import Types

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
"""In the first place of an Imu's covariance: this part is not given."""
_SECOND_NS = 1_000_000_000
_CDR, _NO_INTENSITIES = b"\0\1\0\0", bytes(4)
"""What a message of CDR begins with, and the number of intensities of a scan."""
_CELLS = np.array([-1, 0, 100] + [-1] * 253, np.int8)
"""Occupancy by the fleet's cell: unknown, free, occupied."""
_LONGEST_SCAN_S = 1.0
_UNKNOWN_STATUS, _CHARGING, _DISCHARGING = 0, 1, 2
"""``POWER_SUPPLY_STATUS`` of BatteryState."""
_FIELD_OF_VIEW_RAD, _RANGE_MIN_M, _RANGE_MAX_M = 0.26, 0.0, 10.0
"""Of a distance sensor, which tells neither."""


class Frames(msgspec.Struct, frozen=True):
    """The names of one robot's frames. prefix: the robot, as a part of a ROS name."""

    prefix: str

    @property
    def map(self) -> str:
        """The robot's map."""
        return f"{self.prefix}/map"

    @property
    def odom(self) -> str:
        """Where odometry counts from."""
        return f"{self.prefix}/odom"

    @property
    def base(self) -> str:
        """The robot, on the ground."""
        return f"{self.prefix}/base_link"

    @property
    def camera(self) -> str:
        """The camera."""
        return f"{self.prefix}/camera"

    @property
    def laser(self) -> str:
        """The scanner."""
        return f"{self.prefix}/laser"


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
        self.frames = frames
        laser = frames.laser.encode() + b"\0"
        self._scan = struct.Struct(f"<4siII{len(laser)}s{-len(laser) % 4}x7fI")
        """What is before the ranges of a LaserScan."""
        self._scan_frame = (len(laser), laser)

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
        """Write a LaserScan as CDR: as many ranges as its angles say, counter-clockwise.

        period_s: between two scans, or 0. The one large message that comes often is written without rosbags, which
        takes several times as long; its definition is the same in all distributions.
        """
        ranges = scan.ranges if isinstance(scan.ranges, bytes) else scan.ranges.astype("<f4").tobytes()
        count, first, step = len(ranges) // 4, scan.angle_min, scan.angle_increment
        whole = count and not len(ranges) % 4 and step
        if not whole or not math.isfinite(first + step + scan.range_min + scan.range_max):
            return None
        last = first + step * (count - 1)
        if step < 0:
            first, last, step, ranges = last, first, -step, np.frombuffer(ranges, "<f4")[::-1].tobytes()
        between_s = _between_s(count, scan, scanner, period_s)
        seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
        limits = max(0.0, scan.range_min), scan.range_max
        try:
            before = self._scan.pack(
                _CDR, seconds, nanoseconds, *self._scan_frame, first, last, step, between_s, period_s, *limits, count
            )
        except (struct.error, OverflowError):  # larger than a float32
            return None
        return b"".join((before, ranges, _NO_INTENSITIES))

    def pose_stamped(self, pose: Pose, stamp_ns: int) -> Any | None:
        """Make a PoseStamped in the robot's map."""
        if not _is_finite(pose):
            return None
        return self._make(
            "geometry_msgs/msg/PoseStamped", header=self.header(stamp_ns, self.frames.map), pose=self._pose(pose)
        )

    def odometry(self, pose: Pose | None, speeds: Speeds, stamp_ns: int, spread: float = 1.0) -> Any | None:
        """Make an Odometry. pose: in the frame odom, None: unknown; spread: its variances are so many times larger."""
        if pose is not None and not _is_finite(pose):
            return None
        position, heading = (UNMEASURED, UNMEASURED)
        if pose is not None:
            position, heading = POSITION_VARIANCE * spread, HEADING_VARIANCE * spread
        forward = UNMEASURED if speeds.forward_mps is None else SPEED_VARIANCE * speeds.full_mps**2
        turn = UNMEASURED if speeds.turn_radps is None else TURN_VARIANCE
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, self.frames.odom),
            child_frame_id=self.frames.base,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(pose or Pose(0.0, 0.0, 0.0)),
                covariance=_diagonal(position, position, UNMEASURED, UNMEASURED, UNMEASURED, heading),
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._make(
                    "geometry_msgs/msg/Twist",
                    linear=self._vector(speeds.forward_mps or 0.0),
                    angular=self._vector(z=speeds.turn_radps or 0.0),
                ),
                covariance=_diagonal(forward, UNMEASURED, UNMEASURED, UNMEASURED, UNMEASURED, turn),
            ),
        )

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
                origin=self._pose(Pose(x, y, 0.0)),
            ),
            data=_CELLS[cells],
        )

    def imu(self, motion: Motion, stamp_ns: int) -> Any | None:
        """Make an Imu of what a motion has of acceleration and gyro; no orientation."""
        if motion.acceleration is None and motion.gyro is None:
            return None
        return self._make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns, self.frames.base),
            orientation=self._turned(0.0),
            orientation_covariance=_not_given(),
            angular_velocity=self._vector(*(motion.gyro or ())),
            angular_velocity_covariance=_not_given() if motion.gyro is None else np.zeros(9),
            linear_acceleration=self._vector(*(motion.acceleration or ())),
            linear_acceleration_covariance=_not_given() if motion.acceleration is None else np.zeros(9),
        )

    def battery_state(self, battery: Battery, stamp_ns: int) -> Any | None:
        """Make a BatteryState; NaN is what the robot does not tell."""
        status = _UNKNOWN_STATUS if battery.charging is None else _CHARGING if battery.charging else _DISCHARGING
        return self._make(
            "sensor_msgs/msg/BatteryState",
            header=self.header(stamp_ns, self.frames.base),
            voltage=_told(battery.voltage),
            temperature=math.nan,
            current=_told(battery.current),
            charge=math.nan,
            capacity=math.nan,
            design_capacity=math.nan,
            percentage=_told(battery.level),
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
            header=self.header(stamp_ns, f"{self.frames.prefix}/{name}"),
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
        return self._make(
            "tf2_msgs/msg/TFMessage",
            transforms=[
                self._make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=self._make(
                        "geometry_msgs/msg/Transform",
                        translation=self._vector(at.x, at.y, height_m),
                        rotation=self._turned(at.heading),
                    ),
                )
                for (parent, child), (at, height_m) in pairs.items()
            ],
        )

    def moved(self, pose: Pose, stamp_ns: int) -> Any | None:
        """Make the TFMessage of where the robot is."""
        if not _is_finite(pose):
            return None
        return self.transforms({(self.frames.odom, self.frames.base): (pose, 0.0)}, stamp_ns)

    def text(self, text: str) -> Any:
        """Make a String."""
        return self._make("std_msgs/msg/String", data=text)

    def _pose(self, pose: Pose) -> Any:
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=pose.x, y=pose.y, z=0.0),
            orientation=self._turned(pose.heading),
        )

    def _turned(self, heading: float) -> Any:
        return self._make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2)
        )

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _between_s(count: int, scan: Scan, scanner: Scanner | None, period_s: float) -> float:
    """Return the seconds between two rays; 0 where they are unknown, or would take longer than a whole scan does."""
    between_s = scanner.time_increment_s if scanner is not None and scan.angle_increment > 0 else 0.0
    longest_s = period_s or _LONGEST_SCAN_S
    return between_s if 0.0 < between_s * (count - 1) <= longest_s else 0.0


def _told(value: float | None) -> float:
    return math.nan if value is None else value


def _is_finite(pose: Pose) -> bool:
    return math.isfinite(pose.x) and math.isfinite(pose.y) and math.isfinite(pose.heading)


def _diagonal(*variances: float) -> Any:
    return np.diag(np.array(variances, np.float64)).reshape(-1)


def _not_given() -> Any:
    given = np.zeros(9)
    given[0] = _NO_ESTIMATE
    return given
