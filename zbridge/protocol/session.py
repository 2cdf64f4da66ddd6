"""One conversation with a peer, in either role: bytes in, messages out, frames to write, timers. Sans-IO.

Theory of operation
-------------------
The state of a session is an entry of the table in :mod:`zbridge.protocol.session_states`; ``_on`` executes it. A driver
(a conversation over a link, a simulator, a test) calls ``open`` when the transport is up, ``receive`` with the bytes
that were read and ``fail`` when the transport is gone. After each call it writes ``outgoing(now)`` until that is None,
and calls ``expire(now)`` at ``deadline()``.

A protocol contributes the framing function, ``decode``, ``encode`` and the steps of its handshake: ``opened`` takes the
first one, ``accept`` those that answer the peer, ``establish`` ends it; then the session repeats ``keep_alive`` and
watches for a silence (``silent_s``, ``lost_s``), where its class sets them. ``receive`` raises nothing: a frame with a
malformed body is skipped; what cannot be a frame, too many frames, or an answer that cannot be sent end the session.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

import msgspec

from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet.processes import SessionEntry
from zbridge.protocol.kept import Budget, Exported, Kept
from zbridge.protocol.liveness import KeepAlive as KeepAlive
from zbridge.protocol.liveness import SilenceWatch
from zbridge.protocol.outbox import KEEP_ALIVE, Outbox
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.session_states import TRANSITIONS, SessionEvent
from zbridge.protocol.session_states import Role as Role
from zbridge.protocol.session_states import State as State
from zbridge.protocol.traffic import Datagram as Datagram
from zbridge.protocol.traffic import Limits as Limits
from zbridge.protocol.traffic import Traffic as Traffic
from zbridge.wire.frames import DatagramFrames, FrameBuffer, FrameEnd, Partial

M = TypeVar("M")

Tap = Callable[[str, bytes], None]
"""``tap("in" or "out", frame)``: called with every frame while it is set; a :class:`Datagram` if it went by one."""

LINGER_S = 0.5
"""Seconds that a closing session waits for its last frames to be written."""
DOUBTS = 2
"""Doubts about a connection that together forbid motion; one alone may be an accident."""

PARTIAL = "partial"
"""The name of the incomplete frame in a state."""
SKIPPED = "the rest of a frame whose beginning was lost with a gateway"
"""What a session counts among what it left out."""

_ESTABLISHED, _CLOSING, _CLOSED = State.ESTABLISHED, State.CLOSING, State.CLOSED
"""Every message is compared with these; looking them up in the class is slow in Python 3.11."""


class Session(Kept, ABC, Generic[M]):
    """One conversation; a protocol subclasses it once for each role it plays."""

    kept: ClassVar[dict[str, Any]] = {
        "state": State,
        "reason": str | None,
        "busy": str | None,
        "doubts": tuple[str, ...],
        "version": str | None,
        "features": tuple[str, ...],
        "transport": str,
        "traffic": Traffic,
        "left_out": dict[str, int],
        "last_malformed": str | None,
        "outbox": Outbox,
        "_limit_at": float,
        "_allowance": RateLimit,
    }
    role: Role
    frame_end: FrameEnd
    known_versions: frozenset[str] = frozenset()
    """The versions that may be agreed; metrics show all others, which a peer may have made up, as one."""
    handled: frozenset[type] = frozenset()
    """Message classes that go to ``accept`` after the handshake too."""
    silent_s: float | None = None
    """Seconds without a message after which the robot is not driven; ``inf``: a healthy robot may be silent."""
    lost_s: float | None = None
    """Seconds without a message after which the session ends; None: it never ends for that."""
    speaks_first = False
    """Whether we speak first on a link of datagrams; else the peer did, and may be anybody."""
    keep_alive: KeepAlive | None = None
    """What the robot's watchdog needs. It leaves only while this process works, so the watchdog stops a robot whose
    gateway hangs."""

    def __init__(self, limits: Limits, *, name: str = "", peer: str = "") -> None:
        self.limits = limits
        self.name = name
        self.peer = peer
        self.state = State.CONNECTING
        self.reason: str | None = None
        self.busy: str | None = None
        """Why the peer accepts no commands now although the session is established; None: it accepts them."""
        self.doubts: tuple[str, ...] = ()
        """Signs that the connection loses or alters what is sent on it."""
        self.warnings: tuple[str, ...] = ()
        """What people should know of the robot, on the next ``status``; it is driven all the same."""
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
        self.silence = SilenceWatch(self.silent_s, self.lost_s)
        self._watches = self.silence.on

    def __repr__(self) -> str:
        reason = f" ({self.reason})" if self.reason else ""
        return f"<{type(self).__name__} {self.name or self.peer} {self.state.value}{reason}>"

    # What a protocol contributes

    @abstractmethod
    def encode(self, message: M) -> bytes:
        """Write a message as one frame; raise EncodeError if it cannot be."""

    @abstractmethod
    def decode(self, frame: bytes) -> M:
        """Read one frame; raise ProtocolError if it is none of this protocol's messages."""

    def opened(self, now: float) -> None:
        """Take the first step of the handshake."""

    @abstractmethod
    def accept(self, message: M, now: float) -> bool:
        """Handle a message of the handshake, or of a class in ``handled``; True passes it on to the translator."""

    def timers(self) -> float:
        """Return the time of the next :meth:`on_timer`; ``inf``: never."""
        return math.inf

    def on_timer(self, now: float) -> None:
        """Run the protocol's own timers that are due."""

    def undated(self, frame: bytes) -> bytes:
        """Return a written frame without what each writing changes, as numbers and times; for the conformance kit."""
        return frame

    def overdue(self) -> str:
        """Return the reason for a handshake that was not finished in time."""
        return f"no handshake within {self.limits.handshake_s:g} s"

    # What a driver calls

    def open(self, now: float) -> None:
        """Begin: the transport is up. A session that has ended stays so."""
        self._on(SessionEvent.OPEN, now=now)

    def by_datagrams(self, *, speaks_first: bool) -> None:
        """Take each :meth:`receive` as one datagram. speaks_first: see the attribute."""
        self.transport, self.speaks_first = "udp", speaks_first
        self._frames = DatagramFrames(self.frame_end, self.limits.frame_bytes, self.malformed)

    def receive(self, data: bytes, now: float) -> list[M]:
        """Receive bytes, cut anywhere; return the messages for the translator, also those before a broken frame."""
        messages: list[M] = []
        established = self.state is _ESTABLISHED
        if not established and self.over:
            return messages
        traffic, decode, tap, handled = self.traffic, self.decode, self.tap, self.handled
        traffic.bytes_in += len(data)
        frames = broken = 0
        allowed = self._allowance.fill(now) if self._allowance.rate_hz < math.inf else math.inf
        try:
            for frame in self._frames.feed(data):
                frames += 1
                if frames > allowed:
                    self.fail(self._allowance.exceeded)
                    break
                if tap is not None:
                    tap("in", frame)
                try:
                    message = decode(frame)
                    if established and type(message) not in handled:  # nearly always
                        messages.append(message)
                        continue
                    if self.accept(message, now):
                        messages.append(message)
                except ProtocolError as error:
                    self.malformed(str(error))
                    broken += 1
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
        if self._watches and frames > broken:
            self._heard(now)
        return messages

    def receive_datagram(self, datagram: bytes, now: float) -> list[M]:
        """Receive one datagram, which is one frame; return its message for the translator."""
        if self.over:
            return []
        if not self._allowance.take(now):
            self.fail(self._allowance.exceeded)
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
            self._heard(now)
            if self.accept_datagram(message, now):
                return [message]
        except ProtocolError as error:
            self.malformed(str(error))
        except (EncodeError, Refused) as error:
            self.fail(f"no answer possible: {error}")
        return []

    def accept_datagram(self, message: M, now: float) -> bool:
        """Handle a message that came by datagram; True passes it on to the translator."""
        return self.accept(message, now)

    def _heard(self, now: float) -> None:
        """Note a sign of life of an established peer."""
        if self._watches and self.state is _ESTABLISHED:
            self.busy = self.silence.heard(now, self.busy)

    def malformed(self, what: str) -> None:
        """Count a malformed message of the peer; ``what`` describes it."""
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
        elif self.state is _CLOSING and not self.outbox.waits(now):
            self._on(SessionEvent.WRITTEN)
        return frame

    def deadline(self, *, writing: bool = True) -> float | None:
        """Return the time of the next :meth:`expire` and :meth:`outgoing`; None: never.

        ``writing`` False leaves out waiting frames: the link is stalled now.
        """
        if self.state is _CLOSED:
            return None
        outbox = self.outbox.deadline() if writing else None
        timers = math.inf if self.state is _CLOSING else self.timers()
        if self._watches and self.state is not _CLOSING:
            timers = min(timers, self.silence.due)
        earliest = min(self._limit_at, timers, math.inf if outbox is None else outbox)
        return None if earliest == math.inf else earliest

    def expire(self, now: float) -> None:
        """Run the timers that are due."""
        if not self.over and now >= self.timers():
            self.on_timer(now)
        if self._watches and not self.over and now >= self.silence.due:
            self.busy, lost = self.silence.judge(now, self.busy)
            if lost is not None:
                self.fail(lost)
        if now >= self._limit_at:
            self._limit_at = math.inf
            self._on(SessionEvent.OVERDUE, self.overdue())

    def close(self, reason: str, now: float) -> None:
        """End the conversation from our side once the waiting frames are written."""
        self._on(SessionEvent.CLOSE, reason, now)

    def fail(self, reason: str) -> None:
        """End the conversation at once: the transport is gone, or of no use. The first reason is kept."""
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
        """Lift the time limit of the handshake: it is complete, or the protocol's own timers watch it from here."""
        self._limit_at = math.inf

    def send(self, message: M) -> None:
        """Queue a message that is sent once; raise Refused when too many wait, EncodeError."""
        self.outbox.put(self.encode(message))

    def send_first(self, message: M) -> None:
        """Queue a message of the handshake: it goes before all others, and through a silence of the outbox."""
        self.outbox.put_exempt(self.encode(message))

    def snapshot(self) -> SessionEntry:
        """Describe the session as it is now, for the session table."""
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

    # A restart of the gateway

    def export(self, budget: Budget | None = None) -> Exported:
        """Write the state with the incomplete frame; to a deposit, who watches reads adds that (:meth:`partial`)."""
        state = super().export(budget) | ({"silence": self.silence.export()} if self._watches else {})
        return state | {PARTIAL: list(self._frames.partial() or ())} if budget is None else state

    def partial(self, most_bytes: int) -> Partial | None:
        """Describe the incomplete frame in ``most_bytes`` at most; None where that is not possible."""
        return self._frames.partial(most_bytes)

    def restore(self, state: Exported) -> None:
        """Take over the state of another process's session, in place of :meth:`open`; raise ProtocolError."""
        super().restore(state)
        if self._watches:
            self.silence.restore(state.get("silence", {}))
        partial = Partial.read(state.get(PARTIAL, (b"", 0)))
        self._frames.resume(partial)
        if partial.skip:
            self.left_out[SKIPPED] += 1

    # The table, executed

    def _on(self, event: SessionEvent, reason: str = "", now: float = math.inf) -> None:
        state = TRANSITIONS[self.state].get(event)
        if state is not None:
            self.state = state
            _ACTIONS[event](self, reason, now)


def _begin(session: Session[Any], reason: str, now: float) -> None:
    session._limit_at = now + session.limits.handshake_s
    session.opened(now)


def _agree(session: Session[Any], reason: str, now: float) -> None:
    session.lift_limit()
    if (keep_alive := session.keep_alive) is not None:
        frames = (session.encode(keep_alive.message),)
        session.outbox.set(KEEP_ALIVE, frames, -math.inf, period_s=keep_alive.period_s)
    session.silence.begin()


def _leave(session: Session[Any], reason: str, now: float) -> None:
    session.reason, session.busy, session.doubts = reason, None, ()
    session._limit_at = now + LINGER_S


def _end(session: Session[Any], reason: str, now: float) -> None:
    session.reason, session.busy, session.doubts = session.reason or reason, None, ()


_ACTIONS: dict[SessionEvent, Callable[[Session[Any], str, float], None]] = {
    SessionEvent.OPEN: _begin,
    SessionEvent.AGREED: _agree,
    SessionEvent.CLOSE: _leave,
    SessionEvent.WRITTEN: _end,
    SessionEvent.OVERDUE: _end,
    SessionEvent.LOST: _end,
}
