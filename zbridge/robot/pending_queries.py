"""Queries that wait for what the robot will publish: asked once, answered together, each with a deadline."""

from __future__ import annotations

import asyncio

from zbridge.bus import IncomingQuery
from zbridge.errors import Code, NotReady
from zbridge.fleet.topics import Topic

ANSWER_S = 2.0
"""Seconds the robot has to answer."""
WAITING = 64
"""Queries that may wait for one topic; one more is refused."""


class PendingQueries:
    """The queries that wait, by the topic that will answer them."""

    def __init__(self, loop: asyncio.AbstractEventLoop, answer_s: float = ANSWER_S) -> None:
        self._loop = loop
        self._answer_s = answer_s
        self.waiting: dict[str, list[tuple[IncomingQuery, asyncio.TimerHandle]]] = {}

    def __repr__(self) -> str:
        return f"<PendingQueries waiting for {sorted(self.waiting)}>"

    def add(self, topic: Topic, question: IncomingQuery) -> bool:
        """Let a question wait; tell whether it is the first, so that the robot must be asked."""
        waiting = self.waiting.setdefault(topic.path, [])
        if len(waiting) >= WAITING:
            raise NotReady(f"{WAITING} queries wait for the robot's answer", Code.BUSY)
        timer = self._loop.call_later(self._answer_s, self._expire, topic, question)
        waiting.append((question, timer))
        return len(waiting) == 1

    def remove(self, topic: Topic, question: IncomingQuery) -> None:
        """Forget a question that will not be answered."""
        waiting = self.waiting.get(topic.path, [])
        for entry in [entry for entry in waiting if entry[0] is question]:
            entry[1].cancel()
            waiting.remove(entry)
        if not waiting:
            self.waiting.pop(topic.path, None)

    def answer(self, topic: Topic, payload: bytes) -> None:
        """Answer all who wait for ``topic``."""
        for question, timer in self.waiting.pop(topic.path, ()):
            timer.cancel()
            question.answer(payload)

    def refuse_all(self, reason: str) -> None:
        """Refuse all who wait for anything."""
        entries_of_all = list(self.waiting.values())
        self.waiting.clear()
        for entries in entries_of_all:
            for question, timer in entries:
                timer.cancel()
                question.refuse(NotReady(reason))

    def _expire(self, topic: Topic, question: IncomingQuery) -> None:
        self.remove(topic, question)
        question.refuse(NotReady(f"the robot did not answer within {self._answer_s:g} s"))
