"""How often something may happen: so many times a second, a second's worth at once. Sans-IO."""

from __future__ import annotations


class RateLimit:
    """rate_hz: times a second; infinite: always."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.left = rate_hz
        """How often it may happen now, as of the last call of :meth:`fill`."""
        self._filled_at = 0.0

    def __repr__(self) -> str:
        return f"<RateLimit {self.left:g} of {self.rate_hz:g} a second>"

    def fill(self, now: float) -> float:
        """Give what is left now."""
        if self.left < self.rate_hz:
            self.left = min(self.rate_hz, self.left + (now - self._filled_at) * self.rate_hz)
        self._filled_at = now
        return self.left

    def take(self, now: float) -> bool:
        """Let it happen once more, if it may."""
        if self.fill(now) < 1:
            return False
        self.left -= 1
        return True
