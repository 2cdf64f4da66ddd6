"""What the parts that serve one robot share."""

from __future__ import annotations

import time
from collections.abc import Callable

import msgspec

from zbridge.bus import Bus
from zbridge.control.conditions import Conditions
from zbridge.control.faults import Faults
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.lease.lease_holder import raw_ms
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Robot

_BOOT = getattr(time, "CLOCK_BOOTTIME", None)


def suspended_s() -> float:
    """Return for how many seconds this machine was suspended since it was booted; 0 where the platform does not say.

    The result may be too small by the time between two readings, never too large.
    """
    if _BOOT is None:
        return 0.0
    since_boot = time.clock_gettime(_BOOT)
    return since_boot - time.monotonic()


class RobotContext(msgspec.Struct, frozen=True):
    """One robot, and how its parts reach the bus, its links, the counters and the time.

    publish: shows a message on the bus. pump: writes to the robot what its sessions have to write.
    clock: seconds on the event loop's time line, from any thread. clock_ns: Unix time in nanoseconds, for stamps.
    raw_ms, suspended_s: see the functions.
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
    raw_ms: Callable[[], float] = raw_ms
    suspended_s: Callable[[], float] = suspended_s
