"""Limits how much of a camera's stream is read and forwarded. Sans-IO: ``now`` is in seconds on any clock."""

from __future__ import annotations

from typing import Generic, TypeVar

T = TypeVar("T")

BYTES_S = 32 * 1024 * 1024
"""Most bytes a second that are read from a camera; one that sends more waits."""
PICTURES_S = 240
"""Most pictures a second that are read from a camera; one that sends more waits."""


class ReadBudget:
    """Bounds the cost of a camera: returns how long to pause after a read. Up to one second's worth accumulates."""

    def __init__(self) -> None:
        self._paid_until = 0.0

    def pause_s(self, size: int, pictures: int, now: float) -> float:
        """Count bytes and pictures that were read; return for how long nothing is to be read, seconds."""
        self._paid_until = max(self._paid_until, now - 1.0) + max(size / BYTES_S, pictures / PICTURES_S)
        return max(0.0, self._paid_until - now)


class Pace(Generic[T]):
    """Forwards ``rate_hz`` items a second, the newest of those waiting. After :meth:`offer`, call :meth:`due`."""

    def __init__(self, rate_hz: float) -> None:
        self.dropped = 0
        """Items that a newer one replaced while they waited."""
        self._interval_s = 1.0 / rate_hz
        self._next_at = 0.0
        self._waiting: T | None = None

    def __repr__(self) -> str:
        return f"<Pace {self._waiting is not None}, {self.dropped} dropped>"

    def offer(self, item: T) -> None:
        """Offer the newest item."""
        self.dropped += self._waiting is not None
        self._waiting = item

    def due(self, now: float) -> T | None:
        """Return the item that may be forwarded now; None: nothing waits, or it is too early.

        One item may be early by an interval: cameras are not regular.
        """
        if self._waiting is None or now < self._next_at:
            return None
        self._next_at = max(self._next_at, now - self._interval_s) + self._interval_s
        item, self._waiting = self._waiting, None
        return item

    def deadline(self) -> float | None:
        """Return when the waiting item is due; None: nothing waits."""
        return None if self._waiting is None else self._next_at
