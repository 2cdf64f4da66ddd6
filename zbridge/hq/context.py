"""What the parts of one listener share, as one frozen value. Knows no protocol and no client."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from zbridge.bus import Bus
from zbridge.fleet.topics import KeySpace
from zbridge.fleet.view import RobotView
from zbridge.hq.freeze import FreezeWatch
from zbridge.hq.listener_log import ConnectionLog, FailureLog
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import HqSettings
from zbridge.lease.commands import CommandPublishers
from zbridge.metrics import Count, Metrics
from zbridge.protocol.plugin import HqSide
from zbridge.protocol.session import Limits
from zbridge.tasks import Tasks


class Bridge(CommandPublishers):
    """What the operators of one listener share: the robot's keys, its view, and publishers for its commands.

    spawn: starts a task.
    """

    def __init__(
        self, bus: Bus, keys: KeySpace, view: RobotView, spawn: Callable[[Coroutine[Any, Any, None]], object]
    ) -> None:
        super().__init__(bus, keys)
        self.view = view
        self.spawn = spawn


class ListenerCounts(msgspec.Struct, frozen=True):
    """The counters of one listener: metrics ``hq_<field>``, but for the connections."""

    accepted: Count
    turned_away: Count
    dropped: Count
    left_out: Count
    commands: Count
    refused: Count
    malformed_frames: Count
    foreign_datagrams: Count
    rival_sources: Count
    refusals_untold: Count


class ListenerContext(msgspec.Struct, frozen=True):
    """One listener: its name on the bus, its protocol's side, the robot it shows, and what its parts report to.

    clock: seconds on the event loop's time line. clock_ms: the raw clock, which dates commands.
    """

    name: str
    settings: HqSettings
    side: HqSide
    robot: RobotSubscription
    bridge: Bridge
    tasks: Tasks
    counts: ListenerCounts
    connections: ConnectionLog
    failures: FailureLog
    freeze: FreezeWatch
    clock: Callable[[], float]
    clock_ms: Callable[[], float]
    limits: Limits
    """What is demanded of every client."""


def listener_counts(metrics: Metrics, name: str) -> ListenerCounts:
    """Return the counters of a listener; made on first use. name: the same after every start of the process."""
    connections = {outcome: metrics.count("hq_connections", listener=name, outcome=outcome) for outcome in _CONNECTIONS}
    others = {
        field: metrics.count(f"hq_{field}", listener=name)
        for field in ListenerCounts.__struct_fields__
        if field not in connections
    }
    return ListenerCounts(**connections, **others)


_CONNECTIONS = ("accepted", "turned_away")
