"""The columns of ``zbridge top``: what each shows, the order of rows, and which fit a width.

Theory of operation. :data:`IMPORTANCE` names the columns, the robot's name first. :func:`fit` gives each in turn the
width of its widest cell, at most its ``most``, while there is room; the first that does not get its ``least`` is left
out, with all that are less important. So the name is cut only where no other column is left. What remains widens the
columns that are still cut.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
from rich.cells import cell_len, set_cell_size

from zbridge.errors import ConfigError
from zbridge.views.rows import RobotRow

GAP = "  "
"""Between two columns."""
_CUT = "…"
_ARROWS = {False: "↑", True: "↓"}
"""Follows the title of the column by which rows are sorted: the smallest first, the largest first."""


class TopColumn(msgspec.Struct, frozen=True):
    """One column. name: for ``--sort``. value: sorts; None and "" come last. text: the cell.

    least: the column is left out rather than cut further. most: its width while other columns need room.
    right: numbers, sorted with the largest first.
    """

    name: str
    title: str
    value: Callable[[RobotRow], str | float | None]
    text: Callable[[RobotRow], str]
    least: int
    most: int
    right: bool = False


class Order(msgspec.Struct, frozen=True):
    """By which column rows are sorted. reverse: the other way round."""

    column: TopColumn
    reverse: bool = False

    @property
    def largest_first(self) -> bool:
        """The direction."""
        return self.column.right != self.reverse

    @property
    def heading(self) -> str:
        """The title of the column, with an arrow."""
        return self.column.title + _ARROWS[self.largest_first]

    def next(self, step: int) -> Order:
        """Return the order by a column further to the right, in the direction that is usual for it."""
        return Order(COLUMNS[(COLUMNS.index(self.column) + step) % len(COLUMNS)])

    def sorted(self, rows: Sequence[RobotRow]) -> list[RobotRow]:
        """Sort rows; equal ones by name, and those without a value last."""
        value = self.column.value
        by_name = sorted(rows, key=lambda row: row.name)
        known = [row for row in by_name if value(row) not in (None, "")]
        known.sort(key=lambda row: value(row) or 0, reverse=self.largest_first)
        return known + [row for row in by_name if value(row) in (None, "")]


class Layout(msgspec.Struct, frozen=True):
    """The columns that are shown, from left to right, with their widths in cells."""

    columns: tuple[tuple[TopColumn, int], ...]
    order: Order

    @property
    def heading(self) -> str:
        """The line above the rows."""
        return self._line([_title(column, self.order) for column, _ in self.columns])

    def line(self, row: RobotRow) -> str:
        """The line of a row."""
        return self._line([column.text(row) for column, _ in self.columns])

    def _line(self, texts: Sequence[str]) -> str:
        cells = (
            pad(text, width, right=column.right) for text, (column, width) in zip(texts, self.columns, strict=True)
        )
        return GAP.join(cells)


def fit(rows: Sequence[RobotRow], order: Order, width: int | None) -> Layout:
    """Choose columns and their widths for a line of this many cells; None: as wide as they need to be."""
    wanted = {
        column: max([cell_len(_title(column, order)), *(cell_len(column.text(row)) for row in rows)])
        for column in IMPORTANCE
    }
    if width is None:
        return Layout(tuple((column, wanted[column]) for column in COLUMNS), order)
    room, widths = width, dict[TopColumn, int]()
    for column in IMPORTANCE:
        gap = len(GAP) if widths else 0
        given = min(wanted[column], column.most, max(room - gap, 0))
        if widths and given < min(column.least, wanted[column]):
            break
        widths[column] = given
        room -= given + gap
    for column in widths:
        more = min(wanted[column] - widths[column], room)
        widths[column] += more
        room -= more
    return Layout(tuple((column, widths[column]) for column in COLUMNS if column in widths), order)


def pad(text: str, width: int, *, right: bool = False) -> str:
    """Return a text of exactly this many cells, cut with an ellipsis where it is longer."""
    missing = width - cell_len(text)
    if missing < 0:
        return set_cell_size(text, width - 1) + _CUT if width else ""
    return " " * missing + text if right else text + " " * missing


def order_by(name: str, *, reverse: bool = False) -> Order:
    """Return the order by a column; raise ConfigError for an unknown name."""
    for column in COLUMNS:
        if column.name == name:
            return Order(column, reverse)
    raise ConfigError(f"--sort {name!r}: expected one of {', '.join(column.name for column in COLUMNS)}")


def _title(column: TopColumn, order: Order) -> str:
    return order.heading if column is order.column else column.title


def _count(value: int | None) -> str:
    return str(value) if value is not None else ""


_ANY = 10_000
_ROBOT = TopColumn("robot", "robot", lambda row: row.name, lambda row: row.name, 1, _ANY)
_STATE = TopColumn("state", "state", lambda row: row.state.severity, lambda row: row.state.word, 7, 11)
_DRIVER = TopColumn("driver", "driver", lambda row: row.driver, lambda row: row.driver, 7, 14)
_RATE = TopColumn(
    "rate", "msg/s", lambda row: row.rate, lambda row: f"{row.rate:.1f}" if row.rate is not None else "", 6, 8, True
)
_REFUSED = TopColumn("refused", "refused", lambda row: row.refused, lambda row: _count(row.refused), 7, 9, True)
_GAPS = TopColumn("gaps", "gaps", lambda row: row.gaps, lambda row: _count(row.gaps), 4, 8, True)
_CPU = TopColumn("cpu", "cpu%", lambda row: row.cpu, lambda row: row.cpu_text, 5, 7, True)
_MEMORY = TopColumn("memory", "mem", lambda row: row.memory_bytes, lambda row: row.memory_text, 4, 7, True)
_HOST = TopColumn("host", "host", lambda row: row.host, lambda row: row.host, 6, 16)
_PROTOCOL = TopColumn("protocol", "protocol", lambda row: row.protocol, lambda row: row.protocol, 6, 14)
_REASON = TopColumn("reason", "reason", lambda row: row.reason, lambda row: row.reason, 8, 16)

COLUMNS = (_ROBOT, _STATE, _DRIVER, _RATE, _REFUSED, _GAPS, _CPU, _MEMORY, _HOST, _PROTOCOL, _REASON)
"""From left to right."""
IMPORTANCE = (_ROBOT, _STATE, _DRIVER, _RATE, _CPU, _MEMORY, _REFUSED, _GAPS, _REASON, _HOST, _PROTOCOL)
"""The most important first."""
