"""What a gateway takes from its machine: clocks, randomness, sockets, processes, a folder and the bus.

A simulation injects its own.
"""

from __future__ import annotations

import random
import secrets
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec

from zbridge.app.config import Plan
from zbridge.app.handover.processes import PROCESSES, Processes
from zbridge.app.joining import can_connect, join_bus
from zbridge.bus import Bus
from zbridge.control import clocks
from zbridge.metrics import Metrics
from zbridge.transport.kernel import KERNEL, Kernel


class Runtime(msgspec.Struct, frozen=True):
    """The machine below one gateway.

    clock: seconds on the time line of event loops, without their rounding. clock_ns: Unix time. raw_ms, suspended_s:
    see :mod:`zbridge.control.clocks`. chance: 0 to 1. secret: so many random bytes. folder: where latched stops are
    kept; None: where :func:`zbridge.control.latch_store.state_folder` says. processes: for a restart. join: opens the
    bus, however long that takes. can_connect: whether a second session connects to it.
    """

    clock: Callable[[], float] = time.monotonic
    clock_ns: Callable[[], int] = time.time_ns
    raw_ms: Callable[[], float] = clocks.raw_ms
    suspended_s: Callable[[], float] = clocks.suspended_s
    chance: Callable[[], float] = random.random
    secret: Callable[[int], bytes] = secrets.token_bytes
    kernel: Kernel = KERNEL
    folder: Path | None = None
    processes: Processes = PROCESSES
    join: Callable[[Plan, Metrics], Awaitable[Bus]] = join_bus
    can_connect: Callable[[Plan], Awaitable[bool]] = can_connect


RUNTIME = Runtime()
"""This machine."""
