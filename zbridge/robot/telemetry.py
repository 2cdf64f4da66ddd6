"""The way out: what one robot sent, translated and published.

Theory of operation. A read from the robot's socket gives many messages. The payloads of one read are gathered by
stream, and given to the bus in one call; states are put one by one. Where the bus is slower than the robot, a lossy
stream drops the oldest, and a lossless bus asks to pause: then the links read nothing until the bus is relieved. Every
:data:`ATTEND_EVERY` messages the commands that wait are served, so that a long read delays no stop.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from zbridge.blackbox import BlackBox
from zbridge.bus import Publisher
from zbridge.control.context import RobotContext
from zbridge.errors import ProtocolError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.topics import Delivery, Topic
from zbridge.log import Log
from zbridge.metrics import Count, Metrics
from zbridge.protocol.plugin import Translate
from zbridge.protocol.session import Datagram
from zbridge.robot.connection import Connection, Links
from zbridge.robot.on_demand import Listened, OnDemand
from zbridge.robot.publishers import RobotPublishers
from zbridge.robot.queries import PendingQueries

log = Log("zbridge.robot.telemetry")

ATTEND_EVERY = 64
"""Messages of a read between two looks at the commands that wait."""


class _Published(dict[str, tuple[Count, Count]]):
    """Messages and bytes published, by path; the paths of a family share their counters."""

    def __init__(self, metrics: Metrics) -> None:
        super().__init__()
        self._metrics = metrics

    def __missing__(self, path: str) -> tuple[Count, Count]:
        count = partial(self._metrics.count, direction="out", kind=path.partition("/")[0])
        counts = self[path] = (count("bus_messages"), count("bus_bytes"))
        return counts


class Telemetry:
    """Publishes what one robot sent. pending: queries that what is published may answer."""

    def __init__(
        self, context: RobotContext, publishers: RobotPublishers, pending: PendingQueries, links: Links
    ) -> None:
        self._context = context
        self._bus = context.bus
        self._clock_ns = context.clock_ns
        self._publishers = publishers
        self._pending = pending
        self._links = links
        self._translators: dict[type, Translate] = {}
        self._counts = _Published(context.metrics)
        self._box = context.box
        self._untranslatable = context.metrics.count("untranslatable_messages")
        self._unnamed = context.metrics.count("names_dropped")

    def __repr__(self) -> str:
        return f"<Telemetry {self._context.keys.robot} {self._publishers!r}>"

    def serve(self) -> list[OnDemand]:
        """Publish on demand what is only published while somebody listens."""
        keys = self._context.keys
        frames = {
            keys.key(f"@wire/{connection.name}/{direction}"): self._show_frames(connection, direction)
            for connection in self._links
            for direction in ("in", "out")
        }
        families: dict[str, dict[str, Listened]] = {keys.key("@wire/**"): frames}
        for topic in self._context.robot.on_demand:
            family, _, _ = topic.path.rpartition("/")
            asked = families.setdefault(keys.key(f"{family}/*" if family else topic.path), {})
            asked[keys.key(topic.path)] = self._tell_robot(topic)
        opened = [OnDemand(self._bus, key_expr, listened) for key_expr, listened in families.items()]
        for each in opened:
            each.open()
        return opened

    def deliver(self, messages: list[Any]) -> None:
        """Publish what the robot sent; the newest wins where the bus is slower, unless it is told to block."""
        stamp_ns = self._clock_ns()
        encode, translators, waiting = payloads.encode, self._translators, self._pending.waiting
        publishers, known = self._publishers, self._publishers.known
        streams: dict[str, list[bytes]] = {}
        flowing = True
        for number, message in enumerate(messages, 1):
            if not number % ATTEND_EVERY:
                self._bus.attend()
            translate = translators.get(type(message)) or self._translator(type(message))
            try:
                for topic, telemetry in translate(message, stamp_ns):
                    payload = encode(telemetry)
                    stream = streams.get(topic.path)
                    if stream is not None:
                        stream.append(payload)
                    elif (publisher := known.get(topic.path) or publishers.get(topic)) is None:
                        self._unnamed.value += 1
                    elif topic.delivery is Delivery.STREAM:
                        streams[topic.path] = [payload]
                    else:
                        flowing = self._publish_state(publisher, topic, payload) and flowing
                    if waiting:
                        self._pending.answer(topic, payload)
            except ProtocolError as error:
                self._untranslatable.value += 1
                log.debug("message_untranslatable", "{robot}: {error}", robot=self._context.keys.robot, error=error)
        if streams:
            flowing = self._publish_streams(streams) and flowing
        if not flowing:
            self._links.pause_reading()

    def _publish_state(self, publisher: Publisher, topic: Topic, payload: bytes) -> bool:
        """Publish one state; False if the bus asks to pause."""
        messages_out, bytes_out = self._counts[topic.path]
        messages_out.value += 1
        bytes_out.value += len(payload)
        if self._box is not None and not self._publishers.muted:
            self._box.put(publisher.key, payload)
        return publisher.put(payload)

    def _publish_streams(self, streams: dict[str, list[bytes]]) -> bool:
        """Publish the streams of one read; False if the bus asks to pause."""
        known, counts, batch = self._publishers.known, self._counts, []
        for path, stream in streams.items():
            batch.append((known[path], stream))
            messages_out, bytes_out = counts[path]
            messages_out.value += len(stream)
            bytes_out.value += len(stream[0]) if len(stream) == 1 else sum(map(len, stream))
        if self._publishers.muted:
            return True
        if self._box is not None:
            _record(self._box, batch)
        return self._bus.put_all(batch)

    def _translator(self, kind: type) -> Translate:
        translate = self._translators[kind] = self._context.robot.translator(kind)
        return translate

    def _show_frames(self, connection: Connection, direction: str) -> Listened:
        """Publish the raw frames of one direction while somebody listens."""

        def listened(publisher: Publisher, anybody: bool) -> None:
            def show(frame: bytes) -> None:
                publisher.put(frame, topics.WIRE_DATAGRAM if type(frame) is Datagram else None)

            connection.wire.watch(direction, show if anybody else None)

        return listened

    def _tell_robot(self, topic: Topic) -> Listened:
        """Tell the robot whether anybody listens to a topic."""

        def listened(_: Publisher, anybody: bool) -> None:
            try:
                self._context.robot.listened(topic, anybody)
                self._context.pump()
            except Exception as error:
                if not isinstance(error, Refused):
                    self._context.faults.note(topic.path, error)

        return listened


def _record(box: BlackBox, batch: list[tuple[Publisher, list[bytes]]]) -> None:
    """Put streams into the black box; images are too large for it."""
    for publisher, stream in batch:
        if not publisher.key.endswith(f"/{topics.IMAGE.path}"):
            for payload in stream:
                box.put(publisher.key, payload)
