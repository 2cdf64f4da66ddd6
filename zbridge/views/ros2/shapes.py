"""Fleet messages as ROS messages: units and axes after REP 103, frames after REP 105, NaN in scans after REP 117.

Sans-IO. A pose is the robot's own, in its map: ``map`` and ``odom`` are the same here. A function returns None if a
message has no sense as a ROS message: numbers that are not finite, a scan or map without content. Messages that come
often are bytes that are filled in: rosbags takes several times as long.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import msgspec
import numpy as np

from zbridge.fleet.messages import Battery, Image, Map, Motion, Pose, Reading, Scan, Scanner
from zbridge.ros2.rmw_zenoh import ros_name
from zbridge.ros2.types import Types
from zbridge.views.ros2.settings import RobotBody

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
_LASER_M = 0.05
"""Radius and height of what is drawn for a scanner."""
_STAMP, _NUMBER = struct.Struct("<iI"), struct.Struct("<d")
_MARK = _NUMBER.unpack(b"\1" * 8)[0]
_MARKED_NS = int.from_bytes(b"\1" * 4, "little") * 1_000_000_000
"""A number and a stamp that differ from zero in their first byte."""
_CDR, _NO_INTENSITIES = b"\0\1\0\0", bytes(4)
"""What a message of CDR begins with, and the number of intensities of a scan."""
_ORIGIN, _NOTHING = Pose(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
_SECOND_NS = 1_000_000_000
_CELLS = np.array([-1, 0, 100] + [-1] * 253, np.int8)
"""Occupancy by the fleet's cell: unknown, free, occupied."""
_LONGEST_SCAN_S = 1.0
_UNKNOWN_STATUS, _CHARGING, _DISCHARGING = 0, 1, 2
"""``POWER_SUPPLY_STATUS`` of BatteryState."""
_FIELD_OF_VIEW_RAD, _RANGE_MIN_M, _RANGE_MAX_M = 0.26, 0.0, 10.0
"""Of a distance sensor, which tells neither."""


class Frames:
    """The names of one robot's frames. prefix: the robot, as a part of a ROS name.

    odom: where odometry counts from; base: the robot, on the ground; laser: the scanner.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.map, self.odom = f"{prefix}/map", f"{prefix}/odom"
        self.camera, self.laser = f"{prefix}/camera", f"{prefix}/laser"
        self.base = f"{prefix}/base_link"

    def sensor(self, name: str) -> str:
        return f"{self.prefix}/{ros_name(name)}"


class Speeds(msgspec.Struct, frozen=True):
    """How a robot moves: m/s, rad/s; None if nobody measured it. full_mps: its full scale."""

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


class MessageTemplate:
    """A message that is always the same, but for its stamp and some float64.

    write: writes the message of a stamp in ns and ``count`` numbers as CDR. Where each of them stands is found by
    changing it alone.
    """

    def __init__(self, write: Callable[..., bytes], count: int) -> None:
        zeros = (0.0,) * count
        self._plain = write(0, *zeros)
        self._stamp_at = self._place(write(_MARKED_NS, *zeros))
        marked = ((*zeros[:number], _MARK, *zeros[number + 1 :]) for number in range(count))
        self._places = [self._place(write(0, *numbers)) for numbers in marked]

    def fill(self, stamp_ns: int, numbers: tuple[float, ...]) -> bytes:
        data = bytearray(self._plain)
        _STAMP.pack_into(data, self._stamp_at, *divmod(stamp_ns, _SECOND_NS))
        for place, number in zip(self._places, numbers, strict=True):
            _NUMBER.pack_into(data, place, number)
        return bytes(data)

    def _place(self, other: bytes) -> int:
        return next(at for at, (one, two) in enumerate(zip(self._plain, other, strict=True)) if one != two)


Fields = dict[str, Any]
"""The fields of a ROS message, by name; those of its parts are such dicts, too."""
_Form = Callable[..., tuple[str, Fields]]
"""Returns the type and the fields of a message: of the frames, a stamp in ns, and numbers."""


class Shapes:
    """Makes the ROS messages of one robot for one distribution: ``bytes``, or what :class:`Types` encodes."""

    def __init__(self, types: Types, frames: Frames) -> None:
        self._types = types
        self._make = types.message
        self.frames = frames
        self._template = cache(self._make_template)
        name = frames.laser.encode() + b"\0"
        self._laser = len(name), name
        self._before_ranges = struct.Struct(f"<4siII{len(name)}s{-len(name) % 4}x7fI")

    def _make_template(self, form: _Form, count: int) -> MessageTemplate:
        def write(*values: Any) -> bytes:
            type_name, fields = form(self.frames, *values)
            return self._types.encode(self._make(type_name, **fields))

        return MessageTemplate(write, count)

    def laser_scan(self, scan: Scan, scanner: Scanner | None, stamp_ns: int, period_s: float) -> bytes | None:
        """Write a LaserScan: as many ranges as its angles say, counter-clockwise. period_s: between two scans, or 0.

        Its definition is the same in all distributions.
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
        numbers = (first, last, step, between_s, period_s, max(0.0, scan.range_min), scan.range_max)
        try:
            before = self._before_ranges.pack(_CDR, *divmod(stamp_ns, _SECOND_NS), *self._laser, *numbers, count)
        except OverflowError:  # a number is too large for a float32
            return None
        return b"".join((before, ranges, _NO_INTENSITIES))

    def pose_stamped(self, pose: Pose, stamp_ns: int) -> bytes | None:
        """Write a PoseStamped in the robot's map."""
        return self._template(_pose_stamped, 4).fill(stamp_ns, _place(pose)) if _is_finite(pose) else None

    def odometry(self, pose: Pose | None, speeds: Speeds, stamp_ns: int, spread: float = 1.0) -> bytes | None:
        """Write an Odometry. pose: in the frame odom, None: unknown; spread: its variances are so many times larger."""
        if pose is not None and not _is_finite(pose):
            return None
        position = UNMEASURED if pose is None else POSITION_VARIANCE * spread
        heading = UNMEASURED if pose is None else HEADING_VARIANCE * spread
        forward = UNMEASURED if speeds.forward_mps is None else SPEED_VARIANCE * speeds.full_mps**2
        turn = UNMEASURED if speeds.turn_radps is None else TURN_VARIANCE
        speed = speeds.forward_mps or 0.0, speeds.turn_radps or 0.0
        numbers = (*_place(pose or _ORIGIN), position, position, heading, *speed, forward, turn)
        return self._template(_odometry, 11).fill(stamp_ns, numbers)

    def occupancy_grid(self, fleet_map: Map, stamp_ns: int) -> Any | None:
        """Make an OccupancyGrid: -1 unknown, 0 free, 100 occupied; rows along y."""
        cells = np.asarray(fleet_map.cells, np.uint8).reshape(-1)
        numbers = (fleet_map.cell, *fleet_map.origin)
        if not len(cells) or len(cells) != fleet_map.rows * fleet_map.columns or not all(map(math.isfinite, numbers)):
            return None
        info = {
            "map_load_time": _time(stamp_ns),
            "resolution": fleet_map.cell,
            "width": fleet_map.columns,
            "height": fleet_map.rows,
            "origin": _pose(*fleet_map.origin, 0.0, 1.0),
        }
        head = header(stamp_ns, self.frames.map)
        return self._make("nav_msgs/msg/OccupancyGrid", header=head, info=info, data=_CELLS[cells])

    def imu(self, motion: Motion, stamp_ns: int) -> bytes | None:
        """Write an Imu of what a motion has of acceleration and gyro; no orientation."""
        gyro, acceleration = motion.gyro, motion.acceleration
        if gyro is None and acceleration is None:
            return None
        known = tuple(0.0 if vector is not None else _NO_ESTIMATE for vector in (gyro, acceleration))
        return self._template(_imu, 8).fill(stamp_ns, (*(gyro or _NOTHING), *(acceleration or _NOTHING), *known))

    def battery_state(self, battery: Battery, stamp_ns: int) -> Any | None:
        """Make a BatteryState; NaN is what the robot does not tell."""
        unknown = dict.fromkeys(("temperature", "charge", "capacity", "design_capacity"), math.nan)
        status = _UNKNOWN_STATUS if battery.charging is None else _CHARGING if battery.charging else _DISCHARGING
        return self._make(
            "sensor_msgs/msg/BatteryState",
            header=header(stamp_ns, self.frames.base),
            voltage=_or_nan(battery.voltage),
            current=_or_nan(battery.current),
            percentage=_or_nan(battery.level),
            power_supply_status=status,
            present=True,
            **unknown,
        )

    def compressed_image(self, image: Image, stamp_ns: int) -> Any | None:
        """Make a CompressedImage of a picture, its bytes as they are."""
        if not image.data:
            return None
        head, data = header(stamp_ns, self.frames.camera), np.frombuffer(image.data, np.uint8)
        return self._make("sensor_msgs/msg/CompressedImage", header=head, format=image.format, data=data)

    def range_of(self, name: str, reading: Reading, stamp_ns: int) -> Any | None:
        """Make a Range of a distance sensor; a fault is NaN."""
        return self._make(
            "sensor_msgs/msg/Range",
            header=header(stamp_ns, self.frames.sensor(name)),
            radiation_type=1,  # infrared, as far as it says what it is
            field_of_view=_FIELD_OF_VIEW_RAD,
            min_range=_RANGE_MIN_M,
            max_range=_RANGE_MAX_M,
            range=math.nan if reading.fault else reading.value,
        )

    def joint_states(self, positions: Mapping[str, float], stamp_ns: int) -> Any | None:
        """Make a JointState: rad, or m for a linear joint."""
        numbers = np.array(list(positions.values()), np.float64)
        head = header(stamp_ns, "")
        return self._make("sensor_msgs/msg/JointState", header=head, name=list(positions), position=numbers)

    def transforms(self, pairs: Mapping[tuple[str, str], tuple[Pose, float]], stamp_ns: int) -> Any:
        """Make a TFMessage: for each frame and its child where the child is, and how high."""
        made = [_transform(pair, stamp_ns, _place(at), height_m) for pair, (at, height_m) in pairs.items()]
        return self._make("tf2_msgs/msg/TFMessage", transforms=made)

    def moved(self, pose: Pose, stamp_ns: int) -> bytes | None:
        """Write the TFMessage of where the robot is."""
        return self._template(_moved, 4).fill(stamp_ns, _place(pose)) if _is_finite(pose) else None


def urdf(robot: str, frames: Frames, body: RobotBody) -> str:
    """Write a box on the ground, and a cylinder where the scanner is. Frames have the robot's prefix."""
    laser = body.laser
    return f"""<?xml version="1.0"?>
<robot name="{robot}">
  <link name="{frames.base}">
    <visual>
      <origin xyz="0 0 {body.height_m / 2:g}"/>
      <geometry><box size="{body.length_m:g} {body.width_m:g} {body.height_m:g}"/></geometry>
      <material name="body"><color rgba="0.2 0.4 0.8 1"/></material>
    </visual>
  </link>
  <link name="{frames.laser}">
    <visual>
      <geometry><cylinder radius="{_LASER_M}" length="{_LASER_M}"/></geometry>
      <material name="laser"><color rgba="0.1 0.1 0.1 1"/></material>
    </visual>
  </link>
  <joint name="{frames.laser}_joint" type="fixed">
    <parent link="{frames.base}"/>
    <child link="{frames.laser}"/>
    <origin xyz="{laser.x:g} {laser.y:g} {laser.z:g}" rpy="0 0 {laser.yaw:g}"/>
  </joint>
</robot>
"""


def header(stamp_ns: int, frame: str) -> Fields:
    """Return the fields of a Header."""
    return {"stamp": _time(stamp_ns), "frame_id": frame}


def _pose_stamped(frames: Frames, stamp_ns: int, *place: float) -> tuple[str, Fields]:
    return "geometry_msgs/msg/PoseStamped", {"header": header(stamp_ns, frames.map), "pose": _pose(*place)}


def _odometry(frames: Frames, stamp_ns: int, *numbers: float) -> tuple[str, Fields]:
    x, y, heading, forward, turn, of_forward, of_turn = numbers[4:]
    unmeasured = (UNMEASURED,) * 4
    return "nav_msgs/msg/Odometry", {
        "header": header(stamp_ns, frames.odom),
        "child_frame_id": frames.base,
        "pose": {
            "pose": _pose(*numbers[:4]),
            "covariance": np.diag([x, y, *unmeasured[:3], heading]).reshape(-1),
        },
        "twist": {
            "twist": {"linear": {"x": forward}, "angular": {"z": turn}},
            "covariance": np.diag([of_forward, *unmeasured, of_turn]).reshape(-1),
        },
    }


def _imu(frames: Frames, stamp_ns: int, *numbers: float) -> tuple[str, Fields]:
    return "sensor_msgs/msg/Imu", {
        "header": header(stamp_ns, frames.base),
        "orientation": {"w": 1.0},
        "orientation_covariance": _first(_NO_ESTIMATE),
        "angular_velocity": dict(zip("xyz", numbers[:3], strict=True)),
        "angular_velocity_covariance": _first(numbers[6]),
        "linear_acceleration": dict(zip("xyz", numbers[3:6], strict=True)),
        "linear_acceleration_covariance": _first(numbers[7]),
    }


def _moved(frames: Frames, stamp_ns: int, *place: float) -> tuple[str, Fields]:
    transform = _transform((frames.odom, frames.base), stamp_ns, place, 0.0)
    return "tf2_msgs/msg/TFMessage", {"transforms": [transform]}


def _transform(pair: tuple[str, str], stamp_ns: int, place: tuple[float, ...], height_m: float) -> Fields:
    x, y, z, w = place
    return {
        "header": header(stamp_ns, pair[0]),
        "child_frame_id": pair[1],
        "transform": {"translation": {"x": x, "y": y, "z": height_m}, "rotation": {"z": z, "w": w}},
    }


def _pose(x: float, y: float, z: float, w: float) -> Fields:
    return {"position": {"x": x, "y": y}, "orientation": {"z": z, "w": w}}


def _time(stamp_ns: int) -> Fields:
    seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
    return {"sec": seconds, "nanosec": nanoseconds}


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


def _first(value: float) -> Any:
    return np.array((value, *(0.0,) * 8))
