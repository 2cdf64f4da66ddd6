"""What the black box costs: ``python -m tests.benchmarks.blackbox [--turns 24] [--cases scan:40 position:1000]``.

A gateway with ``[blackbox]`` and one without take turns, each with a robot and a subscriber of its own, all in
processes of their own. Printed are the delay from robot to subscriber, the CPU of the whole process, its
private memory, and what is written a day. Goals: at most 1 % of a core and 2 MB for scans at 40 Hz, p99 within 5 %.
Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import get_args

from tests.benchmarks.harness import Process, process
from tests.benchmarks.paced import Lane, configuration, interval, private_mb
from tests.benchmarks.paced_peers import Kind
from tests.ports import free_port

SLICE_S = 3.0
_PEERS = "tests.benchmarks.paced_peers"


@contextlib.contextmanager
def lane(kind: Kind, folder: Path, *, box: bool) -> Iterator[Lane]:
    """Run robot, gateway and subscriber."""
    with contextlib.ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"

        def start(module: str, *arguments: object) -> Process:
            return stack.enter_context(process(module, *arguments))

        sink = start(_PEERS, "subscriber", kind, endpoint)
        sink.hear()
        source = start(_PEERS, "robot", kind)
        file = folder / f"{'with' if box else 'without'}.toml"
        table = f'[blackbox]\ndir = "{folder}"\n' if box else ""
        file.write_text(configuration(kind, source.hear()["port"], endpoint) + table)
        gateway = start("zbridge", "run", file)
        start_s = (sink.hear()["first_ns"] - gateway.started_ns) / 1e9
        source.say("hold")
        source.hear()
        yield Lane(source, gateway, sink, start_s)


def written(folder: Path) -> int:
    """Count the bytes of all segments."""
    return sum(path.stat().st_size for path in folder.rglob("*.zbb"))


def measure(kind: Kind, rate_hz: float, turns: int) -> None:
    """Measure one kind of message at one rate, and print what came out."""
    with (
        tempfile.TemporaryDirectory() as made,
        lane(kind, Path(made), box=True) as ours,
        lane(kind, Path(made), box=False) as plain,
    ):
        time.sleep(1.0)
        count, sent = round(SLICE_S * rate_hz), 0
        before = written(Path(made))
        for turn in range(turns):
            for each in (ours, plain) if turn % 2 else (plain, ours):
                each.run(count, rate_hz)
            sent += count
        time.sleep(1.5)
        grown = (written(Path(made)) - before) / sent
        print(f"{kind}s at {rate_hz:g} Hz, {turns} turns of {count}")
        for figure in ("p50_us", "p99_us", "cpu_us"):
            mine, theirs = ([getattr(one, figure) for one in each.slices] for each in (ours, plain))
            ratios = [one / other for one, other in zip(mine, theirs, strict=True)]
            low, high = interval(ratios)
            print(
                f"  {figure}: {median(mine):.0f} with, {median(theirs):.0f} without, ratio {median(ratios):.3f}"
                f" (95 %: {low:.3f} to {high:.3f})"
            )
        more_us = median(a.cpu_us - b.cpu_us for a, b in zip(ours.slices, plain.slices, strict=True))
        memory = [private_mb(each.tested.pid) for each in (ours, plain)]
        print(f"  {more_us:+.1f} us of CPU a message: {more_us * rate_hz / 1e4:+.2f} % of a core")
        print(f"  private memory: {memory[0]:.1f} MB with, {memory[1]:.1f} without: {memory[0] - memory[1]:+.1f}")
        print(f"  {grown:.0f} bytes a message: {grown * rate_hz * 86400 / 1e9:.1f} GB a day", flush=True)


def main() -> None:
    """Run what the arguments say; this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--turns", type=int, default=24)
    parser.add_argument("--cases", nargs="+", default=["scan:40", "scan:10", "position:40", "position:1000"])
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    for case in arguments.cases:
        kind, _, rate = case.partition(":")
        assert kind in get_args(Kind)
        measure(kind, float(rate), arguments.turns)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
