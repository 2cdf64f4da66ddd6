"""Shows the robot to all clients of a listener: each message is encoded once, then queued for each.

Theory of operation. :class:`RobotSubscription` calls ``_on_message`` for each message and ``_on_gateway`` when the
robot's gateway comes or goes. The protocol's side turns a message into a ``Send``, which puts encoded frames into one
client's outbox; the outbox keeps the newest of a slot, so that a slow client delays nobody. A message that the side
cannot show is counted and left out. ``control`` goes to the operators, a change of presence to the people as a text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from zbridge.fleet.messages import Control, FleetMessage, Status
from zbridge.fleet.topics import Topic
from zbridge.hq.client import Client
from zbridge.hq.context import ListenerContext
from zbridge.protocol.plugin import Send

ATTEND_EVERY = 64
"""Clients that are written to between two looks at the stops and commands that wait on the bus."""


class Broadcast:
    """Sends what one robot publishes to ``clients``, which the listener keeps."""

    def __init__(self, context: ListenerContext, clients: Mapping[int, Client]) -> None:
        self._context = context
        self._clients = clients
        self._wanted: set[str] = set()
        self._missing = context.robot.view.missing

    def __repr__(self) -> str:
        return f"<Broadcast to {len(self._clients)} clients>"

    def begin(self) -> None:
        """Follow what the protocol's side shows."""
        self._context.robot.follow(self._context.side.follows, self._on_message, self._on_gateway)

    def follow_wanted(self) -> None:
        """Follow the topics that some client wants now, and no longer those that none of them wants."""
        robot = self._context.robot
        wanted = {topic.path for topic in self._context.side.wanted()}
        for path in wanted - self._wanted:
            robot.also_follow(path, self._on_message)
        for path in self._wanted - wanted:
            robot.unfollow(path, self._on_message)
        self._wanted = wanted

    def _on_message(self, topic: Topic, message: FleetMessage) -> None:
        if isinstance(message, Control):
            for client in tuple(self._clients.values()):
                client.operator.look(message)
            if topic.path not in self._context.side.follows:
                return
        if isinstance(message, Status):
            self._tell_presence()
        if self._clients:
            self._show(lambda: self._context.side.show(topic, message), f"{topic.path} not shown")

    def _on_gateway(self, alive: bool) -> None:
        self._tell_presence()
        if not alive:
            for client in tuple(self._clients.values()):
                client.operator.gateway_lost()

    def _tell_presence(self) -> None:
        """Tell the people at all clients when the robot is gone or there again."""
        missing = self._context.robot.view.missing
        if (missing is None) is not (self._missing is None):
            for client in tuple(self._clients.values()):
                client.tell(missing or "the robot is there", again=True)
            there = missing is None
            self._show(lambda: self._context.side.presence(there), "the robot's presence not shown")
        self._missing = missing

    def _show(self, translate: Callable[[], Send | None], left_out: str) -> None:
        """Translate once and send the result, if any, to every client that has begun."""
        try:
            send = translate()
        except Exception as error:
            self._context.failures.note(left_out, error)
            return
        if send is None:
            return
        bus = self._context.robot.bus
        for number, client in enumerate(tuple(self._clients.values()), 1):
            if not number % ATTEND_EVERY:
                bus.attend()
            if client.begun and not client.session.over:
                client.send(send)
