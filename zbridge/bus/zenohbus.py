"""The bus over Zenoh: the only module that imports it.

Zenoh calls back on threads of its own, and a slow callback stalls the whole session: callbacks here only
put what came where the event loop finds it. Whatever may block (states, answers, streams in ``block``
mode) is written by a thread of ours, never by the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

# One thread that receives instead of several that wake one another for each message; read when zenoh is imported.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1), acc: (handover: rx))")

import msgspec
import zenoh
import zenoh.ext

from zbridge.bus.inbox import Inbox, Source
from zbridge.bus.interface import Answer, Batch, BusSettings, Handle, Lane, Look, Publisher, Question, Sample, Sort
from zbridge.bus.writer import Writer
from zbridge.errors import BusError, PayloadError, Refused, refusal
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Denied
from zbridge.fleet.topics import Congestion, Delivery, Priority, QoS, SizeBounds, Topic, is_concrete
from zbridge.metrics import Count, Metrics
from zbridge.protocol.rate_limit import RateLimit

log = logging.getLogger("zbridge.bus")

H = TypeVar("H", bound=Handle)

_ORIGIN = re.compile(r"\s+at /.*", re.DOTALL)

PATIENCE_US = 20_000
"""Microseconds a stream message waits for room in a full transmission queue before it is dropped."""
QUESTIONS_HZ = 500.0
"""Questions a second that one queryable answers."""
LEAVE_S = 0.4
"""Longest time leaving the bus takes."""
FLUSH_S = 2.0
"""Longest time the bus may take to accept what blocks."""
OPEN_S = 1.0
"""Longest time one attempt to open a client session takes."""

UNDECLARE_S = 1.0
"""Longest time an entity is tried to be taken back whose callback runs on."""

_AT_ONCE, _PAUSE_S = 4, 0.0005
"""How often, and at what distance, that is tried by the thread that asks: it may be the event loop's."""
PUBLISHERS = 300
"""Different stream keys that are given publishers: Zenoh keeps 1.5 kB of each for ever, here and in every router, and
finds others more slowly. Later ones are declared as keys only: that takes 0.5 us more for each message."""
REPLIES = 10_000
"""Most replies to one query."""
_EACH = 16
"""Most replies of one session to a query for one key."""
_TIDY = 64
_INGRESS = ("ingress",)
_BOUNDED = ("put", "delete", "query")
_DENIED = zenoh.Encoding(payloads.ENCODING).with_schema(payloads.schema(Denied))

_PRIORITIES = {
    Priority.DATA: zenoh.Priority.DATA,
    Priority.DATA_HIGH: zenoh.Priority.DATA_HIGH,
    Priority.REAL_TIME: zenoh.Priority.REAL_TIME,
}
_CONGESTIONS = {
    Congestion.DROP: zenoh.CongestionControl.DROP,
    Congestion.BLOCK: zenoh.CongestionControl.BLOCK,
}


def zenoh_config(settings: BusSettings, *, wait_for_peers: bool = False, bounds: SizeBounds = ()) -> zenoh.Config:
    """Write settings as a Zenoh configuration; raise BusError naming what Zenoh does not take."""
    values: dict[str, Any] = {
        "mode": settings.effective_mode,
        "connect/endpoints": settings.connect,
        "scouting/multicast/enabled": settings.multicast,
        "open/return_conditions/connect_scouted": wait_for_peers,
        # A pool of 28 MB in every process, for payloads a robot does not have.
        "transport/shared_memory/enabled": False,
        # A stream is dropped when the bus stands still, not when a thread of it is late by a millisecond.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": PATIENCE_US,
    }
    if settings.listen:
        values["listen/endpoints"] = settings.listen
    if bounds:
        values["low_pass_filter"] = [
            {
                "id": str(number),
                "flows": _INGRESS,
                "messages": _BOUNDED,
                "key_exprs": key_exprs,
                "size_limit": most_bytes,
            }
            for number, (key_exprs, most_bytes) in enumerate(bounds)
        ]
    if settings.effective_mode == "client":
        values["connect/timeout_ms"] = int(OPEN_S * 1000)
    if settings.tls is not None:
        values["transport/link/tls/root_ca_certificate"] = settings.tls.ca
        if settings.tls.certificate and settings.tls.key:
            values["transport/link/tls/enable_mtls"] = True
            for side in ("listen", "connect"):
                values[f"transport/link/tls/{side}_certificate"] = settings.tls.certificate
                values[f"transport/link/tls/{side}_private_key"] = settings.tls.key
    config = zenoh.Config()
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"{key} = {value!r}: {_ORIGIN.sub('', str(error))}") from error
    return config


async def open_zenoh(
    settings: BusSettings, metrics: Metrics, *, wait_for_peers: bool = False, bounds: SizeBounds = ()
) -> ZenohBus:
    """Open a Zenoh session; raise BusError where that is not possible (a client: no router within a second)."""
    config = zenoh_config(settings, wait_for_peers=wait_for_peers, bounds=bounds)
    try:
        session = await asyncio.to_thread(zenoh.open, config)
    except zenoh.ZError as error:
        raise BusError(_ORIGIN.sub("", str(error))) from error
    return ZenohBus(session, asyncio.get_running_loop(), metrics, stream=settings.stream)


class ZenohBus:
    """The bus over one Zenoh session."""

    def __init__(
        self,
        session: zenoh.Session,
        loop: asyncio.AbstractEventLoop,
        metrics: Metrics,
        *,
        stream: str = "drop",
    ) -> None:
        self._session = session
        self._loop = loop
        self._inbox = Inbox(loop, metrics)
        self._replies_dropped = metrics.count("bus_replies_dropped")
        self._unanswered = metrics.count("bus_unanswered")
        self._relief: list[Callable[[], None]] = []
        self._lossless = stream == "block"
        self._writer = Writer("states", metrics, lossless=self._lossless, relieved=self._relieve)
        self._streams = Writer("streams", metrics, lossless=self._lossless, relieved=self._relieve)
        self._handles: list[Handle] = []
        self._tidy_at = _TIDY
        self._published: set[str] = set()
        """Stream keys that were ever given publishers."""

    def __repr__(self) -> str:
        return f"<ZenohBus {self._session.zid()}>"

    @property
    def zid(self) -> str:
        """The id of the Zenoh session."""
        return str(self._session.zid())

    def publisher(self, key: str, topic: Topic) -> Publisher:
        """Declare that ``key`` will be written."""
        qos = topic.qos
        options = _options(topic)
        if qos.keeps_last:
            return self._keep(_StatePublisher(self._session, key, options, self._writer))
        if topic.delivery is Delivery.STREAM:
            known = len(self._published) < PUBLISHERS or key in self._published
            if known:
                self._published.add(key)
            kind = _StreamPublisher if known else _StreamKey
            return self._keep(kind(self._session, key, options, self._streams, blocks=self._lossless))
        plain = self._session.declare_publisher(key, express=qos.express, **options)
        blocks = qos.congestion is Congestion.BLOCK
        return self._keep(_PlainPublisher(key, plain, self._writer if blocks else None))

    def put_all(self, batch: Batch) -> bool:
        """Publish stream messages, those of a key in order: the last one express, which takes the others along."""
        return self._streams.put(lambda: _put_batch(batch), sum(len(waiting) for _, waiting in batch))

    def on_relief(self, handler: Callable[[], None]) -> None:
        """Call ``handler`` when a source that was asked to pause may go on."""
        self._relief.append(handler)

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Sample], None],
        *,
        lane: Lane | Sort = Lane.OTHER,
        history: bool = False,
    ) -> Handle:
        """Take samples by way of a lane; ``history`` asks for last values too.

        Of those that a Sort sends by the lane STOP only one waits: what comes meanwhile is the same stop.
        """
        if isinstance(lane, Lane):
            source = self._inbox.source(handler, _read_sample)
            store = _store_by(lane, source)
        else:
            source = self._inbox.source(handler, lambda sample: sample)
            store = _store_sorted(lane, source)
        if not history:
            return self._keep(_Declared(self._session.declare_subscriber(key_expr, store)))
        config = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        return self._keep(
            _Declared(zenoh.ext.declare_advanced_subscriber(self._session, key_expr, store, history=config))
        )

    def answer(self, key: str, handler: Callable[[Question], None], *, lane: Lane | Sort = Lane.OTHER) -> Handle:
        """Answer queries that ask for ``key``, with or without wildcards; the last chunk of ``key`` may be one."""
        writer = self._writer
        source = self._inbox.source(handler, lambda raw: _Question(raw, key, writer))
        store = _store_sorted_questions(
            _sparing(lane, self._loop.time) if isinstance(lane, Lane) else lane, source, self._unanswered
        )
        return self._keep(_Declared(self._session.declare_queryable(key, store)))

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        """Query ``key_expr`` and collect the replies that come within ``timeout_s``, as far as they are no flood."""
        replies = await self._collect(
            key_expr,
            lambda handler: self._session.get(
                key_expr,
                handler,
                payload=payload,
                timeout=timeout_s,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            ),
            timeout_s,
        )
        return [_read_reply(reply) for reply in replies]

    def attend(self) -> None:
        """Hand over the stops and the holder's commands that wait: to be called in the midst of long work."""
        self._inbox.attend()

    def announce(self, key: str) -> Handle:
        """Declare a liveliness token."""
        return self._keep(_Declared(self._session.liveliness().declare_token(key)))

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        """List the liveliness tokens that exist."""
        replies = await self._collect(
            key_expr, lambda handler: self._session.liveliness().get(key_expr, handler, timeout=timeout_s), timeout_s
        )
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Handle:
        """Be told the key of every liveliness token there is or comes (True), and of each that goes (False)."""
        store = _store_by(Lane.STOP, self._inbox.source(lambda change: handler(*change), _read_change))
        return self._keep(_Declared(self._session.liveliness().declare_subscriber(key_expr, store, history=True)))

    async def flush(self) -> None:
        """Wait until what may block, streams apart, is with the bus; raise BusError where that takes too long."""
        loop = self._loop
        written: asyncio.Future[None] = loop.create_future()

        def tell() -> None:
            if not written.done():
                written.set_result(None)

        def ring() -> None:
            loop.call_soon_threadsafe(tell)

        self._writer.put(ring)
        try:
            async with asyncio.timeout(FLUSH_S):
                await written
        except TimeoutError:
            raise BusError(f"the bus took nothing for {FLUSH_S:g} s") from None

    def frames(self, key: str, listened: Callable[[bool], None]) -> Publisher:
        """Declare a key for raw frames; ``listened`` is told when the first listener comes and the last one goes."""
        loop = self._loop
        plain = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)

        def changed(status: zenoh.MatchingStatus) -> None:
            loop.call_soon_threadsafe(listened, status.matching)

        self._keep(_Declared(plain.declare_matching_listener(changed)))
        return self._keep(_PlainPublisher(key, plain, None))

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Handle:
        """Be told when the first listener of ``key`` comes and when the last one goes."""
        return self.frames(key, handler)

    def watch_connected(self, handler: Callable[[bool], None]) -> Handle:
        """Be told when the first connection to the bus is made and when the last one is gone."""
        loop, info = self._loop, self._session.info

        def changed(_: zenoh.TransportEvent) -> None:
            loop.call_soon_threadsafe(lambda: handler(bool(info.transports())))

        return self._keep(_Declared(info.declare_transport_events_listener(changed, history=True)))

    async def close(self) -> bool:
        """Leave the bus within :data:`LEAVE_S`; False where that hangs, as before a router that stands still."""
        handles, self._handles = self._handles, []
        left = threading.Event()

        def leave() -> None:
            self._leave(handles)
            left.set()

        threading.Thread(target=leave, name="zbridge-leave", daemon=True).start()
        deadline = self._loop.time() + LEAVE_S
        while not left.is_set() and self._loop.time() < deadline:  # noqa: ASYNC110 - a thread, not a task
            await asyncio.sleep(0.005)
        return left.is_set()

    def _leave(self, handles: list[Handle]) -> None:
        for writer in (self._streams, self._writer):
            writer.stop(LEAVE_S / 4)
        with contextlib.suppress(zenoh.ZError):
            for handle in reversed(handles):
                handle.close()
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def _relieve(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            for handler in self._relief:
                self._loop.call_soon_threadsafe(handler)

    def _keep(self, handle: H) -> H:
        """Remember what is to be taken back at the end; a client's comings and goings must not add up."""
        self._handles.append(handle)
        if len(self._handles) >= self._tidy_at:
            self._handles = [kept for kept in self._handles if not getattr(kept, "closed", False)]
            self._tidy_at = 2 * len(self._handles) + _TIDY
        return handle

    async def _collect(self, key_expr: str, start: Callable[[Any], Any], timeout_s: float) -> list[Any]:
        """Run a get whose replies are stored as they come; the last one's handler being dropped ends it."""
        loop, replies = self._loop, _Replies(key_expr, self._replies_dropped)
        done = loop.create_future()

        def finish() -> None:
            if not done.done():
                done.set_result(None)

        handler = zenoh.handlers.Callback(replies.take, lambda: loop.call_soon_threadsafe(finish))
        try:
            await asyncio.to_thread(start, handler)
        except zenoh.ZError as error:
            raise BusError(_ORIGIN.sub("", str(error))) from error
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s + 0.5):  # wait_for of Python 3.11 may swallow a cancellation
                await done
        return list(replies)


def _store_by(lane: Lane, source: Source) -> Callable[[Any], None]:
    """Make the callback of what comes by one lane."""

    def store(raw: Any) -> None:
        source.put(raw, lane)

    return store


def _sparing(lane: Lane, clock: Callable[[], float]) -> Sort:
    """Let so many questions a second go by a lane; what asks more often gets no answer."""
    allowance = RateLimit(QUESTIONS_HZ)

    def sort(key: str, shown: bytes | None, size: int, look: Look) -> Lane | None:
        return lane if allowance.take(clock()) else None

    return sort


def _store_sorted(sort: Sort, source: Source) -> Callable[[zenoh.Sample], None]:
    """Make the callback of samples that are sorted before the event loop hears of them."""

    def store(sample: zenoh.Sample) -> None:
        attachment, payload = sample.attachment, sample.payload
        shown = attachment.to_bytes() if attachment is not None else None
        size = len(payload) + (len(shown) if shown is not None else 0)
        key = str(sample.key_expr)
        lane = sort(key, shown, size, payload.to_bytes)
        if lane is Lane.STOP:
            source.fold(Sample(key, b"", shown), lane)  # its payload says nothing
        elif lane is not None:
            source.put(Sample(key, payload.to_bytes(), shown), lane, size)

    return store


def _store_sorted_questions(sort: Sort, source: Source, unanswered: Count) -> Callable[[zenoh.Query], None]:
    """Make the callback of queries that are sorted before the event loop hears of them."""

    def store(query: zenoh.Query) -> None:
        payload = query.payload
        shown = payload.to_bytes() if payload is not None else None
        size = len(shown) if shown is not None else 0
        lane = sort(str(query.key_expr), shown, size, bytes)
        if lane is None:
            unanswered.value += 1
            query.drop()  # type: ignore[no-untyped-call]
        else:
            source.put(query, lane, size)

    return store


def _options(topic: Topic) -> dict[str, Any]:
    qos: QoS = topic.qos
    encoding = zenoh.Encoding(payloads.ENCODING).with_schema(payloads.schema(topic.message))
    return {
        "encoding": encoding,
        "priority": _PRIORITIES[qos.priority],
        "congestion_control": _CONGESTIONS[qos.congestion],
    }


def _read_sample(raw: zenoh.Sample) -> Sample:
    attachment = raw.attachment
    return Sample(str(raw.key_expr), raw.payload.to_bytes(), attachment.to_bytes() if attachment is not None else None)


def _read_change(raw: zenoh.Sample) -> tuple[str, bool]:
    return str(raw.key_expr), raw.kind == zenoh.SampleKind.PUT


def _read_reply(reply: zenoh.Reply) -> Answer:
    if reply.ok is not None:
        return Answer(str(reply.ok.key_expr), reply.ok.payload.to_bytes(), replier=_replier(reply))
    error = _read_error(reply.err.payload.to_bytes() if reply.err is not None else b"no answer")
    return Answer("", b"", error, _replier(reply))


def _read_error(payload: bytes) -> Refused | BusError:
    """Read an error reply: what was refused has a code, anything else are words of the bus's."""
    try:
        denied = payloads.decode(Denied, payload)
    except PayloadError:
        return BusError(payload.decode("utf-8", "replace"))
    return refusal(denied.code, denied.reason)


def _replier(reply: zenoh.Reply) -> str | None:
    return str(reply.replier_id.zid) if reply.replier_id is not None else None


class _Replies(list[zenoh.Reply]):
    """What replied to one query, within bounds; taken on Zenoh's threads.

    A flood of one session's replies must not hide another's. Who answers for one key has little to say, who answers
    for many may answer for a whole fleet.
    """

    def __init__(self, key_expr: str, dropped: Count) -> None:
        super().__init__()
        self._dropped = dropped
        self._each = REPLIES if "*" in key_expr else _EACH
        self._counts: Counter[str | None] = Counter()

    def take(self, reply: zenoh.Reply) -> None:
        """Keep a reply, if there is room."""
        replier = _replier(reply)
        if len(self) < REPLIES and self._counts[replier] < self._each:
            self._counts[replier] += 1
            self.append(reply)
        else:
            self._dropped.value += 1


def _undeclare(entity: Any) -> bool:
    """Take an entity back; False where that meets its own running callback and must be tried again."""
    try:
        entity.undeclare()
    except RuntimeError as error:
        if "borrowed" not in str(error):
            raise
        return False
    return True


def _undeclare_soon(entity: Any) -> None:
    """Take an entity back, here within 2 ms or else by a thread of its own within :data:`UNDECLARE_S`."""
    for attempt in range(_AT_ONCE):
        if attempt:
            time.sleep(_PAUSE_S)
        if _undeclare(entity):
            return
    threading.Thread(target=_undeclare_later, args=(entity,), name="zbridge-undeclare", daemon=True).start()


def _undeclare_later(entity: Any) -> None:
    give_up_at = time.monotonic() + UNDECLARE_S
    while time.monotonic() < give_up_at:
        time.sleep(_PAUSE_S)
        if _undeclare(entity):
            return
    log.error("%s was not taken back: Already borrowed for %g s", type(entity).__name__, UNDECLARE_S)


class _Declared:
    """Entities of Zenoh's that are undeclared to end them."""

    def __init__(self, *entities: Any) -> None:
        self._entities = entities

    @property
    def closed(self) -> bool:
        """Whether they were taken back."""
        return not self._entities

    def close(self) -> None:
        entities, self._entities = self._entities, ()
        for entity in entities:
            _undeclare_soon(entity)


class _PlainPublisher(_Declared):
    """Writes a key directly, or by way of the writing thread where a full queue blocks."""

    def __init__(self, key: str, publisher: zenoh.Publisher, writer: Writer | None) -> None:
        super().__init__(publisher)
        self.key = key
        self._put = publisher.put
        self._writer = writer

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        if self._writer is not None:
            return self._writer.put(lambda: self._put(payload, attachment=attachment))
        self._put(payload, attachment=attachment)
        return True


class _StreamPublisher(_Declared):
    """Writes a stream key, plain or express: express is what makes a batch leave at once."""

    def __init__(
        self, session: zenoh.Session, key: str, options: dict[str, Any], writer: Writer, *, blocks: bool
    ) -> None:
        self.key = key
        self._writer = writer
        self._blocks = blocks
        if blocks:
            options = {**options, "congestion_control": zenoh.CongestionControl.BLOCK}
        super().__init__(*self._declare(session, key, options))

    put_plain: Callable[..., object]
    put_express: Callable[..., object]

    def _declare(self, session: zenoh.Session, key: str, options: dict[str, Any]) -> tuple[Any, ...]:
        plain = session.declare_publisher(key, **options)
        express = session.declare_publisher(key, express=True, **options)
        self.put_plain, self.put_express = plain.put, express.put
        return plain, express

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        return self._writer.put(partial(self.put_express, payload, attachment=attachment))

    def close(self) -> None:
        if self._blocks:  # what waits to be written is not lost
            self._writer.put(super().close)
        else:
            super().close()


class _StreamKey(_StreamPublisher):
    """Writes a stream key that Zenoh is to forget when it is closed."""

    def _declare(self, session: zenoh.Session, key: str, options: dict[str, Any]) -> tuple[Any, ...]:
        expression = session.declare_keyexpr(key)
        self.put_plain = partial(session.put, expression, **options)
        self.put_express = partial(session.put, expression, express=True, **options)
        return (_Undeclared(lambda: session.undeclare(expression)),)


class _Undeclared(msgspec.Struct):
    """Something that is undeclared by a call."""

    undeclare: Callable[[], object]


class _StatePublisher(_Declared):
    """Writes a state key: cached for late joiners, and answered to a plain get."""

    def __init__(self, session: zenoh.Session, key: str, options: dict[str, Any], writer: Writer) -> None:
        self.key = key
        self._writer = writer
        self._last: bytes | None = None
        self._encoding = options["encoding"]
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session,
            key,
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
            **options,
        )
        super().__init__(session.declare_queryable(key, self._reply), self._publisher)

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        self._last = payload
        return self._writer.replace(
            self.key, lambda: self._publisher.put(payload, attachment=attachment), 1 + len(payload) // 256
        )

    def _reply(self, query: zenoh.Query) -> None:
        last = self._last
        if last is None:
            query.drop()  # type: ignore[no-untyped-call]
        else:
            self._writer.put(lambda: _reply_and_drop(query, self.key, last, self._encoding))


def _reply_and_drop(query: zenoh.Query, key: str, payload: bytes, encoding: zenoh.Encoding | None) -> None:
    try:
        query.reply(key, payload, encoding=encoding, express=True)
    finally:
        query.drop()  # type: ignore[no-untyped-call]


class _Question:
    """A Zenoh query, answered by the writing thread."""

    def __init__(self, query: zenoh.Query, key: str, writer: Writer) -> None:
        self.asked = str(query.key_expr)
        self.key = key if is_concrete(key) else self.asked
        self.payload = query.payload.to_bytes() if query.payload is not None else b""
        self.attachment = query.attachment.to_bytes() if query.attachment is not None else None
        self._query = query
        self._writer = writer

    def answer(self, payload: bytes) -> None:
        self._writer.put(lambda: _reply_and_drop(self._query, self.key, payload, None))

    def refuse(self, refusal: Refused) -> None:
        denied = payloads.encode(Denied(code=refusal.code, reason=str(refusal)))
        self._writer.put(lambda: self._refuse(denied))

    def _refuse(self, denied: bytes) -> None:
        try:
            self._query.reply_err(denied, encoding=_DENIED)
        finally:
            self._query.drop()  # type: ignore[no-untyped-call]


def _put_batch(batch: Sequence[tuple[Any, list[bytes]]]) -> None:
    last = batch[-1][1].pop()
    for publisher, waiting in batch:
        put = publisher.put_plain
        for payload in waiting:
            put(payload)
    batch[-1][0].put_express(last)
