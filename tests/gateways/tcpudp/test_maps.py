"""Maps as HQ programs take them. Expected cells are drawn by hand.

The protocol page: index = x * side + y, 0 unknown, 1 free, 2 obstacle.
"""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gateways.tcpudp.maps import Geometry, announceable, resampled, squared
from zbridge.errors import EncodeError
from zbridge.fleet.messages import Map

UNIT_M = 0.01


def drawn(*rows: str, cell: float = 0.1) -> Map:
    """A map from rows of y (the first is y = 0), a digit for each x."""
    cells = np.array([[int(digit) for digit in row] for row in rows], np.uint8)
    return Map(len(rows), len(rows[0]), cell, (0.0, 0.0), cells)


def columns(cells: bytes) -> tuple[str, ...]:
    """What a program draws: for each x its cells from y = 0."""
    side = math.isqrt(len(cells))
    assert side * side == len(cells)
    return tuple("".join(map(str, cells[x * side : (x + 1) * side])) for x in range(side))


@st.composite
def maps(draw: st.DrawFn, most: int = 60) -> Map:
    shape = (draw(st.integers(1, most)), draw(st.integers(1, most)))
    cells = draw(arrays.arrays(np.uint8, shape, elements=st.sampled_from([0, 1, 2]), fill=st.just(0)))
    cell = draw(st.one_of(st.sampled_from([0.01, 0.05, 0.1, 0.015, 1 / 3]), st.floats(0.001, 5.0)))
    return Map(*shape, cell, (0.0, 0.0), cells)


# Squares, for those who were told no size


@pytest.mark.parametrize(
    ("rows", "most", "expected"),
    [
        # a square map stays as it is, with columns for rows
        (("012", "120", "201"), 100, ("012", "120", "201")),
        (("01", "22"), 100, ("02", "12")),
        # one that is no square is filled with unknown cells
        (("120", "002"), 100, ("100", "200", "020")),
        (("1", "2", "1"), 100, ("121", "000", "000")),
        # one that is too large is pooled, obstacles first, then free cells
        (("1100", "1200", "0000", "1001"), 2, ("21", "01")),
        (("112", "111", "111"), 2, ("11", "21")),
        # a long corridor is shown whole
        (("1" * 99 + "2",), 10, ("1" + "0" * 9,) * 9 + ("2" + "0" * 9,)),
        # cells that are none of the three are unknown and hide no obstacle
        (("39", "12"), 2, ("01", "02")),
        (("39", "12"), 1, ("2",)),
    ],
)
def test_a_map_is_squared(rows: tuple[str, ...], most: int, expected: tuple[str, ...]) -> None:
    grid = drawn(*rows)
    grid.cells.flags.writeable = False
    assert columns(squared(grid, most)) == expected


@given(maps(), st.integers(1, 80))
def test_a_square_fits_keeps_every_obstacle_and_holds_unchanged_what_fits(grid: Map, most: int) -> None:
    side = max(grid.rows, grid.columns)
    cells = squared(grid, most)
    assert len(cells) == min(most, side) ** 2
    assert set(cells) <= {0, 1, 2}
    assert (2 in cells) == (2 in grid.cells)
    assert (max(cells) > 0) == bool(grid.cells.any())
    back = np.frombuffer(squared(grid, side + most), np.uint8).reshape(side, side).T
    assert np.array_equal(back[: grid.rows, : grid.columns], grid.cells)
    assert back.sum() == grid.cells.sum(), "nothing around it is known"


# Cells of another size


def test_a_step_that_is_no_binary_fraction_moves_no_cell() -> None:
    grid = Map(300, 300, 0.1, (0.0, 0.0), np.arange(90_000, dtype=np.uint32).reshape(300, 300).astype(np.uint8) % 3)
    assert resampled(grid, 300, 10 * 0.01) == grid.cells.T.tobytes()
    finer = resampled(grid, 900, 0.1 / 3)
    assert np.array_equal(np.frombuffer(finer, np.uint8).reshape(900, 900)[::3, ::3], grid.cells.T)


@given(
    st.integers(1, 40), st.integers(1, 40), st.data(), st.floats(0.01, 1.0), st.integers(1, 50), st.floats(0.01, 1.0)
)
@example(3, 3, None, 0.1, 2, 0.15)
def test_an_obstacle_is_shown_where_it_is(rows, columns, data, cell, side, cell_m) -> None:
    row = data.draw(st.integers(0, rows - 1)) if data is not None else 1
    column = data.draw(st.integers(0, columns - 1)) if data is not None else 1
    cells = np.ones((rows, columns), np.uint8)
    cells[row, column] = 2
    shown = np.frombuffer(resampled(Map(rows, columns, cell, (0.0, 0.0), cells), side, cell_m), np.uint8)
    places = np.argwhere(shown.reshape(side, side) == 2)
    noise = 1e-5 * max(cell, cell_m)
    if max(row, column) * cell + cell <= side * cell_m - noise:
        assert len(places) > 0
    for x, y in places:
        assert x * cell_m < (column + 1) * cell + noise
        assert (x + 1) * cell_m > column * cell - noise
        assert y * cell_m < (row + 1) * cell + noise
        assert (y + 1) * cell_m > row * cell - noise


@given(maps(20), st.integers(2, 4), st.integers(1, 20))
def test_cells_of_a_whole_multiple_hold_the_most_of_what_they_cover(grid: Map, factor: int, side: int) -> None:
    shown = np.frombuffer(resampled(grid, side, grid.cell * factor), np.uint8).reshape(side, side).T
    for row, column in np.ndindex(side, side):
        covered = grid.cells[row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
        assert shown[row, column] == (covered.max() if covered.size else 0)


# What is announced


@pytest.mark.parametrize(
    ("grid", "most", "size", "interval"),
    [
        (drawn("11", "11"), 244, 20, 10),
        (drawn("111"), 244, 30, 10),
        (drawn("11", cell=0.07), 244, 14, 7),  # 0.07 / 0.01 is more than 7
        (drawn("111", cell=0.001), 244, 1, 1),  # smaller than a unit of length
        (drawn("1111", cell=0.015), 244, 6, 2),  # 6 units in cells of 1.5: cells of 2
        (drawn("1" * 400), 244, 4012, 17),  # 4000 units in 244 cells at most: 17 units each, 236 of them
        (drawn("1" * 244), 244, 2440, 10),
        (drawn("1" * 245), 244, 2453, 11),
        (drawn("1" * 10), 1, 100, 100),
        (drawn("1", cell=1e6), 1, 10**8, 10**8),
    ],
)
def test_a_map_is_announced_in_its_own_cells_or_in_larger_ones(grid: Map, most: int, size: int, interval: int) -> None:
    assert announceable(grid, UNIT_M, most) == Geometry(size, interval)


@given(maps(), st.sampled_from([46, 244]), st.sampled_from([0.01, 0.001, 0.1, 1.0]))
def test_an_announced_map_fits_covers_the_whole_and_keeps_every_obstacle(grid: Map, most: int, unit_m: float) -> None:
    geometry = announceable(grid, unit_m, most)
    assert geometry.size == geometry.side * geometry.interval
    assert 1 <= geometry.side <= most
    assert geometry.size * unit_m >= max(grid.rows, grid.columns) * grid.cell * (1 - 1e-5)
    assert geometry.interval * unit_m >= grid.cell * (1 - 1e-5)
    cells = resampled(grid, geometry.side, geometry.interval * unit_m)
    assert len(cells) == geometry.side**2
    assert (2 in cells) == (2 in grid.cells)


@pytest.mark.parametrize("cell", [0.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, 1e300])
def test_cells_of_no_size_are_refused_and_so_is_a_map_that_no_int32_measures(cell: float) -> None:
    grid = drawn("12", "01", cell=cell)
    with pytest.raises(EncodeError):
        squared(grid, 1)
    with pytest.raises(EncodeError):
        resampled(grid, 2, 0.1)
    with pytest.raises(EncodeError):
        announceable(grid, UNIT_M, 100)
    with pytest.raises(EncodeError):
        announceable(drawn("1", cell=1e6), 1e-4, 244)
