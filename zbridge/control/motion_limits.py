"""Limits on motion that the configuration sets: drives a second, and how fast a drive may change. Sans-IO."""

from __future__ import annotations

import math

import msgspec

from zbridge.errors import RateLimited
from zbridge.fleet.messages import Drive

STEP_S = 0.25
"""The longest time between two drives that counts for their change, seconds."""
_BURST = 2.0
"""Drives that may come at once."""


class MotionLimits:
    """rate_hz: commands a second; slew_per_s: change of each part of a drive a second, in full scales.

    Infinite: no limit. Neutral is never refused, and slowing down is not limited.
    """

    def __init__(self, rate_hz: float = math.inf, slew_per_s: float = math.inf) -> None:
        self.rate_hz = rate_hz
        self.slew_per_s = slew_per_s
        self._last = Drive()
        self._last_at = -math.inf
        self._tokens = _BURST
        self._counted_at = -math.inf

    def limit(self, drive: Drive, now: float) -> Drive:
        """Return the drive that may be sent now; raise RateLimited if drives come too fast."""
        if not drive.moving:
            return drive
        if self.rate_hz < math.inf:
            self._count(now)
        if self.slew_per_s == math.inf:
            return drive
        step = self.slew_per_s * min(now - self._last_at, STEP_S)
        last = self._last
        return msgspec.structs.replace(
            drive,
            forward=_towards(last.forward, drive.forward, step),
            left=_towards(last.left, drive.left, step),
            turn=_towards(last.turn, drive.turn, step),
        )

    def sent(self, drive: Drive, now: float) -> None:
        """Record the drive that the robot was sent."""
        self._last, self._last_at = drive, now

    def stopped(self) -> None:
        """Record that the robot was stopped, whatever it was sent last."""
        self._last = Drive()

    def _count(self, now: float) -> None:
        self._tokens = min(_BURST, self._tokens + (now - self._counted_at) * self.rate_hz)
        self._counted_at = now
        if self._tokens < 1:
            raise RateLimited(f"more than {self.rate_hz:g} commands a second")
        self._tokens -= 1


def _towards(last: float, wanted: float, step: float) -> float:
    """Return the value on the way from ``last`` to ``wanted``, ``step`` away at most; towards zero without limit."""
    start = last if last * wanted > 0 else 0.0
    if abs(wanted) <= abs(start):
        return wanted
    return math.copysign(min(abs(wanted), abs(start) + step), wanted)
