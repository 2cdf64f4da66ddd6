"""Control authority: who may move the robot, and when it must be stopped. Sans-IO, time is an argument.

One lease per robot. What calls decide comes back at once (a lease, or Refused); what follows from them, and
from time going by, is in :meth:`Authority.events`: what to write down, and where an event ``stops``, the
robot is to be sent its stop. The transition table is in ``docs/control.md``.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from enum import Enum

import msgspec

from zbridge.control.proof import LEASE_BYTES, TOKEN_BYTES, Verifier, read
from zbridge.errors import Code, Held, LeaseLost, Malformed, NeutralFirst, Refused
from zbridge.fleet.messages import Acquire, Authorization, Control, Lease, Refusal

REFUSALS = 16
"""Different refusals that ``control`` shows; the oldest makes room."""
ENDED = 16
"""Ended leases whose holders can still be told why, and whose ids are not given again."""
LEAST_S = 0.01
"""The shortest lease or deadman that can be asked for, seconds."""
NAMED, _EXPLAINED = 64, 200
"""Characters of a name and of a reason that are kept."""


class EventKind(Enum):
    """What happened to the right to drive."""

    ACQUIRED = "acquired"
    TAKEN_OVER = "taken over"
    RELEASED = "released"
    REFUSED = "refused"
    STOPPED = "stopped"
    ENDED = "ended"


class Event(msgspec.Struct, frozen=True):
    """Something to write down; where it ``stops``, the robot is to be sent its stop."""

    what: EventKind
    who: str | None = None
    reason: str | None = None
    priority: int | None = None
    command: str | None = None
    code: Code | None = None
    stops: bool = False

    def __str__(self) -> str:
        who = f" {self.who}" if self.who else ""
        command = f" {self.command}" if self.command else ""
        return f"{self.what.value}{who}{command}{f' ({self.reason})' if self.reason else ''}"


class _Holder(msgspec.Struct):
    who: str
    priority: int
    verifier: Verifier
    lease_s: float
    deadman_s: float
    alive: str | None
    expires_at: float
    numbers: dict[str, int] = msgspec.field(default_factory=dict)
    """The last number that was used, of its commands and of its questions."""
    ended: str | None = None
    """Why the lease has ended."""

    @property
    def described(self) -> str:
        return f"{self.who} (priority {self.priority})"


class Authority:
    """The lease of one robot, and the watch over its motion.

    lease_s, deadman_s: the most a holder may ask for, and what it gets without asking, in seconds.
    random: gives so many bytes that nobody can guess.
    """

    def __init__(self, lease_s: float, deadman_s: float, random: Callable[[int], bytes]) -> None:
        self.lease_s = lease_s
        self.deadman_s = deadman_s
        self.on_its_own = False
        """Whether the robot may have moved by itself since its last stop: no deadman, but every other stop."""
        self._autonomous = False
        """Whether its mode is autonomous, since its last stop or neutral."""
        self.verifier: Verifier | None = None
        """Of the lease that is held; other threads use it to sort what comes in."""
        self._random = random
        self._holder: _Holder | None = None
        self._stopped = False
        self._held_back: str | None = None
        self._moving: set[str] = set()
        self._stop_at = math.inf
        self._ended: OrderedDict[bytes, _Holder] = OrderedDict()
        self._refusals: OrderedDict[tuple[str | None, str, Code, str, str | None], int] = OrderedDict()
        self._events: list[Event] = []

    def __repr__(self) -> str:
        return f"<Authority {self.state}{f' by {self._holder.who}' if self._holder else ''}>"

    @property
    def state(self) -> str:
        """``free``, ``held`` or ``stopped``."""
        return "held" if self._holder else "stopped" if self._stopped else "free"

    @property
    def moving(self) -> bool:
        """Whether the robot was told to move, or to move on its own, and not yet to stop."""
        return bool(self._moving) or self.on_its_own

    @property
    def driven(self) -> bool:
        """Whether somebody drives the robot, or lets it drive: else it is to be at rest."""
        return bool(self._moving) or self._autonomous

    # The lease

    def acquire(self, request: Acquire, now: float) -> Lease:
        """Give the lease of a robot that is free or stopped, or held with a lower priority."""
        self.expire(now)
        holder = self._holder
        if holder is not None and request.priority <= holder.priority:
            held = Held(f"held by {holder.described}", holder=holder.who)
            self.refuse("acquire", held, request.who)
            return self._denied(held, now)
        return self._grant(request, EventKind.ACQUIRED, now)

    def takeover(self, request: Acquire, now: float) -> Lease:
        """Give the lease to whoever asks; the one that had it has lost it, and the robot is stopped."""
        self.expire(now)
        return self._grant(request, EventKind.TAKEN_OVER, now)

    def renew(self, shown: Authorization, key: str, now: float) -> Lease:
        """Put the end of a lease off. key: the one that was asked."""
        self.expire(now)
        try:
            holder = self._sender("questions", shown, key)
        except Refused as refusal:
            self.refuse("renew", refusal, refusal.who)
            return self._denied(refusal, now)
        holder.expires_at = now + holder.lease_s
        return Lease(ok=True, expires_in_s=holder.lease_s, holder=holder.who)

    def release(self, shown: Authorization, key: str, now: float) -> Lease:
        """Give a lease back; a robot that moves is stopped. key: the one that was asked."""
        self.expire(now)
        try:
            self._sender("questions", shown, key)
        except Refused as refusal:
            self.refuse("release", refusal, refusal.who)
            return self._denied(refusal, now)
        self._end("released", EventKind.RELEASED, stops=self.moving)
        self._stopped = False
        return Lease(ok=True)

    # Commands

    def admit(self, attachment: bytes | None, key: str, payload: bytes, now: float) -> str:
        """Give the holder whose command this is, and use its number up; raise Refused where it is nobody's.

        key: the one the command came on, without wildcards.
        """
        self.expire(now)
        if attachment is None:
            raise LeaseLost("no lease: acquire first", Code.NO_LEASE)
        noted = self.verifier.noted(attachment, key, payload) if self.verifier is not None else None
        holder = self._sender("commands", noted or read(attachment), key, payload, proven=noted is not None)
        holder.expires_at = now + holder.lease_s
        return holder.who

    def require_motion(self) -> None:
        """Raise Refused where the holder must send neutral before the robot moves."""
        if self._held_back is not None:
            raise NeutralFirst(f"{self._held_back}: send a neutral drive first")

    def applied(self, part: str, now: float, *, moving: bool) -> None:
        """Take note that the holder's command for one part of the robot was carried out."""
        if moving:
            self._moving.add(part)
        else:
            self._moving.discard(part)
            if not self._moving:  # neutral takes the robot out of its mode too
                self._autonomous = False
            self._held_back = None
        deadman_s = self._holder.deadman_s if self._holder else self.deadman_s
        self._stop_at = now + deadman_s if self._moving else math.inf

    def mode_chosen(self, *, autonomous: bool) -> None:
        """Take note that the holder's choice of who moves the robot was carried out."""
        self._autonomous = autonomous
        self.on_its_own = self.on_its_own or autonomous

    def sent_opaque(self) -> None:
        """Take note that the holder had the robot sent what nobody here can read: it may move by it."""
        self.on_its_own = True

    def refuse(
        self, command: str, refusal: Refused, who: str | None = None, *, by: str | None = None, count: int = 1
    ) -> None:
        """Count a refusal; it shows on ``control``. by: the listener that refused it, and tells of it."""
        who, command, reason = who and who[:NAMED], command[:NAMED], str(refusal)[:_EXPLAINED]
        key = (who, command, refusal.code, reason, by)
        self._refusals[key] = self._refusals.pop(key, 0) + count
        if len(self._refusals) > REFUSALS:
            self._refusals.popitem(last=False)
        self._events.append(Event(EventKind.REFUSED, who, reason, command=command, code=refusal.code))

    # Stops

    def stop(self, reason: str) -> None:
        """Stop the robot and end the lease, whoever asks: nobody drives before acquiring anew."""
        self._end(reason, EventKind.STOPPED, stops=True)
        self._stopped = True

    def hold_back(self, reason: str, *, stops: bool = True) -> None:
        """Stop the robot, or know that it stands; the lease stays, motion needs a neutral drive."""
        if stops or self.moving or self._held_back != reason:
            self._events.append(
                Event(EventKind.STOPPED, self._holder.who if self._holder else None, reason, stops=stops)
            )
        self._still()
        self._held_back = reason

    def vanished(self, alive: str) -> None:
        """Take note that a liveliness token is gone: if the holder named it, the lease ends."""
        if self._holder is not None and self._holder.alive == alive:
            self._lose("holder lost")

    def bus_lost(self) -> None:
        """Take note that nobody can be heard any more: the lease ends."""
        if self._holder is not None:
            self._lose("bus lost")

    # Time

    def deadline(self) -> float | None:
        """Tell when :meth:`expire` has something to do."""
        expires_at = self._holder.expires_at if self._holder else math.inf
        earliest = min(self._stop_at, expires_at)
        return None if earliest == math.inf else earliest

    def expire(self, now: float) -> None:
        """Do what is due: end a lease that was not renewed, stop motion that was not."""
        if self._holder is not None and now >= self._holder.expires_at:
            self._lose("lease expired")
        elif now >= self._stop_at:
            self.hold_back("deadman")

    @property
    def eventful(self) -> bool:
        """Whether :meth:`events` has any."""
        return bool(self._events)

    def events(self) -> list[Event]:
        """Give what happened since the last call, in order."""
        events, self._events = self._events, []
        return events

    def report(self, now: float) -> Control:
        """Say who drives and what was refused."""
        holder = self._holder
        return Control(
            state=self.state,  # type: ignore[arg-type]
            holder=holder.who if holder else None,
            lease=holder.verifier.lease if holder else None,
            priority=holder.priority if holder else None,
            expires_in_s=max(0.0, holder.expires_at - now) if holder else None,
            refusals=tuple(
                Refusal(who=who, command=command, code=code, reason=reason, count=count, by=by)
                for (who, command, code, reason, by), count in self._refusals.items()
            ),
        )

    def _sender(
        self, what: str, shown: Authorization, key: str, payload: bytes = b"", *, proven: bool = False
    ) -> _Holder:
        """Give the holder who sent this, and use its number up; raise Refused where it is nobody's.

        The proof comes before the number: who knows the lease's id alone uses up none, and learns of none.
        """
        holder = self._known(shown.lease)
        if not proven and not holder.verifier.proves(shown, key, payload):
            raise Malformed("wrong proof")
        fresh = shown.seq > holder.numbers.get(what, -1)
        if fresh:
            holder.numbers[what] = shown.seq
        if holder.ended is not None:  # repeated, anybody who overheard it may have sent it
            raise LeaseLost(f"the lease has ended ({holder.ended})", who=holder.who if fresh else None)
        if not fresh:
            raise Malformed("repeated or out of order", Code.OUT_OF_ORDER)
        return holder

    def _known(self, lease: bytes) -> _Holder:
        """Give the holder of a lease, of one that has ended too; raise Refused where there was none of this id."""
        holder = self._holder
        if holder is not None and holder.verifier.lease == lease:
            return holder
        if lease in self._ended:
            return self._ended[lease]
        if holder is not None:
            raise Held(f"held by {holder.described}", holder=holder.who)
        raise LeaseLost("no lease: acquire first", Code.NO_LEASE)

    def _grant(self, request: Acquire, what: EventKind, now: float) -> Lease:
        try:
            if not request.who or not request.who.isprintable():
                raise Malformed(f"who = {request.who[:NAMED]!r}: expected a name that others are shown")
            lease_s = _wish("lease_s", request.lease_s, self.lease_s)
            deadman_s = _wish("deadman_s", request.deadman_s, self.deadman_s)
        except Refused as refusal:
            self.refuse("takeover" if what is EventKind.TAKEN_OVER else "acquire", refusal, request.who)
            return self._denied(refusal, now)
        who = request.who[:NAMED]
        if self._holder is not None:
            self._end(f"taken over by {who}", EventKind.ENDED, stops=self.moving)
        lease, token = self._new_lease(), self._random(TOKEN_BYTES)
        self.verifier = Verifier(lease, token)
        self._holder = _Holder(who, request.priority, self.verifier, lease_s, deadman_s, request.alive, now + lease_s)
        self._stopped, self._held_back = False, None
        self._events.append(Event(what, who, priority=request.priority))
        return Lease(ok=True, lease=lease, token=token, expires_in_s=lease_s, holder=who)

    def _new_lease(self) -> bytes:
        """Give an id that none of the last leases had."""
        lease = self._random(LEASE_BYTES)
        while lease in self._ended:
            lease = ((int.from_bytes(lease, "big") + 1) % 256**LEASE_BYTES).to_bytes(LEASE_BYTES, "big")
        return lease

    def _denied(self, refusal: Refused, now: float) -> Lease:
        holder = self._holder
        expires_in_s = max(0.0, holder.expires_at - now) if holder else None
        return Lease(
            ok=False,
            expires_in_s=expires_in_s,
            holder=holder.who if holder else None,
            reason=str(refusal),
            code=refusal.code,
        )

    def _lose(self, reason: str) -> None:
        self._end(reason, EventKind.ENDED, stops=self.moving)
        self._stopped = True

    def _end(self, reason: str, what: EventKind, *, stops: bool) -> None:
        holder, self._holder, self.verifier = self._holder, None, None
        self._still()
        self._held_back = None
        if holder is not None:
            holder.ended = reason
            self._ended[holder.verifier.lease] = holder
            if len(self._ended) > ENDED:
                self._ended.popitem(last=False)
        self._events.append(Event(what, holder.who if holder else None, reason, stops=stops))

    def _still(self) -> None:
        self._moving.clear()
        self.on_its_own = self._autonomous = False
        self._stop_at = math.inf


def _wish(name: str, wish_s: float | None, most_s: float) -> float:
    """Cap what was asked for; raise Refused where it is no time."""
    if wish_s is None:
        return most_s
    if not wish_s >= LEAST_S:
        raise Malformed(f"{name} = {wish_s:g}: expected at least {LEAST_S:g}")
    return min(wish_s, most_s)
