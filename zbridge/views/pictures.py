"""The pictures of one robot: which channels a viewer is offered, and what each fleet message adds to them. Sans-IO.

Pictures are Foxglove's messages, protobuf; times are Unix nanoseconds, lengths metres, angles radians. The SDK encodes
a small message in 1 us, but a scan in 22 us; a scan is written here by hand, in a quarter of that.

A channel is named as its key below the realm: ``/r1/scan``. Three have no key of their own: ``/r1/tf`` (where the
frames are), ``/r1/trail`` (where the robot was) and ``/r1/log`` (texts, states and refusals). Frames after REP 105:
``r1/map`` is the robot's own map, ``r1/base`` the robot, ``r1/scan`` its scanner, which is where the robot is.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator
from functools import lru_cache
from typing import Any

import foxglove.messages as fox
import msgspec
import numpy as np
from foxglove.messages import LogLevel

from zbridge.blackbox.segments import LogLine
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Image, Map, Pose, Scan, Status, Text
from zbridge.fleet.payload import measured_ns
from zbridge.fleet.topics import Topic
from zbridge.lease.lease_events import RefusalNews
from zbridge.views.schemas import Schema, foxglove_schema, json_schema

_SECOND_NS = 1_000_000_000
TRAIL_POINTS = 256
"""Most points of a trail."""
TRAIL_M = 0.05
"""A trail has a point so often, metres."""
TRAIL_EVERY_NS = 200_000_000
"""A trail is drawn at most so often: 5 times a second."""
FRAMES_EVERY_NS = 1_000_000_000
"""The scanner's frame is told so often where no pose tells it: once a second."""
_END_NS = 2**32 * _SECOND_NS
"""A stamp from here on has no place in a Foxglove message."""
_ANGLES = struct.Struct("<BdBdB")
_START_ANGLE, _END_ANGLE, _RANGES = 0x21, 0x29, 0x32
"""Tags of ``foxglove.LaserScan``: field number and wire type."""
_ORIGIN = Pose(0.0, 0.0, 0.0)
_NO_TURN = fox.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
_HERE = fox.Pose(position=fox.Vector3(x=0.0, y=0.0, z=0.0), orientation=_NO_TURN)
_TRAIL_COLOR = fox.Color(r=0.2, g=0.6, b=1.0, a=0.9)
_TRAIL_WIDTH_M = 0.03
_MAP_Z_M = -0.02
"""A map lies below what is drawn on it: viewers show one of two things in the same plane by chance."""
_CELL_COLORS = np.array([(127, 127, 127, 64), (240, 240, 240, 255), (20, 20, 20, 255), (255, 0, 255, 255)], np.uint8)
"""Red, green, blue, alpha of an unknown, a free and an occupied cell, and of one with another value."""
_UINT8 = fox.PackedElementFieldNumericType.Uint8
_CELL_FIELDS = [
    fox.PackedElementField(name=name, offset=offset, type=_UINT8)
    for offset, name in enumerate(("red", "green", "blue", "alpha"))
]
_LINE_LEVELS = {"debug": LogLevel.Debug, "info": LogLevel.Info, "warning": LogLevel.Warning}
_LEVELS = {"debug": LogLevel.Debug, "chat": LogLevel.Info, "request": LogLevel.Info}


class ViewerChannel(msgspec.Struct, frozen=True):
    """What a viewer can subscribe to. path: below the robot; topic: as the viewer is told.

    keeps_last: a late viewer needs the last message.
    """

    topic: str
    path: str
    schema: Schema
    keeps_last: bool = False


class Picture(msgspec.Struct, frozen=True):
    """One message of a channel. stamp_ns: when its content was measured, Unix nanoseconds."""

    channel: ViewerChannel
    payload: bytes
    stamp_ns: int


@lru_cache(maxsize=65_536)
def channels_of(robot: str, path: str) -> tuple[ViewerChannel, ...]:
    """Return the channels that the messages of a path below the robot are drawn on; none for an unknown path."""
    topic = topics.find(path)
    if topic is None:
        return ()
    also = tuple(
        ViewerChannel(f"/{robot}/{name}", name, foxglove_schema(drawn.schema), keeps_last=name == "trail")
        for name, drawn in _DRAWN_ALSO.items()
        if path in drawn.sources
    )
    if topic is topics.TEXT:
        return also
    own = _SHAPES.get(topic.message)
    schema = foxglove_schema(own.schema) if own is not None else json_schema(topic.message)
    return (ViewerChannel(f"/{robot}/{path}", path, schema, topic.qos.keeps_last), *also)


def sources_of(channel: ViewerChannel) -> tuple[str, ...]:
    """Return the paths below the robot whose messages are drawn on a channel."""
    also = _DRAWN_ALSO.get(channel.path)
    return also.sources if also is not None else (channel.path,)


def line_picture(robot: str, line: LogLine, now_ns: int) -> Picture:
    """Draw a line of a gateway's log on the robot's log."""
    channel = next(each for each in channels_of(robot, topics.TEXT.path) if each.path == "log")
    level = _LINE_LEVELS.get(line.level, LogLevel.Error)
    stamp_ns = measured_ns(line.stamp_ns, now_ns, _END_NS)
    return Picture(channel, log(line.message, level, line.logger, stamp_ns), stamp_ns)


class FoxglovePictures:
    """Draws what one robot publishes. It keeps what the trail, the frames and the log need, and nothing else."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self._faults: set[tuple[str, int]] = set()
        self._frame = {name: f"{robot}/{name}" for name in ("map", "base", "scan")}
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL_POINTS)
        self._trail_drawn_ns = self._frames_sent_ns = -_END_NS
        self._state: tuple[str, str | None] | None = None
        self._news = RefusalNews(lambda _: True)

    def draw(
        self, topic: Topic, message: FleetMessage, now_ns: int, wanted: Container[str] | None = None
    ) -> list[Picture]:
        """Return the pictures of a message that the robot published on a topic; none of a pose or map without content.

        now_ns: when it came, Unix nanoseconds. wanted: names of the channels to draw (``scan``, ``tf``); None: all.
        """
        stamp_ns = measured_ns(message.stamp_ns, now_ns, _END_NS)
        return [
            Picture(channel, payload, stamp_ns)
            for channel in channels_of(self.robot, topic.path)
            if wanted is None or channel.path in wanted
            for payload in self._drawn(channel, message, stamp_ns)
        ]

    def _drawn(self, channel: ViewerChannel, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        if (also := _DRAWN_ALSO.get(channel.path)) is not None:
            yield from also.draw(self, message, stamp_ns)
        elif (shape := _SHAPES.get(type(message))) is None:
            yield _ENCODE(message)
        elif (payload := shape.write(message, self._frame[shape.frame], stamp_ns)) is not None:
            yield payload

    def _frames(self, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        """Tell where the frames are: with every pose, and once a second where only scans come."""
        scanner = (self._frame["base"], self._frame["scan"], _ORIGIN)
        if isinstance(message, Pose) and _is_finite(message):
            self._frames_sent_ns = stamp_ns
            yield transforms(((self._frame["map"], self._frame["base"], message), scanner), stamp_ns)
        elif abs(stamp_ns - self._frames_sent_ns) >= FRAMES_EVERY_NS:
            self._frames_sent_ns = stamp_ns
            yield transforms((scanner,), stamp_ns)

    def _on_trail(self, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        if not isinstance(message, Pose) or not _is_finite(message):
            return
        at = (message.x, message.y)
        if self._trail and math.dist(at, self._trail[-1]) < TRAIL_M:
            return
        self._trail.append(at)
        if abs(stamp_ns - self._trail_drawn_ns) >= TRAIL_EVERY_NS:
            self._trail_drawn_ns = stamp_ns
            yield trail(self._trail, self._frame["map"], stamp_ns)

    def _fault_lines(self, status: Status, stamp_ns: int) -> Iterator[bytes]:
        """Write faults that have opened."""
        known, self._faults = self._faults, {(fault.code, fault.since_ns) for fault in status.faults}
        for fault in status.faults:
            if (fault.code, fault.since_ns) not in known:
                yield log(f"fault {fault.code}: {fault.text}", LogLevel.Error, self.robot, stamp_ns)

    def _logged(self, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        """Write texts, changes of the robot's state, and refusals that are new."""
        if isinstance(message, Text):
            yield log(message.text, _LEVELS[message.kind], message.sender or self.robot, stamp_ns)
        elif isinstance(message, Status) and self._state != (message.state, message.reason):
            self._state = (message.state, message.reason)
            level = LogLevel.Info if message.state == "established" else LogLevel.Warning
            text = message.state + (f": {message.reason}" if message.reason else "")
            yield log(text, level, self.robot, stamp_ns)
            yield from self._fault_lines(message, stamp_ns)
        elif isinstance(message, Status):
            yield from self._fault_lines(message, stamp_ns)
        elif isinstance(message, Control):
            for refusal in self._news.take(message):
                text = f"{refusal.command} of {refusal.who or 'somebody'} refused: {refusal.reason} ({refusal.count})"
                yield log(text, LogLevel.Warning, self.robot, stamp_ns)


def laser_scan(scan: Scan, frame: str, stamp_ns: int) -> bytes:
    """Encode ``foxglove.LaserScan``: the ranges as they are (invalid = NaN), the angles of the first and the last."""
    ranges = np.asarray(scan.ranges).astype("<f8").tobytes()
    end = scan.angle_min + scan.angle_increment * max(0, len(scan.ranges) - 1)
    angles = _ANGLES.pack(_START_ANGLE, scan.angle_min, _END_ANGLE, end, _RANGES)
    return b"".join((_timestamp(stamp_ns), _scan_place(frame), angles, _varint(len(ranges)), ranges))


def pose_in_frame(pose: Pose, frame: str, stamp_ns: int) -> bytes | None:
    """Encode ``foxglove.PoseInFrame``; None of a pose that is not finite."""
    if not _is_finite(pose):
        return None
    placed = fox.Pose(position=fox.Vector3(x=pose.x, y=pose.y, z=0.0), orientation=_turned(pose.heading))
    return fox.PoseInFrame(timestamp=_time(stamp_ns), frame_id=frame, pose=placed).encode()


def transforms(placed: Iterable[tuple[str, str, Pose]], stamp_ns: int) -> bytes:
    """Encode ``foxglove.FrameTransforms`` of (parent frame, child frame, the child's pose)."""
    return fox.FrameTransforms(
        transforms=[
            fox.FrameTransform(
                timestamp=_time(stamp_ns),
                parent_frame_id=parent,
                child_frame_id=child,
                translation=fox.Vector3(x=pose.x, y=pose.y, z=0.0),
                rotation=_turned(pose.heading),
            )
            for parent, child, pose in placed
        ]
    ).encode()


def grid(map_: Map, frame: str, stamp_ns: int) -> bytes | None:
    """Encode ``foxglove.Grid``: a colour for each cell, transparent where unknown; None of a map without cells."""
    if not (map_.rows and map_.columns):
        return None
    x, y = map_.origin
    return fox.Grid(
        timestamp=_time(stamp_ns),
        frame_id=frame,
        pose=fox.Pose(position=fox.Vector3(x=x, y=y, z=_MAP_Z_M), orientation=_NO_TURN),
        column_count=map_.columns,
        cell_size=fox.Vector2(x=map_.cell, y=map_.cell),
        row_stride=map_.columns * len(_CELL_FIELDS),
        cell_stride=len(_CELL_FIELDS),
        fields=_CELL_FIELDS,
        data=_CELL_COLORS[np.minimum(map_.cells, len(_CELL_COLORS) - 1)].tobytes(),
    ).encode()


def log(text: str, level: fox.LogLevel, name: str, stamp_ns: int) -> bytes:
    """Encode ``foxglove.Log``. name: who says it."""
    return fox.Log(timestamp=_time(stamp_ns), level=level, message=text, name=name).encode()


def compressed_image(image: Image, frame: str, stamp_ns: int) -> bytes | None:
    """Encode ``foxglove.CompressedImage``; None of an image without data."""
    if not image.data:
        return None
    time = _time(stamp_ns)
    return fox.CompressedImage(timestamp=time, frame_id=frame, data=image.data, format=image.format).encode()


def trail(points: Iterable[tuple[float, float]], frame: str, stamp_ns: int) -> bytes:
    """Encode ``foxglove.SceneUpdate``: a line through x, y of the points, instead of the one before."""
    line = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=_HERE,
        thickness=_TRAIL_WIDTH_M,
        points=[fox.Point3(x=x, y=y, z=0.0) for x, y in points],
        color=_TRAIL_COLOR,
    )
    entity = fox.SceneEntity(timestamp=_time(stamp_ns), frame_id=frame, id="trail", lines=[line])
    return fox.SceneUpdate(entities=[entity]).encode()


def _time(stamp_ns: int) -> fox.Timestamp:
    return fox.Timestamp(*divmod(stamp_ns, _SECOND_NS))


def _is_finite(pose: Pose) -> bool:
    return math.isfinite(pose.x) and math.isfinite(pose.y) and math.isfinite(pose.heading)


def _turned(heading: float) -> fox.Quaternion:
    return fox.Quaternion(x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2))


def _timestamp(stamp_ns: int) -> bytes:
    """Encode the first field of Foxglove's messages: seconds and nanoseconds, as two varints."""
    seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
    body = b"\x08" + _varint(seconds) + b"\x10" + _varint(nanoseconds)
    return b"\x0a" + _varint(len(body)) + body


@lru_cache(maxsize=1024)
def _scan_place(frame: str) -> bytes:
    """Encode the fields ``frame_id`` and ``pose`` of a scan: the scanner is where its frame is."""
    name, pose = frame.encode(), _HERE.encode()
    return b"\x12" + _varint(len(name)) + name + b"\x1a" + _varint(len(pose)) + pose


def _varint(value: int) -> bytes:
    """Encode a number that is not negative as protobuf's varint."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


class _Shape(msgspec.Struct, frozen=True):
    """The Foxglove message of a fleet message. write: makes its payload of message, frame and stamp; None: of none."""

    schema: str
    frame: str
    write: Callable[[Any, str, int], bytes | None]


class _DrawnAlso(msgspec.Struct, frozen=True):
    """A channel without a key of its own. sources: the paths below the robot whose messages are drawn on it."""

    schema: str
    sources: tuple[str, ...]
    draw: Callable[[FoxglovePictures, FleetMessage, int], Iterator[bytes]]


_SHAPES: dict[type[FleetMessage], _Shape] = {
    Scan: _Shape("LaserScan", "scan", laser_scan),
    Pose: _Shape("PoseInFrame", "map", pose_in_frame),
    Map: _Shape("Grid", "map", grid),
    Image: _Shape("CompressedImage", "base", compressed_image),
}
"""All other fleet messages are JSON."""
_DRAWN_ALSO = {
    "tf": _DrawnAlso("FrameTransforms", (topics.POSE.path, topics.SCAN.path), FoxglovePictures._frames),
    "trail": _DrawnAlso("SceneUpdate", (topics.POSE.path,), FoxglovePictures._on_trail),
    "log": _DrawnAlso("Log", (topics.TEXT.path, topics.STATUS.path, topics.CONTROL.path), FoxglovePictures._logged),
}
_ENCODE = msgspec.json.Encoder().encode
"""Writes NaN and infinity as null, bytes as base64."""
