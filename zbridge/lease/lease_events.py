"""The lease client's states and inputs, replies to its questions, and what a program is notified of. Sans-IO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import TypeAlias

import msgspec

from zbridge.bus import Answer
from zbridge.errors import BusError, NotReady, PayloadError, RateLimited, Refused, ZbridgeError, refusal
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import Lease
from zbridge.fleet.messages import Control, Refusal

Reply: TypeAlias = Lease | ZbridgeError | None
"""What a question came to: a lease, granted or not; the error instead of one; None: no gateway answered."""

NO_ANSWER = "no gateway answers"
NAMED = 64
"""Characters of a name that are stored."""
EXPLAINED = 200
"""Characters of a refusal's reason that are stored."""
_PASSING: tuple[str, ...] = (*NotReady.codes, *RateLimited.codes)
"""Codes that do not decide whose the lease is."""


class LeaseState(StrEnum):
    """What a program has, and what it waits for."""

    FREE = "free"
    ASKING = "asking"
    DROPPED = "dropped"
    RECALLED = "recalled"
    PAUSED = "paused"
    HELD = "held"
    CHECKING = "checking"
    DOUBTED = "doubted"
    RETURNING = "returning"
    WANTED = "wanted"


class LeaseInput(StrEnum):
    """What the program wants, what was replied, and other news."""

    WANT = "want"
    DROP = "drop"
    GRANTED = "granted"
    DENIED = "denied"
    LATER = "ask later"
    CONFIRMED = "confirmed"
    UNANSWERED = "unanswered"
    ENDED = "ended"
    RETURNED = "returned"
    DOUBT = "doubt"
    DUE = "due"
    GATEWAY_LOST = "gateway lost"


class LeaseEventKind(StrEnum):
    """What happened to the lease."""

    GRANTED = "granted"
    DENIED = "denied"
    LOST = "lost"


class LeaseEvent(msgspec.Struct, frozen=True):
    """Something that the program must know. error: why the lease was denied or lost; holder: who has it, if known.

    unanswered: whether no gateway said so. expires_in_s: how long the holder's lease lasts at least. expired: whether a
    lost lease was not renewed in time.
    """

    kind: LeaseEventKind
    error: ZbridgeError | None = None
    holder: str | None = None
    expires_in_s: float | None = None
    unanswered: bool = False
    expired: bool = False

    @classmethod
    def of(cls, kind: LeaseEventKind, reply: Reply, *, expired: bool = False) -> LeaseEvent:
        """Make the event of a reply that is no lease."""
        if reply is None:
            return cls(kind, BusError(NO_ANSWER), unanswered=True, expired=expired)
        if isinstance(reply, Lease):
            error = refusal(reply.code or "", reply.reason or "no reason given", holder=reply.holder)
            return cls(kind, error, reply.holder, reply.expires_in_s, expired=expired)
        return cls(kind, reply, expired=expired)


def read(replied: Sequence[Answer] | BusError) -> Reply:
    """Return the lease that was replied, else why it was not, else None."""
    if isinstance(replied, BusError):
        return replied
    reply: Reply = None
    for answer in replied:
        if answer.error is None:
            try:
                return payloads.decode(Lease, answer.payload)
            except PayloadError as error:
                return error
        if isinstance(answer.error, Refused):
            reply = answer.error
    return reply


def code_of(reply: Reply) -> str | None:
    """Return the code of a refusal."""
    return reply.code if isinstance(reply, Lease | Refused) else None


def passes(reply: Reply) -> bool:
    """Return whether this decides nothing about the lease: no reply, or a gateway that cannot say now."""
    return reply is None or code_of(reply) in _PASSING


class RefusalNews:
    """Returns each refusal that concerns a program once for each time its count changes.

    concerns: whether a refusal is the program's own. What listeners report of their programs never is.
    """

    def __init__(self, concerns: Callable[[Refusal], bool]) -> None:
        self._concerns = concerns
        self._counts: dict[tuple[str | None, str, str, str], int] = {}

    def __repr__(self) -> str:
        return f"<RefusalNews, {len(self._counts)} known>"

    def take(self, control: Control) -> list[Refusal]:
        """Return what is new since the last call."""
        news, counts = [], {}
        for each in control.refusals:
            if each.by is None and self._concerns(each):
                key = (each.who, each.command, each.code, each.reason)
                counts[key] = each.count
                if each.count != self._counts.get(key, 0):
                    news.append(each)
        self._counts = counts
        return news
