"""Tracks who watches a camera: programs on the bus, and clients of the relay. Without them nothing is fetched."""

from __future__ import annotations

import asyncio

LINGER_S = 2.0
"""Seconds for which the stream is still fetched after the last watcher has left: many return at once."""


class Demand:
    """Knows whether anybody watches, and waits for the first watcher, or until the last one has left."""

    def __init__(self) -> None:
        self.listened = False
        """Whether a program on the bus listens to the images."""
        self.clients = 0
        """Clients of the relay that get the stream."""
        self._begun, self._ended = asyncio.Event(), asyncio.Event()
        """Set while anybody watches, and while nobody does."""
        self._ended.set()

    def __repr__(self) -> str:
        return f"<Demand {'bus' if self.listened else 'no bus'}, {self.clients} clients>"

    @property
    def wanted(self) -> bool:
        return self.listened or self.clients > 0

    def listen(self, anybody: bool) -> None:
        """Record that the first listener on the bus has appeared, or that the last one has left."""
        self.listened = anybody
        self._notify()

    def join(self) -> None:
        """Record one more client of the relay; :meth:`leave` must follow."""
        self.clients += 1
        self._notify()

    def leave(self) -> None:
        """Record that a client of the relay has left."""
        self.clients -= 1
        self._notify()

    async def begin(self) -> None:
        """Wait until somebody watches."""
        while not self.wanted:
            await self._begun.wait()

    async def end(self) -> None:
        """Wait until nobody has watched for :data:`LINGER_S`."""
        while True:
            await self._ended.wait()
            try:
                async with asyncio.timeout(LINGER_S):
                    await self.begin()
            except TimeoutError:
                return

    def _notify(self) -> None:
        begins, ends = (self._begun, self._ended) if self.wanted else (self._ended, self._begun)
        begins.set()
        ends.clear()
