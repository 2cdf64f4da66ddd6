"""The room simulated robots live in: a square of 10 m with boxes."""

import math

import numpy as np
import pytest

from zbridge.simulation.world import BOXES, HALF_SIDE_M, Body, Box, Grid, cast


def angles(*degrees: float) -> np.ndarray:
    return np.radians(np.array(degrees, np.float64))


def test_rays_end_at_the_walls_of_the_room() -> None:
    assert cast(0.0, 0.0, angles(0, 90, 180, 270), 20.0) == pytest.approx([5.0, 5.0, 5.0, 5.0])


def test_rays_are_measured_from_where_the_robot_is() -> None:
    assert cast(4.0, -3.0, angles(0, 90, 180, 270), 20.0) == pytest.approx([1.0, 8.0, 9.0, 2.0])


def test_a_slanted_ray_is_longer() -> None:
    assert cast(0.0, -3.5, angles(-45.0, 225.0), 20.0) == pytest.approx([1.5 * math.sqrt(2)] * 2)


def test_a_box_hides_the_wall_behind_it() -> None:
    assert cast(0.0, 1.5, angles(0.0), 20.0) == pytest.approx([1.5])
    assert cast(4.0, 1.5, angles(180.0), 20.0) == pytest.approx([1.5])


def test_a_ray_ends_at_its_range() -> None:
    assert cast(0.0, 0.0, angles(0, 90), 3.0) == pytest.approx([3.0, 3.0])


def test_no_ray_yields_no_range() -> None:
    assert cast(0.0, 0.0, np.zeros(0), 3.0).shape == (0,)


def test_a_body_moves_along_its_heading() -> None:
    body = Body()
    body.step(1.0, 0.0, 0.0, 0.5)
    assert (body.x, body.y) == pytest.approx((0.5, 0.0))
    body = Body(heading=math.pi / 2)
    body.step(1.0, 0.0, 0.0, 0.5)
    assert (body.x, body.y) == pytest.approx((0.0, 0.5))


def test_left_is_left_of_the_heading() -> None:
    body = Body(heading=math.pi / 2)
    body.step(0.0, 1.0, 0.0, 0.5)
    assert (body.x, body.y) == pytest.approx((-0.5, 0.0))


def test_a_body_turns_counter_clockwise_and_its_heading_stays_within_a_turn() -> None:
    body = Body(heading=3.0)
    body.step(0.0, 0.0, 1.0, 0.5)
    assert body.heading == pytest.approx(3.5 - 2 * math.pi)


@pytest.mark.parametrize("heading", [0.0, 1.0, 2.0, 3.0, -1.0, -2.0])
def test_walls_and_boxes_stop_a_body_wherever_it_goes(heading: float) -> None:
    body = Body(heading=heading)
    for _ in range(2000):
        body.step(1.0, 0.0, 0.0, 0.02)
    assert body.blocked
    assert max(abs(body.x), abs(body.y)) <= HALF_SIDE_M - body.radius + 1e-9
    assert not any(box.near(body.x, body.y, body.radius) for box in BOXES)


def test_a_blocked_body_can_turn_and_drive_away() -> None:
    body = Body(x=4.7)
    body.step(1.0, 0.0, 0.0, 0.5)
    assert body.blocked
    assert body.x == 4.7
    body.step(-1.0, 0.0, 0.0, 0.5)
    assert not body.blocked
    assert body.x == pytest.approx(4.2)


@pytest.mark.parametrize(
    ("x", "y", "near"),
    [(1.5, 0.5, True), (-0.19, 0.5, True), (-0.21, 0.5, False), (1.15, 1.15, False), (1.1, 1.1, True)],
)
def test_a_disc_overlaps_a_box_by_its_nearest_point(x: float, y: float, near: bool) -> None:
    assert Box(0.0, 0.0, 1.0, 1.0).near(x, y, 0.2) is (near and (x, y) != (1.5, 0.5))


def test_a_sweep_marks_what_it_passed_as_free_and_where_it_ended_as_occupied() -> None:
    grid = Grid(side=10, cell=1.0)
    grid.see(0.5, 0.5, angles(0.0), np.array([3.0]), 4.0)
    assert grid.cells[5:9, 5].tolist() == [1, 1, 1, 2]
    assert np.count_nonzero(grid.cells) == 4


def test_a_ray_that_hits_nothing_marks_no_obstacle() -> None:
    grid = Grid(side=10, cell=1.0)
    grid.see(0.5, 0.5, angles(90.0), np.array([4.0]), 4.0)
    assert 2 not in grid.cells
    assert grid.cells[5, 5:8].tolist() == [1, 1, 1]


def test_what_lies_outside_of_the_grid_is_left_out() -> None:
    grid = Grid(side=4, cell=1.0)
    grid.see(0.0, 0.0, angles(*range(0, 360, 10)), np.full(36, 8.0), 9.0)
    assert set(np.unique(grid.cells)) == {1}
    grid.see(100.0, 100.0, angles(0.0), np.array([1.0]), 9.0)
    assert set(np.unique(grid.cells)) == {1}


def test_a_body_prints_where_it_is() -> None:
    assert repr(Body(1.0, -2.0, 0.5)) == "<Body x=1.00 y=-2.00 heading=0.50>"
