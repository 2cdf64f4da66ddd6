"""Publishers of the classes of delivery: plain, stream and state.

A put that may block is carried out by a writer thread. A stream has a plain and an express publisher: the last message
of a batch is express, which makes the whole batch leave at once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import zenoh
import zenoh.ext

from zbridge.bus.interface import Batch, Publisher
from zbridge.bus.writer import Writer
from zbridge.bus.zenoh.declared import Declared, threadless
from zbridge.fleet import payload as payloads
from zbridge.fleet.topics import Congestion, Delivery, Priority, QoS, Topic

STREAM_PUBLISHERS = 300
"""Stream keys that get publishers: Zenoh keeps 1.5 kB of each forever, here and in every router, and finds others more
slowly. Later ones are declared as keys only, which costs 0.5 us more per message."""

KEPT_TOLD_S = 2.0
"""Seconds after which the number of the last kept frame is announced, so that subscribers that lost it query it; one
timer per key."""


class Publishers:
    """Makes the publishers of one session.

    states: writes states and answers. streams: writes streams. lossless: streams block instead of being dropped.
    """

    def __init__(self, session: zenoh.Session, states: Writer, streams: Writer, *, lossless: bool) -> None:
        self._session = session
        self._states = states
        self._streams = streams
        self._lossless = lossless
        self._last_values = _LastValues(session, states)
        self.stream_keys: set[str] = set()
        """Stream keys that ever got publishers."""

    def __repr__(self) -> str:
        return f"<Publishers {len(self.stream_keys)} of {STREAM_PUBLISHERS} stream keys>"

    def make(self, key: str, topic: Topic, last: bytes | None = None) -> Publisher:
        """Declare ``key`` with the delivery of ``topic``; ``last``: its last value, published by another process."""
        qos, options = topic.qos, _options(topic)
        if qos.keeps_last:
            if last is not None:
                self._last_values.note(key, last)
            return _StatePublisher(self._session, key, options, self._states, self._last_values)
        if qos.newest:
            return _NewestPublisher(self._session, key, options, self._streams)
        if topic.delivery is Delivery.STREAM:
            known = len(self.stream_keys) < STREAM_PUBLISHERS or key in self.stream_keys
            if known:
                self.stream_keys.add(key)
            kind = _StreamPublisher if known else _StreamKey
            return kind(self._session, key, options, self._streams, blocks=self._lossless)
        plain = self._session.declare_publisher(key, express=qos.express, **options)
        blocks = qos.congestion is Congestion.BLOCK
        return PlainPublisher(key, plain, self._states if blocks else None)

    def put_all(self, batch: Batch) -> bool:
        """Publish stream messages, those of a key in order; False asks to pause the source."""
        return self._streams.put_at_once(partial(_put_batch, batch), sum(len(waiting) for _, waiting in batch))


class PlainPublisher(Declared):
    """Writes a key directly, or on a writer thread if a full queue blocks."""

    def __init__(self, key: str, publisher: zenoh.Publisher, writer: Writer | None, *watches: Any) -> None:
        """Begin. watches: what is undeclared with the publisher."""
        super().__init__(*watches, publisher)
        self.key = key
        self.last: bytes | None = None
        self._put = publisher.put
        self._writer = writer

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        if self._writer is not None:
            return self._writer.put(lambda: self._put(payload, attachment=attachment))
        self._put(payload, attachment=attachment)
        return True


class FramePublisher(Declared):
    """Writes frames of any format on a key, and reports when the first listener appears and the last one leaves.

    kept: last frames that late advanced subscribers get, and may query if one was lost. blocks: a congested bus delays
    frames instead of dropping them.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        writer: Writer,
        listened: Callable[[bool], None],
        *,
        best_effort: bool,
        kept: int,
        blocks: bool,
    ) -> None:
        congestion = _BLOCK if blocks else _DROP
        self.key = key
        self.last: bytes | None = None
        self._writer = writer
        reliability = zenoh.Reliability.BEST_EFFORT if best_effort else zenoh.Reliability.RELIABLE
        plain: Any = session.declare_publisher(
            key, express=not best_effort, reliability=reliability, congestion_control=congestion
        )
        matching = plain.declare_matching_listener(threadless(lambda status: listened(status.matching)))
        self._put: Callable[..., object] = plain.put
        publishers = [plain]
        if kept:
            advanced = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=congestion,
                cache=zenoh.ext.CacheConfig(kept),
                publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=KEPT_TOLD_S),
            )
            self._put = advanced.put
            publishers.append(advanced)
        super().__init__(matching, *publishers)

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        return self._writer.put_at_once(partial(self._put, payload, attachment=attachment), 1)


class _StreamPublisher(Declared):
    """Writes a stream key, plain or express."""

    put_plain: Callable[..., object]
    put_express: Callable[..., object]

    def __init__(
        self, session: zenoh.Session, key: str, options: dict[str, Any], writer: Writer, *, blocks: bool
    ) -> None:
        self.key = key
        self.last: bytes | None = None
        self._writer = writer
        self._blocks = blocks
        if blocks:
            options = {**options, "congestion_control": _BLOCK}
        super().__init__(*self._declare(session, key, options))

    def _declare(self, session: zenoh.Session, key: str, options: dict[str, Any]) -> tuple[Any, ...]:
        plain = session.declare_publisher(key, **options)
        express = session.declare_publisher(key, express=True, **options)
        self.put_plain, self.put_express = plain.put, express.put
        return plain, express

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        return self._writer.put(partial(self.put_express, payload, attachment=attachment))

    def close(self) -> None:
        if self._blocks:  # what waits is still written
            self._writer.put(super().close)
        else:
            super().close()


class _NewestPublisher(Declared):
    """Writes a stream of large messages, always on the writer's thread; of those waiting only the newest is put."""

    def __init__(self, session: zenoh.Session, key: str, options: dict[str, Any], writer: Writer) -> None:
        self.key = key
        self.last: bytes | None = None
        self._writer = writer
        self._publisher = session.declare_publisher(key, **options)
        super().__init__(self._publisher)

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        return self._writer.newest(self.key, lambda: self._publisher.put(payload, attachment=attachment))


class _StreamKey(_StreamPublisher):
    """Writes a stream key that Zenoh must forget when it is closed."""

    def _declare(self, session: zenoh.Session, key: str, options: dict[str, Any]) -> tuple[Any, ...]:
        expression = session.declare_keyexpr(key)
        self.put_plain = partial(session.put, expression, **options)
        self.put_express = partial(session.put, expression, express=True, **options)
        return (_Undeclared(lambda: session.undeclare(expression)),)


class _Undeclared(msgspec.Struct):
    """Something that a call undeclares."""

    undeclare: Callable[[], object]


class _LastValues:
    """The last value of every state key of a robot, for plain gets: one queryable answers for all of them."""

    def __init__(self, session: zenoh.Session, writer: Writer) -> None:
        self._session = session
        self._writer = writer
        self._encodings: dict[str, zenoh.Encoding] = {}
        self._values: dict[str, bytes] = {}
        self._queryables: dict[str, Declared] = {}

    def add(self, key: str, encoding: zenoh.Encoding) -> None:
        self._encodings[key] = encoding
        robot, _, _ = key.rpartition("/")
        if robot not in self._queryables:
            self._queryables[robot] = Declared(self._session.declare_queryable(f"{robot}/*", threadless(self._reply)))

    def note(self, key: str, payload: bytes) -> None:
        self._values[key] = payload

    def value(self, key: str) -> bytes | None:
        return self._values.get(key)

    def forget(self, key: str) -> None:
        """Stop answering for a key, and after a robot's last key for that robot."""
        self._values.pop(key, None)
        self._encodings.pop(key, None)
        robot, _, _ = key.rpartition("/")
        if not any(other.startswith(f"{robot}/") for other in self._encodings):
            queryable = self._queryables.pop(robot, None)
            if queryable is not None:
                queryable.close()

    def _reply(self, query: zenoh.Query) -> None:
        asked = query.key_expr
        known = [(key, value) for key, value in tuple(self._values.items()) if asked.intersects(zenoh.KeyExpr(key))]
        self._writer.put(lambda: self._answer(query, known))

    def _answer(self, query: zenoh.Query, known: list[tuple[str, bytes]]) -> None:
        try:
            for key, value in known:
                query.reply(key, value, encoding=self._encodings.get(key), express=True)
        finally:
            query.drop()  # type: ignore[no-untyped-call]


class _StatePublisher(Declared):
    """Writes a state key, which keeps its last value."""

    def __init__(
        self, session: zenoh.Session, key: str, options: dict[str, Any], writer: Writer, last_values: _LastValues
    ) -> None:
        self.key = key
        self._writer = writer
        self._last_values = last_values
        last_values.add(key, options["encoding"])
        self._publisher = session.declare_publisher(key, **options)
        super().__init__(self._publisher)

    @property
    def last(self) -> bytes | None:
        return self._last_values.value(self.key)

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        self._last_values.note(self.key, payload)
        return self._writer.replace(
            self.key, lambda: self._publisher.put(payload, attachment=attachment), 1 + len(payload) // 256
        )

    def close(self) -> None:
        self._last_values.forget(self.key)
        super().close()


def reply_and_drop(query: zenoh.Query, key: str, payload: bytes, attachment: bytes | None) -> None:
    """Answer a query, and end it; on a writer thread."""
    try:
        query.reply(key, payload, attachment=attachment, express=True)
    finally:
        query.drop()  # type: ignore[no-untyped-call]


def _put_batch(batch: Batch) -> None:
    streams: list[tuple[Any, list[bytes]]] = list(batch)
    last = streams[-1][1].pop()
    for publisher, waiting in streams:
        put = publisher.put_plain
        for payload in waiting:
            put(payload)
    streams[-1][0].put_express(last)


def _options(topic: Topic) -> dict[str, Any]:
    qos: QoS = topic.qos
    encoding = zenoh.Encoding(payloads.ENCODING).with_schema(payloads.schema(topic.message))
    return {
        "encoding": encoding,
        "priority": _PRIORITIES[qos.priority],
        "congestion_control": _CONGESTIONS[qos.congestion],
    }


_PRIORITIES = {
    Priority.DATA: zenoh.Priority.DATA,
    Priority.DATA_HIGH: zenoh.Priority.DATA_HIGH,
    Priority.REAL_TIME: zenoh.Priority.REAL_TIME,
}
_DROP, _BLOCK = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
_CONGESTIONS = {
    Congestion.DROP: _DROP,
    Congestion.BLOCK: _BLOCK,
}
