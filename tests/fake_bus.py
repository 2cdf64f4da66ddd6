"""A bus inside one process, for tests: the bus interface and Zenoh's key matching, without threads and delays.

Handlers are called at once, by the caller of ``put`` or ``ask``. All that was put is kept for the test to inspect.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

import msgspec

from zbridge.bus.interface import Answer, Batch, Handle, IncomingQuery, PriorityClass, Publisher, Sample, Sort
from zbridge.errors import Refused
from zbridge.fleet.topics import Topic, is_concrete, matches
from zbridge.metrics import Metrics

H = TypeVar("H", bound=Handle)


@lru_cache(maxsize=65536)
def meet(one: str, other: str) -> bool:
    """Return whether there is a key that both key expressions match."""
    return _meet(one.split("/"), other.split("/"))


def _meet(one: list[str], other: list[str]) -> bool:
    if not one or not other:
        return all(chunk == "**" for chunk in one + other)
    if one[0] != "**" and other[0] == "**":
        one, other = other, one
    if one[0] == "**":
        return _meet(one[1:], other) or (not other[0].startswith("@") and _meet(one, other[1:]))
    wild = "*" in (one[0], other[0]) and "@" not in (one[0][:1], other[0][:1])
    return (wild or one[0] == other[0]) and _meet(one[1:], other[1:])


class FakeBus:
    """One of several sessions on one :class:`FakeNetwork`: ``FakeBus()`` makes the first, ``join()`` another."""

    def __init__(self, zid: str = "1", network: FakeNetwork | None = None) -> None:
        self._zid = zid
        self.network = network or FakeNetwork()
        self._relief: list[Callable[[], None]] = []
        self._connected: list[Callable[[bool], None]] = []
        self._handles: list[Handle] = []
        self.up = True
        self.takes = True

    def __repr__(self) -> str:
        return f"<FakeBus {self._zid}>"

    @property
    def zid(self) -> str:
        return self._zid

    def join(self, zid: str) -> FakeBus:
        """Open another session on the same bus."""
        return FakeBus(zid, self.network)

    def routers(self) -> list[str]:
        """Return no router: sessions of a fake bus need none."""
        return []

    def values(self, key_expr: str) -> list[bytes]:
        """Return every payload that was put on matching keys, in order."""
        return [sample.payload for sample in self.network.history if matches(key_expr, sample.key)]

    def connection(self, up: bool) -> None:
        """Simulate the loss or the return of the bus."""
        self.up = up
        for handler in tuple(self._connected):
            handler(up)

    def relieve(self) -> None:
        """Accept messages again, and notify the paused sources."""
        self.takes = True
        for handler in tuple(self._relief):
            handler()

    # The interface

    def share(self, metrics: Metrics) -> FakeBus:
        shared = self.join(self._zid)
        shared._connected = self._connected
        return shared

    def gather(self, key_expr: str) -> Handle:
        return _FakeHandle(lambda: None)

    def publisher(self, key: str, topic: Topic, last: bytes | None = None) -> Publisher:
        if last is not None:
            self.network.last[key] = last
        return self._keep(_FakePublisher(key, self.network, keeps_last=topic.qos.keeps_last))

    def put_all(self, batch: Batch) -> bool:
        for publisher, payloads in batch:
            for payload in payloads:
                publisher.put(payload)
        return self.takes

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
        entry = (key_expr, handler)
        self.network.priorities[key_expr] = priority
        self.network.subscribers.append(entry)
        if history or kept:
            for key, payload in tuple(self.network.last.items()):
                if matches(key_expr, key):
                    handler(Sample(key, payload))
        return self._keep(_FakeHandle(lambda: self.network.subscribers.remove(entry)))

    def answer(
        self,
        key: str,
        handler: Callable[[IncomingQuery], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        complete: bool = False,
    ) -> Handle:
        entry = (key, handler, self._zid)
        self.network.queryables.append(entry)
        return self._keep(_FakeHandle(lambda: self.network.queryables.remove(entry)))

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        queries = []
        for key, handler, zid in tuple(self.network.queryables):
            if meet(key_expr, key):
                concrete = key if is_concrete(key) else key_expr
                queries.append((query := FakeQuery(concrete, payload, asked=key_expr), zid))
                handler(query)
        kept = [Answer(key, last) for key, last in self.network.last.items() if matches(key_expr, key)]
        replies = [(reply, zid) for query, zid in queries for reply in query.replies]
        return [msgspec.structs.replace(reply, replier=zid) for reply, zid in replies] + kept

    def attend(self) -> None:
        """Do nothing: handlers are called at once."""

    def announce(self, key: str) -> Handle:
        self.network.tokens.append(key)
        self.network.notify(key, True)

        def withdraw() -> None:
            self.network.tokens.remove(key)
            self.network.notify(key, False)

        return self._keep(_FakeHandle(withdraw))

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        return sorted({token for token in self.network.tokens if matches(key_expr, token)})

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Handle:
        entry = (key_expr, handler)
        self.network.watchers.append(entry)
        for token in tuple(self.network.tokens):
            if matches(key_expr, token):
                handler(token, True)
        return self._keep(_FakeHandle(lambda: self.network.watchers.remove(entry)))

    async def flush(self) -> None:
        pass

    async def drain(self, key_expr: str) -> None:
        pass

    def frames(
        self, key: str, listened: Callable[[bool], None], *, best_effort: bool = False, kept: int = 0
    ) -> Publisher:
        publisher = self._keep(_FakePublisher(key, self.network, keeps_last=bool(kept), listened=listened))
        if any(meet(key_expr, key) for key_expr, _ in self.network.subscribers):
            asyncio.get_running_loop().call_soon(listened, True)
        return publisher

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Handle:
        return self.frames(key, handler)

    def watch_connected(self, handler: Callable[[bool], None]) -> Handle:
        self._connected.append(handler)
        handler(self.up)
        return self._keep(_FakeHandle(lambda: self._connected.remove(handler)))

    async def close(self) -> bool:
        handles, self._handles = self._handles, []
        for handle in handles:
            handle.close()
        return True

    def _keep(self, handle: H) -> H:
        self._handles.append(handle)
        return handle


class FakeNetwork:
    """What all sessions of one fake bus share; a test may read all of it."""

    def __init__(self) -> None:
        self.subscribers: list[tuple[str, Callable[[Sample], None]]] = []
        self.priorities: dict[str, PriorityClass | Sort] = {}
        """The priority that the last subscriber of each key expression gave; a fake bus itself sorts nothing."""
        self.queryables: list[tuple[str, Callable[[IncomingQuery], None], str]] = []
        self.tokens: list[str] = []
        self.watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        self.listened: list[tuple[str, Callable[[bool], None]]] = []
        """The keys whose listeners are watched, and what to call when they change."""
        self.last: dict[str, bytes] = {}
        self.history: list[Sample] = []

    def notify(self, key: str, alive: bool) -> None:
        """Call the watchers of a liveliness token that appeared or disappeared."""
        for key_expr, handler in tuple(self.watchers):
            if matches(key_expr, key):
                handler(key, alive)


class _FakeHandle:
    def __init__(self, undo: Callable[[], None]) -> None:
        self._undo: Callable[[], None] | None = undo

    def close(self) -> None:
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()


class _FakePublisher(_FakeHandle):
    def __init__(
        self, key: str, network: FakeNetwork, *, keeps_last: bool, listened: Callable[[bool], None] | None = None
    ) -> None:
        super().__init__(self._forget)
        self.key = key
        self._network = network
        self._keeps_last = keeps_last
        self._listened = [(key, listened)] if listened is not None else []
        network.listened += self._listened

    @property
    def last(self) -> bytes | None:
        return self._network.last.get(self.key)

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        sample = Sample(self.key, payload, attachment)
        self._network.history.append(sample)
        if self._keeps_last:
            self._network.last[self.key] = payload
        for key_expr, handler in tuple(self._network.subscribers):
            if meet(key_expr, self.key):
                handler(sample)
        return True

    def _forget(self) -> None:
        for entry in self._listened:
            self._network.listened.remove(entry)
        self._network.last.pop(self.key, None)


class FakeQuery:
    """A query whose replies a test may inspect."""

    def __init__(self, key: str, payload: bytes = b"", *, asked: str | None = None) -> None:
        self.key = key
        self.asked = asked or key
        self.payload = payload
        self.attachment: bytes | None = None
        self.replies: list[Answer] = []
        self.attached: list[bytes | None] = []

    def answer(self, payload: bytes, attachment: bytes | None = None) -> None:
        self.replies.append(Answer(self.key, payload))
        self.attached.append(attachment)

    def refuse(self, refusal: Refused) -> None:
        self.replies.append(Answer(self.key, b"", refusal))
