"""The links of one robot: each connects, converses, and connects again, until it is closed.

Knows no bus and no translation.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import msgspec

from zbridge.errors import LinkError, ProtocolError
from zbridge.fleet.messages import LinkStatus, RobotState
from zbridge.log import Log
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.kept import Budget, Exported
from zbridge.protocol.session import Session, State
from zbridge.protocol.session_table import Backoff, SessionTable
from zbridge.robot.wire_tap import Tap, WireTap
from zbridge.transport import Conversation, ConversationHooks, Link, Parcel, attach, connect
from zbridge.transport.reading import FairShare
from zbridge.wire.frames import Partial

log = Log("zbridge.link")

Connect = Callable[[DeviceAddress, Conversation], Any]
"""``await connect(address, receiver)``: raises LinkError if there is no connection to be had."""
Attach = Callable[[DeviceAddress, Exported, Parcel, Conversation], Any]
"""``await attach(address, state, parcel, receiver)``: raises ProtocolError, OSError."""
Resume = Callable[[int], Partial | None]
"""``resume(most_bytes)``: the incomplete frame of a stream, by :meth:`zbridge.wire.frames.FrameBuffer.partial`."""

_STATES: dict[State, RobotState] = {
    State.CONNECTING: "connecting",
    State.HANDSHAKING: "handshaking",
    State.ESTABLISHED: "established",
    State.CLOSING: "closing",
    State.CLOSED: "offline",
}


class LinkSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How the links of one robot are made."""

    addresses: tuple[DeviceAddress, ...]
    """One for each link."""
    sessions: SessionTable
    connect: Connect = connect
    attach: Attach = attach
    """Attaches a connection that another process handed over."""
    chance: Callable[[], float] = random.random
    """Between 0 and 1."""
    share: FairShare | None = None
    """Of the processor, where the process serves other robots too."""
    tap: Callable[[str], Tap | None] = lambda name: None
    """``tap(name)``: returns what is called with every raw frame of a link; None: nothing is."""
    shared: bool = False
    """Whether gateways of other robots may connect to the same addresses."""


class LinkHooks(msgspec.Struct, frozen=True):
    """What the connections of one robot call; the first argument of most is the name of the link."""

    session: Callable[[str, str], Session[Any]]
    """``session(name, address)``: makes the session of a new connection."""
    session_changed: Callable[[Session[Any]], None]
    state_changed: Callable[[], None]
    connected: Callable[[str, str], object]
    """``connected(name, outcome)``: a connection was established, or has failed before that, or was lost after it."""
    stalled: Callable[[str, bool], object]
    linked: Callable[[str, Link, bool], object]
    read: Callable[[str, Resume], object] | None
    conversation: ConversationHooks
    """Those that all conversations share."""


class Links:
    """The connections to one robot, in the order of its configuration; the first one drives."""

    def __init__(self) -> None:
        self._connections: list[Connection] = []

    def __iter__(self) -> Iterator[Connection]:
        return iter(self._connections)

    def __repr__(self) -> str:
        return f"<Links {self._connections}>"

    @property
    def first(self) -> Connection:
        """The connection that drives."""
        return self._connections[0]

    def add(self, connection: Connection) -> None:
        """Add the next connection of the configuration."""
        self._connections.append(connection)

    def conversation(self, name: str) -> Conversation | None:
        """Return the conversation over the link of this name; None if there is none."""
        return next((each.conversation for each in self._connections if each.name == name), None)

    def pump(self) -> None:
        """Write what may be written."""
        for connection in self._connections:
            if connection.conversation is not None:
                connection.conversation.pump()

    def pause_reading(self) -> None:
        """Read nothing until :meth:`resume_reading`."""
        for connection in self._connections:
            if connection.conversation is not None:
                connection.conversation.reading.pause()

    def resume_reading(self) -> None:
        """Read again."""
        for connection in self._connections:
            if connection.conversation is not None:
                connection.conversation.reading.resume()


class Connection:
    """One configured address, its conversation while there is one, and who watches its frames."""

    def __init__(self, name: str, label: str, address: DeviceAddress, settings: LinkSettings, hooks: LinkHooks) -> None:
        self.name = name
        self._label = label
        self.address = address
        self.state: RobotState = "offline"
        self.reason: str | None = "not yet connected"
        self.conversation: Conversation | None = None
        self._settings = settings
        self._hooks = hooks
        self._ending = False
        self._link: Link | None = None
        self._free = asyncio.Event()
        """Cleared while suspended or muted: nothing is connected then."""
        self._free.set()
        self._suspended = False
        """Whether another process may get the link."""
        self._restored: tuple[Exported, Parcel] | None = None
        """The link of another process, until it is attached."""
        self._muted = False
        self.wire = WireTap(label, settings.tap(name))
        """Shows the raw frames."""

    def __repr__(self) -> str:
        return f"<Connection {self.name} {self.address} {self.state}>"

    async def run(self) -> None:
        """Connect, converse and connect again, until :meth:`close`."""
        backoff = Backoff(chance=self._settings.chance)
        while not self._ending:
            reason, established = await self._converse()
            self._hooks.connected(self.name, "lost" if established else "failed")
            if established:
                backoff.reset()
            if self._ending:
                log.info("link_closed", "{link}: {reason}", link=self._label, reason=reason)
                return
            delay_s = backoff.delay_s()
            template = "{link}: {reason}; next attempt in {delay_s:.1f} s"
            log.info("link_lost", template, link=self._label, reason=reason, delay_s=delay_s)
            self._set_state("offline", reason)
            await asyncio.sleep(delay_s)
            await self._free.wait()

    async def close(self, reason: str, timeout_s: float) -> None:
        """End the conversation within ``timeout_s`` seconds, and do not connect again."""
        self._ending = True
        conversation = self.conversation
        if conversation is not None:
            conversation.close(reason)
            await asyncio.wait([conversation.ended], timeout=timeout_s)
        if self._link is not None:
            await self._link.ended()
        self.state, self.reason = "offline", reason

    @property
    def is_up(self) -> bool:
        """Whether there is a connection."""
        return self.conversation is not None and self.conversation.link is not None

    def mute(self, muted: bool) -> None:
        """Write nothing but what keeps the connection alive, and connect to nobody, until ``mute(False)``."""
        self._muted = muted
        if self.conversation is not None:
            self.conversation.session.outbox.mute(muted)
        self._set_free()

    def _set_free(self) -> None:
        (self._free.clear if self._suspended or self._muted else self._free.set)()

    # A restart

    @property
    def blocker(self) -> str | None:
        """Why the link cannot be handed to another process now; None if it can, or where there is none."""
        conversation = self.conversation
        if conversation is None:
            return None
        if conversation.session.outbox.hurried:
            return "the stop is not yet written"
        return conversation.blocker

    def suspend(self) -> None:
        """Read, write and connect nothing until :meth:`resume`."""
        self._suspended = True
        self._set_free()
        if self.conversation is not None:
            self.conversation.suspend()

    async def resume(self) -> None:
        """Continue after :meth:`suspend`, or attach what was restored: from now on this process has the link."""
        self._suspended = False
        self._set_free()
        restored, self._restored = self._restored, None
        if self.conversation is None:
            return
        self.conversation.resume()
        if restored is not None:
            try:
                await self._settings.attach(self.address, *restored, self.conversation)
            except (OSError, ProtocolError) as error:
                self.conversation.lost(str(error))

    def export(self, parcel: Parcel, budget: Budget | None = None) -> Exported | None:
        """Put the connection into a parcel, and describe its conversation; None if there is none."""
        return self.conversation.export(parcel, budget) if self.conversation is not None else None

    def restore(self, state: Exported | None, parcel: Parcel) -> None:
        """Restore the conversation of another process, which :meth:`resume` attaches; raise ProtocolError."""
        if state is None:
            return
        session = self._new_session()
        session.restore(state["session"])
        self.state, self.reason = _STATES[session.state], session.busy or session.reason
        self.conversation = conversation = self._make_conversation(session)
        conversation.reading.suspended, conversation.connected_at = True, state["connected_at"]
        self._restored = (state["link"], parcel)

    def detach(self) -> None:
        """Give up the connection, which another process has now."""
        self._ending = True
        if self.conversation is not None:
            self.conversation.detach()

    def status(self) -> LinkStatus:
        """Return the entry of this link on ``status``."""
        peer, shared = str(self.address), self._settings.shared or msgspec.UNSET
        return LinkStatus(name=self.name, state=self.state, peer=peer, reason=self.reason, shared=shared)

    async def _converse(self) -> tuple[str, bool]:
        """Hold one conversation to its end; return why it ended and whether it was ever established."""
        settings, conversation = self._settings, self.conversation
        restored = conversation is not None
        if conversation is None:
            self._set_state("connecting", None)
            conversation = self.conversation = self._make_conversation(self._new_session())
        session = conversation.session
        settings.sessions.add(session)
        try:
            if not restored:
                self._link = await settings.connect(self.address, conversation)
            await conversation.ended
        except LinkError as error:
            session.fail(str(error))
        finally:
            conversation.abandon()
            self.conversation = None
            settings.sessions.remove(session)
        return session.reason or "closed", session.version is not None

    def _new_session(self) -> Session[Any]:
        return self._hooks.session(self.name, str(self.address))

    def _make_conversation(self, session: Session[Any]) -> Conversation:
        name, hooks = self.name, self._hooks
        session.name = name
        session.outbox.mute(self._muted)
        self.wire.begin(session)
        own = msgspec.structs.replace(
            hooks.conversation,
            changed=partial(self._on_session, session),
            stalled=partial(hooks.stalled, name),
            linked=partial(hooks.linked, name),
            read=partial(hooks.read, name, session.partial) if hooks.read is not None else None,
        )
        return Conversation(session, asyncio.get_running_loop(), own)

    def _on_session(self, session: Session[Any]) -> None:
        if session.state is State.ESTABLISHED and self.state != "established":
            self._hooks.connected(self.name, "established")
            agreed = [f"version {session.version}"] if session.version else []
            agreed += [f"features {', '.join(session.features)}"] if session.features else []
            text = ", ".join(["established", *agreed])
            log.info("link_established", "{link}: {agreed}", link=self._label, agreed=text, peer=session.peer)
        self._hooks.session_changed(session)
        self._set_state(_STATES[session.state], session.busy or session.reason)

    def _set_state(self, state: RobotState, reason: str | None) -> None:
        if (self.state, self.reason) != (state, reason):
            self.state, self.reason = state, reason
            self._hooks.state_changed()
