"""Odometry: axes, arcs, and counters that begin anew."""

import math

import pytest

from zbridge.protocol.kinematics import Odometry


def test_the_first_positions_are_the_origin_and_a_restart_goes_on_from_where_the_robot_was() -> None:
    odometry = Odometry(0.5)
    pose = odometry.sides(7.0, 9.0, 5)
    assert (pose.x, pose.y, pose.heading, pose.stamp_ns) == (0.0, 0.0, 0.0, 5)
    assert [odometry.sides(7.0 + way, 9.0 + way, 1).x for way in (2.0, 1.0)] == [2.0, 1.0]
    odometry.restart()
    assert [odometry.sides(way, way, 1).x for way in (0.0, 0.5)] == [1.0, 1.5]


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
    assert (pose.x, pose.y, pose.heading) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
