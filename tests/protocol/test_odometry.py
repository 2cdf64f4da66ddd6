"""Odometry: axes, arcs, and counters that begin anew."""

import math

import pytest

from zbridge.errors import ProtocolError
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


def test_counters_that_wrap_and_begin_anew_do_not_move_the_robot() -> None:
    odometry = Odometry(0.5, unit_m=0.001, wrap=2**16)
    odometry.sides(65_000, 32_700, 1)
    pose = odometry.sides(464, -31_836, 1)  # 1000 units each, past the end of an unsigned and of a signed counter
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 0.0, 0.0))
    assert odometry.sides(64_000, 31_700, 1).x == pytest.approx(1.0 - 2.0)
    odometry.restart()
    assert odometry.sides(0, 0, 1).x == pytest.approx(-1.0)


def test_a_robot_that_reckons_itself_goes_on_from_its_pose_after_a_restart_wherever_it_says_it_is() -> None:
    odometry = Odometry(unit_m=0.01, wrap=4096)
    first = odometry.placed(100, 200, 1.0, 7)
    assert (first.x, first.y, first.heading, first.stamp_ns) == (0.0, 0.0, 0.0, 7)
    ahead = odometry.placed(100 + 100 * math.cos(1.0), 200 + 100 * math.sin(1.0), 1.0 + math.pi / 2, 1)
    assert (ahead.x, ahead.y, ahead.heading) == pytest.approx((1.0, 0.0, math.pi / 2))
    odometry.restart()
    again = odometry.placed(0, 4090, -3.0, 1)
    assert (again.x, again.y, again.heading) == pytest.approx((1.0, 0.0, math.pi / 2))
    behind = odometry.placed(100 * math.cos(-3.0), 4090 + 100 * math.sin(-3.0), 3.0, 1)
    assert (behind.x, behind.y) == pytest.approx((1.0, 1.0))
    assert behind.heading == pytest.approx(math.pi / 2 + 6.0 - 2 * math.pi)
    wrapped = odometry.placed(100 * math.cos(-3.0), 4090 + 100 * math.sin(-3.0) - 4096, 3.0, 1)
    assert (wrapped.x, wrapped.y) == pytest.approx((1.0, 1.0))


def test_a_pose_survives_a_restart_of_the_gateway() -> None:
    odometry, heir = Odometry(0.5), Odometry(0.5)
    for way in (1.0, 3.0):
        odometry.sides(way, way, 1)
    heir.restore(odometry.export())
    assert heir.sides(4.0, 4.0, 1).x == 3.0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused_and_leave_the_pose_as_it_was(bad: float) -> None:
    odometry = Odometry(0.5, wrap=2**16)
    odometry.sides(0, 0, 1)
    for broken in (
        lambda: odometry.sides(bad, 1, 1),
        lambda: odometry.placed(0, bad, 0, 1),
        lambda: odometry.moved(bad, 0, 1),
    ):
        with pytest.raises(ProtocolError, match="expected finite numbers"):
            broken()
    assert odometry.sides(2, 2, 1).x == 2.0
