"""One gateway per robot: whoever comes second finds the liveliness token, waits for it to go, and says so.

Two that start at the same moment both find no token. So a claim is also a question anybody may ask, and
of two that only just claimed the one with the lower session id goes on.
"""

from __future__ import annotations

import asyncio
import logging

from zbridge.bus import Bus, Handle, Question
from zbridge.errors import PayloadError
from zbridge.fleet.payload import pack, unpack
from zbridge.fleet.topics import KeySpace

log = logging.getLogger("zbridge.gateway")

LOOK_S = 0.25
"""Seconds between two looks at a token that should go."""
SETTLE_S = 0.25
"""Longest wait for the bus to show whom it already has."""
_WHO = "gateway"
_CLAIM = "@rpc/claim/gateway"


class Claim:
    """The right to be a robot's gateway; held from :meth:`take` until :meth:`release`."""

    def __init__(self, bus: Bus, keys: KeySpace) -> None:
        self._bus = bus
        self._keys = keys
        self._handles: list[Handle] = []
        self._held = False

    def __repr__(self) -> str:
        return f"<Claim {self._keys.robot} {'held' if self._held else 'not held'}>"

    async def take(self) -> None:
        """Wait until no other gateway serves the robot, then be its gateway."""
        await self._settle()
        said = False
        while True:
            if not await self._bus.alive(self._keys.alive(_WHO)):
                self._announce()
                if await self._wins():
                    self._held = True
                    return
                self.release()
            if not said:
                said = True
                log.warning("another gateway serves %s: waiting until it goes", self._keys.robot)
            await asyncio.sleep(LOOK_S)

    def release(self) -> None:
        """Give the claim up; idempotent."""
        handles, self._handles = self._handles, []
        self._held = False
        for handle in handles:
            handle.close()

    async def _settle(self) -> None:
        connected = asyncio.Event()
        watch = self._bus.watch_connected(lambda up: connected.set() if up else None)
        try:
            async with asyncio.timeout(SETTLE_S):
                await connected.wait()
        except TimeoutError:
            log.debug("nobody else on the bus yet")
        finally:
            watch.close()

    def _announce(self) -> None:
        self._handles = [
            self._bus.answer(self._keys.key(_CLAIM), self._on_question),
            self._bus.announce(self._keys.alive(_WHO)),
        ]

    async def _wins(self) -> bool:
        for answer in await self._bus.ask(self._keys.key(_CLAIM), timeout_s=0.5):
            try:
                other = unpack(answer.payload)
            except PayloadError:
                continue
            if other.get("zid") != self._bus.zid and (other.get("held") or str(other.get("zid")) < self._bus.zid):
                return False
        return True

    def _on_question(self, question: Question) -> None:
        question.answer(pack({"zid": self._bus.zid, "held": self._held}))
