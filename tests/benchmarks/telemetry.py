"""What a busy robot sends: 500 positions and 40 maps of 6 kB a second, on a socket that somebody else reads.

``python -m tests.benchmarks.telemetry DESCRIPTOR``; ``load`` begins, ``calm`` ends.
"""

from __future__ import annotations

import socket
import sys
import time

from tests.benchmarks import wire
from tests.benchmarks.peer import hear

POSITIONS_HZ = 500
MAPS_HZ = 40
SIDE = 78
"""Cells along a side of a map: 6084 bytes of cells, about what a laser scan takes on the bus."""


def main() -> None:
    """Send while told to; the process ends with its stdin."""
    link = socket.socket(fileno=int(sys.argv[1]))
    frame = wire.slam_map(SIDE)
    while True:
        if hear() == "load":
            _load(link, frame)


def _load(link: socket.socket, frame: bytes) -> None:
    """Send one position each tick, and a map whenever one is due, until told otherwise."""
    begun_s, sent = time.perf_counter(), 0
    while hear(max(0.0, begun_s + sent / POSITIONS_HZ - time.perf_counter())) is None:
        link.sendall(wire.position(sent))
        sent += 1
        if sent * MAPS_HZ // POSITIONS_HZ > (sent - 1) * MAPS_HZ // POSITIONS_HZ:
            link.sendall(frame)


if __name__ == "__main__":
    main()
