"""What a listener refused its HQ programs, told to the robot's gateway, which shows it on ``control``.

A stick that is held down is refused fifty times a second: what repeats itself is folded, and told with its count
:data:`EVERY_S` later at the latest. What the gateway refuses by itself, it shows by itself.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any

from zbridge.bus import Bus
from zbridge.errors import BusError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import TOLD, Refusal, Refusals
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Count

log = logging.getLogger("zbridge.hq")

EVERY_S = 0.5
"""Seconds between two tellings."""
TELL_S = 1.0
"""Longest time a telling waits for its answer."""

_Kind = tuple[str, str, str, str]


class Teller:
    """Tells what one listener refused. name: ``hq.<listener>``, which the names of its clients begin with.

    ``spawn`` starts a task. ``untold`` counts what did not find room.
    """

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        name: str,
        spawn: Callable[[Coroutine[Any, Any, None]], object],
        untold: Count,
    ) -> None:
        self._bus = bus
        self._key = keys.key(topics.RPC_REFUSED(name).path)
        self._spawn = spawn
        self._untold = untold
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[_Kind, int] = {}
        self._resting: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<Teller at {self._key}, {len(self._waiting)} wait>"

    def note(self, who: str, command: str, refusal: Refused) -> None:
        """Tell of a refusal, at once or with others soon; at most :data:`TOLD` different ones at a time."""
        kind = (who, command, refusal.code, str(refusal))
        if kind not in self._waiting and len(self._waiting) >= TOLD:
            self._untold.value += 1
            return
        self._waiting[kind] = self._waiting.get(kind, 0) + 1
        if self._resting is None:
            self._tell()

    def close(self) -> None:
        """Tell nothing any more."""
        if self._resting is not None:
            self._resting.cancel()
        self._waiting.clear()

    def _tell(self) -> None:
        self._resting = None
        if not self._waiting:
            return
        waiting, self._waiting = self._waiting, {}
        self._resting = self._loop.call_later(EVERY_S, self._tell)
        told = Refusals(
            refusals=tuple(
                Refusal(who=who, command=command, code=code, reason=reason, count=count)
                for (who, command, code, reason), count in waiting.items()
            )
        )
        self._spawn(self._ask(payloads.encode(told)))

    async def _ask(self, payload: bytes) -> None:
        try:
            for answer in await self._bus.ask(self._key, payload, timeout_s=TELL_S):
                if answer.error is not None:
                    log.debug("%s: %s", self._key, answer.error)
        except BusError as error:
            log.debug("%s: %s", self._key, error)
