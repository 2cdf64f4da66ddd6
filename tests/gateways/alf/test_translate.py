"""Units, axes, signs and refusals of ALF, worked out by hand from "Translation" and "The gateway as HQ" of the page."""

import math
import struct
import tomllib
from typing import Any

import numpy as np
import pytest

from gateways.alf import PROTOCOL
from gateways.alf.messages import DriveInfo, Measurement, ScannerInit
from gateways.alf.session import HqRole
from gateways.alf.translate import AlfRobot, Options, points_of, ranges_m
from tests.gateways.rig import planned
from zbridge.app import config
from zbridge.app.templates import robot_template
from zbridge.errors import ConfigError, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Drive,
    FleetMessage,
    Mode,
    Motion,
    Motor,
    Raw,
    Scan,
    Scanner,
    SensorSetting,
    Stop,
    Switch,
    Text,
)
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

STAMP = 1_700_000_000_000_000_000
MS = 1_000_000
INIT = b"2|-135.000000|119.882812|0.351562|100|20|5600;"
BINARY = Options(dialect="binary", points=3)
INIT_BINARY = bytes.fromhex("02 000007c3 00c4ef42 0000b43e 64000000 14000000 e0150000")
"""-135, 119.8828125 and 0.3515625 degrees, 100 ms, 20 and 5600 mm: 726 points."""
LEFT = "left: an ALF vehicle steers, it does not move sideways"


class Wire:
    """A robot with its links connected, what it tells the fleet, and what leaves it."""

    def __init__(self, options: Options | None = None, links: int = 1) -> None:
        self.metrics = Metrics()
        self.robot = AlfRobot(options or Options(points=3), links, self.metrics)
        self.now = 0.0
        self.arrived_ns = STAMP
        self.sessions: list[HqRole] = []
        for link in range(links):
            self.connect(link)

    def connect(self, link: int = 0) -> None:
        session = self.robot.session(self.robot.link_names[link], "tcp://robot.test:1")
        self.sessions[link : link + 1] = [session]
        session.open(self.now)

    def told(self, data: bytes, link: int = 0) -> list[tuple[Topic, FleetMessage]]:
        """What the fleet is told of what came in one read."""
        messages = self.sessions[link].receive(data, self.now)
        return [told for message in messages for told in self.robot.telemetry(message, self.arrived_ns)]

    def scan(self, data: bytes, link: int = 0) -> Scan:
        ((topic, scan),) = self.told(data, link)
        assert topic is topics.SCAN
        assert isinstance(scan, Scan)
        return scan

    def scanner(self, data: bytes = INIT, link: int = 0) -> Scanner:
        ((topic, scanner),) = self.told(data, link)
        assert topic is topics.SCANNER
        assert isinstance(scanner, Scanner)
        return scanner

    def motion(self, data: bytes) -> Motion:
        ((topic, motion),) = self.told(data)
        assert topic is topics.MOTION
        assert isinstance(motion, Motion)
        return motion

    def drive(
        self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0, light: bool | None = None
    ) -> str | None:
        command = Drive(forward=forward, left=left, turn=turn, light=light)
        return self.robot.command(topics.CMD_DRIVE, command, self.now).left_out

    def sent(self, link: int = 0) -> bytes:
        """The one frame that leaves now."""
        frame = self.sessions[link].outgoing(self.now)
        assert frame is not None
        assert self.sessions[link].outgoing(self.now) is None
        self.now += 0.1
        return frame

    def driven(self, forward: float = 0.0, turn: float = 0.0, light: bool | None = None) -> bytes:
        """The one frame that leaves at once when this is commanded."""
        self.drive(forward, 0.0, turn, light)
        return self.sent()


def info(speed: int = 10, temperature: float = 36.5, **values: float) -> DriveInfo:
    names = ("longitudinal", "lateral", "vertical", "gyro_x", "gyro_y", "gyro_z")
    return DriveInfo(speed, *[values.get(name, 0.0) for name in names], temperature)  # type: ignore[call-arg]


def motion_of(robot: AlfRobot, message: DriveInfo) -> Motion:
    ((topic, motion),) = robot.telemetry(message, STAMP)
    assert topic is topics.MOTION
    assert isinstance(motion, Motion)
    return motion


def shown(ranges: Any) -> list[float | None]:
    """Ranges in whole millimetres, NaN as None."""
    return [None if math.isnan(value) else round(float(value) * 1000) for value in ranges]


@pytest.fixture
def wire() -> Wire:
    return Wire()


# Scanner


@pytest.mark.parametrize(
    ("options", "init", "measurement", "angles"),
    [
        (
            Options(points=3),
            INIT,
            b"1|7|5000|1000|2000|5600|0|2;",
            (-2.356194490192345, 2.092349785949368, 0.006135914424896305),
        ),
        (
            BINARY,
            INIT_BINARY,
            bytes.fromhex("01 07000000 88130000 e803000000000000 d007000000000000 e015000000000000 00000000 02000000"),
            (-2.356194490192345, 2.092349794676015, 0.006135923151542565),  # to 119.8828125 by 0.3515625 degrees
        ),
    ],
)
def test_a_scan_has_the_angles_of_its_scanner_on_either_link_its_sequence_and_the_counter_of_the_vehicle(
    options: Options, init: bytes, measurement: bytes, angles: tuple[float, ...]
) -> None:
    wire = Wire(options, links=2)
    scanner = wire.scanner(init, link=1)
    assert (scanner.angle_min, scanner.angle_max, scanner.angle_increment) == pytest.approx(angles)
    assert (scanner.time_increment_s, scanner.range_min, scanner.range_max) == pytest.approx((0.1, 0.02, 5.6))
    scan = wire.scan(measurement, link=0)
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((angles[0], angles[2]))
    assert (scan.range_min, scan.range_max) == pytest.approx((0.02, 5.6))
    assert (scan.seq, scan.device_ms, scan.stamp_ns) == (7, 5000, STAMP)
    assert scan.ranges.dtype == np.float32
    assert scan.ranges.tolist() == pytest.approx([1.0, 2.0, 5.6])


# Scans


def test_the_stamp_of_a_late_measurement_is_when_it_was_taken_and_never_after_it_came(wire: Wire) -> None:
    wire.scanner()
    wire.scan(b"1|0|5000|1000|1000|1000|0|2;")
    wire.arrived_ns = STAMP + 130 * MS
    late = wire.scan(b"1|1|5100|1000|1000|1000|0|2;")
    assert late.stamp_ns == pytest.approx(STAMP + 100 * MS, abs=MS)
    wire.arrived_ns = STAMP + 200 * MS
    on_time = wire.scan(b"1|2|5200|1000|1000|1000|0|2;")
    assert on_time.stamp_ns == pytest.approx(STAMP + 200 * MS, abs=MS)
    assert isinstance(on_time.stamp_ns, int)
    assert on_time.stamp_ns <= wire.arrived_ns


def test_the_counter_of_binary_starts_over_at_32_bits() -> None:
    wire = Wire(BINARY)
    wire.scanner(INIT_BINARY)
    rest = bytes.fromhex("e803000000000000" * 3 + "00000000 02000000")
    wire.scan(bytes.fromhex("01 07000000 ceffffff") + rest)  # 50 ms before the end
    wire.arrived_ns = STAMP + 120 * MS
    scan = wire.scan(bytes.fromhex("01 08000000 32000000") + rest)  # 50 ms behind it
    assert (scan.seq, scan.device_ms) == (8, 50)
    assert scan.stamp_ns == pytest.approx(STAMP + 100 * MS, abs=MS)


def test_a_measurement_before_scanner_init_is_a_protocol_error_and_changes_nothing(wire: Wire) -> None:
    with pytest.raises(ProtocolError, match="before scanner init"):
        wire.told(b"1|7|5000|1000|2000|5600|0|2;")
    wire.scanner()
    wire.scan(b"1|9|5200|1000|2000|5600|0|2;")
    assert wire.sessions[0].state is State.ESTABLISHED


EIGHT = ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600)


FOUR = [1000, 1001, 1002, 1003]


@pytest.mark.parametrize(
    ("points", "limits_mm", "valid", "expected"),
    [
        (FOUR, (20, 5600), (0, 3), FOUR),
        (FOUR, (20, 5600), (1, 2), [None, 1001, 1002, None]),
        (FOUR, (20, 5600), (2, 2), [None, None, 1002, None]),
        (FOUR, (20, 5600), (0, 0), [1000, None, None, None]),
        (FOUR, (20, 5600), (3, 3), [None, None, None, 1003]),
        (FOUR, (20, 5600), (2, 1), [None] * 4),
        (FOUR, (20, 5600), (3, 0), [None] * 4),
        (FOUR, (20, 5600), (4, 4), [None] * 4),
        (FOUR, (20, 5600), (0, 4), FOUR),
        (FOUR, (20, 5600), (1, 2**32 - 1), [None, 1001, 1002, 1003]),
        (FOUR, (20, 5600), (2**32 - 1, 2**32 - 1), [None] * 4),
        (FOUR, (20, 5600), (2**32 - 1, 0), [None] * 4),
        ([0, 1001, 0, 1003], (20, 5600), (0, 3), [None, 1001, None, 1003]),
        ([19, 20, 5600, 5601], (20, 5600), (0, 3), [None, 20, 5600, None]),
        ([1, -1, -1000, 20], (20, 5600), (0, 3), [None, None, None, 20]),
        ([2**31 - 1, 2**62, -(2**63), 2**63 - 1], (20, 5600), (0, 3), [None] * 4),
        # zero is no range, even where the scanner has none as its least
        ([0, 1, 2], (0, 5600), (0, 2), [None, 1, 2]),
        ([0, -20, 2], (-50, 5600), (0, 2), [None, None, 2]),
        # a scanner without any range measures nothing
        ([10, 1000, 6000], (5600, 20), (0, 2), [None] * 3),
    ],
)
def test_nan_is_what_is_0_out_of_range_or_outside_the_valid_indices_which_are_inclusive(
    points: list[int], limits_mm: tuple[int, int], valid: tuple[int, int], expected: list[int | None]
) -> None:
    message = Measurement(0, 0, np.array(points, np.int64), *valid)
    ranges = ranges_m(message, ScannerInit(-135.0, 119.882812, 0.351562, 100, *limits_mm))
    assert shown(ranges) == expected
    assert ranges.dtype == np.float32
    assert message.points.tolist() == points


def test_every_range_is_the_float32_nearest_to_it_so_none_is_beyond_the_largest() -> None:
    millimetres = np.arange(20, 5601)
    ranges = ranges_m(Measurement(0, 0, millimetres, 0, len(millimetres) - 1), EIGHT)
    assert ranges.tolist() == [np.float32(mm / 1000) for mm in millimetres.tolist()]


def test_the_newest_scanner_counts(wire: Wire) -> None:
    wire.scanner()
    wire.scanner(b"2|-90.0|90.0|1.0|100|500|1500;")
    scan = wire.scan(b"1|7|5000|499|500|1501|0|2;")
    assert shown(scan.ranges) == [None, 500, None]
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((-math.pi / 2, math.pi / 180))


# Points


@pytest.mark.parametrize(
    ("angles", "points"),
    [
        ((-135.0, 119.882812, 0.351562), 726),
        ((-90.0, 90.0, 1.0), 181),
        ((90.0, -90.0, -1.0), 181),
        ((10.0, 10.0, 1.0), 1),
        ((-135.0, 120.0, 0.001), None),  # 255001 points
        ((-135.0, 120.0, -1.0), None),
        ((-1e308, 1e308, 1.0), None),
        ((-1.0, 1.0, 5e-324), None),
        ((-3.4e38, 3.4e38, 1e-38), None),
    ],
)
def test_the_geometry_gives_the_points_and_an_absurd_one_is_a_protocol_error(angles, points: int | None) -> None:
    scanner = ScannerInit(*angles, 100, 20, 5600)
    if points is not None:
        assert points_of(scanner) == points
    else:
        with pytest.raises(ProtocolError, match="points"):
            points_of(scanner)


@pytest.mark.parametrize(("from_scanner", "count", "other"), [(False, 769, 726), (True, 726, 769)])
def test_the_number_of_points_is_what_is_configured_or_taken_from_the_scanner(from_scanner, count, other) -> None:
    wire = Wire(Options(points_from_scanner=from_scanner))
    assert wire.scanner().points == count
    assert len(wire.scan(b"1|7|5000|" + b"1000|" * count + b"0|725;").ranges) == count
    assert wire.told(b"1|8|5100|" + b"1000|" * other + b"0|725;") == []
    assert wire.sessions[0].traffic.malformed == 1


BINARY_726 = bytes.fromhex("01 07000000 88130000" + "e803000000000000" * 726 + "00000000 d5020000")


TEXT_726 = b"1|7|5000|" + b"1000|" * 726 + b"0|725;"


@pytest.mark.parametrize(
    ("dialect", "init", "measurement"), [("text", INIT, TEXT_726), ("binary", INIT_BINARY, BINARY_726)]
)
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("cut", [0, 1, 25, 26, 100, 25 + 5824, 25 + 5825])
def test_the_number_of_points_counts_from_the_first_measurement_on_however_the_stream_is_cut(
    cut: int, count: int, dialect: Any, init: bytes, measurement: bytes
) -> None:
    """Binary framing depends on it: a measurement in the same read as its scanner init must not be cut wrong."""
    wire = Wire(Options(dialect=dialect, points_from_scanner=True), links=2)
    stream = init + measurement * count
    told = wire.told(stream[:cut], link=1) + wire.told(stream[cut:], link=1)
    assert [topic for topic, _ in told] == [topics.SCANNER] + [topics.SCAN] * count
    assert wire.sessions[1].traffic.malformed == 0


ABSURD = b"2|-135|120|0.001|100|20|5600;"  # 255001 points


def refuses(wire: Wire, data: bytes, link: int = 0) -> bool:
    """Whether the fleet is told nothing of a message, for it is counted as malformed or untranslatable."""
    malformed = wire.sessions[link].traffic.malformed
    try:
        return wire.told(data, link) == [] and wire.sessions[link].traffic.malformed == malformed + 1
    except ProtocolError:
        return True


@pytest.mark.parametrize("links", [1, 2])
def test_an_absurd_scanner_is_counted_shows_no_scans_and_the_points_stay_as_they_were(links: int) -> None:
    wire = Wire(Options(points=3, points_from_scanner=True), links)
    assert refuses(wire, ABSURD, links - 1)
    assert wire.sessions[links - 1].points == 3
    assert wire.sessions[links - 1].state is State.ESTABLISHED
    assert refuses(wire, b"1|7|5000|1000|2000|5600|0|2;", links - 1), "there was no scanner init that says anything"


# Sequence


def test_gaps_and_duplicates_of_measurements_are_counted_and_visible(wire: Wire) -> None:
    assert "zbridge_sequence_gaps_total 0\n" in wire.metrics.exposition()
    assert "zbridge_sequence_duplicates_total 0\n" in wire.metrics.exposition()
    wire.scanner()
    counts = []
    for sequence in (5, 6, 7, 10, 10, 10, 11, 1011, 0, 1, 3):
        wire.scan(b"1|%d|5000|1000|2000|5600|0|2;" % sequence)
        counts.append((wire.metrics.total("sequence_gaps"), wire.metrics.total("sequence_duplicates")))
    assert counts == [
        *[(0, 0)] * 3,
        *((2, 0), (2, 1), (2, 2), (2, 2)),  # 8 and 9 are missing, 10 came three times
        (1001, 2),  # 12 to 1010
        *[(1001, 2)] * 2,  # a vehicle that was started anew
        (1002, 2),  # 2
    ]
    wire.connect()
    wire.scanner()
    wire.scan(b"1|7|5400|1000|2000|5600|0|2;")  # 4 to 6 were missed while the link was down
    assert "zbridge_sequence_gaps_total 1005\n" in wire.metrics.exposition()
    assert "zbridge_sequence_duplicates_total 2\n" in wire.metrics.exposition()


# Motion


TEXT_INFO = b"4|10|0.250000|-0.500000|1.000000|1.500000|-2.750000|123.456001|36.500000;"
BINARY_INFO = bytes.fromhex("04 0a fa00 0cfe e803 0f00 e5ff d204 00001242")


@pytest.mark.parametrize(
    ("options", "data", "acceleration", "gyro"),
    [
        (
            Options(),
            TEXT_INFO,
            (2.4516625, 4.903325, 9.80665),
            (0.026179938779915, -0.047996554429844, 2.154713698795412),
        ),
        (
            BINARY,
            BINARY_INFO,
            (2.4516625, 4.903325, 9.80665),
            (0.026179938779915, -0.047123889803847, 2.153736296961003),  # 15, -27, 1234
        ),
        (
            Options(acceleration_m_s2=2.0),  # one unit may be set without the other
            TEXT_INFO,
            (0.5, 1.0, 2.0),
            (0.026179938779915, -0.047996554429844, 2.154713698795412),
        ),
        (
            Options(dialect="binary", points=3, acceleration_m_s2=0.5, gyro_rad_s=0.25),
            BINARY_INFO,
            (125.0, 250.0, 500.0),
            (3.75, -6.75, 308.5),
        ),
    ],
)
def test_a_motion_is_in_si_units_y_to_the_left_z_up(options: Options, data: bytes, acceleration, gyro) -> None:
    """In g and degrees per second, in thousandths and tenths of them in binary, unless told otherwise."""
    motion = Wire(options).motion(data)
    assert motion.speed == pytest.approx(0.1)
    assert motion.acceleration == pytest.approx(acceleration)
    assert motion.gyro == pytest.approx(gyro)
    assert (motion.temperature, motion.stamp_ns) == (36.5, STAMP)


def test_speed_is_a_fraction_of_speed_full_and_no_more_than_full_scale_on_the_bus() -> None:
    for full, shown in ((100, [0.0, 0.01, 0.5, 1.0, 1.0, 1.0]), (200, [0.0, 0.005, 0.25, 0.5, 1.0, 1.0])):
        robot = AlfRobot(Options(speed_full=full))
        assert [motion_of(robot, info(speed)).speed for speed in (0, 1, 50, 100, 255, 2**31 - 1)] == shown


def test_speed_is_negative_when_the_last_direction_sent_was_backward(wire: Wire) -> None:
    assert motion_of(wire.robot, info(50)).speed == 0.5
    assert wire.driven(-0.5) == b"3|50|1|0|0;"
    assert motion_of(wire.robot, info(50)).speed == -0.5
    assert motion_of(wire.robot, info(255)).speed == -1.0
    assert str(motion_of(wire.robot, info(0)).speed) == "0.0", "a vehicle that stands has no sign"
    assert wire.driven(0.5) == b"3|50|0|0|0;"
    assert motion_of(wire.robot, info(50)).speed == 0.5
    wire.driven(-0.5)
    wire.connect()
    assert wire.sent() == b"3|0|0|0|0;"
    assert motion_of(wire.robot, info(50)).speed == 0.5, "a new connection was sent no direction yet"


def test_a_vehicle_that_still_rolls_after_a_stop_has_the_sign_of_the_direction_it_was_sent(wire: Wire) -> None:
    for forward in (-0.5, 0.5):
        wire.driven(forward)
        wire.robot.stop(wire.now, wire.now + 1.0)
        direction = wire.sent().split(b"|")[2]
        speed = motion_of(wire.robot, info(20)).speed
        assert speed == (-0.2 if direction == b"1" else 0.2)
        wire.driven(0.0)
        assert motion_of(wire.robot, info(20)).speed == speed


@pytest.mark.parametrize("number", ["1" + "0" * 308, "-1" + "0" * 308])
def test_no_motion_is_infinite(wire: Wire, number: str) -> None:
    try:
        motion = wire.motion(f"4|10|{number}|0|1|0|0|0|36;".encode())
    except (ProtocolError, ValueError):
        return
    assert motion.acceleration is not None
    assert all(map(math.isfinite, motion.acceleration))


# Drives


@pytest.mark.parametrize(
    ("forward", "turn", "text", "binary"),
    [
        (0.0, 0.0, b"3|0|0|0|0;", "03 00 00 5a 00"),
        (1.0, 0.0, b"3|100|0|0|0;", "03 64 00 5a 00"),
        (0.8, 0.0, b"3|80|0|0|0;", "03 50 00 5a 00"),
        (0.8, 1.0, b"3|80|0|-90|0;", "03 50 00 00 00"),  # turning to the left: negative angles are left, 0 full left
        (0.8, -1.0, b"3|80|0|90|0;", "03 50 00 b4 00"),
        (0.8, 1 / 3, b"3|80|0|-30|0;", "03 50 00 3c 00"),
        (0.8, -1 / 3, b"3|80|0|30|0;", "03 50 00 78 00"),
        (0.8, 0.1, b"3|80|0|-9|0;", "03 50 00 51 00"),
        (-1.0, 0.0, b"3|100|1|0|0;", "03 64 01 5a 00"),
        (-0.8, 1.0, b"3|80|1|90|0;", "03 50 01 b4 00"),  # counter-clockwise: backwards the wheels point to the right
        (-0.8, -1.0, b"3|80|1|-90|0;", "03 50 01 00 00"),
        (-0.8, 1 / 3, b"3|80|1|30|0;", "03 50 01 78 00"),
        (0.0, 1.0, b"3|0|0|-90|0;", "03 00 00 00 00"),  # standing: it only sets the wheels
        (0.0, -0.5, b"3|0|0|45|0;", "03 00 00 87 00"),
    ],
)
def test_a_drive_steers_from_minus_90_left_to_90_right_in_text_and_from_0_to_180_in_binary(
    wire: Wire, forward: float, turn: float, text: bytes, binary: str
) -> None:
    assert wire.driven(forward, turn) == text
    assert Wire(BINARY).driven(forward, turn) == bytes.fromhex(binary)


def test_a_vehicle_that_stands_after_going_backwards_only_sets_its_wheels(wire: Wire) -> None:
    wire.driven(-0.8)
    for turn in (1.0, -0.5):
        assert wire.driven(0.0, turn).split(b"|")[1] == b"0"


@pytest.mark.parametrize(("full", "forward", "speed"), [(255, 1.0, 255), (255, -0.2, 51), (50, 0.5, 25), (1, 1.0, 1)])
def test_full_scale_is_a_setting(full: int, forward: float, speed: int) -> None:
    direction = 1 if forward < 0 else 0
    assert Wire(Options(speed_full=full)).driven(forward) == b"3|%d|%d|0|0;" % (speed, direction)
    binary = Wire(Options(dialect="binary", speed_full=full)).driven(forward)
    assert binary == bytes([3, speed, direction, 90, 0])


@pytest.mark.parametrize("forward", [number / 50 - 1 for number in range(101)])
def test_every_drive_stays_within_what_the_wire_carries(wire: Wire, forward: float) -> None:
    binary = Wire(BINARY)
    for turn in (-1.0, -0.999, -0.004, 0.0, 0.33, 1.0):
        _, speed, direction, steering, _ = wire.driven(forward, turn).rstrip(b";").split(b"|")
        assert 0 <= int(speed) <= 100
        assert int(direction) == (1 if forward < 0 else 0)
        assert -90 <= int(steering) <= 90
        assert struct.unpack("BBB", binary.driven(forward, turn)[1:4]) == (
            int(speed),
            int(direction),
            int(steering) + 90,
        )


def test_only_the_drive_link_gets_drives_and_both_give_telemetry() -> None:
    wire = Wire(links=2)
    assert wire.robot.link_names == ("drive", "laser")
    assert wire.robot.driving is wire.sessions[0]
    assert wire.driven(0.5) == b"3|50|0|0|0;"
    wire.sessions[1].lost("closed by peer")
    wire.connect(1)
    assert wire.robot.ready
    assert wire.sent() == b"3|50|0|0|0;", "a lost laser link leaves the drive as it is"
    wire.robot.command(topics.CMD_LIGHT, Switch(on=True), wire.now)
    wire.robot.stop(wire.now, wire.now + 1)
    assert wire.sessions[1].outgoing(wire.now) is None
    assert wire.sessions[1].deadline() is None
    wire.scanner(link=1)
    assert [topic for topic, _ in wire.told(b"4|10|0|0|1|0|0|0|36;", link=1)] == [topics.MOTION]
    wire.connect(1)
    assert wire.sent().startswith(b"3|0|"), "a new laser link stops nothing and repeats nothing else"


def test_a_single_link_has_a_name_of_its_own(wire: Wire) -> None:
    assert (wire.robot.link_names, wire.robot.dialect) == (("vehicle",), "text")
    assert AlfRobot(BINARY).dialect == "binary"


def test_a_robot_takes_commands_while_its_drive_link_is_up_and_before_it_ever_was_none() -> None:
    robot = AlfRobot(Options(), 2)
    robot.session("laser", "tcp://robot.test:2").open(0.0)
    assert (robot.ready, robot.driving) == (False, None)
    for command in (Drive(forward=1.0), Drive()):
        with pytest.raises(Refused, match="offline"):
            robot.command(topics.CMD_DRIVE, command, 0.0)
    with pytest.raises(Refused, match="offline"):
        robot.stop(0.0, 1.0)
    session = robot.session("drive", "tcp://robot.test:1")
    session.open(0.0)
    assert robot.ready
    session.lost("closed by peer")
    assert not robot.ready


# Light


def test_a_light_stays_as_it_was_last_told(wire: Wire) -> None:
    assert wire.driven(0.5) == b"3|50|0|0|0;"
    assert wire.driven(0.5, light=True) == b"3|50|0|0|1;"
    assert wire.driven(0.6) == b"3|60|0|0|1;"
    assert wire.driven() == b"3|0|0|0|1;"
    wire.robot.stop(wire.now, wire.now + 1)
    assert wire.sent() == b"3|0|0|0|1;"
    assert wire.driven(-0.5) == b"3|50|1|0|1;"
    assert wire.driven(light=False).endswith(b"|0;")
    assert wire.driven(0.5) == b"3|50|0|0|0;"


@pytest.mark.parametrize("options", [Options(points=3), BINARY])
def test_a_light_is_switched_on_its_own_the_drive_goes_on_and_nobody_is_moved(options: Options) -> None:
    wire = Wire(options)
    driving, standing = (
        (b"3|80|0|-30|%d;", b"3|0|0|0|%d;")
        if options.dialect == "text"
        else (bytes.fromhex("03 50 00 3c") + b"%c", bytes.fromhex("03 00 00 5a") + b"%c")
    )
    wire.driven(0.8, 1 / 3)
    for on in (True, False, True):
        wire.robot.command(topics.CMD_LIGHT, Switch(on=on), wire.now)
        assert wire.sent() == driving % on
    wire.robot.stop(wire.now, wire.now + 1)
    wire.sent()
    for on in (False, True):
        wire.robot.command(topics.CMD_LIGHT, Switch(on=on), wire.now)
        assert wire.sent() == standing % on


# Stop


@pytest.mark.parametrize("forward", [0.8, -0.8])
@pytest.mark.parametrize(("options", "stop"), [(Options(), b"3|0|0|0|0;"), (BINARY, bytes.fromhex("03 00 00 5a 00"))])
def test_a_stop_is_speed_0_at_once_and_from_then_on_whatever_the_direction_was(options, stop, forward) -> None:
    wire = Wire(options)
    assert wire.sent() == stop, "as soon as it is connected, too"
    wire.driven(forward, 1.0)
    wire.drive(0.9)
    wire.robot.stop(wire.now, wire.now + 1.0)
    assert wire.sent() == stop
    for later in (0.1, 0.5, 2.0, 60.0):
        assert wire.sessions[0].outgoing(wire.now + later) == stop


# What a vehicle cannot do


def test_moving_sideways_only_is_refused_and_changes_nothing_and_left_out_beside_other_motion(wire: Wire) -> None:
    wire.driven(0.5, light=True)
    with pytest.raises(Refused, match=LEFT):
        wire.drive(left=0.5, light=False)
    assert wire.sent() == b"3|50|0|0|1;"
    for forward, turn, text in ((0.6, 0.0, b"3|60|0|0|1;"), (0.0, 1.0, b"3|0|0|-90|1;")):
        assert wire.drive(forward, 0.5, turn) == LEFT
        assert wire.sent() == text
        assert wire.drive(forward, 0.0, turn) is None


@pytest.mark.parametrize(
    ("topic", "command"),
    [
        (topics.CMD_MODE, Mode(mode="autonomous")),
        (topics.CMD_MODE, Mode(mode="none")),
        (topics.CMD_LIDAR, Switch(on=True)),
        (topics.CMD_CAMERA, Switch(on=True)),
        (topics.CMD_TEXT, Text("hello")),
        (topics.CMD_MOTOR("left"), Motor(1.0)),
        (topics.CMD_SENSOR("front"), SensorSetting(enable=True)),
        (topics.CMD_SCAN, Scan(0.0, 0.1, 0.0, 1.0, np.zeros(3, np.float32))),
        (topics.CMD_RAW("alf"), Raw(3, b"80|0|0|1")),
        (topics.CMD_STOP, Stop()),
    ],
)
def test_what_no_message_of_the_protocol_says_is_refused_and_nothing_is_sent(wire: Wire, topic, command) -> None:
    wire.driven(0.5)
    with pytest.raises(Refused, match="ALF"):
        wire.robot.command(topic, command, wire.now)
    assert wire.sent() == b"3|50|0|0|0;"
    for asked in (topics.MAP, topics.POSE):
        with pytest.raises(Refused, match=asked.path):
            wire.robot.ask(asked)


# Options


def test_the_defaults_are_those_of_the_page_and_every_option_can_be_set() -> None:
    assert planned("alf").options == Options() == Options("text", 769, False, 100, None, None, 0.0)
    options = Options("binary", 10_000, True, 255, 0.01, 0.001, 0.02)
    assert planned("alf", 2, **{name: getattr(options, name) for name in options.__struct_fields__}).options == options
    with pytest.raises(ConfigError, match="at most 2 links"):
        planned("alf", 3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dialect", "morse"),
        ("points", 0),
        ("points", 10_001),
        ("points", "769"),
        ("points_from_scanner", 1),
        ("speed_full", 0),
        ("speed_full", 256),
        ("acceleration_m_s2", 0.0),
        ("acceleration_m_s2", -1.0),
        ("gyro_rad_s", 0.0),
        ("gap_s", -0.1),
        ("gap_s", 0.5),
        ("steering_full", 90),
    ],
)
def test_an_option_that_cannot_be_is_an_error_that_names_it(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"device\.options\.{key} = "):
        planned("alf", **{key: value})


def test_the_template_is_a_configuration_with_the_defaults() -> None:
    plan = config.plan(tomllib.loads(robot_template(PROTOCOL).format(name="r1")))
    assert plan.device is not None
    assert plan.device.protocol is PROTOCOL
    assert plan.device.options == Options()
    assert [str(address) for address in plan.device.addresses] == ["tcp://127.0.0.1:6666"]
    for name in Options.__struct_fields__:
        assert f"\n{name} = " in robot_template(PROTOCOL) or f"\n# {name} = " in robot_template(PROTOCOL)


def test_the_units_that_the_template_shows_as_left_out_are_those_of_text() -> None:
    shown = dict(
        line[2:].split("=")[:2]
        for line in robot_template(PROTOCOL).splitlines()
        if line.startswith(("# acc", "# gyro"))
    )
    acceleration, gyro = (float(value.split("#")[0]) for value in shown.values())
    given = motion_of(AlfRobot(Options(acceleration_m_s2=acceleration, gyro_rad_s=gyro)), info(vertical=1, gyro_z=90))
    assert given == motion_of(AlfRobot(Options()), info(vertical=1, gyro_z=90))
    assert given.gyro == pytest.approx((0, 0, math.pi / 2))
