"""Twists as drives: scaled, the curve kept, steered by the wheelbase, and refused where they have no sense."""

from __future__ import annotations

import math
import struct

import pytest

from zbridge.errors import Malformed, ProtocolError, Unsupported
from zbridge.ros2.types import types_of
from zbridge.views.ros2.cmd_vel import STAMPED, TWIST, drive_of, read_twist
from zbridge.views.ros2.settings import RobotBody

TURNS = RobotBody(speed_full_mps=0.5, turn_full_radps=2.0)
STEERS = RobotBody(speed_full_mps=1.0, wheelbase_m=0.5, steer_full_rad=0.5)
HEADER = b"\x00\x01\x00\x00"

DRIVES = {  # m/s forward, m/s left, rad/s: forward, left, turn
    (0.25, 0.0, 1.0): (0.5, 0.0, 0.5),
    (-0.5, 0.0, -2.0): (-1.0, 0.0, -1.0),
    (1.0, 0.0, 1.0): (1.0, 0.0, 0.25),
    (0.1, 0.2, 0.0): (0.2, 0.4, 0.0),
    (1e-9, -1e-9, 1e-9): (0.0, 0.0, 0.0),
}


@pytest.mark.parametrize(("given", "drive"), DRIVES.items())
def test_speeds_are_fractions_of_full_scale_and_the_curve_is_kept(given, drive) -> None:
    made = drive_of(*given, TURNS)
    assert (made.forward, made.left, made.turn) == pytest.approx(drive)


STEERED = {  # a circle of radius v / omega needs an angle of atan(wheelbase x omega / v)
    (0.5, 0.25): math.atan(0.25) / 0.5,
    (0.5, -0.25): -math.atan(0.25) / 0.5,
    (-0.5, 0.25): math.atan(0.25) / 0.5,  # backwards, too, turn is the sense of the yaw
    (0.5, 0.0): 0.0,
    (0.1, 5.0): 1.0,
}


@pytest.mark.parametrize(("given", "turn"), STEERED.items())
def test_a_robot_that_steers_turns_its_wheels_by_the_curvature(given, turn) -> None:
    made = drive_of(given[0], 0.0, given[1], STEERS)
    assert made.turn == pytest.approx(turn)
    assert made.forward == given[0]


@pytest.mark.parametrize(("given", "why"), [((0.0, 0.0, 1.0), "on the spot"), ((0.5, 0.1, 0.0), "sideways")])
def test_what_a_robot_that_steers_cannot_do_is_refused(given, why) -> None:
    with pytest.raises(Unsupported, match=why):
        drive_of(*given, STEERS)


def test_both_types_are_read_and_the_stamp_says_nothing() -> None:
    six = struct.pack("<6d", 0.25, 0, 0, 0, 0, 1.0)
    stamped = struct.pack("<iII", 2**31 - 1, 0, 5) + b"base\x00" + bytes(7) + six
    big_endian = bytes(4) + struct.pack(">6d", 0.25, 0, 0, 0, 0, 1.0)
    for type_name, payload in ((TWIST, HEADER + six), (TWIST, big_endian), (STAMPED, HEADER + stamped)):
        drive = read_twist(types_of("jazzy"), type_name, payload, TURNS)
        assert (drive.forward, drive.turn) == (0.5, 0.5)


def test_of_a_twist_forward_left_and_turn_are_read_and_nothing_else() -> None:
    payload = HEADER + struct.pack("<6d", 0.1, 0.2, 9.0, 9.0, 9.0, 0.5)
    for read in (payload, HEADER[:2] + b"\0\1" + payload[4:]):  # options say nothing
        drive = read_twist(types_of("jazzy"), TWIST, read, TURNS)
        assert (drive.forward, drive.left, drive.turn) == pytest.approx((0.2, 0.4, 0.25))


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        (b"", ProtocolError),
        (HEADER + bytes(40), ProtocolError),
        (HEADER + bytes(480), ProtocolError),
        (b"\x07\x07\x00\x00" + bytes(48), ProtocolError),
        (HEADER + struct.pack("<6d", math.nan, 0, 0, 0, 0, 0), Malformed),
        (HEADER + struct.pack("<6d", 0, 0, 0, 0, 0, math.inf), Malformed),
        (HEADER + struct.pack("<6d", 0.25, 0, math.nan, 0, 0, 0), Malformed),
        (HEADER + struct.pack("<6d", -2e6, 0, 0, 0, 0, 0), Malformed),
    ],
)
def test_garbage_and_numbers_without_end_are_errors(payload: bytes, error: type[Exception]) -> None:
    with pytest.raises(error):
        read_twist(types_of("jazzy"), TWIST, payload, TURNS)
