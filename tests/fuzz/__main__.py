"""Fuzz what reads foreign bytes.

    python -m tests.fuzz --list
    python -m tests.fuzz [TARGET ...] --seconds 60 [--seed 1]     # each target for so long, with atheris if it is there
    python -m tests.fuzz [TARGET ...] --blind --bytes 1000000     # each target so many bytes, repeatable by its seed
    python -m tests.fuzz --coverage                               # lines that the corpus reaches, as a table
    python -m tests.fuzz [TARGET ...] --keep                      # move what atheris found into tests/corpus

Inputs that are a finding are written to ``zbridge-fuzz/<target>/`` in the folder for temporary files.
"""

import argparse
import importlib.util
import sys
import time
import warnings

from tests.fuzz import engine
from tests.fuzz.corpus import keep
from tests.fuzz.coverage import table
from tests.fuzz.registry import TARGETS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="all if none is named; a prefix names several")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target")
    parser.add_argument("--bytes", type=int, help="for each target, of the blind engine")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--blind", action="store_true", help="do without atheris")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--coverage", action="store_true")
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    wanted = [name for name in TARGETS if not options.targets or name.startswith(tuple(options.targets))]
    if not wanted:
        parser.error(f"no target begins with {', '.join(options.targets)}")
    if options.list:
        print("\n".join(wanted))
    elif options.coverage:
        print(table([TARGETS[name] for name in wanted]))
    elif options.keep:
        for name in wanted:
            print(name, *keep(TARGETS[name]))
    elif options.blind or importlib.util.find_spec("atheris") is None:
        return _blind(wanted, options)
    else:
        codes = [engine.run_guided(TARGETS[name], options.seconds, options.seed) for name in wanted]
        return max(codes)
    return 0


def _blind(wanted: list[str], options: argparse.Namespace) -> int:
    engine.bound_memory()
    warnings.simplefilter("error")
    seconds = 1e9 if options.bytes else options.seconds
    total, began = engine.Tally(), time.monotonic()
    for name in wanted:
        started = time.monotonic()
        tally = engine.run_blind(TARGETS[name], seconds, options.seed, options.bytes)
        took_s = time.monotonic() - started
        print(
            f"{name:28} {tally.inputs:9} inputs {tally.bytes:12} bytes {tally.findings} findings {took_s:7.1f} s",
            flush=True,
        )
        total.inputs += tally.inputs
        total.bytes += tally.bytes
        total.findings += tally.findings
    print(f"{'all':28} {total.inputs:9} inputs {total.bytes:12} bytes {total.findings} findings "
          f"{time.monotonic() - began:7.1f} s, seed {options.seed}")  # fmt: skip
    return 1 if total.findings else 0


if __name__ == "__main__":
    sys.exit(main())
