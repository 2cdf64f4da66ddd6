"""Queries for what the robot knows (``@rpc/map``, ``@rpc/pose``): it is asked once, and all who wait are answered."""

from __future__ import annotations

import asyncio

from zbridge.bus import Handle, IncomingQuery
from zbridge.control.context import RobotContext
from zbridge.errors import Code, NotReady, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.topics import Topic
from zbridge.robot.commands import Commands

ANSWER_S = 2.0
"""Seconds the robot has to answer."""
WAITING = 64
"""Queries that may wait for one topic; one more is refused."""
_ASKED = {topics.RPC_MAP.path: topics.MAP, topics.RPC_POSE.path: topics.POSE}


class Queries:
    """Answers queries with what the robot knows or publishes next. commands: tell whether the robot can be asked."""

    def __init__(self, context: RobotContext, commands: Commands, pending: PendingQueries) -> None:
        self._context = context
        self._commands = commands
        self._pending = pending

    def __repr__(self) -> str:
        return f"<Queries {self._pending!r}>"

    def serve(self) -> list[Handle]:
        """Answer queries until the handles are closed."""
        bus, keys = self._context.bus, self._context.keys
        return [bus.answer(keys.key(path), self._take) for path in _ASKED]

    def _take(self, query: IncomingQuery) -> None:
        context = self._context
        topic = _ASKED[context.keys.path(query.key)]
        try:
            self._answer_or_ask(topic, query)
        except Exception as error:
            refusal = error if isinstance(error, Refused) else context.faults.refusal(topic.path, error)
            self._pending.remove(topic, query)
            query.refuse(refusal)

    def _answer_or_ask(self, topic: Topic, query: IncomingQuery) -> None:
        context = self._context
        self._commands.require_ready()
        known = context.robot.known(topic)
        if known is not None:
            query.answer(payloads.encode(known))
            return
        self._commands.require_flowing()
        if self._pending.add(topic, query):
            context.robot.ask(topic)
            context.pump()


class PendingQueries:
    """The queries that wait, by the topic that will answer them. answer_s: seconds each waits."""

    def __init__(self, loop: asyncio.AbstractEventLoop, answer_s: float = ANSWER_S) -> None:
        self._loop = loop
        self._answer_s = answer_s
        self.waiting: dict[str, list[tuple[IncomingQuery, asyncio.TimerHandle]]] = {}

    def __repr__(self) -> str:
        return f"<PendingQueries waiting for {sorted(self.waiting)}>"

    def add(self, topic: Topic, query: IncomingQuery) -> bool:
        """Let a query wait; tell whether it is the first, so that the robot must be asked.

        Raises Refused where :data:`WAITING` others wait.
        """
        waiting = self.waiting.setdefault(topic.path, [])
        if len(waiting) >= WAITING:
            raise NotReady(f"{WAITING} queries wait for the robot's answer", Code.BUSY)
        timer = self._loop.call_later(self._answer_s, self._expire, topic, query)
        waiting.append((query, timer))
        return len(waiting) == 1

    def remove(self, topic: Topic, query: IncomingQuery) -> None:
        """Forget a query that will not be answered."""
        waiting = self.waiting.get(topic.path, [])
        for entry in [entry for entry in waiting if entry[0] is query]:
            entry[1].cancel()
            waiting.remove(entry)
        if not waiting:
            self.waiting.pop(topic.path, None)

    def answer(self, topic: Topic, payload: bytes) -> None:
        """Answer all who wait for ``topic``."""
        for query, timer in self.waiting.pop(topic.path, ()):
            timer.cancel()
            query.answer(payload)

    def refuse_all(self, reason: str) -> None:
        """Refuse all who wait for anything."""
        entries_of_all = list(self.waiting.values())
        self.waiting.clear()
        for entries in entries_of_all:
            for query, timer in entries:
                timer.cancel()
                query.refuse(NotReady(reason))

    def _expire(self, topic: Topic, query: IncomingQuery) -> None:
        self.remove(topic, query)
        query.refuse(NotReady(f"the robot did not answer within {self._answer_s:g} s"))
