"""One gateway per robot: whoever comes second finds the first one's claim, waits for it to go, and says so.

A claim is an answered query: for how long its gateway has served the robot, and whether it *has* it, that is, whether
it ever reached it since. Whose claim it is, the bus tells (the replier), never a payload. The liveliness token beside
it shows others sooner that there may be one; without a claim behind it, it means nothing.

Taking the robot: no other claim may be found. Two that start at the same moment both find none. So each announces its
own claim, waits until the other's must have come, and only then asks; of two that serve nothing yet, the lower session
id goes on.

Keeping it: a gateway that has its robot lets go of it for nobody, whatever others answer; it tells of them. One that
never reached it lets go for one with a better claim: that has it, or has served it longer, or has the lower id. So
after two were cut off from one another the one that has the robot keeps it, and where both have it both tell.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable

import msgspec

from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.errors import BusError
from zbridge.fleet.topics import KeySpace

log = logging.getLogger("zbridge.app.gateway")

LOOK_S = 0.25
"""Seconds between two looks at a token that should go."""
LOOKS = 3
"""Looks in a row that must find nobody after somebody was seen or the bus was gone; or no claim behind a token."""
SETTLE_S = 0.25
"""Longest wait for the bus to show whom it already has."""
ANNOUNCE_S = 0.1
"""Seconds that a claim is given to get about before others are asked for theirs."""
ASK_S = 1.0
"""Longest wait for the claims of others."""
WATCH_S = 5.0
"""Seconds between two looks for others while the robot is served."""
RIVALS = 16
"""Others that are considered at a time, those with the best claims."""
MOST_S = 10 * 365 * 86_400.0
"""Seconds that a robot can have been served: ten years."""
_WHO = "gateway"
_CLAIM = "@rpc/claim/gateway"


class _Served(msgspec.Struct):
    """A claim. held_s: seconds for which the robot was served, 0 while it is not; has: whether it was ever reached."""

    held_s: float = 0.0
    has: bool = False

    @property
    def plausible(self) -> bool:
        return math.isfinite(self.held_s) and 0 <= self.held_s <= MOST_S and (self.held_s > 0 or not self.has)

    def better_than(self, other: _Served, zid: str, other_zid: str) -> bool:
        return (self.has, self.held_s, other_zid) > (other.has, other.held_s, zid)


_read = msgspec.msgpack.Decoder(_Served).decode
_write = msgspec.msgpack.Encoder().encode


class Ownership:
    """The right to be a robot's gateway; held from :meth:`take` until :meth:`release`, or the end of :meth:`watch`."""

    def __init__(self, bus: Bus, keys: KeySpace, clock: Callable[[], float] = time.monotonic) -> None:
        self._bus = bus
        self._keys = keys
        self._clock = clock
        self._handles: list[Handle] = []
        self._held_since: float | None = None
        self._has: Callable[[], bool] = lambda: False
        self._connected = asyncio.Event()
        self._was_connected = False
        self._came = asyncio.Event()
        self._watch: Handle | None = None

    def __repr__(self) -> str:
        return f"<Ownership {self._keys.robot} {'held' if self._held_since is not None else 'not held'}>"

    async def take(self) -> None:
        """Wait until no other gateway claims the robot, then be its gateway.

        On a bus that was there and is gone nobody can be seen, so nothing is taken; and after somebody was
        seen, or the bus came back, several looks in a row must find nobody.
        """
        await self._settle()
        others = _Others(self._keys.robot)
        looks = 1
        while True:
            bus_gone = self._was_connected and not self._connected.is_set()
            if bus_gone or await self._sees(others):
                looks = LOOKS
            else:
                looks -= 1
                if looks <= 0:
                    self._announce()
                    await asyncio.sleep(ANNOUNCE_S)
                    if await self._wins():
                        self._held_since = self._clock()
                        return
                    self.release()
                    looks = LOOKS
            await asyncio.sleep(LOOK_S if looks else 0)

    async def watch(self, has: Callable[[], bool], tell: Callable[[tuple[str, ...]], object]) -> None:
        """Look for other gateways that serve the robot; return when it must be left to one of them.

        has: whether the robot was ever reached; then it is left to nobody. tell: is given the ids of the others that
        serve it, every time that was looked.
        """
        self._has = has
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(WATCH_S):
                    await self._came.wait()
            self._came.clear()
            await asyncio.sleep(LOOK_S)
            own = self._own()
            with contextlib.suppress(BusError):
                serving = {zid: claim for zid, claim in (await self._claims()).items() if claim.held_s}
                if not has() and any(claim.better_than(own, zid, self._bus.zid) for zid, claim in serving.items()):
                    log.error("another gateway served %s before this one: leaving it alone", self._keys.robot)
                    self.release()
                    return
                tell(tuple(serving))

    def release(self) -> None:
        """Give the claim up; idempotent."""
        handles, self._handles = self._handles, []
        self._held_since, self._has = None, lambda: False
        for handle in handles:
            handle.close()

    async def _settle(self) -> None:
        if self._watch is None:
            self._watch = self._bus.watch_connected(self._on_connected)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SETTLE_S):
                await self._connected.wait()

    def _on_connected(self, up: bool) -> None:
        self._was_connected = self._was_connected or up
        if not up:
            self._connected.clear()
        elif not self._connected.is_set():
            self._connected.set()
            self._came.set()

    def _announce(self) -> None:
        self._handles = [
            self._bus.answer(self._keys.key(_CLAIM), self._on_question),
            self._bus.announce(self._keys.alive(_WHO)),
        ]

    async def _sees(self, others: _Others) -> bool:
        """Look for a token, and for the claim behind it."""
        token = bool(await self._bus.alive(self._keys.alive(_WHO)))
        return others.seen(token, bool(token and await self._claims()))

    async def _wins(self) -> bool:
        """Tell whether nobody has a better claim."""
        own = self._own()
        return not any(claim.better_than(own, zid, self._bus.zid) for zid, claim in (await self._claims()).items())

    async def _claims(self) -> dict[str, _Served]:
        """Ask for the claims of others, by the ids of their sessions; what nobody can claim is no claim."""
        claims: list[tuple[_Served, str]] = []
        heard = {self._bus.zid}
        for answer in await self._bus.ask(self._keys.key(_CLAIM), timeout_s=ASK_S):
            if answer.replier is None or answer.replier in heard:
                continue
            heard.add(answer.replier)
            with contextlib.suppress(msgspec.MsgspecError, RecursionError):
                claim = _read(answer.payload)
                if answer.error is None and claim.plausible:
                    claims.append((claim, answer.replier))
        claims.sort(key=lambda each: (not each[0].has, -each[0].held_s, each[1]))
        return {zid: claim for claim, zid in claims[:RIVALS]}

    def _own(self) -> _Served:
        if self._held_since is None:
            return _Served()
        return _Served(max(self._clock() - self._held_since, 1e-3), self._has())

    def _on_question(self, question: IncomingQuery) -> None:
        question.answer(_write(self._own()))


class _Others:
    """What was seen of other gateways while the robot is waited for; each thing is said once."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._without_claim = 0
        self._said: set[str] = set()

    def seen(self, token: bool, claim: bool) -> bool:
        """Tell whether somebody is there; a token without a claim behind it, several times in a row, is nobody."""
        if claim:
            self._without_claim = 0
            self._say("another gateway serves %s: waiting until it goes")
            return True
        self._without_claim = self._without_claim + 1 if token else 0
        if self._without_claim == LOOKS:
            self._say("there is a token of a gateway of %s and no gateway that answers: it is ignored")
        return 0 < self._without_claim < LOOKS

    def _say(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            log.warning(text, self._robot)
