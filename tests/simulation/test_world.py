"""The room simulated robots live in: a square of 10 m with boxes."""

import math

import numpy as np
import pytest

from zbridge.simulation.world import BOXES, HALF_SIDE_M, Body, Box, Grid, cast


def angles(*degrees: float) -> np.ndarray:
    return np.radians(np.array(degrees, np.float64))


@pytest.mark.parametrize(
    ("x", "y", "degrees", "range_max", "ranges"),
    [
        (0.0, 0.0, (0, 90, 180, 270), 20.0, [5.0, 5.0, 5.0, 5.0]),
        (4.0, -3.0, (0, 90, 180, 270), 20.0, [1.0, 8.0, 9.0, 2.0]),
        (0.0, -3.5, (-45, 225), 20.0, [1.5 * math.sqrt(2)] * 2),
        (0.0, 1.5, (0,), 20.0, [1.5]),
        (4.0, 1.5, (180,), 20.0, [1.5]),
        (0.0, 0.0, (0, 90), 3.0, [3.0, 3.0]),
        (0.0, 0.0, (), 3.0, []),
    ],
    ids=["the walls", "from where it is", "slanted", "a box", "its other side", "the range", "no ray"],
)
def test_a_ray_ends_at_the_first_solid_or_at_its_range(x, y, degrees, range_max: float, ranges: list[float]) -> None:
    assert cast(x, y, angles(*degrees), range_max).tolist() == pytest.approx(ranges)


@pytest.mark.parametrize(
    ("heading", "speeds", "place"),
    [
        (0.0, (1.0, 0.0, 0.0), (0.5, 0.0, 0.0)),
        (math.pi / 2, (1.0, 0.0, 0.0), (0.0, 0.5, math.pi / 2)),
        (math.pi / 2, (0.0, 1.0, 0.0), (-0.5, 0.0, math.pi / 2)),
        (3.0, (0.0, 0.0, 1.0), (0.0, 0.0, 3.5 - 2 * math.pi)),
    ],
    ids=["ahead", "along its heading", "left of its heading", "counter-clockwise, within a turn"],
)
def test_a_body_moves_for_half_a_second(heading: float, speeds, place: tuple[float, float, float]) -> None:
    body = Body(heading=heading)
    body.step(*speeds, 0.5)
    assert (body.x, body.y, body.heading) == pytest.approx(place)


@pytest.mark.parametrize("heading", [0.0, 1.0, 2.0, 3.0, -1.0, -2.0])
def test_walls_and_boxes_stop_a_body_wherever_it_goes_and_it_can_drive_away(heading: float) -> None:
    body = Body(heading=heading)
    for _ in range(2000):
        body.step(1.0, 0.0, 0.0, 0.02)
    stopped = body.x, body.y
    assert body.blocked
    assert max(map(abs, stopped)) <= HALF_SIDE_M - body.radius + 1e-9
    assert not any(box.near(*stopped, body.radius) for box in BOXES)
    body.step(-1.0, 0.0, 0.0, 0.5)
    assert not body.blocked
    assert math.dist((body.x, body.y), stopped) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("x", "y", "near"),
    [
        (0.5, 0.5, True),
        (1.5, 0.5, False),
        (-0.19, 0.5, True),
        (-0.21, 0.5, False),
        (1.15, 1.15, False),
        (1.1, 1.1, True),
    ],
)
def test_a_disc_overlaps_a_box_by_its_nearest_point(x: float, y: float, near: bool) -> None:
    assert Box(0.0, 0.0, 1.0, 1.0).near(x, y, 0.2) is near


@pytest.mark.parametrize(
    ("degrees", "range_m", "column_of", "cells"),
    [(0, 3.0, (slice(5, 10), 5), [1, 1, 1, 2, 0]), (90, 4.0, (5, slice(5, 10)), [1, 1, 1, 1, 0])],
    ids=["where it ended is occupied", "a ray that hits nothing marks no obstacle"],
)
def test_a_sweep_marks_what_it_passed_as_free(degrees: float, range_m: float, column_of, cells: list[int]) -> None:
    grid = Grid(side=10, cell=1.0)
    grid.see(0.5, 0.5, angles(degrees), np.array([range_m]), 4.0)
    assert grid.cells[column_of].tolist() == cells
    assert np.count_nonzero(grid.cells) == 4


def test_what_lies_outside_of_the_grid_is_left_out() -> None:
    grid = Grid(side=4, cell=1.0)
    grid.see(0.0, 0.0, angles(*range(0, 360, 10)), np.full(36, 8.0), 9.0)
    grid.see(100.0, 100.0, angles(0.0), np.array([1.0]), 9.0)
    assert set(np.unique(grid.cells)) == {1}
