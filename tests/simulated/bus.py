"""A simulated Zenoh: sessions, two routers, and what goes wrong between them.

Theory of operation. Each session is linked to one router, the routers to each other. A message goes from link to link;
a link that is *cut* keeps what it is given (commands that may be dropped: only so many bytes), and delivers it in order
and at once when it heals. A cut of more than LEASE_S, or a *reset*, ends the link: both ends notice, what it kept is
lost, and the session returns RETURN_S after the link works again. Order holds for one publisher and one key. What a
session knows of others' tokens and queryables follows with a delay, and news may be late.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.simulated.engine import Process, World
from tests.simulated.net import Paths

LEASE_S = 10.0
"""Seconds of silence after which a link is given up."""
RETURN_S = 1.0
"""Most seconds until a session finds a router again."""
NEWS_S = 0.01
"""Most seconds until tokens and declarations are known elsewhere."""
DROP_BYTES = 8_192
"""Bytes that a link keeps of messages that may be dropped, while it takes nothing."""


class Link:
    """One link: of a session to its router, or between the routers. ``here``, ``there``: hosts."""

    def __init__(self, fabric: Fabric, here: str, there: str) -> None:
        self.fabric = fabric
        self.here, self.there = here, there
        self.up = True
        self._kept: list[tuple[str, str, int, Callable[[], None], bool]] = []
        self._last: dict[tuple[str, str], float] = {}
        self._stalled_at: float | None = None

    def works(self, source: str, target: str) -> bool:
        return self.fabric.paths.up(source, target)

    @property
    def whole(self) -> bool:
        """Whether it is up and lets everything through."""
        return self.up and self.works(self.here, self.there) and self.works(self.there, self.here)

    def carry(self, source: str, order: str, size: int, deliver: Callable[[], None], *, droppable: bool) -> None:
        """Carry a message from one end to the other."""
        if not self.up:
            return
        target = self.there if source == self.here else self.here
        if not self.works(source, target) or self._kept:
            kept = sum(each[2] for each in self._kept if each[4])
            if not droppable or kept + size <= DROP_BYTES:
                self._kept.append((source, order, size, deliver, droppable))
            return
        world = self.fabric.world
        when = max(self._last.get((source, order), 0.0), world.now + self.fabric.paths.delay(source, target))
        self._last[source, order] = when
        world.at(when, lambda: self._arrive(source, order, size, deliver, droppable))

    def _arrive(self, source: str, order: str, size: int, deliver: Callable[[], None], droppable: bool) -> None:
        target = self.there if source == self.here else self.here
        if not self.up:
            return
        if not self.works(source, target):
            self._kept.append((source, order, size, deliver, droppable))
            return
        deliver()

    def changed(self) -> None:
        """Follow the paths: begin to stall, or deliver what was kept."""
        world = self.fabric.world
        works = self.works(self.here, self.there) and self.works(self.there, self.here)
        if not works and self._stalled_at is None:
            self._stalled_at = begun = world.now

            def give_up() -> None:
                if self._stalled_at == begun and self.up:
                    self.drop()

            world.after(LEASE_S, give_up)
        elif works and self._stalled_at is not None:
            self._stalled_at = None
            if self.up:
                world.after(self.fabric.rng.uniform(0.0, 0.5), self._flush)
            else:
                world.after(self.fabric.rng.uniform(0.1, RETURN_S), self.restore)

    def _flush(self) -> None:
        kept, self._kept = self._kept, []
        for source, order, size, deliver, droppable in kept:
            self.carry(source, order, size, deliver, droppable=droppable)

    def drop(self) -> None:
        """End the link: both ends notice."""
        if self.up:
            self.up = False
            self._kept.clear()
            self._last.clear()
            self.fabric.world.note("bus", "link lost", self.here, self.there)
            self.fabric.link_changed(self)

    def restore(self) -> None:
        """Make the link anew."""
        works = self.works(self.here, self.there) and self.works(self.there, self.here)
        if not self.up and works and self._stalled_at is None:
            self.up = True
            self.fabric.world.note("bus", "link back", self.here, self.there)
            self.fabric.link_changed(self)


class Fabric:
    """All sessions and routers. ``log``: what the checker reads."""

    def __init__(self, world: World, paths: Paths) -> None:
        self.world = world
        self.paths = paths
        self.rng = world.rng("bus")
        self.sessions: list[SimSession] = []
        self.on_put: list[Callable[[str, str, bytes], None]] = []
        self.between = Link(self, "router1", "router2")
        self.news_late_s = 0.0
        """Added to the delay of liveliness news, at most."""
        self.news_lost = 0.0
        """The part of liveliness news that a session never gets."""
        self.duplicates = 0.0
        self.reorders = False
        """Whether commands on different keys overtake each other."""
        self._number = 0
        paths.healed.append(lambda here, there: self.follow())

    def number(self) -> int:
        """Return a number of its own."""
        self._number += 1
        return self._number

    def session_id(self) -> str:
        """Return an id for a new session."""
        return f"{self.rng.getrandbits(48):012x}"

    def follow(self) -> None:
        """Follow the paths after they changed."""
        self.between.changed()
        for session in self.sessions:
            session.link.changed()

    def link_changed(self, link: Link) -> None:
        """Tell the session that lost or found its router, and all of the tokens that came or went."""
        for session in self.sessions:
            if session.link is link:
                session.connected_changed(link.up)
        self.spread()

    def reaches(self, one: SimSession, other: SimSession) -> bool:
        """Whether there are links between two sessions, working or not."""
        if one is other:
            return True
        same = one.router == other.router
        return one.link.up and other.link.up and (same or self.between.up) and one.open and other.open

    def works(self, one: SimSession, other: SimSession) -> bool:
        """Whether messages get through now."""
        if one is other:
            return True
        same = one.router == other.router
        return self.reaches(one, other) and one.link.whole and other.link.whole and (same or self.between.whole)

    def carry(
        self, one: SimSession, other: SimSession, order: str, size: int, deliver: Callable[[], None], *, droppable: bool
    ) -> None:
        """Carry a message between two sessions, link by link."""
        if one is other:
            self.world.after(1e-5, deliver)
            return

        def last() -> None:
            other.link.carry(other.router, order, size, deliver, droppable=droppable)

        def middle() -> None:
            if one.router == other.router:
                last()
            else:
                self.between.carry(one.router, order, size, last, droppable=droppable)

        one.link.carry(one.host, order, size, middle, droppable=droppable)

    def spread(self) -> None:
        """Let all sessions know of tokens that came or went."""
        for session in self.sessions:
            if session.open:
                session.compare_tokens()


class SimSession:
    """The Zenoh session of one process."""

    def __init__(self, fabric: Fabric, process: Process, router: str) -> None:
        self.fabric = fabric
        self.process = process
        self.zid = fabric.session_id()
        self.host = process.host.name
        self.router = router
        self.open = True
        self.link = Link(fabric, self.host, router)
        self.tokens: list[str] = []
        self.known: dict[tuple[str, str], bool] = {}
        """Tokens of all sessions that this one was told of, by zid and key."""
        self.buses: list[Any] = []
        self._pending: dict[tuple[str, str], float] = {}
        self._frozen_at: float | None = None
        fabric.sessions.append(self)
        process.on_death.append(self.died)
        process.on_pause.append(self._on_pause)
        fabric.world.after(0.005, self.link.changed)

    def _on_pause(self, paused: bool) -> None:
        """A session that is frozen for longer than the lease is given up by its router."""
        world = self.fabric.world
        self._frozen_at = world.now if paused else None
        begun = world.now
        if paused:
            world.after(LEASE_S, lambda: self.link.drop() if self._frozen_at == begun and self.open else None)
        elif not self.link.up:
            world.after(self.fabric.rng.uniform(0.1, RETURN_S), self.link.restore)

    def died(self) -> None:
        """The process is gone: the router notices at once."""
        self.fabric.world.after(0.002, self.close)

    def close(self) -> None:
        """Leave the bus."""
        if self.open:
            self.open = False
            self.tokens.clear()
            self.fabric.sessions.remove(self)
            self.fabric.spread()

    def connected_changed(self, up: bool) -> None:
        delay_s = self.fabric.rng.random() * 0.005
        self.process.after(delay_s, lambda: [bus.told_connected(self.link.up) for bus in tuple(self.buses)])

    # Tokens

    def visible(self) -> dict[tuple[str, str], bool]:
        """Return the tokens that the router would name now."""
        return {
            (other.zid, token): True
            for other in self.fabric.sessions
            if self.fabric.reaches(self, other)
            for token in other.tokens
        }

    def compare_tokens(self) -> None:
        """Tell the watchers, after a while, of what came and went."""
        visible, rng = self.visible(), self.fabric.rng
        for entry in [entry for entry in visible if entry not in self.known]:
            self.known[entry] = True
            self._tell(entry, True, rng)
        for entry in [entry for entry in self.known if entry not in visible]:
            del self.known[entry]
            self._tell(entry, False, rng)

    def _tell(self, entry: tuple[str, str], alive: bool, rng: Any) -> None:
        if rng.random() < self.fabric.news_lost:
            self.fabric.world.note("bus", "news lost", self.process.name, entry[1], alive)
            return
        world = self.fabric.world
        late_s = rng.random() * NEWS_S + (rng.random() * self.fabric.news_late_s if self.fabric.news_late_s else 0.0)
        when = max(world.now + late_s, self._pending.get(entry, 0.0))
        self._pending[entry] = when
        key = entry[1]

        def tell() -> None:
            for bus in tuple(self.buses):
                bus.told_alive(key, alive)

        world.at(when, lambda: self.process.after(0.0, tell))

    def declare_token(self, key: str) -> None:
        self.tokens.append(key)
        self.fabric.world.note(self.process.name, "announces", key)
        self.fabric.spread()

    def undeclare_token(self, key: str) -> None:
        if key in self.tokens:
            self.tokens.remove(key)
            self.fabric.world.note(self.process.name, "withdraws", key)
            self.fabric.spread()
