"""Decides when a process that died is started again. Sans-IO: time is an argument, in seconds.

    failure   1     2     3     4    5    6 and on
    after     0.25  0.5   1     2    4    60 s      with jitter: each time times 0.8 to 1.2

A process that lived for :data:`HEALTHY_S` counts as the first failure again.
"""

from __future__ import annotations

import random
from collections.abc import Callable

FIRST_S = 0.25
FAST = 5
"""Failures in a row that are answered soon."""
SLOW_S = 60.0
HEALTHY_S = 60.0
JITTER = 0.2


class BackOff:
    """The failures of one process in a row. chance: gives a number from 0 to 1."""

    def __init__(self, chance: Callable[[], float] = random.random) -> None:
        self.failures = 0
        self._chance = chance

    def __repr__(self) -> str:
        return f"<BackOff after {self.failures} failures>"

    def failed(self, lived_s: float) -> float:
        """Note a failure after so many seconds of life; return the seconds until the next start."""
        self.failures = 1 if lived_s >= HEALTHY_S else self.failures + 1
        base_s = FIRST_S * 2 ** (self.failures - 1) if self.failures <= FAST else SLOW_S
        return base_s * (1 + JITTER * (2 * self._chance() - 1))

    def forget(self) -> None:
        """Begin anew: what failed was changed."""
        self.failures = 0
