"""Search all bounded worlds, and print what was reached: ``python -m tests.search [--quick] [--mutants] [WORLD]``."""

import argparse
import sys
import time
from collections import Counter

from tests.search.bounds import FULL, QUICK
from tests.search.intent import search_intent
from tests.search.mutants import MUTANTS, caught_by
from tests.search.search import Found, search
from zbridge.control.authority import Authority
from zbridge.hq.intent import Intent
from zbridge.lease.lease_client import LeaseClient


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("world", nargs="?", default="", help="only worlds whose name has this in it")
    parser.add_argument("--quick", action="store_true", help="only the worlds that the tests search")
    parser.add_argument("--mutants", action="store_true", help="which world catches each broken variant")
    options = parser.parse_args()
    if options.mutants:
        missed = [name for name, broken in MUTANTS if not _shown(name, caught_by(broken))]
        return 1 if missed else 0
    cells: Counter[tuple[str, str, str]] = Counter()
    states = 0
    for bounds in QUICK + (() if options.quick else FULL):
        if options.world in bounds.name:
            began = time.monotonic()
            found = search(bounds)
            states += found.states
            cells += found.cells
            print(f"{_line(found)} {time.monotonic() - began:6.1f} s", flush=True)
    intent = search_intent()
    cells += intent.cells
    print(f"{'the intent of an HQ program':34} {intent.states:7} states {intent.moves:8} moves, complete")
    print(f"{'all':34} {states + intent.states:7} states")
    _print_cells(cells)
    return 0


def _line(found: Found) -> str:
    return (
        f"{found.bounds.name:34} {found.states:7} states {found.moves:8} moves, "
        f"{'complete' if found.complete else 'CUT'}, the lease within {found.longest} steps"
    )


def _shown(name: str, by: str | None) -> bool:
    print(f"{name:50} {by or 'NOT CAUGHT'}", flush=True)
    return by is not None


def _print_cells(cells: Counter[tuple[str, str, str]]) -> None:
    """Print how often each cell of the tables in ``state-tables.md`` was executed."""
    for kind in (Authority, LeaseClient, Intent):
        every = [(state.value, said.value) for state, row in kind.TABLE.items() for said in row]
        reached = [cell for cell in every if cells[kind.__name__, *cell]]
        print(f"\n{kind.__name__}: {len(reached)} of {len(every)} cells")
        for state, said in every:
            print(f"  {state:24} {said:32} {cells[kind.__name__, state, said]:9}")


if __name__ == "__main__":
    sys.exit(main())
