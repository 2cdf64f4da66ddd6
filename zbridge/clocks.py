"""The clocks of one machine, also those that Python has no function for."""

from __future__ import annotations

import time
from collections.abc import Callable

import msgspec

_RAW = getattr(time, "CLOCK_MONOTONIC_RAW", time.CLOCK_MONOTONIC)
_BOOT = getattr(time, "CLOCK_BOOTTIME", None)


def raw_ms() -> float:
    """Return milliseconds of CLOCK_MONOTONIC_RAW, which no time service slews; from any thread."""
    return time.clock_gettime_ns(_RAW) / 1e6


def suspended_s() -> float:
    """Return for how many seconds this machine was suspended since it was booted; 0 where the platform does not say.

    The result may be too small by the time between two readings, never too large.
    """
    if _BOOT is None:
        return 0.0
    since_boot = time.clock_gettime(_BOOT)
    return since_boot - time.monotonic()


class Clocks(msgspec.Struct, frozen=True):
    """The clocks of one machine.

    clock: seconds on the time line of event loops, from any thread. clock_ns: Unix time. raw_ms, suspended_s: see the
    functions.
    """

    clock: Callable[[], float] = time.monotonic
    clock_ns: Callable[[], int] = time.time_ns
    raw_ms: Callable[[], float] = raw_ms
    suspended_s: Callable[[], float] = suspended_s
