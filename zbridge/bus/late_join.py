"""A subscription to keys that keep their last value, which late joiners get too. Knows no zenoh.

Theory of operation. Live values come by a plain subscription. The last values are queried when the liveliness token
of a robot's gateway exists: at the start, and again whenever it returns, because what was published while the two could
not reach each other is lost. The token may arrive before the route for the query exists: a query without an answer is
repeated a few times. A value that arrived live while its robot was being queried is newer than the answer; one that was
in transit meanwhile arrives twice. When the bus returns, many robots' tokens appear at once, and many joiners see them:
so few robots are queried at a time, and each joiner begins at another moment.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import Callable

from zbridge.bus.interface import Bus, Sample
from zbridge.errors import BusError
from zbridge.fleet.topics import gateways_of, of_robot, split_key
from zbridge.log import Log

log = Log("zbridge.bus")

ASK_AFTER_S = (0.0, 0.1, 0.4, 1.5)
"""Seconds before each query."""
JITTER_S = 0.1
"""Most seconds by which the queries to a robot are delayed if others are being queried."""
ASKED_AT_ONCE = 32
"""Robots that are queried at the same time; the others wait."""
ROBOTS = 20_000
"""Most robots that are queried, or wait to be queried."""
LIVE_KEYS = 4096
"""Most keys of a robot that are noted as live while it is queried."""


class LateJoin:
    """Passes ``handler`` the last values of all keys that an expression matches, and then the live ones.

    chance: 0 to 1.
    """

    def __init__(
        self, bus: Bus, key_expr: str, handler: Callable[[Sample], None], chance: Callable[[], float] = random.random
    ) -> None:
        self._bus = bus
        self._chance = chance
        self._key_expr = key_expr
        self._handler = handler
        self.closed = False
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._room = asyncio.Semaphore(ASKED_AT_ONCE)
        self._live: dict[str, set[str]] = {}
        """By the robot that is queried, the keys received live since."""
        self._subscription = bus.subscribe(key_expr, self._take)
        self._watch = bus.watch_alive(gateways_of(key_expr), self._on_gateway)

    def __repr__(self) -> str:
        return f"<LateJoin {self._key_expr} asking {sorted(self._asking)}>"

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        self.closed = True
        for handle in (self._watch, self._subscription):
            handle.close()
        for task in self._asking.values():
            task.cancel()

    def _take(self, sample: Sample) -> None:
        if self._live:
            robot, _, _ = sample.key.partition("/")[2].partition("/")
            live = self._live.get(robot)
            if live is not None and len(live) < LIVE_KEYS:
                live.add(sample.key)
        self._handler(sample)

    def _on_gateway(self, key: str, alive: bool) -> None:
        split = split_key(key)
        if split is None:
            return
        realm, robot, _ = split
        asked = self._asking.pop(robot, None)
        if asked is not None:
            asked.cancel()
        if alive and len(self._asking) < ROBOTS:
            self._asking[robot] = asyncio.get_running_loop().create_task(self._ask(realm, robot))

    async def _ask(self, realm: str, robot: str) -> None:
        live = self._live[robot] = set()
        if len(self._asking) > 1:
            await asyncio.sleep(JITTER_S * self._chance())
        try:
            for after_s in ASK_AFTER_S:
                await asyncio.sleep(after_s)
                async with self._room:
                    answered = await self._asked_once(realm, robot, live)
                if answered:
                    break
        finally:
            if self._live.get(robot) is live:
                del self._live[robot]
        self._asking.pop(robot, None)

    async def _asked_once(self, realm: str, robot: str, live: set[str]) -> bool:
        """Query one robot, and pass on what was not received live meanwhile; False if it did not answer."""
        with contextlib.suppress(BusError):
            replies = await self._bus.ask(of_robot(self._key_expr, realm, robot))
            answers = [reply for reply in replies if reply.error is None and reply.key.startswith(f"{realm}/{robot}/")]
            for answer in answers:
                if answer.key not in live:
                    self._hand_on(Sample(answer.key, answer.payload, None))
            return bool(answers)
        return False

    def _hand_on(self, sample: Sample) -> None:
        try:
            self._handler(sample)
        except Exception:
            log.exception("handler_failed", "a handler failed")
