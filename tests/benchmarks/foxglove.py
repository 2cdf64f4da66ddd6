"""``python -m tests.benchmarks.foxglove``: what ``zbridge foxglove`` costs, and what it adds to a bare Python relay.

1. Ten robots (scans of 769 points at 10 Hz, poses at 20 Hz, states at 1 Hz) are shown to three viewers that subscribed
   to everything: the server's share of a core.
2. A robot's positions go from its socket through its gateway and the bus to a WebSocket, in turns by the server and by
   a relay that only subscribes and sends: the p50 of both in the same run.

The publisher and the viewers are processes of their own; the server is measured by its own processor time.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import statistics
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import msgpack
import zenoh
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.e2e.conftest import Gateway, configuration, device, until
from tests.e2e.rigs.processes import Part
from tests.e2e.rigs.robots import Robot, position
from tests.ports import free_port
from tests.views.protobuf import read
from zbridge.views.schemas import foxglove_schema

SECONDS = 10.0
ROUNDS, ROUND_S, PERIOD_S = 6, 3.0, 0.02
ROBOTS, VIEWERS = 10, 3
SHARE_GOAL, LATENCY_GOAL = 0.20, 1.3
_HEAD = 13
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
    """Give the p50 from a robot's socket to a WebSocket, as a multiple of a bare relay's."""
    with contextlib.ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        stack.enter_context(zenoh.open(configuration("router", endpoint)))
        robot = stack.enter_context(contextlib.closing(Robot()))
        file = Path(stack.enter_context(TemporaryDirectory())) / "r1.toml"
        gateway = Gateway(stack, file, endpoint, device(robot.port, options="length_unit_m = 1.0"))
        until(lambda: "established" in gateway.log, what="an established robot")
        _, ours = served(stack, endpoint)
        theirs = free_port()
        Part(stack, *here("relay", endpoint, theirs)).line()
        times: dict[str, list[float]] = {"zbridge": [], "relay": []}
        for number in range(2 * ROUNDS):
            name, port = (("zbridge", ours), ("relay", theirs))[number % 2]
            times[name].append(taken_us(robot, name, port))
        for name, values in times.items():
            print(f"{name}: p50 of {ROUNDS} rounds, us: {' '.join(f'{value:.0f}' for value in values)}")
        ratio = statistics.median(times["zbridge"]) / statistics.median(times["relay"])
        print(f"from a robot's socket to a WebSocket: p50 {ratio:.2f} x a bare relay's")
        return ratio


def taken_us(robot: Robot, name: str, port: int) -> float:
    """Give the p50 of one round; a position is known by its x, which is its number."""
    sent: dict[int, float] = {}
    taken: list[tuple[float, bytes]] = []
    over = threading.Event()

    def send() -> None:
        for number in itertools.count(1):
            if over.wait(PERIOD_S):
                return
            sent[number] = time.perf_counter()
            robot.send(position(float(number), 0.0, 0.0))

    with looking(name, port) as socket:
        sender = threading.Thread(target=send)
        sender.start()
        end = time.monotonic() + ROUND_S
        while time.monotonic() < end:
            message = socket.recv()
            if isinstance(message, bytes):
                taken.append((time.perf_counter(), message))
        over.set()
        sender.join()
    numbers = [(at, number_of(name, data)) for at, data in taken]
    return statistics.median(at - sent[number] for at, number in numbers[10:] if number in sent) * 1e6


@contextlib.contextmanager
def looking(name: str, port: int) -> Iterator[ClientConnection]:
    """Connect to the relay, or to the server and subscribe to the pose."""
    protocols = [Subprotocol("foxglove.sdk.v1")] if name == "zbridge" else None
    with connect(f"ws://127.0.0.1:{port}", subprotocols=protocols, compression=None) as socket:
        while name == "zbridge":
            message = socket.recv()
            entries = json.loads(message).get("channels", []) if isinstance(message, str) else []
            poses = [entry["id"] for entry in entries if entry["topic"] == "/r1/pose"]
            if poses:
                socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": poses[0]}]}))
                break
        yield socket


def number_of(name: str, data: bytes) -> int:
    """Give the number of a position."""
    if name == "relay":
        return round(msgpack.unpackb(data)["x"])
    return round(read(foxglove_schema("PoseInFrame"), data[_HEAD:])["pose"]["position"]["x"])


def main() -> int:
    """Print both figures; 1 if one of the goals is missed."""
    missed = [share() > SHARE_GOAL, latency() > LATENCY_GOAL]
    return int(any(missed))


if __name__ == "__main__":
    sys.exit(main())
