"""The bus interface over a simulated session (:class:`zbridge.bus.Bus`)."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import msgspec

from tests.fake_bus import matches, meet
from tests.simulated.bus import NEWS_S, Fabric, SimSession
from tests.simulated.engine import THREAD_S
from zbridge.bus.inbox import Inbox
from zbridge.bus.interface import Answer, PriorityClass, Sample
from zbridge.bus.late_join import LateJoin
from zbridge.errors import BusError, Refused
from zbridge.fleet.topics import Congestion, is_concrete
from zbridge.metrics import Metrics

WRITE_S = 1e-3
"""Most seconds until the writer thread writes what must not be dropped: other messages may overtake it."""


class SimBus:
    """One process on the simulated bus."""

    def __init__(self, session: SimSession, metrics: Metrics) -> None:
        self.session = session
        self.fabric: Fabric = session.fabric
        self._loop = session.process.loop
        self._inbox = Inbox(self._loop, metrics)
        self._handles: list[SimHandle] = []
        self.subscribers: list[tuple[str, Callable[[Sample], None]]] = []
        self.queryables: list[tuple[str, Callable[[SimQuery], bool], float]] = []
        self.last: dict[str, bytes] = {}
        self._watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        self._connected: list[Callable[[bool], None]] = []
        self._written_at = 0.0
        """When the writer thread has written what it was given."""
        session.buses.append(self)

    def __repr__(self) -> str:
        return f"<SimBus of {self.session.process.name}>"

    @property
    def zid(self) -> str:
        return self.session.zid

    def routers(self) -> list[str]:
        return [self.session.router] if self.session.link.up else []

    def share(self, metrics: Metrics) -> SimBus:
        return SimBus(self.session, metrics)

    # Samples

    def publisher(self, key: str, topic: Any, last: bytes | None = None) -> Any:
        if last is not None:
            self.last[key] = last
        droppable = topic.qos.congestion is Congestion.DROP
        return self._keep(SimPublisher(self, key, droppable=droppable, keeps_last=topic.qos.keeps_last))

    def put(self, key: str, payload: bytes, attachment: bytes | None, *, droppable: bool) -> None:
        """Send a sample to all that subscribe."""
        session, fabric = self.session, self.fabric
        if not session.open or not session.process.alive:
            return
        if droppable:
            self._write(key, payload, attachment, droppable=True)
            return
        self._written_at = max(self._written_at, fabric.world.now + fabric.rng.random() * WRITE_S)
        fabric.world.at(self._written_at, lambda: self._write(key, payload, attachment, droppable=False))

    def _write(self, key: str, payload: bytes, attachment: bytes | None, *, droppable: bool) -> None:
        session, fabric = self.session, self.fabric
        if not session.open or not session.process.alive:
            return
        for tell in fabric.on_put:
            tell(session.process.name, key, payload)
        if "@" in key or "status" in key or "control" in key:
            fabric.world.note(session.process.name, "puts", key, payload, attachment)
        size = len(payload) + len(attachment or b"")
        for other in tuple(fabric.sessions):
            if not fabric.reaches(session, other):
                continue
            if not any(meet(expr, key) for bus in other.buses for expr, _ in bus.subscribers):
                continue
            copies = 2 if fabric.duplicates and fabric.rng.random() < fabric.duplicates else 1
            for _ in range(copies):
                fabric.carry(
                    session,
                    other,
                    f"{session.zid} {key if fabric.reorders else key.rpartition('/@cmd/')[1] or key}",
                    size,
                    lambda other=other: other.process.after(0.0, lambda: _deliver(other, key, payload, attachment)),
                    droppable=droppable,
                )

    def put_all(self, batch: Any) -> bool:
        for publisher, payloads in batch:
            for payload in payloads:
                publisher.put(payload)
        return True

    def on_relief(self, handler: Callable[[], None]) -> None:
        pass

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Sample], None],
        *,
        priority: Any = PriorityClass.OTHER,
        history: bool = False,
        kept: bool = False,
        direct: bool = False,
    ) -> Any:
        if history:
            return self._keep(LateJoin(self, key_expr, handler, self.fabric.rng.random))
        source = self._inbox.source(handler)

        def store(sample: Sample) -> None:
            if isinstance(priority, PriorityClass):
                source.put(sample, priority)
                return
            size = len(sample.payload) + len(sample.attachment or b"")
            chosen = priority(sample.key, sample.attachment, size, lambda: sample.payload)
            self.fabric.world.note(self.session.process.name, "receives", sample.key, sample.payload, sample.attachment)
            if chosen is PriorityClass.STOP:
                source.fold(Sample(sample.key, b"", sample.attachment), chosen)
            elif chosen is not None:
                source.put(sample, chosen, size)

        entry = (key_expr, store)
        self.subscribers.append(entry)
        return self._keep(SimHandle(lambda: self.subscribers.remove(entry)))

    # Queries

    def answer(
        self, key: str, handler: Callable[[Any], None], *, priority: Any = PriorityClass.OTHER, complete: bool = False
    ) -> Any:
        source = self._inbox.source(handler)

        def store(query: SimQuery) -> bool:
            chosen = priority
            if not isinstance(priority, PriorityClass):
                chosen = priority(query.asked, query.payload or None, len(query.payload), bytes)
            if chosen is None:
                return False
            source.put(query, chosen, len(query.payload))
            return True

        entry = (key, store, self.fabric.world.now + self.fabric.rng.random() * NEWS_S)
        self.queryables.append(entry)
        return self._keep(SimHandle(lambda: self.queryables.remove(entry)))

    def gather(self, key_expr: str) -> Any:
        return SimHandle(lambda: None)

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        asked = Asked(self, key_expr, payload)
        asked.start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await asked.done
        if asked.done.cancelled():
            asked.answers.append(Answer("", b"", BusError("Timeout")))
        asked.end()
        return asked.answers

    def attend(self) -> None:
        self._inbox.attend()

    # Tokens

    def announce(self, key: str) -> Any:
        self.session.declare_token(key)
        return self._keep(SimHandle(lambda: self.session.undeclare_token(key)))

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        session = self.session
        own = set(session.tokens)
        if session.link.ends[0] and not session.link.whole:
            await asyncio.sleep(timeout_s)
            return sorted(key for key in own if matches(key_expr, key))
        await asyncio.sleep(0.001 + self.fabric.rng.random() * 0.002)
        seen = {key for _, key in session.at.tokens} if session.link.up else set()
        return sorted(key for key in own | seen if matches(key_expr, key))

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Any:
        source = self._inbox.source(lambda change: handler(*change))
        entry = (key_expr, lambda key, alive: source.put((key, alive), PriorityClass.STOP))
        self._watchers.append(entry)
        for key in sorted({key for _, key in self.session.known}):
            if matches(key_expr, key):
                entry[1](key, True)
        return self._keep(SimHandle(lambda: self._watchers.remove(entry)))

    def told_alive(self, key: str, alive: bool) -> None:
        for key_expr, tell in tuple(self._watchers):
            if matches(key_expr, key):
                self.fabric.world.note(self.session.process.name, "alive", key, alive)
                tell(key, alive)

    # The rest

    async def flush(self) -> None:
        process = self.session.process
        late_s = process.rng.random() * process.host.thread_s if process.host.thread_s > THREAD_S else 0.0
        await asyncio.sleep(max(1e-4, self._written_at - self.fabric.world.now) + late_s)

    async def drain(self, key_expr: str) -> None:
        await asyncio.sleep(1e-3)

    def frames(self, key: str, listened: Callable[[bool], None], *, best_effort: bool = False, kept: int = 0) -> Any:
        return self._keep(SimPublisher(self, key, droppable=True, keeps_last=False))

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Any:
        return self.frames(key, handler)

    def watch_connected(self, handler: Callable[[bool], None]) -> Any:
        self._connected.append(handler)
        up = self.session.link.ends[0]
        self._loop.call_soon(lambda: handler(up) if handler in self._connected else None)
        return self._keep(SimHandle(lambda: self._connected.remove(handler)))

    def told_connected(self, up: bool) -> None:
        self.fabric.world.note(self.session.process.name, "connected", up)
        for handler in tuple(self._connected):
            self._loop.call_soon(handler, up)

    async def close(self) -> bool:
        await asyncio.sleep(0.005)
        handles, self._handles = self._handles, []
        for handle in handles:
            handle.close()
        if self in self.session.buses:
            self.session.buses.remove(self)
        if not self.session.buses:
            self.session.close()
        return True

    def _keep(self, handle: Any) -> Any:
        self._handles.append(handle)
        if len(self._handles) > 256:
            self._handles = [each for each in self._handles if not getattr(each, "closed", False)]
        return handle


class SimHandle:
    """A declaration."""

    def __init__(self, undo: Callable[[], None]) -> None:
        self._undo = undo
        self.closed = False

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._undo()


class SimPublisher(SimHandle):
    """Writes one key."""

    def __init__(self, bus: SimBus, key: str, *, droppable: bool, keeps_last: bool) -> None:
        super().__init__(lambda: bus.last.pop(key, None) and None)
        self.key = key
        self._bus = bus
        self._droppable = droppable
        self._keeps_last = keeps_last

    @property
    def last(self) -> bytes | None:
        return self._bus.last.get(self.key)

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        if self._keeps_last:
            self._bus.last[self.key] = payload
        self._bus.put(self.key, payload, attachment, droppable=self._droppable)
        return True


def _deliver(session: SimSession, key: str, payload: bytes, attachment: bytes | None) -> None:
    for bus in tuple(session.buses):
        for key_expr, store in tuple(bus.subscribers):
            if meet(key_expr, key):
                try:
                    store(Sample(key, payload, attachment))
                except Exception as error:  # Zenoh loses such a sample, and continues
                    session.fabric.world.errors.append(f"{session.process.name}: a sample of {key}: {error!r}")


class Asked:
    """A query that is under way."""

    def __init__(self, bus: SimBus, key_expr: str, payload: bytes) -> None:
        self.bus = bus
        self.key_expr = key_expr
        self.payload = payload
        self.answers: list[Answer] = []
        self.done: asyncio.Future[None] = bus._loop.create_future()
        self.over = False
        self._open: set[SimSession] = set()
        """Who has not answered to the end."""
        self._number = bus.fabric.number()

    def start(self) -> None:
        """Ask every session that can be seen and answers for the key."""
        session, fabric = self.bus.session, self.bus.fabric
        fabric.world.note(session.process.name, "asks", self.key_expr, self.payload)
        for other in tuple(fabric.sessions):
            if fabric.reaches(session, other) and self._answers(other):
                self._open.add(other)
                order = f"{session.zid} ?{self.key_expr}"
                fabric.carry(session, other, order, 64, lambda other=other: self._arrive(other), droppable=False)
        if not self._open:
            fabric.world.after(0.001, lambda: session.process.after(0.0, self._end))
        fabric.asked.append(self)

    def give_up_lost(self) -> None:
        """Await nothing more of those to whom there is no link any more."""
        session, fabric = self.bus.session, self.bus.fabric
        for other in tuple(self._open):
            if fabric.linked(session, other):
                continue
            if session.link.ends[0]:
                session.link.carry(1, f"!{self._number}", 32, self._later(other), droppable=False)
            else:
                fabric.world.after(0.001, self._later(other))

    def _later(self, other: SimSession) -> Callable[[], None]:
        return lambda: self.bus.session.process.after(0.0, lambda: self._finished(other))

    def _finished(self, other: SimSession) -> None:
        self._open.discard(other)
        if not self._open:
            self._end()

    def end(self) -> None:
        """Take no more answers."""
        self.over = True
        if self in self.bus.fabric.asked:
            self.bus.fabric.asked.remove(self)

    def _answers(self, other: SimSession) -> bool:
        now = self.bus.fabric.world.now
        return any(
            any(since <= now and meet(self.key_expr, key) for key, _, since in bus.queryables)
            or any(matches(self.key_expr, key) for key in bus.last)
            for bus in other.buses
        )

    def _arrive(self, other: SimSession) -> None:
        other.process.after(0.0, lambda: self._serve(other))

    def _serve(self, other: SimSession) -> None:
        queries = []
        for bus in tuple(other.buses):
            for key, store, _ in tuple(bus.queryables):
                if meet(self.key_expr, key):
                    concrete = key if is_concrete(key) else self.key_expr
                    queries.append((SimQuery(self, other, concrete), store))
            for key, last in tuple(bus.last.items()):
                if matches(self.key_expr, key):
                    self._reply(other, Answer(key, last, replier=other.zid))
        waiting = [query for query, store in queries if store(query)]
        for query in waiting:
            query.ends = lambda: self._ended(other, waiting)
        if not waiting:
            self._final(other)

    def _ended(self, other: SimSession, waiting: list[SimQuery]) -> None:
        if all(query.replied for query in waiting):
            self._final(other)

    def _final(self, other: SimSession) -> None:
        self._carry(other, lambda: self._finished(other))

    def reply(self, other: SimSession, answer: Answer) -> None:
        """Take an answer on its way."""
        self._reply(other, answer)

    def _reply(self, other: SimSession, answer: Answer) -> None:
        self._carry(other, lambda: None if self.over else self.answers.append(answer))

    def _carry(self, other: SimSession, arrive: Callable[[], None]) -> None:
        session = self.bus.session
        self.bus.fabric.carry(
            other,
            session,
            f"{other.zid} !{self._number}",
            64,
            lambda: session.process.after(0.0, arrive),
            droppable=False,
        )

    def _end(self) -> None:
        if not self.done.done():
            self.done.set_result(None)


class SimQuery:
    """A query that waits for its answer (:class:`zbridge.bus.IncomingQuery`)."""

    def __init__(self, asked: Asked, session: SimSession, key: str) -> None:
        self.key = key
        self.asked = asked.key_expr
        self.payload = asked.payload
        self.attachment = None
        self.replied = False
        self.ends: Callable[[], None] = lambda: None
        self._asked = asked
        self._session = session

    def answer(self, payload: bytes, attachment: bytes | None = None) -> None:
        self._send(Answer(self.key, payload, replier=self._session.zid))

    def refuse(self, refusal: Refused) -> None:
        self._send(Answer("", b"", refusal, self._session.zid))

    def _send(self, answer: Answer) -> None:
        if self.replied:
            return
        self.replied = True
        asker = self._asked.bus.session.process.name
        world = self._session.fabric.world
        said = (self.asked, answer.payload, str(answer.error), asker, self.payload)
        world.note(self._session.process.name, "answers", *said)
        self._asked.reply(self._session, msgspec.structs.replace(answer))
        self.ends()
