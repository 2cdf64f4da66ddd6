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

The state changes before the action runs: the first step of a handshake may complete it.
"""

from __future__ import annotations

from enum import Enum


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


class SessionAction(Enum):
    """What a session does on an event."""

    BEGIN = "begin"
    """Start the time limit; take the first step of the handshake."""
    SETTLE = "settle"
    """Lift the time limit."""
    LEAVE = "leave"
    """Record the reason; start the time limit for the last frames."""
    END = "end"
    """Record the first reason."""


TRANSITIONS: dict[State, dict[SessionEvent, tuple[SessionAction, State]]] = {
    State.CONNECTING: {
        SessionEvent.OPEN: (SessionAction.BEGIN, State.HANDSHAKING),
        SessionEvent.CLOSE: (SessionAction.LEAVE, State.CLOSING),
        SessionEvent.LOST: (SessionAction.END, State.CLOSED),
    },
    State.HANDSHAKING: {
        SessionEvent.AGREED: (SessionAction.SETTLE, State.ESTABLISHED),
        SessionEvent.CLOSE: (SessionAction.LEAVE, State.CLOSING),
        SessionEvent.OVERDUE: (SessionAction.END, State.CLOSED),
        SessionEvent.LOST: (SessionAction.END, State.CLOSED),
    },
    State.ESTABLISHED: {
        SessionEvent.AGREED: (SessionAction.SETTLE, State.ESTABLISHED),
        SessionEvent.CLOSE: (SessionAction.LEAVE, State.CLOSING),
        SessionEvent.LOST: (SessionAction.END, State.CLOSED),
    },
    State.CLOSING: {
        SessionEvent.WRITTEN: (SessionAction.END, State.CLOSED),
        SessionEvent.OVERDUE: (SessionAction.END, State.CLOSED),
        SessionEvent.LOST: (SessionAction.END, State.CLOSED),
    },
    State.CLOSED: {},
}
