"""Writes messages to the files of a recording: each to the channel of its key, with what belongs beside it.

A message goes to the channel of its key as it was; a command is followed by its sender; a message that has a picture by
its pictures. Log time is the time of arrival, publish time the message's ``stamp_ns``. A file that follows another one
begins with the last value of every state, so each stands for itself.
"""

from __future__ import annotations

import contextlib
import time
from collections import OrderedDict
from collections.abc import Mapping

import msgspec

from zbridge.errors import PayloadError, ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Status
from zbridge.fleet.topics import Delivery, Topic, split_key
from zbridge.views.recording.contents import SENT, ChannelKind, Pictures, Sent, channel_of, is_log, read_sender
from zbridge.views.recording.intake import Arrival, Losses
from zbridge.views.recording.tape import CHANNELS, Tape

ROBOTS = 4096
"""Most robots whose leases, states and descriptions are followed."""
STATES = 16_384
"""Most state keys whose last value is repeated at the begin of each file."""
_LEASES = 16
"""Leases of one robot whose holders are known."""
_LATEST_NS = 2**63


class _StampedFields(msgspec.Struct, gc=False):
    """The fields of a payload that matter to a recording."""

    stamp_ns: int = -1
    seq: int = -1


_read_stamp = msgspec.msgpack.Decoder(_StampedFields).decode


class _Track(msgspec.Struct, eq=False):
    """One key of the recording. channel: its id in the file of ``number``; seq: of its last message."""

    kind: ChannelKind
    topic: Topic | None = None
    number: int = 0
    channel: int | None = None
    count: int = 0
    seq: int = -1


class MessageWriter:
    """Writes messages to a tape. metadata: at the begin of each file.

    fleet: write the messages as they were. pictures: what draws them, None for none.
    """

    def __init__(
        self,
        tape: Tape,
        metadata: Mapping[str, Mapping[str, str]],
        *,
        fleet: bool = True,
        pictures: Pictures | None = None,
    ) -> None:
        self.messages = 0
        self.missing = Losses()
        """Messages that a sequence shows as lost before they came here."""
        self.refused = Losses()
        """Messages of channels that had no place in a file."""
        self._tape = tape
        self._metadata = dict(metadata)
        self._fleet = fleet
        self._pictures = pictures
        self._tracks: dict[tuple[str, bool], _Track] = {}
        self._by_kind: dict[ChannelKind, _Track] = {}
        self._holders: dict[str, OrderedDict[bytes, str]] = {}
        self._states: dict[str, Arrival] = {}
        self._described: dict[str, dict[str, str]] = {}

    def __repr__(self) -> str:
        return f"<MessageWriter {self._tape!r}, {self.messages} messages>"

    def begin(self) -> None:
        """Begin the first file; raise ZbridgeError if that is not possible."""
        try:
            self._tape.begin(time.monotonic(), self._metadata)
        except FileExistsError as error:
            raise ZbridgeError(f"{error.filename} exists: give another name") from error
        except OSError as error:
            raise ZbridgeError(f"{error.filename or 'the file'}: {error.strerror}") from error

    def keep_time(self, now_ns: int) -> None:
        """Flush what has waited, and begin another file if this one is full; raise OSError. Call it often."""
        now = time.monotonic()
        self._tape.keep_time(now)
        if self._tape.full(now):
            self._next_file(now_ns)

    def _next_file(self, now_ns: int) -> None:
        """Begin another file, with the last value of every state."""
        described = {f"robot/{robot}": pairs for robot, pairs in self._described.items()}
        self._tape.begin(time.monotonic(), self._metadata | described)
        for key, last in self._states.items():
            self._write_own(self._track(key, None), msgspec.structs.replace(last, arrived_ns=now_ns))

    def write(self, arrival: Arrival) -> None:
        """Write one message, and what belongs beside it; raise OSError."""
        track = self._track(arrival.key, arrival.attachment)
        self.messages += 1
        publish_ns = self._write_own(track, arrival)
        topic = track.topic
        if topic is not None:
            if topic.delivery is Delivery.STATE:
                self._note_state(topic, arrival)
            elif topic.delivery is Delivery.COMMAND:
                self._write_sender(arrival, publish_ns)
            if self._pictures is not None and topic.delivery is not Delivery.COMMAND:
                at_ns = arrival.arrived_ns
                for kind, stamp_ns, data in self._pictures.draw(arrival.key, topic, arrival.payload, at_ns):
                    self._put(self._extra(kind), at_ns, stamp_ns, data)
        elif self._pictures is not None and is_log(arrival.key):
            for kind, data in self._pictures.draw_line(arrival.key, arrival.payload, arrival.arrived_ns):
                self._put(self._extra(kind), arrival.arrived_ns, arrival.arrived_ns, data)

    def _write_own(self, track: _Track, arrival: Arrival) -> int:
        """Write a message as it was; return its publish time."""
        publish_ns = arrival.arrived_ns
        if track.topic is not None:
            try:
                stamp = _read_stamp(arrival.payload)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                pass
            else:
                if 0 < stamp.stamp_ns < _LATEST_NS:
                    publish_ns = stamp.stamp_ns
                if stamp.seq >= 0:
                    if 0 <= track.seq < stamp.seq - 1:
                        self.missing.add(arrival.key, stamp.seq - track.seq - 1)
                    track.seq = stamp.seq
        if self._fleet:
            self._put(track, arrival.arrived_ns, publish_ns, arrival.payload)
        return publish_ns

    def _put(self, track: _Track, log_ns: int, publish_ns: int, data: bytes) -> None:
        if track.number != self._tape.number:
            track.number, track.channel = self._tape.number, self._tape.register(track.kind)
        if track.channel is None:
            self.refused.add(track.kind.topic)
            return
        track.count += 1
        self._tape.write(track.kind.topic, track.channel, log_ns, publish_ns, track.count & 0xFFFFFFFF, data)

    def _track(self, key: str, attachment: bytes | None) -> _Track:
        """Return the channel of a key. Only so many are remembered: a robot may invent names without end."""
        datagram = attachment == topics.WIRE_DATAGRAM
        if (known := self._tracks.get((key, datagram))) is not None:
            return known
        split = split_key(key)
        topic = topics.find(split[2]) if split is not None else None
        if topic is not None and topic.delivery is Delivery.QUERY:
            topic = None
        track = _Track(channel_of(key, datagram=datagram), topic)
        if len(self._tracks) < 2 * CHANNELS:
            self._tracks[key, datagram] = track
        return track

    def _extra(self, kind: ChannelKind) -> _Track:
        """Return the channel of something that has no key of its own."""
        track = self._by_kind.get(kind)
        if track is None:
            track = _Track(kind)
            if len(self._by_kind) < 2 * CHANNELS:
                self._by_kind[kind] = track
        return track

    def _write_sender(self, arrival: Arrival, publish_ns: int) -> None:
        if not (self._fleet and "/@cmd/" in arrival.key):
            return
        lease = read_sender(arrival.attachment)
        holders: Mapping[bytes, str] = self._holders.get(arrival.key.partition("/@cmd/")[0], {})
        holder = holders.get(lease) if lease is not None else None
        sent = Sent(lease=lease, holder=holder, attachment=arrival.attachment or b"")
        self._put(self._track(arrival.key + SENT, None), arrival.arrived_ns, publish_ns, payloads.encode(sent))

    def _note_state(self, topic: Topic, arrival: Arrival) -> None:
        key = arrival.key
        if key in self._states or len(self._states) < STATES:
            self._states[key] = arrival
        robot = key.rpartition("/")[0]
        with contextlib.suppress(PayloadError):
            if topic is topics.CONTROL:
                self._note_holder(robot, payloads.decode(Control, arrival.payload))
            elif topic is topics.STATUS:
                self._describe(robot, payloads.decode(Status, arrival.payload))

    def _note_holder(self, robot: str, control: Control) -> None:
        if control.lease is None or control.holder is None:
            return
        if robot not in self._holders and len(self._holders) >= ROBOTS:
            return
        holders = self._holders.setdefault(robot, OrderedDict())
        holders[control.lease] = control.holder
        holders.move_to_end(control.lease)
        if len(holders) > _LEASES:
            holders.popitem(last=False)

    def _describe(self, robot: str, status: Status) -> None:
        """Write what a robot is, once it is known, and when it changes."""
        if status.state != "established":
            return
        name = robot.rpartition("/")[2]
        pairs = {
            "robot": name,
            "protocol": status.protocol or "",
            "dialect": status.dialect or "",
            "version": status.version or "",
            "features": ", ".join(status.features),
        }
        if self._described.get(name) != pairs and (name in self._described or len(self._described) < ROBOTS):
            self._described[name] = pairs
            self._tape.add_metadata(f"robot/{name}", pairs)
