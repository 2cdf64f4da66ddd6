"""Measure the price of messages that come alone, at the rates that robots have.

    python -m tests.benchmarks.paced                            # everything, about a quarter of an hour
    python -m tests.benchmarks.paced --quick                    # short slices: a look, no verdict
    python -m tests.benchmarks.paced --cases position:1000 scan:40 drive:50

Run it on a machine that does nothing else. Robot, gateway and consumer are processes of their own, and so are those of
each route that the gateway is compared with: *floor* (a bare TCP hop and, apart from it, a bare Zenoh hop; their times
are added), *least* (a minimal program: uvloop reads, the loop's thread puts) and *script* (what a user writes in an
afternoon). All of them live as long as their case. The routes take turns, a slice of some seconds each, so that what
disturbs the machine disturbs all; ratios are those of one turn, the median of the turns counts, and its 95 % interval
is found by drawing turns anew. Sources keep an absolute schedule. Messages bear their number, times are those of
CLOCK_MONOTONIC. CPU (user and system), context switches and threads are those of the whole process.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Literal

from tests.benchmarks.harness import Process, cpu_s, memory_mb, process, thread_cpu_s
from tests.benchmarks.paced_peers import PROTOCOLS, Kind
from tests.benchmarks.peer import ROBOT
from tests.benchmarks.scene import Drive, Scene, Through, p99, scene
from tests.ports import free_port

Route = Literal["tcp", "zenoh", "least", "script", "gateway"]
ROUTES: dict[Kind, tuple[Route, ...]] = {
    "position": ("tcp", "zenoh", "least", "script", "gateway"),
    "scan": ("tcp", "zenoh", "script", "gateway"),
    "reading": ("tcp", "zenoh", "gateway"),
}
CASES = (
    *(f"position:{rate}" for rate in (10, 40, 100, 1000)),
    *(f"scan:{rate}" for rate in (10, 40)),
    *(f"reading:{rate}" for rate in (10, 40, 100, 1000)),
    *(f"drive:{rate}" for rate in (50, 500)),
)
SCRIPTS = {"position": "script", "scan": "alf_script"}
ARRIVE_S = 0.15
"""Time for the last message of a slice to arrive."""
WARM = 0.1
"""The part of a slice's messages, the first ones, that does not count for delays."""
DRAWS = 2000
_PACKAGE = "tests.benchmarks"


@dataclass(frozen=True)
class Plan:
    """How long a turn is, for each route, and how many there are."""

    turns: int
    slice_s: float
    least: int
    """Fewest messages of a slice."""

    def count(self, rate_hz: float) -> int:
        return max(self.least, round(self.slice_s * rate_hz))


FULL, QUICK = Plan(12, 2.0, 60), Plan(3, 0.7, 15)


@dataclass
class Slice:
    """What one route took for one slice."""

    p50_us: float
    p99_us: float
    cpu_us: float
    switches: float
    """Context switches for each message."""
    lost: int
    disordered: int


@dataclass
class Cost:
    """CPU that a process used in user mode and in the kernel, and the context switches of its threads."""

    cpu_s: float
    user_s: float
    system_s: float
    switches: int

    @classmethod
    def of(cls, pid: int) -> Cost:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        tick_s = 1 / os.sysconf("SC_CLK_TCK")
        switches = 0
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                lines = (task / "status").read_text().splitlines()
                switches += sum(int(line.split()[1]) for line in lines if "ctxt_switches" in line)
        return cls(cpu_s(pid), int(fields[11]) * tick_s, int(fields[12]) * tick_s, switches)


@dataclass
class Lane:
    """One route of a case, alive as long as the case."""

    source: Process
    tested: Process
    sink: Process
    start_s: float
    slices: list[Slice] = field(default_factory=list)
    _number: int = 1

    def run(self, count: int, rate_hz: float) -> None:
        """Send one slice."""
        self.sink.say("report")
        self.sink.hear()
        before = Cost.of(self.tested.pid)
        first, self._number = self._number, self._number + count
        self.source.say(f"send {first} {count} {rate_hz}")
        sent_ns = self.source.hear(60 + count / rate_hz)["sent_ns"]
        time.sleep(ARRIVE_S)
        after = Cost.of(self.tested.pid)
        self.sink.say("report")
        arrivals = [(number, at_ns) for number, at_ns in self.sink.hear()["arrivals"] if number >= first]
        came = dict(arrivals)
        took_us = tuple((came[n] - at) / 1e3 for n, at in enumerate(sent_ns, first) if n in came)
        steady = took_us[int(len(took_us) * WARM) :]
        self.slices.append(
            Slice(
                p50_us=median(steady),
                p99_us=p99(steady),
                cpu_us=(after.cpu_s - before.cpu_s) / count * 1e6,
                switches=(after.switches - before.switches) / count,
                lost=count - len(came),
                disordered=sum(later < sooner for (sooner, _), (later, _) in itertools.pairwise(arrivals)),
            )
        )

    def middle(self, what: Callable[[Slice], float]) -> float:
        """Give the median of a figure over all slices."""
        return median(map(what, self.slices))


# One case


@contextlib.contextmanager
def lanes(kind: Kind) -> Iterator[dict[Route, Lane]]:
    """Start the processes of every route of a kind."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        yield {route: _lane(stack, kind, route, folder) for route in ROUTES[kind]}


def _lane(stack: contextlib.ExitStack, kind: Kind, route: Route, folder: Path) -> Lane:
    def start(module: str, *arguments: object) -> Process:
        return stack.enter_context(process(module, *arguments))

    def peer(role: str, *arguments: object) -> Process:
        return start(f"{_PACKAGE}.paced_peers", role, kind, *arguments)

    endpoint = f"tcp/127.0.0.1:{free_port()}"
    if route != "tcp":
        sink = peer("subscriber", endpoint)
        sink.hear()
    if route == "zenoh":
        source = tested = peer("bare", endpoint)
    else:
        source = peer("robot")
        port = source.hear()["port"]
        if route == "tcp":
            sink = tested = peer("tcp", port)
        elif route == "least":
            tested = peer("minimal", port, endpoint)
        elif route == "script":
            tested = start(f"{_PACKAGE}.{SCRIPTS[kind]}", port, endpoint)
        else:
            file = folder / "gateway.toml"
            file.write_text(configuration(kind, port, endpoint))
            tested = start("zbridge", "run", file)
    start_s = (sink.hear()["first_ns"] - tested.started_ns) / 1e9
    source.say("hold")
    source.hear()
    return Lane(source, tested, sink, start_s)


def configuration(kind: Kind, port: int, endpoint: str) -> str:
    return f"""
[robot]
name = "{ROBOT}"
[device]
protocol = "{PROTOCOLS[kind]}"
connect = ["tcp://127.0.0.1:{port}"]
[bus]
mode = "peer"
listen = ["{endpoint}"]
multicast = false
"""


def telemetry(kind: Kind, rate_hz: float, plan: Plan) -> None:
    """Measure one kind of message at one rate, and print what came out."""
    with lanes(kind) as routes:
        time.sleep(1.0)  # greetings and declarations are over
        pid = routes["gateway"].tested.pid
        before, threads, sent = Cost.of(pid), thread_cpu_s(pid), 0
        for turn in range(plan.turns):
            names = list(routes)
            for name in names[turn % len(names) :] + names[: turn % len(names)]:
                routes[name].run(plan.count(rate_hz), rate_hz)
        after, spent, sent = Cost.of(pid), thread_cpu_s(pid), plan.turns * plan.count(rate_hz)
        print(f"\n{kind}s at {rate_hz:g} Hz, {plan.turns} turns of {plan.count(rate_hz)}")
        print(f"  {'':<8} {'p50 us':>8} {'p99 us':>8} {'CPU us':>8} {'switches':>8} {'lost':>5} {'order':>5}")
        for name, lane in routes.items():
            lost, disordered = (sum(getattr(s, what) for s in lane.slices) for what in ("lost", "disordered"))
            print(
                f"  {name:<8} {lane.middle(lambda s: s.p50_us):8.0f} {lane.middle(lambda s: s.p99_us):8.0f}"
                f" {lane.middle(lambda s: s.cpu_us):8.1f} {lane.middle(lambda s: s.switches):8.1f}"
                f" {lost:5} {disordered:5}"
            )
        _ratios(routes)
        print(
            f"  gateway: {memory_mb(pid):.1f} MB resident, {private_mb(pid):.1f} private, {len(spent)} threads;"
            f" first message after {routes['gateway'].start_s:.2f} s; with the pauses between its slices"
            f" user {(after.user_s - before.user_s) / sent * 1e6:.0f},"
            f" system {(after.system_s - before.system_s) / sent * 1e6:.0f} us a message; by thread:"
            f" {_by_thread(threads, spent, sent)}",
            flush=True,
        )


def _ratios(routes: dict[Route, Lane]) -> None:
    gateway, tcp, zenoh = (routes[name].slices for name in ("gateway", "tcp", "zenoh"))
    floors = [one.p50_us + other.p50_us for one, other in zip(tcp, zenoh, strict=True)]
    _ratio("p50 / floor", [one.p50_us for one in gateway], floors)
    for name in ("least", "script"):
        if name in routes:
            rivals = routes[name].slices
            _ratio(f"{name}'s p50 / floor", [one.p50_us for one in rivals], floors)
            for figure in ("p50_us", "p99_us", "cpu_us"):
                ours, theirs = ([getattr(one, figure) for one in slices] for slices in (gateway, rivals))
                _ratio(f"{figure.removesuffix('_us')} / {name}'s", ours, theirs)


def drives(rate_hz: float, plan: Plan) -> None:
    """Measure drives from the bus to the robot, through the gateway (proof included) and through the script."""
    with scene(Through.GATEWAY) as ours, scene(Through.SCRIPT) as theirs:
        turns = [(_drive(ours, rate_hz, plan), _drive(theirs, rate_hz, plan)) for _ in range(plan.turns)]
        print(f"\ndrives at {rate_hz:g} Hz, {plan.turns} turns of {plan.count(rate_hz)}")
        print(f"  {'':<8} {'p50 us':>8} {'p99 us':>8} {'CPU us':>8} {'arrived':>8}")
        for name, runs in (("gateway", [turn[0] for turn in turns]), ("script", [turn[1] for turn in turns])):
            p50_us, p99_us, cpu_us = (median(getattr(r, n) for r in runs) for n in ("median_us", "p99_us", "cpu_us"))
            print(f"  {name:<8} {p50_us:8.0f} {p99_us:8.0f} {cpu_us:8.1f} {min(run.arrived for run in runs):8.0%}")
        for figure in ("median_us", "p99_us", "cpu_us"):
            _ratio(
                f"{figure.removesuffix('_us')} / script's", *([getattr(t[n], figure) for t in turns] for n in (0, 1))
            )


def _drive(through: Scene, rate_hz: float, plan: Plan) -> Drive:
    return through.drive(rate_hz, plan.count(rate_hz))


# What is said of it


def _ratio(name: str, ours: Sequence[float], theirs: Sequence[float]) -> None:
    ratios = [one / other for one, other in zip(ours, theirs, strict=True)]
    low, high = interval(ratios)
    print(f"  {name:<22} {median(ratios):6.2f}   95 %: {low:.2f} to {high:.2f}")


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Give the 95 % interval of the median, by drawing as many of the values anew, again and again."""
    chance = random.Random(1)
    medians = sorted(median(chance.choices(values, k=len(values))) for _ in range(DRAWS))
    return medians[int(0.025 * DRAWS)], medians[int(0.975 * DRAWS)]


def private_mb(pid: int) -> float:
    """Read the memory that a process shares with no other, megabytes of 10**6 bytes."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) * 1024 / 1e6


def _by_thread(before: dict[int, tuple[str, float]], after: dict[int, tuple[str, float]], sent: int) -> str:
    """Say where the CPU went, us a message, threads of one name together, the greatest first."""
    spent: dict[str, float] = {}
    for thread, (name, seconds) in after.items():
        spent[name] = spent.get(name, 0.0) + seconds - before.get(thread, (name, 0.0))[1]
    shares = sorted(((seconds / sent * 1e6, name) for name, seconds in spent.items()), reverse=True)
    return ", ".join(f"{name} {each_us:.0f}" for each_us, name in shares if each_us >= 0.5)


def main() -> None:
    """Run what the arguments say; this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few, short slices")
    parser.add_argument("--cases", nargs="+", default=CASES, help="kind:rate, e.g. position:1000")
    parser.add_argument("--turns", type=int, help="how often every route has its turn")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    plan = QUICK if arguments.quick else FULL
    if arguments.turns:
        plan = Plan(arguments.turns, plan.slice_s, plan.least)
    begun = time.monotonic()
    for case in arguments.cases:
        kind, _, rate = case.partition(":")
        if kind == "drive":
            drives(float(rate), plan)
        else:
            telemetry(kind, float(rate), plan)
    print(f"\n{time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
