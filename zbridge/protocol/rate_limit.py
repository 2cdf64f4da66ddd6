"""A token bucket: so many times a second, a second's worth at once. Sans-IO."""

from __future__ import annotations

from typing import Any, ClassVar

from zbridge.protocol.kept import Kept


class RateLimit(Kept):
    """A bucket of ``rate_hz`` tokens that fills in a second; ``inf``: never empty."""

    kept: ClassVar[dict[str, Any]] = {"left": float, "_filled_at": float}

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.left = rate_hz
        """Tokens as of the last :meth:`fill`."""
        self._filled_at = 0.0

    def __repr__(self) -> str:
        return f"<RateLimit {self.left:g} of {self.rate_hz:g} a second>"

    def fill(self, now: float) -> float:
        """Add the tokens of the time since the last call; give those there are."""
        if self.left < self.rate_hz:
            self.left = min(self.rate_hz, self.left + (now - self._filled_at) * self.rate_hz)
        self._filled_at = now
        return self.left

    def take(self, now: float) -> bool:
        """Take one token; False if there is none."""
        if self.fill(now) < 1:
            return False
        self.left -= 1
        return True
