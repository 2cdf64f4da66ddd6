"""A session with a ROS 2 robot, as a node beside its nodes: topics are read, commands are repeated. Sans-IO.

The link is a Zenoh session (:mod:`zbridge.protocol.samples`). The handshake: the link is open; a publisher of one of
the robot's topics has a token; something came from it. The session ends when all tokens are gone or nothing came for
``silent_s``; before it ends, it sends the robot zeros. ROS has no handshake of its own: ``busy`` names what is missing,
and after :data:`HANDSHAKE_S` the link is opened anew.

A command from another node is overruled by a repetition of our last one, unless the robot is ``shared``: another node's
motion must not outlive a stop.
"""

from __future__ import annotations

import math
import struct
from typing import Any

from gateways.ros2.graph import Graph
from gateways.ros2.messages import LIVE, STOPPED, TWIST_STAMPED, LinkEvent, TwistCommand, Velocity, write_twist
from gateways.ros2.options import RosOptions
from zbridge.protocol import (
    SAMPLE_BYTES,
    Count,
    KeyedSample,
    Limits,
    NotReady,
    Outbox,
    ProtocolError,
    RateLimit,
    Role,
    SampleKind,
    Session,
    State,
    read_sample,
    sample_end,
    subscription,
    write_sample,
)
from zbridge.ros2.rmw_zenoh import KEEP_LAST_10, LATCHED, SENSOR_DATA, Attachment, Endpoint, Kind, Node, read_attachment
from zbridge.ros2.types import Types

HANDSHAKE_S = 60.0
"""Seconds after which the link is opened anew where nothing of the robot was received."""
CLOSING_S = 0.5
"""Seconds for which zeros are repeated before a session ends."""
ZEROS_S = 1.0
"""Seconds for which zeros are repeated after neutral."""
WATCH_S = 2.0
"""Seconds between two queries for tokens, while something of the robot is missing."""
ANSWERS_HZ = 100.0
"""Most times a second that other nodes' commands are overruled."""
_DRIVE = "drive"
_KIND_AT = 4
"""Offset of the kind in a frame."""
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
"""Offset of the stamp in a TwistStamped as CDR: behind the encapsulation header."""
_NS_PER_S = 1_000_000_000
_SHOWN = 64
"""Longest name of another node that is shown."""


class RosRole(Session[Any]):
    """We play a node that reads one robot's topics and writes its commands. overruled: counts others' commands."""

    role = Role.HQ
    frame_end = staticmethod(sample_end)
    handled = frozenset({LinkEvent, TwistCommand})

    def __init__(self, options: RosOptions, types: Types, overruled: Count) -> None:
        super().__init__(Limits(frame_bytes=SAMPLE_BYTES, handshake_s=HANDSHAKE_S))
        self.transport = "zenoh"
        self.outbox = _Dated(self)
        self.graph = Graph(options, types)
        self._options = options
        self._types = types
        self._overruled = overruled
        self._node: Node | None = None
        self._endpoints = 0
        self._own: dict[tuple[str, Kind], Endpoint] = {}
        """Our endpoints, by the keys that they read or write."""
        self._gids: dict[str, bytes] = {}
        """Our gids, by the keys that we write."""
        self._numbers: dict[str, int] = {}
        self._lost, self._lost_at = "", -math.inf
        """Why the session will end, and since when that is known."""
        self._velocity = STOPPED
        self._now = self._received_at = -math.inf
        self._time: tuple[int, float] = (0, 0.0)
        """Unix time of the last frame, and when it came on the session's own time line."""
        self._robot_time: tuple[int, float] | None = None
        """The same of the robot's clock, by its last stamp."""
        self._watch_at = -math.inf
        self._answers = RateLimit(ANSWERS_HZ)

    # Messages

    def encode(self, message: KeyedSample) -> bytes:
        return write_sample(message)

    def receive(self, data: bytes, now: float) -> list[Any]:
        self._now = now
        return super().receive(data, now)

    def decode(self, frame: bytes) -> Any:
        sample = read_sample(frame)
        self._time = sample.stamp_ns, self._now
        if sample.kind is not SampleKind.SAMPLE:
            return LinkEvent(sample)
        found = self.graph.keys.get(sample.key)
        if found is None:
            raise ProtocolError(f"{sample.key[:200]}: nothing of this robot")
        wanted, type_name = found
        gid = read_attachment(sample.attachment).gid
        if gid == self._gids.get(sample.key):
            return LinkEvent(sample)
        if gid not in self.graph.gids and wanted.received is not TwistCommand:  # robots obey whoever writes
            raise ProtocolError(f"{wanted.name}: from no publisher that has a token")
        message = wanted.received(self._types.decode(type_name, sample.payload))
        if wanted.received is not TwistCommand:
            self._received_at = self._now
            if self._lost and self.graph.publishers:
                self._lost = ""
                self._update_status()
            if isinstance(message, LIVE):
                self._robot_time = message.stamp_ns, self._now
        return message

    def accept(self, message: Any, now: float) -> bool:
        if isinstance(message, LinkEvent):
            self._on_event(message.sample)
            return False
        if isinstance(message, TwistCommand):
            self._overrule(now)
            return False
        if self.state is State.HANDSHAKING:
            self.establish("", self.graph.features)
            self._update_status()
        return True

    # The link and the graph

    def opened(self, now: float) -> None:
        self.busy = "no word of the router yet"

    def _on_event(self, sample: KeyedSample) -> None:
        if sample.kind is SampleKind.DROPPED:
            self.traffic.dropped += sample.count
        elif sample.kind is SampleKind.OPENED and self._node is None:
            self._begin(sample.payload.decode("ascii", "replace"))
        elif sample.kind is SampleKind.OPENED:
            self._watch_again()
        elif sample.kind is SampleKind.APPEARED and not self.graph.knows(sample.key):
            try:
                self._appeared(self.graph.appeared(sample.key))
            finally:
                self._update_status()
        elif sample.kind is SampleKind.GONE and self.graph.gone(sample.key):
            self._update_status()
            if self.state is State.ESTABLISHED and not self.graph.publishers:
                self._lose("its publishers are gone", self._now)

    def _begin(self, zid: str) -> None:
        self.graph.own_zid = zid
        self._node = Node(self._options.domain, zid, 0, self._options.full_namespace, "zbridge")
        self.send_first(KeyedSample(SampleKind.ANNOUNCE, self._node.token()))
        for expression in self.graph.watched():
            self.send_first(KeyedSample(SampleKind.WATCH, expression))
        self._update_status()

    def _watch_again(self) -> None:
        """Ask for tokens again while something is missing: Zenoh may lose the news of some."""
        if self.busy is not None and self._now >= self._watch_at:
            self._watch_at = self._now + WATCH_S
            for expression in self.graph.watched():
                self.send_first(KeyedSample(SampleKind.WATCH, expression))

    def _appeared(self, endpoint: Endpoint) -> None:
        """Read or write the key of a new endpoint, unless that is done already; show that by a token of our own."""
        wanted = self.graph.of_topic(endpoint.name)
        if endpoint.kind is Kind.SUBSCRIBER:
            self._announce_endpoint(endpoint, Kind.PUBLISHER)
        if wanted.received is not TwistCommand or not self._options.shared:
            self._announce_endpoint(endpoint, Kind.SUBSCRIBER, latched=wanted.latched)
            self.send_first(subscription(endpoint.key, kept=wanted.latched))

    def _announce_endpoint(self, endpoint: Endpoint, kind: Kind, *, latched: bool = False) -> None:
        if (endpoint.key, kind) in self._own or self._node is None:
            return
        self._endpoints += 1
        qos = KEEP_LAST_10 if kind is Kind.PUBLISHER else LATCHED if latched else SENSOR_DATA
        own = Endpoint(self._node, self._endpoints, kind, endpoint.name, endpoint.type_name, endpoint.type_hash, qos)
        self._own[endpoint.key, kind] = own
        if kind is Kind.PUBLISHER:
            self._gids[endpoint.key] = own.gid()
        self.send_first(KeyedSample(SampleKind.ANNOUNCE, own.token()))

    def _update_status(self) -> None:
        """Update ``busy`` (what is missing) and ``doubts`` (who else drives)."""
        if self.over:
            return
        if self.state is State.ESTABLISHED:
            self.busy, self.features = self._lost or self.graph.drive_problem, self.graph.features
            nodes = sorted({driver.node.full_name[:_SHOWN] for driver in self.graph.drivers.values()})
            others = f"{', '.join(nodes[:3])} {'publish' if len(nodes) > 1 else 'publishes'} {self.graph.command_topic}"
            self.doubts = (f"{others} too, and is overruled",) if nodes and not self._options.shared else ()
        else:
            self.busy = self.graph.waiting_for

    # Time

    def timers(self) -> float:
        if self.state is not State.ESTABLISHED:
            return math.inf
        return self._lost_at + CLOSING_S if self._lost else self._received_at + self._options.silent_s

    def on_timer(self, now: float) -> None:
        if self._lost:
            self.close(self._lost, now)
        else:
            self._lose(f"nothing came for {self._options.silent_s:g} s", now)

    def _lose(self, reason: str, now: float) -> None:
        """Refuse drives and repeat zeros; end after :data:`CLOSING_S`: one frame alone may be lost on the way."""
        self._lost, self._lost_at = reason, now
        if self._must_stop:
            self.drive(STOPPED, now, urgent=True)
        self._update_status()

    def close(self, reason: str, now: float) -> None:
        """Send zeros to the robot, and end."""
        if self.state is State.ESTABLISHED and self._must_stop:
            self.drive(STOPPED, now, until=now, urgent=True)
        super().close(reason, now)

    @property
    def _must_stop(self) -> bool:
        """Whether zeros are due before the session ends: another node may be driving a ``shared`` robot."""
        return bool(self.graph.subscribers) and (self.moving or not self._options.shared)

    # Commands

    @property
    def moving(self) -> bool:
        """Whether the last command was motion."""
        return self._velocity != STOPPED

    def drive(self, velocity: Velocity, now: float, *, until: float | None = None, urgent: bool = False) -> None:
        """Send a velocity at once, then repeat it at ``cmd_vel_hz``; zeros until ``until``, or for :data:`ZEROS_S`.

        Raises NotReady if nobody subscribes, EncodeError.
        """
        frames = self._commands(velocity)
        if not frames:
            raise NotReady(self.graph.drive_problem or "nobody takes commands")
        if velocity != STOPPED:
            until = math.inf
        elif until is None:
            until = now + ZEROS_S
        self._velocity = velocity
        period_s = 1.0 / self._options.cmd_vel_hz
        self.outbox.set(_DRIVE, frames, now, period_s=period_s, until=until, urgent=urgent)

    def _commands(self, velocity: Velocity) -> tuple[bytes, ...]:
        """Write a velocity for each subscribed type; :class:`_Dated` completes the frames when they leave."""
        keys = {subscriber.key: subscriber.type_name for subscriber in self.graph.subscribers.values()}
        return tuple(
            write_sample(KeyedSample(SampleKind.PUT, key, write_twist(self._types, type_name, velocity)))
            for key, type_name in keys.items()
        )

    def _overrule(self, now: float) -> None:
        """Repeat our last command: another node has sent one."""
        if self.state is not State.ESTABLISHED or self._options.shared or not self._answers.take(now):
            return
        self._overruled.value += 1
        until = None if self.moving or self.outbox.is_set(_DRIVE) else now  # zeros of a stop are not cut short
        if self.graph.subscribers:
            self.drive(self._velocity, now, until=until, urgent=not self.moving)

    def dated(self, frame: bytes, now: float) -> bytes:
        """Complete a command that leaves now: its number, our gid, the time, and the stamp on the robot's clock."""
        if frame[_KIND_AT] != SampleKind.PUT:
            return frame
        sample = read_sample(frame)
        gid = self._gids[sample.key]
        number = self._numbers[sample.key] = self._numbers.get(sample.key, 0) + 1
        sent_ns = self._time[0] + round((now - self._time[1]) * _NS_PER_S)
        payload = self._stamped(sample, _robot_stamp(self._robot_time, now))
        attachment = Attachment(number, max(0, sent_ns), gid).encode()
        return write_sample(KeyedSample(SampleKind.PUT, sample.key, payload, attachment))

    def undated(self, frame: bytes) -> bytes:
        if frame[_KIND_AT] != SampleKind.PUT:
            return frame
        sample = read_sample(frame)
        return write_sample(KeyedSample(SampleKind.PUT, sample.key, self._stamped(sample, bytes(_STAMP.size))))

    def _stamped(self, sample: KeyedSample, stamp: bytes) -> bytes:
        """Write a stamp into a command, if its type has one."""
        if self.graph.keys[sample.key][1] != TWIST_STAMPED:
            return sample.payload
        return sample.payload[:_STAMP_AT] + stamp + sample.payload[_STAMP_AT + _STAMP.size :]

    def overdue(self) -> str:
        return self.graph.waiting_for


def _robot_stamp(robot_time: tuple[int, float] | None, now: float) -> bytes:
    """Write the time on the robot's clock, be it simulated or wrong: controllers drop what is old there."""
    stamp_ns, received_at = robot_time or (0, now)
    seconds, ns = divmod(stamp_ns + round((now - received_at) * _NS_PER_S), _NS_PER_S)
    return _STAMP.pack(seconds, ns) if 0 <= seconds < 2**31 else bytes(_STAMP.size)


class _Dated(Outbox):
    """Completes commands as they leave: their numbers and times rise although their frames are repeated."""

    def __init__(self, session: RosRole) -> None:
        super().__init__(0.0)
        self._session = session

    def take(self, now: float) -> bytes | None:
        frame = super().take(now)
        return self._session.dated(frame, now) if frame is not None else None
