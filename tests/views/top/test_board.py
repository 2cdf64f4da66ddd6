"""The table on the screen: its size, what is selected, the filter and the reports."""

from __future__ import annotations

import msgspec
import pytest
from rich.cells import cell_len

from tests.views.top import rows
from zbridge.views.rows import RobotRow, RowState
from zbridge.views.top.board import NOTICES, Board, Tone, wrap
from zbridge.views.top.columns import order_by


def board(robots: list[RobotRow]) -> Board:
    made = Board("fleet", order_by("robot"))
    made.no_bus = ""
    made.update(robots)
    return made


def text(made: Board, width: int = 80, height: int = 24) -> str:
    return "\n".join(line.text for line in made.lines(width, height))


def name(made: Board) -> str:
    return made.selected.name if made.selected is not None else ""


@pytest.mark.parametrize(("width", "height"), [(80, 24), (200, 60), (40, 10), (10, 5), (3, 2), (1, 1)])
@pytest.mark.parametrize("count", [0, 1, 200])
def test_the_screen_is_filled_and_never_wider_or_higher_than_the_terminal(width: int, height: int, count: int) -> None:
    made = board(rows(count, reason="connection refused " * 5, driver="停止"))
    made.notify("38 of 40 stopped; " * 10)
    lines = made.lines(width, height, "12:00:00")
    assert len(lines) == height
    assert all(cell_len(line.text) <= width for line in lines)


def test_eighty_by_twenty_four_shows_twenty_robots_and_what_keys_do() -> None:
    shown = text(board(rows(200))).split("\n")
    assert shown[0].startswith("zbridge top  fleet  200 robots: 200 established")
    assert sum("established" in line for line in shown[2:-2]) == 20
    assert "q quit" in shown[-1]


def test_the_selected_robot_is_marked_visible_and_the_same_wherever_it_is_sorted() -> None:
    made = board(rows(200))
    made.move(150)
    chosen = name(made)
    for order in (order_by("robot", reverse=True), order_by("robot")):
        made.sort(order)
        (marked,) = [line for line in made.lines(80, 24) if line.text.startswith(">")]
        assert (name(made), marked.text.split()[1], marked.tone) == (chosen, chosen, Tone.SELECTED)


def test_moving_goes_through_all_robots_and_stops_at_the_ends() -> None:
    made = board(rows(50))
    made.lines(80, 24)
    seen = set()
    for _ in range(60):
        seen.add(name(made))
        assert f"> {name(made)} " in text(made)
        made.move(1)
    assert len(seen) == 50
    made.turn(-1)
    made.turn(-100)
    assert name(made) == "r0"


def test_the_reason_of_the_selected_robot_is_shown_where_its_column_is_cut() -> None:
    reason = "the one usable connection is used up: restart the robot's program"
    made = board([RobotRow("r1", RowState.OFFLINE, reason=reason, host="hub")])
    assert f"r1: offline: {reason}" in text(made)


def test_a_filter_shows_robots_that_contain_all_words_and_says_how_many_it_hides() -> None:
    robots = [RobotRow("r1", RowState.OFFLINE, host="hub"), RobotRow("r2", RowState.ESTABLISHED, "Ann", host="hub")]
    made = board([*robots, RobotRow("r3", RowState.ESTABLISHED, host="edge")])
    made.find("HUB ann")
    assert (name(made), made.hidden) == ("r2", 2)
    assert "(hides 2)" in text(made, 120)
    made.find("nobody")
    assert made.selected is None
    assert "no robot matches the filter" in text(made)
    made.find("")
    assert (name(made), made.hidden) == ("r2", 0)


def test_a_robot_that_is_gone_leaves_the_selection_at_its_place() -> None:
    made = board(rows(3))
    made.move(1)
    made.update(rows(3)[:1])
    assert name(made) == "r0"
    made.update([])
    assert made.selected is None


def test_reports_are_few_and_short_and_their_text_may_change() -> None:
    made = board(rows(30))
    for number in range(5):
        notice = made.notify(f"report {number}")
    notice.text = "r1: stopped " * 40
    reports = made.reports(80)
    assert [report.text[:8] for report in reports] == ["report 2", "report 3", "r1: stop", "  stoppe"]
    assert len(made.notices) == NOTICES


def test_troubled_robots_have_another_tone_and_words_say_the_same() -> None:
    robots = [RobotRow("r0", RowState.ESTABLISHED), *(RobotRow(f"r{state.severity + 1}", state) for state in RowState)]
    lines = {line.text.split()[-1]: line for line in board(robots).lines(80, 24)[2:13]}
    assert lines["SILENT"].tone is lines["offline"].tone is Tone.BAD
    assert lines["LATCHED"].tone is Tone.WARNING
    assert len({robot.state.word for robot in robots}) == len(RowState)


def test_a_lost_bus_stands_above_everything() -> None:
    made = board(rows(1))
    made.no_bus = "lost at 12:00:00"
    assert "NO BUS: lost at 12:00:00" in text(made)
    assert made.lines(80, 24)[1].tone is Tone.BAD


def test_long_lines_break_between_words_and_texts_of_others_anywhere() -> None:
    assert wrap("one two three four five six", 20) == ["one two three four", "  five six"]
    assert wrap("  one two three four five six", 20) == ["  one two three four", "    five six"]
    assert wrap("停" * 15, 20) == ["停" * 10, "停" * 5]
    assert wrap("x" * 50, 20) == ["x" * 20, "  " + "x" * 18, "  " + "x" * 12]
    assert wrap("", 20) == [""]


def test_a_row_knows_no_markup() -> None:
    row = msgspec.structs.replace(rows(1)[0], driver="[red]x[/]")
    assert "[red]x[/]" in text(board([row]))
