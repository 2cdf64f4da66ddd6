"""Commands as packets, scans as simulated lidar data, and refusals, worked out by hand from the protocol page."""

import math
import struct

import numpy as np
import pytest

from gateways.tcpudp.options import TcpUdpOptions
from gateways.tcpudp.translate import TcpUdpRobot, polar_ranges
from tests.gateways.tcpudp.frames import LISTED, STOP, Stage, bearing, server_settings
from zbridge.errors import EncodeError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Raw, Scan, Stop, Switch, Text
from zbridge.fleet.topics import Topic

RAW_COMMAND = topics.CMD_RAW("tcpudp")
FULL_TURN = Scan(0.0, math.radians(1), 0.1, 8.0, np.full(360, 2.0, np.float32))


def stage(flags: str = "00010101010101", **options: object) -> Stage:
    return Stage(server_settings(LISTED, flags + "0000000000000000", 2), TcpUdpOptions(**options))  # type: ignore[arg-type]


FULL_SCALE = {"speed_full": 3.0, "turn_full": 0.5}


@pytest.mark.parametrize(
    ("options", "command", "motion", "left_out"),
    [
        # translation becomes a direction, x right, y forward, and a speed
        ({}, {"forward": 1.0}, (0.0, 1.0, 1.0), None),
        ({}, {"forward": -0.5}, (0.0, -1.0, 0.5), None),
        ({}, {"left": 1.0}, (-1.0, 0.0, 1.0), None),
        ({}, {"left": -0.25}, (1.0, 0.0, 0.25), None),
        ({}, {"forward": 0.3, "left": 0.4}, (-0.8, 0.6, 0.5), None),
        # clipped: the corner is no faster than straight ahead
        ({}, {"forward": 1.0, "left": 1.0}, (-0.70710678, 0.70710678, 1.0), None),
        # a turn to the left is negative on the wire
        ({}, {"turn": 1.0}, (-1.0,), None),
        ({}, {"turn": -0.5}, (0.5,), None),
        (FULL_SCALE, {"forward": 0.5}, (0.0, 1.0, 1.5), None),
        (FULL_SCALE, {"forward": 1.0, "left": 1.0}, (-0.70710678, 0.70710678, 3.0), None),
        (FULL_SCALE, {"turn": 1.0}, (-0.5,), None),
        # exclusive: the larger of the turn and the whole translation; the translation when they are equal
        ({}, {"forward": 0.5, "turn": 0.4}, (0.0, 1.0, 0.5), "turn"),
        ({}, {"forward": 0.3, "left": 0.4, "turn": 0.6}, (-0.6,), "forward and left"),
        ({}, {"forward": 0.3, "left": 0.4, "turn": 0.5}, (-0.8, 0.6, 0.5), "turn"),
        ({"combine": "both"}, {"left": 1.0, "turn": 0.5}, (-1.0, 0.0, 1.0, -0.5), None),
        ({}, {"forward": 1.0, "light": True}, (0.0, 1.0, 1.0), "light"),
        ({}, {"light": False}, (), "light"),
        ({}, {}, (), None),
    ],
)
def test_a_drive_becomes_a_move_or_a_rotation_and_the_rest_is_reported(options, command, motion, left_out) -> None:
    robot = stage(**options)
    reported = robot.command(topics.CMD_DRIVE, Drive(**command))  # type: ignore[arg-type]
    assert reported is None if left_out is None else str(reported).startswith(left_out)
    sent = robot.after(0.1)
    headers = {0: ["020000 00020d"], 1: ["060000 00020c"], 3: ["0e0000 00020b"], 4: ["0e0000 00020b", "060000 00020c"]}
    assert [frame[:6].hex(" ", 3) for frame in sent] == headers[len(motion)]
    values = [value for frame in sent for (value,) in struct.iter_unpack("<f", frame[6:])]
    assert values == pytest.approx(motion)
    assert not any(math.copysign(1.0, value) < 0 for value in values if value == 0), "a plain zero"


@pytest.mark.parametrize(
    ("topic", "command", "packet"),
    [
        (topics.CMD_MODE, Mode(mode="none"), "06000000 02 0a 01000000"),
        (topics.CMD_MODE, Mode(mode="manual"), "06000000 02 0a 02000000"),
        (topics.CMD_MODE, Mode(mode="autonomous"), "06000000 02 0a 03000000"),
        (topics.CMD_LIDAR, Switch(on=True), "06000000 02 32 01000000"),
        (topics.CMD_LIDAR, Switch(on=False), "06000000 02 32 02000000"),
        (topics.CMD_TEXT, Text(text="bye"), "09000000 02 01 03000000 627965"),
        (RAW_COMMAND, Raw(id=21, body=b"\x01\x02"), "04000000 02 15 0102"),
        (RAW_COMMAND, Raw(id=40, body=b"\x03"), "03000000 02 28 03"),
        (RAW_COMMAND, Raw(id=75, body=b"\x01"), "03000000 02 4b 01"),  # forced
        (topics.CMD_SCAN, FULL_TURN, "a6050000 02 3d 68010000" + "00004843" * 360),
    ],
)
def test_a_command_becomes_its_packet_and_a_scan_is_shown_besides(topic: Topic, command, packet: str) -> None:
    robot = stage(force=(75,))
    outcome = robot.robot.command(topic, command, robot.now)
    assert outcome.left_out is None
    assert outcome.telemetry == (((topics.SCAN, FULL_TURN),) if command is FULL_TURN else ())
    assert robot.after(0.1) == [bytes.fromhex(packet)]


HELD = (*range(1, 8), *range(10, 14), 31, *range(50, 56), 60, 61)
ALL, NONE = "00010101010101", "00000000000000"


@pytest.mark.parametrize(
    ("flags", "topic", "command", "reason"),
    [
        (ALL, topics.CMD_CAMERA, Switch(on=True), "camera"),
        (ALL, topics.CMD_LIGHT, Switch(on=True), "no such command"),
        (ALL, topics.CMD_MOTOR("left"), Switch(on=True), "no such command"),
        (ALL, topics.CMD_STOP, Stop(), "no such command"),
        (ALL, topics.CMD_RAW("alf"), Raw(id=40), "no such command"),
        (ALL, topics.CMD_TEXT, Text(text="hi", kind="chat"), "chat is opaque"),
        (ALL, topics.CMD_TEXT, Text(text="hi", kind="request"), "request"),
        (ALL, topics.CMD_TEXT, Text(text=""), "empty text"),
        (ALL, topics.CMD_TEXT, Text(text="Grüße"), "ascii"),
        (ALL, topics.CMD_TEXT, Text(text="x" * 5000), "4096"),
        (ALL, RAW_COMMAND, Raw(id=-1), "0 to 255"),
        (ALL, RAW_COMMAND, Raw(id=256), "0 to 255"),
        (ALL, RAW_COMMAND, Raw(id=70), "may crash"),
        (ALL, RAW_COMMAND, Raw(id=0), "may crash"),
        *[(ALL, RAW_COMMAND, Raw(id=held), "not raw") for held in HELD],
        (NONE, topics.CMD_DRIVE, Drive(left=1.0), "does not announce joystick"),
        (NONE, topics.CMD_DRIVE, Drive(), "does not announce joystick"),
        ("00010101010001", topics.CMD_SCAN, FULL_TURN, "lidar_sim"),
    ],
)
def test_what_the_robot_cannot_do_is_refused(flags: str, topic: Topic, command: FleetMessage, reason: str) -> None:
    robot = stage(flags)
    with pytest.raises((Refused, EncodeError), match=reason):
        robot.command(topic, command)
    assert robot.after(0.1) == []


def test_a_robot_is_ready_while_its_session_is_established_and_refuses_all_before_the_first_connection() -> None:
    robot = TcpUdpRobot(TcpUdpOptions())
    assert (robot.driving, robot.ready) == (None, False)
    with pytest.raises(Refused, match="offline"):
        robot.command(topics.CMD_DRIVE, Drive(), 0.0)
    with pytest.raises(Refused, match="offline"):
        robot.ask(topics.MAP)
    with pytest.raises(Refused, match="offline"):
        robot.stop(0.0, 1.0)
    connected = stage()
    assert connected.robot.ready
    connected.robot.stop(connected.now, connected.now)
    assert connected.after(1.0) == [bearing(STOP, 2)]
    connected.session.fail("gone")
    assert not connected.robot.ready


# Simulated lidar data


def polar(ranges: list[float], begin: float = 0.0, step: float = 1.0, *within: float) -> list[float]:
    """What becomes of a scan that begins at an angle and continues by another, degrees."""
    scan = Scan(math.radians(begin), math.radians(step), *(within or (0.1, 8.0)), np.array(ranges, np.float32))  # type: ignore[misc]
    values = polar_ranges(scan, 0.01)
    assert (values.shape, values.dtype) == ((360,), np.float32)
    return [round(float(value), 3) for value in values]


@pytest.mark.parametrize(
    ("ranges", "begin", "step", "expected"),
    [
        # one point a degree is only put into the robot's unit
        ([1 + 0.01 * n for n in range(360)], 0.0, 1.0, {degree: 100.0 + degree for degree in range(360)}),
        # it begins behind the robot: straight ahead is index 180
        ([1 + 0.01 * n for n in range(360)], -180.0, 1.0, {0: 280.0, 180: 100.0, 181: 101.0, 359: 279.0}),
        # clockwise: 90 degrees are 270 clockwise
        ([1 + 0.01 * n for n in range(360)], 0.0, -1.0, {0: 100.0, 359: 101.0, 90: 370.0}),
        # finer, coarser: the nearest points
        ([1 + 0.001 * n for n in range(1440)], 0.0, 0.25, {1: 100.4, 359: 243.6}),
        ([1.0, 2.0, 3.0, 4.0], 0.0, 90.0, {0: 100.0, 44: 100.0, 46: 200.0, 90: 200.0, 180: 300.0, 270: 400.0}),
        # degrees the scan does not cover are zero
        ([2.0] * 181, -90.0, 1.0, {degree: 0.0 if 90 < degree < 270 else 200.0 for degree in range(360)}),
        # points in one direction cover that direction only
        ([2.0] * 360, 0.0, 1e-298, {degree: 0.0 if degree else 200.0 for degree in range(360)}),
        ([2.0] * 360, 0.0, -1e-298, {degree: 0.0 if degree else 200.0 for degree in range(360)}),
    ],
)
def test_a_scan_becomes_360_ranges_a_degree_apart(ranges, begin, step, expected) -> None:
    values = polar(ranges, begin, step)
    assert {degree: values[degree] for degree in expected} == expected


def test_points_that_are_invalid_or_out_of_range_are_zero_and_a_full_circle_has_no_hole_wherever_it_begins() -> None:
    for invalid in (math.nan, math.inf, -math.inf, -1.0, 0.0, 0.05, 8.5):
        assert polar([2.0] * 10 + [invalid] + [2.0] * 349)[9:12] == [200.0, 0.0, 200.0]
    full = [(0.4, 1.0), (-0.4, -1.0), (90 - 1e-7, -1.0), (0.2, 0.5), (-180.0, 1.0), (359.6, 1.0), (1.0, 2.0)]
    for begin, step in full:
        assert set(polar([2.0] * round(360 / abs(step)), begin, step)) == {200.0}


def test_a_scan_without_points_increment_or_limits_and_lengths_the_packet_cannot_carry_are_zero() -> None:
    assert set(polar([])) == {0.0}
    for step in (0.0, math.nan, math.inf, -math.inf):
        assert set(polar([2.0] * 360, 0.0, step)) == {0.0}
    for within in ((math.nan, 8.0), (0.1, math.nan)):
        assert set(polar([2.0] * 360, 0.0, 1.0, *within)) == {0.0}
    assert polar([3e38, 2.0] * 180, 0.0, 1.0, 0.1, 3.3e38) == [0.0, 200.0] * 180
