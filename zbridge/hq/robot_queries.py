"""Asks the robot what HQ programs ask for: one query on the bus answers all programs that ask meanwhile."""

from __future__ import annotations

from collections.abc import Callable

from zbridge.errors import BusError, PayloadError, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.hq.context import ListenerContext
from zbridge.log import Log

log = Log("zbridge.hq")

ANSWER_S = 2.5
"""Longest time a query waits for the robot's answer."""

Answered = Callable[[Topic, FleetMessage | None], None]
"""``answered(topic, message)``; None if the robot gave no answer."""


class RobotQueries:
    """The queries of one listener that wait for their answer: at most one for each topic."""

    def __init__(self, context: ListenerContext) -> None:
        self._context = context
        self._waiting: dict[str, dict[object, Answered]] = {}
        """Who waits for an answer, by path."""

    def __repr__(self) -> str:
        return f"<RobotQueries {sorted(self._waiting)}>"

    def __len__(self) -> int:
        return len(self._waiting)

    def ask(self, topic: Topic, asker: object, answered: Answered) -> None:
        """Query the robot for one client, ``asker``; one that already waits for the answer gets it once.

        Raises Unsupported if robots are not asked for this topic.
        """
        if topic.path not in _ANSWERS:
            raise Unsupported(f"{topic.path} cannot be queried")
        waiting = self._waiting.get(topic.path)
        if waiting is None:
            self._waiting[topic.path] = {asker: answered}
            self._context.tasks.start(self._query(topic))
        else:
            waiting.setdefault(asker, answered)

    async def _query(self, topic: Topic) -> None:
        context, expected = self._context, _ANSWERS[topic.path].message
        message: FleetMessage | None = None
        try:
            for answer in await context.robot.bus.ask(context.robot.keys.key(topic.path), timeout_s=ANSWER_S):
                if answer.error is None:
                    message = payloads.decode(expected, answer.payload)
        except (BusError, PayloadError) as error:
            log.debug("query_failed", "{name}: {topic}: {error}", name=context.name, topic=topic.path, error=error)
        finally:
            waiting = self._waiting.pop(topic.path)
        for answered in waiting.values():
            answered(topic, message)


_ANSWERS = {topics.RPC_MAP.path: topics.MAP, topics.RPC_POSE.path: topics.POSE}
"""The queries that robots answer, and the topic whose message each is answered with."""
