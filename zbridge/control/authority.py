"""Control authority: who may move one robot, and when the robot must be stopped. Sans-IO: time is an argument.

Theory of operation. The machine is :attr:`Authority.TABLE`, ``{state: {input: (action, next state)}}``, at the foot of
the class; ``docs/control.md`` shows the same table, and a test compares both. A pair that the table lacks changes
nothing. An action that raises Refused has changed nothing, and the state stays.

States. FREE and STOPPED: nobody has the lease (they differ in what people are shown). HELD: a program has the lease
and no motion is commanded. MOVING: the last command for at least one part of the robot was motion; the deadman runs.
NEEDS_NEUTRAL: a program has the lease and must send neutral before motion. LATCHED: a latched stop is in force; nobody
has the lease, and nobody gets it.

Who calls what. The lease server calls :meth:`acquire`, :meth:`takeover`, :meth:`renew` and :meth:`release` for queries,
and :meth:`vanished` for lost liveliness tokens. The enforcer calls :meth:`admit` for each command that needs the lease,
:meth:`require_motion` if the command is motion, :meth:`applied` after the robot was sent it, :meth:`stop`,
:meth:`require_neutral`, and :meth:`expire` at :meth:`deadline`. After each call it takes :meth:`events`, writes each
down, and sends the robot its stop at once for one that ``stops``. The admission filters read :attr:`verifier` and
:attr:`moving` from the bus's threads; all else is for the event loop's thread.

Guarantees. Questions about the lease and :meth:`admit` do first what is due by then. Commanded motion always has a
deadline. No lease ends while the robot is ``moving`` without an event that stops it. Which program sent a command is
decided by its proof first and its number second: knowing a lease's public id allows nothing. What was given too long
ago (:class:`zbridge.control.holders.CommandAge`) extends no lease and no motion, and allows no motion either.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import ClassVar, TypeAlias

from msgspec import UNSET

from zbridge.control.events import AuthorityEvent as Event
from zbridge.control.events import AuthorityInput as Input
from zbridge.control.events import AuthorityState as State
from zbridge.control.events import Cause, EventKind
from zbridge.control.events import CommandSender as Sender
from zbridge.control.holders import MAX_AGE_S, CommandAge, Holder, Holders
from zbridge.control.latch import STOPS, Latches, LatchRecord, latch_of
from zbridge.control.requests import RefusalCounts, capped, name_of
from zbridge.errors import Held, Latched, NeutralFirst, Refused
from zbridge.fleet.messages import Acquire, Authorization, Control, FleetLatches, Latch, Lease, Stop
from zbridge.lease.proof import Verifier
from zbridge.machine import step
from zbridge.protocol.kept import Exported

Row: TypeAlias = dict[Input, tuple[Callable[["Authority", Cause], Lease | None], State | None]]


class Authority:
    """The lease of one robot, and the deadman of its motion.

    lease_s, deadman_s: the most a holder may ask for, and the default, in seconds.
    random: returns as many unguessable bytes as it is asked for.
    max_age_s: commands that are later are stale, in seconds; 0: none is. latches: those that are in force already.
    """

    def __init__(
        self,
        lease_s: float,
        deadman_s: float,
        random: Callable[[int], bytes],
        max_age_s: float = MAX_AGE_S,
        latches: Latches | None = None,
    ) -> None:
        self.lease_s = lease_s
        self.deadman_s = deadman_s
        self._max_age_s = max_age_s or math.inf
        self.on_its_own = False
        """Whether the robot may have moved by itself since its last stop: without a deadman, but every stop ends it."""
        self.verifier: Verifier | None = None
        """Verifies proofs of the current lease; None while there is none. Read by other threads."""
        self.latches = latches if latches is not None else Latches()
        self._stops: deque[bytes] = deque(maxlen=STOPS)
        """The ids of the last stops that had one."""
        self._unsaved: set[bytes] = set()
        """The ids of latched stops that are not yet stored where they survive this process."""
        self._state = State.LATCHED if self.latches else State.FREE
        self._holders = Holders(random)
        self._autonomous = False
        """Whether the mode is autonomous; a stop and neutral end it."""
        self._moving: set[str] = set()
        """The parts of the robot whose last command was motion."""
        self._deadman_s = deadman_s
        """The deadman of the current holder."""
        self._stop_at = math.inf
        self._needs_neutral: str | None = None
        self._moved: set[str] = set()
        """The parts that moved when neutral was required, and whose neutral has not come yet."""
        self._refusals = RefusalCounts()
        self._events: list[Event] = []

    def __repr__(self) -> str:
        return f"<Authority {self.state}{f' by {self._holders.current.who}' if self._holders.current else ''}>"

    @property
    def state(self) -> str:
        """``free``, ``held``, ``stopped`` or ``latched``, as ``control`` shows it."""
        return _SHOWN.get(self._state, self._state.value)

    @property
    def moving(self) -> bool:
        """Whether the robot was sent motion, or ordered to move by itself, and has not been stopped since."""
        return bool(self._moving) or self.on_its_own

    @property
    def driven(self) -> bool:
        """Whether a program drives the robot or set its mode to autonomous; if not, the robot must be stopped."""
        return bool(self._moving) or self._autonomous

    # Questions about the lease. received_ms: the gateway's raw clock, for the age of what is dated.

    def acquire(self, request: Acquire, now: float, received_ms: float = 0.0) -> Lease:
        """Grant the lease of a robot that is free or stopped, held with a lower priority, or by who asks again."""
        self.expire(now)
        holder, given = self._holders.current, Input.ACQUIRE
        if holder is not None and request.priority > holder.priority:
            given = Input.OUTRANK
        elif holder is not None and holder.asks_again(request):
            given = Input.AGAIN
        return self._reply("acquire", given, Cause(now, received_ms, request, kind=EventKind.ACQUIRED))

    def takeover(self, request: Acquire, now: float, received_ms: float = 0.0) -> Lease:
        """Grant the lease whoever has it; the previous holder loses it, and a moving robot is stopped."""
        self.expire(now)
        cause = Cause(now, received_ms, request, kind=EventKind.TAKEN_OVER)
        return self._reply("takeover", Input.TAKEOVER, cause)

    def renew(self, shown: Authorization, key: str, now: float, received_ms: float = 0.0) -> Lease:
        """Postpone the end of the lease by its full length; a stale question does not. key: the key queried."""
        self.expire(now)
        return self._reply("renew", Input.RENEW, Cause(now, received_ms, shown=shown, key=key))

    def release(self, shown: Authorization, key: str, now: float) -> Lease:
        """End the lease at its holder's request; a moving robot is stopped. key: the key that was queried."""
        self.expire(now)
        return self._reply("release", Input.RELEASE, Cause(now, shown=shown, key=key))

    # Commands

    def admit(self, attachment: bytes | None, key: str, payload: bytes, now: float, received_ms: float = 0.0) -> Sender:
        """Return who of the holders sent a command, and when; use its number up and renew the lease.

        Raises Refused for other senders. A stale command renews nothing. key: the key that the command came on,
        without wildcards. received_ms: the gateway's raw clock.
        """
        holders = self._holders
        if now >= self._stop_at or (holders.current is not None and now >= holders.current.expires_at):
            self.expire(now)
        holder, shown = holders.of_command(attachment, key, payload)
        late_s = holder.late_s(shown, received_ms)
        stale = holder.age.is_stale(late_s)
        if not stale:
            holder.expires_at = now + holder.lease_s
        return Sender(holder.who, now - late_s, late_s, stale)

    def require_motion(self) -> None:
        """Raise Refused if the holder must send neutral before the robot moves."""
        if self._needs_neutral is not None:
            raise NeutralFirst(f"{self._needs_neutral}: send a neutral drive first")

    def applied(self, part: str, given_at: float, *, moving: bool, stale: bool = False, whole: bool = False) -> None:
        """Record that the holder's command for one part of the robot was carried out.

        given_at: when it was given, on the time line of ``now``; the deadman counts from then. A stale neutral ends
        motion and does not allow it again. whole: a neutral counts for all parts; else a required
        neutral must come for each part that moved.
        """
        parts = self._moving
        if moving and part in parts:  # repeated motion is no input: it only postpones the deadman
            self._stop_at = given_at + self._deadman_s
            return
        if not moving and not parts and self._needs_neutral is None:  # nor is repeated neutral
            self._autonomous = False
            return
        if not moving and not stale and self._moved:
            self._moved = set() if whole else self._moved - {part}
            if self._moved:  # a part that moved had no neutral yet: its stick may still be deflected
                return
        (parts.add if moving else parts.discard)(part)
        if stale and parts:  # motion of another part continues, and with it its deadman
            return
        self._handle(_MOTION if parts else _STALE_NEUTRAL if stale else _NEUTRAL, Cause(given_at))

    def mode_chosen(self, *, autonomous: bool) -> None:
        """Record that the robot was sent the holder's choice of its mode."""
        self._autonomous = autonomous
        self.on_its_own = self.on_its_own or autonomous

    def sent_opaque(self) -> None:
        """Record that the robot was sent a raw message of the holder's: the robot may move because of it."""
        self.on_its_own = True

    def refuse(
        self, command: str, refusal: Refused, who: str | None = None, *, by: str | None = None, count: int = 1
    ) -> None:
        """Count a refusal; ``control`` shows it. by: the listener that refused and reported it."""
        shown = self._refusals.add(command, refusal, who, by, count)
        self._events.append(Event(EventKind.REFUSED, shown.who, shown.reason, command=shown.command, code=refusal.code))

    # Stops

    def stop(self, reason: str) -> None:
        """Stop the robot and end the lease, whoever asks: nobody drives before acquiring anew."""
        self._handle(Input.STOP, Cause(reason=reason, kind=EventKind.STOPPED))

    def take_stop(self, stop: Stop, *, fleet: bool) -> None:
        """Stop the robot as somebody on the bus demands. fleet: all robots of the realm were sent this stop."""
        if isinstance(stop.id, bytes):
            self._stops.append(stop.id)
        if stop.latch is True:
            latch = latch_of(stop, fleet=fleet)
            self.latches.add(latch)
            if latch.id in self.latches:
                self._unsaved.add(latch.id)
                self._latch(latch)
                return
        self.stop("stop")

    def adopt(self, answers: Iterable[FleetLatches]) -> None:
        """Take over the fleet's latched stops that other gateways know."""
        self._latch(*self.latches.adopt(answers))

    def merge(self, record: LatchRecord) -> None:
        """Take over what another gateway of this robot knows."""
        before = self.latches.in_force
        self._latch(*self.latches.merge(record))
        if any(latch.id not in self.latches for latch in before):
            self._events.append(Event(EventKind.UNLATCHED, _ANOTHER_GATEWAY))
        if before and not self.latches:
            self._handle(Input.UNLATCH, Cause())

    def unlatch(self, stop_id: bytes, who: str, *, fleet: bool) -> None:
        """Release a latched stop; raise Refused. who: the name that asks. The robot may be acquired with the last."""
        if self.latches.release(stop_id, fleet=fleet):
            self._events.append(Event(EventKind.UNLATCHED, who))
        if not self.latches:
            self._handle(Input.UNLATCH, Cause())

    def restore_latches(self, state: Exported) -> None:
        """Take over the latched stops of another process, before this one serves the robot; raise ProtocolError."""
        self.latches.restore(state)
        if self.latches:
            self._state = State.LATCHED

    def latches_saved(self) -> None:
        """Record that all latched stops survive this process, or cannot: ``control`` confirms them from now on."""
        self._unsaved.clear()

    @property
    def stop_ids(self) -> frozenset[bytes]:
        """The ids of the last stops: what repeats one of them changes nothing. Read by other threads."""
        return frozenset(self._stops)

    def require_neutral(self, reason: str, *, stops: bool = True) -> None:
        """Stop the robot, or (``stops=False``) record that it is stopped; motion needs a neutral first."""
        self._handle(Input.REQUIRE_NEUTRAL, Cause(reason=reason, stops=stops))

    def vanished(self, alive: str) -> None:
        """Record that a liveliness token is gone; if the holder named it, the lease ends."""
        if self._holders.current is not None and self._holders.current.alive == alive:
            self._handle(Input.HOLDER_LOST, Cause(reason="holder lost"))

    def bus_lost(self) -> None:
        """Record that no program can reach the gateway any more; the lease ends."""
        self._handle(Input.BUS_LOST, Cause(reason="bus lost"))

    # Time

    def deadline(self) -> float | None:
        """Return when :meth:`expire` is next due; None: never."""
        expires_at = self._holders.current.expires_at if self._holders.current else math.inf
        earliest = min(self._stop_at, expires_at)
        return None if earliest == math.inf else earliest

    def expire(self, now: float) -> None:
        """Do what is due: end a lease that was not renewed, stop motion that was not repeated."""
        if self._holders.current is not None and now >= self._holders.current.expires_at:
            self._handle(Input.EXPIRED, Cause(reason="lease expired"))
        elif now >= self._stop_at:
            self._handle(Input.DEADMAN, Cause(reason="deadman"))

    # What happened

    @property
    def eventful(self) -> bool:
        """Whether :meth:`events` returns any."""
        return bool(self._events)

    def events(self) -> list[Event]:
        """Return what happened since the last call, in order."""
        events, self._events = self._events, []
        return events

    def report(self, now: float) -> Control:
        """Return what ``control`` shows: who drives, and what was refused."""
        holder = self._holders.current
        return Control(
            state=self.state,  # type: ignore[arg-type]
            holder=holder.who if holder else None,
            lease=holder.verifier.lease if holder else None,
            priority=holder.priority if holder else None,
            expires_in_s=self._expires_in_s(now),
            refusals=self._refusals.shown(),
            latches=self.latches.in_force,
            stops=tuple(stop_id for stop_id in self._stops if stop_id not in self._unsaved),
        )

    def _handle(self, given: Input, cause: Cause) -> Lease | None:
        self._state, reply = step(self.TABLE, self._state, given, self, cause)
        return reply

    def _reply(self, command: str, given: Input, cause: Cause) -> Lease:
        """Answer a question about the lease; count it if it is refused."""
        try:
            return self._handle(given, cause) or Lease(ok=True)
        except Refused as refusal:
            self.refuse(command, refusal, cause.request.who if cause.request is not None else refusal.who)
            holder = self._holders.current.who if self._holders.current else None
            expires_in_s = self._expires_in_s(cause.at)
            return Lease(ok=False, expires_in_s=expires_in_s, holder=holder, reason=str(refusal), code=refusal.code)

    def _latch(self, *latches: Latch) -> None:
        for latch in latches:
            cause = Cause(reason=latch.reason or "stop", kind=EventKind.LATCHED, who=latch.who)
            self._handle(Input.LATCH, cause)

    def _expires_in_s(self, now: float) -> float | None:
        return max(0.0, self._holders.current.expires_at - now) if self._holders.current else None

    # Actions

    def _grant(self, cause: Cause) -> Lease:
        """End the current lease, if there is one, and give a new one; raise Malformed, and change nothing."""
        request = cause.request
        assert request is not None
        who, lease_s = name_of(request), capped("lease_s", request.lease_s, self.lease_s)
        deadman_s = capped("deadman_s", request.deadman_s, self.deadman_s)
        if self._holders.current is not None:
            self._end(Cause(reason=f"taken over by {who}"))
        elif self.moving:
            self._require_neutral(Cause(reason=f"moving for nobody when {who} acquired"))
        lease, token = self._holders.new_lease()
        self.verifier, self._deadman_s = Verifier(lease, token), deadman_s
        age = CommandAge(min(self._max_age_s, deadman_s) if self._max_age_s < math.inf else math.inf)
        age.late_s(request.t, cause.received_ms)
        expires_at = cause.at + lease_s
        self._holders.current = Holder(
            who, request.priority, self.verifier, lease_s, request.alive, expires_at, age, request.t
        )
        self._needs_neutral = None
        self._moved.clear()
        self._events.append(Event(cause.kind, who, priority=request.priority))
        max_age_s = age.limit_s if request.t is not UNSET and age.limit_s < math.inf else UNSET
        return Lease(ok=True, lease=lease, token=token, expires_in_s=lease_s, holder=who, max_age_s=max_age_s)

    def _deny(self, cause: Cause) -> Lease:
        """Refuse the lease and name its holder."""
        assert self._holders.current is not None
        raise Held(f"held by {self._holders.current.described}", holder=self._holders.current.who)

    def _explain(self, cause: Cause) -> None:
        """Refuse what only a holder may ask, and say why its lease ended if it had one."""
        self._questioner(cause)

    def _questioner(self, cause: Cause) -> Holder:
        """Return the holder who asks; raise Refused for other senders."""
        assert cause.shown is not None
        return self._holders.of_question(cause.shown, cause.key)

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
        self._end(Cause(reason="released", kind=EventKind.RELEASED))

    def _move(self, cause: Cause) -> None:
        """Start the deadman."""
        self._stop_at = cause.at + self._deadman_s

    def _rest(self, cause: Cause) -> None:
        """Stop the deadman; neutral also takes the robot out of its mode, and allows motion again."""
        self._rest_stale(cause)
        self._needs_neutral = None

    def _rest_stale(self, cause: Cause) -> None:
        """Stop the deadman; neutral also takes the robot out of its mode."""
        self._autonomous = False
        self._stop_at = math.inf

    def _require_neutral(self, cause: Cause) -> None:
        """Require neutral before motion; report it once for each reason, and always with a stop."""
        if cause.stops or self.moving or self._needs_neutral != cause.reason:
            who = self._holders.current.who if self._holders.current else None
            self._events.append(Event(EventKind.STOPPED, who, cause.reason, stops=cause.stops))
        self._moved |= self._moving
        self._still()
        self._needs_neutral = cause.reason

    def _end(self, cause: Cause) -> None:
        """End the lease, if there is one, and stop the robot if it moves, or if that was asked for."""
        stops = cause.kind in (EventKind.STOPPED, EventKind.LATCHED) or self.moving
        holder, self.verifier = self._holders.end(cause.reason), None
        self._still()
        self._needs_neutral = None
        self._moved.clear()
        self._deadman_s = self.deadman_s
        who = cause.who if cause.kind is EventKind.LATCHED else holder.who if holder else None
        self._events.append(Event(cause.kind, who, cause.reason, stops=stops))

    def _refuse_latched(self, cause: Cause) -> Lease:
        """Refuse the lease, and say who latched the robot."""
        raise Latched(self.latches.described)

    def _free(self, cause: Cause) -> None:
        """Do nothing: from now on the robot may be acquired."""

    def _still(self) -> None:
        self._moving.clear()
        self.on_its_own = self._autonomous = False
        self._stop_at = math.inf

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


_MOTION, _NEUTRAL, _STALE_NEUTRAL = (
    Input.MOTION,
    Input.NEUTRAL,
    Input.STALE_NEUTRAL,
)  # looking up a member of an enum costs more than a command may
_ANOTHER_GATEWAY = "another gateway of the robot"
_SHOWN = {State.MOVING: "held", State.NEEDS_NEUTRAL: "held"}
