"""What is wrong with a robot that is served all the same, or with its gateway: ``status.reason`` tells people. Sans-IO.

Whoever finds a condition sets it under a name of its own, and clears it when it has passed.
"""

from __future__ import annotations

from collections.abc import Callable


class Conditions:
    """The conditions that hold now. ``changed`` is called when one comes, changes or goes."""

    def __init__(self, changed: Callable[[], object] = lambda: None) -> None:
        self.changed = changed
        self._texts: dict[str, str] = {}

    def __repr__(self) -> str:
        return f"<Conditions {sorted(self._texts)}>"

    @property
    def texts(self) -> tuple[str, ...]:
        """What to tell people, oldest first."""
        return tuple(self._texts.values())

    def set(self, name: str, text: str | None) -> None:
        """Say what holds under a name; None: nothing any more."""
        if self._texts.get(name) == text:
            return
        if text is None:
            del self._texts[name]
        else:
            self._texts[name] = text
        self.changed()
