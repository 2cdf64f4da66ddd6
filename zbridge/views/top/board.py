"""The main screen of ``zbridge top`` as lines of text: what is selected, filtered and reported."""

from __future__ import annotations

import textwrap
from collections import deque
from collections.abc import Sequence
from enum import Enum, auto

import msgspec
from rich.cells import cell_len, chop_cells

from zbridge.fleet.printable import shown
from zbridge.views.rows import RobotRow, RowState, count_states
from zbridge.views.top.columns import Layout, Order, fit, pad

NOTICES = 3
"""Most reports that are shown; a further one replaces the oldest."""
_NOTICE_LINES = 2
"""Most lines of one report."""
_FRAME = 4
"""Lines that are not robots: the summary, the heading, the selected robot's reason, the keys."""
_SELECTED, _OTHER = ">", " "
_NARROW = 20
"""Cells below which texts are broken anywhere."""
FILTER_CHARACTERS = 80
"""Longest filter."""


class Tone(Enum):
    """How a line looks; its text says the same."""

    PLAIN = auto()
    TITLE = auto()
    FAINT = auto()
    WARNING = auto()
    BAD = auto()
    SELECTED = auto()


class ScreenLine(msgspec.Struct, frozen=True):
    """One line of a screen."""

    text: str
    tone: Tone = Tone.PLAIN


class Notice(msgspec.Struct):
    """A report for the operator; its text may still change."""

    text: str
    tone: Tone = Tone.TITLE


class Board:
    """The table of robots. realm: in the title. order, text: of the rows, and the filter to begin with."""

    def __init__(self, realm: str, order: Order, text: str = "") -> None:
        self.realm = realm
        self.order = order
        self.filter = text
        self.typing = False
        """Whether keys write the filter."""
        self.no_bus = "no connection to the bus yet"
        """Why nothing is known of the robots; "" while this program is on the bus."""
        self.left_out = 0
        """How many robots the model does not follow, because there are too many."""
        self.notices: deque[Notice] = deque(maxlen=NOTICES)
        self._all: Sequence[RobotRow] = ()
        self._rows: list[RobotRow] = []
        self._selected = ""
        self._place = 0
        self._first = 0
        self._page = 1

    def __repr__(self) -> str:
        return f"<Board {self.realm}, {len(self._rows)} of {len(self._all)} robots>"

    @property
    def selected(self) -> RobotRow | None:
        """The selected robot; None if none is shown."""
        return self._rows[self._place] if self._rows else None

    @property
    def robots(self) -> int:
        """How many robots there are, also those that the filter hides."""
        return len(self._all)

    @property
    def hidden(self) -> int:
        """How many robots the filter hides."""
        return len(self._all) - len(self._rows)

    def update(self, rows: Sequence[RobotRow]) -> None:
        """Show these rows from now on; the same robot stays selected wherever it is now."""
        self._all = rows
        self._arrange()

    def sort(self, order: Order) -> None:
        """Sort the rows."""
        self.order = order
        self._arrange()

    def find(self, text: str) -> None:
        """Show only rows that contain each word of a text."""
        self.filter = text[:FILTER_CHARACTERS]
        self._arrange()

    def move(self, by: int) -> None:
        """Select a robot further down."""
        self._select(self._place + by)

    def turn(self, pages: int) -> None:
        """Select a robot some pages further down."""
        self.move(pages * self._page)

    def notify(self, text: str, tone: Tone = Tone.TITLE) -> Notice:
        """Report something; return the report, so that its outcome can replace the text."""
        notice = Notice(text, tone)
        self.notices.append(notice)
        return notice

    def lines(self, width: int, height: int, clock: str = "") -> list[ScreenLine]:
        """Return the screen: this many lines, none longer than ``width``. clock: the time, for people."""
        notices = self.reports(width)
        self._page = max(height - _FRAME - len(notices), 1)
        self._first = min(max(self._first, self._place - self._page + 1), self._place)
        shown_rows = self._rows[self._first : self._first + self._page]
        layout = fit(self._rows, self.order, width - 2)
        lines = [
            ScreenLine(self._summary(width, clock), Tone.TITLE),
            *notices,
            ScreenLine(pad("  " + layout.heading, width), Tone.FAINT),
            *(self._row(layout, row, width) for row in shown_rows),
            *[ScreenLine("")] * (self._page - len(shown_rows)),
            ScreenLine(pad(self._reason(), width), Tone.FAINT),
            ScreenLine(pad(self._keys(), width), Tone.FAINT),
        ]
        return lines[:height]

    def reports(self, width: int) -> list[ScreenLine]:
        """Return what is to be noticed on every screen: that the bus is lost, and reports."""
        lines = []
        if self.no_bus:
            lines = [ScreenLine(pad(f"NO BUS: {self.no_bus}; waiting for it", width), Tone.BAD)]
        for notice in self.notices:
            parts = wrap(shown(notice.text), width)
            parts[_NOTICE_LINES - 1 :] = [" ".join(parts[_NOTICE_LINES - 1 :])] if len(parts) >= _NOTICE_LINES else []
            lines += [ScreenLine(pad(part, width), notice.tone) for part in parts]
        return lines

    def _arrange(self) -> None:
        words = self.filter.lower().split()
        self._rows = self.order.sorted([row for row in self._all if row.contains(words)] if words else self._all)
        names = [row.name for row in self._rows]
        self._select(names.index(self._selected) if self._selected in names else self._place)

    def _select(self, place: int) -> None:
        self._place = max(0, min(place, len(self._rows) - 1))
        self._selected = self._rows[self._place].name if self._rows else self._selected

    def _summary(self, width: int, clock: str) -> str:
        text = f"zbridge top  {shown(self.realm)}  {count_states(self._all)}"
        if self.left_out:
            text += f", {self.left_out} more left out"
        return pad(text, width - len(clock) - 1) + " " + clock if len(clock) < width else pad(text, width)

    def _row(self, layout: Layout, row: RobotRow, width: int) -> ScreenLine:
        selected = row.name == self._selected
        text = pad((_SELECTED if selected else _OTHER) + row.state.mark + layout.line(row), width)
        return ScreenLine(text, Tone.SELECTED if selected else _TONES.get(row.state, Tone.BAD))

    def _reason(self) -> str:
        if self.selected is None:
            return "no robot matches the filter" if self._all else "no robots yet"
        row = self.selected
        return f"{row.name}: {row.state.word}" + (f": {row.reason}" if row.reason else "")

    def _keys(self) -> str:
        if self.typing:
            return f"filter: {shown(self.filter)}_   Enter: keep it, Esc: clear it"
        hidden = f" (hides {self.hidden})" if self.hidden else ""
        filtered = f"filter {shown(self.filter)!r}{hidden}, Esc clears; " if self.filter else ""
        return f"{filtered}Enter details  / filter  < > sort  r reverse  s stop  S stop all  ? help  q quit"


def wrap(text: str, width: int) -> list[str]:
    """Break a text into lines of at most this many cells, between words where they are short; further lines indented.

    Words of wide characters are broken anywhere.
    """
    if cell_len(text) <= width:
        return [text]
    if not text.isascii() or width < _NARROW:
        return chop_cells(text, max(width, 2))
    indent = text[: len(text) - len(text.lstrip())]
    return textwrap.wrap(text, width, subsequent_indent=indent + "  ") or [""]


_TONES = {
    RowState.ESTABLISHED: Tone.PLAIN,
    RowState.UNKNOWN: Tone.FAINT,
    RowState.LATCHED: Tone.WARNING,
    RowState.CLOSING: Tone.WARNING,
    RowState.CONNECTING: Tone.WARNING,
    RowState.HANDSHAKING: Tone.WARNING,
}
"""Of states; the others are bad."""
