"""The robots on the bus, for programs that watch and drive them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import AsyncIterator, Callable, Iterable, Iterator

from zbridge.bus import Bus, Sample
from zbridge.client import stops
from zbridge.client.driver import default_who
from zbridge.client.feed import Feed
from zbridge.client.fleet_model import FleetModel, watch
from zbridge.client.robot import Robot, attempts_of_process
from zbridge.client.settled import settled
from zbridge.client.stops import Outcome
from zbridge.clocks import raw_ms
from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Status, Stop
from zbridge.fleet.processes import SessionEntry, Sessions
from zbridge.fleet.topics import KeySpace, is_name, split_key


class Fleet:
    """All robots of one realm: ``fleet["r1"]``. name: of this program on a secure bus, as its certificate says.

    clock_ms: the raw clock, which dates commands. attempts: numbers the requests for a lease of this bus session.
    secret: returns the given number of random bytes.
    """

    def __init__(
        self,
        bus: Bus,
        realm: str = "fleet",
        name: str | None = None,
        *,
        clock_ms: Callable[[], float] = raw_ms,
        attempts: Iterator[int] = attempts_of_process,
        secret: Callable[[int], bytes] = os.urandom,
    ) -> None:
        self._machine = (clock_ms, attempts, secret)
        self._secret = secret
        self.realm = realm
        self.name = name
        self._bus = bus

    def __repr__(self) -> str:
        return f"<Fleet {self.realm}>"

    def __getitem__(self, name: str) -> Robot:
        """Return the robot of this name, whether or not it is on the bus; raise ValueError if it cannot be a name."""
        if not is_name(name):
            raise ValueError(f"robot {name!r}: expected letters, digits, '_', '.' and '-' only")
        return Robot(self._bus, KeySpace(self.realm, name), self.name, *self._machine)

    async def robots(self) -> dict[str, Status | None]:
        """Return the robots that have a gateway or a status, by name; None for a robot without a status.

        While gateways join or rejoin the bus, a result may be partial: the query is repeated until two results in a row
        name the same robots with a status each, for at most three seconds.
        """
        robots = await settled(self._query_robots, lambda seen: seen.keys() if all(seen.values()) else None)
        return dict(sorted(robots.items()))

    async def _query_robots(self) -> dict[str, Status | None]:
        robots: dict[str, Status | None] = dict.fromkeys(await self._gateways())
        for answer in await self._bus.ask(f"{self.realm}/*/{topics.STATUS.path}"):
            split = split_key(answer.key)
            if split is not None and answer.error is None:
                with contextlib.suppress(PayloadError):
                    robots[split[1]] = payloads.decode(Status, answer.payload)
        return robots

    async def _gateways(self) -> set[str]:
        tokens = await self._bus.alive(f"{self.realm}/*/@alive/gateway")
        return {split[1] for key in tokens if (split := split_key(key))}

    async def statuses(self, robot: str | None = None) -> AsyncIterator[tuple[str, Status]]:
        """Iterate over the statuses that robots, or one robot, publish from now on, with the robots' names."""

        def read(sample: Sample) -> tuple[str, Status]:
            split = split_key(sample.key)
            return (split[1] if split is not None else ""), payloads.decode(Status, sample.payload)

        async for named in Feed(self._bus, f"{self.realm}/{robot or '*'}/{topics.STATUS.path}", read):
            yield named

    def watch(
        self, changed: Callable[[str], None] = lambda name: None, *, lazy: bool = False
    ) -> contextlib.AbstractAsyncContextManager[FleetModel]:
        """Follow the state of all robots, without their streams, while the context lasts.

        changed: called with a robot's name after each message of its gateway. lazy: see :class:`FleetModel`.
        """
        return watch(self._bus, self.realm, changed, lazy=lazy)

    async def sessions(self) -> dict[tuple[str, str], tuple[SessionEntry, ...]]:
        """Return the session tables by robot and process: peers, their states, and what was not translated.

        The query is repeated as that of :meth:`robots` is.
        """
        return {process: table.sessions for process, table in (await self.processes()).items()}

    async def processes(self, robot: str | None = None) -> dict[tuple[str, str], Sessions]:
        """Return what the processes of one robot, or of all, say of themselves: sessions, and what listeners use."""

        async def query() -> dict[tuple[str, str], Sessions]:
            tables: dict[tuple[str, str], Sessions] = {}
            for answer in await self._bus.ask(f"{self.realm}/{robot or '*'}/@rpc/sessions/*"):
                split = split_key(answer.key)
                if split is not None and answer.error is None:
                    with contextlib.suppress(PayloadError):
                        tables[split[1], split[2].rpartition("/")[2]] = payloads.decode(Sessions, answer.payload)
            return tables

        tables = await settled(query, lambda seen: seen.keys())
        return dict(sorted(tables.items()))

    async def stop(self, names: Iterable[str] | None = None, reason: str | None = None) -> dict[str, Outcome]:
        """Stop these robots, or all that have a gateway; return for each the error, None if the stop was confirmed.

        One message stops all at once; then each is stopped by name, and has to confirm it.
        """
        return await self._stop(names, reason, latch=False)

    async def latch(
        self, names: Iterable[str] | None = None, reason: str | None = None, *, also: Iterable[str] = ()
    ) -> dict[str, Outcome]:
        """Stop them as :meth:`stop` does, and prevent driving until they are released.

        also: robots that must confirm a stop of all, even if they have no gateway now.

        A stop of all robots latches the whole fleet: gateways that start later learn of it, and :meth:`unlatch`
        releases it. Named robots are released one by one with :meth:`Robot.unlatch`.
        """
        return await self._stop(names, reason, latch=True, also=also)

    async def unlatch(self) -> dict[str, Outcome]:
        """Release the latched stops of the whole fleet; return for each robot the error, None if it was released."""
        names = filter(is_name, await settled(self._gateways, lambda seen: seen))
        return await stops.unlatch_fleet(self._bus, self.realm, names, self._own)

    async def send_stop(
        self, stop: Stop, names: Iterable[str] | None = None, *, also: Iterable[str] = ()
    ) -> dict[str, Outcome]:
        """Send a prepared stop, for callers that need its id or its sender's name; return as :meth:`stop` does."""
        if names is None:
            await stops.put_stop(self._bus, KeySpace(self.realm, "*"), stop)
            names = {*filter(is_name, await settled(self._gateways, lambda seen: seen))}
            return await stops.stop_robots(self._bus, self.realm, names, stop, absent={*also} - names)
        names = [names] if isinstance(names, str) else names
        return await stops.stop_robots(self._bus, self.realm, names, stop)

    async def _stop(
        self, names: Iterable[str] | None, reason: str | None, *, latch: bool, also: Iterable[str] = ()
    ) -> dict[str, Outcome]:
        return await self.send_stop(
            stops.new_stop(self._own, reason, latch=latch, secret=self._secret), names, also=also
        )

    @property
    def _own(self) -> str:
        return self.name or default_who()
