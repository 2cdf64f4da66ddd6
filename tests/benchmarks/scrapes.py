"""What scrapes of a whole host cost: ``python -m tests.benchmarks.scrapes [--robots 200] [--windows 4]``.

Silent robots, one gateway process each, one supervisor whose endpoint is scraped; all processes but robots and router
are measured. Windows with two scrapes a second take turns with windows without; the difference is what a scrape costs.
Goal: 2 % of a core for 200 gateways that are scraped every 15 s.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from tests.benchmarks.fleet_scene import Routers, command, ports, robot_file, when_established
from tests.benchmarks.harness import cpu_s, process
from tests.ports import free_port
from tests.scraped import samples, scrape

WINDOW_S = 10.0
APART_S = 0.5
EVERY_S = 15.0
"""How often Prometheus scrapes, usually."""


def below(pid: int) -> list[int]:
    """List a process and all that descend from it."""
    children = [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [pid, *(each for child in children for each in below(child))]


def window(pids: list[int], port: int, *, scraped: bool) -> tuple[float, list[float]]:
    """Return the seconds of CPU of a window, and how long each of its scrapes took."""
    before, end, took = sum(map(cpu_s, pids)), time.monotonic() + WINDOW_S, list[float]()
    while time.monotonic() < end:
        begun = time.monotonic()
        if scraped:
            scrape(port)
            took.append(time.monotonic() - begun)
        time.sleep(max(0.0, begun + APART_S - time.monotonic()))
    return sum(map(cpu_s, pids)) - before, took


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--windows", type=int, default=4)
    options = parser.parse_args()
    with ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="zbridge-scrapes-")))
        robots = stack.enter_context(process("tests.benchmarks.fleet_robots", options.robots))
        routers = Routers(1)
        stack.callback(routers.end)
        for number, robot in enumerate(ports(robots)):
            robot_file(directory, f"r{number:03}", robot, routers.endpoints[0])
        port = free_port()
        (directory / "host.toml").write_text(f'[metrics]\nlisten = "127.0.0.1:{port}"\n')
        begun = time.monotonic()
        supervisor = stack.enter_context(command("run", directory))
        when_established(routers.endpoints[0], options.robots, begun)
        time.sleep(5.0)
        pids, page = below(supervisor.pid), scrape(port)
        up = sum(value for (name, _), value in samples(page).items() if name == "zbridge_gateway_up")
        costs, took = [], list[float]()
        for _ in range(options.windows):
            idle, _ = window(pids, port, scraped=False)
            busy, times = window(pids, port, scraped=True)
            costs.append((busy - idle) / len(times))
            took += times
    cost_s = statistics.median(costs)
    print(f"{up:.0f} of {options.robots} gateways, {len(samples(page))} series, {len(page) / 1e6:.1f} MB")
    print(f"a scrape takes {1000 * statistics.median(took):.0f} ms, at most {1000 * max(took):.0f} ms")
    print(f"and {1000 * cost_s:.0f} ms of CPU: {100 * cost_s / EVERY_S:.2f} % of a core every {EVERY_S:g} s")


if __name__ == "__main__":
    main()
