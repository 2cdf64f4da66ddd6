"""How one listener is handed to another process, and taken over there, with all its clients. Knows no protocol.

Theory of operation. :class:`~zbridge.transport.transferable.Transferable` has the order of the steps.
:meth:`ListenerHandover.prepare` takes the robot from every client and waits until each connection can be handed over;
those that never can (tls) are closed by :meth:`ListenerHandover.detach`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import msgspec

from zbridge.errors import NotReady, ProtocolError, Unsupported
from zbridge.hq.client import Client
from zbridge.hq.context import ListenerContext
from zbridge.protocol.kept import Exported
from zbridge.protocol.session import Session
from zbridge.protocol.session_table import ClientIds
from zbridge.transport import Door, Parcel, Transferable

RESTARTED = "gateway restarted"
"""Why clients lose the robot, and must send neutral."""
VIEW_S = 1.5
"""Longest wait of a new process until it sees the robot that the old one saw: clients would be told that it is gone."""
LEAVE_S = 0.3
"""Longest wait until clients that cannot be handed over are told so."""
_LOOK_S = 0.005
_TURNS = 3
"""Turns of the event loop until who was accepted last is attached."""

Make = Callable[[int, str, Session[Any]], Client]


class ListenerHandover(Transferable):
    """The handover of one listener. door: its sockets. make: makes a client of a number, a host and a session."""

    def __init__(
        self, context: ListenerContext, door: Door, clients: dict[int, Client], numbers: ClientIds, make: Make
    ) -> None:
        self.suspended = False
        """Whether clients are neither read nor written nor ended."""
        self.detached = asyncio.Event()
        """Set when another process has the listener."""
        self._context = context
        self._door = door
        self._clients = clients
        self._numbers = numbers
        self._make = make
        self._restored: list[tuple[Client, object, tuple[str, int] | None]] = []
        """Clients that were restored and are not yet attached: number of the descriptor, source of datagrams."""

    def __repr__(self) -> str:
        return f"<ListenerHandover of {self._context.name}, {len(self._clients)} clients>"

    # The process that goes

    async def prepare(self, reason: str, within_s: float) -> None:
        """Take the robot from all clients, and wait until they can be handed over; raise Refused after ``within_s``."""
        if not self._context.side.hands_over:
            raise Unsupported(f"protocol {self._context.side.name} does not hand its HQ programs over")
        for client in tuple(self._clients.values()):
            if client.operator.intent.held:
                client.tell(f"not driving: {reason}")
                client.let_go(reason)
        until = self._context.clock() + within_s
        while waiting := [client for client in self._clients.values() if _blocker(client)]:
            if self._context.clock() >= until:
                names = "; ".join(f"client {client.number}: {_blocker(client)}" for client in waiting[:3])
                raise NotReady(f"{self._context.name}: {names}")
            await asyncio.sleep(_LOOK_S)

    async def shut(self) -> None:
        """Accept nobody; wait until who was accepted is a client."""
        self._door.shut()
        for _ in range(_TURNS):
            await asyncio.sleep(0)

    def suspend(self) -> None:
        """Read and write nothing from now on."""
        self.suspended = True
        self._door.suspend()
        for client in self._clients.values():
            client.conversation.suspend()

    def export(self, parcel: Parcel) -> Exported:
        """Put the sockets into a parcel; describe the listener and its clients."""
        context = self._context
        return {
            "name": context.name,
            "there": context.robot.view.missing is None,
            "door": self._door.export(parcel),
            "numbers": self._numbers.export(),
            "side": context.side.export(),
            "clients": [self._client(client, parcel) for client in self._clients.values() if client.blocker is None],
        }

    def _client(self, client: Client, parcel: Parcel) -> Exported:
        assert client.conversation.link is not None
        return {**client.export(parcel), "source": self._door.source(client.conversation.link)}

    async def detach(self) -> None:
        """Give up what another process has now; close the clients that could not be handed over."""
        left = [client for client in self._clients.values() if client.conversation.blocker is not None]
        for client in tuple(self._clients.values()):
            if client in left:
                client.conversation.reading.suspended = False
                client.conversation.close(RESTARTED)
            else:
                client.detach()
        if left:
            await asyncio.wait({client.conversation.ended for client in left}, timeout=LEAVE_S)
        self._door.close()
        self.detached.set()

    # The process that comes

    async def restore(self, state: Exported, parcel: Parcel) -> None:
        """Restore the clients of another process, which :meth:`resume` attaches; raise ProtocolError."""
        context = self._context
        self.suspended = True
        patience = context.clock() + VIEW_S
        while state["there"] and context.robot.view.missing is not None and context.clock() < patience:  # noqa: ASYNC110
            await asyncio.sleep(_LOOK_S)
        context.side.restore(state["side"])
        self._numbers.restore(state["numbers"])
        for each in state["clients"]:
            self._restore_client(each)
        self._numbers.keep(self._clients, context.clock())

    def _restore_client(self, state: Exported) -> None:
        try:
            number, host = msgspec.convert(state["number"], int), msgspec.convert(state["host"], str)
            source = msgspec.convert(state["source"], tuple[str, int] | None)
        except (KeyError, msgspec.ValidationError) as error:
            raise ProtocolError(f"a client of {self._context.name}: {error}") from error
        session = self._context.side.session(number, self._context.limits)
        session.restore(state["session"])
        client = self._make(number, host, session)
        client.restore(state, RESTARTED)
        self._restored.append((client, state["link"].get("tcp"), source))

    async def resume(self) -> None:
        """Read, write and accept: again, or for the first time with what was restored."""
        self.suspended = False
        for client in tuple(self._clients.values()):
            client.resume()
        restored, self._restored = self._restored, []
        for client, number, source in restored:
            try:
                await self._door.admit(number, client.conversation, source)
            except (OSError, ProtocolError) as error:
                client.conversation.lost(str(error))
        await self._door.open()


def _blocker(client: Client) -> str | None:
    """Return why a client that could be handed over cannot be yet."""
    link = client.conversation.link
    return client.blocker if link is not None and link.blocker is None and not client.session.over else None
