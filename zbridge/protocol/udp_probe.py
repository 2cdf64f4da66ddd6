"""Finds out once per session whether datagrams get through. Sans-IO.

Both ends use a probe: one awaits the first datagram, the other its answer. Each has a deadline; when one passes,
datagrams are not used.
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
    """One probe. ``within_s``: seconds that the other end has."""

    def __init__(self, within_s: float) -> None:
        self.verdict = Verdict.UNKNOWN
        self.deadline = math.inf
        self._within_s = within_s

    def __repr__(self) -> str:
        return f"<Probe {self.verdict.value}>"

    def begin(self, now: float) -> None:
        """Start to wait for the other end."""
        self.verdict, self.deadline = Verdict.WAITING, now + self._within_s

    def settle(self, *, works: bool) -> bool:
        """Take the answer; False: it is too late, or no answer was awaited."""
        if self.verdict is not Verdict.WAITING:
            return False
        self.verdict, self.deadline = (Verdict.WORKS if works else Verdict.FAILED), math.inf
        return True

    def fail(self) -> None:
        """Use no datagrams, whatever the verdict was."""
        self.verdict, self.deadline = Verdict.FAILED, math.inf

    def expire(self, now: float) -> bool:
        """End the wait if its time is up; True: it has just ended."""
        return now >= self.deadline and self.settle(works=False)
