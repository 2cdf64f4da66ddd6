"""Claims on the bus: this gateway's own, the questions for those of others, and when to ask them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.control.latch import LatchRecord
from zbridge.fleet.topics import KeySpace
from zbridge.robot.claim import CLAIM, Claim, ClaimQuestion, best_claims, read_question, write
from zbridge.tasks import occurs

SETTLE_S = 0.25
"""Longest wait for the first connection of the bus."""
ASK_S = 1.0
"""Longest wait for the claims of others."""
WATCH_S = 5.0
"""Seconds between two looks for others while the robot is served."""
CLOSE_S = 0.5
"""The same while there may be another gateway that serves the robot; the least time between two looks."""
SPREAD_S = 1.0
"""All gateways of a router find their bus at once, and look each at another moment of so many seconds."""
_WHO = "gateway"


class ClaimBus:
    """The claims of the gateways of one robot. chance: 0 to 1.

    claim: returns the own claim; record: what this gateway knows of the robot. merge: is called with what gateways that
    ask know.
    """

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        chance: Callable[[], float],
        *,
        claim: Callable[[], Claim],
        record: Callable[[], LatchRecord],
        merge: Callable[[LatchRecord], None],
    ) -> None:
        self.was_asked = False
        """Whether another gateway that serves the robot has asked since the own claim was announced."""
        self._bus = bus
        self._key, self._token = keys.key(CLAIM), keys.alive(_WHO)
        self._chance = chance
        self._claim = claim
        self._record = record
        self._merge = merge
        self._claimed: list[Handle] = []
        self._shown: list[Handle] = []
        self._connected = asyncio.Event()
        self._was_connected = False
        self._came = asyncio.Event()
        """The bus has come, or come back."""
        self._asked = asyncio.Event()
        """Another gateway that serves the robot has asked for claims."""
        self._watch: Handle | None = None

    def __repr__(self) -> str:
        return f"<ClaimBus {self._key}>"

    @property
    def gone(self) -> bool:
        """Whether the bus was connected, and is not: then no gateway can be seen."""
        return self._was_connected and not self._connected.is_set()

    async def settle(self) -> None:
        """Wait for the first connection, for :data:`SETTLE_S` at most."""
        if self._watch is None:
            self._watch = self._bus.watch_connected(self._on_connected)
        await occurs(self._connected, SETTLE_S)

    async def next_look(self, closely: Callable[[], bool]) -> None:
        """Wait until it is time to look for others. closely: whether every :data:`CLOSE_S`."""
        await asyncio.sleep(CLOSE_S)
        if not closely():
            await _within(WATCH_S - CLOSE_S, self._came, self._asked)
        if self._came.is_set() and not self._asked.is_set():
            await _within(self._chance() * SPREAD_S, self._asked)
        self._came.clear()
        self._asked.clear()

    async def token(self) -> bool:
        """Query for the token of any gateway of the robot."""
        return bool(await self._bus.alive(self._token))

    async def claims(self) -> dict[str, Claim]:
        """Ask for the claims of others; see :func:`best_claims`."""
        known = self._record()
        question = ClaimQuestion(self._bus.zid, self._claim().held_s > 0, known.latches, known.autonomous)
        return best_claims(await self._bus.ask(self._key, write(question), timeout_s=ASK_S), self._bus.zid)

    def outbid(self, own: Claim, claims: Mapping[str, Claim]) -> bool:
        """Return whether any of these claims is better than the own one."""
        return any(claim.better_than(own, zid, self._bus.zid) for zid, claim in claims.items())

    def announce(self) -> None:
        """Answer with the own claim from now on, and show the token."""
        self.was_asked = False
        self._claimed = [self._bus.answer(self._key, self._on_question)]
        self.show()

    def show(self) -> None:
        """Show the token."""
        self._shown = [self._bus.announce(self._token)]

    def hide(self) -> None:
        """Take the token back."""
        shown, self._shown = self._shown, []
        for handle in shown:
            handle.close()

    def withdraw(self) -> None:
        """Take claim and token back; idempotent."""
        claimed, self._claimed = self._claimed, []
        for handle in claimed:
            handle.close()
        self.hide()

    async def drain(self) -> None:
        """Wait until all that was published has left this process; the successor's claim answers the query."""
        await self._bus.drain(self._key)

    def _on_connected(self, up: bool) -> None:
        self._was_connected = self._was_connected or up
        if not up:
            self._connected.clear()
        elif not self._connected.is_set():
            self._connected.set()
            self._came.set()

    def _on_question(self, question: IncomingQuery) -> None:
        asker = read_question(question.payload)
        if asker is not None and asker.zid != self._bus.zid:
            if asker.serves:
                self._asked.set()
                self.was_asked = True
            if asker.latches or asker.autonomous:
                self._merge(LatchRecord(asker.latches, autonomous=asker.autonomous))
        question.answer(write(self._claim()))


async def _within(seconds: float, *events: asyncio.Event) -> None:
    """Wait so long, or until one of these events."""
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
