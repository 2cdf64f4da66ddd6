"""Which columns fit, what is cut first, and in which order robots are shown."""

from __future__ import annotations

import pytest
from rich.cells import cell_len

from tests.views.top import rows
from zbridge.errors import ConfigError
from zbridge.views.rows import RobotRow, RowState
from zbridge.views.top.columns import COLUMNS, GAP, IMPORTANCE, fit, order_by, pad

NUMBERS = {"rate": 447.6, "refused": 12, "gaps": 0, "cpu": 0.0451, "memory_bytes": 37_000_000, "driver": "ann@laptop"}
BY_ROBOT = order_by("robot")


@pytest.mark.parametrize("name", ["r1", "press-17.hall-3", "r" * 60])
def test_a_name_is_cut_only_where_no_other_column_is_left(name: str) -> None:
    robots = [
        RobotRow(name, RowState.HANDSHAKING, **NUMBERS, host="hub-7", protocol="tcpudp 1.3", reason="wet floor " * 9)
    ]
    for width in range(1, 200):
        layout = fit(robots, BY_ROBOT, width)
        line = layout.line(robots[0])
        assert cell_len(line) <= width
        assert name in line or len(layout.columns) == 1, width


def test_the_less_important_columns_are_left_out_first_and_the_last_one_is_the_one_that_is_cut() -> None:
    robots = rows(3, **NUMBERS, reason="latched by bob (wet floor) " * 4)
    for width in range(1, 200):
        layout = fit(robots, BY_ROBOT, width)
        widths = dict(layout.columns)
        assert set(widths) == set(IMPORTANCE[: len(widths)]), width
        least = [column for column in IMPORTANCE if column in widths][-1]
        for column, given in layout.columns:
            wanted = max(cell_len(column.title), *(cell_len(column.text(row)) for row in robots))
            assert given >= min(wanted, column.most) or column is least, (width, column.name)


def test_eighty_columns_have_room_for_all_numbers_and_some_of_the_reason() -> None:
    shown = {column.name for column, _ in fit(rows(200, **NUMBERS, reason="x" * 70), BY_ROBOT, 78).columns}
    assert shown >= {"robot", "state", "driver", "rate", "refused", "gaps", "cpu", "memory", "reason"}


def test_without_a_width_nothing_is_cut() -> None:
    robots = rows(2, **NUMBERS, reason="y" * 150)
    layout = fit(robots, BY_ROBOT, None)
    assert [column for column, _ in layout.columns] == list(COLUMNS)
    assert "y" * 150 in layout.line(robots[0])
    assert layout.heading.split()[0] == "robot↑"


def test_cells_of_wide_characters_are_aligned() -> None:
    robots = [RobotRow("r1", RowState.OFFLINE, reason="停止 " * 20, driver="安")]
    for width in range(3, 120):
        layout = fit(robots, BY_ROBOT, width)
        total = sum(given for _, given in layout.columns) + len(GAP) * (len(layout.columns) - 1)
        assert cell_len(layout.line(robots[0])) == cell_len(layout.heading) == total <= width


@pytest.mark.parametrize(
    ("text", "width", "padded"),
    [("abc", 5, "abc  "), ("abc", 3, "abc"), ("abcd", 3, "ab…"), ("abc", 1, "…"), ("abc", 0, ""), ("停止", 3, "停…")],
)
def test_a_cell_is_padded_or_cut_to_its_width(text: str, width: int, padded: str) -> None:
    assert pad(text, width) == padded


ROBOTS = [
    RobotRow("r1", RowState.ESTABLISHED, "bob", rate=5.0),
    RobotRow("r2", RowState.SILENT, "", rate=None),
    RobotRow("r3", RowState.LATCHED, "ann", rate=50.0),
    RobotRow("r4", RowState.ESTABLISHED, "ann", rate=5.0),
]


@pytest.mark.parametrize(
    ("column", "reverse", "names"),
    [
        ("robot", False, "r1 r2 r3 r4"),
        ("robot", True, "r4 r3 r2 r1"),
        ("state", False, "r2 r3 r1 r4"),
        ("driver", False, "r3 r4 r1 r2"),
        ("rate", False, "r3 r1 r4 r2"),
        ("rate", True, "r1 r4 r3 r2"),
    ],
)
def test_the_largest_number_and_the_worst_state_come_first_and_what_is_not_known_last(
    column: str, reverse: bool, names: str
) -> None:
    order = order_by(column, reverse=reverse)
    assert " ".join(row.name for row in order.sorted(ROBOTS)) == names


def test_every_column_can_be_sorted_by_and_the_next_one_after_the_last_is_the_first() -> None:
    order = BY_ROBOT
    for column in COLUMNS:
        assert order.column is column
        assert order.heading in fit(ROBOTS, order, None).heading
        assert len(order.sorted(ROBOTS)) == len(ROBOTS)
        order = order.next(1)
    assert order.column is COLUMNS[0]
    assert order.next(-1).column is COLUMNS[-1]


def test_an_unknown_column_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(ConfigError, match=r"^--sort 'x': expected one of robot, state, driver, rate, refused, gaps"):
        order_by("x")
