"""What a gateway tells of itself once a second, for those who watch the fleet: ``@gateway/stats``.

Everything is read from counters that exist anyway. It is published while this gateway serves the robot.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from zbridge.app.black_box import box_folder
from zbridge.app.config import GatewayPlan
from zbridge.app.process_usage import Disks, ProcessUsage
from zbridge.bus import Bus
from zbridge.control.latch_store import state_folder
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.processes import ListenerStats, ProcessStats, Stats
from zbridge.fleet.topics import KeySpace
from zbridge.hq import Listener
from zbridge.metrics import Labels, Metrics

PERIOD_S = 1.0
"""Seconds between two messages."""


class GatewayStats:
    """Reads what one gateway does. clock: seconds; clock_ns: Unix time."""

    def __init__(
        self,
        robot: str,
        metrics: Metrics,
        usage: ProcessUsage,
        listeners: Iterable[Listener],
        clock: Callable[[], float],
        clock_ns: Callable[[], int],
    ) -> None:
        self._robot = robot
        self._metrics = metrics
        self.usage = usage
        self._listeners = tuple(listeners)
        self._clock = clock
        self._clock_ns = clock_ns
        self._at = clock()
        self._published = Counter[str]()

    def __repr__(self) -> str:
        return f"<GatewayStats {self._robot}>"

    def process(self, late_s: float = 0.0) -> ProcessStats:
        """Return what the process uses."""
        return msgspec.structs.replace(self.usage.read(), late_s=round(late_s, 4))

    def listeners(self) -> tuple[ListenerStats, ...]:
        """Return the listeners of the process for this robot."""
        return tuple(
            ListenerStats(each.name, each.protocol, str(each.address), len(each.clients), each.ready.is_set())
            for each in self._listeners
        )

    def read(self, late_s: float = 0.0) -> Stats:
        """Return all of it, with the rates since the call before. late_s: of the event loop."""
        counters = list(self._metrics)
        return Stats(
            stamp_ns=self._clock_ns(),
            process=self.process(late_s),
            rates=self._rates(counters),
            gaps=sum(value for name, _, value in counters if name == "sequence_gaps"),
            refused=sum(value for name, _, value in counters if name == "refused"),
            dropped=sum(value for name, _, value in counters if name.endswith("dropped")),
            listeners=self.listeners(),
            disks=self.usage.free(self._robot),
        )

    def _rates(self, counters: list[tuple[str, Labels, int]]) -> dict[str, float]:
        now = self._clock()
        since_s, self._at = max(now - self._at, 1e-3), now
        counted = Counter[str]()
        for name, labels, value in counters:
            if name == "bus_messages" and ("direction", "out") in labels:
                counted[dict(labels)["kind"]] += value
            elif name == "camera_published":
                counted[topics.IMAGE.path] += value
        before, self._published = self._published, counted
        return {
            key: round((value - before[key]) / since_s, 2) for key, value in counted.items() if value != before[key]
        }


class StatsPublisher:
    """Publishes once a second, from the start until :meth:`close`."""

    def __init__(self, bus: Bus, keys: KeySpace, stats: GatewayStats) -> None:
        self._stats = stats
        self._loop = asyncio.get_running_loop()
        self._publisher = bus.publisher(keys.key(topics.STATS.path), topics.STATS)
        self._closed = False
        stats.usage.robots += 1
        self._publish(self._loop.time())

    def __repr__(self) -> str:
        return f"<StatsPublisher {self._publisher.key}>"

    def close(self) -> None:
        """Publish no more; idempotent."""
        if not self._closed:
            self._closed = True
            self._timer.cancel()
            self._publisher.close()
            self._stats.usage.robots -= 1

    def _publish(self, due: float) -> None:
        now = self._loop.time()
        self._timer = self._loop.call_at(now + PERIOD_S, self._publish, now + PERIOD_S)
        self._publisher.put(payloads.encode(self._stats.read(max(0.0, now - due))))


def disks_of(plan: GatewayPlan, folder: Path | None) -> Disks:
    """Return what a gateway writes, and where. folder: of latched stops; None: the usual one."""
    if plan.device is None:
        return ()
    audit = plan.config.control.audit
    disks: list[tuple[str, Path]] = [("latches", folder if folder is not None else state_folder())]
    if audit is not None:
        disks.append(("audit", Path(audit).absolute()))
    if (blackbox := plan.config.blackbox) is not None:
        disks.append(("blackbox", box_folder(blackbox, folder).absolute()))
    return tuple(disks)
