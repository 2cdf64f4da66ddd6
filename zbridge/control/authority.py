"""Control authority: who may move one robot, and when the robot must be stopped. Sans-IO: time is an argument.

Theory of operation. :class:`~zbridge.control.authority_machine.AuthorityMachine` has the states and the table; the
authority makes inputs of what it is asked and told.

Who calls what. The lease server calls :meth:`acquire`, :meth:`takeover`, :meth:`renew` and :meth:`release` for queries,
and :meth:`vanished` for lost liveliness tokens. The enforcer calls :meth:`admit` for each command that needs the lease,
:meth:`CommandedMotion.check_motion` if the command is motion, :meth:`applied` after the robot was sent it,
:meth:`stop`, :meth:`require_neutral`, and :meth:`expire` at :meth:`deadline`. After each call it takes :meth:`events`,
writes each down, and sends the robot its stop at once for one that ``stops``. The admission filters read
:attr:`holders` and :attr:`motion` from the bus's threads; all else is for the event loop's thread.

Guarantees. Questions about the lease and :meth:`admit` do first what is due by then. Commanded motion always has a
deadline. No lease ends while the robot moves without an event that stops it. Which program sent a command is decided by
its proof first and its number second: knowing a lease's public id allows nothing. What was given too long ago
(:class:`zbridge.control.holders.CommandAge`) extends no lease and no motion, and allows no motion either.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from msgspec import structs

from zbridge.control.authority_machine import AuthorityMachine
from zbridge.control.events import AuthorityEvent as Event
from zbridge.control.events import AuthorityInput as Input
from zbridge.control.events import AuthorityState as State
from zbridge.control.events import Cause, EventKind, StopCause
from zbridge.control.events import CommandSender as Sender
from zbridge.control.holders import MAX_AGE_S
from zbridge.control.latch import Latches, LatchRecord
from zbridge.control.requests import RefusalCounts
from zbridge.errors import Refused
from zbridge.fleet.lease_messages import Acquire, Authorization, Lease
from zbridge.fleet.messages import Control, Latch, Stop
from zbridge.lease.proof import Verifier
from zbridge.protocol.kept import Exported


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
        *,
        alone_is_normal: bool = False,
    ) -> None:
        self._alone_is_normal = alone_is_normal
        self.latches = latches if latches is not None else Latches()
        self.machine = machine = AuthorityMachine(lease_s, deadman_s, random, max_age_s or math.inf, self.latches)
        self.motion = machine.motion
        """What the robot was commanded to do."""
        self.holders = machine.holders
        self._refusals = RefusalCounts()

    def __repr__(self) -> str:
        return f"<Authority {self.state}{f' by {self.holders.current.who}' if self.holders.current else ''}>"

    @property
    def state(self) -> str:
        """``free``, ``held``, ``stopped`` or ``latched``, as ``control`` shows it."""
        return _SHOWN.get(self.machine.state, self.machine.state.value)

    @property
    def verifier(self) -> Verifier | None:
        """Verifies proofs of the current lease; None while there is none. Read by other threads."""
        holder = self.holders.current
        return holder.verifier if holder is not None else None

    # Questions about the lease. received_ms: the gateway's raw clock, for the age of what is dated.

    def acquire(self, request: Acquire, now: float, received_ms: float = 0.0) -> Lease:
        """Grant the lease of a robot that is free or stopped, held with a lower priority, or by who asks again."""
        self.expire(now)
        holder, given = self.holders.current, Input.ACQUIRE
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
        holders = self.holders
        if now >= self.motion.stop_at or (holders.current is not None and now >= holders.current.expires_at):
            self.expire(now)
        holder, shown = holders.of_command(attachment, key, payload)
        late_s = holder.late_s(shown, received_ms)
        stale = holder.age.is_stale(late_s)
        if not stale:
            holder.expires_at = now + holder.lease_s
        return Sender(holder.who, now - late_s, late_s, stale)

    def applied(self, part: str, given_at: float, *, moving: bool, stale: bool = False, whole: bool = False) -> None:
        """Record that the holder's command for one part of the robot was carried out.

        given_at: when it was given, on the time line of ``now``; the deadman counts from then. A stale neutral ends
        motion and does not allow it again. whole: a neutral counts for all parts; otherwise each part that moved needs
        a neutral.
        """
        given = self.motion.applied(part, given_at, moving=moving, stale=stale, whole=whole)
        if given is not None:
            self.machine.handle(given, Cause(given_at))

    def refuse(
        self, command: str, refusal: Refused, who: str | None = None, *, by: str | None = None, count: int = 1
    ) -> None:
        """Count a refusal; ``control`` shows it. by: the listener that refused and reported it."""
        shown = self._refusals.add(command, refusal, who, by, count)
        event = Event(EventKind.REFUSED, shown.who, shown.reason, command=shown.command, code=refusal.code)
        self.machine.events.append(event)

    # Stops

    def stop(self, reason: str, cause: StopCause = StopCause.COMMAND) -> None:
        """Stop the robot and end the lease, whoever asks: nobody drives before acquiring anew."""
        self.machine.handle(Input.STOP, Cause(reason=reason, kind=EventKind.STOPPED, stop=cause))

    def take_stop(self, stop: Stop, *, fleet: bool) -> None:
        """Stop the robot as somebody on the bus demands. fleet: all robots of the realm were sent this stop."""
        latch = self.latches.take(stop, fleet=fleet)
        if latch is None:
            self.stop("stop")
        else:
            self.latch(latch)

    def latch(self, *latches: Latch) -> None:
        """Stop the robot and end the lease for latched stops that have just come into force."""
        for latch in latches:
            reason = latch.reason or "stop"
            cause = Cause(reason=reason, kind=EventKind.LATCHED, who=latch.who, stop=StopCause.LATCH)
            self.machine.handle(Input.LATCH, cause)

    def merge(self, record: LatchRecord) -> None:
        """Take over what another gateway of this robot knows."""
        before = self.latches.in_force
        self.latch(*self.latches.merge(record))
        if any(latch.id not in self.latches for latch in before):
            self.machine.events.append(Event(EventKind.UNLATCHED, _ANOTHER_GATEWAY))
        if before and not self.latches:
            self.machine.handle(Input.UNLATCH, Cause())

    def unlatch(self, stop_id: bytes, who: str, *, fleet: bool) -> None:
        """Release a latched stop; raise Refused. who: the name that asks. The robot may be acquired with the last."""
        if self.latches.release(stop_id, fleet=fleet):
            self.machine.events.append(Event(EventKind.UNLATCHED, who))
        if not self.latches:
            self.machine.handle(Input.UNLATCH, Cause())

    def restore_latches(self, state: Exported) -> None:
        """Take over the latched stops of another process, before this one serves the robot; raise ProtocolError."""
        self.latches.restore(state)
        if self.latches:
            self.machine.state = State.LATCHED

    def require_neutral(self, reason: str, cause: StopCause, *, stops: bool = True) -> None:
        """Stop the robot, or (``stops=False``) record that it is stopped; motion needs a neutral first."""
        self.machine.handle(Input.REQUIRE_NEUTRAL, Cause(reason=reason, stops=stops, stop=cause))

    def vanished(self, alive: str) -> None:
        """Record that a liveliness token is gone; if the holder named it, the lease ends."""
        if self.holders.current is not None and self.holders.current.alive == alive:
            self.machine.handle(Input.HOLDER_LOST, Cause(reason="holder lost", stop=StopCause.HOLDER_LOST))

    def bus_lost(self) -> None:
        """Record that no other process can reach the gateway any more; the lease ends.

        Where others come and go (``alone_is_normal``), a lease whose holder named a liveliness token stays: the token
        tells whether the holder has left, and one of this process has not.
        """
        current = self.holders.current
        if self._alone_is_normal and current is not None and current.alive is not None:
            return
        self.machine.handle(Input.BUS_LOST, Cause(reason="bus lost", stop=StopCause.BUS_LOST))

    # Time

    def deadline(self) -> float | None:
        """Return when :meth:`expire` is next due; None: never."""
        expires_at = self.holders.current.expires_at if self.holders.current else math.inf
        earliest = min(self.motion.stop_at, expires_at)
        return None if earliest == math.inf else earliest

    def expire(self, now: float) -> None:
        """Do what is due: end a lease that was not renewed, stop motion that was not repeated."""
        if self.holders.current is not None and now >= self.holders.current.expires_at:
            self.machine.handle(Input.EXPIRED, Cause(reason="lease expired", stop=StopCause.LEASE_EXPIRED))
        elif now >= self.motion.stop_at:
            self.machine.handle(Input.DEADMAN, Cause(reason="deadman", stop=StopCause.DEADMAN))

    # What happened

    def events(self) -> list[Event]:
        """Return what happened since the last call, in order."""
        events, self.machine.events = self.machine.events, []
        return events

    def report(self, now: float) -> Control:
        """Return what ``control`` shows: who drives, and what was refused."""
        holder = self.holders.current
        return Control(
            state=self.state,  # type: ignore[arg-type]
            holder=holder.who if holder else None,
            lease=holder.verifier.lease if holder else None,
            priority=holder.priority if holder else None,
            expires_in_s=holder.left_s(now) if holder else None,
            refusals=self._refusals.shown(),
            latches=self.latches.in_force,
            stops=self.latches.confirmed,
        )

    def _reply(self, command: str, given: Input, cause: Cause) -> Lease:
        """Answer a question about the lease; count it if it is refused."""
        try:
            return self.machine.handle(given, cause) or Lease(ok=True)
        except Refused as refusal:
            self.refuse(command, refusal, cause.request.who if cause.request is not None else refusal.who)
            reply = Lease(ok=False, reason=str(refusal), code=refusal.code)
            if (holder := self.holders.current) is not None:
                reply = structs.replace(reply, expires_in_s=holder.left_s(cause.at), holder=holder.who)
            return reply


_ANOTHER_GATEWAY = "another gateway of the robot"
_SHOWN = {State.MOVING: "held", State.NEEDS_NEUTRAL: "held"}
