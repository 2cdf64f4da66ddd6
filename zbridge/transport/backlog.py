"""Measures how long the oldest written byte has waited for its acknowledgement. Sans-IO.

A transport reports how many bytes are outstanding, not for how long. So each write is recorded with its time, and
removed when it is acknowledged; acknowledgements come in the order of the writes.
"""

from __future__ import annotations

from collections import deque

LEAST_S = 1e-9
"""The age of a write that was just made, by any clock: 0 would mean that nothing waits."""
ENTRIES = 1024
"""Most writes with a time of their own; a further write shares the time of the last one."""


class Backlog:
    """The writes not known to be acknowledged."""

    def __init__(self) -> None:
        self._entries: deque[tuple[int, float]] = deque()
        """For each write: the bytes written up to its end, and when."""
        self._written = 0
        self.since: float | None = None
        """When the oldest byte was written that is not known to be acknowledged; None if there is none."""

    def __repr__(self) -> str:
        return f"<Backlog of {len(self._entries)} writes>"

    def written(self, size: int, now: float) -> None:
        """Record a write of ``size`` bytes."""
        self._written += size
        if len(self._entries) >= ENTRIES:
            _, now = self._entries.pop()
        self._entries.append((self._written, now))
        if self.since is None:
            self.since = now

    def waited_s(self, now: float) -> float:
        """Return for how long the oldest write has waited; 0 only if there is none, even if the clock stands still."""
        return max(now - self.since, LEAST_S) if self.since is not None else 0.0

    def settle(self, outstanding: int) -> None:
        """Remove the acknowledged writes: all but the last ``outstanding`` bytes."""
        acknowledged = self._written - outstanding
        while self._entries and self._entries[0][0] <= acknowledged:
            self._entries.popleft()
        self.since = self._entries[0][1] if self._entries else None
