"""A simulated link of the bus: TCP with Zenoh's keep-alive and reconnection above it.

Theory of operation. A link has two ends, 0 and 1, which learn of its end at their own times, and two ways. A way that
is cut keeps what it is given (of messages that may be dropped: what fits into the buffers) until TCP sends it again
after the cut: at a moment of its back-off, which doubles from :data:`RTO_S`, so at most as long after the cut as the
cut lasted. Where only the acknowledgements are cut, TCP's window lets a few messages through. An end that hears nothing
for :data:`LEASE_S`, keep-alives included, gives the link up; the other end learns of that if its path works, else when
it is back, or gives up by itself. Then end 0 connects anew (:class:`Retry`): an attempt into a cut path continues as
the kernel repeats it; where end 0 was first to give up, and TCP still has something to send again, it waits for that.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tests.simulated.bus import Fabric

LEASE_S = 10.0
"""Seconds of silence after which an end gives a link up."""
KEEP_ALIVE_S = 2.5
"""Most seconds for which an end that has nothing to say is silent."""
RTO_S = (0.2, 0.23)
"""Seconds until TCP first sends again; doubled each time."""
KEPT_BYTES = (9_000, 20_000)
"""Bytes that a link keeps of messages that may be dropped, while it takes nothing."""
OVERHEAD_BYTES = 30
BURST = (100, 520)
"""Messages within a second that must not be dropped: after so many a link may stall."""
CLOSE_S = 1.0
"""Seconds after which Zenoh closes a link that takes no message that must not be dropped."""
WINDOW = (4, 10)
"""Messages that TCP sends without an acknowledgement."""
SYN_S = (2.0, 2.0, 2.0, 2.0)
"""Seconds between the repetitions of an attempt to connect."""
OPEN_S = 10.0
"""Seconds after which an attempt to connect is given up."""


class Retry(NamedTuple):
    """The seconds between attempts to connect: the first and the longest, each from a range; what they grow by."""

    first_s: tuple[float, float]
    most_s: tuple[float, float]
    factor: float


SESSIONS = Retry((0.5, 1.5), (2.0, 4.0), 1.5)
"""As :mod:`zbridge.bus.zenoh.opening` configures sessions."""
ROUTERS = Retry((1.0, 1.0), (4.0, 4.0), 2.0)
"""Zenoh's own, which routers use."""


class _Message(NamedTuple):
    number: int
    order: str
    size: int
    deliver: Callable[[], None]
    droppable: bool


class _Way:
    """One direction. kept: what waits to be sent again, in order. heard_at: when something arrived at last."""

    def __init__(self, room: int, now: float) -> None:
        self.room = room
        self.kept: list[_Message] = []
        self.last: dict[str, float] = {}
        self.cut_at: float | None = None
        self.kept_since = 0.0
        self.window = 0
        self.unanswered = False
        """Whether only the acknowledgements are cut: TCP sends again what arrives, and in other times."""
        self.heard_at = now
        self.burst_at = now
        self.burst = 0
        self.burst_most = 0
        """After so many messages of this burst the way takes nothing any more."""


class Link:
    """A link between two hosts. later: does something on the side of end 0. changed: told what an end came to know."""

    def __init__(
        self,
        fabric: Fabric,
        hosts: tuple[str, str],
        later: Callable[[float, Callable[[], None]], None],
        retry: Retry,
        changed: Callable[[int, bool], None],
    ) -> None:
        self.fabric = fabric
        self.hosts = hosts
        self.ends = [True, True]
        """Whether each end takes the link for up."""
        self._later = later
        self._retry = retry
        self._changed = changed
        self._number = 0
        self._life = 0
        self._stays_down = False
        self.locked = False
        """Whether the session makes no connection any more, until its process opens another one."""
        self._blocked_until = 0.0
        """The old connection is closed only then: TCP has to send that again, too."""
        self._ways = self._new_ways()

    def _new_ways(self) -> tuple[_Way, _Way]:
        rng, now = self.fabric.rng, self.fabric.world.now
        return _Way(rng.randint(*KEPT_BYTES), now), _Way(rng.randint(*KEPT_BYTES), now)

    @property
    def up(self) -> bool:
        """Whether both ends take it for up."""
        return all(self.ends)

    @property
    def whole(self) -> bool:
        """Whether it is up and lets everything through."""
        return self.up and self._flows and not any(way.kept for way in self._ways)

    @property
    def _flows(self) -> bool:
        return self._path(0) and self._path(1)

    def _path(self, end: int) -> bool:
        """Whether what end ``end`` sends arrives."""
        return self.fabric.paths.up(self.hosts[end], self.hosts[1 - end])

    def silent_s(self) -> float:
        """Return for how long end 1 has heard nothing."""
        now = self.fabric.world.now
        return min(now - self._ways[0].heard_at, self.fabric.rng.uniform(0.0, KEEP_ALIVE_S))

    # Messages

    def carry(self, end: int, order: str, size: int, deliver: Callable[[], None], *, droppable: bool) -> None:
        """Carry a message from one end to the other."""
        if not self.up:
            return
        self._number += 1
        self._send(end, _Message(self._number, order, size + OVERHEAD_BYTES, deliver, droppable))

    def _send(self, end: int, message: _Message) -> None:
        way, world = self._ways[end], self.fabric.world
        if not message.droppable and self._jams(way):
            return
        if way.kept or not self._path(end) or (not self._path(1 - end) and way.window <= 0):
            kept = sum(each.size for each in way.kept if each.droppable)
            if not message.droppable or kept + message.size <= way.room:
                self._keep(way, message)
            return
        if not self._path(1 - end):
            way.window -= 1
        delay_s = self.fabric.paths.delay(self.hosts[end], self.hosts[1 - end])
        when = max(way.last.get(message.order, 0.0), world.now + delay_s)
        way.last[message.order] = when
        life = self._life
        world.at(when, lambda: self._arrive(end, message, life))

    def _jams(self, way: _Way) -> bool:
        """Whether too much came at once that must not be dropped: then Zenoh closes the link after a while."""
        now, rng = self.fabric.world.now, self.fabric.rng
        if now - way.burst_at > 1.0 or not way.burst:
            way.burst_at, way.burst = now, 0
        way.burst += 1
        if way.burst == BURST[0]:
            way.burst_most = rng.randint(*BURST) if rng.random() < 0.7 else 10**9
        if way.burst <= max(way.burst_most, BURST[0]):
            return False
        if way.burst == way.burst_most + 1:
            life = self._life
            self.fabric.world.after(CLOSE_S, lambda: self.drop() if life == self._life else None)
        way.burst_at = now
        return True

    def _keep(self, way: _Way, message: _Message) -> None:
        if not way.kept:
            way.kept_since = self.fabric.world.now
        insort(way.kept, message, key=lambda each: each.number)

    def _arrive(self, end: int, message: _Message, life: int) -> None:
        if not self.up or life != self._life:
            return
        if not self._path(end):
            self._keep(self._ways[end], message)
            return
        self._ways[end].heard_at = self.fabric.world.now
        message.deliver()

    # Cuts

    def follow(self) -> None:
        """Follow the paths: begin to stall, or send again what was kept."""
        for end in (0, 1):
            way = self._ways[end]
            if not self._flows and way.cut_at is None:
                self._cut(end, way)
            elif self._flows and way.cut_at is not None:
                way.cut_at = None
                self._send_again(end, way)
                if self.ends[1 - end] and not self.ends[end]:
                    self._close_later(1 - end)

    def _cut(self, end: int, way: _Way) -> None:
        world, rng = self.fabric.world, self.fabric.rng
        way.cut_at = world.now
        way.window, way.unanswered = rng.randint(*WINDOW), self._path(end)
        way.heard_at = max(way.heard_at, world.now - rng.uniform(0.0, KEEP_ALIVE_S))
        if not way.kept:  # the next keep-alive
            life, begun = self._life, way.cut_at
            world.after(rng.uniform(0.0, KEEP_ALIVE_S), lambda: self._keep_alive(end, life, begun))
        self._watch(end, way.heard_at, self._life)

    def _keep_alive(self, end: int, life: int, begun: float) -> None:
        way = self._ways[end]
        if life == self._life and way.cut_at == begun and not way.kept:
            self.carry(end, "alive", 0, lambda: None, droppable=False)

    def _watch(self, end: int, heard_at: float, life: int) -> None:
        """Let the other end give up when it has heard nothing for the lease."""

        def look() -> None:
            way = self._ways[end]
            if life != self._life or not self.up:
                return
            if way.heard_at > heard_at:
                self._watch(end, way.heard_at, life)
            elif self._path(end) and (way.cut_at is None or way.window > 0) and not way.kept:
                way.heard_at = self.fabric.world.now
                if way.cut_at is not None:
                    self._watch(end, way.heard_at, life)
            else:
                self.give_up(1 - end)

        self.fabric.world.at(max(self.fabric.world.now, heard_at + LEASE_S), look)

    def _again_at(self, way: _Way) -> float:
        """Return when TCP sends again what it keeps."""
        now, rto_s = self.fabric.world.now, self.fabric.rng.uniform(*RTO_S)
        when = way.kept_since + rto_s
        while when < now:
            rto_s *= 2
            when += rto_s
        return self.fabric.rng.uniform(now, max(when, now + 0.5)) if way.unanswered else when

    def _send_again(self, end: int, way: _Way) -> None:
        if way.kept:
            life = self._life
            self.fabric.world.at(self._again_at(way), lambda: self._flush(end, life))

    def _flush(self, end: int, life: int) -> None:
        way = self._ways[end]
        if life == self._life and self.up and self._flows:
            kept, way.kept = way.kept, []
            for message in kept:
                self._send(end, message)

    # The end, and the return

    def give_up(self, end: int) -> None:
        """Let one end give the link up; the other one learns of it."""
        if not self.ends[end]:
            return
        if self.ends[1 - end]:
            if self._path(end) and not self._ways[end].kept:
                life = self._life
                delay_s = self.fabric.paths.delay(self.hosts[end], self.hosts[1 - end])
                self.fabric.world.after(delay_s, lambda: self._end(1 - end) if life == self._life else None)
            else:
                self._outlive(1 - end)
        self._end(end)

    def _outlive(self, end: int) -> None:
        """Let an end that was told nothing give up by itself, by its own lease."""
        world, life = self.fabric.world, self._life
        due = max(world.now, self._ways[1 - end].heard_at + LEASE_S)
        world.at(due, lambda: self._end(end) if life == self._life else None)

    def _close_later(self, end: int) -> None:
        """Let an end learn, now that the path is back, that the other one has gone."""
        way, life = self._ways[1 - end], self._life
        now = self.fabric.world.now
        when = self._again_at(way) if way.kept_since else now + 0.5
        self.fabric.world.at(self.fabric.rng.uniform(now, when), lambda: self._end(end) if life == self._life else None)

    def drop(self, *, stays: bool = False) -> None:
        """End the link: both ends notice. stays: until :meth:`restore`."""
        self._stays_down = stays
        for end in (0, 1):
            self._end(end)

    def lock(self) -> None:
        """End the link for good, as eclipse-zenoh/zenoh#1876 does: only another session helps."""
        self.locked = True
        self.drop(stays=True)

    def _end(self, end: int) -> None:
        if not self.ends[end]:
            return
        self.ends[end] = False
        self.fabric.world.note("bus", "link lost", *self.hosts, end)
        if end == 0:
            way = self._ways[0]
            self._blocked_until = self._again_at(way) if self.ends[1] and self._flows and way.kept else 0.0
            self._again(self.fabric.rng.uniform(0.0, 0.05), self.fabric.rng.uniform(*self._retry.first_s))
        self._changed(end, False)

    def _again(self, after_s: float, period_s: float) -> None:
        """Try to connect after so long; then, in longer and longer times, again."""
        life = self._life

        def attempt() -> None:
            if life == self._life and not self.ends[0]:
                self._attempt(period_s, 0)

        self._later(after_s, attempt)

    def _attempt(self, period_s: float, repeated: int) -> None:
        """Try once. repeated: how often the kernel has repeated it."""
        fabric, life = self.fabric, self._life
        most_s = fabric.rng.uniform(*self._retry.most_s)
        following_s = min(most_s, period_s * self._retry.factor)
        if not self._flows:
            if repeated == len(SYN_S):
                self._again(max(0.0, OPEN_S - sum(SYN_S)) + period_s, following_s)
                return
            wait_s = SYN_S[repeated] * fabric.rng.uniform(0.9, 1.1)

            def once_more() -> None:
                if life == self._life and not self.ends[0]:
                    self._attempt(period_s, repeated + 1)

            self._later(wait_s, once_more)
        elif self._stays_down or not fabric.routers[self.hosts[1]].up or not self._router_here():
            self._again(period_s, following_s)
        elif fabric.world.now < self._blocked_until:
            self._again(self._blocked_until - fabric.world.now + 0.02, following_s)
        else:
            self._later(fabric.rng.uniform(0.01, 0.05), self.restore)

    def _router_here(self) -> bool:
        own = self.fabric.routers.get(self.hosts[0])
        return own is None or own.up or self is not self.fabric.between

    def restore(self) -> None:
        """Make the link anew, if the paths allow it."""
        self._stays_down = self.locked
        if self.locked or self.ends[0] or not self._flows or not self.fabric.routers[self.hosts[1]].up:
            return
        self._end(1)
        self._life += 1
        self._ways = self._new_ways()
        self.ends = [True, True]
        self.fabric.world.note("bus", "link back", *self.hosts)
        self._changed(1, True)
        self._changed(0, True)
