"""State tables in ``docs/``: read back, to be compared with the tables that the code executes."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"
NOTHING = "\u2013"

Cells = dict[tuple[str, str], str]
"""What a table says of each state and input: ``action → next state``, or the action alone if the state stays."""


def documented(page: str, first: str) -> Cells:
    """Read the table of a page whose first heading is ``first``. Its columns are states, several in one allowed."""
    lines = iter((DOCS / page).read_text().splitlines())
    heading = next(line for line in lines if line.startswith(f"| {first} |"))
    states = [cell.split(", ") for cell in _cells(heading)[1:]]
    next(lines)
    cells: Cells = {}
    for line in lines:
        if not line.startswith("|"):
            return cells
        said, *entries = _cells(line)
        for together, entry in zip(states, entries, strict=True):
            if entry != NOTHING:
                cells |= {(state, said): entry.removesuffix(f" → {state}") for state in together}
    return cells


def executed(table: Mapping[Any, Mapping[Any, tuple[Any, Any]]]) -> Cells:
    """Write a table of the code in the same form."""
    return {
        (state.value, said.value): _named(action) + (f" → {after.value}" if after not in (None, state) else "")
        for state, row in table.items()
        for said, (action, after) in row.items()
    }


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _named(action: Any) -> str:
    name: str = action.value if isinstance(action, Enum) else action.__name__
    return name.strip("_").replace("_", " ")
