"""When simulated peers act and read, and how late their own process was. Knows no protocol.

A judge holds a time against its peer only as far as the judge itself was not late.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from zbridge.simulation.sockets import readable

_READ_BYTES = 65536
_STAMPS = 35
"""SO_TIMESTAMPNS of Linux, which Python does not name."""
STAMPED = ((socket.SOL_SOCKET, _STAMPS, 1),) if sys.platform == "linux" else ()
"""Options of a socket whose reads report when their last byte arrived."""


class Ticker:
    """Ticks every ``period_s`` seconds, the first time after ``first_s`` (default: a period).

    A late tick delays those after it. ``catch_up_s``: lost time that ticks in quick succession make up for. ``clock``:
    seconds; None: monotonic ones.
    """

    def __init__(
        self,
        period_s: float,
        *,
        first_s: float | None = None,
        catch_up_s: float = 0.0,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self.passed_s = 0.0
        """Seconds between the last two ticks; before the second one, since the ticker was made."""
        self.late_s = 0.0
        """Seconds by which this process slept too long before the last tick."""
        self._period_s, self._catch_up_s = period_s, catch_up_s
        self._clock = clock or time.monotonic
        self._last = self._clock()
        self._due = self._last + (period_s if first_s is None else first_s)

    def __repr__(self) -> str:
        return f"<Ticker every {self._period_s:g} s, {self.late_s:.3f} s late>"

    async def tick(self) -> None:
        """Sleep until the next tick is due."""
        due = max(self._due, self._clock() - self._catch_up_s)
        await asyncio.sleep(due - self._clock())
        now = self._clock()
        self.passed_s, self.late_s = now - self._last, now - due
        self._last, self._due = now, due + self._period_s


class PollingReader:
    """Reads a non-blocking connection on request, and reports how long it had not polled.

    ``most_bytes``: of one read.
    """

    def __init__(self, tcp: socket.socket, most_bytes: int) -> None:
        self.unread_s = 0.0
        """Longest time for which the last data may have waited: it was not there at the previous poll."""
        self._tcp, self._most_bytes = tcp, most_bytes
        self._empty_at = time.monotonic()

    def poll(self) -> bytes | None:
        """Read without waiting: None if nothing is there, empty at the end of the stream; raise OSError."""
        polled_at, data = time.monotonic(), None
        with contextlib.suppress(BlockingIOError):
            data = self._tcp.recv(self._most_bytes)
            self.unread_s = time.monotonic() - self._empty_at
        if data is None or len(data) < self._most_bytes:
            self._empty_at = polled_at
        return data

    async def read(self, poll_s: float) -> bytes:
        """Read as soon as there is data; poll every ``poll_s``, to know since when there was none."""
        while (data := self.poll()) is None:
            await readable(self._tcp, poll_s)
        return data


class Read(NamedTuple):
    """The result of one read; ``data`` is empty at the end of the stream, for the reason ``why``.

    ``at``: monotonic seconds. ``late_s``: longest time for which the reader may have left the data unread.
    """

    at: float
    data: bytes
    late_s: float = 0.0
    why: str = ""


class ReadingThread(threading.Thread):
    """Calls ``give`` with each read, on this thread, up to the end of the stream.

    A fragile peer takes one read as one packet. The kernel joins what waits, so joined packets are a violation only if
    this thread was not late: between the arrival of the last data and its next read, or while it was ready to run and
    had no processor. ``tcp`` must be blocking; ``since``: time of day before which nothing can have arrived.
    """

    def __init__(self, tcp: socket.socket, since: float, give: Callable[[Read], object]) -> None:
        super().__init__(name="fragile-reads", daemon=True)
        self._tcp, self._arrived, self._give = tcp, since, give

    def run(self) -> None:
        """Read until the stream ends."""
        data = b" "
        while data:
            began, waited, why = time.time(), _waited_s(), ""
            try:
                data, stamps, _, _ = self._tcp.recvmsg(_READ_BYTES, 64)
            except OSError as error:
                data, stamps, why = b"", [], f"the connection broke: {error!r}"
            late_s = max(began - self._arrived, _waited_s() - waited)
            self._arrived = _stamp(stamps)
            self._give(Read(time.monotonic(), data, late_s, why))


def _stamp(stamps: Sequence[tuple[int, int, bytes]]) -> float:
    """Return the time of day when the kernel took the last byte read; now if it does not report it."""
    for level, kind, data in stamps:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _STAMPS, 16):
            seconds, nanoseconds = struct.unpack("qq", data)
            return float(seconds + nanoseconds * 1e-9)
    return time.time()


def _waited_s() -> float:
    """Return how long this thread was ready to run without a processor so far; 0 if the system does not report it."""
    with contextlib.suppress(OSError, ValueError, IndexError), open("/proc/thread-self/schedstat", "rb") as file:
        return int(file.read().split()[1]) * 1e-9
    return 0.0
