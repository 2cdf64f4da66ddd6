"""Screens of lines for Textual: drawn where they have changed, moved through by pages, with a question above them.

What is drawn is plain text with one style a line: no part of it is interpreted as markup.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich.segment import Segment
from rich.style import Style
from textual.app import ComposeResult
from textual.color import Color
from textual.events import Key, Resize
from textual.filter import LineFilter
from textual.geometry import Region
from textual.screen import ModalScreen, Screen
from textual.strip import Strip
from textual.widget import Widget
from textual.widgets import Static

from zbridge.views.top.board import ScreenLine, Tone, wrap


class LinesView(Widget):
    """Draws lines of text."""

    ALLOW_SELECT = False
    DEFAULT_CSS = "LinesView { width: 100%; height: 100%; }"

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[ScreenLine] = []

    def show(self, lines: list[ScreenLine]) -> None:
        """Draw these lines from now on."""
        before, self.lines = self.lines, lines
        old = before + [None] * (len(lines) - len(before))
        changed = [y for y, was in enumerate(old) if y >= len(lines) or lines[y] != was]
        if changed:
            self.refresh(*(Region(0, y, self.size.width, 1) for y in changed))

    def render_line(self, y: int) -> Strip:
        line = self.lines[y] if y < len(self.lines) else ScreenLine("")
        style = _STYLES[line.tone]
        return Strip([Segment(line.text, style)]).adjust_cell_length(self.size.width, style)


class LinesScreen(Screen[None]):
    """A screen of lines."""

    def __init__(self) -> None:
        super().__init__()
        self.drawing = LinesView()

    def compose(self) -> ComposeResult:
        yield self.drawing

    def on_resize(self, event: Resize) -> None:
        self.redraw()

    def on_screen_resume(self) -> None:
        self.redraw()

    def on_key(self, event: Key) -> None:
        event.stop()
        self.press(event.character if event.is_printable and event.character else event.key)
        if self.is_current:
            self.redraw()

    def press(self, key: str) -> None:
        """React to a key: the character that it writes, else its name."""

    def layout_lines(self, width: int, height: int) -> list[ScreenLine]:
        """Return the lines of the screen."""
        raise NotImplementedError

    def redraw(self) -> None:
        """Lay the lines out again."""
        width, height = self.app.size
        if self.is_attached and width and height:
            self.drawing.show(self.layout_lines(width, height))


class PageScreen(LinesScreen):
    """Lines of any number: a page at a time is shown. keys: what keys do, for people."""

    keys = "Esc back  arrows scroll"

    def __init__(self) -> None:
        super().__init__()
        self._first = 0
        self._page = 1

    def content(self) -> Sequence[ScreenLine]:
        """Return all lines."""
        raise NotImplementedError

    def reports(self, width: int) -> list[ScreenLine]:
        """Return what stands above them."""
        return []

    def layout_lines(self, width: int, height: int) -> list[ScreenLine]:
        reports = self.reports(width)
        lines = [ScreenLine(part, line.tone) for line in self.content() for part in wrap(line.text, width)]
        self._page = max(height - len(reports) - 1, 1)
        self._first = max(0, min(self._first, len(lines) - self._page))
        page = lines[self._first : self._first + self._page]
        more = len(lines) - self._first - len(page)
        keys = self.keys + (f"  ({more} more lines)" if more else "")
        return [*reports, *page, *[ScreenLine("")] * (self._page - len(page)), ScreenLine(keys[:width], Tone.FAINT)][
            :height
        ]

    def press(self, key: str) -> None:
        if key in ("escape", "q", "enter"):
            self.dismiss()
        elif key in _PAGE_KEYS:
            self._first += _PAGE_KEYS[key](self._page)


class QuestionScreen(ModalScreen[bool]):
    """Asks before something is sent: only ``y`` means yes."""

    def __init__(self, question: str) -> None:
        super().__init__()
        self.question = question

    def compose(self) -> ComposeResult:
        yield Static(f"{self.question}\n\ny: yes    n, Esc, Enter: no", markup=False)

    def on_key(self, event: Key) -> None:
        event.stop()
        if event.character in ("y", "Y"):
            self.dismiss(True)
        elif event.character in ("n", "N", "q") or event.key in ("escape", "enter"):
            self.dismiss(False)


class WithoutStyle(LineFilter):
    """Removes colour, bold and all other style."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        return [Segment(text, None, control) for text, _, control in segments]


_STYLES = {
    Tone.PLAIN: Style.null(),
    Tone.TITLE: Style(bold=True),
    Tone.FAINT: Style(dim=True),
    Tone.WARNING: Style(color="yellow"),
    Tone.BAD: Style(color="red"),
    Tone.SELECTED: Style(reverse=True),
}


_ALL = 1_000_000
_PAGE_KEYS: dict[str, Callable[[int], int]] = {
    "up": lambda page: -1,
    "down": lambda page: 1,
    "k": lambda page: -1,
    "j": lambda page: 1,
    "pageup": lambda page: -page,
    "pagedown": lambda page: page,
    "home": lambda page: -_ALL,
    "end": lambda page: _ALL,
}
