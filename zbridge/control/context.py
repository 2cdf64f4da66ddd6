"""What the parts that serve one robot share."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from zbridge.bus import Bus
from zbridge.control import clocks
from zbridge.control.conditions import Conditions
from zbridge.control.faults import Faults
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Robot


class RobotContext(msgspec.Struct, frozen=True):
    """One robot, and how its parts reach the bus, its links, the counters and the time.

    publish: shows a message on the bus. pump: writes to the robot what its sessions have to write.
    clock: seconds on the event loop's time line, from any thread. clock_ns: Unix time in nanoseconds, for stamps.
    raw_ms, suspended_s: see :mod:`zbridge.control.clocks`.
    """

    robot: Robot
    keys: KeySpace
    bus: Bus
    metrics: Metrics
    conditions: Conditions
    faults: Faults
    publish: Callable[[Topic, FleetMessage], object]
    pump: Callable[[], object]
    clock: Callable[[], float]
    clock_ns: Callable[[], int]
    raw_ms: Callable[[], float] = clocks.raw_ms
    suspended_s: Callable[[], float] = clocks.suspended_s
