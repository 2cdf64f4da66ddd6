"""Bounds the names that a robot may publish under (its sensors'): each costs memory on every router. Sans-IO."""

from __future__ import annotations

NAMES = 1024
"""Different names that a robot may publish within an hour."""
HOUR_S = 3600.0


class NameBudget:
    """Counts the different names of an hour, which begins with its first name. A name counts once an hour."""

    def __init__(self) -> None:
        self.over = False
        """Whether a name was refused in this hour."""
        self._seen: set[str] = set()
        self._ends_at = 0.0

    def __repr__(self) -> str:
        return f"<NameBudget {len(self._seen)} of {NAMES}>"

    def admit(self, name: str, now: float) -> bool:
        """Return whether a name may be published."""
        self.expire(now)
        if name in self._seen:
            return True
        if len(self._seen) >= NAMES:
            self.over = True
            return False
        if not self._seen:
            self._ends_at = now + HOUR_S
        self._seen.add(name)
        return True

    def expire(self, now: float) -> None:
        """Begin a new hour if the current one is over."""
        if self._seen and now >= self._ends_at:
            self._seen.clear()
            self.over = False
