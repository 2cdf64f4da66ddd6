"""A program of a trace: carries out steps on a bus, simulated or real, and records what it observes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from zbridge.bus import Answer, Bus, IncomingQuery, Sample
from zbridge.errors import NotReady
from zbridge.fleet import topics
from zbridge.fleet.topics import Topic

TOPICS: dict[str, Topic] = {"drive": topics.CMD_DRIVE, "stop": topics.CMD_STOP, "state": topics.CONTROL}
"""Classes of delivery: dropped where the queue is full; kept; kept, with a last value."""
Record = Callable[..., None]


class Agent:
    """Carries out steps. record: notes an observation, with its time. clock: seconds, of the trace's time line."""

    def __init__(self, bus: Bus, record: Record, clock: Callable[[], float]) -> None:
        self._bus = bus
        self._record = record
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._publishers: dict[str, Any] = {}
        self._tokens: dict[str, Any] = {}
        self._handles: dict[str, Any] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    def do(self, step: str, *arguments: Any) -> None:
        """Carry out a step; what takes time becomes a task."""
        work = getattr(self, f"_{step}")(*arguments)
        if work is not None:
            task = self._loop.create_task(work)
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    # Samples

    def _subscribe(self, key: str, late: bool = False) -> None:
        self._handles[key] = self._bus.subscribe(key, self._on_sample, history=late)

    def _unsubscribe(self, key: str) -> None:
        self._handles.pop(key).close()

    def _on_sample(self, sample: Sample) -> None:
        tag, number, given_at = sample.payload.split(b" ")[:3]
        self._record("got", sample.key, tag.decode(), int(number), float(given_at))

    def _publisher(self, key: str, kind: str) -> None:
        self._publishers[key] = self._bus.publisher(key, TOPICS[kind])

    def _put(self, key: str, tag: str, number: int = 0, size: int = 0) -> None:
        self._publishers[key].put(f"{tag} {number} {self._clock():.6f} ".encode().ljust(size, b"."))

    async def _stream(self, keys: list[str], tag: str, hz: float, count: int, size: int = 0) -> None:
        began = self._loop.time()
        for number in range(count):
            await asyncio.sleep(max(0.0, began + number / hz - self._loop.time()))
            for key in keys:
                self._put(key, tag, number, size)
        self._record("sent", tag, count)

    # Tokens

    def _announce(self, key: str) -> None:
        self._tokens[key] = self._bus.announce(key)

    def _withdraw(self, key: str) -> None:
        self._tokens.pop(key).close()

    def _watch(self, key: str) -> None:
        self._bus.watch_alive(key, lambda token, alive: self._record("alive", token, alive))

    async def _list(self, key: str, tag: str) -> None:
        began = self._clock()
        self._record("listed", tag, sorted(await self._bus.alive(key)), self._clock() - began)

    def _watch_connected(self) -> None:
        self._bus.watch_connected(lambda up: self._record("connected", up))

    # Queries

    def _answer(self, key: str, how: str, name: str) -> None:
        def on_query(query: IncomingQuery) -> None:
            self._record("asked", name, query.asked)
            if how == "at once":
                query.answer(name.encode())
            elif how == "refused":
                query.refuse(NotReady("not now"))
            elif how == "late":
                self._loop.call_later(0.5, query.answer, name.encode())
            else:
                kept.append(query)  # a query that nobody keeps would end

        kept: list[Any] = []
        self._handles[key] = self._bus.answer(key, on_query)

    async def _ask(self, key: str, tag: str, timeout_s: float = 1.0) -> None:
        began = self._clock()
        answers = await self._bus.ask(key, timeout_s=timeout_s)
        self._record("answered", tag, sorted(map(_read, answers)), self._clock() - began)

    async def _keep_asking(self, key: str, tag: str, count: int, every_s: float) -> None:
        for _ in range(count):
            began = self._clock()
            answers = await self._bus.ask(key, timeout_s=0.3)
            self._record("answered", tag, sorted(map(_read, answers)), self._clock() - began)
            await asyncio.sleep(max(0.0, began + every_s - self._clock()))


def _read(answer: Answer) -> str:
    return answer.payload.decode() if answer.error is None else f"{type(answer.error).__name__}: {answer.error}"
