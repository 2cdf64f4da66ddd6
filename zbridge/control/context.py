"""What the parts that serve one robot share: the bus, counters, clocks, open faults, faults of its protocol."""

from __future__ import annotations

import time
from collections.abc import Callable

import msgspec

from zbridge.blackbox import BlackBox
from zbridge.bus import Bus
from zbridge.clocks import raw_ms, suspended_s
from zbridge.control.faults import OpenFaults
from zbridge.errors import FAULT, Unsupported, describe
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import RobotSide

log = Log("zbridge.robot.commands")

LOGGED = 16
"""Faults that are logged, each once."""


class ProtocolFaults:
    """Exceptions in the code of one robot's protocol, as refusals. robot: its name, for the log."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._logged: set[str] = set()

    def __repr__(self) -> str:
        return f"<ProtocolFaults {sorted(self._logged)}>"

    def refusal(self, what: str, error: Exception) -> Unsupported:
        """Return the refusal of what ran into a fault, and note the fault."""
        self.note(what, error)
        return Unsupported(f"{FAULT}{describe(error)}")

    def note(self, what: str, error: Exception) -> None:
        """Log a fault with its traceback, each once."""
        fault = describe(error)
        if fault not in self._logged and len(self._logged) < LOGGED:
            self._logged.add(fault)
            text = f"{FAULT}{fault}"
            log.error(
                "protocol_fault", "{robot}: {what}: {reason}", robot=self._robot, what=what, reason=text, exc_info=error
            )


class RobotContext(msgspec.Struct, frozen=True):
    """One robot, and how its parts reach the bus, its links, the counters and the time.

    publish: shows a message on the bus. pump: writes to the robot what its sessions have to write.
    clock: seconds on the event loop's time line, from any thread. clock_ns: Unix time in nanoseconds, for stamps.
    raw_ms, suspended_s: see :mod:`zbridge.clocks`. box: records what passes; None: nothing does.
    """

    robot: RobotSide
    keys: KeySpace
    bus: Bus
    metrics: Metrics
    open_faults: OpenFaults
    faults: ProtocolFaults
    clock: Callable[[], float]
    clock_ns: Callable[[], int] = time.time_ns
    raw_ms: Callable[[], float] = raw_ms
    suspended_s: Callable[[], float] = suspended_s
    publish: Callable[[Topic, FleetMessage], object] = lambda topic, message: None
    pump: Callable[[], object] = lambda: None
    box: BlackBox | None = None
