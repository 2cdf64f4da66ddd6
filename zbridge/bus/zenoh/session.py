"""The Zenoh session of one process: what is declared on it, and how it is left."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar

import zenoh
import zenoh.ext

from zbridge.bus.inbox import Inbox
from zbridge.bus.interface import Answer, BusSettings, Handle, IncomingQuery, PriorityClass, Publisher, Sample, Sort
from zbridge.bus.late_join import LateJoin
from zbridge.bus.tls.files import own_certificate
from zbridge.bus.tls.membership import require_member
from zbridge.bus.writer import Writer
from zbridge.bus.zenoh.alive import AliveWatches, Changed
from zbridge.bus.zenoh.answers import Answers
from zbridge.bus.zenoh.connected import ConnectedWatch
from zbridge.bus.zenoh.declared import Declared, prompt, threadless
from zbridge.bus.zenoh.incoming import (
    Replies,
    ZenohQuery,
    direct_callback,
    loop_callback,
    priority_callback,
    query_callback,
    rate_limiting,
    read_change,
)
from zbridge.bus.zenoh.opening import in_short, open_or_explain
from zbridge.bus.zenoh.publishers import Publishers
from zbridge.errors import BusError
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics, Reading
from zbridge.tasks import occurs

H = TypeVar("H", bound=Handle)

LEAVE_S = 0.4
"""Longest time to leave the bus, seconds."""
FLUSH_S = 2.0
"""Longest wait of :meth:`ZenohBus.flush`, seconds."""
_TIDY = 64
"""Handles that are kept before closed ones are forgotten."""


async def open_zenoh(
    config: zenoh.Config,
    settings: BusSettings,
    metrics: Metrics,
    *,
    realm: str | None,
    robot: str | None,
    explain: bool,
    threads: bool,
) -> ZenohBus:
    """Open a session of this configuration for :func:`zbridge.bus.open_bus`."""
    session = await open_or_explain(config, settings, explain=explain)
    bus = ZenohBus(session, asyncio.get_running_loop(), metrics, stream=settings.stream, threads=threads)
    certificate = own_certificate(settings.tls)
    if certificate is not None and realm is not None:
        try:
            await require_member(bus.ask, bus.routers(), certificate, realm, robot)
        except BaseException:
            await bus.close()
            raise
    return bus


class ZenohBus:
    """The bus over one Zenoh session."""

    def __init__(
        self,
        session: zenoh.Session,
        loop: asyncio.AbstractEventLoop,
        metrics: Metrics,
        *,
        stream: str = "drop",
        threads: bool = True,
        beside: ZenohBus | None = None,
    ) -> None:
        """Begin. beside: a bus whose session this one shares and does not close."""
        self._session = session
        self._threads = threads
        self._loop = loop
        self._stream = stream
        lossless = stream == "block"
        self._shares = beside is not None
        self._inbox = Inbox(loop, metrics)
        self._inboxes: list[Inbox] = beside._inboxes if beside is not None else []
        """The inboxes of all that share the session: urgent input of one is served with that of all."""
        self._inboxes.append(self._inbox)
        self._answers = Answers(session)
        self._alive = AliveWatches(loop, partial(_declare_alive, session, self._inbox))
        self._replies_dropped = metrics.count("bus_dropped", queue="replies")
        self._unanswered = metrics.count("bus_queries_unanswered")
        self._relief: list[Callable[[], None]] = []
        self._writer = Writer("states", metrics, lossless=lossless, relieved=self._relieve)
        self._streams = Writer("streams", metrics, lossless=lossless, relieved=self._relieve)
        self._publishers = Publishers(session, self._writer, self._streams, lossless=lossless)
        self.put_all = self._publishers.put_all
        self._handles: list[Handle] = []
        self._tidy_at = _TIDY
        self._unread = metrics.add_source(partial(_read_queues, self._inbox, self._writer, self._streams))
        """Ends that the metrics show the queues."""

    def __repr__(self) -> str:
        return f"<ZenohBus {self._session.zid()}>"

    @property
    def zid(self) -> str:
        return str(self._session.zid())

    def routers(self) -> list[str]:
        return [str(zid) for zid in self._session.info.routers_zid()]

    def share(self, metrics: Metrics) -> ZenohBus:
        return ZenohBus(self._session, self._loop, metrics, stream=self._stream, threads=self._threads, beside=self)

    def publisher(self, key: str, topic: Topic, last: bytes | None = None) -> Publisher:
        return self._keep(self._publishers.make(key, topic, last))

    def on_relief(self, handler: Callable[[], None]) -> None:
        self._relief.append(handler)

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Sample], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        history: bool = False,
        kept: bool = False,
        direct: bool = False,
    ) -> Handle:
        if history:
            return self._keep(LateJoin(self, key_expr, handler))
        store: Any = direct_callback(key_expr, handler) if direct else loop_callback(self._inbox, handler, priority)
        if direct or not self._threads:
            store = prompt(store)
        if kept:  # what advanced publishers keep, too, now and whenever one appears
            kept_ones = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            advanced = zenoh.ext.declare_advanced_subscriber(self._session, key_expr, store, history=kept_ones)
            return self._keep(Declared(advanced))
        return self._keep(Declared(self._session.declare_subscriber(key_expr, store)))

    def answer(
        self,
        key: str,
        handler: Callable[[IncomingQuery], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        complete: bool = False,
    ) -> Handle:
        writer = self._writer
        source = self._inbox.source(handler, lambda raw: ZenohQuery(raw, key, writer))
        store = query_callback(
            rate_limiting(priority, self._loop.time) if isinstance(priority, PriorityClass) else priority,
            source,
            self._unanswered,
        )
        if complete:
            return self._keep(Declared(self._session.declare_queryable(key, store, complete=True)))
        return self._keep(self._answers.add(key, store))

    def gather(self, key_expr: str) -> Handle:
        return self._answers.gather(key_expr)

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        return await self._collect(
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

    def attend(self) -> None:
        for inbox in self._inboxes:
            inbox.attend()

    def announce(self, key: str) -> Handle:
        return self._keep(Declared(self._session.liveliness().declare_token(key)))

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        answers = await self._collect(
            key_expr,
            lambda handler: self._session.liveliness().get(key_expr, handler, timeout=timeout_s),
            timeout_s,
        )
        return [answer.key for answer in answers if answer.error is None]

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Handle:
        return self._keep(self._alive.add(key_expr, handler))

    async def flush(self) -> None:
        await _written(self._writer)

    async def drain(self, key_expr: str) -> None:
        await _written(self._streams)
        options: Any = {"priority": zenoh.Priority.BACKGROUND, "congestion_control": zenoh.CongestionControl.BLOCK}
        start = partial(self._session.get, key_expr, timeout=1.0, **options)
        await self._collect(key_expr, start, 1.0)

    def frames(
        self, key: str, listened: Callable[[bool], None], *, best_effort: bool = False, kept: int = 0
    ) -> Publisher:
        def changed(matching: bool) -> None:
            self._loop.call_soon_threadsafe(listened, matching)

        return self._keep(self._publishers.frames(key, changed, best_effort=best_effort, kept=kept))

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Handle:
        return self.frames(key, handler)

    def watch_connected(self, handler: Callable[[bool], None]) -> Handle:
        return self._keep(ConnectedWatch(self._session.info, self._loop, handler))

    async def close(self) -> bool:
        """Leave the bus within :data:`LEAVE_S`; False if that hangs, as with a router that has stalled."""
        handles, self._handles = self._handles, []
        self._unread()
        if self._inbox in self._inboxes:
            self._inboxes.remove(self._inbox)
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
        if not (self._shares or self._session.is_closed()):
            self._session.close()  # type: ignore[no-untyped-call]

    def _relieve(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            for handler in self._relief:
                self._loop.call_soon_threadsafe(handler)

    def _keep(self, handle: H) -> H:
        """Remember a handle to close at the end; forget closed ones now and then, so that they do not accumulate."""
        self._handles.append(handle)
        if len(self._handles) >= self._tidy_at:
            self._handles = [kept for kept in self._handles if not getattr(kept, "closed", False)]
            self._tidy_at = 2 * len(self._handles) + _TIDY
        return handle

    async def _collect(self, key_expr: str, start: Callable[[Any], Any], timeout_s: float) -> list[Answer]:
        """Run a get and collect its replies. Zenoh drops the handler after the last reply, which ends the wait."""
        replies, done = Replies(key_expr, self._replies_dropped), asyncio.Event()
        handler = zenoh.handlers.Callback(replies.take, lambda: self._loop.call_soon_threadsafe(done.set))
        try:
            await asyncio.to_thread(start, handler)
        except zenoh.ZError as error:
            raise BusError(in_short(error)) from error
        await occurs(done, timeout_s + 0.5)
        return list(replies)


async def _written(writer: Writer) -> None:
    """Wait until all that was queued before is written; raise BusError after :data:`FLUSH_S`."""
    written, loop = asyncio.Event(), asyncio.get_running_loop()
    writer.put(lambda: loop.call_soon_threadsafe(written.set))
    try:
        async with asyncio.timeout(FLUSH_S):
            await written.wait()
    except TimeoutError:
        raise BusError(f"the bus accepted nothing for {FLUSH_S:g} s") from None


def _declare_alive(session: zenoh.Session, inbox: Inbox, key_expr: str, handler: Changed) -> Handle:
    store = priority_callback(PriorityClass.STOP, inbox.source(lambda change: handler(*change), read_change))
    return Declared(session.liveliness().declare_subscriber(key_expr, threadless(store), history=True))


def _read_queues(inbox: Inbox, states: Writer, streams: Writer) -> Iterator[Reading]:
    lengths = {"bus_in": inbox.length, "bus_out_states": states.length, "bus_out_streams": streams.length}
    for queue, length in lengths.items():
        yield "queue_length", {"queue": queue}, length
