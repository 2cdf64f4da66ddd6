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
from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Map, Mode, Pose, Raw, Scan, Stop, Switch, Text
from zbridge.fleet.topics import Topic

STAMP = 1_700_000_000_000_000_000
LISTED = b"\x0b\x00\x00\x001.1,1.2,1.3"
STOP = bytes.fromhex("02000000 02 0d")


def settings(flags: str = "00010101010101", size: int = 0, interval: int = 0) -> bytes:
    tail = bytes.fromhex(flags) + struct.pack("<ii", size, interval)
    return bytes.fromhex("21000000 01 02 02") + LISTED + tail


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

    def map(self, cells: bytes) -> Map:
        topic, shown = self.one(ServerSLAMMap(cells))
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

    def moves(self) -> tuple[float, float, float]:
        """Read the one packet 11 that leaves: x right, y forward, speed."""
        (frame,) = self.sent()
        assert frame[:6] == bytes.fromhex("0e000000 02 0b")
        x, y, speed = struct.unpack("<fff", frame[6:])
        return x, y, speed

    def rotates(self) -> float:
        """Read the one packet 12 that leaves: positive to the right."""
        (frame,) = self.sent()
        assert frame[:6] == bytes.fromhex("06000000 02 0c")
        (speed,) = struct.unpack("<f", frame[6:])
        return float(speed)


@pytest.fixture
def wire() -> Wire:
    return Wire()


# Packets to telemetry


@pytest.mark.parametrize(
    ("x", "y", "degrees", "heading"),
    [
        (150.0, -50.0, 0.0, math.pi / 2),
        (0.0, 0.0, 90.0, math.pi),
        (1.0, 2.0, -90.0, 0.0),
        (0.0, 0.0, 45.0, 2.356194490),
    ],
)
def test_a_pose_is_in_metres_with_x_and_y_kept_and_its_heading_turned_by_a_quarter(
    wire: Wire, x: float, y: float, degrees: float, heading: float
) -> None:
    topic, pose = wire.one(ServerPosition(x, y, degrees))
    assert topic is topics.POSE
    assert isinstance(pose, Pose)
    assert pose.x == pytest.approx(x / 100)
    assert pose.y == pytest.approx(y / 100)
    assert pose.heading == pytest.approx(heading)
    assert pose.stamp_ns == STAMP


def test_the_unit_of_length_and_the_heading_offset_are_options() -> None:
    _, pose = Wire(Options(length_unit_m=0.001, heading_offset=0.0)).one(ServerPosition(150.0, -50.0, 180.0))
    assert pose == Pose(x=0.15, y=-0.05, heading=math.pi, stamp_ns=STAMP)


def test_a_map_is_transposed_from_x_major_to_rows_of_y() -> None:
    shown = Wire(announced=settings(size=30, interval=10)).map(bytes([0, 1, 2, 2, 2, 0, 1, 0, 1]))
    assert (shown.rows, shown.columns) == (3, 3)
    assert shown.cells.tolist() == [[0, 2, 1], [1, 2, 0], [2, 0, 1]]
    assert shown.cell == pytest.approx(0.1)
    assert shown.origin == pytest.approx((-0.15, -0.15))
    assert shown.stamp_ns == STAMP


def test_cells_of_no_known_value_become_unknown(wire: Wire) -> None:
    assert wire.map(bytes([3, 1, 2, 255])).cells.tolist() == [[0, 2], [1, 0]]


@pytest.mark.parametrize(
    ("size", "interval", "cells", "side", "cell"),
    [
        (40, 10, 16, 4, 0.1),
        (45, 10, 16, 4, 0.1),
        (1000, 10, 16, 4, 0.1),  # does not fit the body: the square root
        (0, 0, 16, 4, 0.01),  # nothing announced
        (40, 0, 16, 4, 0.01),
        (0, 5, 16, 4, 0.05),
        (-40, -10, 16, 4, 0.01),
    ],
)
def test_the_side_of_a_map_is_what_was_announced_where_it_fits_else_the_square_root(
    size: int, interval: int, cells: int, side: int, cell: float
) -> None:
    shown = Wire(announced=settings(size=size, interval=interval)).map(bytes(cells))
    assert (shown.rows, shown.columns) == (side, side)
    assert shown.cell == pytest.approx(cell)


def test_the_cell_and_origin_of_a_map_are_options() -> None:
    shown = Wire(Options(map_cell_m=0.25, map_origin=(-1.0, 2.0))).map(bytes(4))
    assert shown.cell == 0.25
    assert shown.origin == (-1.0, 2.0)


@pytest.mark.parametrize("message", [ServerSLAMMap(b""), ServerSLAMMap()])
@pytest.mark.parametrize("announced", [settings(), settings(size=30, interval=10), settings("00000000000000")])
def test_a_map_without_cells_is_an_empty_map(message: Packet, announced: bytes) -> None:
    topic, shown = Wire(announced=announced).one(message)
    assert topic is topics.MAP
    assert isinstance(shown, Map)
    assert (shown.rows, shown.columns, shown.cells.shape) == (0, 0, (0, 0))
    assert shown.origin == (0.0, 0.0)


@pytest.mark.parametrize("cells", [2, 3, 5, 8, 10_001])
def test_a_map_that_is_not_square_is_refused(wire: Wire, cells: int) -> None:
    with pytest.raises(ProtocolError, match=f"map of {cells} cells is not square"):
        wire.map(bytes(cells))


@pytest.mark.parametrize(("mode", "on"), [(1, True), (2, False)])
def test_lidar_status_and_camera_mode_are_switches(wire: Wire, mode: int, on: bool) -> None:
    assert wire.one(ServerLidarStatus(mode)) == (topics.LIDAR, Switch(on=on, stamp_ns=STAMP))
    assert wire.one(ServerCamMode(mode)) == (topics.CAMERA, Switch(on=on, stamp_ns=STAMP))


@pytest.mark.parametrize("mode", [0, 3, -1, 2**31 - 1])
def test_a_mode_that_is_neither_on_nor_off_has_no_meaning(wire: Wire, mode: int) -> None:
    with pytest.raises(ProtocolError, match=f"mode {mode}"):
        wire.one(ServerLidarStatus(mode))
    with pytest.raises(ProtocolError):
        wire.one(ServerCamMode(mode))


def test_a_debug_message_is_a_text(wire: Wire) -> None:
    assert wire.one(DebugMessage("hi")) == (topics.TEXT, Text(text="hi", kind="debug", stamp_ns=STAMP))


def test_a_request_for_simulated_lidar_data_is_a_text_of_that_kind(wire: Wire) -> None:
    topic, text = wire.one(ServerGetSimulatedLidarData())
    assert topic is topics.TEXT
    assert isinstance(text, Text)
    assert text.kind == "request"


def test_chat_and_packets_of_no_table_are_raw(wire: Wire) -> None:
    raw = topics.RAW("tcpudp")
    assert wire.one(ChatMessage(b"\x01")) == (raw, Raw(id=40, body=b"\x01", stamp_ns=STAMP))
    assert wire.one(OpaquePacket(70, b"\x02")) == (raw, Raw(id=70, body=b"\x02", stamp_ns=STAMP))
    assert wire.one(OpaquePacket(200)) == (raw, Raw(id=200, body=b"", stamp_ns=STAMP))


def test_packets_of_the_table_that_no_fleet_message_holds_are_raw(wire: Wire) -> None:
    assert wire.one(ServerUDPConnection(True)) == (topics.RAW("tcpudp"), Raw(id=6, body=b"\x01", stamp_ns=STAMP))


# Drive


@pytest.mark.parametrize(
    ("forward", "left", "x", "y", "speed"),
    [
        (1.0, 0.0, 0.0, 1.0, 1.0),
        (-0.5, 0.0, 0.0, -1.0, 0.5),
        (0.0, 1.0, -1.0, 0.0, 1.0),
        (0.0, -0.25, 1.0, 0.0, 0.25),
        (0.3, 0.4, -0.8, 0.6, 0.5),
        (1.0, 1.0, -0.70710678, 0.70710678, 1.0),  # clipped: the corner is no faster than straight ahead
        (-0.6, -0.8, 0.8, -0.6, 1.0),
    ],
)
def test_translation_becomes_a_direction_x_right_y_forward_and_a_speed(wire: Wire, forward, left, x, y, speed) -> None:
    assert wire.drive(forward, left) is None
    assert wire.moves() == pytest.approx((x, y, speed))


def test_straight_ahead_is_a_plain_zero_to_the_right(wire: Wire) -> None:
    wire.drive(forward=1.0)
    assert wire.sent() == [bytes.fromhex("0e000000 02 0b 00000000 0000803f 0000803f")]


@pytest.mark.parametrize(("turn", "rotate"), [(1.0, -1.0), (-0.5, 0.5)])
def test_a_turn_to_the_left_is_negative_on_the_wire(wire: Wire, turn: float, rotate: float) -> None:
    assert wire.drive(turn=turn) is None
    assert wire.rotates() == pytest.approx(rotate)


def test_full_scale_of_speed_and_turn_are_options() -> None:
    wire = Wire(Options(speed_full=3.0, turn_full=0.5))
    wire.drive(forward=0.5)
    assert wire.moves() == pytest.approx((0.0, 1.0, 1.5))
    wire.drive(forward=1.0, left=1.0)
    assert wire.moves()[2] == pytest.approx(3.0)
    wire.drive(turn=1.0)
    assert wire.rotates() == pytest.approx(-0.5)


def test_exclusive_moves_where_translation_is_the_larger_and_reports_the_turn(wire: Wire) -> None:
    left_out = wire.drive(forward=0.5, turn=0.4)
    assert wire.moves() == pytest.approx((0.0, 1.0, 0.5))
    assert left_out is not None
    assert left_out.startswith("turn")


def test_exclusive_rotates_where_the_turn_is_the_larger_and_reports_the_translation(wire: Wire) -> None:
    left_out = wire.drive(forward=0.3, left=0.4, turn=0.6)
    assert wire.rotates() == pytest.approx(-0.6)
    assert left_out is not None
    assert left_out.startswith("forward and left")


def test_exclusive_compares_the_turn_with_the_whole_translation_and_moves_when_they_are_equal(wire: Wire) -> None:
    wire.drive(forward=0.3, left=0.4, turn=0.5)
    assert wire.moves() == pytest.approx((-0.8, 0.6, 0.5))


def test_both_sends_one_after_the_other_and_leaves_nothing_out() -> None:
    wire = Wire(Options(combine="both"))
    assert wire.drive(left=1.0, turn=0.5) is None
    assert wire.sent() == [
        bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f"),
        bytes.fromhex("06000000 02 0c 000000bf"),
    ]


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
    frames = [wire.session.outgoing(1.0 + 0.25 * step) for step in range(9)]
    assert frames == [bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")] * 9
    assert wire.session.outgoing(3.1) is None


def test_neutral_is_packet_13_repeated_for_a_second(wire: Wire) -> None:
    assert wire.drive() is None
    frames = [wire.session.outgoing(1.0 + 0.25 * step) for step in range(9)]
    assert frames == [STOP] * 5 + [None] * 4


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
    assert wire.session.outgoing(1.0) == bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")
    wire.robot.stop(1.001, 2.001)
    wire.now = 1.002
    wire.drive()
    wire.now = 1.003
    wire.drive(left=-1.0)
    assert wire.sent() == [STOP, bytes.fromhex("0e000000 02 0b 0000803f 00000000 0000803f")]


def test_a_light_is_reported_as_left_out(wire: Wire) -> None:
    left_out = wire.drive(forward=1.0, light=True)
    assert left_out is not None
    assert "light" in left_out
    assert wire.moves()[2] == 1.0


def test_a_light_with_neutral_is_reported_and_neutral_is_sent(wire: Wire) -> None:
    left_out = wire.drive(light=False)
    assert left_out is not None
    assert "light" in left_out
    assert wire.sent() == [STOP]


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
        (topics.CMD_RAW("tcpudp"), Raw(id=21, body=b"\x01\x02"), "04000000 02 15 0102"),
        (topics.CMD_RAW("tcpudp"), Raw(id=40, body=b"\x03"), "03000000 02 28 03"),
    ],
)
def test_a_command_becomes_its_packet(wire: Wire, topic: Topic, command: FleetMessage, packet: str) -> None:
    assert wire.robot.command(topic, command, wire.now).left_out is None
    assert wire.sent() == [bytes.fromhex(packet)]


def test_the_robot_is_asked_for_map_and_pose(wire: Wire) -> None:
    wire.robot.ask(topics.MAP)
    wire.robot.ask(topics.POSE)
    assert wire.sent() == [bytes.fromhex("02000000 02 34"), bytes.fromhex("02000000 02 36")]


@pytest.mark.parametrize(
    ("topic", "command", "reason"),
    [
        (topics.CMD_CAMERA, Switch(on=True), "camera"),
        (topics.CMD_LIGHT, Switch(on=True), "no such command"),
        (topics.CMD_MOTOR("left"), Switch(on=True), "no such command"),
        (topics.CMD_SENSOR("x"), Switch(on=True), "no such command"),
        (topics.CMD_STOP, Stop(), "no such command"),
        (topics.CMD_RAW("alf"), Raw(id=40), "no such command"),
        (topics.CMD_TEXT, Text(text="hi", kind="chat"), "chat is opaque"),
        (topics.CMD_TEXT, Text(text="hi", kind="request"), "request"),
        (topics.CMD_TEXT, Text(text=""), "empty text"),
        (topics.CMD_RAW("tcpudp"), Raw(id=-1), "0 to 255"),
        (topics.CMD_RAW("tcpudp"), Raw(id=256), "0 to 255"),
        (topics.CMD_RAW("tcpudp"), Raw(id=70), "may crash"),
        (topics.CMD_RAW("tcpudp"), Raw(id=0), "may crash"),
        *[
            (topics.CMD_RAW("tcpudp"), Raw(id=known), "not raw")
            for known in (1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 31, 50, 51, 52, 53, 54, 55, 60, 61)
        ],
    ],
)
def test_what_the_robot_cannot_do_is_refused(wire: Wire, topic: Topic, command: FleetMessage, reason: str) -> None:
    with pytest.raises(Refused, match=reason):
        wire.robot.command(topic, command, wire.now)
    assert wire.sent() == []


def test_a_text_the_protocol_cannot_carry_is_refused(wire: Wire) -> None:
    with pytest.raises(EncodeError):
        wire.robot.command(topics.CMD_TEXT, Text(text="Grüße"), wire.now)
    with pytest.raises(EncodeError):
        wire.robot.command(topics.CMD_TEXT, Text(text="x" * 5000), wire.now)
    assert wire.sent() == []


def test_a_forced_raw_packet_is_sent() -> None:
    wire = Wire(Options(force=(70,)))
    wire.robot.command(topics.CMD_RAW("tcpudp"), Raw(id=70, body=b"\x01"), wire.now)
    assert wire.sent() == [bytes.fromhex("03000000 02 46 01")]


def test_a_robot_without_joystick_takes_no_drive_and_no_stop() -> None:
    wire = Wire(announced=settings("00000000000000"))
    for command in (Drive(left=1.0), Drive(turn=1.0), Drive()):
        with pytest.raises(Refused, match="does not announce joystick"):
            wire.robot.command(topics.CMD_DRIVE, command, wire.now)
    with pytest.raises(Refused, match="does not announce joystick"):
        wire.robot.stop(1.0, 2.0)
    assert wire.sent() == []


def test_before_the_first_connection_nothing_can_be_sent() -> None:
    robot = TcpUdpRobot(Options())
    assert robot.driving is None
    assert not robot.ready
    with pytest.raises(Refused, match="offline"):
        robot.command(topics.CMD_DRIVE, Drive(), 0.0)
    with pytest.raises(Refused, match="offline"):
        robot.ask(topics.MAP)
    with pytest.raises(Refused, match="offline"):
        robot.stop(0.0, 1.0)


def test_a_robot_is_ready_when_its_session_is_established() -> None:
    robot = TcpUdpRobot(Options())
    session = robot.session("robot", "")
    session.open(0.0)
    assert not robot.ready
    session.receive(settings(), 0.1)
    assert robot.ready
    session.lost("gone")
    assert not robot.ready


# Simulated lidar data


def scan(
    ranges: list[float],
    angle_min_deg: float = 0.0,
    increment_deg: float = 1.0,
    limits: tuple[float, float] = (0.1, 8.0),
) -> Scan:
    return Scan(
        angle_min=math.radians(angle_min_deg),
        angle_increment=math.radians(increment_deg),
        range_min=limits[0],
        range_max=limits[1],
        ranges=np.array(ranges, np.float32),
    )


def polar(source: Scan) -> list[float]:
    values = polar_ranges(source, 0.01)
    assert values.shape == (360,)
    assert values.dtype == np.float32
    return [round(float(value), 3) for value in values]


def test_a_scan_of_one_point_a_degree_is_only_put_into_the_robots_unit() -> None:
    assert polar(scan([1 + 0.01 * degree for degree in range(360)])) == [100.0 + degree for degree in range(360)]


def test_a_scan_that_begins_behind_the_robot_is_rotated() -> None:
    values = polar(scan([1 + 0.01 * index for index in range(360)], angle_min_deg=-180))
    assert values[0] == 280.0  # straight ahead is index 180
    assert values[180] == 100.0
    assert values[181] == 101.0
    assert values[359] == 279.0


def test_a_clockwise_scan_is_turned_around() -> None:
    values = polar(scan([1 + 0.01 * index for index in range(360)], increment_deg=-1.0))
    assert values[0] == 100.0
    assert values[359] == 101.0
    assert values[90] == 370.0  # 270 degrees clockwise


def test_a_finer_scan_gives_its_nearest_points() -> None:
    values = polar(scan([1 + 0.001 * index for index in range(1440)], increment_deg=0.25))
    assert values[1] == 100.4
    assert values[359] == 243.6


def test_a_coarser_scan_repeats_its_nearest_points() -> None:
    values = polar(scan([1.0, 2.0, 3.0, 4.0], increment_deg=90.0))
    assert values[0] == 100.0
    assert values[44] == 100.0
    assert values[46] == 200.0
    assert values[90] == 200.0
    assert values[180] == 300.0
    assert values[270] == 400.0


def test_degrees_the_scan_does_not_cover_are_zero() -> None:
    values = polar(scan([2.0] * 181, angle_min_deg=-90))
    covered = {degree for degree, value in enumerate(values) if value}
    assert covered == {*range(91), *range(270, 360)}


@pytest.mark.parametrize("invalid", [math.nan, math.inf, -math.inf, -1.0, 0.0, 0.05, 8.5])
def test_points_that_are_invalid_or_out_of_range_are_zero(invalid: float) -> None:
    values = polar(scan([2.0] * 10 + [invalid] + [2.0] * 349))
    assert values[9:12] == [200.0, 0.0, 200.0]


@pytest.mark.parametrize("increment", [0.0, math.nan, math.inf, -math.inf])
def test_a_scan_without_a_usable_increment_is_all_zero(increment: float) -> None:
    source = scan([2.0] * 360)
    broken = Scan(angle_min=0.0, angle_increment=increment, range_min=0.1, range_max=8.0, ranges=source.ranges)
    assert set(polar(broken)) == {0.0}


@pytest.mark.parametrize("increment", [1e-300, -1e-300])
def test_a_scan_whose_points_lie_in_one_direction_covers_that_direction_only(increment: float) -> None:
    ranges = np.full(360, 2.0, np.float32)
    values = polar(Scan(angle_min=0.0, angle_increment=increment, range_min=0.1, range_max=8.0, ranges=ranges))
    assert values == [200.0] + [0.0] * 359


@pytest.mark.parametrize(
    ("increment_deg", "angle_min_deg"),
    [(1.0, 0.4), (-1.0, -0.4), (-1.0, 90 - 1e-7), (0.5, 0.2), (1.0, -180.0), (1.0, 359.6), (2.0, 1.0)],
)
def test_a_full_circle_has_no_hole_wherever_it_begins(increment_deg: float, angle_min_deg: float) -> None:
    source = scan([2.0] * round(360 / abs(increment_deg)), angle_min_deg, increment_deg)
    assert set(polar(source)) == {200.0}


def test_lengths_the_packet_cannot_carry_are_zero() -> None:
    ranges = np.array([3e38, 2.0] * 180, np.float32)
    source = Scan(angle_min=0.0, angle_increment=math.radians(1), range_min=0.1, range_max=3.3e38, ranges=ranges)
    assert polar(source) == [0.0, 200.0] * 180


@pytest.mark.parametrize("limits", [(math.nan, 8.0), (0.1, math.nan), (math.nan, math.nan)])
def test_a_scan_whose_limits_are_no_numbers_is_all_zero(limits: tuple[float, float]) -> None:
    assert set(polar(scan([2.0] * 360, limits=limits))) == {0.0}


def test_an_empty_scan_is_all_zero() -> None:
    assert set(polar(scan([]))) == {0.0}


def test_a_scan_is_sent_as_packet_61_and_shown_as_telemetry(wire: Wire) -> None:
    source = scan([2.0] * 360)
    outcome = wire.robot.command(topics.CMD_SCAN, source, wire.now)
    assert outcome.telemetry == ((topics.SCAN, source),)
    assert wire.sent() == [bytes.fromhex("a6050000 02 3d 68010000") + bytes.fromhex("00004843") * 360]


def test_a_scan_for_a_robot_that_takes_none_is_refused() -> None:
    wire = Wire(announced=settings("00010101010001"))
    with pytest.raises(Refused, match="lidar_sim"):
        wire.robot.command(topics.CMD_SCAN, scan([2.0] * 360), wire.now)
