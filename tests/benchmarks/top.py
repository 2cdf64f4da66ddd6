"""What ``zbridge top`` costs in a terminal of 80x24, while robots publish once a second through a real router.

``python -m tests.benchmarks.top [--robots 200] [--seconds 20]``. Sorted by processor, which changes with each message:
every row moves every second.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.fleet_scene import Routers, wait_until
from tests.benchmarks.harness import ROOT, BenchmarkError, cpu_s, process, thread_cpu_s

CPU_GOAL, MEMORY_GOAL_MB = 10.0, 50.0
"""Per cent of a core, megabytes."""
SETTLE_S = 8.0
"""Seconds until what starting costs is over."""


class Terminal:
    """``zbridge top`` in a terminal of its own, whose output is read and counted."""

    def __init__(self, *arguments: str) -> None:
        self.written = 0
        self.last = b""
        ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "zbridge", "top", *arguments],
            cwd=ROOT,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "TERM": "xterm-256color"},
        )
        os.close(theirs)
        self._ours = ours
        self.pid = self._process.pid
        threading.Thread(target=self._read, daemon=True).start()

    def alive(self) -> bool:
        return self._process.poll() is None

    def end(self) -> None:
        """Press q, and wait."""
        with contextlib.suppress(OSError):
            os.write(self._ours, b"q")
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._ours)

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := os.read(self._ours, 65_536):
                self.written += len(data)
                self.last = (self.last + data)[-20_000:]


@contextlib.contextmanager
def terminal(*arguments: str) -> Iterator[Terminal]:
    running = Terminal(*arguments)
    try:
        yield running
    finally:
        running.end()


def memory_mb(pid: int) -> dict[str, float]:
    """Read what a process occupies, by kind: megabytes of 10**6 bytes."""
    kinds = dict.fromkeys(("Rss", "Pss", "Private_Clean", "Private_Dirty"), 0.0)
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        name = line.partition(":")[0]
        if name in kinds:
            kinds[name] = int(line.split()[1]) * 1024 / 1e6
    return kinds


def measure(endpoint: str, robots: int, seconds: float) -> bool:
    with (
        process("tests.benchmarks.top_robots", endpoint, robots) as fleet,
        terminal("--connect", endpoint, "--sort", "cpu") as top,
    ):
        fleet.hear()
        wait_until(lambda: b"robot-" in top.last or not top.alive(), 60.0, "the table")
        time.sleep(SETTLE_S)
        if not top.alive() or f"{robots} robots: {robots} established".encode() not in top.last:
            raise BenchmarkError(top.last[-2000:].decode(errors="replace"))
        begun, before, written, threads = time.monotonic(), cpu_s(top.pid), top.written, thread_cpu_s(top.pid)
        time.sleep(seconds)
        took = time.monotonic() - begun
        share, memory = 100 * (cpu_s(top.pid) - before) / took, memory_mb(top.pid)
        spent = {}
        for thread, (name, until_s) in thread_cpu_s(top.pid).items():
            since_s = threads.get(thread, ("", 0.0))[1]
            spent[name] = spent.get(name, 0.0) + 100 * (until_s - since_s) / took
        written = top.written - written
    private = memory["Private_Clean"] + memory["Private_Dirty"]
    print(f"{robots} robots, {seconds:g} s, 80x24, {written / took / 1e3:.1f} kB/s to the terminal")
    print(f"processor: {share:.1f} % of a core (goal {CPU_GOAL:g}); by thread:", _listed(spent))
    print(
        f"memory: {private:.1f} MB private, {memory['Pss']:.1f} MB proportional (goal {MEMORY_GOAL_MB:g}), "
        f"{memory['Rss']:.1f} MB resident with shared libraries"
    )
    return share <= CPU_GOAL and memory["Pss"] <= MEMORY_GOAL_MB


def _listed(spent: dict[str, float]) -> str:
    return ", ".join(f"{name} {share:.1f}" for name, share in sorted(spent.items(), key=lambda each: -each[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=20.0)
    asked = parser.parse_args()
    routers = Routers(1)
    try:
        met = measure(routers.endpoints[0], asked.robots, asked.seconds)
    finally:
        routers.end()
    sys.exit(not met)


if __name__ == "__main__":
    main()
