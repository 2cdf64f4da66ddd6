"""The typed messages that a robot publishes on one key: iterate over them, or ask for the last one."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any, Generic, TypeVar

from zbridge.bus import Bus, Sample
from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic

T = TypeVar("T")
F = TypeVar("F", bound=FleetMessage)

WAITING = 256
"""Most messages that wait for an iterating program; a further one replaces the oldest, which is counted as lost."""
WAITING_IMAGES = 2
"""The same for a key with large messages."""


class Feed(Generic[T]):
    """The messages of one key, or of several: ``async for message in feed``. Each iteration has a queue of its own.

    lost: messages that were dropped because the program was slower than the robot. malformed: payloads that could not
    be decoded as their key's message; they are skipped.
    """

    def __init__(
        self,
        bus: Bus,
        key_expr: str,
        read: Callable[[Sample], T],
        *,
        history: bool = False,
        most_waiting: int = WAITING,
    ) -> None:
        self.key_expr = key_expr
        self.lost = 0
        self.malformed = 0
        self._bus = bus
        self._read = read
        self._history = history
        self._most_waiting = most_waiting

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.key_expr}>"

    async def __aiter__(self) -> AsyncIterator[T]:
        waiting: deque[Sample] = deque()
        came = asyncio.Event()

        def take(sample: Sample) -> None:
            if len(waiting) >= self._most_waiting:
                waiting.popleft()
                self.lost += 1
            waiting.append(sample)
            came.set()

        with contextlib.closing(self._bus.subscribe(self.key_expr, take, history=self._history)):
            while True:
                await came.wait()
                while waiting:
                    try:
                        message = self._read(waiting.popleft())
                    except PayloadError:
                        self.malformed += 1
                        continue
                    yield message
                came.clear()


class StateFeed(Feed[F]):
    """The messages of a key that keeps its last value; an iteration begins with that value."""

    def __init__(self, bus: Bus, keys: KeySpace, topic: Topic) -> None:
        self._message: Any = topic.message
        super().__init__(bus, keys.key(topic.path), reader(topic), history=True)

    async def last(self, timeout_s: float = 1.0) -> F | None:
        """Return the last value; None if there is none."""
        for answer in await self._bus.ask(self.key_expr, timeout_s=timeout_s):
            if answer.error is None:
                message: F = payloads.decode(self._message, answer.payload)
                return message
        return None


def reader(topic: Topic) -> Callable[[Sample], Any]:
    """Return a function that decodes the samples of a topic."""
    message = topic.message
    return lambda sample: payloads.decode(message, sample.payload)
