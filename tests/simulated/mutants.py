"""``python -m tests.simulated.mutants``: break the product on purpose, and see that the simulation notices.

Each broken variant runs in a copy of the checkout, in a process of its own, until a rule is broken or its time is over.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.simulated.mutants_data import MUTANTS, Mutant
from tests.simulated.mutants_found import FOUND
from tests.simulated.mutants_handover import HANDOVER

ROOT = Path(__file__).parents[2]
SEED = 20_000
ALL = (*MUTANTS, *HANDOVER, *FOUND)


def main() -> int:
    """Run; return how many variants were not noticed."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulated.mutants", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for each variant, of one core")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("names", nargs="*", help="parts of names; by default all variants")
    options = parser.parse_args()
    missed = 0
    chosen = [each for each in ALL if not options.names or any(name in each.name for name in options.names)]
    for mutant in chosen:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="zbridge-mutant-") as folder:
            found = caught_by(mutant, Path(folder), options.seconds, options.seed)
        missed += found is None
        print(
            f"{'MISSED' if found is None else 'caught'} {time.monotonic() - begun:5.1f} s  {mutant.name}: {found}",
            flush=True,
        )
    print(f"{len(chosen) - missed} of {len(chosen)} broken variants were caught")
    return missed


def caught_by(mutant: Mutant, folder: Path, seconds: float, seed: int) -> str | None:
    """Return the first violation that a broken variant shows; None where it shows none."""
    for package in ("zbridge", "gateways", "tests/simulated"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for module in ("__init__.py", "fake_bus.py"):
        shutil.copy(ROOT / "tests" / module, folder / "tests" / module)
    broken = folder / mutant.file
    text = broken.read_text()
    if mutant.old not in text:
        raise SystemExit(f"{mutant.name}: {mutant.file} has no {mutant.old!r}")
    broken.write_text(text.replace(mutant.old, mutant.new, 1))
    command = [sys.executable, "-m", "tests.simulated", "--seconds", str(seconds), "--seed", str(seed), "--first"]
    command += ["--profile", mutant.profile] if mutant.profile else []
    ran = subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True, check=False
    )
    if ran.returncode == 0:
        return None
    lines = ran.stdout.strip().splitlines()
    if len(lines) < 2 or not lines[0].startswith("seed"):
        raise SystemExit(f"{mutant.name}: the simulation itself failed: {ran.stderr[-500:]}")
    return lines[1].strip()[:150]


if __name__ == "__main__":
    sys.exit(main())
