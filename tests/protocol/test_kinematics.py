"""Drives and wheels."""

import msgspec
import pytest

from zbridge.errors import Unsupported
from zbridge.fleet.messages import Drive
from zbridge.protocol.kinematics import Differential, Factors

CAR = Differential(track_m=0.4, speed_full_m_s=2.0, turn_full_rad_s=5.0)


@pytest.mark.parametrize(
    ("drive", "left_m_s", "right_m_s"),
    [
        (Drive(), 0.0, 0.0),
        (Drive(forward=1.0), 2.0, 2.0),
        (Drive(forward=-0.5), -1.0, -1.0),
        (Drive(turn=1.0), -1.0, 1.0),
        (Drive(forward=0.5, turn=-1.0), 2.0, 0.0),
    ],
)
def test_a_drive_moves_both_sides_and_their_speeds_give_the_drive(drive: Drive, left_m_s, right_m_s) -> None:
    assert CAR.sides_m_s(drive) == pytest.approx((left_m_s, right_m_s))
    back = CAR.drive(left_m_s, right_m_s)
    assert (back.forward, back.left, back.turn) == pytest.approx((drive.forward, 0.0, drive.turn))


def test_two_sides_of_wheels_do_not_move_sideways() -> None:
    assert CAR.sides_m_s(Drive(forward=0.5, left=1.0)) == pytest.approx((1.0, 1.0))
    with pytest.raises(Unsupported, match="does not move sideways"):
        CAR.sides_m_s(Drive(left=0.5))


@pytest.mark.parametrize(
    ("sides_m_s", "forward", "turn"),
    [((20.0, 20.0), 1.0, 0.0), ((-20.0, 20.0), 0.0, 1.0), ((3.0, -9.0), -0.25, -1.0), ((0.0, 100.0), 0.5, 1.0)],
)
def test_speeds_beyond_full_scale_keep_their_proportion(sides_m_s: tuple[float, float], forward, turn) -> None:
    drive = CAR.drive(*sides_m_s)
    assert (drive.forward, drive.turn) == pytest.approx((forward, turn))


def test_factors_add_up() -> None:
    factors = Factors(forward=10.0, left=1.0, turn=-3.0)
    assert factors.value(Drive(forward=0.5, left=-1.0, turn=0.5)) == pytest.approx(2.5)
    assert Factors().value(Drive(forward=1.0, left=1.0, turn=1.0)) == 0.0


@pytest.mark.parametrize("options", [{}, {"track_m": 0.0}, {"track_m": 1.0, "speed_full_m_s": -1.0}])
def test_absurd_settings_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(options, Differential)


def test_a_robot_that_takes_speed_and_turn_rate_gets_them_in_si_units() -> None:
    assert CAR.velocity(Drive(forward=-0.5, left=0.1, turn=0.5)) == (
        -0.5 * CAR.speed_full_m_s,
        0.5 * CAR.turn_full_rad_s,
    )
    with pytest.raises(Unsupported, match="does not move sideways"):
        CAR.velocity(Drive(left=0.5))
