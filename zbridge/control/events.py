"""The right to drive a robot: its states, the inputs that change them, and the events that result. Sans-IO."""

from __future__ import annotations

import math
from enum import Enum, StrEnum

import msgspec

from zbridge.errors import Code
from zbridge.fleet.lease_messages import Acquire, Authorization


class AuthorityState(StrEnum):
    """The state of the right to drive; ``control`` shows the middle three as ``held``."""

    FREE = "free"
    HELD = "held"
    MOVING = "moving"
    NEEDS_NEUTRAL = "needs neutral"
    STOPPED = "stopped"
    LATCHED = "latched"


class AuthorityInput(StrEnum):
    """What happened, to the authority."""

    ACQUIRE = "acquire"
    OUTRANK = "acquire with a higher priority"
    AGAIN = "acquire asked again"
    TAKEOVER = "takeover"
    RENEW = "renew"
    RELEASE = "release"
    MOTION = "motion carried out"
    NEUTRAL = "neutral carried out"
    STALE_NEUTRAL = "stale neutral carried out"
    DEADMAN = "deadman"
    REQUIRE_NEUTRAL = "require neutral"
    STOP = "stop"
    LATCH = "latch"
    UNLATCH = "last latch released"
    EXPIRED = "lease expired"
    HOLDER_LOST = "holder lost"
    BUS_LOST = "bus lost"


class StopCause(StrEnum):
    """What stops a robot, for programs; the reason says more to people."""

    COMMAND = "command"
    """Somebody's stop."""
    LATCH = "latch"
    """A latched stop came into force."""
    DEADMAN = "deadman"
    """Motion was not repeated in time."""
    LEASE_EXPIRED = "lease_expired"
    """The holder did not renew its lease."""
    HOLDER_LOST = "holder_lost"
    """The holder's liveliness token is gone."""
    BUS_LOST = "bus_lost"
    """No other process can be reached."""
    RELEASED = "released"
    """The holder gave the lease back while the robot moved."""
    TAKEN_OVER = "taken_over"
    """Another program took the lease while the robot moved."""
    UNDRIVEN = "undriven"
    """It moved without a driver when a program acquired it."""
    LINK_STALLED = "link_stalled"
    """Its link had accepted no bytes."""
    ROBOT_LOST = "robot_lost"
    """Its connection ended."""
    ROBOT_BUSY = "robot_busy"
    """It accepts no commands, or has just begun to."""
    LINK_IN_DOUBT = "link_in_doubt"
    """Its connection may lose or alter what is sent."""
    NOT_READY = "not_ready"
    """Motion was refused because the robot was not ready."""
    ANOTHER_GATEWAY = "another_gateway"
    """It was left to another gateway, or taken back."""
    RESTART = "restart"
    """The gateway hands over to its successor."""
    GATEWAY_ENDING = "gateway_ending"
    """The gateway takes leave of the robot."""
    SUSPENDED = "suspended"
    """The gateway's machine slept."""


ORDERED = frozenset({StopCause.COMMAND, StopCause.LATCH})
"""The causes of stops that somebody ordered: all others only end what this gateway has begun."""


class EventKind(Enum):
    """What happened to the right to drive."""

    ACQUIRED = "acquired"
    TAKEN_OVER = "taken over"
    RELEASED = "released"
    REFUSED = "refused"
    STOPPED = "stopped"
    LATCHED = "latched"
    UNLATCHED = "unlatched"
    ENDED = "ended"


class Cause(msgspec.Struct, frozen=True):
    """What comes with an input of the table; each action reads what it needs.

    at: when it happened, or when a command was given. received_ms: the gateway's raw clock. request: for the lease.
    shown, key: the proof of a question about the lease, and the key that was queried. kind, reason, who: of the event
    that follows. stops: whether the robot is sent its stop where neutral is required. stop: the cause of a stop.
    """

    at: float = math.inf
    received_ms: float = 0.0
    request: Acquire | None = None
    shown: Authorization | None = None
    key: str = ""
    kind: EventKind = EventKind.ENDED
    reason: str = ""
    who: str | None = None
    stops: bool = True
    stop: StopCause = StopCause.COMMAND


class CommandSender(msgspec.Struct, frozen=True):
    """Who sent a command of the lease, and when it was given.

    given_at: on the time line of the event loop, seconds. late_s: for how long it was on its way. stale: it is too old
    to be obeyed, but for neutral and for a mode that ends autonomous motion.
    """

    who: str
    given_at: float
    late_s: float = 0.0
    stale: bool = False


class AuthorityEvent(msgspec.Struct, frozen=True):
    """One event to write down. stops: whether the robot must be sent its stop now. cause: of an event that stops it."""

    what: EventKind
    who: str | None = None
    reason: str | None = None
    priority: int | None = None
    command: str | None = None
    code: Code | None = None
    stops: bool = False
    cause: StopCause | None = None

    def __str__(self) -> str:
        who = f" {self.who}" if self.who else ""
        command = f" {self.command}" if self.command else ""
        return f"{self.what.value}{who}{command}{f' ({self.reason})' if self.reason else ''}"
