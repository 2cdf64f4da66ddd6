"""Serves a simulated robot to the HQ programs that connect: links, conversations, and simulation steps.

Uses the gateway's sessions and transport, unlike :mod:`zbridge.simulation.fragile`. Knows no bus and no protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Generic, TypeVar

import msgspec

from zbridge.errors import EncodeError, Refused
from zbridge.log import Log
from zbridge.protocol.plugin import Simulation, Truth
from zbridge.protocol.session import Session, State
from zbridge.simulation.timing import Ticker
from zbridge.simulation.world import Body
from zbridge.transport import Accepted, ClientConversation, Conversation, ConversationHooks, Link, listen

STEP_S = 0.02
"""Seconds between two steps of a simulated robot, in its own time too."""
CATCH_UP_S = 1.0
"""Most seconds that a robot catches up after this process was late."""

M = TypeVar("M")


async def live(step: Callable[[int], None]) -> None:
    """Call ``step`` every :data:`STEP_S` of the event loop's clock with its number, from 1, until cancelled."""
    ticker = Ticker(STEP_S, catch_up_s=CATCH_UP_S, clock=asyncio.get_running_loop().time)
    for steps in itertools.count(1):
        await ticker.tick()
        step(steps)


class Simulator(ABC, Generic[M]):
    """One simulated robot on its links. A protocol contributes :meth:`session`, :meth:`take` and :meth:`step`.

    ``links``: one name for each address of the simulation. ``datagrams``: receive datagrams at the TCP port's number.
    """

    body: Body | None = None
    """The robot in the room; it begins at ``Simulation.place``."""

    def __init__(self, log: logging.Logger, *, links: tuple[str, ...] = ("robot",), datagrams: bool = False) -> None:
        self._log, self._links, self._datagrams = Log(log.name), links, datagrams
        self._loop = asyncio.get_running_loop()
        self._clients: dict[Conversation, str] = {}

    # What a protocol contributes

    @abstractmethod
    def session(self, peer: str, link: str) -> Session[M] | None:
        """Make the session for a connection to the link of this name; None closes it: the robot is full."""

    @abstractmethod
    def take(self, client: Conversation, message: M) -> None:
        """Obey or answer one message of an HQ program."""

    @abstractmethod
    def step(self, steps: int) -> None:
        """Simulate :data:`STEP_S`, and send what is due; ``steps`` counts from 1."""

    def truth(self) -> Truth | None:
        """Return how the robot really is, for the conformance kit; None: it is not in the room."""
        return None

    def greet(self, client: Conversation, link: str) -> None:
        """Send the first messages of a new client. Nothing that :meth:`tell` sends precedes them."""

    def dismiss(self, client: Conversation) -> None:
        """Forget a client whose conversation has ended."""

    def check(self, session: Session[M], message: M) -> None:
        """Raise Refused for a message that a client may not be sent."""

    # What a protocol calls

    def clients(self, link: str | None = None) -> Iterator[Conversation]:
        """Return the clients whose sessions are established, of one link or of all."""
        for client, name in tuple(self._clients.items()):
            if link in (None, name) and client.session.state is State.ESTABLISHED:
                yield client

    def tell(self, *messages: M, link: str | None = None) -> None:
        """Send messages to the clients of one link, or of all."""
        for client in self.clients(link):
            self.send(client, *messages)

    def send(self, client: Conversation, *messages: M) -> None:
        """Send messages to one client, up to the first that it may not be sent or that does not fit."""
        session = client.session
        if session.state is State.ESTABLISHED:
            try:
                for message in messages:
                    self.check(session, message)
                    session.send(message)
            except (Refused, EncodeError) as error:
                self._log.debug("message_not_sent", "{session}: not sent, {error}", session=session.name, error=error)
            client.pump()

    # Running

    async def run(self, simulation: Simulation) -> None:
        """Listen on each address and run until cancelled; then close every conversation."""
        async with contextlib.AsyncExitStack() as stack:
            addresses = [
                await stack.enter_async_context(
                    listen(address, partial(Accepted, partial(self._admit, name=name)), datagrams=self._datagrams)
                )
                for name, address in zip(self._links, simulation.addresses, strict=True)
            ]
            if self.body is not None:
                self.body.place(simulation.place)
            simulation.ready(tuple(addresses))
            try:
                await live(partial(self._step, simulation.report))
            finally:
                for client in tuple(self._clients):
                    client.close("simulator ended")

    def _step(self, report: Callable[[Truth], None], steps: int) -> None:
        self.step(steps)
        truth = self.truth()
        if truth is not None:
            report(msgspec.structs.replace(truth, lived_s=steps * STEP_S))

    def _admit(self, link: Link, name: str) -> Conversation | None:
        session = self.session(link.peer, name)
        if session is None:
            return None
        hooks = ConversationHooks(deliver=lambda messages: self._deliver(client, messages))
        client = ClientConversation(session, self._loop, hooks)
        client.ended.add_done_callback(lambda _: self._dismiss(client))
        self._log.info("client_connected", "{peer}: connected as {session}", peer=link.peer, session=session.name)
        self._loop.call_soon(self._greet, client, name)  # the session is opened first
        return client

    def _greet(self, client: Conversation, name: str) -> None:
        self.greet(client, name)
        if not client.ended.done():
            self._clients[client] = name

    def _deliver(self, client: Conversation, messages: list[Any]) -> None:
        for message in messages:
            self.take(client, message)

    def _dismiss(self, client: Conversation) -> None:
        ended = client.session
        self._log.info("client_gone", "{peer}: {reason}", peer=ended.peer, reason=ended.reason, session=ended.name)
        self._clients.pop(client, None)
        self.dismiss(client)
