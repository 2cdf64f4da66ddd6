"""What HQ programs of ALF are shown and what they command: texts and bytes of the protocol page, written by hand."""

import math
import struct
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gateways.alf import hq as module
from gateways.alf.conformance.fragile_hq import Reader
from gateways.alf.conformance.parser import INIT, SCAN
from gateways.alf.hq import AlfHq, HqOptions
from gateways.alf.messages import AlfMessage
from gateways.alf.translate import AlfRobot, Options
from tests.captures import payloads, stream
from tests.gateways.rig import HqScene, drained
from zbridge.errors import EncodeError, ProtocolError
from zbridge.fleet import payload as fleet_payload
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Motion, Motor, Scan, Scanner, Status
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.hq.intent import Action, Intent
from zbridge.protocol.session import Role, State

NAN, INF = math.nan, math.inf
STAMP = 1_700_000_000_123_456_789
DIALECTS = ("text", "binary")
POINTS = 769
STEP_DEG = 0.351562

SCANNER = Scanner(
    angle_min=-0.75 * math.pi,
    angle_max=math.radians(119.882812),
    angle_increment=math.radians(STEP_DEG),
    time_increment_s=0.1,
    range_min=0.02,
    range_max=5.6,
    points=POINTS,
    stamp_ns=STAMP,
)
"""The recorded vehicle's."""
INIT_FRAME = {
    "text": b"2|-135.000000|119.882812|0.351562|100|20|5600;",
    "binary": bytes.fromhex("02 00 00 07 c3 00 c4 ef 42 ef ff b3 3e 64 00 00 00 14 00 00 00 e0 15 00 00"),
}
END = {"text": b"255|1;", "binary": bytes.fromhex("ff 01")}
REST_FRAME = b"4|0|0.000000|0.000000|0.000000|0.000000|0.000000|0.000000|0.000000;"


def scan_of(
    ranges: Iterable[float], *, angle_min: float = SCANNER.angle_min, step: float = SCANNER.angle_increment, **more: Any
) -> Scan:
    """A scan of the recorded vehicle's scanner, unless told otherwise."""
    return Scan(angle_min, step, 0.02, 5.6, np.array(list(ranges), np.float32), **more)


def turned(count: int) -> Scan:
    """A scan with ``count`` points a turn from straight back, each of its own range: 1 m and its number in mm."""
    step = 2 * math.pi / count
    return scan_of((1 + number / 1000 for number in range(count)), angle_min=-math.pi, step=step, seq=0, device_ms=0)


class Scene(HqScene):
    """One listener, what is known of its robot, and its clients."""

    def __init__(self, *, protocol: str | None = "alf", clients: int = 1, serve: str = "both", **options: Any) -> None:
        view = RobotView()
        if protocol is not None:
            view.note(topics.STATUS, Status("established", protocol=protocol))
        super().__init__(AlfHq(HqOptions(serve=serve, **options), view), view)  # type: ignore[arg-type]
        for _ in range(clients):
            self.connect()

    def tell(self, topic: Topic, message: FleetMessage) -> None:
        """Let the robot publish something, which the listener follows or does not."""
        self.view.note(topic, message)
        if topic.path in self.side.follows:
            self.send(self.side.show(topic, message))

    def told(self, client: int = 0) -> list[bytes]:
        """What leaves for a client now."""
        return drained(self.clients[client])


def text_of(points: Iterable[int], *, seq: int = 0, stamp: int = 0, first: int, last: int) -> bytes:
    numbers = (1, seq, stamp, *points, first, last)
    return "|".join(str(number) for number in numbers).encode() + b";"


def fields_of(frame: bytes) -> list[float]:
    """The numbers of a text message behind its id."""
    return [float(number) for number in frame[:-1].split(b"|")[1:]]


def points_of(frame: bytes) -> list[int]:
    return [int(number) for number in fields_of(frame)[2:-2]]


# What is said first


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_client_is_sent_the_cached_scanner_init_before_anything_else(dialect: str) -> None:
    scene = Scene(dialect=dialect, clients=0)
    scene.tell(topics.SCANNER, SCANNER)
    client = scene.connect()
    scene.tell(topics.MOTION, Motion())
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    frames = scene.told()
    assert frames[0] == INIT_FRAME[dialect]
    assert sorted(frame[:1] for frame in frames[1:]) == ([b"1", b"4"] if dialect == "text" else [b"\1", b"\4"])
    assert (client.role, client.state) == (Role.ROBOT, State.ESTABLISHED)


def test_a_client_that_came_before_the_scanner_was_known_is_told_once_it_is_and_the_same_scanner_once() -> None:
    scene = Scene()
    assert scene.told() == []
    for stamp in range(3):
        scene.tell(topics.SCANNER, replace(SCANNER, stamp_ns=stamp))
        scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    init, measurement = scene.told()
    assert (init, measurement[:2]) == (INIT_FRAME["text"], b"1|")


def test_another_geometry_is_announced_before_its_first_measurement_and_drops_the_one_that_waits() -> None:
    scene = Scene()
    scene.tell(topics.SCANNER, SCANNER)
    assert scene.told() == [INIT_FRAME["text"]]
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    scene.tell(topics.SCANNER, replace(SCANNER, range_max=4.0))
    assert scene.told() == [b"2|-135.000000|119.882812|0.351562|100|20|4000;"]
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    scene.tell(topics.SCAN, scan_of([2.0] * POINTS, angle_min=0.0, step=math.radians(0.25), seq=5, device_ms=6))
    *_, init, measurement = scene.told()
    assert init.startswith(b"2|0.000000|192.000000|0.250000|")
    assert measurement == text_of([2000] * POINTS, seq=5, stamp=6, first=0, last=768)


def test_a_robot_that_publishes_no_scanner_is_announced_by_its_scan() -> None:
    scene = Scene(protocol="tcpudp")
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS, angle_min=-math.pi / 2, step=math.radians(0.25)))
    init, measurement = scene.told()
    assert init == b"2|-90.000000|102.000000|0.250000|0|20|5600;"
    assert measurement.startswith(b"1|")


@pytest.mark.parametrize("late", [False, True])
def test_a_scanner_that_is_learnt_after_the_first_scan_is_announced_as_it_is(late: bool) -> None:
    scene = Scene(clients=0 if late else 1)
    scan = scan_of([1.0] * POINTS)
    scene.tell(topics.SCAN, scan)
    scene.told() if not late else scene.side.show(topics.SCAN, scan)
    scene.tell(topics.SCANNER, SCANNER)
    if late:
        scene.connect()
    assert scene.told() == [INIT_FRAME["text"]]


# Measurements


def test_a_measurement_in_the_documents_form_is_packed_little_endian() -> None:
    scene = Scene(dialect="binary", points=4)
    scene.tell(topics.SCAN, scan_of([NAN, 0.02, 5.6, NAN], seq=7, device_ms=5000))
    assert scene.told()[1] == (
        bytes.fromhex("01 07000000 88130000")
        + bytes.fromhex("0000000000000000 1400000000000000 e015000000000000 0000000000000000")
        + bytes.fromhex("01000000 02000000")
    )


def test_eight_points_become_769_the_nearest_of_each_angle_and_their_scanner_is_announced_once_as_such() -> None:
    scene = Scene(protocol="wc2ec")
    scan = turned(8)
    geometry = (scan.angle_min, scan.angle_min + 7 * scan.angle_increment, scan.angle_increment)
    scene.tell(topics.SCANNER, Scanner(*geometry, 0.05, 0.02, 5.6, 8))
    assert scene.told() == [b"2|-180.000000|135.000000|0.410156|50|20|5600;"], "315 degrees in 768 steps"
    scene.tell(topics.SCAN, scan)
    (measurement,) = scene.told()
    points = points_of(measurement)
    assert len(points) == POINTS
    assert (points[0], points[54], points[55], points[164], points[165]) == (1000, 1000, 1001, 1001, 1002)
    assert (points[713], points[714], points[768]) == (1006, 1007, 1007)
    assert sorted(points) == points


@pytest.mark.parametrize("count", [1, 2, 3, 8, 360, 720, 768, 770, 1081, 5000])
def test_a_scan_of_another_size_is_resampled_by_angle(count: int) -> None:
    scene = Scene(protocol="tcpudp")
    scan = turned(count)
    scene.tell(topics.SCAN, scan)
    init, measurement = scene.told()
    low, high, step, *_ = fields_of(init)
    points = points_of(measurement)
    source_deg = 360 / count
    assert len(points) == POINTS
    assert low == -180
    assert high == pytest.approx(180 - source_deg, abs=1e-5)
    if count > 1:
        assert low + 768 * step == pytest.approx(high, abs=1e-3)
        announced = low + step * np.arange(POINTS)
        taken = -180 + source_deg * (np.array(points) - 1000)
        assert np.abs(announced - taken).max() <= source_deg / 2 + 1e-3
    assert (points[0], points[-1]) == (1000, 999 + count)
    assert fields_of(measurement)[-2:] == [0, 768]


@pytest.mark.parametrize(
    ("ranges", "points", "first", "last"),
    [
        ([NAN, NAN, 1.5, NAN, 2.5, INF, NAN], [0, 0, 1500, 0, 2500, 0, 0], 2, 4),
        ([-INF, -1.0, 1.0, 2_147_484.0, 1e30], [0, 0, 1000, 0, 0], 2, 2),
        ([NAN] * POINTS, [0] * POINTS, 0, 0),
        *(([mm / 1000] * 2, [mm] * 2, 0, 1) for mm in (1, 19, 20, 333, 1001, 4095, 5599, 5600, 30_000)),
    ],
)
def test_what_was_not_measured_is_0_and_outside_valid_indices_and_every_millimetre_survives_the_bus(
    ranges: list[float], points: list[int], first: int, last: int
) -> None:
    scene = Scene(points=len(points))
    scene.tell(topics.SCAN, scan_of(ranges, seq=1, device_ms=2))
    assert scene.told()[1] == text_of(points, seq=1, stamp=2, first=first, last=last)


def test_the_number_of_points_is_a_setting_and_a_scan_without_points_is_not_shown() -> None:
    scene = Scene(protocol="tcpudp", points=5)
    scene.tell(topics.SCAN, scan_of([]))
    assert scene.told() == []
    scene.tell(topics.SCAN, turned(9))
    init, measurement = scene.told()
    assert init == b"2|-180.000000|140.000000|80.000000|0|20|5600;"
    assert measurement == text_of([1000, 1002, 1004, 1006, 1008], first=0, last=4)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(
    ("counter", "shown"),
    [
        (0, 0),
        (2**31 - 1, 2**31 - 1),
        (2**31, 0),
        (2**31 + 5, 5),
        (2**32 - 1, 2**31 - 1),
        (2**32, 0),
        (2**63 - 1, 2**31 - 1),
    ],
)
def test_sequence_and_stamp_start_anew_at_2_to_the_31(dialect: str, counter: int, shown: int) -> None:
    scene = Scene(dialect=dialect, points=2)
    scene.tell(topics.SCAN, scan_of([1.0, 1.0], seq=counter, device_ms=counter))
    frame = scene.told()[1]
    head = f"1|{shown}|{shown}|1000".encode() if dialect == "text" else struct.pack("<BII", 1, shown, shown)
    assert frame.startswith(head)


def test_a_robot_without_counters_of_its_own_is_given_some() -> None:
    scene = Scene(points=2)
    heads = []
    for stamp_ns in (7_000_000_000, 7_001_000_000, STAMP):
        scene.tell(topics.SCAN, scan_of([1.0, 1.0], stamp_ns=stamp_ns))
        heads.append(tuple(fields_of(scene.told()[-1])[:2]))
    first = heads[0][0]
    assert heads == [(first, 7000), (first + 1, 7001), (first + 2, 1_700_000_000_123 % 2**31)], "wrapped"


def test_of_measurements_and_of_drive_infos_that_wait_the_newest_is_sent() -> None:
    scene = Scene(points=2)
    for number in range(1000):
        scene.tell(topics.SCAN, scan_of([1.0, 1.0], seq=number, device_ms=0))
        scene.tell(topics.MOTION, Motion(speed=number / 1000))
    _, *frames = scene.told()
    assert sorted(frame[:6] for frame in frames) == [b"1|999|", b"4|100|"]
    assert drained(scene.clients[0], 1000.0) == [], "and once"


# Drive info

RECORDED_MOTION = Motion(
    speed=0.1,
    acceleration=(0.25 * 9.80665, 0.5 * 9.80665, 0.987654 * 9.80665),
    gyro=(math.radians(1.5), math.radians(-2.75), math.radians(123.456001)),
    temperature=36.529999,
)
"""The first the recorded vehicle sent: 0.5 g to the left are -0.5 g to the right."""


G, DEGREE = 9.80665, math.radians(1)
IN_UNITS = Motion(speed=1.0, acceleration=(1.0, 2.0, 3.0), gyro=(0.1, 0.2, 0.3), temperature=20.0)


@pytest.mark.parametrize(
    ("options", "motion", "shown"),
    [
        ({}, RECORDED_MOTION, payloads("alf-drive.hex", source=16668)[0].payload),
        (
            {"dialect": "binary"},  # thousandths of g, tenths of a degree
            Motion(-0.5, (0.25 * G, 0.5 * G, 1.0 * G), (1.5 * DEGREE, -2.7 * DEGREE, 123.4 * DEGREE), 36.5),
            bytes.fromhex("04 32 fa00 0cfe e803 0f00 e5ff d204 00001242"),
        ),
        (
            {"acceleration_m_s2": 1.0, "gyro_rad_s": 0.1},
            IN_UNITS,
            b"4|100|1.000000|-2.000000|3.000000|1.000000|2.000000|3.000000|20.000000;",
        ),
        (
            {"dialect": "binary", "acceleration_m_s2": 0.01, "gyro_rad_s": 0.001},
            IN_UNITS,
            struct.pack("<BB6hf", 4, 100, 100, -200, 300, 100, 200, 300, 20.0),
        ),
        (
            {"dialect": "binary"},  # what 16 bits do not hold is the most they hold
            Motion(1.0, (1e6, 1e6, -1e6), (1e6, -1e6, 1e300), 0.0),
            struct.pack("<BB6hf", 4, 100, 32767, -32767, -32767, 32767, -32767, 32767, 0.0),
        ),
        ({}, Motion(), REST_FRAME),
        ({}, Motion(NAN, (NAN, INF, -INF), (NAN, INF, -INF), NAN), REST_FRAME),
    ],
)
def test_motion_is_drive_info_in_the_units_of_the_dialect_or_the_settings(options, motion, shown) -> None:
    scene = Scene(**options)
    scene.tell(topics.MOTION, motion)
    assert scene.told() == [shown]


@pytest.mark.parametrize(("speed", "shown"), [(0.0, 0), (1.0, 100), (-1.0, 100), (-0.42, 42), (1.5, 100), (None, 0)])
def test_the_speed_of_drive_info_is_percent_without_its_sign(speed: float | None, shown: int) -> None:
    scene = Scene()
    scene.tell(topics.MOTION, Motion(speed=speed))
    assert scene.told()[0].startswith(b"4|%d|" % shown)


# Nothing that deployed receivers break on

anything = st.floats() | st.floats(-10, 10)
ranges_of = st.lists(st.floats(width=32) | st.floats(0, 10, width=32), max_size=12)
stamps = st.integers(-(2**63), 2**63 - 1)
scans = st.builds(
    lambda low, step, ranges, factor, seq, ms: Scan(
        low, step, low, step, np.array(ranges * factor, np.float32), seq=seq, device_ms=ms
    ),
    *(anything, anything, ranges_of, st.sampled_from([1, 3, 100]), stamps, stamps),
)
scanners = st.builds(
    Scanner,
    angle_min=anything,
    angle_max=anything,
    angle_increment=anything,
    time_increment_s=anything,
    range_min=anything,
    range_max=anything,
    points=st.integers(0, 10_000),
)
vectors = st.none() | st.tuples(anything, anything, anything)
motions = st.builds(Motion, st.none() | anything, vectors, vectors, st.none() | anything)
published = st.one_of(
    st.tuples(st.just(topics.SCAN), scans),
    st.tuples(st.just(topics.SCANNER), scanners),
    st.tuples(st.just(topics.MOTION), motions),
)


@pytest.mark.parametrize("dialect", DIALECTS)
@given(history=st.lists(published, max_size=8), points=st.sampled_from([2, 12, 769]))
def test_whatever_is_on_the_bus_deployed_receivers_break_on_nothing(dialect, history, points) -> None:
    """An ``EncodeError`` or ``ProtocolError`` is what a listener counts; it sends nothing then."""
    scene, readers = Scene(dialect=dialect, points=points), [Reader(dialect, points)]
    kinds: list[list[int]] = [[]]
    for topic, message in history:
        try:
            scene.tell(topic, message)
            scene.connect()
            readers.append(Reader(dialect, points))
            kinds.append([])
        except (EncodeError, ProtocolError):
            pass
        for client, reader, seen in zip(scene.clients, readers, kinds, strict=True):
            for told in reader.take(b"".join(drained(client))):
                assert (told.problem, told.deadly) == ("", False), told.raw[:100]
                seen.append(told.kind)
            assert reader.rest == b""
    for seen in kinds:
        assert SCAN not in seen or INIT in seen[: seen.index(SCAN)]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_scanner_whose_geometry_is_no_number_is_not_announced(dialect: str) -> None:
    scene = Scene(dialect=dialect, clients=0)
    scene.view.note(topics.SCANNER, Scanner(NAN, INF, 0.1, 0.0, 0.0, 1.0, 769))
    with pytest.raises(EncodeError):  # what a listener counts, where a client begins too
        scene.connect()


# Drive commands


@pytest.mark.parametrize(
    ("said", "drive"),
    [
        (b"3|255|0|0|0;", Drive(forward=1.0, light=False)),
        (b"3|255|0|0|1;", Drive(forward=1.0, light=True)),
        (b"3|51|0|-90|0;", Drive(forward=0.2, turn=1.0, light=False)),
        (b"3|51|0|90|0;", Drive(forward=0.2, turn=-1.0, light=False)),
        (b"3|51|0|-45|0;", Drive(forward=0.2, turn=0.5, light=False)),
        (b"3|51|1|0|0;", Drive(forward=-0.2, light=False)),
        (b"3|51|1|-45|0;", Drive(forward=-0.2, turn=-0.5, light=False)),
        (b"3|51|1|45|1;", Drive(forward=-0.2, turn=0.5, light=True)),
        (b"3|1000|0|0|0;", Drive(forward=1.0, light=False)),
        (b"3|2147483647|1|0|0;", Drive(forward=-1.0, light=False)),
        (b"3|0|0|0|0;", Drive(light=False)),
        (b"3|0|1|0|0;", Drive(light=False)),
        # the document has its own scales
        (bytes.fromhex("03 64 00 5a 00"), Drive(forward=1.0, light=False)),
        (bytes.fromhex("03 32 00 00 01"), Drive(forward=0.5, turn=1.0, light=True)),
        (bytes.fromhex("03 32 00 b4 00"), Drive(forward=0.5, turn=-1.0, light=False)),
        (bytes.fromhex("03 32 00 2d 00"), Drive(forward=0.5, turn=0.5, light=False)),
        (bytes.fromhex("03 32 01 5a 00"), Drive(forward=-0.5, light=False)),
        (bytes.fromhex("03 32 01 2d 00"), Drive(forward=-0.5, turn=-0.5, light=False)),
        (bytes.fromhex("03 32 01 87 00"), Drive(forward=-0.5, turn=0.5, light=False)),
        (bytes.fromhex("03 ff 00 5a 00"), Drive(forward=1.0, light=False)),
        (bytes.fromhex("03 32 00 ff 00"), Drive(forward=0.5, turn=-1.0, light=False)),
        (bytes.fromhex("03 00 01 5a 00"), Drive(light=False)),
    ],
)
@pytest.mark.parametrize("protocol", ["alf", "tcpudp", "wc2ec"])
def test_a_command_is_a_drive_of_any_robot(protocol: str, said: bytes, drive: Drive) -> None:
    ((topic, command),) = Scene(protocol=protocol, dialect="text" if said.endswith(b";") else "binary").says(said)
    assert topic is topics.CMD_DRIVE
    assert command == drive
    assert isinstance(command, Drive)
    assert "-0.0" not in repr(command)


@pytest.mark.parametrize(("protocol", "turn"), [("alf", -0.5), ("tcpudp", 0.0), ("wc2ec", 0.0), (None, 0.0)])
@pytest.mark.parametrize("direction", [0, 1])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_wheels_that_are_set_without_speed_turn_only_a_robot_that_has_some(dialect, direction, protocol, turn) -> None:
    """45 degrees to the right; with forward 0 a vehicle only sets its wheels, by -turn, whatever the direction."""
    said = b"3|0|%d|45|0;" % direction if dialect == "text" else bytes((3, 0, direction, 135, 0))
    ((_, command),) = Scene(protocol=protocol, dialect=dialect).says(said)
    assert command == Drive(turn=turn, light=False)


@pytest.mark.parametrize(
    "bad",
    [
        b"3|10|0|91|0;",
        b"3|10|0|-91|0;",
        b"3|-1|0|0|0;",
        b"3|10|0|0;",
        b"3|10|0|0|0|0;",
        b"3|nan|0|0|0;",
        b"3|99999999999|0|0|0;",
        b"1|0|0|0|0;",
        b"2|0|0|0|0|0|0;",
        b"9|1;",
        b"rubbish;",
        b";",
    ],
)
def test_what_is_no_command_is_counted_and_the_next_one_is_taken(bad: bytes) -> None:
    scene = Scene()
    assert scene.says(bad + b"3|255|0|0|0;") == [(topics.CMD_DRIVE, Drive(forward=1.0, light=False))]
    assert scene.clients[0].traffic.malformed == 1


def test_a_listener_is_auto_unless_told_otherwise_and_says_what_its_programs_are() -> None:
    assert HqOptions().serve == "auto"
    side = Scene().side
    assert (side.name, side.deadman_s, side.initial_commands()) == ("alf", 0.3, ())


@pytest.mark.parametrize(
    ("command", "motion"),
    [
        (Drive(turn=0.5), False),
        (Drive(light=True), False),
        (Drive(forward=0.1, turn=0.5), True),
        (Drive(left=0.1), True),
        (Motor(0.5), True),
        (Motor(0.0), False),
    ],
)
def test_a_turn_without_speed_sets_the_wheels_and_is_no_motion(command: Drive | Motor, motion: bool) -> None:
    assert Scene().side.is_motion(command) is motion


# Drive, laser or both


@pytest.mark.parametrize(
    ("serve", "kinds", "driving"),
    [
        ("auto", [b"2|", b"1|"], [b"4|"]),
        ("both", [b"2|", b"1|", b"4|"], [b"1|", b"4|"]),
        ("laser", [b"2|", b"1|"], [b"1|"]),
        ("drive", [b"4|"], [b"4|"]),
    ],
)
def test_a_listener_serves_what_it_was_told_to_and_one_of_the_laser_takes_no_drives(serve, kinds, driving) -> None:
    scene = Scene(serve=serve, clients=0)
    scene.tell(topics.SCANNER, SCANNER)
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    scene.connect()
    for _ in range(3):
        scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
        scene.tell(topics.MOTION, Motion())
        scene.tell(topics.SCANNER, SCANNER)
    frames = scene.told()
    assert frames[0].startswith(kinds[0])
    assert sorted(frame[:2] for frame in frames) == sorted(kinds)
    taken = 0 if serve == "laser" else 1
    assert len(scene.says(b"3|255|0|0|0;")) == taken
    assert sum(scene.clients[0].left_out.values()) == 1 - taken
    assert sorted(shown(scene)) == driving


def shown(scene: Scene, client: int = 0) -> list[bytes]:
    """The ids of what a client is shown of a robot that measures and moves."""
    scene.tell(topics.SCANNER, SCANNER)
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    scene.tell(topics.MOTION, Motion())
    return [frame[:2] for frame in scene.told(client)]


def test_a_client_is_shown_the_laser_until_it_drives_and_drive_info_from_then_on() -> None:
    """No deployed program bears both: the driving one stops reading, the scanning one takes a 4 as END."""
    scene = Scene(serve="auto", clients=2)
    assert scene.side.follows == ("scan", "scanner", "motion")
    assert shown(scene) == [b"2|", b"1|"]
    assert shown(scene) == [b"1|"], "no 4 however often"
    assert len(scene.says(b"3|0|0|0|0;")) == 1
    assert [shown(scene) for _ in range(3)] == [[b"4|"]] * 3
    assert set(shown(scene, 1)) == {b"2|", b"1|"}, "each client for itself"


def test_what_waited_of_the_laser_is_not_sent_to_a_client_that_drives() -> None:
    scene = Scene(serve="auto", clients=0)
    scene.tell(topics.SCANNER, SCANNER)
    scene.connect()
    scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
    scene.says(b"3|0|0|0|0;")
    scene.tell(topics.MOTION, Motion())
    assert scene.told() == [REST_FRAME]
    other = replace(SCANNER, angle_min=0.0)
    scene.tell(topics.SCANNER, other)
    assert scene.told() == [], "another geometry is nothing for it either"


# END


def test_end_is_said_once_where_both_say_it_and_a_command_behind_it_is_none() -> None:
    scene = Scene()
    assert scene.says(b"3|0|0|0|0;255|1;3|255|0|0|0;") == [(topics.CMD_DRIVE, Drive(light=False))]
    assert (scene.told(), scene.clients[0].reason) == ([b"255|1;"], "ended")
    scene = Scene()
    scene.clients[0].close("gateway stopped", 0.0)
    assert scene.told() == [b"255|1;"]
    assert scene.says(b"3|255|0|0|0;255|1;") == []
    assert scene.told() == []


@pytest.mark.parametrize("ended_by_hq", [False, True])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_end_is_the_last_word_whatever_waits(dialect: str, ended_by_hq: bool) -> None:
    scene = Scene(dialect=dialect)
    client = scene.clients[0]
    scene.tell(topics.SCANNER, SCANNER)
    for _ in range(2):
        scene.tell(topics.SCAN, scan_of([1.0] * POINTS))
        scene.tell(topics.MOTION, Motion())
    if ended_by_hq:
        scene.says(END[dialect])
    else:
        client.close("gateway stopped", 0.0)
    frames = scene.told()
    assert frames[-1] == END[dialect]
    assert frames.count(END[dialect]) == 1
    assert client.state is State.CLOSED


# Many clients


@pytest.mark.parametrize(("dialect", "writer"), [("text", "write_text"), ("binary", "write_binary")])
def test_a_message_is_encoded_once_however_many_clients_there_are(dialect, writer, monkeypatch) -> None:
    write: Callable[[AlfMessage], bytes] = getattr(module, writer)
    encoded: list[str] = []

    def counting(message: AlfMessage) -> bytes:
        encoded.append(message.spec.name)
        return write(message)

    monkeypatch.setattr(module, writer, counting)
    scene = Scene(dialect=dialect, clients=0)
    scene.tell(topics.SCANNER, SCANNER)
    for _ in range(250):
        scene.connect()
    for number in range(10):
        scene.tell(topics.SCAN, scan_of([1.0] * POINTS, seq=number))
        scene.tell(topics.MOTION, Motion(speed=number / 10))
    assert sorted(encoded) == ["drive info"] * 10 + ["measurement"] * 10 + ["scanner init"]
    first = scene.told(0)
    assert len(first) == 3
    assert all(scene.told(client) == first for client in range(1, 250))


# The recorded HQ programs


def test_the_recorded_hq_says_neutral_acquires_with_its_first_motion_and_keeps_the_robot_to_its_end() -> None:
    scene, commands, done = Scene(), [], []
    intent = Intent(scene.side.deadman_s)
    for record in payloads("alf-drive.hex", destination=16668):
        now = record.seconds
        intent.heard(now)
        for _, command in scene.says(record.payload):
            assert isinstance(command, Drive)
            commands.append(command)
            done.append(intent.motion(now) if command.moving else intent.neutral(now))
            if done[-1] is Action.ACQUIRE:
                assert (record.payload, now) == (b"3|80|0|30|1;", 0.5049)
            if intent.asking and now > 0.6:
                intent.granted(3.0)
    neutral, right = Drive(light=False), Drive(forward=80 / 255, turn=-30 / 90, light=True)
    assert commands == [neutral] * 25 + [right] * 90
    assert scene.clients[0].traffic.malformed == 0
    assert done[:25] == [Action.NOTHING] * 25
    asked = done[25:].count(Action.WAIT)
    assert done[25:] == [Action.ACQUIRE] + [Action.WAIT] * asked + [Action.SEND] * (89 - asked)
    assert 3 <= asked <= 6, "what came in a tenth of a second, every 20 ms"
    assert not intent.wants_release(2.3017 + 2.6)
    assert intent.wants_release(2.3017 + 2.71)


def test_the_recorded_laser_hq_takes_init_and_measurements_and_answers_the_end() -> None:
    scene = Scene(serve="laser", clients=0)
    scene.tell(topics.SCANNER, SCANNER)
    client = scene.connect()
    frames = scene.told()
    assert frames == [payloads("alf-laser.hex", source=16667)[0].payload]
    recorded = [record.payload for record in payloads("alf-laser.hex", source=16667)[1:-1]]
    for number, payload in enumerate(recorded):
        ranges = [(1000 + number + at) / 1000 for at in range(POINTS)]
        scene.tell(topics.SCAN, scan_of(ranges, seq=number, device_ms=5000 + 100 * number))
        (shown,) = scene.told()
        assert shown == payload.replace(b"|44|725;", b"|0|768;"), "here the whole of it has ranges"
    client.close("gateway stopped", 0.7032)
    assert drained(client, 0.7032) == [b"255|1;"]
    (answer,) = payloads("alf-laser.hex", destination=16667)
    assert answer.payload == b"255|1;"
    assert scene.says(answer.payload) == []
    assert drained(client, 0.7039) == []
    assert client.state is State.CLOSED
    assert client.traffic.malformed == 0


@pytest.mark.parametrize("name", ["alf-drive.hex", "alf-laser.hex"])
def test_what_a_recorded_vehicle_sent_passes_the_bus_and_reaches_an_hq_as_it_was(name: str) -> None:
    """All but the points outside the valid indices: on the bus they have no range, here they are 0."""
    port = 16668 if name == "alf-drive.hex" else 16667
    robot, scene = AlfRobot(Options(), 2), Scene()
    session = robot.session("drive", "tcp://robot.test:1")
    session.open(0.0)
    written = b""
    for record in payloads(name, source=port):
        for message in session.receive(record.payload, record.seconds):
            for topic, telemetry in robot.telemetry(message, STAMP):
                scene.tell(topic, fleet_payload.decode(topic.message, fleet_payload.encode(telemetry)))
            written += b"".join(scene.told())
    scene.clients[0].close("robot gone", 3.0)
    written += b"".join(drained(scene.clients[0], 3.0))
    expected = []
    for frame in stream(name, source=port).split(b";"):
        fields = frame.split(b"|")
        if fields[0] == b"1":
            fields[3:47], fields[729:772] = [b"0"] * 44, [b"0"] * 43
        expected.append(b"|".join(fields))
    assert written == b";".join(expected)
