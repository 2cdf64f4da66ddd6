"""Writes what docstrings have of reStructuredText, roles and simple tables, as Markdown, for the pages of the API."""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):`(?:[~.])?([^`]+)`")
TABLE = re.compile(r"^(=+) =+\n(.*?)\n=+ =+$", re.MULTILINE | re.DOTALL)


class Plain(griffe.Extension):
    """Rewrites every docstring as it is read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = TABLE.sub(_table, ROLE.sub(r"`\1`", obj.docstring.value))


def _table(match: re.Match[str]) -> str:
    """Write a table of two columns; a row goes on where its first cell is empty."""
    width = len(match[1]) + 1
    rows: list[tuple[str, list[str]]] = []
    for line in match[2].splitlines():
        first, rest = line[:width].strip(), line[width:].strip()
        if first:
            rows.append((first, [rest]))
        else:
            rows[-1][1].append(rest)
    lines = (f"| `{first}` | {' '.join(rest)} |" for first, rest in rows)
    return "\n".join(["| part | contents |", "|---|---|", *lines])
