"""One conversation with a peer, in either role: bytes in, messages out, frames to write, timers. Sans-IO.

A driver (:mod:`zbridge.robot.device`, a simulator, a test) calls ``open`` when the transport is up, ``receive``
with what was read, ``lost`` when the transport is gone; after each call it writes ``outgoing(now)`` until that
is None, and calls ``expire(now)`` at ``deadline()``. A protocol contributes the framing function, the
decoding of a frame, the encoding of a message, and its handshake.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from enum import Enum
from typing import Generic, TypeVar

import msgspec

from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet.messages import SessionEntry
from zbridge.protocol.outbox import Outbox
from zbridge.protocol.rate_limit import RateLimit
from zbridge.wire.frames import FrameBuffer, FrameEnd

M = TypeVar("M")

Tap = Callable[[str, bytes], None]
"""``tap("in" or "out", frame)``: is shown every frame while it is set."""

LINGER_S = 0.5
"""Longest time a closing session waits for its last frames to be written."""
DOUBTS = 2
"""Doubts about a connection with which its peer is not set in motion."""


class Role(Enum):
    """Which side of a legacy protocol we play."""

    HQ = "hq"
    ROBOT = "robot"


class State(Enum):
    """Where a session stands; it only ever moves down this list."""

    CONNECTING = "connecting"
    HANDSHAKING = "handshaking"
    ESTABLISHED = "established"
    CLOSING = "closing"
    CLOSED = "closed"


_CLOSING, _CLOSED = State.CLOSING, State.CLOSED
"""As plain names: every message asks several times, and looking a member up in its class is slow in Python 3.11."""


class Limits(msgspec.Struct, frozen=True):
    """Bounds of one session: bytes of a frame, seconds for the handshake, seconds between two writes.

    rate_hz: frames a second that the peer may send, a second's worth at once; one more ends the session.
    """

    frame_bytes: int
    handshake_s: float
    gap_s: float = 0.0
    rate_hz: float = math.inf


class Datagram(bytes):
    """A frame that goes by datagram; every other frame goes by the stream."""


class Traffic(msgspec.Struct):
    """What one session has carried, and what of it was not usable."""

    frames_in: int = 0
    frames_out: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    malformed: int = 0
    foreign: int = 0
    """Datagrams that came from elsewhere."""
    dropped: int = 0
    """Frames that found no place in the queue."""
    refused: int = 0
    """Commands of the peer that were not carried out."""
    unanswered: int = 0
    """Requests that the peer did not answer in time."""


class Session(ABC, Generic[M]):
    """The part of a conversation that all protocols share."""

    role: Role
    frame_end: FrameEnd
    handled: frozenset[type] = frozenset()
    """The message classes a session keeps for itself after the handshake too."""
    drops_source = False
    """Set by a protocol where what datagrams came from turns out not to be the peer; the driver obeys and clears it."""

    def __init__(self, limits: Limits, *, name: str = "", peer: str = "") -> None:
        self.limits = limits
        self.name = name
        self.peer = peer
        self.state = State.CONNECTING
        self.reason: str | None = None
        self.busy: str | None = None
        """Why the peer takes no commands for now, although the session is established."""
        self.doubts: tuple[str, ...] = ()
        """Signs that the connection does not carry what is said on it."""
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
        """Take a message of the handshake, or of a class in ``handled``; False keeps it for the session itself."""

    def claims(self, datagram: bytes, port: int) -> bool:
        """Tell whether a datagram from a port of the peer's host that is no peer's source yet is this session's."""
        return False

    def rivalled(self, now: float) -> None:
        """Take note that another source, or session, claims what this one does: its peer has no source any more."""

    def stray(self, datagram: bytes) -> None:
        """Look at a datagram of the peer's host that nobody claimed; raise Refused with what the peer is to be told."""

    def timers(self) -> float:
        """Tell when :meth:`on_timer` wants to be called next; ``inf`` for never."""
        return math.inf

    def on_timer(self, now: float) -> None:
        """Let a protocol's own timers that are due take effect."""

    def overdue(self) -> str:
        """Say why a handshake that was never finished probably was not."""
        return f"no handshake within {self.limits.handshake_s:g} s"

    # What a driver calls

    def open(self, now: float) -> None:
        """Begin: the transport is up. A session that was ended before stays so."""
        if self.state is not State.CONNECTING:
            return
        self.state = State.HANDSHAKING
        self._limit_at = now + self.limits.handshake_s
        self.opened(now)

    def receive(self, data: bytes, now: float) -> list[M]:
        """Take bytes in any cut; return the messages for the translator.

        A frame whose body is malformed is counted and skipped: the stream is still in step. A frame that
        cannot be one ends the session, after the messages before it.
        """
        messages: list[M] = []
        if self.over:
            return messages
        traffic, decode, tap, handled = self.traffic, self.decode, self.tap, self.handled
        open_to_all = self.state is State.ESTABLISHED
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
                    if open_to_all and type(message) not in handled:
                        messages.append(message)
                        continue
                    if self.accept(message, now):
                        messages.append(message)
                    if self.over:
                        break
                    open_to_all = self.state is State.ESTABLISHED
                except ProtocolError as error:
                    self.malformed(str(error))
                except (EncodeError, Refused) as error:
                    self.fail(f"no answer possible: {error}")
                    break
        except ProtocolError as error:
            self.malformed(str(error))
            self.fail(f"broken stream: {error}")
        traffic.frames_in += frames
        self._allowance.left -= frames
        return messages

    def receive_datagram(self, datagram: bytes, now: float) -> list[M]:
        """Take one datagram, which is one frame; return its message for the translator.

        A datagram that is no frame is counted and changes nothing else.
        """
        if self.over:
            return []
        if not self._allowance.take(now):
            self._flooded()
            return []
        self.traffic.frames_in += 1
        self.traffic.bytes_in += len(datagram)
        if self.tap is not None:
            self.tap("in", datagram)
        try:
            end = self.frame_end(datagram, 0)
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
        """Take a message that came by datagram; False keeps it for the session itself."""
        return self.accept(message, now)

    def _flooded(self) -> None:
        self.fail(f"flood: more than {self.limits.rate_hz:g} messages a second")

    def malformed(self, what: str) -> None:
        """Count one message of the peer that could not be used."""
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
            self.state = _CLOSED
        return frame

    def deadline(self, *, writing: bool = True) -> float | None:
        """Tell when :meth:`expire` and :meth:`outgoing` want to be called next.

        ``writing`` False leaves out what only waits to be written: the link takes nothing now.
        """
        if self.state is _CLOSED:
            return None
        outbox = self.outbox.deadline() if writing else None
        timers = math.inf if self.over else self.timers()
        earliest = min(self._limit_at, timers, math.inf if outbox is None else outbox)
        return None if earliest == math.inf else earliest

    def expire(self, now: float) -> None:
        """Let the timers that are due take effect."""
        if not self.over and now >= self.timers():
            self.on_timer(now)
        if now < self._limit_at:
            return
        self._limit_at = math.inf
        if self.state is State.HANDSHAKING:
            self.fail(self.overdue())
        elif self.state is State.CLOSING:
            self.state = State.CLOSED

    def close(self, reason: str, now: float) -> None:
        """End the conversation from our side once the frames that wait are written."""
        if not self.over:
            self.state, self.reason, self.busy, self.doubts = State.CLOSING, reason, None, ()
            self._limit_at = now + LINGER_S

    def lost(self, reason: str) -> None:
        """Take note that the transport is gone; the first reason stands."""
        self.fail(reason)

    def fail(self, reason: str) -> None:
        """End the conversation at once."""
        if self.state is not State.CLOSED:
            self.reason = self.reason or reason
            self.state, self.busy, self.doubts = State.CLOSED, None, ()

    # What a protocol's own code calls

    @property
    def over(self) -> bool:
        """Whether nothing more is to be expected of this session."""
        return self.state is _CLOSED or self.state is _CLOSING

    @property
    def doubtful(self) -> str | None:
        """Why the peer is not to be set in motion on this connection; one doubt alone is no reason."""
        return f"connection in doubt: {'; '.join(self.doubts)}" if len(self.doubts) >= DOUBTS else None

    def establish(self, version: str, features: tuple[str, ...]) -> None:
        """End the handshake with what was agreed."""
        self.state, self.version, self.features = State.ESTABLISHED, version, features
        self._limit_at = math.inf

    def send(self, message: M) -> None:
        """Queue a message that is sent once; raises Refused when too many wait, EncodeError."""
        self.outbox.put(self.encode(message))

    def send_first(self, message: M) -> None:
        """Queue a message of the handshake: nothing goes before it, and a silence does not hold it."""
        self.outbox.put_exempt(self.encode(message))

    def snapshot(self) -> SessionEntry:
        """Show the session as it is now."""
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
