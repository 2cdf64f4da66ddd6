"""Measure what the gateway costs, against a bare loop of ``publisher.put`` and the script of an afternoon.

    python -m tests.benchmarks.gateway              # everything, about three minutes
    python -m tests.benchmarks.gateway --quick      # two pairs of short runs, under 40 s: a look, no verdict
    python -m tests.benchmarks.gateway --profile    # only where the gateway's microseconds go

Run it from the root of a checkout, on a machine that does nothing else. What is measured, and how:

- The whole way: a robot (plain sockets, its own process) sends packets by TCP; the real ``python -m zbridge run``
  translates them, with a configuration a user could have written; a subscriber in a third process takes them.
- Paired runs: gateway and its rival take turns, five times; a ratio is that of one pair, and the median of the
  ratios counts. Machine noise that lasts longer than one run falls on both.
- Positions (18 bytes), as fast as the socket takes them: the rate is what arrived at the subscriber divided by the
  time from the first byte sent to the last message received; CPU is that of all threads of the gateway's or the
  script's process, divided by the packets. Neither may lose any: the gateway has ``[bus] stream = "block"``, the
  script and the bare loop put with BLOCK.
- Maps (200 x 200, 40 kB): the rate at the subscriber against that of the bare loop with the same payload. A map is a
  state, the newest wins: the gateway may replace one that still waits, and the rate counts only what arrived. Once
  with Zenoh's defaults, by which two processes of one machine share memory, once by TCP as between machines.
- 10 000 positions a second, one write each, with the default ``stream = "drop"``: running numbers show losses. The
  bare loop, with DROP as well, shows how many of them are Zenoh's own on this machine.
- Latency at 1 kHz: the time from the robot's write to the subscriber's callback, median; against the sum of bare
  TCP one way (the same robot, a bare uvloop protocol) and bare Zenoh one way (put with express, same subscriber).
- Memory (VmRSS) at the end of each run of the gateway; and the time from the start of its process to the first
  position at the subscriber, which connects to the gateway within 10 ms of its listening.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from dataclasses import dataclass
from statistics import median

from tests.benchmarks.flow import Load, Route, Run, run
from tests.benchmarks.harness import Spread, pairs

PACED_HZ = 10_000.0
LATENCY_HZ = 1000.0


@dataclass(frozen=True)
class Plan:
    """How much is run."""

    pairs: int
    gateway_poses: int
    script_poses: int
    bare_poses: int
    maps: int
    bare_maps: int
    paced_s: float
    latency_s: float


FULL = Plan(5, 400_000, 200_000, 800_000, 6000, 20_000, 3.0, 3.0)
QUICK = Plan(2, 60_000, 30_000, 100_000, 1000, 4000, 0.5, 0.5)
PROFILED = (
    (Load("pose", 500_000), "block", 24),
    (Load("pose", 60_000, PACED_HZ), "drop", 16),
    (Load("map", 8000), "block", 16),
)


@dataclass(frozen=True)
class Figure:
    """One line of the final table; ``at_least`` tells which side of the target is the good one."""

    name: str
    reached: float
    target: float
    unit: str = ""
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """Whether the target is reached."""
        return self.reached >= self.target if self.at_least else self.reached <= self.target

    def __str__(self) -> str:
        sign = ">=" if self.at_least else "<="
        reached, target = f"{self.reached:.3g} {self.unit}", f"{sign} {self.target:g} {self.unit}"
        return f"{self.name:<52} {reached:>12} {target:>12}  {'ok' if self.ok else 'short'}"


class Benchmark:
    """All measurements of one call; the gateway's runs are kept for memory and start."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._gateways: dict[str, list[Run]] = {}

    def run(self) -> list[Figure]:
        """Measure everything; say on the way what came out."""
        return [*self._positions(), *self._maps(), self._paced(), self._latency(), *self._process()]

    def _gateway(self, what: str, load: Load, stream: str = "drop") -> Run:
        measured = run(Route.GATEWAY, load, stream=stream)
        self._gateways.setdefault(what, []).append(measured)
        return measured

    def _positions(self) -> list[Figure]:
        plan = self._plan
        head("positions, saturated, nothing dropped: gateway | script", "rate/s, CPU us/packet, lost")
        runs = pairs(
            plan.pairs,
            lambda: self._gateway("positions", Load("pose", plan.gateway_poses), "block"),
            lambda: run(Route.SCRIPT, Load("pose", plan.script_poses)),
        )
        bare = run(Route.ZENOH, Load("pose", plan.bare_poses))
        for ours, theirs in runs:
            print(f"  {_line(ours)}  |  {_line(theirs)}")
        print(f"  bare loop: {_line(bare)}")
        cpu = Spread.of([ours.cpu_us / theirs.cpu_us for ours, theirs in runs])
        rate = Spread.of([ours.rate_hz / theirs.rate_hz for ours, theirs in runs])
        print(f"  CPU ratio {cpu}, rate ratio {rate} (least / median / most)")
        lost = sum(run.lost for pair in runs for run in pair)
        return [
            Figure("positions: CPU per packet / script's", cpu.middle, 0.35),
            Figure("positions: rate / script's", rate.middle, 2.5, at_least=True),
            Figure("positions: lost in saturated runs", lost, 0),
        ]

    def _maps(self) -> list[Figure]:
        return [
            Figure("maps: rate / bare loop's", self._map_rate(shared=True), 0.5, at_least=True),
            Figure("maps: the same without shared memory", self._map_rate(shared=False), 0.5, at_least=True),
        ]

    def _map_rate(self, *, shared: bool) -> float:
        plan = self._plan
        how = "Zenoh's shared memory" if shared else "by TCP, as between machines"
        head(f"maps of 40 kB, saturated, {how}: gateway | bare loop", "arrived/s, CPU us/map sent, not arrived")
        runs = pairs(
            plan.pairs,
            lambda: self._gateway("maps", Load("map", plan.maps, shared_memory=shared), "block"),
            lambda: run(Route.ZENOH, Load("map", plan.bare_maps, shared_memory=shared)),
        )
        for ours, theirs in runs:
            print(f"  {_line(ours)}  |  {_line(theirs)}")
        rate = Spread.of([ours.rate_hz / theirs.rate_hz for ours, theirs in runs])
        replaced = Spread.of([ours.lost / ours.sent for ours, _ in runs])
        print(f"  rate ratio {rate}; replaced by a newer one before it left: {replaced} of all")
        return rate.middle

    def _paced(self) -> Figure:
        head(
            f"positions at {PACED_HZ:,.0f}/s, default stream: gateway | bare loop with express and DROP",
            "arrived/s, CPU us/packet, lost",
        )
        load = Load("pose", int(PACED_HZ * self._plan.paced_s), PACED_HZ, keep=True)
        runs = pairs(self._plan.pairs, lambda: self._gateway("10 000/s", load), lambda: run(Route.ZENOH, load))
        for ours, theirs in runs:
            print(f"  {_line(ours)}  |  {_line(theirs)}")
        return Figure("positions: lost at 10 000/s, all runs", sum(ours.lost for ours, _ in runs), 0)

    def _latency(self) -> Figure:
        head("latency at 1 kHz, medians, us", "gateway, bare TCP, bare Zenoh, gateway / sum")
        load = Load("pose", int(LATENCY_HZ * self._plan.latency_s), LATENCY_HZ, keep=True)
        ratios = []
        for _ in range(self._plan.pairs):
            ours = self._gateway("1 kHz", load).latency_us
            tcp, bare = run(Route.TCP, load).latency_us, run(Route.ZENOH, load).latency_us
            ratios.append(ours / (tcp + bare))
            print(f"  {ours:6.0f} {tcp:6.0f} {bare:6.0f}  {ratios[-1]:.2f}")
        print(f"  ratio {Spread.of(ratios)}")
        return Figure("latency: median / (bare TCP + bare Zenoh)", median(ratios), 1.6)

    def _process(self) -> list[Figure]:
        head("the gateway's process", "least / median / most over its runs")
        for what, runs in self._gateways.items():
            print(f"  memory after {what}: {Spread.of([run.memory_mb for run in runs])} MB")
        every = [run for runs in self._gateways.values() for run in runs]
        starts = Spread.of([run.start_s for run in every])
        print(f"  first position at the subscriber after {starts} s")
        return [
            Figure("memory, the most of all runs", max(run.memory_mb for run in every), 60, "MB"),
            Figure("start to first position published", starts.middle, 0.8, "s"),
        ]


def profile() -> None:
    """Show where the gateway's microseconds go: saturated with positions, at 10 000/s, saturated with maps."""
    for load, stream, most in PROFILED:
        measured = run(Route.GATEWAY, load, stream=stream, profile=True)
        assert measured.profile is not None
        rate = f"at {load.rate_hz:,.0f}/s" if load.rate_hz else "saturated"
        head(
            f"profile: {load.count} x {load.kind}, {rate}, stream {stream}", "us each; own time includes C code called"
        )
        print(f"  {_line(measured)}\n  by thread:")
        names = {int(thread): name for thread, name in measured.profile["threads"].items()}
        for thread, (comm, spent_s) in sorted(measured.threads_s.items(), key=lambda item: -item[1][1]):
            _print_cost(spent_s / load.count, names.get(thread, comm))
        for table, title in (("own", "own"), ("cumulative", "with what it calls"), ("lines", "by line")):
            print(f"  {title}:")
            for thread, place, spent_s in measured.profile[table][:most]:
                _print_cost(spent_s / load.count, f"{thread:<22} {place}")


def _print_cost(each_s: float, what: str) -> None:
    if each_s > 1e-8:
        print(f"    {each_s * 1e6:8.2f}  {what}")


def head(title: str, columns: str) -> None:
    """Begin a section of the report."""
    print(f"\n{title}\n  [{columns}]", flush=True)


def _line(measured: Run) -> str:
    return f"{measured.rate_hz:9,.0f} {measured.cpu_us:7.2f} {measured.lost:6,}"


def main() -> None:
    """Run what the arguments say; the exit code does not depend on targets: this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two pairs of short runs")
    parser.add_argument("--profile", action="store_true", help="only profile the gateway in saturated runs")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    begun = time.monotonic()
    if arguments.profile:
        profile()
    else:
        figures = Benchmark(QUICK if arguments.quick else FULL).run()
        print(f"\n{'figure':<52} {'reached':>12} {'target':>12}")
        for figure in figures:
            print(figure)
    print(f"\n{time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
