"""What connections that never become sessions do to a router's TLS port: to those who are in, and to who comes.

    python -m tests.e2e.measured.half_open

A gateway writes a pose 200 times a second, a viewer hears it, both through one router with mutual TLS. In each round,
for three seconds each: 1 000 connections come at once and send what is no TLS; 300 connections come at once, say
nothing for a second, and leave. Before each, the same connections go to another port, where nobody listens to them: the
attacker takes the same share of this machine then. Printed are the viewer's latency (p50, p99, worst) and the processor
time of the router, which no load of the machine changes; at last how long a newcomer takes to join who comes in the
third second, for Zenoh takes 100 ms for each connection that failed. Established sessions must not notice: p99 at most
1.5 times that of the attack elsewhere, median of the rounds. Run it on an idle machine; it takes four minutes.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import NamedTuple

import zenoh

from tests.e2e.conftest import HOST, until
from tests.e2e.rigs.secure import ROLES, SecureBus, declared

GARBAGE, HALF_OPEN = 1000, 300
ROUNDS = 3
POSES, POSES_HZ, WARM = 600, 200.0, 50
"""WARM: the first poses, which are slower whatever happens, are not counted."""
COMES_S = 2.0
"""When the newcomer comes."""
PATIENCE_S = 180.0
"""Longest time that a newcomer is waited for."""
MOST = 1.5
"""p99 of established sessions, compared to that without an attack."""
KEY = "fleet/r1/pose"


class Latency(NamedTuple):
    """What three seconds were like: the viewer's latency in milliseconds, and the router's processor time."""

    p50: float
    p99: float
    worst: float
    cpu_s: float

    def __str__(self) -> str:
        latency = f"p50 {self.p50:6.2f} ms  p99 {self.p99:6.2f} ms  worst {self.worst:6.2f} ms"
        return f"{latency}  router {self.cpu_s:.2f} s of CPU"


def main() -> None:
    """Measure and print; exit 1 if established sessions notice an attack."""
    rounds: list[dict[tuple[str, bool], Latency]] = []
    with tempfile.TemporaryDirectory() as folder:
        bus = SecureBus(Path(folder))
        bus.stop()
        for number in range(ROUNDS):
            rounds.append({each: latency(bus, *each) for each in PHASES})
            for each, measured in rounds[-1].items():
                print(f"{number + 1}  {said(*each):20} {measured}", flush=True)
        for each in PHASES[1::2]:
            print(f"a newcomer, {said(*each)}: {newcomer_s(bus, *each):.1f} s", flush=True)
        print(f"a newcomer, no attack: {newcomer_s(bus, 'garbage', False):.2f} s")
    for each in PHASES:
        print(f"median  {said(*each):20} {Latency(*map(median, zip(*(one[each] for one in rounds), strict=True)))}")
    factors = {name: median(one[name, True].p99 / one[name, False].p99 for one in rounds) for name in ATTACKS}
    print("p99 compared: " + ", ".join(f"{name} {factor:.2f} x" for name, factor in factors.items()))
    sys.exit(any(factor > MOST for factor in factors.values()))


def said(attack: str, here: bool) -> str:
    return attack if here else f"{attack}, elsewhere"


@contextlib.contextmanager
def routing(bus: SecureBus) -> Iterator[None]:
    """Start the router anew: it has forgotten the attack before."""
    bus.start(ROLES)
    try:
        yield
    finally:
        bus.stop()


def latency(bus: SecureBus, attack: str, here: bool) -> Latency:
    """Measure poses while a router is attacked."""
    latencies: list[float] = []

    def hear(sample: zenoh.Sample) -> None:
        now = time.perf_counter_ns()
        latencies.append((now - struct.unpack("<q", sample.payload.to_bytes())[0]) / 1e6)

    with routing(bus), bus.session("g1") as gateway, bus.session("v1") as viewer:
        publisher = gateway.declare_publisher(KEY)
        with declared(viewer.declare_subscriber(KEY, hear), publisher):
            until(lambda: publisher.matching_status.matching)
            used_s = bus.cpu_s
            with attacked(attack, bus.port if here else 0):
                for _ in range(POSES):
                    publisher.put(struct.pack("<q", time.perf_counter_ns()))
                    time.sleep(1 / POSES_HZ)
                until(lambda: len(latencies) == POSES, what=f"{POSES} poses")
                used_s = bus.cpu_s - used_s
    counted = sorted(latencies[WARM:])
    return Latency(counted[len(counted) // 2], counted[len(counted) * 99 // 100], counted[-1], used_s)


def newcomer_s(bus: SecureBus, attack: str, here: bool) -> float:
    """Return how long it takes an operator to join, in seconds."""
    with routing(bus), attacked(attack, bus.port if here else 0):
        time.sleep(COMES_S)
        begun = time.monotonic()
        with bus.session("op1", connect__timeout_ms=int(PATIENCE_S * 1000)):
            return time.monotonic() - begun


@contextlib.contextmanager
def attacked(how: str, port: int) -> Iterator[None]:
    """Attack from a process of its own, which ends with the context. port: 0 is a port of its own."""
    command = [sys.executable, "-m", "tests.e2e.measured.half_open", how, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as attacker:
        assert attacker.stdout is not None
        attacker.stdout.readline()
        try:
            yield
        finally:
            attacker.terminate()


def send_garbage(port: int) -> None:
    """Connect, send what is no TLS, and wait to be thrown out."""
    print("begins", flush=True)
    time.sleep(COMES_S / 2)
    links = connected(port, GARBAGE)
    for link in links:
        with contextlib.suppress(OSError):
            link.sendall(os.urandom(200))
    time.sleep(PATIENCE_S)


def stay_silent(port: int) -> None:
    """Connect, say nothing, and leave after a while."""
    print("begins", flush=True)
    links = connected(port, HALF_OPEN)
    time.sleep(COMES_S / 2)
    for link in links:
        link.close()


def connected(port: int, count: int) -> list[socket.socket]:
    """Make so many connections."""
    links = []
    for _ in range(count):
        with contextlib.suppress(OSError):
            links.append(socket.create_connection((HOST, port), 5.0))
    return links


ATTACKS = {"garbage": send_garbage, "half-open": stay_silent}
PHASES = [(name, here) for name in ATTACKS for here in (False, True)]

if __name__ == "__main__":
    if len(sys.argv) > 1:
        with socket.create_server((HOST, 0), backlog=GARBAGE) as elsewhere:
            ATTACKS[sys.argv[1]](int(sys.argv[2]) or elsewhere.getsockname()[1])
    else:
        main()
