"""Lasting faults of a robot that is served all the same, or of its gateway; ``status.reason`` shows them. Sans-IO.

Each part that finds a fault sets a condition under a name of its own and clears it when the fault has passed.
"""

from __future__ import annotations

from collections.abc import Callable


class Conditions:
    """The conditions of now. ``changed`` is called when one is set, changed or cleared."""

    def __init__(self, changed: Callable[[], object] = lambda: None) -> None:
        self.changed = changed
        self._texts: dict[str, str] = {}

    def __repr__(self) -> str:
        return f"<Conditions {sorted(self._texts)}>"

    @property
    def texts(self) -> tuple[str, ...]:
        """The texts for people, oldest first."""
        return tuple(self._texts.values())

    def set(self, name: str, text: str | None) -> None:
        """Set the condition of a name; None clears it."""
        if self._texts.get(name) == text:
            return
        if text is None:
            del self._texts[name]
        else:
            self._texts[name] = text
        self.changed()
