"""A token bucket: so many times a second, a second's worth at once, or as many as its burst. Sans-IO."""

from __future__ import annotations

from typing import Any, ClassVar

from zbridge.protocol.kept import Kept


class RateLimit(Kept):
    """A bucket of ``burst`` tokens that gets ``rate_hz`` a second; ``inf``: never empty. burst: default ``rate_hz``."""

    kept: ClassVar[dict[str, Any]] = {"left": float, "_filled_at": float}

    def __init__(self, rate_hz: float, burst: float | None = None) -> None:
        self.rate_hz = rate_hz
        self.burst = rate_hz if burst is None else burst
        self.left = self.burst
        """Tokens as of the last :meth:`fill`."""
        self._filled_at = 0.0

    def __repr__(self) -> str:
        return f"<RateLimit {self.left:g} of {self.rate_hz:g} a second>"

    @property
    def exceeded(self) -> str:
        """Why a peer that sends more must go."""
        return f"flood: more than {self.rate_hz:g} messages a second"

    def fill(self, now: float) -> float:
        """Add the tokens of the time since the last call; give those there are."""
        if self.left < self.burst:
            self.left = min(self.burst, self.left + (now - self._filled_at) * self.rate_hz)
        self._filled_at = now
        return self.left

    def take(self, now: float) -> bool:
        """Take one token; False if there is none."""
        if self.fill(now) < 1:
            return False
        self.left -= 1
        return True
