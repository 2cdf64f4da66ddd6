"""Since when a peer's machine has owed the acknowledgement of what was written to it. Sans-IO.

The transport tells how many bytes are outstanding, not for how long. So every write is entered with its time, and what
is acknowledged is taken out again: the kernel acknowledges in order.
"""

from __future__ import annotations

from collections import deque

ENTRIES = 1024
"""Writes whose times are kept apart; later ones count as written with the last of these."""


class Backlog:
    """The bytes that were written and are not known to be acknowledged."""

    def __init__(self) -> None:
        self._entries: deque[tuple[int, float]] = deque()
        """For each write, how many bytes were written up to its end, and when."""
        self._written = 0
        self.since: float | None = None
        """When the oldest byte was written that is not known to be acknowledged; None where there is none."""

    def __repr__(self) -> str:
        return f"<Backlog of {len(self._entries)} writes>"

    def written(self, size: int, now: float) -> None:
        """Enter a write of ``size`` bytes."""
        self._written += size
        if len(self._entries) >= ENTRIES:
            _, now = self._entries.pop()
        self._entries.append((self._written, now))
        if self.since is None:
            self.since = now

    def settle(self, outstanding: int) -> None:
        """Take out what is acknowledged: all but the last ``outstanding`` bytes."""
        acknowledged = self._written - outstanding
        while self._entries and self._entries[0][0] <= acknowledged:
            self._entries.popleft()
        self.since = self._entries[0][1] if self._entries else None
