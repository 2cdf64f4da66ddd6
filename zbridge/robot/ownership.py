"""Ownership: one gateway per robot. A second gateway finds the first one's claim, waits until it goes, and says so.

A claim is an answered query (:class:`~zbridge.robot.claim.Claim`). The liveliness token beside the claim shows sooner
that there may be another gateway; without a claim behind it, it means nothing.

Theory of operation. The machine is :attr:`Ownership.TABLE`, ``{state: {input: (action, next state)}}``;
``state-tables.md`` shows the same table, and a test compares both. The gateway awaits :meth:`Ownership.take`, then
runs :meth:`Ownership.watch` beside its device, and calls :meth:`Ownership.release` at its end.

LOOKING: other gateways are looked for. One look that finds none is enough at the start; :data:`LOOKS` in a row after a
gateway was seen or the bus was gone. CLAIMING: the own claim is announced, and other claims are asked for once they
must have come. Two gateways that start at the same moment both find none; of their claims the one of the lower session
id is better. OWNING: the robot is served. After a network that was cut has healed, two may own one robot: the better
claim keeps owning it, and the other leaves the robot alone. YIELDED: to a better claim, but with a connection to the
robot that must not be closed, for many robots accept nobody once a connection has ended. The gateway looks on until no
claim is better, and owns the robot again.

Which claim is better is told by each gateway for itself, of its own claim as it was when it asked, and of the answers.
So a gateway that asks seems a little younger than it is: two never both think themselves better. Both may think the
other one better where their ages are nearly the same; of two that have yielded the lower id resumes.

A gateway asks for claims every :data:`WATCH_S`; every :data:`CLOSE_S` while there may be another one that nobody said
goodbye to. Who is asked by another gateway that serves the robot asks too.
"""

from __future__ import annotations

import asyncio
import math
import random
import time
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import ClassVar, Protocol

import msgspec

from zbridge.bus import Bus
from zbridge.control.latch import LatchRecord
from zbridge.errors import BusError
from zbridge.fleet.topics import KeySpace
from zbridge.log import Log
from zbridge.machine import step
from zbridge.protocol.kept import Exported
from zbridge.robot.claim import LOOKS, Claim, OtherGateways, Standing
from zbridge.robot.claim_bus import ClaimBus

log = Log("zbridge.app.gateway")

LOOK_S = 0.25
"""Seconds between two looks for other gateways while the robot is not owned."""
ANNOUNCE_S = 0.1
"""Seconds between the announcement of a claim and the question for others, so that others have seen it."""


class Served(Protocol):
    """What serves a robot, as :meth:`Ownership.watch` sees it."""

    @property
    def standing(self) -> Standing:
        """How the gateway stands with the robot now."""

    @property
    def must_stay(self) -> bool:
        """Whether there is a connection to the robot that must not be closed."""

    def heard(self, claims: Mapping[str, Claim]) -> None:
        """Take what other gateways that serve the robot claim, by their session ids; after every look."""

    def merge(self, record: LatchRecord) -> None:
        """Take what a gateway knows that does not serve the robot."""

    async def step_aside(self) -> None:
        """Leave the robot to another gateway: stop it, then publish, write and connect nothing."""

    async def step_in(self) -> None:
        """Serve the robot again."""


class OwnershipState(StrEnum):
    """How far a gateway has got with a robot."""

    LOOKING = "looking"
    CLAIMING = "claiming"
    OWNING = "owning"
    YIELDED = "yielded"


class OwnershipInput(StrEnum):
    """What a gateway found."""

    SEEN = "another gateway, or no bus"
    CLEAR = "nobody, look again"
    LAST_CLEAR = "nobody, last look"
    BEST = "no better claim"
    OUTBID = "a better claim"
    OUTBID_CONNECTED = "a better claim, while connected"
    RELEASE = "release"


class Ownership:
    """The right to be a robot's gateway, from :meth:`take` to :meth:`release` or the end of :meth:`watch`.

    mirror: is called with the latched stops of the gateway that owns the robot while this one does not. record: what
    this gateway knows of the robot. chance: 0 to 1.
    """

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        clock: Callable[[], float] = time.monotonic,
        *,
        mirror: Callable[[LatchRecord], object] = lambda record: None,
        record: Callable[[], LatchRecord] = LatchRecord,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._bus = ClaimBus(bus, keys, chance, claim=self._claim, record=record, merge=self._merge)
        self._robot = keys.robot
        self._clock = clock
        self._mirror = mirror
        self._state = OwnershipState.LOOKING
        self._looks = 1
        """Looks that must still find nobody."""
        self._held_since: float | None = None
        self._leaving = False
        self._served: Served | None = None
        """What serves the robot, while others are watched."""
        self._untold = LOOKS
        """Looks for which latched stops are kept from being lost with this gateway's claim."""
        self._close_until = -math.inf
        """Other gateways are looked for every CLOSE_S until then."""
        self.hands_over = False
        """Whether a successor announces the same claim now: it is no rival."""
        self._waits = False
        """Whether the gateway before still serves the robot."""

    def __repr__(self) -> str:
        return f"<Ownership {self._robot} {self._state.value}>"

    async def take(self) -> None:
        """Wait until no other gateway claims the robot, then own it.

        While a bus that was connected is not, no gateway can be seen, so nothing is taken. Nor is anything while
        a successor is handed over to: it has been told that there is no robot to continue.
        """
        await self._bus.settle()
        others, self._looks = OtherGateways(self._robot), 1
        while True:
            if self.hands_over or self._bus.gone or await self._sees(others):
                found = OwnershipInput.SEEN
            else:
                found = OwnershipInput.CLEAR if self._looks > 1 else OwnershipInput.LAST_CLEAR
            if self._handle(found) is OwnershipState.CLAIMING:
                await asyncio.sleep(ANNOUNCE_S)
                outbid = self._bus.outbid(self._claim(), await self._bus.claims())
                found = OwnershipInput.OUTBID if outbid or self.hands_over else OwnershipInput.BEST
                if self._handle(found) is OwnershipState.OWNING:
                    self._close_until = others.close_until(self._clock())
                    return
            await asyncio.sleep(LOOK_S)

    async def watch(self, served: Served) -> None:
        """Poll for other gateways that serve the robot; return when the robot must be left to one of them."""
        self._served = served
        if self.yielded:
            await served.step_aside()
        self._untold = LOOKS
        while True:
            await self._bus.next_look(lambda: self.yielded or self._clock() < self._close_until)
            if not self.hands_over and not self._waits and await self._meet(served) is OwnershipState.LOOKING:
                log.error("robot_left", "another gateway serves {robot}: leaving it alone", robot=self._robot)
                return

    async def _meet(self, served: Served) -> OwnershipState:
        """Compare the own claim with those of others, and follow from it; return the new state."""
        own, state = self._claim(), self._state
        try:
            claims = await self._bus.claims()
        except BusError:
            return state
        serving = {zid: claim for zid, claim in claims.items() if claim.held_s}
        if serving:
            goodbye = all(claim.leaving for claim in serving.values())
            self._close_until, self._looks = (-math.inf, 1) if goodbye else (math.inf, LOOKS)
        elif state is OwnershipState.YIELDED and not self._owner_gone():
            return state
        found = OwnershipInput.BEST
        if self._bus.outbid(own, serving):
            found = OwnershipInput.OUTBID_CONNECTED if served.must_stay else OwnershipInput.OUTBID
        if found is OwnershipInput.OUTBID and self._keeps_latches(own):
            return state
        if self._handle(found) is OwnershipState.LOOKING:
            await served.step_aside()
            return self._state
        if self._state is not state:
            if self._state is OwnershipState.OWNING:
                text = "{robot}: no other gateway has a better claim: serving it again"
                log.error("robot_regained", text, robot=self._robot)
                await served.step_in()
            else:
                text = "{robot}: another gateway serves it: leaving the robot alone, and staying connected"
                log.error("robot_yielded", text, robot=self._robot)
                await served.step_aside()
        served.heard(serving)
        return self._state

    def _owner_gone(self) -> bool:
        """Whether the better gateway is gone: after a goodbye one look without it is enough, else :data:`LOOKS`."""
        if self._bus.gone:
            return False
        self._looks -= 1
        return self._looks <= 0

    def _keeps_latches(self, own: Claim) -> bool:
        """Whether the other gateway may not have heard of our latched stops yet; true for so many looks at most."""
        self._untold -= 1
        return bool(own.latches) and not self._bus.was_asked and self._untold >= 0

    def export(self) -> Exported | None:
        """Write the claim for a successor of this gateway; None if the robot is not owned."""
        if self._held_since is None:
            return None
        return {"since": self._held_since, "yielded": self.yielded, "close_until": self._close_until}

    def restore(self, claim: Exported) -> None:
        """Own the robot as the gateway before did, once that goes; called instead of :meth:`take`.

        Until :meth:`begin` the claim is a weak one, so that the gateway before may continue if this process fails.
        """
        self._waits = True
        self._announce()
        self._held_since, self._close_until = float(claim["since"]), float(claim["close_until"])
        self._state = OwnershipState.OWNING
        if claim["yielded"]:
            self._handle(OwnershipInput.OUTBID_CONNECTED)

    def begin(self) -> None:
        """Note that the gateway before has gone."""
        self._waits = False

    def leave(self) -> None:
        """Say goodbye: the robot will be left in good order."""
        self._leaving = True

    def release(self) -> None:
        """Withdraw the claim; idempotent."""
        self._handle(OwnershipInput.RELEASE)

    async def drain(self) -> None:
        """Wait until all that was published has left this process: what a successor publishes must not overtake it."""
        await self._bus.drain()

    @property
    def yielded(self) -> bool:
        """Whether the robot is left to another gateway, while its connection is kept."""
        return self._state is OwnershipState.YIELDED

    # The machine

    def _handle(self, found: OwnershipInput) -> OwnershipState:
        """Carry out the table and return the new state. A pair that the table lacks changes nothing."""
        self._state, _ = step(self.TABLE, self._state, found, self)
        return self._state

    def _look_again(self) -> None:
        self._looks = LOOKS

    def _count(self) -> None:
        self._looks -= 1

    def _announce(self) -> None:
        self._leaving = False
        self._bus.announce()

    def _own(self) -> None:
        self._held_since = self._clock()

    def _hide(self) -> None:
        self._bus.hide()

    def _show(self) -> None:
        self._bus.show()

    def _withdraw(self) -> None:
        self._held_since, self._served, self._looks = None, None, LOOKS
        self._bus.withdraw()

    # The own claim, and those of others

    async def _sees(self, others: OtherGateways) -> bool:
        """Query for a token, and for the claim behind it."""
        token = await self._bus.token()
        claims = await self._bus.claims() if token else {}
        serving = [claim for claim in claims.values() if claim.held_s]
        if serving:
            self._mirror(serving[0].record)
        return others.seen(token, bool(claims), leaving=any(claim.leaving for claim in serving))

    def _claim(self) -> Claim:
        if self._held_since is None:
            return Claim()
        standing = self._served.standing if self._served is not None else Standing()
        return Claim(
            held_s=max(self._clock() - self._held_since, 1e-3),
            healthy=standing.healthy,
            connected_s=standing.connected_s,
            yielded=self.yielded or self._waits,
            leaving=self._leaving,
            **msgspec.structs.asdict(standing.record),
        )

    def _merge(self, record: LatchRecord) -> None:
        if self._served is not None:
            self._served.merge(record)

    TABLE: ClassVar[dict[OwnershipState, dict[OwnershipInput, tuple[Callable[[Ownership], None], OwnershipState]]]] = {
        OwnershipState.LOOKING: {
            OwnershipInput.SEEN: (_look_again, OwnershipState.LOOKING),
            OwnershipInput.CLEAR: (_count, OwnershipState.LOOKING),
            OwnershipInput.LAST_CLEAR: (_announce, OwnershipState.CLAIMING),
        },
        OwnershipState.CLAIMING: {
            OwnershipInput.BEST: (_own, OwnershipState.OWNING),
            OwnershipInput.OUTBID: (_withdraw, OwnershipState.LOOKING),
            OwnershipInput.RELEASE: (_withdraw, OwnershipState.LOOKING),
        },
        OwnershipState.OWNING: {
            OwnershipInput.OUTBID: (_withdraw, OwnershipState.LOOKING),
            OwnershipInput.OUTBID_CONNECTED: (_hide, OwnershipState.YIELDED),
            OwnershipInput.RELEASE: (_withdraw, OwnershipState.LOOKING),
        },
        OwnershipState.YIELDED: {
            OwnershipInput.BEST: (_show, OwnershipState.OWNING),
            OwnershipInput.OUTBID: (_withdraw, OwnershipState.LOOKING),
            OwnershipInput.RELEASE: (_withdraw, OwnershipState.LOOKING),
        },
    }
