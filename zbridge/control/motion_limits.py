"""Limits on motion that the robot's owner sets: how often drives may come, and how fast they may change. Sans-IO."""

from __future__ import annotations

import math

import msgspec

from zbridge.errors import TooFast
from zbridge.fleet.messages import Drive

STEP_S = 0.25
"""Longest time since the last command that a change is computed for, seconds."""
_BURST = 2.0
"""Commands that may come at once, above the rate."""


class MotionLimits:
    """Limits the rate and the change of drives. Neutral is never refused, and slowing down is never limited.

    rate_hz: commands a second. slew_per_s: change of each part of a drive, full scales a second. Infinite: no limit.
    """

    def __init__(self, rate_hz: float = math.inf, slew_per_s: float = math.inf) -> None:
        self.rate_hz = rate_hz
        self.slew_per_s = slew_per_s
        self._last = Drive()
        self._last_at = -math.inf
        self._tokens = _BURST
        self._counted_at = -math.inf

    def limit(self, drive: Drive, now: float) -> Drive:
        """Return the drive that may be sent now; raise TooFast where commands come too fast."""
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
        """Note what the robot was told."""
        self._last, self._last_at = drive, now

    def at_rest(self) -> None:
        """Note that the robot is at rest, whatever it was told last."""
        self._last = Drive()

    def _count(self, now: float) -> None:
        self._tokens = min(_BURST, self._tokens + (now - self._counted_at) * self.rate_hz)
        self._counted_at = now
        if self._tokens < 1:
            raise TooFast(f"more than {self.rate_hz:g} commands a second")
        self._tokens -= 1


def _towards(last: float, wanted: float, step: float) -> float:
    """Return ``last`` moved towards ``wanted`` by ``step`` at most; towards zero at once."""
    start = last if last * wanted > 0 else 0.0
    if abs(wanted) <= abs(start):
        return wanted
    return math.copysign(min(abs(wanted), abs(start) + step), wanted)
