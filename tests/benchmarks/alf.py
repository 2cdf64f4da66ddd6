"""Measure what an ALF vehicle costs: one scan decoded, scans through the real gateway, and a vehicle that is driven.

    python -m tests.benchmarks.alf              # everything, about two minutes and a half
    python -m tests.benchmarks.alf --quick      # short runs, under a minute: a look, no verdict
    python -m tests.benchmarks.alf --profile    # only where the gateway's microseconds go

Run it from the root of a checkout, on a machine that does nothing else. What is measured, and how:

- Decoding: ``read_text`` and ``ranges_m`` of one text scan of 769 points (3.8 kB), to float32 metres, against
  ``np.fromstring(body, dtype=np.int64, sep="|")`` of the same bytes, its id left out; in turns, in this process.
- Text scans, as fast as the socket takes them, through ``python -m zbridge run`` with ``stream = "block"`` and through
  the script of an afternoon (:mod:`tests.benchmarks.alf_script`), which puts with BLOCK: neither loses any. The
  rate is what arrived at the subscriber divided by the time from the first byte sent to the last scan received; CPU
  is that of all threads of the process under test, divided by the scans. Vehicle, gateway and subscriber are
  processes of their own; scans travel by TCP, as between machines.
- Binary scans likewise, against a bare loop of ``publisher.put`` of the same payload.
- A vehicle in use: 10 text scans a second, drive info each second, and a client that holds the lease and drives at
  50 Hz; the CPU time of the gateway's process in per cent of one core.
- Paired runs: gateway and rival take turns; a ratio is that of one pair, and the median of the ratios counts.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gateways.alf.messages import Measurement, ScannerInit, read_text, sent_by
from gateways.alf.translate import ranges_m
from tests.benchmarks import alf_wire
from tests.benchmarks.alf_flow import COMMANDS_HZ, SCANS_HZ, saturated, steady
from tests.benchmarks.flow import Route, Run
from tests.benchmarks.gateway import head
from tests.benchmarks.harness import Spread, pairs
from zbridge.protocol.session import Role

ROUNDS = 25
"""Turns of decoding; each of both sides takes the fastest of three repetitions."""
_REPEAT = 3


@dataclass(frozen=True)
class Plan:
    """How much is run; scans are counted."""

    pairs: int
    decoded: int
    gateway_text: int
    script_text: int
    gateway_binary: int
    bare: int
    steady_runs: int
    steady_s: float


FULL = Plan(5, 400, 16_000, 2000, 30_000, 100_000, 3, 20.0)
QUICK = Plan(2, 100, 5000, 700, 8000, 25_000, 1, 8.0)
PROFILED_TEXT, PROFILED_BINARY, PROFILED_S = 30_000, 50_000, 15.0
_ROWS = 20


@dataclass(frozen=True)
class Figure:
    """One line of the final table; ``at_least`` tells which side of the target is the good one."""

    name: str
    reached: Spread
    target: float
    unit: str = ""
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """Whether the median reaches the target."""
        reached = self.reached.middle
        return reached >= self.target if self.at_least else reached <= self.target

    def __str__(self) -> str:
        target = f"{'>=' if self.at_least else '<='} {self.target:g} {self.unit}"
        return f"{self.name:<48} {f'{self.reached} {self.unit}':>24} {target:>10}  {'ok' if self.ok else 'short'}"


def decoding(count: int) -> list[Figure]:
    """Decode the same text scan by the codec and by numpy alone, in turns."""
    head("a text scan, 769 points, to float32 metres", "us: codec and ranges_m, np.fromstring of the same bytes, ratio")
    frame = alf_wire.scan("text", 12_345, 1_234_567)
    body = frame[2:-1]
    ids = sent_by(Role.ROBOT)
    scanner = read_text(alf_wire.geometry("text"), ids)
    assert isinstance(scanner, ScannerInit)

    def ours() -> object:
        message = read_text(frame, ids)
        assert isinstance(message, Measurement)
        return ranges_m(message, scanner)

    def numpy() -> object:
        return np.fromstring(body, dtype=np.int64, sep="|")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = pairs(ROUNDS, lambda: _each_us(ours, count), lambda: _each_us(numpy, count))
    ratio = Spread.of([codec / bare for codec, bare in runs])
    print(f"  {Spread.of([codec for codec, _ in runs])}  |  {Spread.of([bare for _, bare in runs])}  |  {ratio}")
    return [Figure("text scan decoded: time / np.fromstring's", ratio, 2.0)]


def _each_us(work: Callable[[], object], count: int) -> float:
    """Time one call: the fastest of some repetitions of ``count``."""
    fastest = float("inf")
    for _ in range(_REPEAT):
        begun = time.perf_counter()
        for _ in range(count):
            work()
        fastest = min(fastest, time.perf_counter() - begun)
    return fastest / count * 1e6


def text_scans(plan: Plan) -> list[Figure]:
    """Saturate the gateway and the script with text scans."""
    head("text scans, saturated, nothing dropped: gateway | script", "scans/s, CPU us/scan, lost")
    runs = pairs(
        plan.pairs,
        lambda: saturated(Route.GATEWAY, "text", plan.gateway_text),
        lambda: saturated(Route.SCRIPT, "text", plan.script_text),
    )
    _print_pairs(runs)
    return [
        Figure("text scans: rate / the script's", _ratio(runs, lambda run: run.rate_hz), 6, at_least=True),
        Figure("text scans: CPU per scan / the script's", _ratio(runs, lambda run: run.cpu_us), 0.2),
        _lost("text", runs),
    ]


def binary_scans(plan: Plan) -> list[Figure]:
    """Saturate the gateway with binary scans, and Zenoh with what comes of them."""
    head("binary scans, saturated, nothing dropped: gateway | bare loop", "scans/s, CPU us/scan, lost")
    runs = pairs(
        plan.pairs,
        lambda: saturated(Route.GATEWAY, "binary", plan.gateway_binary),
        lambda: saturated(Route.ZENOH, "binary", plan.bare),
    )
    _print_pairs(runs)
    return [
        Figure("binary scans: rate / the bare loop's", _ratio(runs, lambda run: run.rate_hz), 0.25, at_least=True),
        _lost("binary", runs),
    ]


def in_use(plan: Plan) -> list[Figure]:
    """Let one vehicle measure and be driven."""
    head(
        f"one vehicle: {SCANS_HZ:g} text scans/s, {COMMANDS_HZ:g} leased commands/s",
        "% of a core, scans arrived, commands the vehicle read, memory MB",
    )
    shares = []
    for _ in range(plan.steady_runs):
        run, commands = steady("text", plan.steady_s)
        shares.append(run.cpu_s / run.seconds * 100)
        print(f"  {shares[-1]:.2f}  {run.arrived}/{run.sent}  {commands}  {run.memory_mb:.0f}", flush=True)
        _print_threads(run, run.seconds, 1e-4, "%", 100)
    return [Figure("one vehicle: share of a core", Spread.of(shares), 3, "%")]


def _print_pairs(runs: list[tuple[Run, Run]]) -> None:
    for ours, theirs in runs:
        print(f"  {_line(ours)}  |  {_line(theirs)}", flush=True)


def _ratio(runs: list[tuple[Run, Run]], value: Callable[[Run], float]) -> Spread:
    return Spread.of([value(ours) / value(theirs) for ours, theirs in runs])


def _lost(what: str, runs: list[tuple[Run, Run]]) -> Figure:
    return Figure(f"{what} scans: lost", Spread.of([ours.lost + theirs.lost for ours, theirs in runs]), 0)


def _line(measured: Run) -> str:
    return f"{measured.rate_hz:9,.0f} {measured.cpu_us:7.1f} {measured.lost:4,}"


def profile() -> None:
    """Show where the gateway's time goes: saturated with text and binary scans, and with a vehicle in use."""
    for dialect, count in (("text", PROFILED_TEXT), ("binary", PROFILED_BINARY)):
        run = saturated(Route.GATEWAY, "text" if dialect == "text" else "binary", count, profile=True)
        head(f"profile: {count} {dialect} scans, saturated", "us a scan; own time includes C code called")
        print(f"  {_line(run)}")
        _print_profile(run, count)
    run, _ = steady("text", PROFILED_S, profile=True)
    head("profile: a vehicle in use", "us a second; own time includes C code called")
    print(f"  {run.cpu_s / run.seconds:.2%} of a core")
    _print_profile(run, run.seconds)


def _print_profile(run: Run, divisor: float) -> None:
    assert run.profile is not None
    _print_threads(run, divisor, 1e-8, "us", 1e6)
    for table, title in (("own", "own"), ("cumulative", "with what it calls"), ("lines", "by line")):
        print(f"  {title}:")
        for thread, place, spent_s in run.profile[table][:_ROWS]:
            print(f"    {spent_s / divisor * 1e6:8.2f}  {thread:<22} {place}")


def _print_threads(run: Run, divisor: float, least: float, unit: str, factor: float) -> None:
    names = {int(thread): name for thread, name in run.profile["threads"].items()} if run.profile else {}
    spent = sorted(((spent / divisor, names.get(thread, comm)) for thread, (comm, spent) in run.threads_s.items()))
    shown = [f"{name} {each * factor:.2f} {unit}" for each, name in reversed(spent) if each > least]
    print(f"    by thread: {', '.join(shown)}", flush=True)


def main() -> None:
    """Run what the arguments say; the exit code does not depend on targets: this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two pairs of short runs")
    parser.add_argument("--profile", action="store_true", help="only profile the gateway")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    begun = time.monotonic()
    if arguments.profile:
        profile()
    else:
        plan = QUICK if arguments.quick else FULL
        figures = [*decoding(plan.decoded), *text_scans(plan), *binary_scans(plan), *in_use(plan)]
        print(f"\n{'figure':<48} {'least / median / most':>24} {'target':>10}")
        for figure in figures:
            print(figure)
    print(f"\n{time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
