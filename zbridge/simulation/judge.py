"""What every judge keeps: what it found wrong, what happened, and what it died of. Knows no protocol.

Judges are simulated peers as fragile as deployed ones. They share this with each other, and nothing with the gateway.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NoReturn


class Judge:
    """The accounts of one judge. keep: bound of every list; note: called with each violation."""

    _DEATH: ClassVar[type[Exception]]
    """What :meth:`_die` raises, to end whatever the judge is doing."""

    def __init__(self, *, keep: int, note: Callable[[str], None] | None) -> None:
        self.violations: list[str] = []
        self.events: list[str] = []
        self.alive = True
        self.death = ""
        self._keep = keep
        self._note = note

    def _violate(self, text: str) -> None:
        """Note something the peer must not do."""
        if len(self.violations) < self._keep:
            self.violations.append(text)
        if self._note:
            self._note(text)

    def _event(self, text: str) -> None:
        """Note something that happened."""
        if len(self.events) < self._keep:
            self.events.append(text)

    def _die(self, text: str) -> NoReturn:
        """Note what kills a deployed program, and end."""
        self.alive, self.death = False, text
        self._violate(text)
        raise self._DEATH(f"died: {text}")
