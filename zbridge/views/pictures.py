"""The pictures of one robot: which channels a viewer is offered, and what each fleet message adds to them. Sans-IO.

A channel is named as its key below the realm: ``/r1/scan``. Three have no key of their own: ``/r1/tf`` (where the
frames are), ``/r1/trail`` (where the robot was) and ``/r1/log`` (texts, states and refusals). Frames after REP 105:
``r1/map`` is the robot's own map, ``r1/base`` the robot, ``r1/scan`` its scanner, which is where the robot is.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Container, Iterator

import msgspec
from foxglove.messages import LogLevel

from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Image, Map, Pose, Scan, Status, Text
from zbridge.fleet.topics import Topic
from zbridge.lease.lease_events import RefusalNews
from zbridge.views import foxglove_messages
from zbridge.views.schemas import Schema, foxglove_schema, json_schema
from zbridge.views.stamps import measured_ns

TRAIL_POINTS = 256
"""Most points of a trail."""
TRAIL_M = 0.05
"""A trail has a point so often, metres."""
TRAIL_EVERY_NS = 200_000_000
"""A trail is drawn at most so often: 5 times a second."""
FRAMES_EVERY_NS = 1_000_000_000
"""The scanner's frame is told so often where no pose tells it: once a second."""
_END_NS = 2**32 * 1_000_000_000
"""A stamp from here on has no place in a Foxglove message."""
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


def channels_of(robot: str, path: str) -> tuple[ViewerChannel, ...]:
    """Return the channels that the messages of a path below the robot are drawn on; none for an unknown path."""
    topic = topics.find(path)
    if topic is None:
        return ()
    also = tuple(_also(robot, name) for name, sources in _SOURCES.items() if path in sources)
    if topic is topics.TEXT:
        return also
    own = _SHAPES.get(topic.message)
    schema = foxglove_schema(own) if own is not None else json_schema(topic.message)
    return (ViewerChannel(f"/{robot}/{path}", path, schema, topic.qos.keeps_last), *also)


def sources_of(channel: ViewerChannel) -> tuple[str, ...]:
    """Return the paths below the robot whose messages are drawn on a channel."""
    return _SOURCES.get(channel.path, (channel.path,))


def _also(robot: str, name: str) -> ViewerChannel:
    return ViewerChannel(f"/{robot}/{name}", name, foxglove_schema(_ALSO[name]), keeps_last=name == "trail")


class FoxglovePictures:
    """Draws what one robot publishes. It keeps what the trail, the frames and the log need, and nothing else."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self._map, self._base, self._scan = (f"{robot}/{frame}" for frame in ("map", "base", "scan"))
        self._channels: dict[str, tuple[ViewerChannel, ...]] = {}
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL_POINTS)
        self._trail_drawn_ns = self._frames_sent_ns = -_END_NS
        self._state: tuple[str, str | None] | None = None
        self._news = RefusalNews(lambda _: True)

    def __repr__(self) -> str:
        return f"<FoxglovePictures {self.robot}>"

    def draw(
        self, topic: Topic, message: FleetMessage, now_ns: int, wanted: Container[str] | None = None
    ) -> list[Picture]:
        """Return the pictures of a message that the robot published on a topic; none of a pose or map without content.

        now_ns: when it came, Unix nanoseconds. wanted: names of the channels to draw (``scan``, ``tf``); None: all.
        """
        if (channels := self._channels.get(topic.path)) is None:
            channels = channels_of(self.robot, topic.path)
            if len(self._channels) < _KNOWN:
                self._channels[topic.path] = channels
        stamp_ns = measured_ns(message.stamp_ns, now_ns, _END_NS)
        return [
            Picture(channel, payload, stamp_ns)
            for channel in channels
            if wanted is None or channel.path in wanted
            for payload in self._drawn(channel, message, stamp_ns)
        ]

    def _drawn(self, channel: ViewerChannel, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        if (also := _DRAWN_ALSO.get(channel.path)) is not None:
            yield from also(self, message, stamp_ns)
        elif isinstance(message, Scan):
            yield foxglove_messages.laser_scan(message, self._scan, stamp_ns)
        elif isinstance(message, Pose):
            if _is_finite(message):
                yield foxglove_messages.pose_in_frame(message, self._map, stamp_ns)
        elif isinstance(message, Map):
            if message.rows and message.columns:
                yield foxglove_messages.grid(message, self._map, stamp_ns)
        elif isinstance(message, Image):
            if message.data:
                yield foxglove_messages.compressed_image(message.data, message.format, self._base, stamp_ns)
        else:
            yield _ENCODE(message)

    def _frames(self, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        """Tell where the frames are: with every pose, and once a second where only scans come."""
        scanner = (self._base, self._scan, None)
        if isinstance(message, Pose) and _is_finite(message):
            self._frames_sent_ns = stamp_ns
            yield foxglove_messages.transforms(((self._map, self._base, message), scanner), stamp_ns)
        elif abs(stamp_ns - self._frames_sent_ns) >= FRAMES_EVERY_NS:
            self._frames_sent_ns = stamp_ns
            yield foxglove_messages.transforms((scanner,), stamp_ns)

    def _on_trail(self, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        if not isinstance(message, Pose) or not _is_finite(message):
            return
        at = (message.x, message.y)
        if self._trail and math.dist(at, self._trail[-1]) < TRAIL_M:
            return
        self._trail.append(at)
        if abs(stamp_ns - self._trail_drawn_ns) >= TRAIL_EVERY_NS:
            self._trail_drawn_ns = stamp_ns
            yield foxglove_messages.trail(self._trail, self._map, stamp_ns)

    def _logged(self, message: FleetMessage, stamp_ns: int) -> Iterator[bytes]:
        """Write texts, changes of the robot's state, and refusals that are new."""
        if isinstance(message, Text):
            yield foxglove_messages.log(message.text, _LEVELS[message.kind], message.sender or self.robot, stamp_ns)
        elif isinstance(message, Status) and self._state != (message.state, message.reason):
            self._state = (message.state, message.reason)
            level = LogLevel.Info if message.state == "established" else LogLevel.Warning
            text = message.state + (f": {message.reason}" if message.reason else "")
            yield foxglove_messages.log(text, level, self.robot, stamp_ns)
        elif isinstance(message, Control):
            for refusal in self._news.take(message):
                text = f"{refusal.command} of {refusal.who or 'somebody'} refused: {refusal.reason} ({refusal.count})"
                yield foxglove_messages.log(text, LogLevel.Warning, self.robot, stamp_ns)


def _is_finite(pose: Pose) -> bool:
    return math.isfinite(pose.x) and math.isfinite(pose.y) and math.isfinite(pose.heading)


_KNOWN = 4096
"""Paths whose channels are remembered."""
_SHAPES: dict[type[FleetMessage], str] = {
    Scan: "LaserScan",
    Pose: "PoseInFrame",
    Map: "Grid",
    Image: "CompressedImage",
}
"""The Foxglove message of a fleet message; JSON for all others."""
_ALSO = {"tf": "FrameTransforms", "trail": "SceneUpdate", "log": "Log"}
"""The channels without a key of their own, and their Foxglove messages."""
_SOURCES = {
    "tf": (topics.POSE.path, topics.SCAN.path),
    "trail": (topics.POSE.path,),
    "log": (topics.TEXT.path, topics.STATUS.path, topics.CONTROL.path),
}
_Also = Callable[[FoxglovePictures, FleetMessage, int], Iterator[bytes]]
_DRAWN_ALSO: dict[str, _Also] = {
    "tf": FoxglovePictures._frames,
    "trail": FoxglovePictures._on_trail,
    "log": FoxglovePictures._logged,
}
_ENCODE = msgspec.json.Encoder().encode
"""Writes NaN and infinity as null, bytes as base64."""
