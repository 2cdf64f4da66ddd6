"""What connections that never become sessions do to a router's TLS port: to those who are in, and to who comes.

    python -m tests.e2e.half_open

A gateway writes a pose 200 times a second, a viewer hears it, both through one router with mutual TLS. In each round,
for five seconds each: nothing else happens; 1 000 connections send what is no TLS; 300 connections say nothing for a
second, and leave. Printed are the viewer's latency (p50, p99, worst, of 1 000 poses) and how long a newcomer takes to
join who comes two seconds after the beginning. Established sessions must not notice: p99 at most 1.5 times that without
an attack, median of all rounds. Zenoh takes 100 ms for each connection that failed: the whole takes ten minutes.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import NamedTuple

import zenoh

from tests.e2e.conftest import HOST, until
from tests.e2e.secure import SecureBus

GARBAGE, HALF_OPEN = 1000, 300
ROUNDS = 3
COMES_S = 2.0
"""When the newcomer comes."""
POSES, POSES_HZ = 1000, 200.0
PATIENCE_S = 180.0
"""Longest time that a newcomer is waited for."""
MOST = 1.5
"""p99 of established sessions, compared to that without an attack."""
KEY = "fleet/r1/pose"


class Figures(NamedTuple):
    """What five seconds were like."""

    p50_ms: float
    p99_ms: float
    worst_ms: float
    newcomer_s: float


def main() -> None:
    """Measure and print; exit 1 if established sessions notice an attack."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        bus = SecureBus(Path(folder))
        stack.callback(bus.stop)
        gateway, viewer = (stack.enter_context(bus.session(name)) for name in ("g1", "v1"))
        measured: dict[str, list[Figures]] = {name: [] for name in ("nothing", *ATTACKS)}
        for _ in range(ROUNDS):
            for name, figures in measured.items():
                with attacked(name, bus.port):
                    figures.append(measure(bus, gateway, viewer))
                print(f"{name:10} {said(figures[-1])}", flush=True)
                until(lambda: joins_s(bus) < 0.5, PATIENCE_S, "the router to recover")
    medians = {name: Figures(*map(median, zip(*figures, strict=True))) for name, figures in measured.items()}
    print(f"\nmedian of {ROUNDS} rounds")
    for name, figures in medians.items():
        print(f"{name:10} {said(figures)}")
    factors = {name: medians[name].p99_ms / medians["nothing"].p99_ms for name in ATTACKS}
    print("p99 compared: " + ", ".join(f"{name} {factor:.2f} x" for name, factor in factors.items()))
    sys.exit(any(factor > MOST for factor in factors.values()))


def said(figures: Figures) -> str:
    return (
        f"p50 {figures.p50_ms:6.2f} ms  p99 {figures.p99_ms:6.2f} ms  worst {figures.worst_ms:6.2f} ms"
        f"  newcomer {figures.newcomer_s:6.2f} s"
    )


def measure(bus: SecureBus, gateway: zenoh.Session, viewer: zenoh.Session) -> Figures:
    """Measure poses while a newcomer joins."""
    latencies: list[float] = []
    joined: list[float] = []

    def hear(sample: zenoh.Sample) -> None:
        now = time.perf_counter_ns()
        latencies.append((now - struct.unpack("<q", sample.payload.to_bytes())[0]) / 1e6)

    subscriber = viewer.declare_subscriber(KEY, hear)
    publisher = gateway.declare_publisher(KEY)
    until(lambda: publisher.matching_status.matching)
    joining = threading.Timer(COMES_S, lambda: joined.append(joins_s(bus)))
    joining.start()
    for _ in range(POSES):
        publisher.put(struct.pack("<q", time.perf_counter_ns()))
        time.sleep(1 / POSES_HZ)
    until(lambda: len(latencies) == POSES, what=f"{POSES} poses")
    joining.join(PATIENCE_S)
    subscriber.undeclare()
    publisher.undeclare()
    latencies.sort()
    return Figures(latencies[POSES // 2], latencies[POSES * 99 // 100], latencies[-1], *joined)


def joins_s(bus: SecureBus) -> float:
    """Join as an operator; return how long that took, in seconds."""
    begun = time.monotonic()
    while time.monotonic() - begun < PATIENCE_S:
        with contextlib.suppress(zenoh.ZError), bus.session("op1", connect__timeout_ms=int(PATIENCE_S * 1000)):
            return time.monotonic() - begun
    return PATIENCE_S


@contextlib.contextmanager
def attacked(how: str, port: int) -> Iterator[None]:
    """Attack from a process of its own, which ends with the context."""
    if how not in ATTACKS:
        yield
        return
    command = [sys.executable, "-m", "tests.e2e.half_open", how, str(port)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as attacker:
        assert attacker.stdout is not None
        attacker.stdout.readline()
        yield
        attacker.communicate()


def send_garbage(port: int) -> None:
    """Connect, send what is no TLS, and leave; again and again."""
    print("begins", flush=True)
    for _ in range(GARBAGE):
        with contextlib.suppress(OSError), socket.create_connection((HOST, port), 5.0) as link:
            link.sendall(os.urandom(200))
            time.sleep(4.5 / GARBAGE)


def stay_silent(port: int) -> None:
    """Connect, say nothing, and leave after a second."""
    print("begins", flush=True)
    links = [socket.create_connection((HOST, port), 5.0) for _ in range(HALF_OPEN)]
    time.sleep(1.0)
    for link in links:
        link.close()


ATTACKS = {"garbage": send_garbage, "half-open": stay_silent}

if __name__ == "__main__":
    if len(sys.argv) > 1:
        ATTACKS[sys.argv[1]](int(sys.argv[2]))
    else:
        main()
