"""``zbridge top`` on a terminal, with Textual: lays out its screens once a second, asks before it stops a robot."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import ClassVar

from textual.app import App
from textual.binding import Binding, BindingType
from textual.filter import LineFilter
from textual.screen import Screen

from zbridge.bus import Bus
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import FleetModel
from zbridge.client.stops import summarize
from zbridge.errors import ZbridgeError
from zbridge.views.rows import read_rows
from zbridge.views.top.board import Board, Notice, ScreenLine, Tone
from zbridge.views.top.details import Tables, detail_lines
from zbridge.views.top.screens import LinesScreen, PageScreen, QuestionScreen, WithoutStyle

REDRAW_S = 1.0
"""Seconds between two drawings."""
ASK_S = 5.0
"""Seconds between two queries for the sessions of the robot whose details are shown."""
END_S = 5.0
"""Longest wait, when the program ends, for the outcome of a stop."""


class BoardScreen(LinesScreen):
    """The table of robots."""

    def layout_lines(self, width: int, height: int) -> list[ScreenLine]:
        top = top_of(self)
        top.board.left_out = len(top.model.left_out)
        top.board.update(read_rows(top.model, connected=not top.board.no_bus))
        return top.board.lines(width, height, top.clock())

    def press(self, key: str) -> None:
        if top_of(self).board.typing:
            self._type(key)
        elif key in _BOARD_KEYS:
            _BOARD_KEYS[key](top_of(self))

    def _type(self, key: str) -> None:
        board = top_of(self).board
        if key in ("enter", "escape"):
            board.typing = False
            if key == "escape":
                board.find("")
        elif key == "backspace":
            board.find(board.filter[:-1])
        elif len(key) == 1:
            board.find(board.filter + key)


class ReportedScreen(PageScreen):
    """Lines below the reports of the program."""

    def reports(self, width: int) -> list[ScreenLine]:
        return top_of(self).board.reports(width)


class HelpScreen(ReportedScreen):
    """What the keys and words mean."""

    def content(self) -> Sequence[ScreenLine]:
        return [ScreenLine(text) for text in HELP.splitlines()]


class DetailsScreen(ReportedScreen):
    """All that is known of one robot. Its sessions are queried as long as the screen is open."""

    keys = f"{PageScreen.keys}  s stop"

    def __init__(self, robot: str) -> None:
        super().__init__()
        self.robot = robot
        self._tables: Tables | None = None

    def on_mount(self) -> None:
        self.run_worker(self._ask(), exit_on_error=False)

    def content(self) -> Sequence[ScreenLine]:
        top = top_of(self)
        row = next(row for row in read_rows(top.model, connected=not top.board.no_bus) if row.name == self.robot)
        return detail_lines(top.model.robots[self.robot], row, self._tables)

    def press(self, key: str) -> None:
        if key == "s":
            top_of(self).ask_stop(self.robot)
        else:
            super().press(key)

    async def _ask(self) -> None:
        while True:
            try:
                self._tables = await top_of(self).fleet.processes(self.robot)
            except ZbridgeError:
                self._tables = self._tables or {}
            self.redraw()
            await asyncio.sleep(ASK_S)


class TopApp(App[None]):
    """The program. board: what to begin with. clock: the time of day, for people."""

    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [Binding("ctrl+c", "quit", priority=True, show=False)]
    CSS = """
    Screen { background: ansi_default; color: ansi_default; }
    QuestionScreen { align: center middle; background: transparent; }
    QuestionScreen Static {
        width: auto; max-width: 90%; height: auto; padding: 1 2; border: solid ansi_default; background: ansi_default;
    }
    """

    def __init__(self, fleet: Fleet, bus: Bus, model: FleetModel, board: Board, clock: Callable[[], str]) -> None:
        super().__init__(ansi_color=True)
        self.fleet = fleet
        self.model = model
        self.board = board
        self.clock = clock
        self.stopping: set[asyncio.Task[None]] = set()
        self._bus = bus
        self._plain = (WithoutStyle(),) if self.no_color else ()

    def get_line_filters(self) -> Sequence[LineFilter]:
        return (*super().get_line_filters(), *self._plain)

    def get_default_screen(self) -> Screen[None]:
        return BoardScreen()

    def on_mount(self) -> None:
        self.set_interval(REDRAW_S, self.redraw)

    def redraw(self) -> None:
        """Lay out the screen again, or the one below a question."""
        self.model.take()
        for screen in reversed(self.screen_stack):
            if isinstance(screen, LinesScreen):
                screen.redraw()
                return

    def follow_bus(self, connected: bool) -> None:
        """The bus was lost, or is back: robots then have some seconds to show that they are there too."""
        if connected:
            self.model.opened_at = self.model.clock()
        self.board.no_bus = "" if connected else f"lost at {self.clock()}, nothing is known of the robots since"
        if self.is_running:
            self.redraw()

    def show_details(self) -> None:
        """Show all of the selected robot."""
        if self.board.selected is not None:
            self.push_screen(DetailsScreen(self.board.selected.name))

    def stop_selected(self) -> None:
        """Ask whether the selected robot shall be stopped."""
        if self.board.selected is not None:
            self.ask_stop(self.board.selected.name)

    def ask_stop(self, robot: str | None) -> None:
        """Ask whether a robot, or None for all, shall be stopped; then stop it, and report what was confirmed."""
        if robot is not None:
            question = f"Stop {robot}?"
        else:
            hidden = f", also the {self.board.hidden} that the filter hides" if self.board.hidden else ""
            question = f"Stop ALL {self.board.robots} robots of {self.board.realm}{hidden}?"
        self.push_screen(QuestionScreen(f"{question} This ends any lease."), lambda yes: self._stop(robot, yes))

    def _stop(self, robot: str | None, yes: bool | None) -> None:
        if yes:
            notice = self.board.notify(f"stopping {robot or 'all robots'}: not confirmed yet")
            task = asyncio.create_task(self._send_stop(robot, notice))
            self.stopping.add(task)
            task.add_done_callback(self.stopping.discard)
        self.redraw()

    async def _send_stop(self, robot: str | None, notice: Notice) -> None:
        try:
            outcomes = await self.fleet.stop([robot] if robot is not None else None)
        except ZbridgeError as error:
            notice.text, notice.tone = f"{robot or 'all robots'}: {error}", Tone.BAD
        else:
            errors = [error for error in outcomes.values() if error is not None]
            notice.tone = Tone.BAD if errors or not outcomes else Tone.TITLE
            if robot is not None:
                notice.text = str(errors[0]) if errors else f"{robot}: stopped"
            else:
                notice.text = summarize(outcomes, "stopped") if outcomes else f"no gateways on {self.board.realm}/"
        if self.is_running:
            self.redraw()


async def show(fleet: Fleet, bus: Bus, board: Board, clock: Callable[[], str]) -> int:
    """Show the robots until the operator ends the program; return the exit code."""
    async with fleet.watch(lazy=True) as model:
        app = TopApp(fleet, bus, model, board, clock)
        handle = bus.watch_connected(app.follow_bus)
        try:
            await app.run_async(mouse=False)
        finally:
            handle.close()
            if app.stopping:
                await asyncio.wait(app.stopping, timeout=END_S)
        return app.return_code or 0


HELP = """\
keys
  up, down, PgUp, PgDn, Home, End   select a robot
  Enter                             its details: links, sessions, latched stops, refusals, process
  /                                 show robots that contain all words; Esc clears the filter
  < >                               sort by another column      r  reverse
  s                                 stop the selected robot     S  stop all robots; each asks first
  Esc                               clears reports and the filter
  q                                 end

marks before the name
  X   no gateway: nobody serves the robot, and nothing can stop it from here
  ?   silent: its gateway has published nothing for 3 s, and perhaps hangs
  L   latched: nobody can drive before `zbridge unlatch`
  !   the link to the robot does not work, or not yet

columns
  msg/s     messages that the gateway published in the last second
  refused   commands refused since the gateway started
  gaps      messages of the robot that were lost before the gateway
  cpu%      per cent of a core;  mem  megabytes;  * the process serves several robots
"""


def top_of(screen: Screen[None]) -> TopApp:
    """Return the program of a screen."""
    assert isinstance(screen.app, TopApp)
    return screen.app


def _escape(top: TopApp) -> None:
    top.board.notices.clear()
    top.board.find("")


def _reverse(top: TopApp) -> None:
    order = top.board.order
    top.board.sort(type(order)(order.column, not order.reverse))


def _filter(top: TopApp) -> None:
    top.board.typing = True


_ALL = 1_000_000
_BOARD_KEYS: dict[str, Callable[[TopApp], object]] = {
    "up": lambda top: top.board.move(-1),
    "down": lambda top: top.board.move(1),
    "k": lambda top: top.board.move(-1),
    "j": lambda top: top.board.move(1),
    "pageup": lambda top: top.board.turn(-1),
    "pagedown": lambda top: top.board.turn(1),
    "home": lambda top: top.board.move(-_ALL),
    "end": lambda top: top.board.move(_ALL),
    "<": lambda top: top.board.sort(top.board.order.next(-1)),
    ">": lambda top: top.board.sort(top.board.order.next(1)),
    "left": lambda top: top.board.sort(top.board.order.next(-1)),
    "right": lambda top: top.board.sort(top.board.order.next(1)),
    "r": _reverse,
    "/": _filter,
    "escape": _escape,
    "enter": TopApp.show_details,
    "s": TopApp.stop_selected,
    "S": lambda top: top.ask_stop(None),
    "?": lambda top: top.push_screen(HelpScreen()),
    "q": lambda top: top.exit(),
}
