"""What the fleet benchmarks share: routers, robot files, gateway processes, what they cost, and who is on the bus."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.harness import ROOT, BenchmarkError, Process, cpu_s
from tests.ports import free_port
from zbridge.client import Fleet, connect
from zbridge.errors import BusError

SOON_S = 150.0
"""Longest wait for a fleet."""
_ZBRIDGE = (sys.executable, "-m", "zbridge")


class Command:
    """A zbridge command that runs until it is ended; its log goes to a file."""

    def __init__(self, *arguments: object) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process lives
        self._process = subprocess.Popen(
            [*_ZBRIDGE, *map(str, arguments)], cwd=ROOT, stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log
        )
        self.pid = self._process.pid

    def log(self) -> str:
        """Return what it logged so far."""
        size = os.fstat(self._log.fileno()).st_size
        return os.pread(self._log.fileno(), size, 0).decode(errors="replace")

    def alive(self) -> bool:
        return self._process.poll() is None

    def end(self, number: int = signal.SIGTERM) -> None:
        """End it and wait; idempotent."""
        if self.alive():
            self._process.send_signal(number)
            try:
                self._process.wait(10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


@contextlib.contextmanager
def command(*arguments: object) -> Iterator[Command]:
    """Run a zbridge command while the context lasts."""
    running = Command(*arguments)
    try:
        yield running
    finally:
        running.end()


class Routers:
    """Linked routers on loopback: each connects to all before it."""

    def __init__(self, count: int) -> None:
        self.endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(count)]
        self.running = [self._start(number) for number in range(count)]

    def restart(self, number: int) -> None:
        """Kill a router and start it again at once."""
        self.running[number].end(signal.SIGKILL)
        self.running[number] = self._start(number)

    def end(self) -> None:
        for router in self.running:
            router.end()

    def _start(self, number: int) -> Command:
        links = [word for endpoint in self.endpoints[:number] for word in ("--connect", endpoint)]
        router = Command("router", "--listen", self.endpoints[number], *links)
        wait_until(lambda: "router at" in router.log() or not router.alive(), 20.0, "a router")
        if not router.alive():
            raise BenchmarkError(router.log())
        return router


def robot_file(directory: Path, name: str, port: int, router: str) -> Path:
    """Write a robot's file."""
    file = directory / f"{name}.toml"
    file.write_text(
        f'[robot]\nname = "{name}"\n[device]\nprotocol = "wc2ec"\nconnect = ["tcp://127.0.0.1:{port}"]\n'
        f'[bus]\nmode = "client"\nconnect = ["{router}"]\nmulticast = false\n'
    )
    return file


@dataclass(frozen=True)
class Cost:
    """What processes take: private megabytes, threads, seconds of CPU."""

    private_mb: float
    threads: int
    cpu_s: float

    @classmethod
    def of(cls, pids: Sequence[int]) -> Cost:
        private_kb = threads = 0
        for pid in pids:
            for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
                if line.startswith("Private_"):
                    private_kb += int(line.split()[1])
            threads += len(list(Path(f"/proc/{pid}/task").iterdir()))
        return cls(private_kb * 1024 / 1e6, threads, sum(map(cpu_s, pids)))


def share_of_a_core(pids: Sequence[int], seconds: float) -> float:
    """Measure the CPU of processes over some seconds, in per cent of a core."""
    before, begun = Cost.of(pids).cpu_s, time.monotonic()
    time.sleep(seconds)
    return 100 * (Cost.of(pids).cpu_s - before) / (time.monotonic() - begun)


def wait_until(condition: object, timeout_s: float, what: str) -> None:
    assert callable(condition)
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise BenchmarkError(f"{what}: not within {timeout_s:g} s")
        time.sleep(0.02)


def when_established(endpoint: str, count: int, begun_s: float, timeout_s: float = SOON_S) -> float:
    """Ask the bus until so many robots are established; return the seconds since ``begun_s``."""

    async def ask() -> float:
        async with contextlib.AsyncExitStack() as stack:
            fleet = await _join(stack, endpoint)
            while True:
                robots = await fleet.robots()
                there = sum(status is not None and status.state == "established" for status in robots.values())
                if there >= count:
                    return time.monotonic() - begun_s
                if time.monotonic() - begun_s > timeout_s:
                    missing = [
                        name for name, status in robots.items() if status is None or status.state != "established"
                    ]
                    raise BenchmarkError(
                        f"{there} of {count} robots after {timeout_s:g} s; not: {missing[:5]}, {len(robots)} tokens"
                    )
                await asyncio.sleep(0.05)

    return asyncio.run(ask())


async def _join(stack: contextlib.AsyncExitStack, endpoint: str) -> Fleet:
    """Join the bus; again where the router has too much to do to answer within a second."""
    for _ in range(int(SOON_S)):
        with contextlib.suppress(BusError):
            return await stack.enter_async_context(connect(endpoint))
    raise BenchmarkError(f"no router at {endpoint}")


def listed(endpoint: str) -> tuple[int, float]:
    """Run ``zbridge ls --json``; return how many established robots it printed, and its seconds."""
    begun = time.monotonic()
    done = subprocess.run(
        [*_ZBRIDGE, "ls", "--json", "--connect", endpoint], cwd=ROOT, capture_output=True, text=True, check=False
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return sum(row["state"] == "established" for row in rows), time.monotonic() - begun


def ports(robots: Process) -> list[int]:
    """Return where the robots of a process listen."""
    return list(robots.hear()["ports"])
