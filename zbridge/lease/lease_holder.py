"""Drives a :class:`LeaseClient` on the bus: asks its questions, and declares the liveliness token of its program."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any

from msgspec import structs

from zbridge.bus import Bus, Handle
from zbridge.errors import BusError
from zbridge.fleet.messages import Control, Refusal
from zbridge.lease.lease_client import LeaseClient, Question
from zbridge.lease.lease_events import LeaseEvent, LeaseState
from zbridge.tasks import occurs


class LeaseHolder:
    """Holds the lease of one robot for one program. All calls belong on the event loop's thread.

    spawn: starts a task. on_event: notified of every event of the lease, within the call that caused it or when
    an answer comes. clock: seconds. The token named in ``request.alive`` is declared with the first question; it is
    taken back after :meth:`close`, once nothing is asked any more.
    """

    def __init__(
        self,
        bus: Bus,
        client: LeaseClient,
        *,
        spawn: Callable[[Coroutine[Any, Any, None]], object],
        on_event: Callable[[LeaseEvent], None],
        clock: Callable[[], float],
    ) -> None:
        self.client = client
        self._bus = bus
        self._spawn = spawn
        self._on_event = on_event
        self._clock = clock
        self._alive = client.request.alive
        self._token: Handle | None = None
        self._disowned = 0
        self._closed = False
        self._changed = asyncio.Event()

    def __repr__(self) -> str:
        return f"<LeaseHolder {self.client!r}>"

    @property
    def held(self) -> bool:
        """Whether commands can be proven."""
        return self.client.held

    def announce(self) -> None:
        """Declare the program's liveliness token, if it has one and it is not declared."""
        alive = self.client.request.alive
        if self._token is None and alive is not None:
            self._token = self._bus.announce(self.client.keys.alive(alive))

    def want(self) -> None:
        """Get the lease; an event tells whether it was granted."""
        self.client.want(self._clock())
        self._settle()

    def drop(self) -> None:
        """Release the lease, or stop asking for it. No event follows."""
        self.client.drop(self._clock())
        self._settle()

    def close(self) -> None:
        """Drop the lease, and take the token back when that is done; idempotent."""
        self._closed = True
        self.drop()

    def withdraw(self) -> None:
        """Take the token back at once; idempotent."""
        token, self._token = self._token, None
        if token is not None:
            token.close()

    def read_control(self, control: Control) -> list[Refusal]:
        """Take news from ``control``; return what was refused to this program since the last call."""
        news = self.client.read_control(control, self._clock())
        if self.client.state is LeaseState.FREE and control.holder == self.client.request.who:
            self._disown()
        self._settle()
        return news

    def gateway_lost(self) -> None:
        """Record that the robot's gateway is gone, and every lease with it."""
        self.client.gateway_lost(self._clock())
        self._settle()

    def expire(self) -> None:
        """Do what is due; to be called several times a second, unless :meth:`keep` runs."""
        self.client.expire(self._clock())
        self._settle()

    async def keep(self) -> None:
        """Do what is due when it is due, until cancelled."""
        while True:
            deadline = self.client.deadline()
            await occurs(self._changed, None if deadline is None else max(0.0, deadline - self._clock()))
            self.expire()
            self._changed.clear()

    def _disown(self) -> None:
        """End a lease whose grant was lost on the way: without its token it ends at the gateway.

        The next token has another name: the gateway may learn of the end of this one after the next lease was granted.
        """
        client = self.client
        self.withdraw()
        self._disowned += 1
        if self._alive is not None:
            client.request = structs.replace(client.request, alive=f"{self._alive}.{self._disowned}")

    def _settle(self) -> None:
        """Ask what the machine has to ask, and notify the program."""
        question = self.client.question()
        if question is not None:
            self.announce()
            self._spawn(self._ask(question))
        for event in self.client.events():
            self._on_event(event)
        if self._closed and self.client.state is LeaseState.FREE:
            self.withdraw()
        self._changed.set()

    async def _ask(self, question: Question) -> None:
        try:
            if question.returns:
                with contextlib.suppress(BusError):  # the commands before it go before it
                    await self._bus.flush()
            replied = await self._bus.ask(question.key, question.payload, timeout_s=question.timeout_s)
        except BusError as error:
            self.client.answered(question, error, self._clock())
        else:
            self.client.answered(question, replied, self._clock())
        self._settle()
