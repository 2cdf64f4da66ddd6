"""A process is frozen for a while, with real sockets and signals: it drops no peer that spoke meanwhile."""

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from tests.transport.frozen import LOOPS, SILENCE_S

REPORT_S = 0.02


@pytest.mark.parametrize("loop", LOOPS)
def test_a_process_that_was_frozen_reads_what_waits_before_it_judges_silence(loop: str) -> None:
    """An interrupted poll gives no events: without care the timers come first."""
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def report() -> None:
            conn, _ = server.accept()
            with conn, contextlib.suppress(OSError):
                conn.sendall(b"\x07welcome")
                while not ended.wait(REPORT_S):
                    conn.sendall(b"\x01a")
                conn.recv(1 << 20)
                conn.recv(1)  # it stays, and says nothing more

        robot = threading.Thread(target=report)
        robot.start()
        command = [sys.executable, "-m", "tests.transport.frozen", loop, str(server.getsockname()[1])]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "established\n"
            for frozen_s in (0.6, 1.0, 0.6):
                process.send_signal(signal.SIGSTOP)
                time.sleep(frozen_s)
                process.send_signal(signal.SIGCONT)
                time.sleep(SILENCE_S / 2)
                assert process.poll() is None, process.stdout.read()
            ended.set()
            assert process.stdout.read() == f"no report for {SILENCE_S:g} s\n"
        robot.join()
