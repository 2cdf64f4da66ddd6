"""The links of one robot: each connects, converses, and connects again, until it is closed.

Knows no bus and no translation.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from zbridge.errors import LinkError
from zbridge.fleet.messages import LinkStatus, RobotState
from zbridge.metrics import Count
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.session import Session, State, Tap
from zbridge.protocol.session_table import Backoff, SessionTable
from zbridge.transport import Conversation, Link

log = logging.getLogger("zbridge.link")

Connect = Callable[[DeviceAddress, Conversation], Any]
"""``await connect(address, receiver)``: raises LinkError where there is no connection to be had."""

_LOGGED = 64
_STATES: dict[State, RobotState] = {
    State.CONNECTING: "connecting",
    State.HANDSHAKING: "handshaking",
    State.ESTABLISHED: "established",
    State.CLOSING: "closing",
    State.CLOSED: "offline",
}


class Hooks(msgspec.Struct, frozen=True):
    """What a connection is given by the device it belongs to."""

    session: Callable[[], Session[Any]]
    deliver: Callable[[list[Any]], None]
    session_changed: Callable[[Session[Any]], None]
    state_changed: Callable[[], None]
    connect: Connect
    manager: SessionTable
    malformed: Count
    foreign: Count
    clock: Callable[[], float]
    before: Callable[[], object] = lambda: None
    """Called before a frame is written: a stop may have to be written first."""
    stalled: Callable[[bool], object] = lambda stalled: None
    """Called when the link stops taking bytes (True), and when it takes them again (False)."""


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

    def pump(self) -> None:
        """Write what may be written."""
        for connection in self._connections:
            if connection.conversation is not None:
                connection.conversation.pump()

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""
        for connection in self._connections:
            if connection.conversation is not None:
                connection.conversation.pause()

    def resume(self) -> None:
        """Read again."""
        for connection in self._connections:
            if connection.conversation is not None:
                connection.conversation.resume()


class Connection:
    """One configured address, its conversation while there is one, and who watches its frames."""

    def __init__(self, name: str, label: str, address: DeviceAddress, hooks: Hooks) -> None:
        self.name = name
        self._label = label
        self.address = address
        self.state: RobotState = "offline"
        self.reason: str | None = "not yet connected"
        self.conversation: Conversation | None = None
        self._hooks = hooks
        self._ending = False
        self._link: Link | None = None
        self._watchers: dict[str, Callable[[bytes], object]] = {}

    def __repr__(self) -> str:
        return f"<Connection {self.name} {self.address} {self.state}>"

    async def run(self) -> None:
        """Connect, converse and connect again, until :meth:`close`."""
        backoff = Backoff()
        while not self._ending:
            reason, established = await self._converse()
            if established:
                backoff.reset()
            delay_s = backoff.delay_s()
            log.info("%s: %s; next attempt in %.1f s", self._label, reason, delay_s)
            self._set_state("offline", reason)
            await asyncio.sleep(delay_s)

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

    def status(self) -> LinkStatus:
        """Return the entry of this link on ``status``."""
        return LinkStatus(name=self.name, state=self.state, peer=str(self.address), reason=self.reason)

    def watch(self, direction: str, show: Callable[[bytes], object] | None) -> None:
        """Show the raw frames of one direction (``in`` or ``out``) from now on; None: show none."""
        if show is not None:
            self._watchers[direction] = show
        else:
            self._watchers.pop(direction, None)
        if self.conversation is not None:
            self.conversation.session.tap = self._tap

    @property
    def _tap(self) -> Tap | None:
        return self._show if self._watchers or log.isEnabledFor(logging.DEBUG) else None

    def _show(self, direction: str, frame: bytes) -> None:
        if log.isEnabledFor(logging.DEBUG):
            log.debug("%s %s %s", "<" if direction == "in" else ">", self._label, frame[:_LOGGED].hex(" "))
        show = self._watchers.get(direction)
        if show is not None:
            show(frame)

    async def _converse(self) -> tuple[str, bool]:
        """Hold one conversation to its end; return why it ended and whether it was ever established."""
        hooks, session = self._hooks, self._hooks.session()
        session.name, session.tap = self.name, self._tap
        conversation = Conversation(
            session,
            asyncio.get_running_loop(),
            deliver=hooks.deliver,
            changed=lambda: self._on_session(session),
            malformed=hooks.malformed,
            foreign=hooks.foreign,
            clock=hooks.clock,
            before=hooks.before,
            stalled=hooks.stalled,
        )
        self._set_state("connecting", None)
        self.conversation = conversation
        hooks.manager.add(session)
        try:
            self._link = await hooks.connect(self.address, conversation)
            await conversation.ended
        except LinkError as error:
            session.lost(str(error))
        finally:
            conversation.abandon()
            self.conversation = None
            hooks.manager.remove(session)
        return session.reason or "closed", session.version is not None

    def _on_session(self, session: Session[Any]) -> None:
        if session.state is State.ESTABLISHED and self.state != "established":
            agreed = [f"version {session.version}"] if session.version else []
            agreed += [f"features {', '.join(session.features)}"] if session.features else []
            log.info("%s: %s", self._label, ", ".join(["established", *agreed]))
        self._hooks.session_changed(session)
        self._set_state(_STATES[session.state], session.busy or session.reason)

    def _set_state(self, state: RobotState, reason: str | None) -> None:
        if (self.state, self.reason) != (state, reason):
            self.state, self.reason = state, reason
            self._hooks.state_changed()
