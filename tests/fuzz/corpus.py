"""Chooses what is kept of what atheris found: inputs that reach lines which no kept one reaches, the shortest first."""

from __future__ import annotations

import hashlib
import random
import tempfile
from dataclasses import replace
from pathlib import Path

from tests.fuzz.coverage import reached
from tests.fuzz.engine import mutated
from tests.fuzz.target import CORPUS, Target

MOST_FILES, MOST_BYTES = 40, 12_000
"""Of one target."""
BENT = 1500


def keep(target: Target) -> tuple[int, int]:
    """Add to the corpus of a target what reaches more; return how many files and bytes it has."""
    known = target.corpus()
    found = Path(tempfile.gettempdir()) / "zbridge-fuzz" / target.name / "found"
    candidates = {path.read_bytes() for path in found.glob("*")} if found.is_dir() else _bent(target)
    lines = _lines(target, known[0][1] if known else b"", *(data for _, data in known))
    folder, size, count = CORPUS / target.name, sum(len(data) for _, data in known), len(known)
    for data in sorted(candidates, key=lambda data: (len(data), data)):
        if size + len(data) > MOST_BYTES or count >= MOST_FILES:
            continue
        more = _lines(target, data) - lines
        if more:
            lines |= more
            folder.mkdir(parents=True, exist_ok=True)
            (folder / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
            size, count = size + len(data), count + 1
    return count, size


def _bent(target: Target) -> set[bytes]:
    """Bend the seeds of a target that atheris has not run."""
    chance, pool = random.Random(target.name), list(target.seeds())
    return {mutated(pool, chance, target.most_bytes) for _ in range(BENT)}


def _lines(target: Target, *inputs: bytes) -> set[tuple[str, int]]:
    alone = replace(target, seeds=lambda: inputs)
    object.__setattr__(alone, "corpus", list)
    return {(path, line) for path, lines in reached(alone).items() for line in lines}
