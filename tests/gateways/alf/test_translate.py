"""Units, axes, signs and refusals of ALF, worked out by hand.

Source: "Translation from the robot" and "Translation of commands" of the protocol page.
"""

import contextlib
import math
from typing import Any

import numpy as np
import pytest

from gateways.alf import PROTOCOL
from gateways.alf.messages import AlfDialect, Measurement, ScannerInit
from gateways.alf.session import AlfHqRole
from gateways.alf.translate import AlfOptions, AlfRobot, points_of, ranges_m
from tests.gateways.alf.golden import BINARY, INFO, INIT, NEUTRAL, TEXT
from tests.gateways.rig import planned
from zbridge.errors import ConfigError, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Motor, Raw, Scan, Scanner, Switch
from zbridge.metrics import Metrics

STAMP = 1_700_000_000_000_000_000
MS = 1_000_000


class Wire:
    """A robot with its links connected, what it tells the fleet, and what leaves it."""

    def __init__(self, links: int = 1, **options: Any) -> None:
        self.metrics = Metrics()
        self.robot = AlfRobot(AlfOptions(**{"points": 3, **options}), links, self.metrics)
        self.now = 0.0
        self.arrived_ns = STAMP
        self.sessions: list[AlfHqRole] = []
        for link in range(links):
            self.connect(link)

    def connect(self, link: int = 0) -> None:
        session = self.robot.session(self.robot.link_names[link], "tcp://robot.test:1")
        self.sessions[link : link + 1] = [session]
        session.open(self.now)

    def told(self, data: bytes, link: int = 0) -> list[Any]:
        """What the fleet is told of what came in one read, each on the topic of its class."""
        messages = self.sessions[link].receive(data, self.now)
        told = [one for message in messages for one in self.robot.telemetry(message, self.arrived_ns)]
        assert all(type(message) is topic.message for topic, message in told)
        return [message for _, message in told]

    def one(self, data: bytes, link: int = 0) -> Any:
        (message,) = self.told(data, link)
        return message

    def speed(self, told: int) -> Any:
        """The speed of the motion of a vehicle that tells of this speed."""
        return self.one(b"4|%d|0|0|1|0|0|0|36;" % told).speed

    def command(self, text: str) -> bytes:
        """The one frame that leaves at once: of ``stop``, ``switch on`` or a drive (``forward 0.8 light on``)."""
        words = text.split()
        if text == "stop":
            self.robot.stop(self.now, self.now + 1.0)
        elif words[0] == "switch":
            self.robot.command(topics.CMD_LIGHT, Switch(on=words[1] == "on"), self.now)
        else:
            values = (word == "on" if word in ("on", "off") else float(word) for word in words[1::2])
            fields: dict[str, Any] = dict(zip(words[::2], values, strict=True))
            self.robot.command(topics.CMD_DRIVE, Drive(**fields), self.now)
        return self.sent()

    def sent(self, link: int = 0) -> bytes:
        """The one frame that leaves now."""
        frame = self.sessions[link].outgoing(self.now)
        assert frame is not None
        assert self.sessions[link].outgoing(self.now) is None
        self.now += 0.1
        return frame


def shown_mm(ranges: Any) -> list[float | None]:
    """Ranges in whole millimetres, NaN as None."""
    return [None if math.isnan(value) else round(float(value) * 1000) for value in ranges]


# Scans


def test_a_scan_has_the_geometry_of_the_scanner_on_either_link_its_sequence_and_counter() -> None:
    wire = Wire(links=2, dialect="binary")
    scanner = wire.one(INIT[BINARY], link=1)
    points = "e803000000000000 d007000000000000 e015000000000000"
    scan = wire.one(bytes.fromhex(f"01 07000000 88130000 {points} 00000000 02000000"), link=0)
    angles = (scanner.angle_min, scanner.angle_max, scanner.angle_increment)
    assert angles == pytest.approx((-2.356194490192345, 2.092349794676015, 0.006135923151542565))
    assert (scan.angle_min, scan.angle_increment) == (scanner.angle_min, scanner.angle_increment)
    assert (scan.seq, scan.device_ms, scan.stamp_ns) == (7, 5000, STAMP)
    assert scan.ranges.tolist() == pytest.approx([1.0, 2.0, 5.6])


def test_a_late_measurement_is_stamped_by_the_counter_which_starts_over_at_32_bits_in_binary() -> None:
    wire = Wire(dialect="binary")
    wire.told(INIT[BINARY])
    rest = bytes.fromhex("e803000000000000" * 3 + "00000000 02000000")
    wire.told(bytes.fromhex("01 07000000 ceffffff") + rest)  # 50 ms before the end
    wire.arrived_ns = STAMP + 120 * MS
    scan = wire.one(bytes.fromhex("01 08000000 32000000") + rest)  # 50 ms behind it
    assert (scan.seq, scan.device_ms) == (8, 50)
    assert scan.stamp_ns == pytest.approx(STAMP + 100 * MS, abs=MS)


def test_a_measurement_before_scanner_init_is_a_protocol_error_and_of_two_scanners_the_newest_counts() -> None:
    wire = Wire()
    with pytest.raises(ProtocolError, match="before scanner init"):
        wire.told(b"1|7|5000|1000|2000|5600|0|2;")
    wire.told(INIT[TEXT])
    assert shown_mm(wire.one(b"1|9|5200|499|500|1501|0|2;").ranges) == [499, 500, 1501]
    wire.told(b"2|-90.0|90.0|1.0|100|500|1500;")
    scan = wire.one(b"1|7|5000|499|500|1501|0|2;")
    assert shown_mm(scan.ranges) == [None, 500, None]
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((-math.pi / 2, math.pi / 180))


FOUR = [1000, 1001, 1002, 1003]
URG = (20, 5600)


@pytest.mark.parametrize(
    ("points", "limits_mm", "valid", "expected"),
    [
        (FOUR, URG, (0, 3), FOUR),
        (FOUR, URG, (1, 2), [None, 1001, 1002, None]),
        (FOUR, URG, (2, 2), [None, None, 1002, None]),
        (FOUR, URG, (2, 1), [None] * 4),
        (FOUR, URG, (1, 2**32 - 1), [None, 1001, 1002, 1003]),
        (FOUR, URG, (2**32 - 1, 0), [None] * 4),
        ([0, 19, 20, 5600, 5601], URG, (0, 4), [None, None, 20, 5600, None]),
        ([2**31 - 1, 2**62, -(2**63), 2**63 - 1, -1], URG, (0, 4), [None] * 5),
        # zero is no range, even where the scanner has none as its least
        ([0, -20, 2], (-50, 5600), (0, 2), [None, None, 2]),
        # a scanner without any range measures nothing; one may see far
        ([10, 1000, 6000], (5600, 20), (0, 2), [None] * 3),
        ([19, 20, 200_000, 200_001], (20, 200_000), (0, 3), [None, 20, 200_000, None]),
    ],
)
def test_nan_is_what_is_0_out_of_range_or_outside_the_valid_indices_which_are_inclusive(
    points: list[int], limits_mm: tuple[int, int], valid: tuple[int, int], expected: list[int | None]
) -> None:
    message = Measurement(0, 0, np.array(points, np.int64), *valid)
    ranges = ranges_m(message, ScannerInit(-135.0, 119.882812, 0.351562, 100, *limits_mm))
    assert shown_mm(ranges) == expected
    assert ranges.dtype == np.float32
    assert message.points.tolist() == points


def test_every_range_is_the_float32_nearest_to_it_so_none_is_beyond_the_largest() -> None:
    millimetres = np.arange(20, 5601)
    scanner = ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600)
    ranges = ranges_m(Measurement(0, 0, millimetres, 0, len(millimetres) - 1), scanner)
    assert ranges.tolist() == [np.float32(mm / 1000) for mm in millimetres.tolist()]


def test_gaps_and_duplicates_of_measurements_are_counted_also_over_a_new_connection() -> None:
    wire = Wire()
    wire.told(INIT[TEXT])
    counts = []
    for sequence in (5, 6, 9, 9, 9, 10, 1010, 0, 1, 3):
        wire.told(b"1|%d|5000|1000|2000|5600|0|2;" % sequence)
        counts.append((wire.metrics.total("sequence_gaps"), wire.metrics.total("sequence_duplicates")))
    assert counts == [
        *((0, 0), (0, 0), (2, 0), (2, 1), (2, 2), (2, 2)),  # 7 and 8 are missing, 9 came three times
        *((1001, 2), (1001, 2), (1001, 2), (1002, 2)),  # 11 to 1009; a vehicle that was started anew; 2
    ]
    wire.connect()
    wire.told(INIT[TEXT] + b"1|7|5400|1000|2000|5600|0|2;")  # 4 to 6 were missed while the link was down
    assert "zbridge_sequence_gaps_total 1005\n" in wire.metrics.exposition()
    assert "zbridge_sequence_duplicates_total 2\n" in wire.metrics.exposition()


# Points


@pytest.mark.parametrize(
    ("angles", "points"),
    [
        *(((-135.0, 119.882812, 0.351562), 726), ((90.0, -90.0, -1.0), 181), ((10.0, 10.0, 1.0), 1)),
        *(((-135.0, 120.0, 0.001), None), ((-135.0, 120.0, -1.0), None), ((-1.0, 1.0, 5e-324), None)),
    ],
)
def test_the_geometry_gives_the_points_and_an_absurd_one_is_a_protocol_error(angles, points: int | None) -> None:
    with contextlib.nullcontext() if points else pytest.raises(ProtocolError, match="points"):
        assert points_of(ScannerInit(*angles, 100, 20, 5600)) == points


def test_a_measurement_has_the_points_that_are_configured() -> None:
    wire = Wire(points=769)
    assert wire.one(INIT[TEXT]).points == 769
    assert len(wire.one(b"1|7|5000|" + b"1000|" * 769 + b"0|725;").ranges) == 769
    assert wire.told(b"1|8|5100|" + b"1000|" * 726 + b"0|725;") == []
    assert wire.sessions[0].last_malformed == "measurement of 726 points, expected 769"


@pytest.mark.parametrize(
    ("dialect", "measurement"),
    [
        (TEXT, b"1|7|5000|" + b"1000|" * 726 + b"0|725;"),
        (BINARY, bytes.fromhex("01 07000000 88130000" + "e803000000000000" * 726 + "00000000 d5020000")),
    ],
)
def test_the_points_that_the_scanner_tells_count_from_the_first_measurement_on_however_the_stream_is_cut(
    dialect: AlfDialect, measurement: bytes
) -> None:
    """Binary framing depends on it: a measurement in the same read as its scanner init must not be cut wrong."""
    stream = INIT[dialect] + measurement * 3
    for cut in (0, 1, 25, 26, 100, 25 + 5824, 25 + 5825):
        wire = Wire(links=2, dialect=dialect.value, points_from_scanner=True)
        told = wire.told(stream[:cut], link=1) + wire.told(stream[cut:], link=1)
        assert [type(message) for message in told] == [Scanner] + [Scan] * 3
        assert told[0].points == len(told[1].ranges) == 726
        assert wire.sessions[1].traffic.malformed == 0


def test_an_absurd_scanner_is_counted_shows_no_scans_and_the_points_stay_as_they_were() -> None:
    wire = Wire(points_from_scanner=True)
    assert wire.told(b"2|-135|120|0.001|100|20|5600;") == []  # 255001 points
    assert (wire.sessions[0].points, wire.sessions[0].traffic.malformed) == (3, 1)
    with pytest.raises(ProtocolError, match="before scanner init"):
        wire.told(b"1|7|5000|1000|2000|5600|0|2;")


# Motion


@pytest.mark.parametrize(
    ("options", "acceleration", "gyro"),
    [
        ({"acceleration_m_s2": 2.0}, (0.5, 1.0, 1.975308), (0.026179938779915, -0.047996554429844, 2.154713698795412)),
        (
            {"dialect": "binary"},
            (2.4516625, 4.903325, 9.80665),
            (0.026179938779915, -0.047123889803847, 2.153736296961003),  # 15, -27, 1234
        ),
        ({"dialect": "binary", "acceleration_m_s2": 0.5, "gyro_rad_s": 0.25}, (125, 250, 500), (3.75, -6.75, 308.5)),
    ],
)
def test_a_motion_is_in_si_units_y_to_the_left_z_up(options: dict[str, Any], acceleration, gyro) -> None:
    """In g and degrees per second, in thousandths and tenths of them in binary, unless told otherwise."""
    motion = Wire(**options).one(INFO[AlfDialect(options.get("dialect", "text"))])
    assert motion.speed == pytest.approx(0.1)
    assert motion.acceleration == pytest.approx(acceleration)
    assert motion.gyro == pytest.approx(gyro)
    assert motion.temperature == pytest.approx(36.5, abs=0.03)
    assert motion.stamp_ns == STAMP


def test_speed_is_a_fraction_of_speed_full_both_ways_and_no_more_than_full_scale_on_the_bus() -> None:
    for full, shown in ((100, [0.0, 0.01, 0.5, 1.0, 1.0, 1.0]), (200, [0.0, 0.005, 0.25, 0.5, 1.0, 1.0])):
        wire = Wire(speed_full=full)
        assert [wire.speed(told) for told in (0, 1, 50, 100, 255, 2**31 - 1)] == shown
        assert wire.command("forward 1") == b"3|%d|0|0|0;" % full


def test_speed_is_negative_when_the_last_direction_sent_was_backward_also_while_it_rolls_after_a_stop() -> None:
    wire = Wire()
    assert wire.speed(50) == 0.5
    for command in ("forward -0.5", "stop", "forward 0"):
        wire.command(command)
        assert (wire.speed(50), wire.speed(255)) == (-0.5, -1.0)
        assert str(wire.speed(0)) == "0.0", "a vehicle that stands has no sign"
    wire.command("forward 0.5")
    assert wire.speed(50) == 0.5
    wire.command("forward -0.5")
    wire.connect()
    assert wire.sent() == b"3|0|0|0|0;"
    assert wire.speed(50) == 0.5, "a new connection was sent no direction yet"


# Commands


@pytest.mark.parametrize(
    "talk",
    [
        "forward 0 = 0 0 0 0 / forward 1 = 100 0 0 0 / forward -1 = 100 1 0 0",
        "forward 0.8 turn 1 = 80 0 -90 0 / forward 0.8 turn -0.5 = 80 0 45 0",
        "forward -0.8 turn 1 = 80 1 90 0 / forward -0.8 turn -0.5 = 80 1 -45 0",
        "turn 1 = 0 0 -90 0 / turn -0.5 = 0 0 45 0",
        "forward -0.8 = 80 1 0 0 / turn 1 = 0 1 -90 0 / forward 0.8 = 80 0 0 0",
        "forward 0.8 turn 1 = 80 0 -90 0 / stop = 0 0 0 0",
        "forward -0.8 = 80 1 0 0 / stop = 0 1 0 0",
        "forward 0.8 light on = 80 0 0 1 / forward -0.8 = 80 1 0 1 / stop = 0 1 0 1 / forward 1 = 100 0 0 1",
        "light on = 0 0 0 1 / light off = 0 0 0 0 / forward 0.8 = 80 0 0 0",
        "forward 0.8 turn 0.1 = 80 0 -9 0 / switch on = 80 0 -9 1 / forward 1 = 100 0 0 1 / switch off = 100 0 0 0",
        "switch on = 0 0 0 1 / stop = 0 0 0 1",
        "forward 0.6 left 0.5 = 60 0 0 0 / left 0.5 turn 1 = 0 0 -90 0",
    ],
)
@pytest.mark.parametrize("dialect", AlfDialect)
def test_a_command_leaves_at_once_and_is_repeated(dialect: AlfDialect, talk: str) -> None:
    """Behind each command: speed, direction, degrees to the right (from full left in binary), light."""
    wire = Wire(dialect=dialect.value)
    assert wire.sent() == NEUTRAL[dialect]
    for command, _, expected in (step.partition(" = ") for step in talk.split(" / ")):
        speed, direction, right_deg, light = map(int, expected.split())
        frame = b"3|%d|%d|%d|%d;" % (speed, direction, right_deg, light)
        if dialect is BINARY:
            frame = bytes([3, speed, direction, 90 + right_deg, light])
        assert wire.command(command) == frame
        assert [wire.sent() for _ in range(3)] == [frame] * 3


@pytest.mark.parametrize(
    "talk", ["forward 0.8 turn 1 = 0 0 0 0", "forward -0.8 light on = 0 1 0 1", "switch on = 0 0 0 1"]
)
@pytest.mark.parametrize("dialect", AlfDialect)
def test_the_frames_of_a_stop_are_told_and_change_nothing(dialect: AlfDialect, talk: str) -> None:
    wire = Wire(dialect=dialect.value)
    command, _, expected = talk.partition(" = ")
    frame = wire.command(command)
    speed, direction, right_deg, light = map(int, expected.split())
    text = b"3|%d|%d|%d|%d;" % (speed, direction, right_deg, light)
    stop = bytes([3, speed, direction, 90, light]) if dialect is BINARY else text
    assert wire.robot.stop_frames() == (stop,)
    assert wire.sent() == frame


def test_a_stop_replaces_a_drive_that_waits() -> None:
    wire = Wire()
    wire.robot.command(topics.CMD_DRIVE, Drive(forward=1.0), wire.now)
    assert wire.command("stop") == NEUTRAL[TEXT]


def test_only_the_drive_link_gets_commands_and_both_give_telemetry() -> None:
    wire = Wire(links=2)
    assert (wire.robot.link_names, Wire().robot.link_names) == (("drive", "laser"), ("vehicle",))
    assert (wire.robot.driving, wire.robot.dialect) == (wire.sessions[0], "text")
    assert wire.command("forward 0.5") == b"3|50|0|0|0;"
    wire.sessions[1].fail("closed by peer")
    wire.connect(1)
    assert wire.robot.ready
    assert wire.sent() == b"3|50|0|0|0;", "a lost laser link leaves the drive as it is"
    wire.command("switch on")
    wire.command("stop")
    assert (wire.sessions[1].outgoing(wire.now), wire.sessions[1].deadline()) == (None, None)
    assert [len(wire.told(data, link=1)) for data in (INIT[TEXT], INFO[TEXT])] == [1, 1]


def test_before_its_drive_link_ever_was_up_a_robot_takes_no_command() -> None:
    robot = AlfRobot(AlfOptions(), 2)
    robot.session("laser", "tcp://robot.test:2").open(0.0)
    assert (robot.ready, robot.driving) == (False, None)
    with pytest.raises(Refused, match="offline"):
        robot.command(topics.CMD_DRIVE, Drive(), 0.0)
    with pytest.raises(Refused, match="offline"):
        robot.stop(0.0, 1.0)


def test_what_no_message_of_the_protocol_says_is_refused_and_changes_nothing() -> None:
    wire = Wire()
    wire.command("forward 0.5 light on")
    for topic, command in (
        (topics.CMD_DRIVE, Drive(left=0.5, light=False)),
        (topics.CMD_MODE, Mode(mode="autonomous")),
        (topics.CMD_CAMERA, Switch(on=True)),
        (topics.CMD_MOTOR("left"), Motor(1.0)),
        (topics.CMD_RAW("alf"), Raw(3, b"80|0|0|1")),
    ):
        with pytest.raises(Refused, match="ALF"):
            wire.robot.command(topic, command, wire.now)
        assert wire.sent() == b"3|50|0|0|1;"
    with pytest.raises(Refused, match=topics.MAP.path):
        wire.robot.ask(topics.MAP)


def test_sideways_beside_other_motion_is_said_to_be_left_out() -> None:
    wire = Wire()
    said = [wire.robot.command(topics.CMD_DRIVE, Drive(0.6, left), wire.now).left_out for left in (0.5, 0.0)]
    assert said == ["left: an ALF vehicle steers, it does not move sideways", None]


# Options


def test_the_defaults_are_those_of_the_page_and_every_option_can_be_set_and_is_in_the_template() -> None:
    assert planned("alf").options == AlfOptions("text", 769, False, 100, None, None, 0.0)
    options = AlfOptions("binary", 10_000, True, 255, 0.01, 0.001, 0.02)
    assert planned("alf", 2, **{name: getattr(options, name) for name in options.__struct_fields__}).options == options
    for name in AlfOptions.__struct_fields__:
        assert f"\n{name} = " in PROTOCOL.template or f"\n# {name} = " in PROTOCOL.template
    with pytest.raises(ConfigError, match="at most 2 links"):
        planned("alf", 3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("dialect", "morse"), ("points", 0), ("points", 10_001), ("points", "769"), ("points_from_scanner", 1)),
        *(("speed_full", 0), ("speed_full", 256), ("acceleration_m_s2", 0.0), ("acceleration_m_s2", -1.0)),
        *(("gyro_rad_s", 0.0), ("gap_s", -0.1), ("gap_s", 0.5), ("steering_full", 90)),
    ],
)
def test_an_option_that_cannot_be_is_an_error_that_names_it(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"device\.options\.{key} = "):
        planned("alf", **{key: value})
