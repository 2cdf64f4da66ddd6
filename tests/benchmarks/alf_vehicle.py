"""The vehicle of the ALF benchmark: a plain socket that says its geometry and then sends scans as told.

``python -m tests.benchmarks.alf_vehicle DIALECT COUNT RATE_HZ``; a rate of 0 is as fast as the socket takes it.
Paced, it says its drive info once a second as well. A thread of its own reads the drive commands, which never cease.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
import time

from tests.benchmarks import alf_wire
from tests.benchmarks.peer import drive, tell

ACCEPT_S = 20.0
JOINED = 16
"""Scans in one write of a saturated run."""


def main() -> None:
    """Serve one HQ."""
    dialect: alf_wire.Dialect = "binary" if sys.argv[1] == "binary" else "text"
    count, rate_hz = int(sys.argv[2]), float(sys.argv[3])
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(ACCEPT_S)
        tell(port=server.getsockname()[1])
        link, _ = server.accept()
    begun_s = time.monotonic()
    commands = 0

    def read() -> None:
        nonlocal commands
        with contextlib.suppress(OSError):
            while data := link.recv(4096):
                commands += alf_wire.commands(dialect, data)

    def scan(number: int) -> bytes:
        return alf_wire.scan(dialect, number, int((time.monotonic() - begun_s) * 1000))

    def send(number: int) -> None:
        link.sendall(scan(number))
        if number and rate_hz and not number % round(rate_hz):
            link.sendall(alf_wire.info(dialect))

    def flood() -> None:
        for low in range(1, count + 1, JOINED):
            link.sendall(b"".join([scan(number) for number in range(low, min(low + JOINED, count + 1))]))

    with link:
        link.settimeout(None)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.sendall(alf_wire.geometry(dialect))
        threading.Thread(target=read, daemon=True).start()
        drive(count, rate_hz, send, flood)
        while sys.stdin.readline():  # until the harness ends this process
            tell(commands=commands)


if __name__ == "__main__":
    main()
