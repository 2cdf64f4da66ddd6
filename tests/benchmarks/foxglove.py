"""``python -m tests.benchmarks.foxglove``: what ``zbridge foxglove`` costs, and what it adds to a bare Python relay.

1. Ten robots (scans of 769 points at 10 Hz, poses at 20 Hz, states at 1 Hz) are shown to three viewers that subscribed
   to everything: the server's share of a core.
2. One robot's scans go from a put on the bus to a WebSocket, in turns by the server and by a relay that only
   subscribes and sends: the p50 of both in the same run.

The publisher and the viewers are processes of their own; the server is measured by its own processor time.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import sys
import time
from pathlib import Path

from tests.e2e.conftest import free_port
from tests.e2e.processes import Part

SECONDS = 10.0
ROUNDS, ROUND_S = 6, 3.0
ROBOTS, VIEWERS = 10, 3
SHARE_GOAL, LATENCY_GOAL = 0.20, 1.3
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def here(name: str, *arguments: object) -> list[str]:
    """Give the command of a part of this benchmark."""
    return [sys.executable, "-m", f"tests.benchmarks.foxglove_{name}", *map(str, arguments)]


def used_s(pid: int) -> float:
    """Give the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK_S


def served(stack: contextlib.ExitStack, endpoint: str) -> tuple[Part, int]:
    """Start the server; give it and its port."""
    port = free_port()
    command = [sys.executable, "-m", "zbridge", "foxglove", "--connect", endpoint, "--listen", f"127.0.0.1:{port}"]
    server = Part(stack, *command)
    assert "Foxglove connects to" in server.line()
    return server, port


def share() -> float:
    """Give the server's share of a core."""
    with contextlib.ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        robots = Part(stack, *here("robots", endpoint, ROBOTS, 10))
        robots.line()
        server, port = served(stack, endpoint)
        viewers = Part(stack, *here("viewers", port, VIEWERS, ROBOTS))
        assert viewers.line() == "subscribed"
        time.sleep(2.0)
        before, began = used_s(server.pid), time.monotonic()
        viewers.say("count")
        first = int(viewers.line())
        time.sleep(SECONDS)
        viewers.say("count")
        shown, took_s = int(viewers.line()) - first, time.monotonic() - began
        used = (used_s(server.pid) - before) / took_s
        print(f"{ROBOTS} robots, {VIEWERS} viewers: {shown / took_s:.0f} messages/s, {used:.1%} of a core")
        return used


def latency() -> float:
    """Give the p50 from the bus to a WebSocket, as a multiple of a bare relay's."""
    with contextlib.ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        robots = Part(stack, *here("robots", endpoint, 1, 50))
        robots.line()
        _, ours = served(stack, endpoint)
        theirs = free_port()
        relay = Part(stack, *here("relay", endpoint, theirs))
        relay.line()
        times: dict[str, list[float]] = {"zbridge": [], "relay": []}
        for number in range(2 * ROUNDS):
            name, port = (("zbridge", ours), ("relay", theirs))[number % 2]
            taker = Part(stack, *here("taker", name, port, ROUND_S))
            times[name].append(float(taker.line()))
        for name, values in times.items():
            print(f"{name}: p50 of {ROUNDS} rounds, us: {' '.join(f'{value:.0f}' for value in values)}")
        ratio = statistics.median(times["zbridge"]) / statistics.median(times["relay"])
        print(f"from the bus to a WebSocket: p50 {ratio:.2f} x a bare relay's")
        return ratio


def main() -> int:
    """Print both figures; 1 if one of the goals is missed."""
    missed = [share() > SHARE_GOAL, latency() > LATENCY_GOAL]
    return int(any(missed))


if __name__ == "__main__":
    sys.exit(main())
