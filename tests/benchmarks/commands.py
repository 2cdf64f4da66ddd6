"""Measure what a command costs, from the client's ``put`` on the bus to the bytes at the robot's socket.

    python -m tests.benchmarks.commands              # everything, about three minutes
    python -m tests.benchmarks.commands --quick      # short runs, under a minute: a look, no verdict
    python -m tests.benchmarks.commands --profile    # only where the gateway's microseconds go
    python -m tests.benchmarks.commands --flood 5000 # another rate of adversaries than 10 000/s (0: only unpaced)

Run it from the root of a checkout, on a machine that does nothing else. What is measured, and how:

- The whole way: a raw Zenoh client gets the lease by query and drives, each command authorised and published as
  express, real time, drop; the real ``python -m zbridge run`` with ``gap_s = 0``; a robot (plain sockets, its own
  process) whose only reading thread notes when each packet 11 came. Every command has a value of its own, and its first
  arrival counts: the gateway repeats the drive that stands. The stop that greets a robot is waited for.
- Paired runs: the gateway and the script of an afternoon (:mod:`tests.benchmarks.steering`) run at the same time and
  are driven in turns, half a second each, by the same kind of client and robot in the same bus topology. An idle
  machine takes its time to wake up, how much changes from minute to minute: a ratio is that of one pair of runs, and
  the median of the ratios of five counts.
- Under load: the robot's other process sends 500 positions and 40 maps of 6 kB a second, and a consumer subscribes to
  all of it; against the gateway's own time of the same run without load.
- The default ``gap_s`` beside it: 10 ms between two packets, so that of 500 commands a second most are replaced by a
  newer one before they are written; the latency is that of the commands that were.
- Renewing the lease, against a bare queryable that answers in its callback; both asked one after the other.
- The proof of a command alone, in this process: checking it, its fields read first, as the gateway does on the bus's
  thread and again before it carries a command out; and making it, as a client does.
- Adversaries: 100 000 drives of another process while the driver drives at 50/s, a quarter each with the driver's
  public lease and a proof made up, with the driver's own attachments and another payload, with a proof of an ended
  lease, and with none. They block, so that all of them arrive; the robot must see none, and the gateway must count each
  as refused or dropped. The driver's time meanwhile against the time right before.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
import timeit
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from tests.benchmarks.drives import DRIVE, drive, packed
from tests.benchmarks.gateway import head
from tests.benchmarks.harness import Spread, thread_cpu_s
from tests.benchmarks.scene import WARM, Drive, Flood, Scene, Through, bare_queries, p99, scene
from tests.benchmarks.stages import STAGES
from zbridge.fleet.lease_messages import Lease
from zbridge.lease.proof import Signer, Verifier, read

RATES_HZ = (50, 500)
FLOOD_HZ = 10_000.0
FLOOD_DRIVE_HZ = 50.0
DEFAULT_OPTIONS = ""
PROFILED_HZ = 5000
PROFILED_S = 5.0
PROOFS = 20_000
_ROWS = 24


@dataclass(frozen=True)
class Plan:
    """How much is run: in each pair ``rounds`` of ``drive_s`` at each rate, and so on."""

    pairs: int
    rounds: int
    drive_s: float
    renewals: int
    default_rounds: int
    floods: int
    adversaries: int
    calm_s: float


FULL = Plan(5, 4, 0.5, 1000, 3, 2, 100_000, 6.0)
QUICK = Plan(1, 3, 0.4, 300, 1, 1, 20_000, 2.0)


@dataclass(frozen=True)
class Figure:
    """One line of the final table; without a target it is only reported."""

    name: str
    reached: Spread
    target: float | None = None
    unit: str = ""

    def __str__(self) -> str:
        target = f"<= {self.target:g}" if self.target is not None else ""
        verdict = "" if self.target is None else "ok" if self.reached.middle <= self.target else "short"
        return f"{self.name:<54} {f'{self.reached} {self.unit}':>26} {target:>9}  {verdict}"


Drives = dict[int, Drive]
"""Drives by their rate."""


@dataclass(frozen=True)
class Pair:
    """What one run of the gateway and one of its rivals took, in turns."""

    idle: Drives
    script: Drives
    loaded: Drives
    load_hz: float
    renewals_us: tuple[float, ...]
    queries_us: tuple[float, ...]


class Benchmark:
    """All measurements of one call."""

    def __init__(self, plan: Plan, flood_hz: float) -> None:
        self._plan = plan
        self._flood_hz = flood_hz

    def run(self) -> list[Figure]:
        """Measure everything; say on the way what came out."""
        return [*self._latencies(), *_proofs(), *self._default_gap(), *self._floods()]

    # Latency, idle and under load, and the lease

    def _latencies(self) -> list[Figure]:
        head(
            "gateway | script; gateway under load; renewing the lease | a bare query",
            "us, median and 99th percentile of each",
        )
        runs = [self._pair() for _ in range(self._plan.pairs)]
        lease = [median(run.renewals_us) / median(run.queries_us) for run in runs]
        return [
            *_against_script(runs),
            *_under_load([(run.idle, run.loaded) for run in runs], "", 1.2),
            Figure("renewing the lease: median / a bare query's", Spread.of(lease), 2.0),
        ]

    def _pair(self) -> Pair:
        """Let the gateway and the script take turns, and the gateway with itself under load."""
        plan = self._plan
        idle, script, loaded = list[Drives](), list[Drives](), list[Drives]()
        with scene(Through.GATEWAY) as ours:
            with scene(Through.SCRIPT) as theirs:
                for _ in range(plan.rounds):
                    idle.append(self._drives(ours))
                    script.append(self._drives(theirs))
                    with ours.load():
                        loaded.append(self._drives(ours))
            renewals_us = ours.renew(plan.renewals)
        run = Pair(
            _joined(idle), _joined(script), _joined(loaded), ours.load_hz, renewals_us, bare_queries(plan.renewals)
        )
        for rate_hz in RATES_HZ:
            times = f"{_times(run.idle[rate_hz])}  | {_times(run.script[rate_hz])};  {_times(run.loaded[rate_hz])}"
            print(f"  {rate_hz:3}/s {times}")
        print(
            f"  lease {_line(run.renewals_us)}  | {_line(run.queries_us)};"
            f"  {run.load_hz:.0f} messages/s at the consumer under load\n",
            flush=True,
        )
        return run

    def _drives(self, running: Scene) -> Drives:
        return {rate_hz: running.drive(rate_hz, int(rate_hz * self._plan.drive_s)) for rate_hz in RATES_HZ}

    # The default gap

    def _default_gap(self) -> list[Figure]:
        head("gateway with the default gap_s; under load", "us, median and 99th percentile of those that arrived")
        runs: list[tuple[Drives, Drives]] = []
        with scene(Through.GATEWAY, DEFAULT_OPTIONS) as running:
            for _ in range(self._plan.default_rounds):
                idle = self._drives(running)
                with running.load():
                    runs.append((idle, self._drives(running)))
        figures = []
        for rate_hz in RATES_HZ:
            drives = [idle[rate_hz] for idle, _ in runs]
            for idle, loaded in runs:
                print(f"  {rate_hz:3}/s {_times(idle[rate_hz])};  {_times(loaded[rate_hz])}", flush=True)
            figures += [
                Figure(f"default gap_s, {rate_hz}/s: median", Spread.of([run.median_us for run in drives]), unit="us"),
                Figure(
                    f"default gap_s, {rate_hz}/s: arrived", Spread.of([run.arrived * 100 for run in drives]), unit="%"
                ),
            ]
        return [*figures, *_under_load(runs, "default gap_s, ", None)]

    # Adversaries

    def _floods(self) -> list[Figure]:
        head(
            f"{self._plan.adversaries:,} commands of adversaries while the driver drives at {FLOOD_DRIVE_HZ:.0f}/s",
            "driver before | meanwhile: us, median and 99th percentile",
        )
        paced = [self._flood(self._flood_hz) for _ in range(self._plan.floods)] if self._flood_hz else []
        unpaced = [self._flood(0)]
        every = paced + unpaced
        return [
            Figure("adversaries: applied", Spread.of([run.calm.applied + run.meanwhile.applied for run in every]), 0),
            Figure("adversaries: not counted", Spread.of([abs(run.uncounted) for run in every]), 0),
            *([self._flooded(paced, f"at {self._flood_hz:,.0f}/s", 2.0)] if paced else []),
            self._flooded(unpaced, "unpaced", None),
        ]

    def _flood(self, rate_hz: float) -> Flood:
        plan = self._plan
        with scene(Through.GATEWAY) as running:
            run = running.flood(plan.adversaries, rate_hz, FLOOD_DRIVE_HZ, plan.calm_s)
        print(
            f"  {run.rate_hz:8,.0f}/s  {_times(run.calm)}  | {_times(run.meanwhile)};  counted {run.counted}",
            flush=True,
        )
        return run

    def _flooded(self, floods: Sequence[Flood], how: str, target: float | None) -> Figure:
        ratios = [run.meanwhile.p99_us / run.calm.p99_us for run in floods]
        return Figure(f"adversaries {how}: driver's 99th percentile / before", Spread.of(ratios), target)


def _proofs() -> list[Figure]:
    """Measure what the proof of one command costs at either end."""
    given = Lease(ok=True, lease=bytes(range(8)), token=bytes(range(32)), expires_in_s=3.0)
    signer, verifier = Signer(given), Verifier(bytes(range(8)), bytes(range(32)))
    payload = packed(drive(1))
    attachment = signer.command(DRIVE, payload, 0)

    def check() -> None:
        assert verifier.plausible(attachment)
        assert verifier.proves(read(attachment), DRIVE, payload)

    def sign() -> None:
        signer.command(DRIVE, payload, 0)

    figures = []
    for what, work in (("checked", check), ("made", sign)):
        each_us = [seconds / PROOFS * 1e6 for seconds in timeit.repeat(work, number=PROOFS, repeat=7)]
        figures.append(Figure(f"a command's proof {what}", Spread.of(each_us), unit="us"))
    return figures


def _joined(rounds: Sequence[Drives]) -> Drives:
    return {rate_hz: Drive.joined([drives[rate_hz] for drives in rounds]) for rate_hz in RATES_HZ}


def _against_script(runs: Sequence[Pair]) -> list[Figure]:
    figures = []
    for rate_hz in RATES_HZ:
        pairs = [(run.idle[rate_hz], run.script[rate_hz]) for run in runs]
        ratio = Spread.of([ours.median_us / theirs.median_us for ours, theirs in pairs])
        tail = Spread.of([ours.p99_us / theirs.p99_us for ours, theirs in pairs])
        figures += [
            Figure(f"{rate_hz}/s: median", Spread.of([ours.median_us for ours, _ in pairs]), unit="us"),
            Figure(f"{rate_hz}/s: 99th percentile", Spread.of([ours.p99_us for ours, _ in pairs]), unit="us"),
            Figure(f"{rate_hz}/s: median / the script's", ratio, 0.95),
            Figure(f"{rate_hz}/s: 99th percentile / the script's", tail),
        ]
    lost = [sum(drive.sent - len(drive.latencies_us) for drive in run.idle.values()) for run in runs]
    return [*figures, Figure("commands that did not arrive", Spread.of(lost), 0)]


def _under_load(runs: Sequence[tuple[Drives, Drives]], prefix: str, target: float | None) -> list[Figure]:
    return [
        Figure(
            f"{prefix}{rate_hz}/s under load: median / idle",
            Spread.of([loaded[rate_hz].median_us / idle[rate_hz].median_us for idle, loaded in runs]),
            target,
        )
        for rate_hz in RATES_HZ
    ]


def _times(drive: Drive) -> str:
    arrived = "" if drive.arrived == 1 else f" ({drive.arrived:.1%} arrived)"
    return _line(drive.latencies_us) + arrived


def _line(latencies_us: tuple[float, ...]) -> str:
    return f"{median(latencies_us):6.0f} {p99(latencies_us):6.0f}"


def profile() -> None:
    """Show where a command's microseconds go on its way, and where CPU time goes when there are many."""
    for rate_hz in RATES_HZ:
        _profile_stages(rate_hz)
    _profile_cpu(PROFILED_HZ)


def _profile_stages(rate_hz: int) -> None:
    """Time every stage of a command in the gateway."""
    count = int(rate_hz * PROFILED_S)
    with scene(Through.GATEWAY, watch="stages") as running:
        running.drive(rate_hz, WARM)
        before = running.mark()
        drive = running.drive(rate_hz, count)
        spent = _spent(running, before)
        passed = [command for command in running.watched() if command["number"] in drive.sent_ns]
    head(f"stages of {len(passed)} commands at {rate_hz}/s", "us since the stage before: median, 99th percentile")
    print(f"  {_times(drive)}  from the client's put to the robot")
    last_ns = [drive.sent_ns[command["number"]] for command in passed]
    for stage, what in STAGES.items():
        now_ns = [command[stage] for command in passed]
        print(f"  {_line(tuple((now - last) / 1e3 for now, last in zip(now_ns, last_ns, strict=True)))}  {what}")
        last_ns = now_ns
    print("  CPU by thread:")
    for name, each_s in spent:
        _print_cost(each_s / count, name)


def _profile_cpu(rate_hz: int) -> None:
    """Sample where CPU time goes; at lower rates the sampler would mostly find the loop asleep."""
    count = int(rate_hz * PROFILED_S)
    with scene(Through.GATEWAY, watch="profiler") as running:
        running.drive(rate_hz, WARM)
        before = running.mark()
        drive = running.drive(rate_hz, count)
        spent = _spent(running, before)
        sampled = running.watched()
    head(f"profile: {count} commands at {rate_hz}/s", "us each; own time includes C code called")
    print(f"  {_times(drive)}; {drive.cpu_us:.0f} us of CPU a command\n  by thread:")
    for name, each_s in spent:
        _print_cost(each_s / count, name)
    for table, title in (("own", "own"), ("cumulative", "with what it calls"), ("lines", "by line")):
        print(f"  {title}:")
        for thread_name, place, spent_s in sampled[table][:_ROWS]:
            _print_cost(spent_s / count, f"{thread_name:<22} {place}")


def _spent(running: Scene, before: dict[int, tuple[str, float]]) -> list[tuple[str, float]]:
    """Give what every thread of the gateway has spent since, the greatest first."""
    pid = running.tested.pid
    spent = [
        ("event loop" if thread == pid else f"a thread of {name}", total - before.get(thread, ("", 0.0))[1])
        for thread, (name, total) in thread_cpu_s(pid).items()
    ]
    return sorted(spent, key=lambda item: -item[1])


def _print_cost(each_s: float, what: str) -> None:
    if each_s > 1e-7:
        print(f"    {each_s * 1e6:8.2f}  {what}")


def main() -> None:
    """Run what the arguments say; the exit code does not depend on targets: this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="short runs")
    parser.add_argument("--profile", action="store_true", help="only profile the gateway while it is driven")
    parser.add_argument("--flood", type=float, default=FLOOD_HZ, metavar="N", help="adversaries' commands a second")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    begun = time.monotonic()
    if arguments.profile:
        profile()
    else:
        figures = Benchmark(QUICK if arguments.quick else FULL, arguments.flood).run()
        print(f"\n{'figure':<54} {'least / median / most':>26} {'target':>9}")
        for figure in figures:
            print(figure)
    print(f"\n{time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
