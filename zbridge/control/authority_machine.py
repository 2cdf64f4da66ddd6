"""The table of the authority: what each input does in each state of the right to drive. Sans-IO.

The machine is :attr:`AuthorityMachine.TABLE`, ``{state: {input: (action, next state)}}``, at the foot of the class;
``state-tables.md`` shows the same table, and a test compares both. A pair that the table lacks changes nothing. An
action that raises Refused has changed nothing, and the state stays.

States. FREE and STOPPED: nobody has the lease (they differ in what people are shown). HELD: a program has the lease
and no motion is commanded. MOVING: the last command for at least one part of the robot was motion; the deadman runs.
NEEDS_NEUTRAL: a program has the lease and must send neutral before motion. LATCHED: a latched stop is in force; nobody
has the lease, and nobody gets it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, TypeAlias

from msgspec import UNSET

from zbridge.control.commanded_motion import CommandedMotion
from zbridge.control.events import AuthorityEvent as Event
from zbridge.control.events import AuthorityInput as Input
from zbridge.control.events import AuthorityState as State
from zbridge.control.events import Cause, EventKind, StopCause
from zbridge.control.holders import CommandAge, Holder, Holders
from zbridge.control.latch import Latches
from zbridge.control.requests import capped, name_of
from zbridge.errors import Held, Latched
from zbridge.fleet.lease_messages import Lease
from zbridge.lease.proof import Verifier
from zbridge.machine import step

Row: TypeAlias = dict[Input, tuple[Callable[["AuthorityMachine", Cause], Lease | None], State | None]]


class AuthorityMachine:
    """The state of the right to drive one robot. For the arguments see :class:`zbridge.control.authority.Authority`.

    max_age_s: infinite where nothing is stale.
    """

    def __init__(
        self, lease_s: float, deadman_s: float, random: Callable[[int], bytes], max_age_s: float, latches: Latches
    ) -> None:
        self.state = State.LATCHED if latches else State.FREE
        self.holders = Holders(random)
        self.motion = CommandedMotion(deadman_s)
        self.events: list[Event] = []
        """What happened and is not yet written down."""
        self.lease_s, self.deadman_s, self._max_age_s = lease_s, deadman_s, max_age_s
        self._latches = latches

    def __repr__(self) -> str:
        return f"<AuthorityMachine {self.state.value}, {self.holders!r}>"

    def handle(self, given: Input, cause: Cause) -> Lease | None:
        """Carry out the table; return the answer to a question about the lease. Raises Refused."""
        self.state, reply = step(self.TABLE, self.state, given, self, cause)
        return reply

    def _grant(self, cause: Cause) -> Lease:
        """End the current lease, if there is one, and give a new one; raise Malformed, and change nothing."""
        request = cause.request
        assert request is not None
        who, lease_s = name_of(request), capped("lease_s", request.lease_s, self.lease_s)
        deadman_s = capped("deadman_s", request.deadman_s, self.deadman_s)
        if self.holders.current is not None:
            self._end(Cause(reason=f"taken over by {who}", stop=StopCause.TAKEN_OVER))
        elif self.motion.moving:
            reason = f"moving without a driver when {who} acquired"
            self._require_neutral(Cause(reason=reason, stop=StopCause.UNDRIVEN))
        lease, token = self.holders.new_lease()
        verifier, self.motion.deadman_s = Verifier(lease, token), deadman_s
        age = CommandAge(min(self._max_age_s, deadman_s) if self._max_age_s < math.inf else math.inf)
        age.late_s(request.t, cause.received_ms)
        expires_at = cause.at + lease_s
        self.holders.current = Holder(
            who, request.priority, verifier, lease_s, request.alive, expires_at, age, request.t
        )
        self.motion.allow()
        self.events.append(Event(cause.kind, who, priority=request.priority))
        max_age_s = age.limit_s if request.t is not UNSET and age.limit_s < math.inf else UNSET
        return Lease(ok=True, lease=lease, token=token, expires_in_s=lease_s, holder=who, max_age_s=max_age_s)

    def _deny(self, cause: Cause) -> Lease:
        """Refuse the lease and name its holder."""
        assert self.holders.current is not None
        raise Held(f"held by {self.holders.current.described}", holder=self.holders.current.who)

    def _explain(self, cause: Cause) -> None:
        """Refuse what only a holder may ask, and say why its lease ended if it had one."""
        self._questioner(cause)

    def _questioner(self, cause: Cause) -> Holder:
        """Return the holder who asks; raise Refused for other senders."""
        assert cause.shown is not None
        return self.holders.of_question(cause.shown, cause.key)

    def _extend(self, cause: Cause) -> Lease:
        """Renew the lease if its holder asks, and asked lately; raise Refused for other senders."""
        holder = self._questioner(cause)
        assert cause.shown is not None
        if holder.age.is_stale(holder.late_s(cause.shown, cause.received_ms)):
            return Lease(ok=True, expires_in_s=holder.expires_at - cause.at, holder=holder.who)
        holder.expires_at = cause.at + holder.lease_s
        return Lease(ok=True, expires_in_s=holder.lease_s, holder=holder.who)

    def _give_back(self, cause: Cause) -> None:
        """End the lease if its holder asks; raise Refused for other senders."""
        self._questioner(cause)
        self._end(Cause(reason="released", kind=EventKind.RELEASED, stop=StopCause.RELEASED))

    def _move(self, cause: Cause) -> None:
        """Start the deadman."""
        self.motion.start(cause.at)

    def _rest(self, cause: Cause) -> None:
        """Stop the deadman; neutral also takes the robot out of its mode, and allows motion again."""
        self.motion.rest()
        self.motion.allow()

    def _rest_stale(self, cause: Cause) -> None:
        """Stop the deadman; neutral also takes the robot out of its mode."""
        self.motion.rest()

    def _require_neutral(self, cause: Cause) -> None:
        """Require neutral before motion; report it once for each reason, and always with a stop."""
        motion, holder = self.motion, self.holders.current
        if cause.stops or motion.moving or motion.needs_neutral != cause.reason:
            who = holder.who if holder is not None else None
            self.events.append(Event(EventKind.STOPPED, who, cause.reason, stops=cause.stops, cause=cause.stop))
        motion.require_neutral(cause.reason)

    def _end(self, cause: Cause) -> None:
        """End the lease, if there is one, and stop the robot if it moves, or if that was asked for."""
        stops = cause.kind in (EventKind.STOPPED, EventKind.LATCHED) or self.motion.moving
        holder = self.holders.end(cause.reason)
        self.motion.end()
        self.motion.deadman_s = self.deadman_s
        who = cause.who if cause.kind is EventKind.LATCHED else holder.who if holder else None
        self.events.append(Event(cause.kind, who, cause.reason, stops=stops, cause=cause.stop if stops else None))

    def _refuse_latched(self, cause: Cause) -> Lease:
        """Refuse the lease, and say who latched the robot."""
        raise Latched(self._latches.described)

    def _free(self, cause: Cause) -> None:
        """Do nothing: from now on the robot may be acquired."""

    _NOBODY: ClassVar[Row] = {
        Input.ACQUIRE: (_grant, State.HELD),
        Input.TAKEOVER: (_grant, State.HELD),
        Input.RENEW: (_explain, None),
        Input.RELEASE: (_explain, None),
        Input.MOTION: (_move, None),
        Input.NEUTRAL: (_rest, None),
        Input.STALE_NEUTRAL: (_rest_stale, None),
        Input.DEADMAN: (_require_neutral, None),
        Input.REQUIRE_NEUTRAL: (_require_neutral, None),
        Input.STOP: (_end, State.STOPPED),
        Input.LATCH: (_end, State.LATCHED),
    }
    _HOLDER: ClassVar[Row] = {
        Input.ACQUIRE: (_deny, None),
        Input.OUTRANK: (_grant, State.HELD),
        Input.AGAIN: (_grant, State.HELD),
        Input.TAKEOVER: (_grant, State.HELD),
        Input.RENEW: (_extend, None),
        Input.RELEASE: (_give_back, State.FREE),
        Input.NEUTRAL: (_rest, State.HELD),
        Input.STALE_NEUTRAL: (_rest_stale, State.HELD),
        Input.REQUIRE_NEUTRAL: (_require_neutral, State.NEEDS_NEUTRAL),
        Input.STOP: (_end, State.STOPPED),
        Input.LATCH: (_end, State.LATCHED),
        Input.EXPIRED: (_end, State.STOPPED),
        Input.HOLDER_LOST: (_end, State.STOPPED),
        Input.BUS_LOST: (_end, State.STOPPED),
    }
    TABLE: ClassVar[dict[State, Row]] = {
        State.FREE: _NOBODY,
        State.STOPPED: _NOBODY,
        State.HELD: _HOLDER | {Input.MOTION: (_move, State.MOVING)},
        State.MOVING: _HOLDER | {Input.MOTION: (_move, None), Input.DEADMAN: (_require_neutral, State.NEEDS_NEUTRAL)},
        State.NEEDS_NEUTRAL: _HOLDER
        | {
            Input.MOTION: (_move, None),
            Input.STALE_NEUTRAL: (_rest_stale, None),
            Input.DEADMAN: (_require_neutral, None),
        },
        State.LATCHED: _NOBODY
        | {
            Input.ACQUIRE: (_refuse_latched, None),
            Input.TAKEOVER: (_refuse_latched, None),
            Input.STOP: (_end, None),
            Input.LATCH: (_end, None),
            Input.UNLATCH: (_free, State.STOPPED),
        },
    }
    """What to do with an input, and the state after it; None: the state stays."""
