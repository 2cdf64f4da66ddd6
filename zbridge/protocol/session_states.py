"""The states of a session, as a table. Sans-IO.

Theory of operation
-------------------
A session is in one state and only ever moves down the list of :class:`State`. An event that the table does not name in
a state is ignored there, so a driver may report a loss twice and close what is closed already.

    CONNECTING   the transport is not up. Nothing is written.
    HANDSHAKING  the protocol's own steps decide what is sent. A time limit runs (``Limits.handshake_s``).
    ESTABLISHED  messages are handed to the translator. No time limit runs.
    CLOSING      nothing more is read; what waits is still written, for ``LINGER_S`` at most.
    CLOSED       nothing is read or written. The reason is the first one that was given.

Who reports an event: the driver OPEN (the transport is up) and LOST (it is gone); the protocol AGREED (the handshake is
complete), CLOSE (say goodbye) and LOST (the peer broke the protocol); the session itself WRITTEN (nothing waits to be
written) and OVERDUE (the time limit has passed).

What a session does depends on the event alone (:mod:`zbridge.protocol.session`). The state changes before: the first
step of a handshake may complete it.
"""

from __future__ import annotations

from enum import Enum


class Role(Enum):
    """The side of a legacy protocol that we play."""

    HQ = "hq"
    ROBOT = "robot"


class State(Enum):
    """The state of a session; it only ever moves down this list."""

    CONNECTING = "connecting"
    HANDSHAKING = "handshaking"
    ESTABLISHED = "established"
    CLOSING = "closing"
    CLOSED = "closed"


class SessionEvent(Enum):
    """What happens to a session."""

    OPEN = "open"
    AGREED = "agreed"
    CLOSE = "close"
    WRITTEN = "written"
    OVERDUE = "overdue"
    LOST = "lost"


TRANSITIONS: dict[State, dict[SessionEvent, State]] = {
    State.CONNECTING: {
        SessionEvent.OPEN: State.HANDSHAKING,
        SessionEvent.CLOSE: State.CLOSING,
        SessionEvent.LOST: State.CLOSED,
    },
    State.HANDSHAKING: {
        SessionEvent.AGREED: State.ESTABLISHED,
        SessionEvent.CLOSE: State.CLOSING,
        SessionEvent.OVERDUE: State.CLOSED,
        SessionEvent.LOST: State.CLOSED,
    },
    State.ESTABLISHED: {
        SessionEvent.AGREED: State.ESTABLISHED,
        SessionEvent.CLOSE: State.CLOSING,
        SessionEvent.LOST: State.CLOSED,
    },
    State.CLOSING: {
        SessionEvent.WRITTEN: State.CLOSED,
        SessionEvent.OVERDUE: State.CLOSED,
        SessionEvent.LOST: State.CLOSED,
    },
    State.CLOSED: {},
}
