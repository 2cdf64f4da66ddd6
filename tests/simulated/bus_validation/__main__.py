"""Play the traces on the model and on real Zenoh, and compare: ``python -m tests.simulated.bus_validation [TRACE]``."""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from tests.e2e.rigs.processes import go_apart
from tests.simulated.bus_validation import played_model, played_real
from tests.simulated.bus_validation.played_real import Played
from tests.simulated.bus_validation.trace import Finding, Trace
from tests.simulated.bus_validation.traces import TRACES

LATE_S, EARLY_S = 0.3, 0.05
"""Seconds by which a real observation may be outside what the model allows: this machine has other work."""
MANY = 10
"""Samples of which two, or one in fifty, may be more or fewer: the clocks of a cut are not those of its samples."""
AGAIN = 2
"""Times that a trace is played again which differs: this machine may have been late."""
SEEDS = 60


class Allowed:
    """What the model allows for one finding: a range of numbers, or a set."""

    def __init__(self) -> None:
        self.numbers: list[float] = []
        self.others: set[Any] = set()

    def add(self, value: Finding) -> None:
        """Note what the model did once."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            self.numbers.append(value)
        else:
            self.others.add(value)

    def has(self, value: Finding) -> bool:
        """Whether the model allows this."""
        if not isinstance(value, int | float) or isinstance(value, bool):
            return value in self.others
        if not self.numbers:
            return False
        slack = max(2.0, 0.02 * max(self.numbers)) if max(self.numbers) > MANY else 0.0
        late, early = (LATE_S, EARLY_S) if isinstance(value, float) else (slack, slack)
        return min(self.numbers) - early <= value <= max(self.numbers) + late

    def __str__(self) -> str:
        texts = [shown(other) for other in sorted(self.others, key=str)]
        if self.numbers:
            least, most = min(self.numbers), max(self.numbers)
            texts.insert(0, shown(least) if least == most else f"{shown(least)} to {shown(most)}")
        return " or ".join(texts)


def shown(value: Finding) -> str:
    if isinstance(value, bool) or value is None:
        return {None: "never", True: "yes", False: "no"}[value]
    return f"{value:.2f} s" if isinstance(value, float) else str(value) or "none"


def allowed(trace: Trace, seeds: int) -> dict[str, Allowed]:
    """Play a trace on the model, with many seeds."""
    found: dict[str, Allowed] = {}
    for seed in range(seeds):
        for name, value in trace.read(played_model.play(trace, seed)).items():
            found.setdefault(name, Allowed()).add(value)
    return found


def compared(trace: Trace, model: dict[str, Allowed], plays: list[Played]) -> tuple[bool, str]:
    """Return whether the model allows all that Zenoh did, and a table of both."""
    reals = [trace.read(play.log) for play in plays]
    names = list(dict.fromkeys((*model, *(name for real in reals for name in real))))
    equal, lines = True, []
    for name in names:
        values = [real.get(name) for real in reals]
        fits = all(name in model and model[name].has(value) for value in values)
        equal = equal and fits
        did = " | ".join(dict.fromkeys(map(shown, values)))
        lines.append(f"    {name:30} {model.get(name, Allowed())!s:34} {did:34} {'' if fits else 'DIFFERENT'}")
    withheld_s = max(play.withheld_s for play in plays)
    heading = f"{'equal    ' if equal else 'DIFFERENT'} {trace.name} (the machine withheld {withheld_s:.2f} s)"
    return equal, "\n".join((heading, *lines))


def validate(traces: list[Trace], options: Any) -> bool:
    """Play the traces on both, and print what came of it. What differs is played again, alone."""
    models = [allowed(trace, options.seeds) for trace in traces]
    count = 0
    with ThreadPoolExecutor(options.at_once) as pool:
        plays = [[pool.submit(played_real.play, trace) for _ in range(options.repetitions)] for trace in traces]
        for trace, model, played in zip(traces, models, plays, strict=True):
            equal, table = compared(trace, model, [play.result() for play in played])
            for _ in range(AGAIN):
                if not equal:
                    print(table, "    played again:", sep="\n", flush=True)
                    equal, table = compared(trace, model, [played_real.play(trace)])
            print(table, flush=True)
            count += equal
    print(f"{count} of {len(traces)} traces are equal")
    return count == len(traces)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trace", nargs="?", default="", help="only traces whose name has this in it")
    parser.add_argument("--repetitions", type=int, default=1, help="how often each is played on Zenoh")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how often each is played on the model")
    parser.add_argument("--at-once", type=int, default=4, help="traces that are played on Zenoh at a time")
    parser.add_argument("--quick", action="store_true", help="only the traces that the tests play")
    parser.add_argument("--model", action="store_true", help="only the model: print what it allows")
    options = parser.parse_args()
    traces = [each for each in TRACES if options.trace in each.name and (each.quick or not options.quick)]
    if options.model:
        for trace in traces:
            print(
                trace.name, *(f"    {name:30} {each}" for name, each in allowed(trace, options.seeds).items()), sep="\n"
            )
        return 0
    if not go_apart("tests.simulated.bus_validation"):
        return 3
    print(f"eclipse-zenoh {importlib.metadata.version('eclipse-zenoh')}, {time.strftime('%Y-%m-%d')}")
    print(f"{'':34} {'the model':34} {'Zenoh':34}", flush=True)
    return 0 if validate(traces, options) else 1


if __name__ == "__main__":
    sys.exit(main())
