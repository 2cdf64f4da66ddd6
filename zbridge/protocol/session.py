"""One conversation with a peer, in either role: bytes in, messages out, frames to write, timers. Sans-IO.

Theory of operation
-------------------
The state of a session is an entry of the table in :mod:`zbridge.protocol.session_states`; ``_on`` executes it. A driver
(a conversation over a link, a simulator, a test) calls ``open`` when the transport is up, ``receive`` with the bytes
that were read and ``lost`` when the transport is gone. After each call it writes ``outgoing(now)`` until that is None,
and calls ``expire(now)`` at ``deadline()``.

A protocol contributes the framing function, ``decode``, ``encode`` and the steps of its handshake: ``opened`` takes the
first one, ``accept`` those that answer the peer, ``establish`` ends it. ``receive`` raises nothing: a frame with a
malformed body is skipped; what cannot be a frame, too many frames, or an answer that cannot be sent end the session.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from enum import Enum
from typing import Any, Generic, TypeVar

import msgspec

from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet.messages import SessionEntry
from zbridge.protocol.outbox import Outbox
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.session_kept import KeptSession
from zbridge.protocol.session_states import TRANSITIONS, SessionAction, SessionEvent
from zbridge.protocol.session_states import State as State
from zbridge.protocol.traffic import Datagram as Datagram
from zbridge.protocol.traffic import Limits as Limits
from zbridge.protocol.traffic import Traffic as Traffic
from zbridge.wire.frames import FrameBuffer, FrameEnd

M = TypeVar("M")

Tap = Callable[[str, bytes], None]
"""``tap("in" or "out", frame)``: is shown every frame while it is set; a :class:`Datagram` where it went by one."""

LINGER_S = 0.5
"""Seconds that a closing session waits for its last frames to be written."""
DOUBTS = 2
"""So many doubts about a connection forbid motion; one alone may be an accident."""


class Role(Enum):
    """The side of a legacy protocol that we play."""

    HQ = "hq"
    ROBOT = "robot"


_ESTABLISHED, _CLOSING, _CLOSED = State.ESTABLISHED, State.CLOSING, State.CLOSED
"""Every message is compared with these; a lookup in the class is slow in Python 3.11."""


class Session(KeptSession, ABC, Generic[M]):
    """One conversation; a protocol subclasses it once for each role it plays."""

    role: Role
    frame_end: FrameEnd
    handled: frozenset[type] = frozenset()
    """Message classes that go to ``accept`` after the handshake too."""
    drops_source = False
    """Set by a protocol when the source of datagrams is not the peer; the driver forgets the source and clears it."""

    def __init__(self, limits: Limits, *, name: str = "", peer: str = "") -> None:
        self.limits = limits
        self.name = name
        self.peer = peer
        self.state = State.CONNECTING
        self.reason: str | None = None
        self.busy: str | None = None
        """Why the peer takes no commands now although the session is established; None: it takes them."""
        self.doubts: tuple[str, ...] = ()
        """Signs that the connection loses or alters what is sent on it."""
        self.version: str | None = None
        self.features: tuple[str, ...] = ()
        self.transport = "tcp"
        self.traffic = Traffic()
        self.left_out: Counter[str] = Counter()
        self.last_malformed: str | None = None
        self.outbox = Outbox(limits.gap_s)
        self.tap: Tap | None = None
        self._frames = FrameBuffer(self.frame_end, limits.frame_bytes)
        self._limit_at = math.inf
        self._allowance = RateLimit(limits.rate_hz)

    def __repr__(self) -> str:
        reason = f" ({self.reason})" if self.reason else ""
        return f"<{type(self).__name__} {self.name or self.peer} {self.state.value}{reason}>"

    # What a protocol contributes

    @abstractmethod
    def encode(self, message: M) -> bytes:
        """Write a message as one frame; raise EncodeError where it cannot be."""

    @abstractmethod
    def decode(self, frame: bytes) -> M:
        """Read one frame; raise ProtocolError where it is none of this protocol's messages."""

    def opened(self, now: float) -> None:
        """Take the first step of the handshake."""

    @abstractmethod
    def accept(self, message: M, now: float) -> bool:
        """Handle a message of the handshake, or of a class in ``handled``; True hands it on to the translator."""

    def claims(self, datagram: bytes, port: int) -> bool:
        """Tell whether a datagram from a port of the peer's host that is nobody's source yet is from the peer."""
        return False

    def rivalled(self, now: float) -> None:
        """React to a second source, or session, with the same claim; the peer has no source of datagrams any more."""

    def stray(self, datagram: bytes) -> None:
        """ReadPayload at a datagram of the peer's host that nobody claimed; raise Refused to tell the peer why."""

    def timers(self) -> float:
        """Give the time of the next :meth:`on_timer`; ``inf``: never."""
        return math.inf

    def on_timer(self, now: float) -> None:
        """Run the protocol's own timers that are due."""

    def undated(self, frame: bytes) -> bytes:
        """Give a written frame without what each writing changes, as numbers and times; for the conformance kit."""
        return frame

    def overdue(self) -> str:
        """Give the reason for a handshake that was not finished in time."""
        return f"no handshake within {self.limits.handshake_s:g} s"

    # What a driver calls

    def open(self, now: float) -> None:
        """Begin: the transport is up. A session that has ended stays so."""
        self._on(SessionEvent.OPEN, now=now)

    def receive(self, data: bytes, now: float) -> list[M]:
        """Take bytes in any cut; give the messages for the translator, also those before a broken frame."""
        messages: list[M] = []
        established = self.state is _ESTABLISHED
        if not established and self.over:
            return messages
        traffic, decode, tap, handled = self.traffic, self.decode, self.tap, self.handled
        traffic.bytes_in += len(data)
        frames, allowed = 0, self._allowance.fill(now)
        try:
            for frame in self._frames.feed(data):
                frames += 1
                if frames > allowed:
                    self._flooded()
                    break
                if tap is not None:
                    tap("in", frame)
                try:
                    message = decode(frame)
                    if established and type(message) not in handled:
                        messages.append(message)
                        continue
                    if self.accept(message, now):
                        messages.append(message)
                except ProtocolError as error:
                    self.malformed(str(error))
                except (EncodeError, Refused) as error:
                    self.fail(f"no answer possible: {error}")
                if self.over:
                    break
                established = self.state is _ESTABLISHED
        except ProtocolError as error:
            self.malformed(str(error))
            self.fail(f"broken stream: {error}")
        traffic.frames_in += frames
        self._allowance.left -= frames
        return messages

    def receive_datagram(self, datagram: bytes, now: float) -> list[M]:
        """Take one datagram, which is one frame; give its message for the translator."""
        if self.over:
            return []
        if not self._allowance.take(now):
            self._flooded()
            return []
        self.traffic.frames_in += 1
        self.traffic.bytes_in += len(datagram)
        if self.tap is not None:
            self.tap("in", Datagram(datagram))
        try:
            end = self.frame_end(datagram, 0) if datagram else 1
            if end != len(datagram):
                raise ProtocolError(f"datagram of {len(datagram)} bytes holds a frame of {end}")
            message = self.decode(datagram)
            if self.accept_datagram(message, now):
                return [message]
        except ProtocolError as error:
            self.malformed(str(error))
        except (EncodeError, Refused) as error:
            self.fail(f"no answer possible: {error}")
        return []

    def accept_datagram(self, message: M, now: float) -> bool:
        """Handle a message that came by datagram; True hands it on to the translator."""
        return self.accept(message, now)

    def _flooded(self) -> None:
        self.fail(f"flood: more than {self.limits.rate_hz:g} messages a second")

    def malformed(self, what: str) -> None:
        """Count a message of the peer that is malformed; ``what`` says how."""
        self.traffic.malformed += 1
        self.last_malformed = what

    def outgoing(self, now: float) -> bytes | None:
        """Take the next frame to write now; None when nothing may be written yet."""
        if self.state is _CLOSED:
            return None
        frame = self.outbox.take(now)
        if frame is not None:
            self.traffic.frames_out += 1
            self.traffic.bytes_out += len(frame)
            if self.tap is not None:
                self.tap("out", frame)
        elif self.state is _CLOSING and not self.outbox:
            self._on(SessionEvent.WRITTEN)
        return frame

    def deadline(self, *, writing: bool = True) -> float | None:
        """Give the time of the next :meth:`expire` and :meth:`outgoing`; None: never.

        ``writing`` False leaves out the frames that wait: the link takes nothing now.
        """
        if self.state is _CLOSED:
            return None
        outbox = self.outbox.deadline() if writing else None
        timers = math.inf if self.state is _CLOSING else self.timers()
        earliest = min(self._limit_at, timers, math.inf if outbox is None else outbox)
        return None if earliest == math.inf else earliest

    def expire(self, now: float) -> None:
        """Run the timers that are due."""
        if not self.over and now >= self.timers():
            self.on_timer(now)
        if now >= self._limit_at:
            self._limit_at = math.inf
            self._on(SessionEvent.OVERDUE, self.overdue())

    def close(self, reason: str, now: float) -> None:
        """End the conversation from our side once the frames that wait are written."""
        self._on(SessionEvent.CLOSE, reason, now)

    def lost(self, reason: str) -> None:
        """End the conversation: the transport is gone. The first reason is kept."""
        self.fail(reason)

    def fail(self, reason: str) -> None:
        """End the conversation at once."""
        self._on(SessionEvent.LOST, reason)

    # What a protocol's own code calls

    @property
    def over(self) -> bool:
        """Whether the session is closing or closed."""
        return self.state is _CLOSED or self.state is _CLOSING

    @property
    def doubtful(self) -> str | None:
        """Why the peer must not be moved by this connection: ``DOUBTS`` doubts or more; else None."""
        return f"connection in doubt: {'; '.join(self.doubts)}" if len(self.doubts) >= DOUBTS else None

    def establish(self, version: str, features: tuple[str, ...]) -> None:
        """End the handshake with what was agreed."""
        if not self.over:
            self.version, self.features = version, features
            self._on(SessionEvent.AGREED)

    def lift_limit(self) -> None:
        """Let the handshake take longer than its time limit: the protocol's own timers watch it from here."""
        self._limit_at = math.inf

    def send(self, message: M) -> None:
        """Queue a message that is sent once; raise Refused when too many wait, EncodeError."""
        self.outbox.put(self.encode(message))

    def send_first(self, message: M) -> None:
        """Queue a message of the handshake: it goes before all others, and through a silence of the outbox."""
        self.outbox.put_exempt(self.encode(message))

    def snapshot(self) -> SessionEntry:
        """Show the session as it is now, for the session table."""
        return SessionEntry(
            name=self.name,
            peer=self.peer,
            role=self.role.value,
            state=self.state.value,
            reason=self.reason or self.busy,
            version=self.version or None,
            features=self.features,
            transport=self.transport,
            counters=msgspec.structs.asdict(self.traffic),
            left_out=dict(self.left_out),
        )

    # The table, executed

    def _on(self, event: SessionEvent, reason: str = "", now: float = math.inf) -> None:
        step = TRANSITIONS[self.state].get(event)
        if step is not None:
            action, self.state = step
            _ACTIONS[action](self, reason, now)


def _begin(session: Session[Any], reason: str, now: float) -> None:
    session._limit_at = now + session.limits.handshake_s
    session.opened(now)


def _settle(session: Session[Any], reason: str, now: float) -> None:
    session._limit_at = math.inf


def _leave(session: Session[Any], reason: str, now: float) -> None:
    session.reason, session.busy, session.doubts = reason, None, ()
    session._limit_at = now + LINGER_S


def _end(session: Session[Any], reason: str, now: float) -> None:
    session.reason, session.busy, session.doubts = session.reason or reason, None, ()


_ACTIONS: dict[SessionAction, Callable[[Session[Any], str, float], None]] = {
    SessionAction.BEGIN: _begin,
    SessionAction.SETTLE: _settle,
    SessionAction.LEAVE: _leave,
    SessionAction.END: _end,
}
