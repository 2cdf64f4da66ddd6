"""``zbridge top``: the robots of a realm on a terminal; or printed once, which needs no extra."""

from __future__ import annotations

import asyncio
import gc
import logging
import shutil
import sys
import time
from collections.abc import Sequence

from zbridge.bus import BusSettings
from zbridge.bus.tls.files import own_name
from zbridge.cli import run_command
from zbridge.client import connect, joined
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import SILENT_S, FleetModel
from zbridge.errors import ConfigError
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.tasks import occurs, until_signal
from zbridge.views.rows import RobotRow, as_fields, count_states, read_rows
from zbridge.views.top.board import Board
from zbridge.views.top.columns import Order, fit, order_by

_SUMMED_UP = 2
"""From this number of robots on, a line below the table counts them."""


def run_top(settings: BusSettings, realm: str, sort: str, text: str) -> None:
    """Show the robots until the operator ends the program; raise ConfigError, BusError. text: the filter."""
    order = order_by(sort)
    try:
        from zbridge.views.top.app import show
    except ImportError as error:
        raise ConfigError(f"{error}: install the extra: pip install 'zbridge[top]'; or use --once") from error
    if not all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise ConfigError("top needs a terminal; --once prints the table")
    board = Board(realm, order, text)

    async def watch() -> int:
        async with joined(settings, realm) as bus:
            fleet = Fleet(bus, realm, own_name(settings.tls))
            return await show(fleet, bus, board, lambda: time.strftime("%H:%M:%S"))

    gc.freeze()  # modules live as long as the process; the collector skips them
    run_command(until_signal(watch()), level=logging.CRITICAL)  # a line of the log would spoil the screen
    for notice in board.notices:
        print(notice.text)  # noqa: T201


async def print_once(settings: BusSettings, realm: str, sort: str, text: str, *, as_json: bool) -> None:
    """Print the robots as a table, or one JSON object a line; wait until all have published, for 3 s at most."""
    order, came = order_by(sort), asyncio.Event()
    async with connect(settings=settings, realm=realm) as fleet, fleet.watch(lambda name: came.set()) as model:
        await _until_published(model, came)
        words = text.lower().split()
        rows = order.sorted([row for row in read_rows(model) if row.contains(words)])
    if as_json:
        for row in rows:
            print(to_json(as_fields(row, model.robots[row.name])))  # noqa: T201
    elif rows:
        _print_table(rows, order)
    else:
        found = f"none of {len(model.robots)} robots matches the filter" if model.robots else f"no robots on {realm}/"
        print(shown(found), file=sys.stderr)  # noqa: T201


async def _until_published(model: FleetModel, came: asyncio.Event) -> None:
    """Wait until every gateway has published something; a silent one is known after SILENT_S."""
    while not all(entry.alive and entry.published_at is not None for entry in model.robots.values()):
        came.clear()
        left_s = SILENT_S - (model.clock() - model.opened_at)
        if left_s <= 0 or not await occurs(came, left_s):
            return


def _print_table(rows: Sequence[RobotRow], order: Order) -> None:
    width = shutil.get_terminal_size().columns - len(rows[0].state.mark) - 1 if sys.stdout.isatty() else None
    layout = fit(rows, order, width)
    print("  " + layout.heading.rstrip())  # noqa: T201
    for row in rows:
        print(f"{row.state.mark} {layout.line(row)}".rstrip())  # noqa: T201
    if len(rows) >= _SUMMED_UP:
        print(count_states(rows))  # noqa: T201
