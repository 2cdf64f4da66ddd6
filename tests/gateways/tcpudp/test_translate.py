"""Units, axes and refusals of the TCP/UDP package protocol, worked out by hand from the protocol page."""

import math
import struct

import numpy as np
import pytest

from gateways.tcpudp.messages import (
    ChatMessage,
    DebugMessage,
    OpaquePacket,
    Packet,
    ServerCamMode,
    ServerGetSimulatedLidarData,
    ServerLidarStatus,
    ServerPosition,
    ServerSLAMMap,
    ServerUDPConnection,
)
from gateways.tcpudp.session import HqRole
from gateways.tcpudp.translate import Options, TcpUdpRobot, polar_ranges
from tests.gateways.tcpudp.frames import LISTED, server_settings
from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Map, Mode, Pose, Raw, Scan, Stop, Switch, Text
from zbridge.fleet.topics import Topic

STAMP = 1_700_000_000_000_000_000
STOP = bytes.fromhex("02000000 02 0d")
MOVE_LEFT = bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")
MOVE_RIGHT = bytes.fromhex("0e000000 02 0b 0000803f 00000000 0000803f")
RAW, RAW_COMMAND = topics.RAW("tcpudp"), topics.CMD_RAW("tcpudp")


def settings(flags: str = "00010101010101", size: int = 0, interval: int = 0) -> bytes:
    return server_settings(LISTED, flags + struct.pack("<ii", size, interval).hex(), 2)


class Wire:
    """A robot with an established session, and what leaves it."""

    def __init__(self, options: Options | None = None, announced: bytes = settings()) -> None:
        self.robot = TcpUdpRobot(options or Options())
        self.session: HqRole = self.robot.session("robot", "tcp://robot.test:1")
        self.session.open(0.0)
        self.session.receive(announced, 0.0)
        self.session.outgoing(0.0)
        self.now = 1.0

    def one(self, message: Packet) -> tuple[Topic, FleetMessage]:
        (telemetry,) = self.robot.telemetry(message, STAMP)
        return telemetry

    def map(self, cells: bytes | None) -> Map:
        topic, shown = self.one(ServerSLAMMap(cells) if cells is not None else ServerSLAMMap())
        assert topic is topics.MAP
        assert isinstance(shown, Map)
        return shown

    def sent(self) -> list[bytes]:
        """What leaves within 0.1 s, before anything is repeated."""
        frames = []
        for _ in range(10):
            frame = self.session.outgoing(self.now)
            if frame is not None:
                frames.append(frame)
            self.now += 0.01
        return frames

    def drive(
        self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0, light: bool | None = None
    ) -> str | None:
        command = Drive(forward=forward, left=left, turn=turn, light=light)
        return self.robot.command(topics.CMD_DRIVE, command, self.now).left_out

    def motion(self) -> tuple[float, ...]:
        """Read the one packet that leaves: x right, y forward, speed of 11; the speed of 12, positive to the right."""
        (frame,) = self.sent()
        count = {"0e000000020b": 3, "06000000020c": 1}[frame[:6].hex()]
        return struct.unpack(f"<{count}f", frame[6:])


@pytest.fixture
def wire() -> Wire:
    return Wire()


# Packets to telemetry


@pytest.mark.parametrize(
    ("options", "packet", "x", "y", "heading"),
    [
        (Options(), ServerPosition(150.0, -50.0, 0.0), 1.5, -0.5, math.pi / 2),
        (Options(), ServerPosition(0.0, 0.0, 90.0), 0.0, 0.0, math.pi),
        (Options(), ServerPosition(1.0, 2.0, -90.0), 0.01, 0.02, 0.0),
        (Options(), ServerPosition(0.0, 0.0, 45.0), 0.0, 0.0, 2.356194490),
        (Options(length_unit_m=0.001, heading_offset=0.0), ServerPosition(150.0, -50.0, 180.0), 0.15, -0.05, math.pi),
    ],
)
def test_a_pose_is_in_metres_with_x_and_y_kept_and_its_heading_turned_by_a_quarter(
    options: Options, packet: Packet, x: float, y: float, heading: float
) -> None:
    topic, pose = Wire(options).one(packet)
    assert topic is topics.POSE
    assert isinstance(pose, Pose)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((x, y, heading))
    assert pose.stamp_ns == STAMP


def test_a_map_is_transposed_from_x_major_to_rows_of_y_and_unknown_values_are_unknown_cells() -> None:
    shown = Wire(announced=settings(size=30, interval=10)).map(bytes([0, 1, 2, 2, 2, 0, 1, 0, 1]))
    assert (shown.rows, shown.columns) == (3, 3)
    assert shown.cells.tolist() == [[0, 2, 1], [1, 2, 0], [2, 0, 1]]
    assert shown.cell == pytest.approx(0.1)
    assert shown.origin == pytest.approx((-0.15, -0.15))
    assert shown.stamp_ns == STAMP
    assert Wire().map(bytes([3, 1, 2, 255])).cells.tolist() == [[0, 2], [1, 0]]


@pytest.mark.parametrize(
    ("size", "interval", "cell"),
    [
        (40, 10, 0.1),
        (45, 10, 0.1),
        (1000, 10, 0.1),  # does not fit the body: the square root
        (0, 0, 0.01),  # nothing announced
        (40, 0, 0.01),
        (0, 5, 0.05),
        (-40, -10, 0.01),
    ],
)
def test_the_side_of_a_map_is_what_was_announced_where_it_fits_else_the_square_root(size, interval, cell) -> None:
    shown = Wire(announced=settings(size=size, interval=interval)).map(bytes(16))
    assert (shown.rows, shown.columns) == (4, 4)
    assert shown.cell == pytest.approx(cell)


def test_the_cell_and_origin_of_a_map_are_options() -> None:
    shown = Wire(Options(map_cell_m=0.25, map_origin=(-1.0, 2.0))).map(bytes(4))
    assert (shown.cell, shown.origin) == (0.25, (-1.0, 2.0))


@pytest.mark.parametrize("cells", [b"", None])
@pytest.mark.parametrize("announced", [settings(), settings(size=30, interval=10), settings("00000000000000")])
def test_a_map_without_cells_is_an_empty_map(cells: bytes | None, announced: bytes) -> None:
    shown = Wire(announced=announced).map(cells)
    assert (shown.rows, shown.columns, shown.cells.shape) == (0, 0, (0, 0))
    assert shown.origin == (0.0, 0.0)


@pytest.mark.parametrize(
    ("packet", "topic", "message"),
    [
        (ServerLidarStatus(1), topics.LIDAR, Switch(on=True, stamp_ns=STAMP)),
        (ServerLidarStatus(2), topics.LIDAR, Switch(on=False, stamp_ns=STAMP)),
        (ServerCamMode(1), topics.CAMERA, Switch(on=True, stamp_ns=STAMP)),
        (ServerCamMode(2), topics.CAMERA, Switch(on=False, stamp_ns=STAMP)),
        (DebugMessage("hi"), topics.TEXT, Text(text="hi", kind="debug", stamp_ns=STAMP)),
        (ChatMessage(b"\x01"), RAW, Raw(id=40, body=b"\x01", stamp_ns=STAMP)),
        (OpaquePacket(70, b"\x02"), RAW, Raw(id=70, body=b"\x02", stamp_ns=STAMP)),
        (OpaquePacket(200), RAW, Raw(id=200, body=b"", stamp_ns=STAMP)),
        # of the table, but no fleet message holds it
        (ServerUDPConnection(True), RAW, Raw(id=6, body=b"\x01", stamp_ns=STAMP)),
    ],
)
def test_a_packet_becomes_its_telemetry(wire: Wire, packet: Packet, topic: Topic, message: FleetMessage) -> None:
    assert wire.one(packet) == (topic, message)


def test_a_request_for_simulated_lidar_data_is_a_text_of_that_kind(wire: Wire) -> None:
    topic, text = wire.one(ServerGetSimulatedLidarData())
    assert topic is topics.TEXT
    assert isinstance(text, Text)
    assert text.kind == "request"


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        *((ServerLidarStatus(mode), f"mode {mode}") for mode in (0, 3, -1, 2**31 - 1)),
        *((ServerCamMode(mode), f"mode {mode}") for mode in (0, 3, -1, 2**31 - 1)),
        *((ServerSLAMMap(bytes(n)), f"map of {n} cells is not square") for n in (2, 3, 5, 8, 10_001)),
    ],
)
def test_a_mode_that_is_neither_on_nor_off_and_a_map_that_is_no_square_are_refused(wire, packet, reason) -> None:
    with pytest.raises(ProtocolError, match=reason):
        wire.one(packet)


# Drive

EXCLUSIVE, BOTH = Options(), Options(combine="both")
FULL_SCALE = Options(speed_full=3.0, turn_full=0.5)


@pytest.mark.parametrize(
    ("options", "command", "motion", "left_out"),
    [
        # translation becomes a direction, x right, y forward, and a speed
        (EXCLUSIVE, {"forward": 1.0}, (0.0, 1.0, 1.0), None),
        (EXCLUSIVE, {"forward": -0.5}, (0.0, -1.0, 0.5), None),
        (EXCLUSIVE, {"left": 1.0}, (-1.0, 0.0, 1.0), None),
        (EXCLUSIVE, {"left": -0.25}, (1.0, 0.0, 0.25), None),
        (EXCLUSIVE, {"forward": 0.3, "left": 0.4}, (-0.8, 0.6, 0.5), None),
        # clipped: the corner is no faster than straight ahead
        (EXCLUSIVE, {"forward": 1.0, "left": 1.0}, (-0.70710678, 0.70710678, 1.0), None),
        (EXCLUSIVE, {"forward": -0.6, "left": -0.8}, (0.8, -0.6, 1.0), None),
        # a turn to the left is negative on the wire
        (EXCLUSIVE, {"turn": 1.0}, (-1.0,), None),
        (EXCLUSIVE, {"turn": -0.5}, (0.5,), None),
        (FULL_SCALE, {"forward": 0.5}, (0.0, 1.0, 1.5), None),
        (FULL_SCALE, {"forward": 1.0, "left": 1.0}, (-0.70710678, 0.70710678, 3.0), None),
        (FULL_SCALE, {"turn": 1.0}, (-0.5,), None),
        # exclusive: the larger of the turn and the whole translation; the translation when they are equal
        (EXCLUSIVE, {"forward": 0.5, "turn": 0.4}, (0.0, 1.0, 0.5), "turn"),
        (EXCLUSIVE, {"forward": 0.3, "left": 0.4, "turn": 0.6}, (-0.6,), "forward and left"),
        (EXCLUSIVE, {"forward": 0.3, "left": 0.4, "turn": 0.5}, (-0.8, 0.6, 0.5), "turn"),
        (EXCLUSIVE, {"forward": 1.0, "light": True}, (0.0, 1.0, 1.0), "light"),
    ],
)
def test_a_drive_becomes_a_move_or_a_rotation_and_what_is_left_out_is_reported(
    options: Options, command: dict[str, float], motion: tuple[float, ...], left_out: str | None
) -> None:
    wire = Wire(options)
    reported = wire.drive(**command)  # type: ignore[arg-type]
    assert reported is None if left_out is None else str(reported).startswith(left_out)
    assert wire.motion() == pytest.approx(motion)


def test_straight_ahead_is_a_plain_zero_to_the_right(wire: Wire) -> None:
    wire.drive(forward=1.0)
    assert wire.sent() == [bytes.fromhex("0e000000 02 0b 00000000 0000803f 0000803f")]


def test_a_light_with_neutral_is_reported_and_neutral_is_sent(wire: Wire) -> None:
    assert "light" in str(wire.drive(light=False))
    assert wire.sent() == [STOP]


def test_both_sends_one_after_the_other_and_leaves_nothing_out() -> None:
    wire = Wire(BOTH)
    assert wire.drive(left=1.0, turn=0.5) is None
    assert wire.sent() == [MOVE_LEFT, bytes.fromhex("06000000 02 0c 000000bf")]


def test_both_sends_translation_and_turn_in_turns_although_every_command_replaces_the_one_before() -> None:
    wire = Wire(Options(combine="both", gap_s=1 / 64))
    kinds = []
    for step in range(20):
        wire.now = 1.0 + step / 64
        wire.drive(left=1.0, turn=0.5)
        frame = wire.session.outgoing(wire.now)
        assert frame is not None
        kinds.append(frame[5])
    assert kinds == [11, 12] * 10


def test_motion_is_repeated_every_quarter_of_a_second_without_end(wire: Wire) -> None:
    wire.drive(left=1.0)
    assert [wire.session.outgoing(1.0 + 0.25 * step) for step in range(9)] == [MOVE_LEFT] * 9
    assert wire.session.outgoing(3.1) is None


def test_neutral_is_packet_13_repeated_for_a_second(wire: Wire) -> None:
    assert wire.drive() is None
    assert [wire.session.outgoing(1.0 + 0.25 * step) for step in range(9)] == [STOP] * 5 + [None] * 4


def test_a_stop_is_packet_13_repeated_to_its_end_and_goes_before_what_waits(wire: Wire) -> None:
    wire.drive(left=1.0)
    wire.robot.command(topics.CMD_TEXT, Text(text="hi"), 1.0)
    wire.robot.stop(1.0, 2.0)
    assert wire.session.outgoing(1.0) == STOP
    frames = [wire.session.outgoing(1.05 + 0.01 * step) for step in range(300)]
    assert frames.count(STOP) in (9, 10)
    assert all(frame is None for frame in frames[100:])
    assert not any(frame and frame[5] == 11 for frame in frames)


def test_a_stop_leaves_before_newer_motion(wire: Wire) -> None:
    wire.drive(left=1.0)
    assert wire.session.outgoing(1.0) == MOVE_LEFT
    wire.robot.stop(1.001, 2.001)
    wire.now = 1.002
    wire.drive()
    wire.now = 1.003
    wire.drive(left=-1.0)
    assert wire.sent() == [STOP, MOVE_RIGHT]


# Other commands


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
    ],
)
def test_a_command_becomes_its_packet(topic: Topic, command: FleetMessage, packet: str) -> None:
    wire = Wire(Options(force=(75,)))
    assert wire.robot.command(topic, command, wire.now).left_out is None
    assert wire.sent() == [bytes.fromhex(packet)]


def test_the_robot_is_asked_for_map_and_pose(wire: Wire) -> None:
    wire.robot.ask(topics.MAP)
    wire.robot.ask(topics.POSE)
    assert wire.sent() == [bytes.fromhex("02000000 02 34"), bytes.fromhex("02000000 02 36")]


FULL_TURN = Scan(0.0, math.radians(1), 0.1, 8.0, np.full(360, 2.0, np.float32))
HELD = (1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 31, 50, 51, 52, 53, 54, 55, 60, 61)
NO_JOYSTICK = settings("00000000000000")


@pytest.mark.parametrize(
    ("announced", "topic", "command", "reason"),
    [
        (settings(), topics.CMD_CAMERA, Switch(on=True), "camera"),
        (settings(), topics.CMD_LIGHT, Switch(on=True), "no such command"),
        (settings(), topics.CMD_MOTOR("left"), Switch(on=True), "no such command"),
        (settings(), topics.CMD_SENSOR("x"), Switch(on=True), "no such command"),
        (settings(), topics.CMD_STOP, Stop(), "no such command"),
        (settings(), topics.CMD_RAW("alf"), Raw(id=40), "no such command"),
        (settings(), topics.CMD_TEXT, Text(text="hi", kind="chat"), "chat is opaque"),
        (settings(), topics.CMD_TEXT, Text(text="hi", kind="request"), "request"),
        (settings(), topics.CMD_TEXT, Text(text=""), "empty text"),
        (settings(), RAW_COMMAND, Raw(id=-1), "0 to 255"),
        (settings(), RAW_COMMAND, Raw(id=256), "0 to 255"),
        (settings(), RAW_COMMAND, Raw(id=70), "may crash"),
        (settings(), RAW_COMMAND, Raw(id=0), "may crash"),
        *[(settings(), RAW_COMMAND, Raw(id=held), "not raw") for held in HELD],
        (NO_JOYSTICK, topics.CMD_DRIVE, Drive(left=1.0), "does not announce joystick"),
        (NO_JOYSTICK, topics.CMD_DRIVE, Drive(turn=1.0), "does not announce joystick"),
        (NO_JOYSTICK, topics.CMD_DRIVE, Drive(), "does not announce joystick"),
        (settings("00010101010001"), topics.CMD_SCAN, FULL_TURN, "lidar_sim"),
    ],
)
def test_what_the_robot_cannot_do_is_refused(announced, topic, command, reason) -> None:
    wire = Wire(announced=announced)
    with pytest.raises(Refused, match=reason):
        wire.robot.command(topic, command, wire.now)
    assert wire.sent() == []


@pytest.mark.parametrize("text", ["Grüße", "x" * 5000])
def test_a_text_the_protocol_cannot_carry_is_refused(wire: Wire, text: str) -> None:
    with pytest.raises(EncodeError):
        wire.robot.command(topics.CMD_TEXT, Text(text=text), wire.now)
    assert wire.sent() == []


def test_a_robot_without_joystick_takes_no_stop() -> None:
    wire = Wire(announced=NO_JOYSTICK)
    with pytest.raises(Refused, match="does not announce joystick"):
        wire.robot.stop(1.0, 2.0)
    assert wire.sent() == []


def test_before_the_first_connection_nothing_can_be_sent() -> None:
    robot = TcpUdpRobot(Options())
    assert robot.driving is None
    with pytest.raises(Refused, match="offline"):
        robot.command(topics.CMD_DRIVE, Drive(), 0.0)
    with pytest.raises(Refused, match="offline"):
        robot.ask(topics.MAP)
    with pytest.raises(Refused, match="offline"):
        robot.stop(0.0, 1.0)


def test_a_robot_is_ready_when_its_session_is_established() -> None:
    robot = TcpUdpRobot(Options())
    assert not robot.ready
    session = robot.session("robot", "")
    session.open(0.0)
    assert not robot.ready
    session.receive(settings(), 0.1)
    assert robot.ready
    session.lost("gone")
    assert not robot.ready


# Simulated lidar data


def polar(
    ranges: list[float],
    angle_min_deg: float = 0.0,
    increment_deg: float = 1.0,
    limits: tuple[float, float] = (0.1, 8.0),
) -> list[float]:
    angles = math.radians(angle_min_deg), math.radians(increment_deg)
    values = polar_ranges(Scan(*angles, *limits, np.array(ranges, np.float32)), 0.01)
    assert values.shape == (360,)
    assert values.dtype == np.float32
    return [round(float(value), 3) for value in values]


@pytest.mark.parametrize(
    ("ranges", "angle_min_deg", "increment_deg", "expected"),
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
def test_a_scan_becomes_360_ranges_a_degree_apart(ranges, angle_min_deg, increment_deg, expected) -> None:
    values = polar(ranges, angle_min_deg, increment_deg)
    assert {degree: values[degree] for degree in expected} == expected


@pytest.mark.parametrize("invalid", [math.nan, math.inf, -math.inf, -1.0, 0.0, 0.05, 8.5])
def test_points_that_are_invalid_or_out_of_range_are_zero(invalid: float) -> None:
    assert polar([2.0] * 10 + [invalid] + [2.0] * 349)[9:12] == [200.0, 0.0, 200.0]


@pytest.mark.parametrize(
    ("angle_min_deg", "increment_deg"),
    [(0.4, 1.0), (-0.4, -1.0), (90 - 1e-7, -1.0), (0.2, 0.5), (-180.0, 1.0), (359.6, 1.0), (1.0, 2.0)],
)
def test_a_full_circle_has_no_hole_wherever_it_begins(angle_min_deg: float, increment_deg: float) -> None:
    assert set(polar([2.0] * round(360 / abs(increment_deg)), angle_min_deg, increment_deg)) == {200.0}


def test_lengths_the_packet_cannot_carry_are_zero() -> None:
    assert polar([3e38, 2.0] * 180, limits=(0.1, 3.3e38)) == [0.0, 200.0] * 180


@pytest.mark.parametrize(
    ("ranges", "increment_deg", "limits"),
    [
        ([], 1.0, (0.1, 8.0)),
        *[([2.0] * 360, increment, (0.1, 8.0)) for increment in (0.0, math.nan, math.inf, -math.inf)],
        *[([2.0] * 360, 1.0, limits) for limits in ((math.nan, 8.0), (0.1, math.nan), (math.nan, math.nan))],
    ],
)
def test_a_scan_without_points_increment_or_limits_is_all_zero(ranges, increment_deg, limits) -> None:
    assert set(polar(ranges, 0.0, increment_deg, limits)) == {0.0}


def test_a_scan_is_sent_as_packet_61_and_shown_as_telemetry(wire: Wire) -> None:
    assert wire.robot.command(topics.CMD_SCAN, FULL_TURN, wire.now).telemetry == ((topics.SCAN, FULL_TURN),)
    assert wire.sent() == [bytes.fromhex("a6050000 02 3d 68010000") + bytes.fromhex("00004843") * 360]
