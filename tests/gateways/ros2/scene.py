"""A session with a ROS 2 robot without Zenoh: the test plays the link, and the robot's nodes."""

from __future__ import annotations

import struct
from typing import Any

from gateways.ros2.options import RosOptions
from gateways.ros2.translate import RosRobot
from tests.gateways.rig import drained
from zbridge.metrics import Metrics
from zbridge.protocol import KeyedSample, SampleKind, read_sample, write_sample
from zbridge.ros2.rmw_zenoh import gid_of
from zbridge.ros2.types import types_of

START_NS = 1_700_000_000_000_000_000
TYPES = types_of("jazzy")
KINDS = {
    "scan": "sensor_msgs/msg/LaserScan",
    "odom": "nav_msgs/msg/Odometry",
    "map": "nav_msgs/msg/OccupancyGrid",
    "imu": "sensor_msgs/msg/Imu",
    "battery_state": "sensor_msgs/msg/BatteryState",
    "image/compressed": "sensor_msgs/msg/CompressedImage",
}
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


def dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def token(topic: str, kind: str, role: str = "MP", *, number: int = 1, node: str = "base", hashed: str = "") -> str:
    """Write a token by hand, as rmw_zenoh does for a node of the root namespace."""
    hashed = hashed or TYPES.computed_hash(kind)
    name = f"%{topic}".replace("/", "%")
    return f"@ros2_lv/0/feed/0/{number}/{role}/%/%/{node}/{name}/{dds(kind)}/{hashed}/::,10:,:,:,,"


def key(topic: str, kind: str) -> str:
    return f"0/{topic}/{dds(kind)}/{TYPES.computed_hash(kind)}"


class RosScene:
    """The device side of a robot, its session, and what the session writes."""

    def __init__(self, **options: Any) -> None:
        self.metrics = Metrics()
        self.robot = RosRobot(RosOptions(**options), 1, self.metrics)
        self.session = self.robot.session("router", "tcp://h:1")
        self.now = 100.0
        self.written: list[KeyedSample] = []
        self._numbers = 0
        self.session.open(self.now)
        self.feed(KeyedSample(SampleKind.OPENED, payload=b"cafe", stamp_ns=self.time_ns))

    @property
    def time_ns(self) -> int:
        return START_NS + round((self.now - 100.0) * 1e9)

    def feed(self, sample: KeyedSample) -> list[Any]:
        """Let the link bring something; give what the session hands on."""
        received = self.session.receive(write_sample(sample), self.now)
        self.write()
        return received

    def write(self) -> list[KeyedSample]:
        """Take what the session writes now."""
        new = [read_sample(frame) for frame in drained(self.session, self.now)]
        self.written += new
        return new

    def after(self, seconds: float) -> list[KeyedSample]:
        """Let time pass; take what the session writes then."""
        self.now += seconds
        self.session.expire(self.now)
        return self.write()

    def appears(self, topic: str, kind: str = "", role: str = "MP", **more: Any) -> str:
        made = token(topic, kind or KINDS[topic], role, **more)
        self.feed(KeyedSample(SampleKind.APPEARED, made, stamp_ns=self.time_ns))
        return made

    def gone(self, made: str) -> None:
        self.feed(KeyedSample(SampleKind.GONE, made, stamp_ns=self.time_ns))

    def says(self, topic: str, by: str, payload: bytes, kind: str = "") -> list[Any]:
        """Let the publisher with this token put a payload."""
        self._numbers += 1
        attachment = struct.pack("<qqB", self._numbers, self.time_ns, 16) + gid_of(by)
        kind = kind or KINDS[topic]
        return self.feed(KeyedSample(SampleKind.SAMPLE, key(topic, kind), payload, attachment, self.time_ns))

    def hears(self, topic: str, by: str, **fields: Any) -> dict[str, Any]:
        """Let a publisher put a message; give the telemetry it makes, by path."""
        received = self.says(topic, by, TYPES.encode(TYPES.message(KINDS[topic], **fields)))
        return {path.path: message for one in received for path, message in self.robot.telemetry(one, self.time_ns)}

    def establish(self, kind: str = TWIST) -> str:
        """Bring up a robot with odometry and a base; give the publisher's token."""
        by = self.appears("odom")
        self.appears("cmd_vel", kind, "MS", number=2)
        self.hears("odom", by, header=header(self.time_ns))
        assert self.session.state.value == "established"
        self.write()
        return by


def header(stamp_ns: int) -> Any:
    stamp = TYPES.message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return TYPES.message("std_msgs/msg/Header", stamp=stamp, frame_id="laser")
