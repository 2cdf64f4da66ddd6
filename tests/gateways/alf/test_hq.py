"""What HQ programs of ALF are shown and what they command: texts and bytes of the protocol page, written by hand."""

import math
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gateways.alf import messages
from gateways.alf.conformance import parser
from gateways.alf.conformance.parser import VehicleReader as Reader
from gateways.alf.hq import AlfHq, AlfHqOptions
from gateways.alf.messages import AlfDialect, AlfMessage, write_text
from tests.gateways.alf.golden import BINARY, END, INIT, TEXT
from tests.gateways.rig import HqScene, drained
from zbridge.errors import EncodeError, ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Motion, Motor, Scan, Scanner, Status
from zbridge.fleet.view import RobotView
from zbridge.protocol.session import Role, State

NAN, INF = math.nan, math.inf
STAMP = 1_700_000_000_123_456_789
POINTS = 769
TOPICS = {Scan: topics.SCAN, Scanner: topics.SCANNER, Motion: topics.MOTION}
SCANNER = Scanner(-0.75 * math.pi, math.radians(119.882812), math.radians(0.351562), 0.1, 0.02, 5.6, POINTS)
"""The recorded vehicle's."""


def scan_of(
    ranges: Iterable[float], *, angle_min: float = SCANNER.angle_min, step: float = SCANNER.angle_increment, **more: Any
) -> Scan:
    """A scan of the recorded vehicle's scanner, unless told otherwise."""
    return Scan(angle_min, step, 0.02, 5.6, np.array(list(ranges), np.float32), **more)


def turned(count: int) -> Scan:
    """A scan with ``count`` points a turn from straight back, each of its own range: 1 m and its number in mm."""
    step = 2 * math.pi / count
    return scan_of((1 + number / 1000 for number in range(count)), angle_min=-math.pi, step=step, seq=0, device_ms=0)


SCAN = scan_of([1.0] * POINTS)
OTHER_SCAN = scan_of([2.0] * POINTS, angle_min=0.0, step=math.radians(0.25), seq=5, device_ms=6)
EIGHT = Scanner(-math.pi, 0.75 * math.pi, math.pi / 4, 0.05, 0.02, 5.6, 8)


class Scene(HqScene):
    """One listener, what is known of its robot, and its clients."""

    def __init__(self, dialect: AlfDialect = TEXT, *, protocol: str = "alf", clients: int = 1, **options: Any) -> None:
        view = RobotView()
        view.note(topics.STATUS, Status("established", protocol=protocol))
        settings = AlfHqOptions(**{"serve": "both", "dialect": dialect.value, **options})
        super().__init__(AlfHq(settings, view), view)
        for _ in range(clients):
            self.connect()

    def tell(self, *messages: Any) -> None:
        """Let the robot publish something, which the listener follows or does not."""
        for message in messages:
            topic = TOPICS[type(message)]
            self.view.note(topic, message)
            if topic.path in self.side.follows:
                self.send(self.side.show(topic, message))

    def told(self, client: int = 0) -> list[bytes]:
        """What leaves for a client now."""
        return drained(self.clients[client])

    def shown(self, *messages: Any, client: int = 0) -> list[bytes]:
        """What a client is shown of what the robot publishes."""
        self.tell(*messages)
        return self.told(client)


def text_of(points: Iterable[int], *, seq: int = 0, stamp: int = 0, first: int, last: int) -> bytes:
    numbers = (1, seq, stamp, *points, first, last)
    return "|".join(str(number) for number in numbers).encode() + b";"


def fields_of(frame: bytes) -> list[float]:
    """The numbers of a text message behind its id."""
    return [float(number) for number in frame[:-1].split(b"|")[1:]]


# What is said first


@pytest.mark.parametrize("known", [[SCANNER], [SCAN, SCANNER]])
@pytest.mark.parametrize("dialect", AlfDialect)
def test_a_client_is_sent_the_cached_scanner_init_before_anything_else(dialect: AlfDialect, known: list[Any]) -> None:
    scene = Scene(dialect, clients=0)
    scene.tell(*known)
    client = scene.connect()
    init, *others = scene.shown(Motion(), SCAN)
    # in binary the angle is not that of the golden table: 0.351562 has no float32 of its own
    assert init == INIT[dialect].replace(bytes.fromhex("0000b43e"), bytes.fromhex("efffb33e"))
    assert sorted(frame[0] for frame in others) == ([49, 52] if dialect is TEXT else [1, 4])
    assert (client.role, client.state) == (Role.ROBOT, State.ESTABLISHED)


@pytest.mark.parametrize(
    "talk",
    [
        [((SCANNER, SCAN, replace(SCANNER, stamp_ns=1), SCAN), [INIT[TEXT], b"1|"])],
        [
            ((SCANNER,), [INIT[TEXT]]),
            ((SCAN, replace(SCANNER, range_max=4.0)), [b"2|-135.000000|119.882812|0.351562|100|20|4000;"]),
            ((SCAN, OTHER_SCAN), [b"2|-135.000000|", b"2|0.000000|192.000000|0.250000|", b"1|5|6|2000|"]),
        ],
        [((OTHER_SCAN,), [b"2|0.000000|192.000000|0.250000|0|20|5600;", b"1|5|6|2000|"])],
        [((SCAN,), [b"2|", b"1|"]), ((SCANNER,), [INIT[TEXT]])],
        [((EIGHT,), [b"2|-180.000000|135.000000|0.410156"])],  # 315 degrees in 768 steps
    ],
    ids=["the same one once", "another geometry, and what waits of the old one is dropped", "of a scan, without one"]
    + ["one that is learnt after the first scan", "of another number of points"],
)
def test_a_scanner_is_announced_before_its_first_measurement(talk) -> None:
    scene = Scene()
    for published, expected in talk:
        frames = scene.shown(*published)
        assert len(frames) == len(expected)
        assert all(frame.startswith(start) for frame, start in zip(frames, expected, strict=True))


# Measurements


def test_the_number_of_points_is_a_setting_and_a_scan_without_points_is_not_shown() -> None:
    scene = Scene(points=5)
    assert scene.shown(scan_of([])) == []
    init, measurement = scene.shown(turned(9))
    assert init == b"2|-180.000000|140.000000|80.000000|0|20|5600;"
    assert measurement == text_of([1000, 1002, 1004, 1006, 1008], first=0, last=4)


@pytest.mark.parametrize("count", [1, 2, 8, 360, 768, 770, 5000])
def test_a_scan_of_another_size_is_resampled_by_angle(count: int) -> None:
    init, measurement = Scene().shown(turned(count))
    low, high, step, *_ = fields_of(init)
    _, _, *points, first, last = fields_of(measurement)
    source_deg = 360 / count
    assert (len(points), first, last) == (POINTS, 0, 768)
    assert (points[0], points[-1]) == (1000, 999 + count)
    assert (low, high) == (-180, pytest.approx(180 - source_deg, abs=1e-5))
    if count > 1:
        assert low + 768 * step == pytest.approx(high, abs=1e-3)
        announced = low + step * np.arange(POINTS)
        taken = -180 + source_deg * (np.array(points) - 1000)
        assert np.abs(announced - taken).max() <= source_deg / 2 + 1e-3


@pytest.mark.parametrize(
    ("ranges", "points", "first", "last"),
    [
        ([NAN, NAN, 1.5, NAN, 2.5, INF, NAN], [0, 0, 1500, 0, 2500, 0, 0], 2, 4),
        ([-INF, -1.0, 1.0, 2_147_484.0, 1e30], [0, 0, 1000, 0, 0], 2, 2),
        ([NAN] * POINTS, [0] * POINTS, 0, 0),
        ([0.001, 0.333, 1.001, 5.599, 30.0], [1, 333, 1001, 5599, 30_000], 0, 4),
    ],
)
def test_what_was_not_measured_is_0_and_outside_valid_indices_and_every_millimetre_survives_the_bus(
    ranges: list[float], points: list[int], first: int, last: int
) -> None:
    frame = Scene(points=len(points)).shown(scan_of(ranges, seq=1, device_ms=2))[1]
    assert frame == text_of(points, seq=1, stamp=2, first=first, last=last)


def test_sequence_and_stamp_start_anew_at_2_to_the_31() -> None:
    for counter, shown in ((2**31 - 1, 2**31 - 1), (2**31, 0), (2**63 - 1, 2**31 - 1)):
        scan = scan_of([1.0, 1.0], seq=counter, device_ms=counter)
        assert Scene(points=2).shown(scan)[1] == text_of([1000, 1000], seq=shown, stamp=shown, first=0, last=1)


def test_a_robot_without_counters_of_its_own_is_given_some() -> None:
    scene = Scene(points=2)
    scans = (scan_of([1.0, 1.0], stamp_ns=stamp_ns) for stamp_ns in (7_000_000_000, 7_001_000_000, STAMP))
    heads = [tuple(fields_of(scene.shown(scan)[-1])[:2]) for scan in scans]
    assert heads == [(1, 7000), (2, 7001), (3, 1_700_000_000_123 % 2**31)], "wrapped"


# Drive info

G, DEGREE = 9.80665, math.radians(1)
MOVES = Motion(-0.5, (0.25 * G, 0.5 * G, 1.0 * G), (1.5 * DEGREE, -2.7 * DEGREE, 123.4 * DEGREE), 36.5)
MOST = Motion(1.0, (1e6, 1e6, -1e6), (1e6, -1e6, 1e300), 0.0)
REST = b"4|0|0.000000|0.000000|0.000000|0.000000|0.000000|0.000000|0.000000;"


@pytest.mark.parametrize(
    ("dialect", "options", "motion", "shown"),
    [
        # thousandths of g, tenths of a degree; what 16 bits do not hold is the most they hold
        (BINARY, {}, MOVES, bytes.fromhex("04 32 fa00 0cfe e803 0f00 e5ff d204 00001242")),
        (BINARY, {}, MOST, struct.pack("<BB6hf", 4, 100, 32767, -32767, -32767, 32767, -32767, 32767, 0.0)),
        (
            TEXT,
            {"acceleration_m_s2": 1.0, "gyro_rad_s": 0.1},
            Motion(1.0, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), 20.0),
            b"4|100|1.000000|-2.000000|3.000000|1.000000|2.000000|3.000000|20.000000;",
        ),
        (TEXT, {}, Motion(), REST),
        (TEXT, {}, Motion(NAN, (NAN, INF, -INF), (NAN, INF, -INF), NAN), REST),
        (TEXT, {}, Motion(speed=-0.42), REST.replace(b"4|0|", b"4|42|")),
        (TEXT, {}, Motion(speed=1.5), REST.replace(b"4|0|", b"4|100|")),
    ],
)
def test_motion_is_drive_info_in_the_units_of_the_dialect_or_the_settings(dialect, options, motion, shown) -> None:
    assert Scene(dialect, **options).shown(motion) == [shown]


# Nothing that legacy receivers break on

anything = st.floats() | st.floats(-10, 10)
ranges_of = st.lists(st.floats(width=32) | st.floats(0, 10, width=32), max_size=12)
stamps = st.integers(-(2**63), 2**63 - 1)
scans = st.builds(
    lambda low, step, ranges, factor, seq, ms: Scan(
        low, step, low, step, np.array(ranges * factor, np.float32), seq=seq, device_ms=ms
    ),
    *(anything, anything, ranges_of, st.sampled_from([1, 3, 100]), stamps, stamps),
)
scanners = st.builds(Scanner, *[anything] * 6, st.integers(0, 10_000))
vectors = st.none() | st.tuples(anything, anything, anything)
motions = st.builds(Motion, st.none() | anything, vectors, vectors, st.none() | anything)


@pytest.mark.parametrize("dialect", AlfDialect)
@given(history=st.lists(scans | scanners | motions, max_size=8), points=st.sampled_from([2, 12, 769]))
def test_whatever_is_on_the_bus_deployed_receivers_break_on_nothing(dialect, history, points) -> None:
    """An ``EncodeError`` or ``ProtocolError`` is what a listener counts; it sends nothing then."""
    scene, readers = Scene(dialect, points=points), [Reader(dialect.value, points)]
    kinds: list[list[int]] = [[]]
    for message in history:
        try:
            scene.tell(message)
            scene.connect()
            readers.append(Reader(dialect.value, points))
            kinds.append([])
        except (EncodeError, ProtocolError):
            pass
        for client, reader, seen in zip(scene.clients, readers, kinds, strict=True):
            for told in reader.take(b"".join(drained(client))):
                assert (told.problem, told.deadly) == ("", False), told.raw[:100]
                seen.append(told.kind)
            assert reader.rest == b""
    for seen in kinds:
        assert parser.SCAN not in seen or parser.INIT in seen[: seen.index(parser.SCAN)]


# Drive commands


@pytest.mark.parametrize("protocol", ["alf", "wc2ec"])
@pytest.mark.parametrize(
    ("speeds", "others", "drive"),
    [
        ((255, 100), (0, 0, 0), Drive(forward=1.0, light=False)),
        ((1000, 255), (1, 0, 1), Drive(forward=-1.0, light=True)),
        ((51, 20), (0, -90, 0), Drive(forward=0.2, turn=1.0, light=False)),
        ((51, 20), (0, 45, 0), Drive(forward=0.2, turn=-0.5, light=False)),
        ((51, 20), (1, -45, 0), Drive(forward=-0.2, turn=-0.5, light=False)),
        ((51, 20), (1, 90, 0), Drive(forward=-0.2, turn=1.0, light=False)),
        ((0, 0), (1, 0, 0), Drive(light=False)),
    ],
)
def test_a_command_is_a_drive_of_any_robot(speeds, others, drive: Drive, protocol: str) -> None:
    """Full speed is 255 in text and 100 in binary. Others: direction, degrees to the right, light."""
    direction, right_deg, light = others
    text = b"3|%d|%d|%d|%d;" % (speeds[0], *others)
    for dialect, said in ((TEXT, text), (BINARY, bytes([3, speeds[1], direction, 90 + right_deg, light]))):
        told = Scene(dialect, protocol=protocol).says(said)
        assert told == [(topics.CMD_DRIVE, drive)]
        assert "-0.0" not in repr(told)


def test_steering_beyond_full_right_is_full_right_in_binary() -> None:
    assert Scene(BINARY).says(bytes.fromhex("03 32 00 ff 00"))[0][1] == Drive(forward=0.5, turn=-1.0, light=False)


@pytest.mark.parametrize(("protocol", "turn"), [("alf", -0.5), ("wc2ec", 0.0)])
@pytest.mark.parametrize("direction", [b"0", b"1"])
def test_wheels_that_are_set_without_speed_turn_only_a_robot_that_has_some(direction, protocol, turn) -> None:
    """45 degrees to the right; with forward 0 a vehicle only sets its wheels, by -turn, whatever the direction."""
    assert Scene(protocol=protocol).says(b"3|0|%b|45|0;" % direction)[0][1] == Drive(turn=turn, light=False)


def test_a_turn_without_speed_sets_the_wheels_and_is_no_motion() -> None:
    side = Scene().side
    assert all(map(side.is_motion, (Drive(forward=0.1, turn=0.5), Drive(left=0.1), Motor(0.5))))
    assert not any(map(side.is_motion, (Drive(turn=0.5, light=True), Motor(0.0))))
    assert (side.name, side.deadman_s, side.initial_commands()) == ("alf", 0.3, ())


# Drive, laser or both


@pytest.mark.parametrize(
    ("options", "kinds", "driving"),
    [
        ({}, [b"2|", b"1|"], [b"4|"]),
        ({"serve": "both"}, [b"2|", b"1|", b"4|"], [b"1|", b"4|"]),
        ({"serve": "laser"}, [b"2|", b"1|"], [b"1|"]),
        ({"serve": "drive"}, [b"4|"], [b"4|"]),
    ],
)
def test_a_listener_serves_what_it_was_told_to_and_one_of_the_laser_takes_no_drives(options, kinds, driving) -> None:
    """By default the laser until a client drives, from then on drive info: no legacy program tolerates both."""
    scene = Scene(clients=0)
    scene.side = AlfHq(AlfHqOptions(**options), scene.view)
    scene.tell(SCANNER, SCAN)
    client = scene.connect()
    scene.connect()
    frames = scene.shown(*[SCANNER, SCAN, Motion()] * 3)
    assert frames[0].startswith(kinds[0])
    assert sorted(frame[:2] for frame in frames) == sorted(kinds)
    taken = 0 if options.get("serve") == "laser" else 1
    assert len(scene.says(b"3|255|0|0|0;")) == taken
    assert client.left_out.total() == 1 - taken
    for _ in range(3):
        assert sorted(frame[:2] for frame in scene.shown(SCANNER, SCAN, Motion())) == driving
    assert {frame[:2] for frame in scene.told(1)} == set(kinds), "each client for itself"


def test_what_waited_of_the_laser_is_not_sent_to_a_client_that_drives() -> None:
    scene = Scene(serve="auto", clients=0)
    scene.tell(SCANNER)
    scene.connect()
    scene.tell(SCAN)
    scene.says(b"3|0|0|0|0;")
    assert scene.shown(Motion()) == [REST]
    assert scene.shown(replace(SCANNER, angle_min=0.0)) == [], "another geometry is nothing for it either"


@pytest.mark.parametrize("ended_by_hq", [False, True])
@pytest.mark.parametrize("dialect", AlfDialect)
def test_end_is_the_last_word_whatever_waits(dialect: AlfDialect, ended_by_hq: bool) -> None:
    scene = Scene(dialect)
    scene.tell(SCANNER, SCAN, Motion())
    if ended_by_hq:
        scene.says(END[dialect])
    else:
        scene.clients[0].close("gateway stopped", 0.0)
    init, end = scene.told()
    assert (init[:1], end) == (INIT[dialect][:1], END[dialect])
    assert scene.clients[0].state is State.CLOSED


def test_what_waits_is_the_newest_and_encoded_once_however_many_clients_there_are(monkeypatch) -> None:
    encoded: list[str] = []

    def counting(message: AlfMessage) -> bytes:
        encoded.append(message.spec.name)
        return write_text(message)

    monkeypatch.setattr(messages, "write_text", counting)
    scene = Scene(clients=250)
    scene.tell(SCANNER)
    for number in range(10):
        scene.tell(scan_of([1.0] * POINTS, seq=number), Motion(speed=number / 10))
    assert sorted(encoded) == ["drive info"] * 10 + ["measurement"] * 10 + ["scanner init"]
    first, *others = (scene.told(client) for client in range(250))
    assert sorted(frame[:5] for frame in first) == [b"1|9|0", b"2|-13", b"4|90|"]
    assert others == [first] * 249
    assert drained(scene.clients[0], 1000.0) == [], "and once"
