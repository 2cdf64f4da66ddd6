"""The accounts of a judge: violations, events, and the cause of its death. Sans-IO; knows no protocol.

A judge is a simulated peer as fragile as the deployed ones. Judges share this module with each other, and no code with
the gateway that they judge.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn


class Ended(Exception):
    """A judge died, or has nothing left to do: raised to end its tasks."""


class Judge:
    """The accounts of one judge. ``keep``: most entries of every list; ``note``: called with each violation."""

    def __init__(self, *, keep: int, note: Callable[[str], None] | None) -> None:
        self.violations: list[str] = []
        self.events: list[str] = []
        self.alive = True
        self.death = ""
        """The violation that killed it."""
        self._keep = keep
        self._note = note

    def _violate(self, text: str) -> None:
        """Record what the protocol page forbids; beyond ``keep`` entries it is only noted."""
        if len(self.violations) < self._keep:
            self.violations.append(text)
        if self._note:
            self._note(text)

    def _event(self, text: str) -> None:
        """Record what happened and is no violation; dropped beyond ``keep`` entries."""
        if len(self.events) < self._keep:
            self.events.append(text)

    def _die(self, text: str) -> NoReturn:
        """Record a violation that kills a deployed program; raise Ended."""
        self.alive, self.death = False, text
        self._violate(text)
        raise Ended(f"died: {text}")


def show(data: bytes, limit: int = 60) -> str:
    """Write bytes in hex for a sentence, the first ``limit`` of them."""
    return shorten(data[:limit].hex(" "), data, limit)


def shorten(shown: str, data: bytes, limit: int) -> str:
    """Complete ``shown``, which is how the first ``limit`` bytes of ``data`` are written."""
    rest = f"... ({len(data)} bytes)" if len(data) > limit else ""
    return (shown or "(no bytes)") + rest
