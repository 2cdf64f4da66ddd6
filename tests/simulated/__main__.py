"""``python -m tests.simulated``: run scenarios for so many seconds, or replay one that is kept."""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from tests.simulated.generate import PROFILES, scenario
from tests.simulated.rows import counted, table
from tests.simulated.scenario import Outcome, run
from tests.simulated.shrink import shrink


def main() -> int:
    """Run; return 1 where a rule was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulated", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to run, in seconds of this machine")
    parser.add_argument("--seed", type=int, default=0, help="the first seed; each scenario takes the next one")
    parser.add_argument("--count", type=int, help="scenarios to run at most")
    parser.add_argument("--profile", choices=PROFILES, help="one profile; by default the seed chooses")
    parser.add_argument("--replay", type=Path, help="run a kept scenario (JSON) and print its trace")
    parser.add_argument("--trace", action="store_true", help="print the trace of the first scenario")
    parser.add_argument("--keep", type=Path, help="a folder: shrink what fails, and write it there")
    parser.add_argument("--first", action="store_true", help="end with the first scenario that fails")
    parser.add_argument("--twice", action="store_true", help="run each scenario twice and compare the traces")
    parser.add_argument(
        "--rows", action="store_true", help="print how often each row of the tables in docs was reached"
    )
    parser.add_argument("--verbose", action="store_true", help="print the counts of what was reached")
    options = parser.parse_args()
    if options.replay is not None:
        return show(run(json.loads(options.replay.read_text()), keep_trace=True))
    if options.trace:
        return show(run(scenario(options.seed, options.profile), keep_trace=True))
    if options.rows:
        with counted(reached := Counter[str]()):
            failed = campaign(options, reached)
        for name, row, count in table(reached):
            print(f"  {name:13} {row:58} {count:8}")
        return failed
    return campaign(options, Counter())


def show(outcome: Outcome) -> int:
    """Print a trace, and what was violated."""
    print("\n".join(line[:240] for line in outcome.lines))
    print(*outcome.violations, f"hash {outcome.hash}", sep="\n")
    return bool(outcome.violations)


def campaign(options: Any, counts: Counter[str]) -> int:
    """Run one scenario after the other. counts: is added what they reached."""
    begun, simulated, failed = time.process_time(), 0.0, 0
    ran = 0
    gc.freeze()  # what is loaded stays: only the scenarios' own objects are looked at after each
    for seed in itertools.count(options.seed):
        if time.process_time() - begun > options.seconds or ran == options.count:
            break
        made = scenario(seed, options.profile)
        outcome = run(made)
        ran, simulated = ran + 1, simulated + outcome.seconds
        counts.update(outcome.counts)
        if options.twice and run(made).hash != outcome.hash:
            print(f"seed {seed} ({made['profile']}): two runs differ")
            failed += 1
        if outcome.violations:
            failed += 1
            report(seed, made, outcome, options.keep)
        if failed and options.first:
            break
    spent = time.process_time() - begun
    print(f"{ran} scenarios, {simulated / 3600:.2f} simulated hours in {spent:.0f} s of one core: ", end="")
    print(f"{simulated / 60 / spent:.2f} simulated hours a minute; {failed} failed")
    if options.verbose:
        for what, count in sorted(counts.items()):
            print(f"  {count:8} {what}")
    return bool(failed)


def report(seed: int, made: dict[str, Any], outcome: Outcome, keep: Path | None) -> None:
    """Print what was violated; keep the smallest scenario that does the same."""
    print(f"seed {seed} ({made['profile']}):", *outcome.violations[:4], sep="\n    ")
    if keep is not None:
        small = shrink(made, outcome.rules)
        keep.mkdir(parents=True, exist_ok=True)
        path = keep / f"{sorted(outcome.rules)[0]}-{seed}.json"
        path.write_text(json.dumps(small, indent=1) + "\n")
        print(f"    kept as {path}: {len(small['steps'])} of {len(made['steps'])} steps")


sys.exit(main())
