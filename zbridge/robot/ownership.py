"""Ownership: one gateway per robot. A second gateway finds the first one's claim, waits until it goes, and says so.

A claim is an answered query: for how long its gateway has served the robot, and whether it *has* the robot, that is,
whether it ever reached it since. The bus tells whose claim an answer is (the replier), never a payload. The liveliness
token beside the claim shows sooner that there may be another gateway; without a claim behind it, it means nothing.

Theory of operation. The machine is :attr:`Ownership.TABLE`, ``{state: {input: (action, next state)}}``;
``docs/control.md`` shows the same table, and a test compares both. The gateway awaits :meth:`Ownership.take`, then
runs :meth:`Ownership.watch` beside its device, and calls :meth:`Ownership.release` at its end.

LOOKING: other gateways are looked for. One look that finds none is enough at the start; :data:`LOOKS` in a row after a
gateway was seen or the bus was gone. CLAIMING: the own claim is announced, and other claims are asked for once they
must have come. Two gateways that start at the same moment both find none; of their claims the one of the lower session
id is better. OWNING: the robot is served and was never reached. It is left to a better claim: of a gateway that has
the robot, or has served it longer, or has the lower id. KEEPING: the robot was reached. It is left to nobody, whatever
others answer; they are reported. So after two gateways were cut off from each other the one that has the robot keeps
it, and where both have it both report it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import random
import time
from collections.abc import Callable
from enum import StrEnum
from typing import ClassVar

import msgspec

from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.errors import BusError
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.kept import Exported

log = logging.getLogger("zbridge.app.gateway")

LOOK_S = 0.25
"""Seconds between two looks for other gateways while the robot is not owned."""
LOOKS = 3
"""Looks in a row that must find no gateway after one was seen or the bus was gone, or no claim behind a token."""
SETTLE_S = 0.25
"""Longest wait for the first connection of the bus."""
ANNOUNCE_S = 0.1
"""Seconds between the announcement of a claim and the question for others, so that others have seen it."""
ASK_S = 1.0
"""Longest wait for the claims of others."""
WATCH_S = 5.0
"""Seconds between two looks for others while the robot is served."""
RIVALS = 16
"""Claims of others that are considered at a time: the best."""
MOST_S = 10 * 365 * 86_400.0
"""The longest time for which a robot can have been served, seconds: ten years. Longer claims are ignored."""
_WHO = "gateway"
CLAIM = "@rpc/claim/gateway"
"""The path at which a gateway answers with its claim."""


class _Served(msgspec.Struct):
    """A claim. held_s: seconds since the robot is served, 0 while it is not. has: whether it was reached since."""

    held_s: float = 0.0
    has: bool = False

    @property
    def plausible(self) -> bool:
        return math.isfinite(self.held_s) and 0 <= self.held_s <= MOST_S and (self.held_s > 0 or not self.has)

    def better_than(self, other: _Served, zid: str, other_zid: str) -> bool:
        return (self.has, self.held_s, other_zid) > (other.has, other.held_s, zid)


_read = msgspec.msgpack.Decoder(_Served).decode
_write = msgspec.msgpack.Encoder().encode


class State(StrEnum):
    """How far a gateway has got with a robot."""

    LOOKING = "looking"
    CLAIMING = "claiming"
    OWNING = "owning"
    KEEPING = "keeping"


class Input(StrEnum):
    """What a gateway found."""

    SEEN = "another gateway, or no bus"
    CLEAR = "nobody, look again"
    LAST_CLEAR = "nobody, last look"
    BEST = "no better claim"
    OUTBID = "a better claim"
    REACHED = "robot reached"
    RELEASE = "release"


class Ownership:
    """The right to be a robot's gateway, from :meth:`take` to :meth:`release` or the end of :meth:`watch`."""

    def __init__(self, bus: Bus, keys: KeySpace, clock: Callable[[], float] = time.monotonic) -> None:
        self._bus = bus
        self._keys = keys
        self._clock = clock
        self._state = State.LOOKING
        self._looks = 1
        """Looks that must still find nobody."""
        self._handles: list[Handle] = []
        self._held_since: float | None = None
        self._has: Callable[[], bool] = lambda: False
        self._connected = asyncio.Event()
        self._was_connected = False
        self._came = asyncio.Event()
        self._watch: Handle | None = None
        self.hands_over = False
        """Whether a successor announces the same claim now: it is no rival."""

    def __repr__(self) -> str:
        return f"<Ownership {self._keys.robot} {'held' if self._held_since is not None else 'not held'}>"

    async def take(self) -> None:
        """Wait until no other gateway claims the robot, then own it.

        While a bus that was connected is not, no gateway can be seen, so nothing is taken.
        """
        await self._settle()
        others, self._looks = _Others(self._keys.robot), 1
        while True:
            bus_gone = self._was_connected and not self._connected.is_set()
            if bus_gone or await self._sees(others):
                found = Input.SEEN
            else:
                found = Input.CLEAR if self._looks > 1 else Input.LAST_CLEAR
            if self._handle(found) is State.CLAIMING:
                await asyncio.sleep(ANNOUNCE_S)
                found = Input.OUTBID if self._better(await self._claims()) else Input.BEST
                if self._handle(found) is State.OWNING:
                    return
            await asyncio.sleep(LOOK_S)

    async def watch(self, has: Callable[[], bool], tell: Callable[[tuple[str, ...]], object]) -> None:
        """Look for other gateways that serve the robot; return when the robot must be left to one of them.

        has: whether the robot was ever reached. tell: called after every look with the session ids of the other
        gateways that serve the robot.
        """
        self._has = has
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(WATCH_S):
                    await self._came.wait()
            self._came.clear()
            await asyncio.sleep(random.uniform(1.0, 4.0) * LOOK_S)  # all gateways of a router find their bus at once
            if self.hands_over:
                continue
            with contextlib.suppress(BusError):
                serving = {zid: claim for zid, claim in (await self._claims()).items() if claim.held_s}
                if has():
                    self._handle(Input.REACHED)
                if self._better(serving) and self._handle(Input.OUTBID) is State.LOOKING:
                    log.error("another gateway served %s before this one: leaving it alone", self._keys.robot)
                    return
                tell(tuple(serving))

    def export(self) -> Exported | None:
        """Write the claim for a successor of this gateway; None where the robot is not owned."""
        return None if self._held_since is None else {"since": self._held_since, "has": self._has()}

    def inherit(self, claim: Exported) -> None:
        """Own the robot as the gateway before did, without waiting until it goes; called instead of :meth:`take`."""
        self._announce()
        self._held_since, has = float(claim["since"]), bool(claim["has"])
        self._has = lambda: has
        self._state = State.KEEPING if has else State.OWNING

    def release(self) -> None:
        """Withdraw the claim; idempotent."""
        self._handle(Input.RELEASE)

    # The machine

    def _handle(self, found: Input) -> State:
        """Carry out the table and return the new state. A pair that the table lacks changes nothing."""
        entry = self.TABLE[self._state].get(found)
        if entry is not None:
            action, self._state = entry
            action(self)
        return self._state

    def _look_again(self) -> None:
        self._looks = LOOKS

    def _count(self) -> None:
        self._looks -= 1

    def _announce(self) -> None:
        self._handles = [
            self._bus.answer(self._keys.key(CLAIM), self._on_question),
            self._bus.announce(self._keys.alive(_WHO)),
        ]

    def _own(self) -> None:
        self._held_since = self._clock()

    def _keep(self) -> None:
        """Do nothing: from now on no claim is better."""

    def _withdraw(self) -> None:
        handles, self._handles = self._handles, []
        self._held_since, self._has, self._looks = None, lambda: False, LOOKS
        for handle in handles:
            handle.close()

    # The bus

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

    async def _sees(self, others: _Others) -> bool:
        """Look for a token, and for the claim behind it."""
        token = bool(await self._bus.alive(self._keys.alive(_WHO)))
        return others.seen(token, bool(token and await self._claims()))

    def _better(self, claims: dict[str, _Served]) -> bool:
        """Return whether any of these claims is better than the own one."""
        own = self._claim()
        return any(claim.better_than(own, zid, self._bus.zid) for zid, claim in claims.items())

    async def _claims(self) -> dict[str, _Served]:
        """Ask for the claims of others; return the best by session id. Implausible claims are ignored."""
        claims: list[tuple[_Served, str]] = []
        heard = {self._bus.zid}
        for answer in await self._bus.ask(self._keys.key(CLAIM), timeout_s=ASK_S):
            if answer.replier is None or answer.replier in heard:
                continue
            heard.add(answer.replier)
            with contextlib.suppress(msgspec.MsgspecError, RecursionError):
                claim = _read(answer.payload)
                if answer.error is None and claim.plausible:
                    claims.append((claim, answer.replier))
        claims.sort(key=lambda each: (not each[0].has, -each[0].held_s, each[1]))
        return {zid: claim for claim, zid in claims[:RIVALS]}

    def _claim(self) -> _Served:
        if self._held_since is None:
            return _Served()
        return _Served(max(self._clock() - self._held_since, 1e-3), self._has())

    def _on_question(self, question: IncomingQuery) -> None:
        question.answer(_write(self._claim()))

    TABLE: ClassVar[dict[State, dict[Input, tuple[Callable[[Ownership], None], State]]]] = {
        State.LOOKING: {
            Input.SEEN: (_look_again, State.LOOKING),
            Input.CLEAR: (_count, State.LOOKING),
            Input.LAST_CLEAR: (_announce, State.CLAIMING),
        },
        State.CLAIMING: {
            Input.BEST: (_own, State.OWNING),
            Input.OUTBID: (_withdraw, State.LOOKING),
            Input.RELEASE: (_withdraw, State.LOOKING),
        },
        State.OWNING: {
            Input.OUTBID: (_withdraw, State.LOOKING),
            Input.REACHED: (_keep, State.KEEPING),
            Input.RELEASE: (_withdraw, State.LOOKING),
        },
        State.KEEPING: {
            Input.RELEASE: (_withdraw, State.LOOKING),
        },
    }


class _Others:
    """What was seen of other gateways while the robot is waited for; each finding is logged once."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._without_claim = 0
        self._said: set[str] = set()

    def seen(self, token: bool, claim: bool) -> bool:
        """Return whether there is another gateway. A token without a claim, :data:`LOOKS` times in a row, is none."""
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
