"""Who has the lease or had it, and which of them sent a command, and how late. Sans-IO.

Theory of operation. A network that was cut delivers what it kept, in order and at once: a command may be seconds old
when it comes. So senders date their commands: ``t`` is their own raw monotonic clock when a command was given. Clocks
of two machines are never compared. The gateway compares what it receives with the fastest delivery that it saw: the
*baseline* is the least of receive time minus ``t``, and a command is as late as its own difference exceeds that. Two
clocks drift apart, and a network may become slower for good: so the baseline may rise, by :data:`RISES_MS_PER_S`.

A baseline that was first taken from a late question is too high; the next command in time lowers it.
Source: "Sequence numbers" and "Timestamps" in ``lease.md``.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable

import msgspec
from msgspec import UNSET, UnsetType

from zbridge.errors import Code, Held, LeaseLost, Malformed
from zbridge.fleet.lease_messages import Acquire, Authorization
from zbridge.lease.proof import Verifier, read

LEASE_BYTES = 8
TOKEN_BYTES = 32
ENDED = 16
"""Ended leases that are remembered: their holders are told why, and their ids are not given again."""
MAX_AGE_S = 0.4
"""The greatest age at which a command is obeyed, unless the configuration says otherwise."""
RISES_MS_PER_S = 1.0
"""Milliseconds by which the baseline rises in a second: raw clocks drift by less than 0.2."""


class CommandAge:
    """The age of the commands and renewals of one lease.

    limit_s: what is later is stale; ``inf``: nothing is.
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._baseline_ms: float | None = None
        self._sampled_ms = 0.0

    def __repr__(self) -> str:
        return f"<CommandAge {'dated' if self._baseline_ms is not None else 'undated'}, limit {self.limit_s:g} s>"

    def late_s(self, given_ms: int | UnsetType, received_ms: float) -> float:
        """Return by how many seconds something is late that was given and received at these times.

        0 for senders that never date anything; raises Malformed for something undated after something dated.
        """
        if self.limit_s == math.inf:
            return 0.0
        if given_ms is UNSET:
            if self._baseline_ms is not None:
                raise Malformed("t is missing: earlier commands of this lease had it")
            return 0.0
        apart_ms = received_ms - given_ms
        if self._baseline_ms is None:
            self._baseline_ms = apart_ms
        else:
            risen_ms = self._baseline_ms + (received_ms - self._sampled_ms) / 1000 * RISES_MS_PER_S
            self._baseline_ms = min(apart_ms, risen_ms)
        self._sampled_ms = received_ms
        return (apart_ms - self._baseline_ms) / 1000

    def is_stale(self, late_s: float) -> bool:
        """Return whether something that is late by so much must not be obeyed."""
        return late_s > self.limit_s


class Holder(msgspec.Struct):
    """A program that has the lease, or had it. asked_ms: its raw clock when it asked. ended: why its lease ended."""

    who: str
    priority: int
    verifier: Verifier
    lease_s: float
    alive: str | None
    expires_at: float
    age: CommandAge
    asked_ms: int | UnsetType = UNSET
    numbers: dict[str, int] = msgspec.field(default_factory=dict)
    """The highest number used, of commands and of questions."""
    ended: str | None = None

    def left_s(self, now: float) -> float:
        """Return the seconds until the lease expires."""
        return max(0.0, self.expires_at - now)

    def late_s(self, shown: Authorization, received_ms: float) -> float:
        """Return by how many seconds a command or question is late; raise Malformed if it should be dated."""
        try:
            return self.age.late_s(shown.t, received_ms)
        except Malformed as error:
            raise Malformed(str(error), who=self.who) from None

    def asks_again(self, request: Acquire) -> bool:
        """Return whether the holder repeats its own question because the grant did not reach it.

        That is a later question of the same name and liveliness token, while the lease was not used. A question that
        was delayed on the way is an earlier one: it must not end the lease that was granted to a later one.
        """
        unused = not self.numbers and self.alive is not None and self.asked_ms is not UNSET
        same = (request.who, request.alive) == (self.who, self.alive)
        return unused and same and request.t is not UNSET and request.t > self.asked_ms  # type: ignore[operator]

    @property
    def described(self) -> str:
        return f"{self.who} (priority {self.priority})"


class Holders:
    """The holder of the lease and the last ones before it: finds out which one sent a command or a question.

    The proof is checked before the number, so that knowing a lease's id alone uses up and reveals no number.
    random: returns as many unguessable bytes as it is asked for.
    """

    def __init__(self, random: Callable[[int], bytes]) -> None:
        self.current: Holder | None = None
        self._random = random
        self._ended: OrderedDict[bytes, Holder] = OrderedDict()

    def __repr__(self) -> str:
        return f"<Holders {self.current.who if self.current else 'none'}, {len(self._ended)} before>"

    def new_lease(self) -> tuple[bytes, bytes]:
        """Return an id that no remembered lease has, and a token."""
        lease = self._random(LEASE_BYTES)
        while lease in self._ended:
            lease = ((int.from_bytes(lease, "big") + 1) % 256**LEASE_BYTES).to_bytes(LEASE_BYTES, "big")
        return lease, self._random(TOKEN_BYTES)

    def end(self, reason: str) -> Holder | None:
        """End the current lease and return its holder, if there is one."""
        holder, self.current = self.current, None
        if holder is not None:
            holder.ended = reason
            self._ended[holder.verifier.lease] = holder
            if len(self._ended) > ENDED:
                self._ended.popitem(last=False)
        return holder

    def of_command(self, attachment: bytes | None, key: str, payload: bytes) -> tuple[Holder, Authorization]:
        """Return the holder who sent a command, and its authorization, and use its number up.

        Raises Refused for other senders.
        """
        if attachment is None:
            raise LeaseLost("no lease: acquire first", Code.NO_LEASE)
        holder = self.current
        if holder is not None and (noted := holder.verifier.noted(attachment, key, payload)) is not None:
            return _use_up("commands", noted.seq, holder), noted
        shown = read(attachment)
        return self._sender("commands", shown, key, payload), shown

    def of_question(self, shown: Authorization, key: str) -> Holder:
        """Return the holder who asked to renew or release, use its number up; raise Refused for other senders."""
        return self._sender("questions", shown, key, b"")

    def _sender(self, kind: str, shown: Authorization, key: str, payload: bytes) -> Holder:
        holder = self._known(shown.lease)
        if not holder.verifier.proves(shown, key, payload):
            raise Malformed("wrong proof")
        return _use_up(kind, shown.seq, holder)

    def _known(self, lease: bytes) -> Holder:
        """Return the holder of a current or remembered lease; raise Refused for any other id."""
        holder = self.current
        if holder is not None and holder.verifier.lease == lease:
            return holder
        if lease in self._ended:
            return self._ended[lease]
        if holder is not None:
            raise Held(f"held by {holder.described}", holder=holder.who)
        raise LeaseLost("no lease: acquire first", Code.NO_LEASE)


def _use_up(kind: str, seq: int, holder: Holder) -> Holder:
    """Record that a number whose proof was right is used, and return the holder.

    Raises Refused if the number is not above the highest used one, or if the lease has ended.
    """
    fresh = seq > holder.numbers.get(kind, -1)
    if fresh:
        holder.numbers[kind] = seq
    if holder.ended is not None:  # a repeated command may be an eavesdropper's copy: then nobody is named
        raise LeaseLost(f"the lease has ended ({holder.ended})", who=holder.who if fresh else None)
    if not fresh:
        raise Malformed("repeated or out of order", Code.OUT_OF_ORDER)
    return holder
