"""The Zenoh session of one process: what is declared on it, and how it is left."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh

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
    read_reply,
    subscribe_with_kept,
)
from zbridge.bus.zenoh.opening import in_short, open_or_say_why, zenoh_config
from zbridge.bus.zenoh.publishers import FramePublisher, Publishers
from zbridge.errors import BusError
from zbridge.fleet.topics import SizeBounds, Topic
from zbridge.metrics import Metrics

H = TypeVar("H", bound=Handle)

LEAVE_S = 0.4
"""Longest time leaving the bus takes."""
FLUSH_S = 2.0
"""Longest time for which :meth:`ZenohBus.flush` waits."""
_TIDY = 64
"""Handles that are kept before closed ones are forgotten."""


async def open_zenoh(
    settings: BusSettings,
    metrics: Metrics,
    *,
    wait_for_peers: bool = False,
    bounds: SizeBounds = (),
    within_s: float = 1.0,
    realm: str | None = None,
    robot: str | None = None,
    timestamps: bool = False,
    explain: bool = True,
    threads: bool = True,
) -> ZenohBus:
    """Open a Zenoh session; raise BusError where that is not possible (a client: no router within ``within_s``)."""
    config = zenoh_config(
        settings, wait_for_peers=wait_for_peers, bounds=bounds, within_s=within_s, timestamps=timestamps
    )
    session = await open_or_say_why(config, settings, explain=explain)
    bus = ZenohBus(session, asyncio.get_running_loop(), metrics, stream=settings.stream, threads=threads)
    certificate = own_certificate(settings.tls)
    if certificate is not None and realm is not None:
        try:
            await require_member(bus.ask, [str(zid) for zid in session.info.routers_zid()], certificate, realm, robot)
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
        """Begin. beside: a bus whose session this one shares and does not end."""
        self._session = session
        self._threads = threads
        self._loop = loop
        self._stream = stream
        self._lossless = lossless = stream == "block"
        self._shares = beside is not None
        self._inbox = Inbox(loop, metrics)
        self._inboxes: list[Inbox] = beside._inboxes if beside is not None else []
        """Of all that share the session: what is urgent to one of them is served with all."""
        self._inboxes.append(self._inbox)
        self._answers = Answers(session)
        self._alive = AliveWatches(loop, self._declare_alive)
        self._replies_dropped = metrics.count("bus_replies_dropped")
        self._unanswered = metrics.count("bus_unanswered")
        self._relief: list[Callable[[], None]] = []
        self._writer = Writer("states", metrics, lossless=lossless, relieved=self._relieve)
        self._streams = Writer("streams", metrics, lossless=lossless, relieved=self._relieve)
        self._publishers = Publishers(session, self._writer, self._streams, lossless=lossless)
        self.put_all = self._publishers.put_all
        self._handles: list[Handle] = []
        self._tidy_at = _TIDY

    def __repr__(self) -> str:
        return f"<ZenohBus {self._session.zid()}>"

    @property
    def zid(self) -> str:
        """The id of the Zenoh session."""
        return str(self._session.zid())

    def routers(self) -> list[str]:
        """Return the ids of the routers that this session is connected to."""
        return [str(zid) for zid in self._session.info.routers_zid()]

    def share(self, metrics: Metrics) -> ZenohBus:
        """Return a bus on the same session for one robot, with queues, bounds, threads and declarations of its own.

        Its ``close`` takes back what was declared on it, and leaves the session to the others.
        """
        return ZenohBus(self._session, self._loop, metrics, stream=self._stream, threads=self._threads, beside=self)

    def publisher(self, key: str, topic: Topic, last: bytes | None = None) -> Publisher:
        """Declare that ``key`` will be written. last: what another process published last, for keys that keep it."""
        return self._keep(self._publishers.make(key, topic, last))

    def on_relief(self, handler: Callable[[], None]) -> None:
        """Call ``handler`` when a paused source may resume."""
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
        """Subscribe to ``key_expr``.

        priority: of all samples, or a Sort that chooses it for each. history: ask for last values too.
        kept: the frames that publishers have kept come too, those of publishers that appear later as well.
        direct: the handler is called on one of Zenoh's threads, for streams without priority and history: it must be
        quick, and may put frames on another bus.

        Of the samples that a Sort gives priority STOP only one waits at a time: those that follow are the same stop.
        """
        if history:
            return self._keep(LateJoin(self, key_expr, handler))
        store: Any = direct_callback(key_expr, handler) if direct else loop_callback(self._inbox, handler, priority)
        if direct or not self._threads:
            store = prompt(store)
        if kept:
            return self._keep(Declared(subscribe_with_kept(self._session, key_expr, store)))
        return self._keep(Declared(self._session.declare_subscriber(key_expr, store)))

    def answer(
        self,
        key: str,
        handler: Callable[[IncomingQuery], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        complete: bool = False,
    ) -> Handle:
        """Answer queries that ask for ``key``, with or without wildcards; the last chunk of ``key`` may be one.

        complete: this session answers for the whole key, so that queries to complete answerers alone find it.
        """
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
        """Declare one queryable, ``key_expr``, for all keys below it that are answered from now on."""
        return self._answers.gather(key_expr)

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        """Query ``key_expr`` and collect the replies of ``timeout_s`` seconds, bounded in number."""
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
        return [read_reply(reply) for reply in replies]

    def attend(self) -> None:
        """Serve the stops and the holder's commands that wait. To be called in the middle of long work."""
        for inbox in self._inboxes:
            inbox.attend()

    def announce(self, key: str) -> Handle:
        """Declare a liveliness token."""
        return self._keep(Declared(self._session.liveliness().declare_token(key)))

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        """List the liveliness tokens that exist."""
        replies = await self._collect(
            key_expr, lambda handler: self._session.liveliness().get(key_expr, handler, timeout=timeout_s), timeout_s
        )
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Handle:
        """Call ``handler`` with every liveliness token that exists or appears (True) or disappears (False)."""
        return self._keep(self._alive.add(key_expr, handler))

    def _declare_alive(self, key_expr: str, handler: Changed) -> Handle:
        store = priority_callback(PriorityClass.STOP, self._inbox.source(lambda change: handler(*change), read_change))
        watch = self._session.liveliness().declare_subscriber(key_expr, threadless(store), history=True)
        return Declared(watch)

    async def flush(self) -> None:
        """Wait until all queued states and answers are handed to Zenoh; raise BusError after :data:`FLUSH_S`."""
        await self._flush(self._writer)

    async def drain(self, key_expr: str) -> None:
        """Wait until all that was published has left: a query of the lowest priority goes behind it."""
        await self._flush(self._streams)
        options: Any = {"priority": zenoh.Priority.BACKGROUND, "congestion_control": zenoh.CongestionControl.BLOCK}
        await self._collect(key_expr, lambda handler: self._session.get(key_expr, handler, timeout=1.0, **options), 1.0)

    async def _flush(self, writer: Writer) -> None:
        loop = self._loop
        written: asyncio.Future[None] = loop.create_future()

        def tell() -> None:
            if not written.done():
                written.set_result(None)

        def ring() -> None:
            loop.call_soon_threadsafe(tell)

        writer.put(ring)
        try:
            async with asyncio.timeout(FLUSH_S):
                await written
        except TimeoutError:
            raise BusError(f"the bus took nothing for {FLUSH_S:g} s") from None

    def frames(
        self, key: str, listened: Callable[[bool], None], *, best_effort: bool = False, kept: int = 0
    ) -> Publisher:
        """Declare a key for raw frames; call ``listened`` when the first listener comes and the last one goes.

        best_effort: links may lose frames. kept: last frames that Zenoh's advanced subscribers get when they come late;
        needs a bus with timestamps.
        """

        def changed(matching: bool) -> None:
            self._loop.call_soon_threadsafe(listened, matching)

        return self._keep(
            FramePublisher(
                self._session, key, self._streams, changed, best_effort=best_effort, kept=kept, blocks=self._lossless
            )
        )

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Handle:
        """Call ``handler`` when the first listener of ``key`` appears (True) and when the last one leaves (False)."""
        return self.frames(key, handler)

    def watch_connected(self, handler: Callable[[bool], None]) -> Handle:
        """Call ``handler`` when the first connection to the bus is made (True) and the last one is lost (False)."""
        return self._keep(ConnectedWatch(self._session.info, self._loop, handler))

    async def close(self) -> bool:
        """Leave the bus within :data:`LEAVE_S`; False where that hangs, as with a router that has stalled."""
        handles, self._handles = self._handles, []
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
        """Remember a handle that is to be closed at the end; forget closed ones now and then, so that none add up."""
        self._handles.append(handle)
        if len(self._handles) >= self._tidy_at:
            self._handles = [kept for kept in self._handles if not getattr(kept, "closed", False)]
            self._tidy_at = 2 * len(self._handles) + _TIDY
        return handle

    async def _collect(self, key_expr: str, start: Callable[[Any], Any], timeout_s: float) -> list[Any]:
        """Run a get and collect its replies. Zenoh drops the handler after the last reply, which ends the wait."""
        loop, replies = self._loop, Replies(key_expr, self._replies_dropped)
        done = loop.create_future()

        def finish() -> None:
            if not done.done():
                done.set_result(None)

        handler = zenoh.handlers.Callback(replies.take, lambda: loop.call_soon_threadsafe(finish))
        try:
            await asyncio.to_thread(start, handler)
        except zenoh.ZError as error:
            raise BusError(in_short(error)) from error
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s + 0.5):  # wait_for of Python 3.11 may lose a cancellation
                await done
        return list(replies)
