"""Whether datagrams get through, found out once per session. Sans-IO.

Both ends use it: the one that waits for the first datagram, and the one that waits for the answer to it. Each
has a deadline of its own, and whichever passes first, datagrams are not used.
"""

from __future__ import annotations

import math
from enum import Enum


class Verdict(Enum):
    """What is known of the datagrams."""

    UNKNOWN = "unknown"
    WAITING = "waiting"
    WORKS = "works"
    FAILED = "failed"


class Probe:
    """One probe. ``within_s``: seconds the other end has."""

    def __init__(self, within_s: float) -> None:
        self.verdict = Verdict.UNKNOWN
        self.deadline = math.inf
        self._within_s = within_s

    def __repr__(self) -> str:
        return f"<Probe {self.verdict.value}>"

    def begin(self, now: float) -> None:
        """Wait for the other end from now on."""
        self.verdict, self.deadline = Verdict.WAITING, now + self._within_s

    def settle(self, *, works: bool) -> bool:
        """Take the answer; False when it comes too late to count, or was not waited for."""
        if self.verdict is not Verdict.WAITING:
            return False
        self.verdict, self.deadline = (Verdict.WORKS if works else Verdict.FAILED), math.inf
        return True

    def fail(self) -> None:
        """Use no datagrams, whatever was found out before."""
        self.verdict, self.deadline = Verdict.FAILED, math.inf

    def expire(self, now: float) -> bool:
        """Tell whether the other end has just used up its time."""
        return now >= self.deadline and self.settle(works=False)
