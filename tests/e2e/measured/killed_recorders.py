"""Recorders that are killed at any moment: every file is readable to its cut, and lacks a second at most.

python -m tests.e2e.measured.killed_recorders --times 100
"""

from __future__ import annotations

import argparse
import contextlib
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader

from tests.benchmarks.recording_source import scans
from tests.e2e.conftest import HOST, configuration
from tests.ports import free_port
from zbridge.views.recording.reader import RecordingReader

SCAN_HZ = 200.0
LATE_S = 1.0
"""Seconds besides that one, on a busy machine."""


@dataclass
class Killed:
    """One recorder that was killed. lacks_s: between its end and its last message."""

    ours: int
    theirs: int
    lacks_s: float
    fault: str | None


def publish(session: zenoh.Session, ended: threading.Event) -> None:
    """Publish scans until the end."""
    publisher, payloads = session.declare_publisher("fleet/k1/scan"), scans(100)
    while not ended.wait(1 / SCAN_HZ):
        publisher.put(random.choice(payloads))


def kill_one(endpoint: str, path: Path, seconds: float) -> Killed:
    """Record for so long, kill, and read the file in both ways."""
    command = [sys.executable, "-m", "zbridge", "record", "--all", "--only", "fleet", "-o", str(path)]
    recorder = subprocess.Popen([*command, "--connect", endpoint], stderr=subprocess.PIPE, text=True)
    assert recorder.stderr is not None
    recorder.stderr.readline()
    time.sleep(seconds)
    recorder.send_signal(signal.SIGKILL)
    killed_ns = time.time_ns()
    recorder.wait()
    recorder.stderr.close()
    with path.open("rb") as file:
        reader = RecordingReader(file)
        ours = list(reader.messages())
    theirs = 0
    with path.open("rb") as file, contextlib.suppress(McapError, EOFError):
        for record in StreamReader(file, validate_crcs=True).records:
            theirs += type(record).__name__ == "Message"
    last_ns = ours[-1].log_ns if ours else killed_ns - int(seconds * 1e9)
    return Killed(len(ours), theirs, (killed_ns - last_ns) / 1e9, reader.fault)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--times", type=int, default=100)
    wanted = parser.parse_args()
    endpoint, ended, rng = f"tcp/{HOST}:{free_port()}", threading.Event(), random.Random(1)
    kills: list[Killed] = []
    with zenoh.open(configuration("router", endpoint)) as session, tempfile.TemporaryDirectory() as folder:
        source = threading.Thread(target=publish, args=(session, ended))
        source.start()
        for number in range(wanted.times):
            path = Path(folder) / f"{number}.mcap"
            kills.append(kill_one(endpoint, path, rng.uniform(0.0, 2.5)))
            path.unlink()
        ended.set()
        source.join()
    good = [
        kill
        for kill in kills
        if kill.ours == kill.theirs and (kill.fault or "").startswith("cut off") and kill.lacks_s < 1.0 + LATE_S
    ]
    lacks = sorted(kill.lacks_s for kill in kills)
    messages = sum(kill.ours for kill in kills)
    print(f"{len(good)} of {len(kills)} readable to the cut, {messages} messages, at most {lacks[-1]:.2f} s lacking")
    sys.exit(len(good) != len(kills))


if __name__ == "__main__":
    main()
