"""Carries what arrives on the bus to the writing thread, within a bound in bytes. Knows no file and no bus.

Bus threads put, the writing thread takes all at once. What does not fit is dropped and counted by key: the newest, so
that what is recorded has one hole instead of many.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

import msgspec

OVERHEAD_BYTES = 200
"""What a message costs in memory besides its payload, about."""
KEYS = 4096
"""Keys whose losses are counted apart; those of all others are counted together."""
OTHERS = "(other keys)"


class Arrival(msgspec.Struct, frozen=True, gc=False):
    """One message as it came in. arrived_ns: Unix time."""

    arrived_ns: int
    key: str
    payload: bytes
    attachment: bytes | None = None


class Losses(Counter[str]):
    """Messages lost, by key. One thread adds."""

    def add(self, key: str, count: int = 1) -> None:
        """Count lost messages of one key."""
        self[key if key in self or len(self) < KEYS else OTHERS] += count


class Intake:
    """The queue between bus and disk. bound_bytes: that may wait for the disk."""

    def __init__(self, bound_bytes: int) -> None:
        self.dropped = Losses()
        self._bound = bound_bytes
        self._lock = threading.Lock()
        self._waiting: list[Arrival] = []
        self._bytes = 0
        self._taken = 0
        self._closed = False

    def __repr__(self) -> str:
        return f"<Intake {len(self._waiting)} waiting, {self.dropped.total()} dropped>"

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> bool:
        """Queue a message, from any thread; False if it was dropped. Arrival times rise along the queue."""
        size = len(payload) + (len(attachment) if attachment is not None else 0)
        return self.put_sized(key, size, lambda: payload, attachment)

    def put_sized(self, key: str, size: int, read_payload: Callable[[], bytes], attachment: bytes | None) -> bool:
        """Queue a message of ``size`` bytes, whose payload is read only where there is room for it."""
        size += OVERHEAD_BYTES
        with self._lock:
            if self._closed:
                return False
            if self._bytes + size > self._bound:
                self.dropped.add(key)
                return False
            self._bytes += size
            self._waiting.append(Arrival(time.time_ns(), key, read_payload(), attachment))
        return True

    def close(self) -> None:
        """Queue nothing more: what comes from now on belongs to no recording, and is no loss."""
        with self._lock:
            self._closed = True

    def take(self) -> list[Arrival]:
        """Take all that waits. The messages taken before count as written now."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
            self._bytes -= self._taken
            self._taken = self._bytes
        return waiting
