"""Runs one session over one link: bytes in, frames out, timers. Knows neither protocol nor bus.

A process that was frozen finds its timers overdue and the peer's bytes unread. The order then is: what must leave first
(``before``), waiting input, and the session's timers :data:`CATCH_UP_S` later. So no session ends for a silence that
the process itself caused.

Only ``pump`` writes. Everything that may give the session something to write, or change its state, ends with it: bytes,
a timer, a command of the device. An exception of the protocol's own code in any of them ends its session, with file and
line as the reason.

A link is stalled when bytes have waited for their acknowledgement for longer than STALLED_S. From then on nothing is
written: a robot would read what piles up as one packet, and lose it. The stall ends, before the next write, when all is
acknowledged.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import msgspec

from zbridge.errors import FAULT, Refused, describe
from zbridge.log import Log
from zbridge.metrics import Count
from zbridge.protocol.kept import Budget, Exported
from zbridge.protocol.session import Datagram, Session, State
from zbridge.transport.link import STALLED_S, Link, Receiver
from zbridge.transport.reading import UNTIMED, FairShare, ReadControl, ReadTimes
from zbridge.transport.transferable import Parcel

log = Log("zbridge.link")

LATE_S = 0.02
"""A session's timer that fires this late shows that the process, or the machine, was delayed; seconds."""
CATCH_UP_S = 0.05
"""Seconds for which such a process reads before it runs the session's timers."""
CHECK_S = 0.05
"""Seconds between two checks of a stalled link."""
_ESTABLISHED, _CLOSED = State.ESTABLISHED, State.CLOSED

_C = TypeVar("_C", bound="Conversation")
_P = ParamSpec("_P")


class ConversationHooks(msgspec.Struct, frozen=True, kw_only=True):
    """What a conversation calls, counts and uses of its owner."""

    deliver: Callable[[list[Any]], None] = lambda messages: None
    """Takes the messages of each read."""
    changed: Callable[[], object] = lambda: None
    """Called on every change of the session's state."""
    before: Callable[[], object] = lambda: None
    """Called before each read and write, to pass the session what must leave first."""
    read: Callable[[], object] | None = None
    """Called when the bytes of a read have been cut into frames."""
    stalled: Callable[[bool], object] = lambda stalled: None
    """Called when the link is stalled (True), and when that ends (False)."""
    linked: Callable[[Link, bool], object] = lambda link, up: None
    """Called when the link is up (True), and when it is gone (False)."""
    refused: Callable[[Refused], object] = lambda refusal: None
    """Called for datagrams in the peer's name that did not come from the peer."""
    may_warn: Callable[[str], bool] = lambda kind: True
    """Returns whether a warning of this kind may be logged now."""
    clock: Callable[[], float] | None = None
    """Seconds on the loop's time line; by default the loop's own clock, which may be a millisecond behind."""
    share: FairShare | None = None
    """Of a processor; a peer that sends more than can be processed within it is not read meanwhile."""
    times: ReadTimes = UNTIMED
    """From a read until its messages are handed on."""
    malformed: Count = msgspec.field(default_factory=Count)
    foreign: Count = msgspec.field(default_factory=Count)
    rivals: Count = msgspec.field(default_factory=Count)
    surplus: Count = msgspec.field(default_factory=Count)
    """Counts datagrams that were dropped because the share was used up."""


def then_pump(step: Callable[Concatenate[_C, _P], None]) -> Callable[Concatenate[_C, _P], None]:
    """Let a step end with ``pump``; an exception of the protocol's own code ends it."""

    @wraps(step)
    def contained(self: _C, /, *args: _P.args, **kwargs: _P.kwargs) -> None:
        try:
            step(self, *args, **kwargs)
        except Exception as error:
            self._fault(error)
        else:
            self.pump()

    return contained


class Conversation(Receiver):
    """The receiver of a link, and the driver of a session."""

    def __init__(self, session: Session[Any], loop: asyncio.AbstractEventLoop, hooks: ConversationHooks) -> None:
        self.session = session
        self.ended: asyncio.Future[None] = loop.create_future()
        self.link: Link | None = None
        """The connection; None before there is one, and after it."""
        self.connected_at: float | None = None
        """When the link came up, also of the process that had it before; None before it was ever up."""
        self._loop = loop
        self._hooks = hooks
        self._clock = clock = hooks.clock or loop.time
        self._before, self._read = hooks.before, hooks.read
        self._times = hooks.times
        self._observed: Link | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at: float | None = None
        self._reads_until = -math.inf
        """When the session's timers run again: the process was delayed, and reads first."""
        self._seen = (session.state, session.busy, session.doubts)
        self._malformed_logged = 0
        self.blocked = False
        """Whether nothing is written because the link is stalled."""
        self.reading = ReadControl(loop, clock, hooks.share)
        self.reading.resumed = lambda: session.silence.restart(clock())
        self.heard_at = -math.inf
        """When anything came by the link last, or it came up."""

    def __repr__(self) -> str:
        return f"<Conversation {self.session!r}>"

    @then_pump
    def attached(self, link: Link) -> None:
        self.link = self._observed = self.reading.link = link
        self.heard_at = self._clock()
        if self.connected_at is None:
            self.connected_at = self.heard_at
        self._hooks.linked(link, True)
        if self.reading.suspended:
            link.suspend()
        if link.datagrams_only:
            self.session.by_datagrams(speaks_first=link.speaks_first)
            link.unsent = self.session.traffic.drop
        self.session.peer = link.peer
        self.session.open(self._clock())

    def received(self, data: bytes) -> None:
        begun = self.heard_at = self._clock()
        try:
            self._before()
            messages = self.session.receive(data, begun)
            if self._read is not None:
                self._read()
            self._hand_on(messages)
            if begun >= self._times.due:
                self._times.note(begun, self._clock())
        except Exception as error:
            self._fault(error)
        else:
            self.pump()
        if self._hooks.share is not None:
            self.reading.worked(begun)

    @then_pump
    def received_datagram(self, datagram: bytes) -> None:
        begun = self.heard_at = self._clock()
        if self.reading.rests:
            self._hooks.surplus.value += 1
            return
        self._hand_on(self.session.receive_datagram(datagram, begun))
        self.reading.worked(begun)

    def foreign_datagram(self) -> None:
        self.session.traffic.foreign += 1
        self._hooks.foreign.value += 1

    def _hand_on(self, messages: list[Any]) -> None:
        if self.session.state is not self._seen[0] and not self.session.over:
            self._notify()
        if messages:  # the messages before the end of a session are delivered before the end is reported
            self._hooks.deliver(messages)
        count, logged = self.session.traffic.malformed, self._malformed_logged
        if count == logged:
            return
        self._hooks.malformed.value += count - logged
        # a warning at malformed messages 1, 2, 4, 8 ...: the log stays readable in a flood
        if count.bit_length() != logged.bit_length() and self._hooks.may_warn("warnings of malformed messages"):
            log.warning(
                "messages_malformed",
                "{session}: {count} malformed so far, last: {error}",
                session=self.session.name,
                peer=self.session.peer,
                count=count,
                error=self.session.last_malformed,
            )
        self._malformed_logged = count

    def _fault(self, error: Exception) -> None:
        """End the session, and log where the code of its protocol is wrong."""
        reason = f"{FAULT}{describe(error)}"
        log.error("session_fault", "{session}: {reason}", session=self.session.name, reason=reason, exc_info=error)
        self.session.fail(reason)
        self._end()
        self._notify()

    @then_pump
    def lost(self, reason: str) -> None:
        if self._observed is not None:
            log.debug("connection_lost", "{peer}: {reason}", peer=self.session.peer, reason=reason)
            self._hooks.linked(self._observed, False)
        self.link = self._observed = self.reading.link = None
        self.session.fail(reason)

    def writable(self) -> None:
        self.pump()

    def pump(self) -> None:
        """Write what may be written now, report a change of state, and set the timer for the rest."""
        if self.reading.suspended:
            return
        session = self.session
        try:
            writes_at, waited_s = self._write()
            changed = (session.state, session.busy, session.doubts) != self._seen
            if changed:
                self._notify()
            if session.state is _CLOSED:
                self._end()
                return
            if changed:  # the code that was notified may have given the session something to write
                writes_at, waited_s = self._write()
            now = self._clock()
            at = self._reads_until if now < self._reads_until else session.deadline(writing=False)
            if writes_at is not None and (at is None or writes_at < at):
                at = writes_at
            if waited_s or self.blocked:
                check_at = now + (CHECK_S if self.blocked else max(0.0, STALLED_S - waited_s) + CHECK_S / 10)
                at = check_at if at is None else min(at, check_at)
            self._set_timer(at)
        except Exception as error:
            self._fault(error)

    def _write(self) -> tuple[float | None, float]:
        """Write what is due; return when more is due, None for never, and for how long bytes have waited, seconds."""
        session, link, outbox = self.session, self.link, self.session.outbox
        if link is None:
            return None, 0.0
        established, waited_s, writes_at = session.state is _ESTABLISHED, link.unacknowledged_s, None
        last_words = not established and session.over  # these leave a stalled link too
        if not last_words and (waited_s > (0.0 if self.blocked else STALLED_S)) is not self.blocked:
            self.blocked = not self.blocked
            self._hooks.stalled(self.blocked)
        if self.blocked and not last_words:
            return None, waited_s
        now = self._clock()
        while link.ready:
            writes_at = outbox.deadline()
            if established and (writes_at is None or writes_at > now):
                break
            self._before()  # what becomes due while the process is frozen waits for its turn: ``now`` is older
            frame = session.outgoing(now)
            if frame is None:
                writes_at = outbox.deadline()
                break
            if type(frame) is Datagram:
                link.write_datagram(frame)
            else:
                link.write(frame)
            now, established = self._clock(), session.state is _ESTABLISHED
            outbox.written(now)
            waited_s = link.unacknowledged_s
        return (writes_at if link.ready else None), waited_s

    @then_pump
    def close(self, reason: str) -> None:
        """End the conversation from our side."""
        self.session.close(reason, self._clock())

    @property
    def stalled(self) -> bool:
        """Whether the kernel has not taken all that was written."""
        return self.link is not None and not self.link.ready

    @then_pump
    def cut(self, reason: str) -> None:
        """End the conversation and its link at once, with a reason; what was written may be lost."""
        self.session.fail(reason)
        if self.link is not None:
            self.link.abort()

    def abandon(self) -> None:
        """End the conversation and its link at once, in any state; idempotent."""
        self.session.fail("abandoned")
        self._end()

    # A restart

    @property
    def blocker(self) -> str | None:
        """Why the conversation cannot be handed to another process now; None if it can."""
        link = self.link
        if link is None or self.session.over:
            return "the connection is not up"
        return link.blocker or (None if link.ready else "the peer is stalled")

    def suspend(self) -> None:
        """Read and write nothing, and run no timer, until :meth:`resume`: another process may get the connection."""
        self.reading.suspended = True
        self._set_timer(None)
        if self.link is not None:
            self.link.suspend()

    def resume(self) -> None:
        """Continue where :meth:`suspend` interrupted: this process has the connection."""
        self.reading.suspended = False
        if self.link is not None:
            self.link.resume()
        self.pump()

    def export(self, parcel: Parcel, budget: Budget | None = None) -> Exported:
        """Put the connection of a suspended conversation into a parcel; describe it and the session.

        budget: of a deposit; the conversation need not be suspended then.
        """
        assert self.link is not None
        return {
            "session": self.session.export(budget),
            "link": self.link.export(parcel),
            "connected_at": self.connected_at,
        }

    def detach(self) -> None:
        """Forget the connection, which another process has now: the peer notices nothing."""
        self.reading.suspended = True
        self._set_timer(None)
        self.reading.end()
        link, self.link = self.link, None
        if link is not None:
            link.detach()

    @then_pump
    def _tick(self) -> None:
        self._timer, due, now = None, self._timer_at, self._clock()
        if due is not None and due != self._reads_until and now > due + LATE_S:
            self._before()
            self._reads_until = now + CATCH_UP_S
        elif now >= self._reads_until:
            if self.reading.off:
                self.session.silence.restart(now)
            self.session.expire(now)

    def _set_timer(self, deadline: float | None) -> None:
        if self._timer is not None:
            if deadline is not None and self._timer_at is not None and self._timer_at <= deadline:
                return  # an early wake-up is harmless, and cheaper than a new timer for every frame
            self._timer.cancel()
            self._timer = None
        if deadline is not None:
            self._timer = self._loop.call_at(deadline, self._tick)
        self._timer_at = deadline  # a uvloop timer that is due at once has no time

    def _notify(self) -> None:
        """Report a change of state, once."""
        now = (self.session.state, self.session.busy, self.session.doubts)
        if now != self._seen:
            self._seen = now
            self._hooks.changed()

    def _end(self) -> None:
        self._set_timer(None)
        self.reading.end()
        link, self.link = self.link, None
        if link is not None:
            link.close()
        if not self.ended.done():
            self.ended.set_result(None)
