"""What commands print: lines, and tables that fit the terminal. Piped output is never cut.

Whatever peers sent is printed as text that is safe, never interpreted as markup. ``NO_COLOR`` removes bold too.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.text import Text

from zbridge.fleet.printable import shown

console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)
errors = Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)

_GAP = 2
"""Characters between two columns."""
_CUT = "..."


class Column(msgspec.Struct, frozen=True):
    """A column of a table.

    cut: its place among those that a narrow terminal makes shorter, and then leaves out: the highest first, 0 never.
    number: aligned to the right, and never shortened: a number without its end is another number.
    """

    title: str
    cut: int = 0
    number: bool = False


class Table:
    """Rows of text in columns. A table of rich takes a millisecond for each row."""

    def __init__(self, columns: Sequence[Column], rows: Iterable[Sequence[object]]) -> None:
        self._columns = columns
        self._rows = [[column.title for column in columns], *([shown(cell) for cell in row] for row in rows)]

    def __repr__(self) -> str:
        return f"<Table of {len(self._rows) - 1} rows>"

    def lines(self, room: int | None) -> list[str]:
        """Lay the table out, its titles first. room: characters of a line; None: as many as the cells have."""
        widths = [max(map(cell_len, cells)) for cells in zip(*self._rows, strict=True)]
        kept = fitted(self._columns, widths, room) if room is not None else dict(enumerate(widths))
        return [self._line(row, kept) for row in self._rows]

    def text(self, room: int | None) -> Text:
        """Return the table with bold titles, unless ``NO_COLOR`` is set."""
        titles, *rows = self.lines(room)
        return Text.assemble((titles, bold()), "".join(f"\n{row}" for row in rows))

    def print(self) -> None:
        """Print the table, as wide as the terminal at most."""
        console.print(self.text(console.width if sys.stdout.isatty() else None))

    def _line(self, row: Sequence[str], kept: dict[int, int]) -> str:
        cells = (_sized(row[place], width, self._columns[place]) for place, width in kept.items())
        return (" " * _GAP).join(cells).rstrip()


def builtins(message: msgspec.Struct) -> Any:
    """Return a message as values that :func:`zbridge.fleet.printable.as_json` prints."""
    return msgspec.to_builtins(message, builtin_types=(bytes,))


def bold() -> str:
    """Return the style of titles: bold, and none at all if ``NO_COLOR`` is set (rich leaves bold)."""
    return "" if os.environ.get("NO_COLOR") else "bold"


def fitted(columns: Sequence[Column], widths: Sequence[int], room: int) -> dict[int, int]:
    """Return which columns are shown, and how wide, so that they fit into a line where that is possible.

    Columns are shortened to the width of their titles, the least important first; if that is not enough, the least
    important column is left out, and the others are laid out anew.
    """
    kept = dict(enumerate(widths))
    least = sorted((place for place in kept if columns[place].cut), key=lambda place: -columns[place].cut)
    while True:
        wide = dict(kept)
        for place in least:
            excess = sum(wide.values()) + _GAP * (len(wide) - 1) - room
            if excess > 0 and not columns[place].number:
                wide[place] = min(wide[place], max(cell_len(columns[place].title), wide[place] - excess))
        if not least or sum(wide.values()) + _GAP * (len(wide) - 1) <= room:
            return wide
        del kept[least.pop(0)]


def _sized(text: str, width: int, column: Column) -> str:
    """Return a text of exactly this width."""
    missing = width - cell_len(text)
    if missing < 0:
        return set_cell_size(text, width - len(_CUT)) + _CUT if width > len(_CUT) else set_cell_size(text, width)
    return " " * missing + text if column.number else text + " " * missing
