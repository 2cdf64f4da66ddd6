"""One gateway per robot: whoever comes second finds the liveliness token, waits for it to go, and says so.

Two that start at the same moment both find no token. So a claim is also a question anybody may ask, and
of two that claim it the one that has held it longer goes on, or the one with the lower session id.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable

from zbridge.bus import Bus, Handle, Question
from zbridge.errors import PayloadError
from zbridge.fleet.payload import pack, unpack
from zbridge.fleet.topics import KeySpace

log = logging.getLogger("zbridge.gateway")

LOOK_S = 0.25
"""Seconds between two looks at a token that should go."""
LOOKS = 3
"""Looks in a row that must find nobody, after somebody was seen or the bus was gone."""
SETTLE_S = 0.25
"""Longest wait for the bus to show whom it already has."""
_WHO = "gateway"
_CLAIM = "@rpc/claim/gateway"


class Claim:
    """The right to be a robot's gateway; held from :meth:`take` until :meth:`release` or :meth:`lost`."""

    def __init__(self, bus: Bus, keys: KeySpace, clock: Callable[[], float] = time.monotonic) -> None:
        self._bus = bus
        self._keys = keys
        self._clock = clock
        self._handles: list[Handle] = []
        self._held_since: float | None = None
        self._connected = asyncio.Event()
        self._was_connected = False
        self._reconnected = asyncio.Event()
        self._watch: Handle | None = None

    def __repr__(self) -> str:
        return f"<Claim {self._keys.robot} {'held' if self._held_since is not None else 'not held'}>"

    async def take(self) -> None:
        """Wait until no other gateway serves the robot, then be its gateway.

        On a bus that was there and is gone nobody can be seen, so nothing is taken; and after somebody was
        seen, or the bus came back, several looks in a row must find nobody.
        """
        await self._settle()
        looks, said = 1, False
        while True:
            if self._was_connected and not self._connected.is_set():
                looks = LOOKS
            elif await self._bus.alive(self._keys.alive(_WHO)):
                looks = LOOKS
                if not said:
                    said = True
                    log.warning("another gateway serves %s: waiting until it goes", self._keys.robot)
            else:
                looks -= 1
                if looks <= 0:
                    self._announce()
                    if await self._wins():
                        self._held_since = self._clock()
                        return
                    self.release()
                    looks = LOOKS
            await asyncio.sleep(LOOK_S if looks else 0)

    async def lost(self) -> None:
        """Return when another gateway has the better claim: two may have begun while they could not see each other."""
        while True:
            await self._reconnected.wait()
            self._reconnected.clear()
            await asyncio.sleep(LOOK_S)
            if not await self._wins():
                log.error("another gateway served %s before this one: leaving it alone", self._keys.robot)
                self.release()
                return

    def release(self) -> None:
        """Give the claim up; idempotent."""
        handles, self._handles = self._handles, []
        self._held_since = None
        for handle in handles:
            handle.close()

    async def _settle(self) -> None:
        if self._watch is None:
            self._watch = self._bus.watch_connected(self._on_connected)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SETTLE_S):
                await self._connected.wait()

    def _on_connected(self, up: bool) -> None:
        if up and self._was_connected and not self._connected.is_set():
            self._reconnected.set()
        self._was_connected = self._was_connected or up
        if up:
            self._connected.set()
        else:
            self._connected.clear()

    def _announce(self) -> None:
        self._handles = [
            self._bus.answer(self._keys.key(_CLAIM), self._on_question),
            self._bus.announce(self._keys.alive(_WHO)),
        ]

    async def _wins(self) -> bool:
        """Tell whether nobody has held the robot longer; of two that hold it equally long, the lower id does."""
        own_s = self._held_s()
        for answer in await self._bus.ask(self._keys.key(_CLAIM), timeout_s=0.5):
            with contextlib.suppress(PayloadError, TypeError, ValueError):
                other = unpack(answer.payload)
                zid, held_s = str(other.get("zid")), float(other.get("held_s") or 0.0)
                if zid != self._bus.zid and (-held_s, zid) < (-own_s, self._bus.zid):
                    return False
        return True

    def _held_s(self) -> float:
        return 0.0 if self._held_since is None else self._clock() - self._held_since

    def _on_question(self, question: Question) -> None:
        question.answer(pack({"zid": self._bus.zid, "held_s": self._held_s()}))
