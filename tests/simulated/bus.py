"""A simulated Zenoh: sessions, two routers, and what goes wrong between them.

Theory of operation. Each session is linked to one router, the routers to each other (:mod:`tests.simulated.bus_link`).
A message goes from link to link. Order holds for one publisher and one key. A router knows the tokens of its sessions
and those that the other router told it; news of tokens travel as messages, and may be late besides. What happened to a
link is known at each of its ends at its own time. ``python -m tests.simulated.bus_validation`` compares all of this
with real Zenoh; docs/explanation/reliability.md says what was measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.simulated.bus_link import LEASE_S, ROUTERS, SESSIONS, Link
from tests.simulated.engine import Process, World
from tests.simulated.net import Paths

NEWS_S = 0.01
"""Most seconds until tokens and declarations are known elsewhere."""
_TOKEN_BYTES = 64

Token = tuple[str, str]
"""The id of a session, and the key of its token."""


class Router:
    """One router. tokens: those of its own sessions, and those that the other router told it."""

    def __init__(self, fabric: Fabric, name: str) -> None:
        self.name = name
        self.up = True
        self.tokens: dict[Token, bool] = {}
        """Of each token, whether it came from the other router."""
        self._fabric = fabric

    @property
    def sessions(self) -> list[SimSession]:
        """The sessions that it takes for connected."""
        return [each for each in self._fabric.sessions if each.router == self.name and each.link.ends[1]]

    def learn(self, token: Token, alive: bool, *, beyond: bool = False) -> None:
        """Take news of a token, and pass it on. beyond: it came from the other router."""
        if (token in self.tokens) is alive:
            return
        if alive:
            self.tokens[token] = beyond
        else:
            del self.tokens[token]
        for session in self.sessions:
            if session.zid != token[0]:
                self._carry(session.link, 1, lambda session=session: session.learn(token, alive))
        if not beyond:
            other = self._fabric.other(self)
            self._carry(self._fabric.between, self._fabric.end_of(self), lambda: other.learn(token, alive, beyond=True))

    def forget(self, wanted: Callable[[Token, bool], bool]) -> None:
        """Forget tokens: those that a lost link brought."""
        for token, beyond in tuple(self.tokens.items()):
            if wanted(token, beyond):
                self.learn(token, False, beyond=beyond)

    def tell_all(self, link: Link, end: int, tell: Callable[[Token], None], *, own: bool) -> None:
        """Tell who was linked anew of the tokens. own: only those of this router's own sessions."""
        for token, beyond in tuple(self.tokens.items()):
            if not (own and beyond):
                self._carry(link, end, lambda token=token: tell(token))

    def _carry(self, link: Link, end: int, deliver: Callable[[], None]) -> None:
        link.carry(end, "news", _TOKEN_BYTES, deliver, droppable=False)


class Fabric:
    """All sessions and routers. ``log``: what the checker reads."""

    def __init__(self, world: World, paths: Paths) -> None:
        self.world = world
        self.paths = paths
        self.rng = world.rng("bus")
        self.sessions: list[SimSession] = []
        self.on_put: list[Callable[[str, str, bytes], None]] = []
        self.routers = {name: Router(self, name) for name in ("router1", "router2")}
        self.between = Link(self, ("router1", "router2"), world.after, ROUTERS, self._between_changed)
        self.news_late_s = 0.0
        """Added to the delay of liveliness news, at most."""
        self.news_lost = 0.0
        """The part of liveliness news that a session never gets."""
        self.duplicates = 0.0
        self.reorders = False
        """Whether commands on different keys overtake each other."""
        self.asked: list[Any] = []
        """Queries that are under way."""
        self._number = 0
        paths.healed.append(lambda here, there: self.follow())

    def number(self) -> int:
        """Return a number of its own."""
        self._number += 1
        return self._number

    def session_id(self) -> str:
        """Return an id for a new session."""
        return f"{self.rng.getrandbits(48):012x}"

    def other(self, router: Router) -> Router:
        """Return the other router."""
        return self.routers["router2" if router.name == "router1" else "router1"]

    def end_of(self, router: Router) -> int:
        """Return which end of the link between the routers is this router's."""
        return int(router.name == "router2")

    def follow(self) -> None:
        """Follow the paths after they changed."""
        self.between.follow()
        for session in tuple(self.sessions):
            session.link.follow()

    def kill_router(self, name: str) -> None:
        """End a router: its links end, and nobody returns before it is started again."""
        router = self.routers[name]
        router.up = False
        router.tokens.clear()
        for link in self._links_of(name):
            link.drop()

    def start_router(self, name: str) -> None:
        """Start a router."""
        self.routers[name].up = True

    def _links_of(self, router: str) -> list[Link]:
        return [each.link for each in self.sessions if each.router == router] + [self.between]

    def _between_changed(self, end: int, up: bool) -> None:
        """Follow what an end of the link between the routers came to know."""
        router = self.routers[("router1", "router2")[end]]
        if up:
            other = self.other(router)
            router.tell_all(self.between, end, lambda token: other.learn(token, True, beyond=True), own=True)
        else:
            router.forget(lambda token, beyond: beyond)
        self.end_questions()

    def end_questions(self) -> None:
        """End the queries that wait for an answerer whose link is known to be lost."""
        for asked in tuple(self.asked):
            asked.give_up_lost()

    def linked(self, one: SimSession, other: SimSession) -> bool:
        """Whether, as the asker's side knows, there are links between two sessions."""
        if one is other:
            return True
        if not (one.link.ends[0] and other.link.ends[1]):
            return False
        return one.router == other.router or self.between.ends[self.end_of(self.routers[one.router])]

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

    def accepts(self, host: str, router: str) -> bool:
        """Whether a new session connects."""
        return self.routers[router].up and self.paths.up(host, router) and self.paths.up(router, host)

    def carry(
        self, one: SimSession, other: SimSession, order: str, size: int, deliver: Callable[[], None], *, droppable: bool
    ) -> None:
        """Carry a message between two sessions, link by link."""
        if one is other:
            self.world.after(1e-5, deliver)
            return

        def last() -> None:
            other.link.carry(1, order, size, deliver, droppable=droppable)

        def middle() -> None:
            if one.router == other.router:
                last()
            else:
                end = self.end_of(self.routers[one.router])
                self.between.carry(end, order, size, last, droppable=droppable)

        one.link.carry(0, order, size, middle, droppable=droppable)


class SimSession:
    """The Zenoh session of one process."""

    def __init__(self, fabric: Fabric, process: Process, router: str) -> None:
        self.fabric = fabric
        self.process = process
        self.zid = fabric.session_id()
        self.host = process.host.name
        self.router = router
        self.open = True
        self.link = Link(fabric, (self.host, router), process.after, SESSIONS, self._link_changed)
        self.tokens: list[str] = []
        self.known: set[Token] = set()
        """Tokens that this session was told of, its own included."""
        self.buses: list[Any] = []
        self._late: dict[Token, float] = {}
        self._frozen_at: float | None = None
        fabric.sessions.append(self)
        process.on_death.append(self.died)
        process.on_pause.append(self._on_pause)
        fabric.world.after(0.005, self._begin)

    def _begin(self) -> None:
        self.link.follow()
        self._link_changed(1, self.link.ends[1])

    @property
    def at(self) -> Router:
        """Its router."""
        return self.fabric.routers[self.router]

    def _on_pause(self, paused: bool) -> None:
        """A session that is frozen for longer than the lease is given up by its router."""
        world = self.fabric.world
        self._frozen_at = begun = world.now if paused else None
        if paused:
            quiet_s = self.link.silent_s()

            def give_up() -> None:
                if self._frozen_at == begun and self.open:
                    self.link.give_up(1)

            world.after(LEASE_S - quiet_s, give_up)

    def died(self) -> None:
        """The process is gone: the router notices at once, if its path works."""
        self.fabric.world.after(0.002, self._gone)

    def close(self) -> None:
        """Leave the bus."""
        self._gone()

    def _gone(self) -> None:
        if self.open:
            self.open = False
            self.tokens.clear()
            self.link.give_up(0)
            if not self.link.ends[1]:
                self._leave()

    def _leave(self) -> None:
        if self in self.fabric.sessions:
            self.fabric.sessions.remove(self)

    def _link_changed(self, end: int, up: bool) -> None:
        """Follow what an end of the link came to know: 0 is the session's, 1 the router's."""
        if end == 1:
            if up:
                self.at.tell_all(self.link, 1, lambda token: self.learn(token, True), own=False)
            else:
                self.at.forget(lambda token, _: token[0] == self.zid)
                if not self.open:
                    self._leave()
        elif self.open:
            delay_s = self.fabric.rng.random() * 0.005
            self.process.after(delay_s, lambda: [bus.told_connected(self.link.ends[0]) for bus in tuple(self.buses)])
            if up:
                for key in self.tokens:
                    self._announce(key, True)
            else:
                for token in [each for each in self.known if each[0] != self.zid]:
                    self._change(token, False)
        self.fabric.end_questions()

    # Tokens

    def learn(self, token: Token, alive: bool) -> None:
        """Take news of another session's token from the router."""
        if self.open and token[0] != self.zid:
            self._change(token, alive)

    def _change(self, token: Token, alive: bool) -> None:
        """Tell the watchers of a token, where that is news: of several sessions' same tokens only one counts."""
        key = token[1]
        before = any(known[1] == key for known in self.known)
        (self.known.add if alive else self.known.discard)(token)
        if any(known[1] == key for known in self.known) is before:
            return
        fabric, world, rng = self.fabric, self.fabric.world, self.fabric.rng
        if rng.random() < fabric.news_lost:
            world.note("bus", "news lost", self.process.name, key, alive)
            return
        late_s = rng.random() * NEWS_S + (rng.random() * fabric.news_late_s if fabric.news_late_s else 0.0)
        when = max(world.now + late_s, self._late.get(token, 0.0))
        self._late[token] = when

        def tell() -> None:
            for bus in tuple(self.buses):
                bus.told_alive(key, alive)

        world.at(when, lambda: self.process.after(0.0, tell))

    def _announce(self, key: str, alive: bool) -> None:
        token = (self.zid, key)
        self.link.carry(0, "news", _TOKEN_BYTES, lambda: self.at.learn(token, alive), droppable=False)

    def declare_token(self, key: str) -> None:
        self.tokens.append(key)
        self.fabric.world.note(self.process.name, "announces", key)
        self._change((self.zid, key), True)
        self._announce(key, True)

    def undeclare_token(self, key: str) -> None:
        if key in self.tokens:
            self.tokens.remove(key)
            self.fabric.world.note(self.process.name, "withdraws", key)
            self._change((self.zid, key), False)
            self._announce(key, False)
