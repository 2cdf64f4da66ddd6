"""Reports what a listener refused to the robot's gateway, which shows it on ``control``.

A stick that is held down is refused fifty times a second: repetitions are folded and reported with their count at most
:data:`EVERY_S` later. What the gateway refuses itself, it shows itself.
"""

from __future__ import annotations

import asyncio

from zbridge.bus import Bus
from zbridge.errors import BusError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import TOLD, Refusal, Refusals
from zbridge.fleet.topics import KeySpace
from zbridge.lease.lease_events import EXPLAINED, NAMED
from zbridge.log import Log
from zbridge.metrics import Count
from zbridge.tasks import Tasks

log = Log("zbridge.hq")

EVERY_S = 0.5
"""Seconds between two reports."""
TELL_S = 1.0
"""Longest time a report waits for its answer."""

_Kind = tuple[str, str, str, str]


class RefusalReports:
    """The reports of one listener.

    name: ``hq.<listener>``, which the names of its clients begin with. untold: counts refusals that find no room.
    """

    def __init__(self, bus: Bus, keys: KeySpace, name: str, tasks: Tasks, untold: Count) -> None:
        self._bus = bus
        self._key = keys.key(topics.RPC_REFUSED(name).path)
        self._tasks = tasks
        self._untold = untold
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[_Kind, int] = {}
        """How often each refusal came since the last report."""
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<RefusalReports at {self._key}, {len(self._waiting)} wait>"

    def note(self, who: str, command: str, refusal: Refused) -> None:
        """Report a refusal, now or with the next report; at most :data:`TOLD` different ones wait."""
        kind = (who, command[:NAMED], refusal.code, str(refusal)[:EXPLAINED])
        if kind not in self._waiting and len(self._waiting) >= TOLD:
            self._untold.value += 1
            return
        self._waiting[kind] = self._waiting.get(kind, 0) + 1
        if self._timer is None:
            self._report()

    def close(self) -> None:
        """Report nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
        self._waiting.clear()

    def _report(self) -> None:
        self._timer = None
        if not self._waiting:
            return
        waiting, self._waiting = self._waiting, {}
        self._timer = self._loop.call_later(EVERY_S, self._report)
        report = Refusals(
            refusals=tuple(
                Refusal(who=who, command=command, code=code, reason=reason, count=count)
                for (who, command, code, reason), count in waiting.items()
            )
        )
        self._tasks.start(self._ask(payloads.encode(report)))

    async def _ask(self, payload: bytes) -> None:
        try:
            for answer in await self._bus.ask(self._key, payload, timeout_s=TELL_S):
                if answer.error is not None:
                    log.debug("report_refused", "{key}: {reason}", key=self._key, reason=answer.error)
        except BusError as error:
            log.debug("report_refused", "{key}: {reason}", key=self._key, reason=error)
