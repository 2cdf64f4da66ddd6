"""Carries one session over one link: bytes in, frames out, timers. Knows neither protocol nor bus."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

from zbridge.errors import Refused
from zbridge.metrics import Count
from zbridge.protocol.session import Datagram, Session, State
from zbridge.transport.link import STALLED_S, Link, Receiver

log = logging.getLogger("zbridge.link")

_ESTABLISHED = State.ESTABLISHED

LOOK_S = 0.05
"""Seconds between two looks at a link that takes nothing."""


class Conversation:
    """The receiver of a link. ``deliver`` takes messages, ``changed`` is called on every change of state.

    Nothing is written to a link on which bytes have waited for their acknowledgement for longer than STALLED_S: a robot
    would read what piles up as one packet, and lose it. ``stalled`` is told when that begins (True) and when all is
    acknowledged (False), before anything else is written.
    ``before`` is called before anything is written: it may have something that must be written first. ``refused`` is
    told what was refused before it was a message: datagrams that bear the peer's name and do not come from it.
    ``may_warn`` is asked before a warning of one kind about the peer is logged.
    ``clock``: seconds on the loop's time line; by default the loop's own, which may be a millisecond behind.
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
    ) -> None:
        self.session = session
        self._before = before
        self._on_stall = stalled
        self.blocked = False
        """Whether nothing is written because the peer's machine acknowledges nothing."""
        self.ended: asyncio.Future[None] = loop.create_future()
        self._loop = loop
        self._clock = clock or loop.time
        self._deliver = deliver
        self._changed = changed
        self._link: Link | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at: float | None = None
        self._seen = (session.state, session.busy, session.doubts)
        self._malformed = malformed or Count()
        self._foreign = foreign or Count()
        self._rivals = rivals or Count()
        self._refused = refused
        self._may_warn = may_warn
        self._malformed_logged = 0

    def __repr__(self) -> str:
        return f"<Conversation {self.session!r}>"

    def attached(self, link: Link) -> None:
        """Begin: the link is up."""
        self._link = link
        self.session.peer = link.peer
        self.session.open(self._clock())
        self.pump()

    def received(self, data: bytes) -> None:
        """Take bytes from the link."""
        session = self.session
        messages = session.receive(data, self._clock())
        self._hand_on(messages)

    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram from the link."""
        self._hand_on(self.session.receive_datagram(datagram, self._clock()))

    def claims(self, datagram: bytes, port: int) -> bool:
        """Tell whether a datagram from a port of the peer's host that is nobody's source yet is this session's."""
        return self.session.claims(datagram, port)

    def rivalled(self) -> None:
        """Count that another source, or session, claims what this one does; its session decides what becomes of it."""
        self._rivals.value += 1
        self.session.rivalled(self._clock())
        if self._may_warn("with a rival source of datagrams"):
            log.warning("%s: another source of datagrams claims to be %s", self.session.name, self.session.peer)
        self.pump()

    def stray_datagram(self, datagram: bytes) -> None:
        """Look at a datagram of the peer's host that nobody claimed."""
        try:
            self.session.stray(datagram)
        except Refused as refusal:
            self._refused(refusal)

    def foreign_datagram(self) -> None:
        """Count a datagram that came from elsewhere."""
        self.session.traffic.foreign += 1
        self._foreign.value += 1

    def _hand_on(self, messages: list[Any]) -> None:
        session = self.session
        if not session.over:
            self._notify()
        if messages:  # what came before the end of a session is delivered before the end is told
            self._deliver(messages)
        if session.traffic.malformed != self._malformed_logged:
            self._report_malformed()
        self.pump()

    def lost(self, reason: str) -> None:
        """Take note that the link is gone."""
        self._link = None
        self.session.lost(reason)
        self.pump()

    def writable(self) -> None:
        """Go on writing."""
        self.pump()

    def pump(self) -> None:
        """Write what may be written now, and set the timer for what may not."""
        session, link = self.session, self._link
        outbox = session.outbox
        if session.drops_source and link is not None:
            session.drops_source = False
            link.drop_source()
        writing = link is not None and (session.over or self._takes(link))  # last words are written in any case
        while writing and link is not None and link.ready:
            now = self._clock()  # before the look: what becomes due after it, as the process froze, waits for another
            self._before()
            frame = session.outgoing(now)
            if frame is None:
                break
            if type(frame) is Datagram:
                link.write_datagram(frame)
            else:
                link.write(frame)
            outbox.written(self._clock())
            if session.state is _ESTABLISHED and (outbox.gap_s or outbox.idle):
                break  # nothing more may be written now
        self._notify()
        if session.state is State.CLOSED:
            self._end()
        else:
            ready = writing and link is not None and link.ready
            self._set_timer(self._next(session.deadline(writing=ready), link))

    def close(self, reason: str) -> None:
        """End the conversation from our side."""
        self.session.close(reason, self._clock())
        self.pump()

    @property
    def stalled(self) -> bool:
        """Whether the peer does not take what was written."""
        return self._link is not None and not self._link.ready

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has owed an answer."""
        return self._link.silent_s if self._link is not None else 0.0

    def cut(self, reason: str) -> None:
        """End the conversation and its link at once, and say why; what was written is lost."""
        self.session.lost(reason)
        if self._link is not None:
            self._link.abort()
        self.pump()

    def abandon(self) -> None:
        """End the conversation and its link at once, whatever state they are in; idempotent."""
        self.session.lost("abandoned")
        self._end()

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""
        if self._link is not None:
            self._link.pause()

    def resume(self) -> None:
        """Read again."""
        if self._link is not None:
            self._link.resume()

    def _tick(self) -> None:
        self._timer = None
        self.session.expire(self._clock())
        self.pump()

    def _takes(self, link: Link) -> bool:
        """Tell whether the peer's machine acknowledges what is written; once it does not, wait for the last byte."""
        waited_s = link.unacknowledged_s
        blocked = waited_s > (0.0 if self.blocked else STALLED_S)
        if blocked is not self.blocked:
            self.blocked = blocked
            self._on_stall(blocked)
        return not blocked

    def _next(self, deadline: float | None, link: Link | None) -> float | None:
        """Give the next time to do anything: the session's, or a look at what is not acknowledged."""
        waited_s = link.unacknowledged_s if link is not None else 0.0
        if not waited_s and not self.blocked:
            return deadline
        look_at = self._clock() + (LOOK_S if self.blocked else max(0.0, STALLED_S - waited_s) + LOOK_S / 10)
        return look_at if deadline is None else min(deadline, look_at)

    def _set_timer(self, deadline: float | None) -> None:
        if self._timer is not None:
            if deadline is not None and self._timer_at is not None and self._timer_at <= deadline:
                return  # it fires early, finds nothing due, and is set anew: cheaper than a new one for every frame
            self._timer.cancel()
            self._timer = None
        if deadline is not None:
            self._timer = self._loop.call_at(deadline, self._tick)
        self._timer_at = deadline  # uvloop's timers that are due at once do not tell when

    def _notify(self) -> None:
        """Tell of a change of state, once."""
        now = (self.session.state, self.session.busy, self.session.doubts)
        if now != self._seen:
            self._seen = now
            self._changed()

    def _end(self) -> None:
        self._set_timer(None)
        link, self._link = self._link, None
        if link is not None:
            link.close()
        if not self.ended.done():
            self.ended.set_result(None)

    def _report_malformed(self) -> None:
        """Warn at the first, second, fourth ... malformed message: the log stays readable in a flood."""
        count = self.session.traffic.malformed
        self._malformed.value += count - self._malformed_logged
        due = count.bit_length() != self._malformed_logged.bit_length()
        if due and self._may_warn("warnings of malformed messages"):
            log.warning("%s: %d malformed so far, last: %s", self.session.name, count, self.session.last_malformed)
        self._malformed_logged = count


class Accepted(Receiver):
    """The receiver of a link that was accepted: its conversation is made by ``admit``, which may refuse one.

    ``level``: of the line of the log about the end of the link.
    """

    def __init__(self, admit: Callable[[Link], Conversation | None], level: int = logging.INFO) -> None:
        self._admit = admit
        self._level = level
        self._conversation: Conversation | None = None

    def __repr__(self) -> str:
        return f"<Accepted {self._conversation!r}>"

    def attached(self, link: Link) -> None:
        """Begin a conversation, or close the link."""
        self._conversation = self._admit(link)
        if self._conversation is None:
            link.close()
        else:
            self._conversation.attached(link)

    def received(self, data: bytes) -> None:
        """Take bytes from the link."""
        if self._conversation is not None:
            self._conversation.received(data)

    def lost(self, reason: str) -> None:
        """Take note that the link is gone."""
        if self._conversation is not None:
            log.log(self._level, "%s: %s", self._conversation.session.peer, reason)
            self._conversation.lost(reason)

    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram from the link."""
        if self._conversation is not None:
            self._conversation.received_datagram(datagram)

    def claims(self, datagram: bytes, port: int) -> bool:
        """Tell whether a datagram from a port of the peer's host that is nobody's source yet is this conversation's."""
        return self._conversation is not None and self._conversation.claims(datagram, port)

    def rivalled(self) -> None:
        """Take note that another source, or conversation, claims what this one does."""
        if self._conversation is not None:
            self._conversation.rivalled()

    def stray_datagram(self, datagram: bytes) -> None:
        """Look at a datagram of the peer's host that nobody claimed."""
        if self._conversation is not None:
            self._conversation.stray_datagram(datagram)

    def foreign_datagram(self) -> None:
        """Count a datagram that came from elsewhere."""
        if self._conversation is not None:
            self._conversation.foreign_datagram()

    def writable(self) -> None:
        """Go on writing."""
        if self._conversation is not None:
            self._conversation.writable()
