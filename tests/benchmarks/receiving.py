"""What one position costs: ``python -m tests.benchmarks.receiving [--against DIRECTORY] [--reads 20000]``.

A device with a fake link and a bus that takes everything reads positions of the TCP/UDP protocol, one a read and eight
a read; the fastest of many batches counts, since another process can only add. With ``--against`` another checkout is
measured by its own copy of this file's work, in turns with this one, and the difference is printed. Goal: metrics cost
45 ns per position at most.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import statistics
import subprocess
import sys
import time
import timeit
from pathlib import Path

from zbridge.metrics import Metrics

POSITION = bytes.fromhex("0e000000 01 37 00001643 000048c2 0000b442")
BATCH = 500
TURNS = 7
PER_READ = (1, 8)


async def measure(reads: int) -> list[float]:
    """Return the nanoseconds per position, for each number of positions in a read."""
    from tests.robot.scene import Rig, serving  # of the checkout that is measured

    found = []
    async with serving() as rig:
        assert isinstance(rig, Rig)
        await rig.establish()
        rig.bus.put_all = lambda streams: True  # type: ignore[method-assign]
        received = rig.conversations[-1].received
        for positions in PER_READ:
            data, times = POSITION * positions, []
            for _ in range(reads // BATCH):
                begun = time.perf_counter_ns()
                for _ in range(BATCH):
                    received(data)
                times.append((time.perf_counter_ns() - begun) / BATCH / positions)
            found.append(min(times))
    return found


def measured_in(directory: Path, reads: int) -> list[float]:
    """Measure a checkout in a process of its own."""
    command = [sys.executable, str(Path(__file__).absolute()), "--once", "--reads", str(reads)]
    environment = {**os.environ, "PYTHONPATH": str(directory)}
    done = subprocess.run(command, env=environment, cwd=directory, text=True, capture_output=True, check=True)
    return [float(word) for word in done.stdout.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--reads", type=int, default=20_000)
    parser.add_argument("--once", action="store_true", help="print the numbers of this process only")
    options = parser.parse_args()
    if options.once:
        print(*asyncio.run(measure(options.reads)))
        return
    trees = [Path(__file__).parents[2], *([options.against.absolute()] if options.against else [])]
    results: list[list[list[float]]] = [[] for _ in trees]
    for _ in range(TURNS):
        for tree, result in zip(trees, results, strict=True):
            result.append(measured_in(tree, options.reads))
    for place, positions in enumerate(PER_READ):
        costs = [statistics.median(each[place] for each in result) for result in results]
        line = f"{positions} a read: {costs[0]:.0f} ns per position"
        if options.against:
            pairs = [mine[place] - other[place] for mine, other in zip(*results, strict=True)]
            line += f"; there {costs[1]:.0f} ns; difference {statistics.median(pairs):+.0f} ns"
        print(line)
    print(f"an increment: {_cost_ns('count.value += 1'):.0f} ns; an observation: {_cost_ns('observe(0.001)'):.0f} ns")


def _cost_ns(statement: str) -> float:
    """Measure a statement on a counter and a histogram, without the loop around it."""
    metrics = Metrics()
    names = {
        "count": metrics.count("refused", code="held"),
        "observe": metrics.histogram("socket_to_bus_seconds").observe,
    }
    number = 200_000
    spent, empty = (min(timeit.repeat(each, globals=names, number=number)) for each in (statement, "pass"))
    return 1e9 * (spent - empty) / number


if __name__ == "__main__":
    main()
