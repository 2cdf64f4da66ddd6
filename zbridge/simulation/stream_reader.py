"""Reads a stream in a thread of its own, and measures how late the thread was. Knows no protocol.

A fragile peer takes one read as one packet. The kernel joins what waits, so joined packets are a violation only if the
reader was not late itself.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

_READ_BYTES = 65536
_STAMPS = 35
"""SO_TIMESTAMPNS of Linux, which Python does not name."""
STAMPED = ((socket.SOL_SOCKET, _STAMPS, 1),) if sys.platform == "linux" else ()
"""Options of a socket whose reads tell when their last byte arrived."""


class Read(NamedTuple):
    """The result of one read; ``data`` is empty at the end of the stream, for the reason ``why``.

    ``at``: monotonic seconds. ``late_s``: longest time for which the reader may have left the data unread.
    """

    at: float
    data: bytes
    late_s: float = 0.0
    why: str = ""


class StreamReader(threading.Thread):
    """Calls ``give`` with each read, on this thread, up to the end of the stream.

    ``tcp`` must be blocking; ``since``: time of day before which nothing can have arrived. The reader is late between
    the arrival of the last data and its next read, and while it is ready to run and has no processor.
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
    """Give the time of day when the kernel took the last byte read; now where it does not tell."""
    for level, kind, data in stamps:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _STAMPS, 16):
            seconds, nanoseconds = struct.unpack("qq", data)
            return float(seconds + nanoseconds * 1e-9)
    return time.time()


def _waited_s() -> float:
    """Give how long this thread was ready to run without a processor so far; 0 where the system does not tell."""
    with contextlib.suppress(OSError, ValueError, IndexError), open("/proc/thread-self/schedstat", "rb") as file:
        return int(file.read().split()[1]) * 1e-9
    return 0.0
