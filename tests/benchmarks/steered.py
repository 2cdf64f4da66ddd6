"""The robot that is driven: notes when each read came, and says so when asked.

``python -m tests.benchmarks.steered``. What it sends under load is sent by a process of its own that has the same
socket (:mod:`tests.benchmarks.telemetry`): the thread that reads waits for nobody's interpreter lock.

Words: ``report`` gives the packets 11 and 13 since the last report; ``load`` and ``calm`` begin and end the telemetry.
"""

from __future__ import annotations

import contextlib
import gc
import socket
import subprocess
import sys
import threading
import time

from tests.benchmarks.drives import moves, stops
from tests.benchmarks.harness import ROOT
from tests.benchmarks.peer import hear, tell
from tests.benchmarks.robot import ACCEPT_S, shake_hands

_READ_BYTES = 65_536


def main() -> None:
    """Serve one HQ."""
    gc.disable()  # it lives for seconds
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(ACCEPT_S)
        tell(port=server.getsockname()[1])
        link, _ = server.accept()
    with link, _telemetry(link) as telemetry:
        link.settimeout(None)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        shake_hands(link)
        reads: list[tuple[int, bytes]] = []
        threading.Thread(target=_read, args=(link, reads), daemon=True).start()
        tell(connected=True)
        _obey(reads, telemetry)


def _telemetry(link: socket.socket) -> subprocess.Popen[bytes]:
    """Start the process that sends; it ends when its stdin does."""
    descriptor = link.fileno()
    command = [sys.executable, "-m", "tests.benchmarks.telemetry", str(descriptor)]
    return subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, pass_fds=(descriptor,))


def _read(link: socket.socket, reads: list[tuple[int, bytes]]) -> None:
    now_ns = time.perf_counter_ns
    with contextlib.suppress(OSError):
        while data := link.recv(_READ_BYTES):
            reads.append((now_ns(), data))


def _obey(reads: list[tuple[int, bytes]], telemetry: subprocess.Popen[bytes]) -> None:
    assert telemetry.stdin is not None
    while True:
        word = hear()
        if word == "report":
            count = len(reads)
            tell(moves=moves(reads[:count]), stops=stops(reads[:count]))
            del reads[:count]
        elif word:
            telemetry.stdin.write(f"{word}\n".encode())
            telemetry.stdin.flush()


if __name__ == "__main__":
    main()
