"""Tables fit the terminal, the least important columns suffer first, and what is piped is whole."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from zbridge.cli.demo import LiveTable
from zbridge.cli.terminal import Column, Table

ROOT = Path(__file__).parents[2]
COLUMNS = (Column("robot"), Column("state", 1), Column("Hz", 2, number=True), Column("reason", 3))
ROWS = [("r1", "established", 20.25, ""), ("hub.a-long-name", "offline", 3, "no route to host 10.0.0.7 at all")]
WHOLE = [
    "robot            state           Hz  reason",
    "r1               established  20.25",
    "hub.a-long-name  offline          3  no route to host 10.0.0.7 at all",
]
PRINTING = f"from zbridge.cli.terminal import *; Table({COLUMNS!r}, {ROWS!r}).print()"


def test_without_a_terminal_nothing_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    Table(COLUMNS, ROWS).print()
    assert capsys.readouterr().out.splitlines() == WHOLE


@pytest.mark.parametrize(
    ("room", "last"),
    [
        (69, WHOLE[2]),
        (68, "hub.a-long-name  offline          3  no route to host 10.0.0.7 at..."),
        (46, "hub.a-long-name  offline          3  no rou..."),
        (43, "hub.a-long-name  offline          3  no ..."),
        (41, "hub.a-long-name  offline        3  no ..."),
        (37, "hub.a-long-name  of...      3  no ..."),
        (36, "hub.a-long-name  offline          3"),
        (30, "hub.a-long-name  off...      3"),
        (29, "hub.a-long-name  of...      3"),
        (28, "hub.a-long-name  offline"),
        (22, "hub.a-long-name  of..."),
        (21, "hub.a-long-name"),
        (3, "hub.a-long-name"),
    ],
)
def test_the_least_important_column_is_shortened_first_and_names_and_numbers_never(room: int, last: str) -> None:
    lines = Table(COLUMNS, ROWS).lines(room)
    assert lines[2] == last
    assert all(len(line) <= max(room, len("hub.a-long-name")) for line in lines)


def test_wide_characters_take_two_cells() -> None:
    (_, line) = Table((Column("robot"), Column("reason", 1)), [("r1", "\u4e2d" * 10)]).lines(5 + 2 + 10)
    assert line == "r1     \u4e2d\u4e2d\u4e2d ..."


def test_the_numbers_of_the_demo_are_whole_at_eighty_characters() -> None:
    names = ["alf1", "ros21", "tcpudp1", "wc2ec1"]
    titles, *rows = str(LiveTable(names).table(1.0, 80)).splitlines()
    assert [row.split()[0] for row in rows] == names
    assert titles.split()[-9:] == ["pose/s", "scan/s", "map/s", "sensor/s", "x", "m", "y", "m", "turn"]
    assert all(row.endswith("0.0") or row.split()[-4:] == 4 * ["0.0"] for row in rows)
    assert max(map(len, (titles, *rows))) <= 80


def on_a_terminal(program: str, **variables: str) -> str:
    """Run a program of Python on a terminal of its own; return what it prints there."""
    here, there = pty.openpty()
    environment = {name: value for name, value in os.environ.items() if name != "NO_COLOR"} | variables
    with os.fdopen(there, "wb") as out:
        subprocess.run((sys.executable, "-c", program), cwd=ROOT, env=environment, stdout=out, check=True)
    printed = os.read(here, 65536).decode()
    os.close(here)
    return printed.replace("\r\n", "\n")


def test_a_terminal_gets_bold_titles_unless_no_color_is_set() -> None:
    titles, *rows = Table(COLUMNS, ROWS).lines(28)
    terminal = {"TERM": "xterm", "COLUMNS": "28"}
    assert on_a_terminal(PRINTING, **terminal, NO_COLOR="1").splitlines() == [titles, *rows]
    assert on_a_terminal(PRINTING, **terminal).splitlines() == [f"\x1b[1m{titles}\x1b[0m", *rows]
