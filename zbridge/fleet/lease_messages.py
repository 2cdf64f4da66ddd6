"""The messages about the lease of a robot and its latched stops: what programs ask, and what they are answered.

Times are seconds, stamps milliseconds of the sender's raw clock.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import UNSET, UnsetType

from zbridge.fleet.messages import FleetMessage, Latch, StopId

LeaseId = Annotated[bytes, msgspec.Meta(min_length=8, max_length=8)]
Token = Annotated[bytes, msgspec.Meta(min_length=32, max_length=32)]
Proof = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
GivenMs = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]


class Unlatch(FleetMessage, frozen=True):
    """Release one latched stop.

    id: of the stop.
    """

    id: StopId


class FleetLatches(FleetMessage, frozen=True):
    """What one gateway knows of the fleet's latched stops.

    latches: those in force. released: the ids released last.
    """

    latches: tuple[Latch, ...] = ()
    released: tuple[StopId, ...] = ()


class Acquire(FleetMessage, frozen=True):
    """Ask for the lease of a robot, or take it over.

    who: the name that others are shown. priority: a higher priority gets the lease of a holder with a lower one.
    lease_s, deadman_s: requested times, capped by the robot's configuration; None: its default. alive: the ``<who>`` of
    a liveliness token below the robot's ``@alive/``; its loss ends the lease. t: the sender's CLOCK_MONOTONIC_RAW, ms;
    absent where the sender does not date its commands.
    """

    who: str
    priority: int = 0
    lease_s: float | None = None
    deadman_s: float | None = None
    alive: str | None = None
    t: GivenMs | UnsetType = UNSET


class Lease(FleetMessage, frozen=True):
    """The answer to every query about the lease.

    ok: whether it is granted. lease: its public id. token: secret, for the holder, never sent again; both only where
    the lease is granted. expires_in_s: until the lease ends, unless it is renewed. holder: who has it. reason: of a
    refusal, for people. code: a :class:`zbridge.errors.Code` where it is refused, for programs. max_age_s: what is
    later than that is stale; where it is given, commands and renewals must be dated.
    """

    ok: bool
    lease: LeaseId | None = None
    token: Token | None = None
    expires_in_s: float | None = None
    holder: str | None = None
    reason: str | None = None
    code: str | None = None
    max_age_s: float | UnsetType = UNSET


class Authorization(FleetMessage, frozen=True):
    """Shows that a command, or a query about the lease, is the holder's: see :mod:`zbridge.lease.proof`.

    Attachment of a command; payload of ``renew`` and ``release``.

    lease: its public id. seq: rises with each command (query) of the lease. proof: HMAC of key, number, time and
    payload. t: the sender's CLOCK_MONOTONIC_RAW when the command was given, ms; absent where the sender does not date
    it.
    """

    lease: LeaseId
    seq: Annotated[int, msgspec.Meta(ge=0)]
    proof: Proof
    t: GivenMs | UnsetType = UNSET


class Denied(FleetMessage, frozen=True):
    """The error reply to a query.

    code: a :class:`zbridge.errors.Code`, for programs. reason: for people.
    """

    code: str
    reason: str
