"""What the console costs: processor and memory beside its pages, and how soon a page is drawn.

``python -m tests.benchmarks.console [--robots 10] [--pages 20] [--seconds 20]``: pages are sockets that take all they
get, in a process of their own, so that a browser's own work does not slow down what it is sent.
``python -m tests.benchmarks.console --hours 1``: memory while pages come and go.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from tests.benchmarks.fleet_scene import Routers
from tests.benchmarks.harness import ROOT, BenchmarkError, cpu_s, memory_mb, process
from tests.browser.conftest import CHROMIUM, chromium

CPU_GOAL, PAINT_GOAL_S, GROWTH_GOAL = 15.0, 0.6, 5.0
"""Per cent of a core; seconds; per cent of memory in an hour."""
STEP_S = 300
"""Seconds between two readings of memory."""
PAINTS = 10
STALL_S = 20.0
SETTLE_S = 5.0
CHURNING = 10
"""Pages that come and go at a time."""


class ConsoleProcess:
    """``zbridge console`` on the bus of a router."""

    def __init__(self, endpoint: str, folder: Path) -> None:
        command = ("console", "--listen", "127.0.0.1:0", "--roster", str(folder / "roster"), "--connect", endpoint)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "zbridge", *command], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        self.at = self._process.stdout.readline().split()[-1]
        self.pid = self._process.pid

    def end(self) -> None:
        self._process.terminate()
        self._process.wait(10)


@contextlib.contextmanager
def scene(robots: int) -> Iterator[ConsoleProcess]:
    """Run a router, robots, and a console."""
    routers = Routers(1)
    with contextlib.ExitStack() as stack:
        stack.callback(routers.end)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        moving = stack.enter_context(process("tests.benchmarks.console_robots", routers.endpoints[0], robots))
        moving.hear()
        console = ConsoleProcess(routers.endpoints[0], folder)
        stack.callback(console.end)
        time.sleep(SETTLE_S)
        yield console


def share(pid: int, seconds: float) -> float:
    """Measure the processor that a process uses, per cent of a core."""
    began, before = time.monotonic(), cpu_s(pid)
    time.sleep(seconds)
    return 100 * (cpu_s(pid) - before) / (time.monotonic() - began)


def measure_processor(console: ConsoleProcess, robots: int, pages: int, seconds: float) -> bool:
    alone = share(console.pid, seconds)
    with process("tests.benchmarks.console_pages", console.at, pages, robots) as looking:
        for _ in range(round(SETTLE_S)):
            first = looking.hear()
        used = share(console.pid, seconds)
        for _ in range(round(seconds)):
            last = looking.hear()
    messages, size = ((last[name] - first[name]) / seconds for name in ("messages", "bytes"))
    print(f"{pages} pages at {robots} robots: {messages:.0f} messages and {size / 1e6:.1f} MB a second")
    print(f"processor: {used:.1f} % of a core (goal {CPU_GOAL:g}); {alone:.1f} % without pages")
    if messages < pages * 10:
        raise BenchmarkError(f"a page got {messages / pages:.1f} messages a second")
    return used <= CPU_GOAL


def stalled_page(at: str) -> socket.socket:
    """Open a page that asks for a robot and then reads nothing, with a small buffer."""
    host, port = at.removeprefix("http://").split(":")
    opened = socket.create_connection((host, int(port)))
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    head = (
        f"GET /socket HTTP/1.1\r\nHost: {host}:{port}\r\nOrigin: {at}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    opened.sendall(head.encode())
    if b"101" not in opened.recv(64):
        raise BenchmarkError("the console opened no socket")
    text = json.dumps({"do": "look", "robot": "robot-000"}).encode()
    opened.sendall(bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text)
    return opened


def measure_stall(console: ConsoleProcess) -> bool:
    with contextlib.closing(stalled_page(console.at)):
        time.sleep(SETTLE_S)
        before = memory_mb(console.pid)
        time.sleep(STALL_S)
        after = memory_mb(console.pid)
    print(f"a page that reads nothing for {STALL_S:g} s: {before:.1f} MB, then {after:.1f} MB")
    return after - before < 1.0


def measure_paint(console: ConsoleProcess) -> bool:
    async def paint() -> list[float]:
        times = []
        async with chromium() as running:
            for _ in range(PAINTS):
                page = await (await running.new_context()).new_page()
                await page.goto(console.at)
                await page.locator(".tall .row").first.wait_for()
                entry = "performance.getEntriesByName('first-contentful-paint')[0].startTime / 1000"
                times.append(await page.evaluate(entry))
        return times

    times = asyncio.run(paint())
    print(f"first paint: {median(times):.2f} s median, {max(times):.2f} s at most (goal {PAINT_GOAL_S:g})")
    return max(times) <= PAINT_GOAL_S


def measure_hours(console: ConsoleProcess, robots: int, hours: float) -> bool:
    with process("tests.benchmarks.console_pages", console.at, CHURNING, robots, "churn") as looking:
        ends = time.monotonic() + 3600 * hours
        for _ in range(60):
            looking.hear()
        print(f"{memory_mb(console.pid):.1f} MB after a minute", flush=True)
        found = []
        while time.monotonic() < ends or len(found) < 2:
            for _ in range(STEP_S):
                last = looking.hear()
            found.append(memory_mb(console.pid))
            print(f"{found[-1]:.1f} MB, {last['pages']} pages came and went", flush=True)
        growth = 100 * (max(found) / found[0] - 1)  # before, the allocator still fills its arenas
    print(f"memory: at most {growth:+.1f} % of that after six minutes, in {hours:g} h (goal {GROWTH_GOAL:g} %)")
    return growth <= GROWTH_GOAL


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--pages", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--hours", type=float, default=0.0)
    asked = parser.parse_args()
    with scene(asked.robots) as console:
        if asked.hours:
            met = [measure_hours(console, asked.robots, asked.hours)]
        else:
            met = [measure_processor(console, asked.robots, asked.pages, asked.seconds), measure_stall(console)]
            if CHROMIUM is not None:
                met.append(measure_paint(console))
    sys.exit(not all(met))


if __name__ == "__main__":
    main()
