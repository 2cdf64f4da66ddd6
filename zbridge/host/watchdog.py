"""Decides when a gateway process counts as hung, and when one that died is started again.

Sans-IO: time is an argument, in seconds. A robot that moves when its gateway hangs has to stop within 1.5 s: a driven
process is allowed 0.8 s without a heartbeat (it sends five a second), which leaves 0.7 s for a busy machine and the
stop. If the machine delayed the supervisor itself, the heartbeats may be late for the same reason, and get a little
longer.

The delay before a restart, with jitter (each time times 0.8 to 1.2)::

    failure   1     2     3     4    5    6 and on
    delay     0.25  0.5   1     2    4    60 s

A process that lived for :data:`HEALTHY_S` counts as the first failure again.
"""

from __future__ import annotations

import random
from collections.abc import Callable

import msgspec

DRIVEN_S = 0.8
"""Longest time without a heartbeat while the robot is driven."""
IDLE_S = 5.0
"""The same while it is not driven."""
FIRST_S = 30.0
"""Longest time until the first heartbeat: thirty processes that start at once share the processors."""
EXTENSION_S = 0.2
"""Extension of the timeout after a delay of the supervisor itself."""
FIRST_DELAY_S = 0.25
QUICK_RESTARTS = 5
"""Failures in a row that are answered soon."""
LONG_DELAY_S = 60.0
HEALTHY_S = 60.0
JITTER = 0.2


class Watchdog(msgspec.Struct):
    """The heartbeats of one process. last: of the last one, or of the start, in seconds of the monotonic clock."""

    last: float
    timeout_s: float = FIRST_S
    extension_s: float = 0.0
    heartbeats: int = 0

    def heartbeat(self, now: float, *, driven: bool) -> None:
        self.heartbeats += 1
        self.last, self.extension_s = now, 0.0
        self.timeout_s = DRIVEN_S if driven else IDLE_S

    def extend(self) -> None:
        """Wait longer for the next heartbeat: the supervisor itself did not run for a while, nor may the process."""
        self.extension_s = EXTENSION_S

    @property
    def deadline(self) -> float:
        """The time at which the process counts as hung."""
        return self.last + self.timeout_s + self.extension_s

    def silent_s(self, now: float) -> float:
        return now - self.last


class RestartDelay:
    """The failures of one process in a row. chance: gives a number from 0 to 1."""

    def __init__(self, chance: Callable[[], float] = random.random) -> None:
        self.failures = 0
        self._chance = chance

    def __repr__(self) -> str:
        return f"<RestartDelay after {self.failures} failures>"

    def failed(self, lived_s: float) -> float:
        """Note a failure after so many seconds of life; return the seconds until the next start."""
        self.failures = 1 if lived_s >= HEALTHY_S else self.failures + 1
        base_s = FIRST_DELAY_S * 2 ** (self.failures - 1) if self.failures <= QUICK_RESTARTS else LONG_DELAY_S
        return base_s * (1 + JITTER * (2 * self._chance() - 1))

    def reset(self) -> None:
        """Count failures from zero: the file or code that failed has changed."""
        self.failures = 0
