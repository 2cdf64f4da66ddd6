"""Processes, their CPU and memory, and ratios of paired runs. Linux only: reads ``/proc`` and process clocks."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 20.0
"""Longest wait for a line of a process."""
_END_S = 5.0

A = TypeVar("A")
B = TypeVar("B")


class BenchmarkError(Exception):
    """A process of the benchmark failed or said nothing in time."""


class Process:
    """A Python process of the benchmark: words to its stdin, lines of JSON from its stdout, ended by its id."""

    def __init__(self, module: str, *arguments: object) -> None:
        self.module = module
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process lives
        self.started_ns = time.perf_counter_ns()
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, arguments)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        self._lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def say(self, word: str) -> None:
        """Write one line to the process."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(word + "\n")
            self._process.stdin.flush()
        except OSError as error:
            raise self._failure("is gone") from error

    def hear(self, timeout_s: float = WAIT_S) -> dict[str, Any]:
        """Wait for one line of the process."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise self._failure(f"said nothing within {timeout_s:g} s") from None
        if line is None:
            raise self._failure("is gone")
        heard: dict[str, Any] = json.loads(line)
        return heard

    def signal(self, number: int) -> None:
        """Send a signal to the process."""
        self._process.send_signal(number)

    def end(self) -> None:
        """End the process, with force when it does not obey; idempotent."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(_END_S)
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with contextlib.suppress(ValueError, OSError):  # closed while reading
            for line in self._process.stdout:
                self._lines.put(line)
        self._lines.put(None)

    def _failure(self, what: str) -> BenchmarkError:
        self._errors.seek(0)
        said = self._errors.read()[-2000:].decode(errors="replace").strip()
        return BenchmarkError(f"{self.module} {what}{': ' + said if said else ''}")


@contextlib.contextmanager
def process(module: str, *arguments: object) -> Iterator[Process]:
    """Run a process while the context lasts."""
    running = Process(module, *arguments)
    try:
        yield running
    finally:
        running.end()


def cpu_s(pid: int) -> float:
    """Read the CPU time of all threads a process has or had, as ``/proc/PID/stat`` but to the nanosecond."""
    return time.clock_gettime((~pid << 3) | 2)  # clock_getcpuclockid(3): CPUCLOCK_SCHED of a process


def thread_cpu_s(pid: int) -> dict[int, tuple[str, float]]:
    """Read name and CPU time of every living thread of a process, by thread id."""
    threads = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # ended while reading
            spent_ns = int((task / "schedstat").read_text().split()[0])
            threads[int(task.name)] = ((task / "comm").read_text().strip(), spent_ns / 1e9)
    return threads


def memory_mb(pid: int) -> float:
    """Read the resident memory of a process (VmRSS), megabytes of 10**6 bytes."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise BenchmarkError(f"process {pid} has no VmRSS")


@dataclass(frozen=True)
class Spread:
    """Least, middle and greatest of several measurements."""

    least: float
    middle: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        return cls(min(values), median(values), max(values))

    def __str__(self) -> str:
        return f"{_short(self.least)} / {_short(self.middle)} / {_short(self.most)}"


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def pairs(count: int, first: Callable[[], A], second: Callable[[], B]) -> list[tuple[A, B]]:
    """Run two measurements in turn, ``count`` times: what disturbs one disturbs its neighbour as well."""
    return [(first(), second()) for _ in range(count)]
