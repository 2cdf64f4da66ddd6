"""Publishers of the classes of delivery: plain, stream and state.

A put that may block is carried out by a writer thread. A stream has a plain and an express publisher: the last message
of a batch is express, which makes the whole batch leave at once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import zenoh
import zenoh.ext

from zbridge.bus.interface import Batch, Publisher
from zbridge.bus.writer import Call, Writer
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
        if topic.delivery is Delivery.STREAM and not qos.newest:
            known = len(self.stream_keys) < STREAM_PUBLISHERS or key in self.stream_keys
            if known:
                self.stream_keys.add(key)
            kind = _StreamPublisher if known else _StreamKey
            return kind(self._session, key, options, self._streams, blocks=self._lossless)
        plain = self._session.declare_publisher(key, express=qos.express, **options)
        if qos.newest:  # large messages: of those that wait for the writer's thread only the newest is put
            return WrittenPublisher(key, plain.put, partial(self._streams.newest, key), plain)
        blocks = qos.congestion is Congestion.BLOCK
        return WrittenPublisher(key, plain.put, self._states.put if blocks else _write, plain)

    def frames(self, key: str, listened: Callable[[bool], object], *, best_effort: bool, kept: int) -> Publisher:
        """Declare a key of frames of any format; report when the first listener appears and the last one leaves.

        kept: last frames that late advanced subscribers get, and may query if one was lost.
        """
        congestion = _BLOCK if self._lossless else _DROP
        reliability = zenoh.Reliability.BEST_EFFORT if best_effort else zenoh.Reliability.RELIABLE
        plain: Any = self._session.declare_publisher(
            key, express=not best_effort, reliability=reliability, congestion_control=congestion
        )
        matching = plain.declare_matching_listener(threadless(lambda status: listened(status.matching)))
        publishers = [plain]
        if kept:
            advanced = zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=congestion,
                cache=zenoh.ext.CacheConfig(kept),
                publisher_detection=True,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=KEPT_TOLD_S),
            )
            publishers.append(advanced)
        write = partial(self._streams.put_at_once, size=1)
        return WrittenPublisher(key, publishers[-1].put, write, matching, *publishers)

    def put_all(self, batch: Batch) -> bool:
        """Publish stream messages, those of a key in order; False asks to pause the source."""
        return self._streams.put_at_once(partial(_put_batch, batch), sum(len(waiting) for _, waiting in batch))


class WrittenPublisher(Declared):
    """Writes a key by a call of Zenoh's that ``write`` makes: here, or on a thread of a writer if it may block."""

    last: bytes | None = None

    def __init__(self, key: str, put: Callable[..., object], write: Callable[[Call], bool], *entities: Any) -> None:
        """Begin. entities: what is undeclared at the end."""
        super().__init__(*entities)
        self.key = key
        self._put = put
        self._write = write

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        return self._write(partial(self._put, payload, attachment=attachment))


class _StreamPublisher(WrittenPublisher):
    """Writes a stream key, plain or express."""

    put_plain: Callable[..., object]
    put_express: Callable[..., object]

    def __init__(
        self, session: zenoh.Session, key: str, options: dict[str, Any], writer: Writer, *, blocks: bool
    ) -> None:
        self._writer = writer
        self._blocks = blocks
        if blocks:
            options = {**options, "congestion_control": _BLOCK}
        entities = self._declare(session, key, options)
        super().__init__(key, self.put_express, writer.put, *entities)

    def _declare(self, session: zenoh.Session, key: str, options: dict[str, Any]) -> tuple[Any, ...]:
        plain = session.declare_publisher(key, **options)
        express = session.declare_publisher(key, express=True, **options)
        self.put_plain, self.put_express = plain.put, express.put
        return plain, express

    def close(self) -> None:
        if self._blocks:  # what waits is still written
            self._writer.put(super().close)
        else:
            super().close()


class _StreamKey(_StreamPublisher):
    """Writes a stream key that Zenoh must forget when it is closed."""

    def _declare(self, session: zenoh.Session, key: str, options: dict[str, Any]) -> tuple[Any, ...]:
        expression = session.declare_keyexpr(key)
        self.put_plain = partial(session.put, expression, **options)
        self.put_express = partial(session.put, expression, express=True, **options)
        return (SimpleNamespace(undeclare=partial(session.undeclare, expression)),)


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


def _write(call: Call) -> bool:
    """Write here, on the caller's thread."""
    call()
    return True


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
