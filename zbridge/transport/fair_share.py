"""The part of a processor that the input of one robot of a shared process may use. Sans-IO: time is an argument."""

from __future__ import annotations

BURST_S = 0.02
"""Seconds of work that may be done at once after a pause."""


class FairShare:
    """Allows ``part`` seconds of work per second in the long run, and :data:`BURST_S` at once."""

    def __init__(self, part: float) -> None:
        self._part = part
        self._left_s = BURST_S
        self._at: float | None = None

    def __repr__(self) -> str:
        return f"<FairShare {self._part:g}, {self._left_s:.3f} s left>"

    def spent(self, work_s: float, now: float) -> float:
        """Record work that ended now; return for how many seconds to start no more."""
        idle_s = now - self._at if self._at is not None else 0.0
        self._left_s = min(BURST_S, self._left_s + idle_s * self._part) - work_s
        self._at = now
        return max(0.0, -self._left_s / self._part)
