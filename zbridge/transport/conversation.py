"""Runs one session over one link: bytes in, frames out, timers. Knows neither protocol nor bus.

A process that was frozen finds its timers overdue and the peer's bytes unread. The order then is: what must leave first
(``before``), what waits to be read, and the session's timers :data:`CATCH_UP_S` later. So no session ends for a silence
that was its own.

``pump`` is the one place that writes. Everything that may give the session something to write, or change its state,
ends with it: bytes, a timer, a command of the device. What the protocol's own code raises in any of them ends its
session, with the place as the reason.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec

from zbridge.errors import FAULT, Refused, describe
from zbridge.metrics import Count
from zbridge.protocol.kept import Budget, Exported
from zbridge.protocol.session import Datagram, Session, State
from zbridge.transport.fair_share import FairShare
from zbridge.transport.link import Link
from zbridge.transport.reading import Reading
from zbridge.transport.stalls import Stalls
from zbridge.transport.transferable import Parcel

log = logging.getLogger("zbridge.link")

LATE_S = 0.02
"""A timer of a session that fires so much late tells of a process, or a machine, that was held up; seconds."""
CATCH_UP_S = 0.05
"""Seconds for which such a process reads before the timers of the session run."""
_ESTABLISHED = State.ESTABLISHED


_P = ParamSpec("_P")


def _then_pump(step: Callable[Concatenate[Conversation, _P], None]) -> Callable[Concatenate[Conversation, _P], None]:
    """Let a step end with ``pump``; a fault of the protocol's own code ends the session."""

    @wraps(step)
    def contained(self: Conversation, /, *args: _P.args, **kwargs: _P.kwargs) -> None:
        try:
            step(self, *args, **kwargs)
            self._pump()
        except Exception as error:
            self._fault(error)

    return contained


class Conversation:
    """The receiver of a link, and the driver of a session.

    ``deliver`` takes the messages of each read. ``changed`` is called on every change of the session's state.
    ``before`` is called before each write: what must leave first may be given to the session there.
    ``stalled(True)`` is called when bytes have waited for their acknowledgement for longer than STALLED_S. From then on
    nothing is written: a robot would read what piles up as one packet, and lose it. ``stalled(False)`` is called when
    all is acknowledged, before the next write.
    ``refused`` is told which datagrams in the peer's name did not come from the peer.
    ``may_warn(kind)`` says whether a warning of this kind may be logged now.
    ``share``: of a processor; who sends more than can be worked off within it is not read meanwhile, and its datagrams
    are dropped and counted by ``surplus``.
    ``linked`` is called with the link and True when the link is up, and False when it is gone.
    ``read`` is called when the bytes of a read have been cut into frames.
    ``clock``: seconds on the loop's time line; the default is the loop's own clock, which may be a millisecond behind.
    """

    def __init__(
        self,
        session: Session[Any],
        loop: asyncio.AbstractEventLoop,
        *,
        deliver: Callable[[list[Any]], None],
        changed: Callable[[], None] = lambda: None,
        malformed: Count | None = None,
        foreign: Count | None = None,
        rivals: Count | None = None,
        refused: Callable[[Refused], None] = lambda refusal: None,
        may_warn: Callable[[str], bool] = lambda kind: True,
        clock: Callable[[], float] | None = None,
        before: Callable[[], object] = lambda: None,
        stalled: Callable[[bool], object] = lambda stalled: None,
        share: FairShare | None = None,
        surplus: Count | None = None,
        linked: Callable[[Link, bool], object] = lambda link, up: None,
        read: Callable[[], object] = lambda: None,
    ) -> None:
        self._read = read
        self.session = session
        self._linked = linked
        self._observed: Link | None = None
        self._before = before
        self.ended: asyncio.Future[None] = loop.create_future()
        self._loop = loop
        self._clock = clock or loop.time
        self._deliver = deliver
        self._changed = changed
        self._link: Link | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at: float | None = None
        self._reads_until = -math.inf
        """The timers of the session do not run before: the process was held up, and reads first."""
        self._seen = (session.state, session.busy, session.doubts)
        self._malformed = malformed or Count()
        self._foreign = foreign or Count()
        self._rivals = rivals or Count()
        self._refused = refused
        self._may_warn = may_warn
        self._malformed_logged = 0
        self._surplus = surplus or Count()
        self._stalls = Stalls(self._clock, stalled)
        self._reading = Reading(loop, self._clock, share)
        self.connected_at: float | None = None
        """When the link came up, also of the process that had it before; None before it was ever up."""
        self._heard_at = -math.inf

    def __repr__(self) -> str:
        return f"<Conversation {self.session!r}>"

    @_then_pump
    def attached(self, link: Link) -> None:
        """Begin: the link is up."""
        self._link = self._observed = self._reading.link = link
        self._heard_at = self._clock()
        if self.connected_at is None:
            self.connected_at = self._heard_at
        self._linked(link, True)
        if self._reading.suspended:
            link.suspend()
        self.session.peer = link.peer
        self.session.open(self._clock())

    def received(self, data: bytes) -> None:
        """Take bytes from the link."""
        begun = self._heard_at = self._clock()
        try:
            self._before()
            messages = self.session.receive(data, begun)
            self._read()
            self._hand_on(messages)
            self._pump()
        except Exception as error:
            self._fault(error)
        self._reading.worked(begun)

    @_then_pump
    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram from the link."""
        begun = self._heard_at = self._clock()
        if self._reading.rests:
            self._surplus.value += 1
            return
        self._hand_on(self.session.receive_datagram(datagram, begun))
        self._reading.worked(begun)

    def claims(self, datagram: bytes, port: int) -> bool:
        """Ask the session whether this datagram is from its peer."""
        return self.session.claims(datagram, port)

    @_then_pump
    def rivalled(self) -> None:
        """Count a second source, or session, with the same claim, and tell the session."""
        self._rivals.value += 1
        self.session.rivalled(self._clock())
        if self._may_warn("with a rival source of datagrams"):
            log.warning("%s: another source of datagrams claims to be %s", self.session.name, self.session.peer)

    def stray_datagram(self, datagram: bytes) -> None:
        """Show the session a datagram of the peer's host that nobody claimed."""
        try:
            self.session.stray(datagram)
        except Refused as refusal:
            self._refused(refusal)

    def foreign_datagram(self) -> None:
        """Count a datagram that came from elsewhere."""
        self.session.traffic.foreign += 1
        self._foreign.value += 1

    def _hand_on(self, messages: list[Any]) -> None:
        if self.session.state is not self._seen[0] and not self.session.over:
            self._notify()
        if messages:  # the messages before the end of a session are delivered before the end is reported
            self._deliver(messages)
        if self.session.traffic.malformed != self._malformed_logged:
            self._report_malformed()

    def _fault(self, error: Exception) -> None:
        """End the session, and show where the code of its protocol is wrong."""
        log.error("%s: %s%s", self.session.name, FAULT, describe(error), exc_info=error)
        self.session.fail(f"{FAULT}{describe(error)}")
        self._end()
        self._notify()

    @_then_pump
    def lost(self, reason: str) -> None:
        """End: the link is gone."""
        if self._observed is not None:
            self._linked(self._observed, False)
        self._link = self._observed = self._reading.link = None
        self.session.lost(reason)

    def pump(self) -> None:
        """Write what may be written now, report a change of state, and set the timer for the rest."""
        try:
            self._pump()
        except Exception as error:
            self._fault(error)

    def writable(self) -> None:
        """Resume writing."""
        self.pump()

    def _pump(self) -> None:
        if self._reading.suspended:
            return
        session, link = self.session, self._link
        outbox = session.outbox
        if session.drops_source and link is not None:
            session.drops_source = False
            link.drop_source()
        established = session.state is _ESTABLISHED
        writing = link is not None and (
            (not established and session.over) or self._stalls.takes(link)
        )  # last words leave
        now = self._clock()
        while writing and link is not None and link.ready and (not established or outbox.due(now)):
            self._before()  # what becomes due while the process is frozen waits for its turn: ``now`` is older
            frame = session.outgoing(now)
            if frame is None:
                break
            if type(frame) is Datagram:
                link.write_datagram(frame)
            else:
                link.write(frame)
            now, established = self._clock(), session.state is _ESTABLISHED
            outbox.written(now)
        self._notify()
        if session.state is State.CLOSED:
            self._end()
        else:
            ready = writing and link is not None and link.ready
            self._set_timer(self._stalls.next(self._deadline(now, writing=ready), link))

    @_then_pump
    def close(self, reason: str) -> None:
        """End the conversation from our side."""
        self.session.close(reason, self._clock())

    @property
    def stalled(self) -> bool:
        """Whether the kernel has not taken all that was written."""
        return self._link is not None and not self._link.ready

    @property
    def unheard_s(self) -> float:
        """Seconds since anything came by the link, or it came up."""
        return self._clock() - self._heard_at

    @property
    def connected_s(self) -> float:
        """Age of the connection in seconds; 0 where there is none."""
        return self._clock() - self.connected_at if self._link is not None and self.connected_at is not None else 0.0

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has not answered."""
        return self._link.silent_s if self._link is not None else 0.0

    @_then_pump
    def cut(self, reason: str) -> None:
        """End the conversation and its link at once, with a reason; what was written may be lost."""
        self.session.lost(reason)
        if self._link is not None:
            self._link.abort()

    def abandon(self) -> None:
        """End the conversation and its link at once, in any state; idempotent."""
        self.session.lost("abandoned")
        self._end()

    def pause_reading(self) -> None:
        """Read nothing until :meth:`resume_reading`."""
        self._reading.pause()

    def resume_reading(self) -> None:
        """Read again."""
        self._reading.resume()

    # A restart

    @property
    def suspended(self) -> bool:
        """Whether nothing is read or written, and no timer runs: another process has the connection, or may get it."""
        return self._reading.suspended

    @suspended.setter
    def suspended(self, suspended: bool) -> None:
        self._reading.suspended = suspended

    @property
    def link(self) -> Link | None:
        """The connection; None before there is one, and after it."""
        return self._link

    @property
    def blocker(self) -> str | None:
        """Why the conversation cannot be handed to another process now; None where it can."""
        link = self._link
        if link is None or self.session.over:
            return "the connection is not up"
        return link.blocker or (None if link.ready else "the peer takes nothing")

    def suspend(self) -> None:
        """Read and write nothing, and run no timer, until :meth:`resume`."""
        self.suspended = True
        self._set_timer(None)
        if self._link is not None:
            self._link.suspend()

    def resume(self) -> None:
        """Continue where :meth:`suspend` interrupted: this process has the connection."""
        self.suspended = False
        if self._link is not None:
            self._link.resume()
        self.pump()

    def export(self, parcel: Parcel, budget: Budget | None = None) -> Exported:
        """Put the connection of a suspended conversation into a parcel; describe it and the session.

        budget: of a deposit; the conversation need not be suspended then.
        """
        assert self._link is not None
        return {
            "session": self.session.export(budget),
            "link": self._link.export(parcel),
            "connected_at": self.connected_at,
        }

    def detach(self) -> None:
        """Forget the connection, which another process has now: the peer notices nothing."""
        self.suspended = True
        self._set_timer(None)
        self._reading.end()
        link, self._link = self._link, None
        if link is not None:
            link.detach()

    @_then_pump
    def _tick(self) -> None:
        self._timer, due, now = None, self._timer_at, self._clock()
        if due is not None and due != self._reads_until and now > due + LATE_S:
            self._before()
            self._reads_until = now + CATCH_UP_S
        elif now >= self._reads_until:
            self.session.expire(now)

    def _deadline(self, now: float, *, writing: bool) -> float | None:
        """Give the time of the next tick; ``writing`` False: the link takes nothing now."""
        if now >= self._reads_until:
            return self.session.deadline(writing=writing)
        writes_at = self.session.outbox.deadline() if writing else None
        return self._reads_until if writes_at is None else min(writes_at, self._reads_until)

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
            self._changed()

    def _end(self) -> None:
        self._set_timer(None)
        self._reading.end()
        link, self._link = self._link, None
        if link is not None:
            link.close()
        if not self.ended.done():
            self.ended.set_result(None)

    def _report_malformed(self) -> None:
        """Warn at malformed messages 1, 2, 4, 8 ...: the log stays readable in a flood."""
        count = self.session.traffic.malformed
        self._malformed.value += count - self._malformed_logged
        due = count.bit_length() != self._malformed_logged.bit_length()
        if due and self._may_warn("warnings of malformed messages"):
            log.warning("%s: %d malformed so far, last: %s", self.session.name, count, self.session.last_malformed)
        self._malformed_logged = count
