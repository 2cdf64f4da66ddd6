"""Odometry: axes, arcs, and counters that begin anew."""

from __future__ import annotations

import math

import pytest

from zbridge.protocol.odometry import Odometry


def test_the_first_positions_are_the_origin_whatever_the_counters_say() -> None:
    pose = Odometry(0.5).sides(7.0, 9.0, 5)
    assert (pose.x, pose.y, pose.heading, pose.stamp_ns) == (0.0, 0.0, 0.0, 5)


def test_both_sides_forward_is_along_the_heading() -> None:
    odometry = Odometry(0.5)
    odometry.sides(0.0, 0.0, 1)
    assert odometry.sides(2.0, 2.0, 1).x == 2.0
    assert odometry.sides(1.0, 1.0, 1).x == 1.0


def test_the_right_side_alone_turns_counter_clockwise() -> None:
    odometry = Odometry(0.5)
    odometry.sides(0.0, 0.0, 1)
    pose = odometry.sides(-0.5 * math.pi / 4, 0.5 * math.pi / 4, 1)
    assert (pose.x, pose.y, pose.heading) == (0.0, 0.0, pytest.approx(math.pi / 2))
    pose = odometry.moved(1.0, 0.0, 1)
    assert (pose.x, pose.y) == (pytest.approx(0.0), pytest.approx(1.0))


def test_many_small_arcs_close_a_circle() -> None:
    odometry = Odometry(0.5)
    for _ in range(1000):
        pose = odometry.moved(0.01, 2 * math.pi / 1000, 1)
    assert (pose.x, pose.y, pose.heading) == tuple(pytest.approx(0.0, abs=1e-9) for _ in range(3))


def test_after_a_restart_the_pose_goes_on_from_where_it_was() -> None:
    odometry = Odometry(0.5)
    odometry.sides(0.0, 0.0, 1)
    odometry.sides(1.0, 1.0, 1)
    odometry.restart()
    assert odometry.sides(0.0, 0.0, 1).x == 1.0
    assert odometry.sides(0.5, 0.5, 1).x == 1.5
