"""The benchmark of listeners: one robot shown to 1, 10, 50 and 250 HQ programs, against a bare loop of writes.

    python -m tests.benchmarks.hq [--quick] [--profile] [--kinds udp,alf] [--clients 250] [--talk]

The process under test is a real ``zbridge run`` without a device, with a TCP/UDP and an ALF listener. The robot is
played on the bus by a process of its own; all clients are in another one. Runs of the listener and of the bare loop
take turns. CPU is user and system time of all threads, what the process does when idle included, for each message
that a client got: with one client it is that of a whole publication. Delivery is from the robot's put to the client's
read, on one clock.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tests.benchmarks.flow import QUIET_S, RUN_S, SETTLE_S
from tests.benchmarks.gateway import Figure, head
from tests.benchmarks.harness import (
    BenchmarkError,
    Process,
    Spread,
    cpu_s,
    memory_mb,
    pairs,
    process,
    thread_cpu_s,
)
from tests.benchmarks.hq_wire import KINDS, SCANS_HZ, SMALL_HZ, Kind
from tests.benchmarks.peer import ROBOT
from tests.ports import free_port

COUNTS = (1, 10, 50, 250)
CPU_US, LATE_MS, EVEN = 40.0, 25.0, 0.99
BASE_MB, CLIENT_MB = 60.0, 0.06
WHAT = {
    "tcp": "TCP/UDP 1.3 without datagrams, 50 Hz of positions",
    "udp": "TCP/UDP 1.3 with datagrams, 50 Hz of positions",
    "alf": "ALF text, 50 Hz of drive info, 10 Hz of scans",
}
ATTEMPTS = 3
"""Times a run that fails is begun."""
_MORE = {"alf": 'options = { serve = "both" }\n'}
"""Clients of ALF take all there is here, which no legacy program does."""
_ALL_AT_ONCE = "accept_hz = 10000\n"
_PACKAGE = "tests.benchmarks"
_ROWS = 24

Route = Literal["listener", "bare"]


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    seconds: float
    pairs: int
    counts: Sequence[int] = COUNTS
    kinds: Sequence[Kind] = KINDS
    talk: bool = False


@dataclass(frozen=True)
class Run:
    """What one run took. A run delivers ``expected`` messages where nothing is replaced by a newer one."""

    counts: tuple[int, ...]
    expected: int
    cpu_s: float
    late_ms: tuple[float, ...]
    """Milliseconds of delivery, least first."""
    memory_mb: float
    threads_s: dict[int, tuple[str, float]]
    profile: dict[str, Any] | None

    @property
    def delivered(self) -> int:
        """Messages that clients got."""
        return sum(self.counts)

    @property
    def cpu_us(self) -> float:
        """CPU time for each message that was delivered, microseconds."""
        return self.cpu_s / self.delivered * 1e6

    @property
    def even(self) -> float:
        """What the slowest client got of what the fastest did."""
        return min(self.counts) / max(self.counts)

    def within_ms(self, share: float) -> float:
        """Give the time within which this share of all messages was delivered, milliseconds."""
        return self.late_ms[min(len(self.late_ms) - 1, int(share * len(self.late_ms)))]

    def __str__(self) -> str:
        late = f"{self.within_ms(0.5):6.2f} {self.within_ms(0.99):7.2f} {self.late_ms[-1]:7.1f}"
        lost = self.expected - self.delivered
        return f"{self.cpu_us:7.1f} {late} {self.even:6.3f} {lost:6,} {self.memory_mb:6.1f}"


def run(route: Route, kind: Kind, clients: int, plan: Plan, *, profile: bool = False) -> Run:
    """Make one run; again where it failed, as when somebody else took a port that was free."""
    for _ in range(ATTEMPTS - 1):
        try:
            return _run(route, kind, clients, plan, profile=profile)
        except BenchmarkError as error:
            print(f"  once more: {str(error).splitlines()[0]} ... {str(error).splitlines()[-1]}", flush=True)
    return _run(route, kind, clients, plan, profile=profile)


def _run(route: Route, kind: Kind, clients: int, plan: Plan, *, profile: bool) -> Run:
    small = round(SMALL_HZ * plan.seconds)
    each = small + (round(small * SCANS_HZ / SMALL_HZ) if kind == "alf" else 0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with _stage(route, kind, clients, small, folder, talk=plan.talk, profile=profile) as (robot, tested, sink):
            if profile:
                tested.signal(signal.SIGUSR1)
            cpu, threads = cpu_s(tested.pid), thread_cpu_s(tested.pid)
            sink.say(f"await {clients * each} {QUIET_S} {RUN_S + plan.seconds}")
            robot.say("go")
            sent_ns = robot.hear(RUN_S + plan.seconds)["sent_ns"]
            got = sink.hear(RUN_S + QUIET_S)
            cpu, memory = cpu_s(tested.pid) - cpu, memory_mb(tested.pid)
            threads = {
                thread: (comm, spent - threads.get(thread, ("", 0.0))[1])
                for thread, (comm, spent) in thread_cpu_s(tested.pid).items()
            }
            tested.end()
        profiled = json.loads((folder / "profile.json").read_text()) if profile else None
    arrivals = [(number, at_ns) for table in (got["small"], got["scans"]) for number, at_ns in zip(*table, strict=True)]
    late_ms = tuple(sorted((at_ns - sent_ns[number - 1]) / 1e6 for number, at_ns in arrivals))
    return Run(tuple(got["counts"]), clients * each, cpu, late_ms, memory, threads, profiled)


@contextlib.contextmanager
def _stage(
    route: Route, kind: Kind, clients: int, count: int, folder: Path, *, talk: bool, profile: bool
) -> Iterator[tuple[Process, Process, Process]]:
    """Start robot, process under test and clients; give them when every client was shown something."""
    with contextlib.ExitStack() as stack:

        def start(module: str, *arguments: object) -> Process:
            return stack.enter_context(process(module, *arguments))

        endpoint, ports = f"tcp/127.0.0.1:{free_port()}", {"tcpudp": free_port(), "alf": free_port()}
        port = ports["alf" if kind == "alf" else "tcpudp"]
        if route == "bare":
            tested = start(f"{_PACKAGE}.hq_bare", kind, endpoint, port)
        else:
            file = folder / "listener.toml"
            file.write_text(_configuration(ports, endpoint))
            before = (f"{_PACKAGE}.profiler", folder / "profile.json") if profile else ("zbridge",)
            tested = start(*map(str, before), "run", file)
        robot = start(f"{_PACKAGE}.hq_robot", kind, endpoint, count)
        sink = start(f"{_PACKAGE}.hq_clients", kind, port, clients, *(("talk",) if talk else ()))
        try:
            sink.hear(RUN_S)
        except BenchmarkError:
            tested.hear(0.1)  # what it died of, if it did, says more
            raise
        robot.say("hold")
        robot.hear()
        time.sleep(SETTLE_S)
        yield robot, tested, sink


def _configuration(ports: dict[str, int], endpoint: str) -> str:
    listeners = "".join(
        f'[[hq]]\nprotocol = "{protocol}"\nlisten = "tcp://127.0.0.1:{port}"\n{_MORE.get(protocol, "")}{_ALL_AT_ONCE}'
        for protocol, port in ports.items()
    )
    return f"""
[robot]
name = "{ROBOT}"
{listeners}
[bus]
mode = "peer"
listen = ["{endpoint}"]
multicast = false
"""


def measure(plan: Plan) -> list[Figure]:
    """Measure everything; say on the way what came out."""
    figures = []
    for kind in plan.kinds:
        columns = "CPU us/message; delivery ms: median, 99 %, most; slowest/fastest client; replaced or lost; MB"
        head(f"{WHAT[kind]}: listener | bare loop", columns)
        for clients in plan.counts:
            runs = pairs(
                plan.pairs,
                partial(run, "listener", kind, clients, plan),
                partial(run, "bare", kind, clients, plan),
            )
            for ours, bare in runs:
                print(f"  {clients:>4}  {ours}  |  {bare}", flush=True)
            ratio = Spread.of([ours.cpu_us / bare.cpu_us for ours, bare in runs])
            print(f"        CPU {Spread.of([ours.cpu_us for ours, _ in runs])} us, {ratio} of the bare loop's")
            figures += _figures(kind, clients, [ours for ours, _ in runs])
    return figures


def _figures(kind: Kind, clients: int, runs: Sequence[Run]) -> list[Figure]:
    what = f"{kind}, {clients} client{'s' if clients > 1 else ''}"
    even, late = min(each.even for each in runs), Spread.of([each.within_ms(0.99) for each in runs])
    figures = [
        Figure(f"{what}: CPU per message", Spread.of([each.cpu_us for each in runs]).middle, CPU_US, "us"),
        Figure(f"{what}: slowest / fastest, the least", even, EVEN, at_least=True),
        Figure(f"{what}: memory, the most", max(each.memory_mb for each in runs), BASE_MB + CLIENT_MB * clients, "MB"),
    ]
    if clients == max(COUNTS):
        figures.append(Figure(f"{what}: 99 % delivered within", late.middle, LATE_MS, "ms"))
    return figures


def profile(plan: Plan) -> None:
    """Show where the listener's microseconds go with most clients."""
    for kind in plan.kinds:
        clients = max(plan.counts)
        measured = run("listener", kind, clients, plan, profile=True)
        found = measured.profile
        assert found is not None
        columns = "us/message delivered; own time includes C code called, uvloop's the profiler's signals"
        head(f"profile: {WHAT[kind]}, {clients} clients", columns)
        print(f"  {measured}\n  by thread:")
        names = {int(thread): name for thread, name in found["threads"].items()}
        for thread, (comm, spent_s) in sorted(measured.threads_s.items(), key=lambda item: -item[1][1])[:6]:
            _print_cost(spent_s / measured.delivered, names.get(thread, comm))
        for table, title in (("own", "own"), ("cumulative", "with what it calls"), ("lines", "by line")):
            print(f"  {title}:")
            for thread_name, place, spent_s in found[table][:_ROWS]:
                _print_cost(spent_s / measured.delivered, f"{thread_name:<22} {place}")


def _print_cost(each_s: float, what: str) -> None:
    if each_s > 1e-8:
        print(f"    {each_s * 1e6:8.2f}  {what}")


def main() -> None:
    """Run what the arguments say; the exit code does not depend on targets: this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one pair of short runs, with 1 and 250 clients")
    parser.add_argument("--profile", action="store_true", help="only profile the listener with most clients")
    parser.add_argument("--talk", action="store_true", help="clients repeat their neutral command as legacy ones do")
    parser.add_argument("--kinds", default=",".join(KINDS), help="of clients")
    parser.add_argument("--clients", help="how many, separated by commas")
    parser.add_argument("--pairs", type=int, help="runs of each, in turn")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    begun, quick = time.monotonic(), arguments.quick
    counts = [int(count) for count in arguments.clients.split(",")] if arguments.clients else None
    plan = Plan(
        seconds=4.0 if quick else 6.0,
        pairs=arguments.pairs or (1 if quick else 3),
        counts=counts or ((COUNTS[0], COUNTS[-1]) if quick else COUNTS),
        kinds=[kind for kind in KINDS if kind in arguments.kinds.split(",")],
        talk=arguments.talk,
    )
    print(f"load of this machine when it began: {os.getloadavg()[0]:.2f}, cores: {os.cpu_count()}")
    if arguments.profile:
        profile(plan)
    else:
        figures = measure(plan)
        print(f"\n{'figure':<52} {'reached':>12} {'target':>12}")
        for figure in figures:
            print(figure)
    print(f"\n{time.monotonic() - begun:.0f} s, load at the end {os.getloadavg()[0]:.2f}")


if __name__ == "__main__":
    main()
