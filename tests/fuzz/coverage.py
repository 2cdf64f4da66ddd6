"""Which lines of the readers the corpus reaches: a table for ``reliability.md``."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from tests.fuzz.target import Target

ROOT = Path(__file__).parents[2]


def reached(target: Target) -> dict[str, set[int]]:
    """Replay corpus and seeds of a target; return the lines of each covered module that ran."""
    paths = {str(ROOT / path): path for path in target.covers}
    lines: dict[str, set[int]] = {path: set() for path in target.covers}

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        path = paths.get(frame.f_code.co_filename)
        if path is None:
            return None
        seen = lines[path]

        def line(frame: FrameType, event: str, argument: Any) -> Any:
            seen.add(frame.f_lineno)
            return line

        return line(frame, event, argument)

    sys.settrace(trace)
    try:
        for data in [data for _, data in target.corpus()] + list(target.seeds()):
            target.run(data)
    finally:
        sys.settrace(None)
    return lines


def countable(path: str) -> set[int]:
    """Return the lines of a module's functions; not those that run on import, nor of ``__repr__``."""
    text = (ROOT / path).read_text()
    return set(_lines(compile(text, str(ROOT / path), "exec"), top=True))


def _lines(code: CodeType, *, top: bool) -> Iterable[int]:
    body = code.co_flags & 0x02  # CO_NEWLOCALS: a function, no class body
    if not top and body and code.co_name != "__repr__":
        yield from (line for _, _, line in code.co_lines() if line is not None and line > code.co_firstlineno)
    for constant in code.co_consts:
        if isinstance(constant, CodeType) and constant.co_name != "__repr__":
            yield from _lines(constant, top=False)


def table(targets: list[Target]) -> str:
    """Write the table: what all targets together reach of each module."""
    lines: dict[str, set[int]] = {}
    names: dict[str, list[str]] = {}
    for target in targets:
        for path, seen in reached(target).items():
            lines.setdefault(path, set()).update(seen)
            names.setdefault(path, []).append(target.name)
    rows = ["| module | lines reached | targets |", "|---|---|---|"]
    for path in sorted(lines):
        all_lines = countable(path)
        seen = lines[path] & all_lines
        share = 100 * len(seen) // max(1, len(all_lines))
        rows.append(f"| `{path}` | {share} % ({len(seen)} of {len(all_lines)}) | {_shortened(names[path])} |")
    return "\n".join(rows)


def _shortened(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
