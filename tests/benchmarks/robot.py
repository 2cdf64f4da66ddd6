"""The robot of the benchmark: a plain socket that shakes hands as version 1.3 and then sends as told.

``python -m tests.benchmarks.robot KIND COUNT RATE_HZ``; a rate of 0 is as fast as the socket takes it.
"""

from __future__ import annotations

import socket
import sys

from tests.benchmarks import wire
from tests.benchmarks.peer import drive, tell

ACCEPT_S = 20.0
JOINED = 2000
"""Positions in one write of a saturated run."""


def main() -> None:
    """Serve one HQ."""
    kind, count, rate_hz = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(ACCEPT_S)
        tell(port=server.getsockname()[1])
        link, _ = server.accept()
    with link:
        link.settimeout(ACCEPT_S)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        shake_hands(link)
        if kind == "map":
            frame = wire.slam_map()
            drive(count, rate_hz, lambda _: link.sendall(frame), lambda: _flood(link, [frame] * count))
        else:
            chunks = [wire.positions(low, min(low + JOINED - 1, count)) for low in range(1, count + 1, JOINED)]
            drive(count, rate_hz, lambda number: link.sendall(wire.position(number)), lambda: _flood(link, chunks))
        while link.recv(4096):  # until the harness ends the other side, or this one
            pass


def shake_hands(link: socket.socket) -> None:
    """Send the settings and wait for the HQ's."""
    link.sendall(wire.server_settings())
    answer = b""
    while len(answer) < wire.HEADER.size or len(answer) < 4 + wire.HEADER.unpack_from(answer)[0]:
        answer += link.recv(4096)
    if answer[5] != wire.CLIENT_SETTINGS:
        raise SystemExit(f"expected clientSettings, got packet {answer[5]}")


def _flood(link: socket.socket, chunks: list[bytes]) -> None:
    for chunk in chunks:
        link.sendall(chunk)


if __name__ == "__main__":
    main()
