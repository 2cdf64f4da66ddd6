"""Names, units, kinematics and refusals of WC2EC, worked out by hand from the page and the design."""

import math
import struct
import tomllib
from typing import Any

import numpy as np
import pytest

from gateways.wc2ec import PROTOCOL
from gateways.wc2ec.session import ExternalRole
from gateways.wc2ec.settings import Options
from gateways.wc2ec.translate import Wc2EcRobot
from tests.gateways.rig import planned
from tests.gateways.wc2ec.golden import DISTANCE, LINEAR, ROTATIONAL, data, light, registration
from zbridge.app import config
from zbridge.app.templates import robot_template
from zbridge.errors import ConfigError, EncodeError, ProtocolError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Device,
    Devices,
    Drive,
    FleetMessage,
    Mode,
    Motor,
    Raw,
    Reading,
    Scan,
    SensorSetting,
    Switch,
    Text,
)
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

STAMP = 1_700_000_000_000_000_000
WHEELS: dict[str, Any] = {
    "differential": {
        "left": ["fl", "rl"],
        "right": ["fr", "rr"],
        "wheel_radius_m": 0.05,
        "track_m": 0.3,
        "speed_full_m_s": 0.5,
        "turn_full_rad_s": 1.0,
    }
}
FACTORS: dict[str, Any] = {
    "factors": {"fl": {"forward": 10.0, "left": -4.0, "turn": -3.0}, "fr": {"forward": 10.0, "left": 4.0, "turn": 3.0}}
}
NAN, INF = math.nan, math.inf


def options_of(**options: Any) -> Options:
    made = planned("wc2ec", **options).options
    assert isinstance(made, Options)
    return made


def draft(count: int = 2, **options: Any) -> Options:
    devices = [{"name": f"light{number}", "number": number} for number in range(count)]
    return options_of(**{"dialect": "draft", "devices": devices, **options})


CAR = b"".join(
    [
        registration(ROTATIONAL, 0, b"fl"),
        registration(ROTATIONAL, 1, b"fr"),
        registration(ROTATIONAL, 2, b"rl"),
        registration(ROTATIONAL, 3, b"rr"),
        registration(LINEAR, 4, b"lift"),
        registration(DISTANCE, 5, b"front"),
    ]
)


class Wire:
    """A robot that is connected, what it tells the fleet, and what leaves it."""

    def __init__(self, options: Options | None = None, greeting: bytes = b"") -> None:
        self.metrics = Metrics()
        self.robot = Wc2EcRobot(options or options_of(), 1, self.metrics)
        self.now = 0.0
        self.session: ExternalRole
        self.begun: tuple[tuple[Topic, FleetMessage], ...] = ()
        self.connect()
        if greeting:
            self.told(greeting)

    def connect(self) -> None:
        self.session = self.robot.session("robot", "tcp://robot.test:1")
        self.session.open(self.now)
        if self.session.state is State.ESTABLISHED:
            self.begun = self.robot.begun(STAMP)

    def told(self, received: bytes) -> list[tuple[Topic, FleetMessage]]:
        """What the fleet is told of what came in one read."""
        before = self.session.state
        messages = self.session.receive(received, self.now)
        assert self.session.traffic.malformed == 0
        told = [told for message in messages for told in self.robot.telemetry(message, STAMP)]
        if before is not State.ESTABLISHED and self.session.state is State.ESTABLISHED:
            self.robot.begun(STAMP)
        return told

    def table(self, received: bytes) -> tuple[Device, ...]:
        """The device table after this."""
        tables = [message for topic, message in self.told(received) if topic is topics.DEVICES]
        assert isinstance(tables[-1], Devices)
        return tables[-1].devices

    def reading(self, received: bytes) -> tuple[str, Reading]:
        """The key and the one reading that this is."""
        ((topic, reading),) = self.told(received)
        assert isinstance(reading, Reading)
        return topic.path, reading

    def scans(self, received: bytes) -> list[Scan]:
        return [message for _, message in self.told(received) if isinstance(message, Scan)]

    def drive(self, **fields: Any) -> str | None:
        return self.robot.command(topics.CMD_DRIVE, Drive(**fields), self.now).left_out

    def motor(self, name: str, value: float) -> None:
        self.robot.command(topics.CMD_MOTOR(name), Motor(value=value), self.now)

    def set(self, name: str, **fields: Any) -> None:
        self.robot.command(topics.CMD_SENSOR(name), SensorSetting(**fields), self.now)

    def frames(self) -> list[bytes]:
        """What leaves now."""
        frames = []
        while (frame := self.session.outgoing(self.now)) is not None:
            frames.append(frame)
            assert len(frames) < 2000
        return frames

    def values(self) -> dict[int, float]:
        """The motors' last values among what leaves now, by number; every frame is a command to a motor."""
        values = {}
        for frame in self.frames():
            command, kind, number, value = struct.unpack("<BBBd", frame)
            assert (command, kind) in ((130, ROTATIONAL), (130, LINEAR))
            values[number] = value
        return values

    def later(self, seconds: float) -> None:
        self.now += seconds
        self.session.expire(self.now)


@pytest.fixture
def wire() -> Wire:
    return Wire(greeting=CAR + data(5, 1.0))


@pytest.fixture
def car() -> Wire:
    return Wire(options_of(**WHEELS), CAR + data(5, 1.0))


# Readings


@pytest.mark.parametrize("kind", [0, 37, 46, 99, 255])
def test_a_reading_of_any_type_is_on_the_key_of_its_name_with_kind_device_and_stamp(wire: Wire, kind: int) -> None:
    expected = Reading(value=750.5, kind="distance", device=5, fault=False, stamp_ns=STAMP)
    assert wire.reading(data(5, 750.5, kind)) == ("sensor/front", expected)


@pytest.mark.parametrize(
    ("name", "chunk"),
    [
        (b"inf_left", "inf_left"),
        (b"A-z.0_9", "A-z.0_9"),
        (b"left wheel", "left%20wheel"),
        (b"a/b", "a%2Fb"),
        (b"*", "%2A"),
        (b"**", "%2A%2A"),
        (b"#1", "%231"),
        (b"@cmd", "%40cmd"),
        (b"100%", "100%25"),
        (b"%2F", "%252F"),
        (b"", "%"),
        (b"%", "%25"),
        (b"\xff\xfe", "%FF%FE"),
        (b"\x00", "%00"),
        ("größe".encode(), "gr%C3%B6%C3%9Fe"),
        (b"n" * 255, "n" * 255),
        (b"\xff" * 255, "%FF" * 255),
    ],
)
def test_a_name_is_escaped_in_its_key_and_its_motor_is_found_by_it(name: bytes, chunk: str) -> None:
    wire = Wire(greeting=registration(DISTANCE, 7, name))
    path, reading = wire.reading(data(7, 1.0))
    assert path == f"sensor/{chunk}"
    assert reading.device == 7
    moved = Wire(greeting=registration(ROTATIONAL, 8, name) + data(7, 1.0))
    topic = topics.find(f"@cmd/motor/{chunk}")
    assert topic is not None
    moved.robot.command(topic, Motor(value=1.5), 0.0)
    assert moved.frames() == [bytes.fromhex("82 35 08 000000000000f83f")]


def test_names_that_differ_have_keys_that_differ_and_every_name_can_be_shown() -> None:
    names = [b"", b"%", b"%25", b"a/b", b"a%2Fb", b"\xff", b"%FF", b"A", b"a", b"a ", b"\xc3\xbf", b"\x00", b"n" * 255]
    wire, paths = Wire(greeting=registration(DISTANCE, 255, b"first")), set()
    for number, name in enumerate(names):
        for _, message in wire.told(registration(DISTANCE, number, name)):
            assert payloads.decode(type(message), payloads.encode(message)) == message
        paths.add(wire.reading(data(number, 1.0))[0])
        with pytest.raises(Refused) as caught:
            wire.robot.command(topics.CMD_MOTOR(name.decode("utf-8", "surrogateescape")), Motor(value=1.0), 0.0)
        assert str(caught.value).encode()
    assert len(paths) == len(names)


def test_numbers_mean_nothing_but_where_they_are_told_to() -> None:
    """The numbers of node types move with the Webots version."""
    wire = Wire(options_of(motor_types={"rotational": [60], "linear": [61, 62]}))
    table = wire.table(b"".join(registration(kind, kind, b"k%d" % kind) for kind in (53, 46, 60, 61, 62, 38, 99)))
    kinds = {entry.name: entry.kind for entry in table}
    assert (kinds["k60"], kinds["k61"], kinds["k62"], kinds["k38"]) == ("rotational", "linear", "linear", "distance")
    assert not {kinds["k53"], kinds["k46"], kinds["k99"]} & {"rotational", "linear"}
    for name in ("k53", "k46", "k99", "k38"):
        with pytest.raises(Refused):
            wire.motor(name, 1.0)
    wire.motor("k60", 1.5)
    wire.motor("k62", 1.5)
    assert wire.frames() == [bytes.fromhex("82 3c 3c 000000000000f83f"), bytes.fromhex("82 3e 3e 000000000000f83f")]


def test_motors_may_be_listed_by_name_whatever_their_type() -> None:
    wire = Wire(options_of(motors={"rotational": ["arm"], "linear": ["front", "fl"]}), CAR)
    kinds = {entry.name: entry.kind for entry in wire.table(registration(99, 77, b"arm"))}
    assert (kinds["arm"], kinds["front"], kinds["fl"], kinds["fr"]) == ("rotational", "linear", "linear", "rotational")


def test_data_before_registration_is_shown_under_its_number_and_counted() -> None:
    wire = Wire()
    path, reading = wire.reading(data(9, 4.5))
    assert path == "sensor/distance-9"
    assert (reading.value, reading.device, reading.kind) == (4.5, 9, "distance")
    wire.reading(data(9, 4.5))
    assert wire.metrics.total("sensor_unregistered") == 2
    wire.told(registration(DISTANCE, 9, b"late"))
    assert wire.reading(data(9, 4.5))[0] == "sensor/late"
    assert wire.metrics.total("sensor_unregistered") == 2


def test_an_error_of_a_device_is_a_text(wire: Wire) -> None:
    ((topic, text),) = wire.told(bytes.fromhex("7f 25 05"))
    assert topic is topics.TEXT
    assert isinstance(text, Text)
    assert "5" in text.text


def test_deployed_measures_without_being_asked_and_without_kinematics_a_drive_is_refused(wire: Wire) -> None:
    assert wire.robot.on_demand == ()
    with pytest.raises(Refused, match="kinematics"):
        wire.drive(forward=0.5)
    assert wire.frames() == []


# The device table


def test_the_device_table_is_a_state_that_grows_with_every_registration() -> None:
    wire = Wire()
    assert topics.DEVICES.qos.keeps_last
    assert wire.table(registration(ROTATIONAL, 3, b"wheel")) == (Device("wheel", 3, "rotational"),)
    assert wire.table(registration(DISTANCE, 1, b"eye") + registration(LINEAR, 0, b"lift")) == (
        Device("wheel", 3, "rotational"),
        Device("eye", 1, "distance"),
        Device("lift", 0, "linear"),
    )


def test_a_name_that_is_taken_is_reported_and_its_second_device_is_name_number() -> None:
    wire = Wire(greeting=registration(DISTANCE, 1, b"eye"))
    told = wire.told(registration(DISTANCE, 7, b"eye") + registration(ROTATIONAL, 8, b"eye"))
    texts = [message.text for topic, message in told if topic is topics.TEXT and isinstance(message, Text)]
    assert len(texts) == 2
    assert "'eye'" in texts[0]
    assert "1 and 7" in texts[0]
    assert "eye#7" in texts[0]
    (devices,) = [message for _, message in told if isinstance(message, Devices)][-1:]
    assert [entry.name for entry in devices.devices] == ["eye", "eye#7", "eye#8"]
    assert [wire.reading(data(number, 1.0))[0] for number in (1, 7)] == ["sensor/eye", "sensor/eye%237"]
    wire.motor("eye#8", 1.5)
    assert wire.values() == {8: 1.5}
    with pytest.raises(Refused):
        wire.motor("eye", 1.5)


def test_a_device_that_is_called_like_the_second_of_another_name_loses_nothing() -> None:
    """However the names are chosen, every device has a key of its own and every motor moves by its own name alone."""
    names = [b"arm#3", b"arm", b"arm"]
    wire = Wire()
    table = wire.table(b"".join(registration(ROTATIONAL, number + 1, name) for number, name in enumerate(names)))
    assert len({entry.name for entry in table}) == 3
    assert table[0] == Device("arm#3", 1, "rotational")
    wire.told(data(1, 0.0))
    paths = {wire.reading(data(number, 1.0))[0] for number in (1, 2, 3)}
    assert len(paths) == 3
    wire.motor("arm#3", 1.5)
    assert wire.values() == {1: 1.5}


def test_a_number_that_is_registered_twice_is_a_protocol_error_and_changes_nothing(wire: Wire) -> None:
    for name in (b"front", b"other"):
        with pytest.raises(ProtocolError, match="device 5 registered again"):
            wire.told(registration(DISTANCE, 5, name))
    assert wire.session.state is State.ESTABLISHED
    assert wire.reading(data(5, 1.0))[0] == "sensor/front"
    assert [entry.name for entry in wire.table(registration(DISTANCE, 6, b"more"))].count("front") == 1


def test_a_new_connection_begins_with_a_fresh_table() -> None:
    wire = Wire(greeting=CAR + data(5, 1.0))
    wire.session.lost("closed by peer")
    wire.connect()
    with pytest.raises(Refused):
        wire.motor("fl", 1.0)
    assert wire.frames() == []
    assert wire.table(registration(DISTANCE, 0, b"fl")) == (Device("fl", 0, "distance"),)
    assert wire.reading(data(0, 1.0))[0] == "sensor/fl"
    with pytest.raises(Refused):
        wire.motor("fl", 1.0)
    assert wire.reading(data(5, 1.0))[0] == "sensor/distance-5"


# Faults


TO_1000: dict[str, Any] = {"bounds_default": [0.0, 1000.0]}
FRONT_TO_5000: dict[str, Any] = {"bounds": {"front": [-1.0, 5000.0]}, **TO_1000}


@pytest.mark.parametrize(
    ("options", "number", "value", "fault"),
    [
        *((TO_1000, 5, value, False) for value in (0.0, 500.0, 1000.0)),
        *((TO_1000, 5, value, True) for value in (-0.001, 1000.001, -1.0, NAN, INF, -INF)),
        *((FRONT_TO_5000, 5, value, False) for value in (-1.0, 5000.0)),
        (FRONT_TO_5000, 5, 5000.5, True),
        (FRONT_TO_5000, 99, 1001.0, True),  # the others have the default
        ({"bounds": {"front": [0.0, 0.0]}}, 5, 0.5, True),
        ({"bounds": {"front": [0.0, 0.0]}}, 5, 0.0, False),
        ({}, 5, -1e300, False),
        *(({}, 5, value, True) for value in (NAN, INF)),
    ],
)
def test_a_value_outside_the_bounds_is_published_with_fault_and_counted(options, number, value, fault) -> None:
    wire = Wire(options_of(**options), CAR)
    _, reading = wire.reading(data(number, value))
    assert reading.fault is fault
    assert repr(reading.value) == repr(value)
    assert wire.metrics.total("sensor_faults") == fault


# Lookup tables


FALLING: dict[str, Any] = {"tables": {"front": [[0.0, 1.0], [1000.0, 0.02]]}}
BENT: dict[str, Any] = {"tables": {"front": [[0, 0], [10, 1], [30, 5]]}}


@pytest.mark.parametrize(
    ("options", "number", "value", "shown"),
    [
        *((FALLING, 5, value, shown) for value, shown in ((0.0, 1.0), (250.0, 0.755), (500.0, 0.51), (1000.0, 0.02))),
        *((FALLING, 5, value, shown) for value, shown in ((-50.0, 1.0), (2000.0, 0.02))),  # it ends where it ends
        *((BENT, 5, value, shown) for value, shown in ((5.0, 0.5), (20.0, 3.0))),
        (BENT, 6, 20.0, 20.0),  # it is of one sensor
        ({**FALLING, **TO_1000}, 5, 1000.0, 0.02),  # the bounds are of what the sensor said
        ({**FALLING, **TO_1000}, 5, 1500.0, 1500.0),  # a fault is not looked up
    ],
)
def test_a_lookup_table_of_a_sensor_interpolates_what_is_no_fault(options, number, value, shown) -> None:
    wire = Wire(options_of(**options), CAR + registration(DISTANCE, 6, b"back"))
    assert wire.reading(data(number, value))[1].value == pytest.approx(shown)


# Scan from bearings

RING = b"".join(registration(DISTANCE, number, b"ds%d" % number) for number in range(4))
EVEN: dict[str, Any] = {"bearings_deg": {"ds0": -90.0, "ds1": 0.0, "ds2": 90.0}, "scan_range_m": [0.1, 2.0]}


def test_a_scan_comes_beside_the_readings_when_every_sensor_with_a_bearing_has_a_new_value() -> None:
    wire = Wire(options_of(**EVEN), RING)
    assert wire.scans(data(0, 0.5) + data(1, 1.0) + data(3, 9.0)) == []
    (path, _), (topic, first) = wire.told(data(2, 1.5))
    assert (path.path, topic) == ("sensor/ds2", topics.SCAN)
    assert isinstance(first, Scan)
    assert first.angle_min == pytest.approx(-math.pi / 2)
    assert first.angle_increment == pytest.approx(math.pi / 2)
    assert (first.range_min, first.range_max) == (0.1, 2.0)
    assert first.ranges.dtype == np.float32
    assert first.stamp_ns == STAMP
    assert wire.scans(data(2, 1.25) + data(1, 1.0)) == []
    (scan,) = wire.scans(data(0, 0.25))
    assert scan.ranges.tolist() == pytest.approx([0.25, 1.0, 1.25])
    assert first.ranges.tolist() == pytest.approx([0.5, 1.0, 1.5]), "what was published does not change any more"


def test_a_scan_is_in_metres_by_the_lookup_table_and_nan_where_it_measures_nothing() -> None:
    table = [[0.0, 0.0], [1000.0, 4.0]]
    options = options_of(**EVEN, bounds_default=[0.0, 1000.0], tables={f"ds{n}": table for n in range(3)})
    wire = Wire(options, RING)
    (scan,) = wire.scans(data(0, 250.0) + data(1, 20.0) + data(2, 500.0))
    assert scan.ranges[[0, 2]].tolist() == pytest.approx([1.0, 2.0])
    assert math.isnan(scan.ranges[1]), "0.08 m is nearer than range_min"
    (scan,) = wire.scans(data(0, -1.0) + data(1, 250.0) + data(2, 750.0))
    assert math.isnan(scan.ranges[0]), "a fault"
    assert scan.ranges[1] == pytest.approx(1.0)
    assert math.isnan(scan.ranges[2]), "3 m is beyond range_max"


def test_bearings_that_are_not_evenly_spread_are_a_point_a_degree() -> None:
    wire = Wire(options_of(bearings_deg={"ds0": 10.0, "ds1": 0.0, "ds2": -20.0, "ds3": 12.0}), RING)
    (scan,) = wire.scans(data(0, 1.0) + data(1, 2.0) + data(2, 3.0) + data(3, 4.0))
    assert scan.angle_min == pytest.approx(math.radians(-20))
    assert scan.angle_increment == pytest.approx(math.radians(1))
    assert len(scan.ranges) == 33
    there = {place: float(value) for place, value in enumerate(scan.ranges) if not math.isnan(value)}
    assert there == {0: 3.0, 20: 2.0, 30: 1.0, 32: 4.0}


@pytest.mark.parametrize(
    ("bearings", "angle_min", "step"),
    [([45.0 * number for number in range(8)], 0.0, math.pi / 4), ([90.0], math.pi / 2, None)],
    ids=["the ring of the simulated robot", "one point"],
)
def test_bearings_that_are_evenly_spread_are_a_point_each(bearings, angle_min, step) -> None:
    wire = Wire(options_of(bearings_deg={f"ds{number}": bearing for number, bearing in enumerate(bearings)}))
    registrations = b"".join(registration(DISTANCE, number, b"ds%d" % number) for number in range(len(bearings)))
    (scan,) = wire.scans(registrations + b"".join(data(number, 1.0 + number) for number in range(len(bearings))))
    assert scan.angle_min == pytest.approx(angle_min)
    assert step is None or scan.angle_increment == pytest.approx(step)
    assert scan.ranges.tolist() == [1.0 + number for number in range(len(bearings))]


def test_a_scan_after_a_reconnect_holds_nothing_from_before() -> None:
    wire = Wire(options_of(**EVEN), RING)
    wire.scans(data(0, 0.5) + data(1, 0.5))
    wire.session.lost("closed by peer")
    wire.connect()
    wire.told(RING)
    assert wire.scans(data(2, 1.5)) == []
    (scan,) = wire.scans(data(0, 1.0) + data(1, 1.0))
    assert scan.ranges.tolist() == pytest.approx([1.0, 1.0, 1.5])


# Motors


def test_a_motor_is_set_by_its_name(wire: Wire) -> None:
    for name, value, sent in (
        ("fr", 1.5, "82 35 01 000000000000f83f"),
        ("lift", 0.25, "82 2e 04 000000000000d03f"),
        ("fl", 0.0, "82 35 00 0000000000000000"),
    ):
        wire.motor(name, value)
        assert wire.frames() == [bytes.fromhex(sent)]


def test_a_full_table_of_255_devices() -> None:
    wire = Wire(greeting=b"".join(registration(ROTATIONAL, number, b"m%d" % number) for number in range(254)))
    assert len(wire.table(registration(DISTANCE, 254, b"eye") + data(254, 1.0))) == 255
    wire.motor("m253", 1.5)
    assert wire.values() == {253: 1.5}
    wire.robot.stop(0.0, 1.0)
    assert wire.values() == dict.fromkeys(range(254), 0.0), "every rotational motor is stopped at once"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, 1.0) for name in ("front", "nobody", "", "FL", "fl ", "#1", "0", "distance-5", "rotational-0")),
        *(("fl", value) for value in (NAN, INF, -INF)),
    ],
)
def test_what_is_no_motor_or_no_number_is_refused_and_never_sent(wire: Wire, name: str, value: float) -> None:
    """After a 130 to a device that is no motor, or is unknown, every later command is stuck."""
    with pytest.raises((Refused, EncodeError)):
        wire.motor(name, value)
    assert wire.frames() == []


@pytest.mark.parametrize("greeting", [data(9, 1.0, ROTATIONAL), RING + data(0, 1.0)])
def test_a_robot_without_registered_motors_has_nothing_to_move_and_nothing_to_stop(greeting: bytes) -> None:
    wire = Wire(greeting=greeting)
    with pytest.raises(Refused):
        wire.motor("rotational-9", 1.0)
    wire.robot.stop(0.0, 1.0)
    assert wire.frames() == []


@pytest.mark.parametrize(
    ("topic", "command"),
    [
        (topics.CMD_MODE, Mode(mode="manual")),
        (topics.CMD_LIGHT, Switch(on=True)),
        (topics.CMD_LIDAR, Switch(on=True)),
        (topics.CMD_CAMERA, Switch(on=True)),
        (topics.CMD_TEXT, Text(text="hello")),
        (topics.CMD_RAW("wc2ec"), Raw(id=130, body=b"\x35\x00")),
    ],
)
def test_what_a_webots_robot_does_not_have_is_refused(wire: Wire, topic: Topic, command: FleetMessage) -> None:
    with pytest.raises(Refused):
        wire.robot.command(topic, command, 0.0)
    assert wire.frames() == []
    for asked in (topics.RPC_MAP, topics.RPC_POSE):
        with pytest.raises(Refused):
            wire.robot.ask(asked)


def test_before_the_first_connection_everything_is_refused() -> None:
    robot = Wc2EcRobot(options_of(**WHEELS))
    assert (robot.driving, robot.ready) == (None, False)
    for topic, command in ((topics.CMD_DRIVE, Drive(forward=0.5)), (topics.CMD_MOTOR("fl"), Motor(value=1.0))):
        with pytest.raises(Refused):
            robot.command(topic, command, 0.0)


# Drive


FAST: dict[str, Any] = {
    "differential": {**WHEELS["differential"], "speed_full_m_s": 2.0, "turn_full_rad_s": 0.5, "wheel_radius_m": 0.1}
}


@pytest.mark.parametrize(
    ("options", "command", "left", "right"),
    [
        (WHEELS, {"forward": 1.0}, 10.0, 10.0),  # 0.5 m/s on wheels of 0.05 m
        (WHEELS, {"forward": -0.5}, -5.0, -5.0),
        (WHEELS, {"turn": 1.0}, -3.0, 3.0),  # 1 rad/s, 0.15 m from the middle, on wheels of 0.05 m
        (WHEELS, {"turn": -0.5}, 1.5, -1.5),
        (WHEELS, {"forward": 0.5, "turn": 0.5}, 3.5, 6.5),
        (WHEELS, {"forward": -1.0, "turn": 1.0}, -13.0, -7.0),
        (WHEELS, {}, 0.0, 0.0),
        (FAST, {"forward": 0.5, "turn": 1.0}, 9.25, 10.75),  # 1 m/s and 0.5 rad/s: (1 -+ 0.075) / 0.1
        (FACTORS, {"forward": 1.0}, 10.0, 10.0),
        (FACTORS, {"left": 0.5}, -2.0, 2.0),
        (FACTORS, {"turn": 0.5}, -1.5, 1.5),
        (FACTORS, {"forward": 0.5, "left": -0.25, "turn": -1.0}, 9.0, 1.0),
        (FACTORS, {}, 0.0, 0.0),
    ],
)
def test_a_drive_is_what_two_sides_of_wheels_or_factors_make_of_it(options, command, left, right) -> None:
    car = Wire(options_of(**options), CAR + data(5, 1.0))
    assert car.drive(**command) is None
    rear = {} if options is FACTORS else {2: left, 3: right}
    assert car.values() == pytest.approx({0: left, 1: right, **rear})
    car.later(10.0)
    assert car.frames() == [], "a value holds until the next one"


def test_sideways_is_refused_by_two_sides_of_wheels_and_left_out_like_a_light_beside_other_motion(car: Wire) -> None:
    with pytest.raises(Refused, match="left"):
        car.drive(left=0.5)
    assert car.frames() == []
    for more, said in (({"left": 0.5}, "left"), ({"light": True}, "light")):
        assert said in (car.drive(forward=1.0, **more) or "")
        assert car.values() == pytest.approx({0: 10.0, 2: 10.0, 1: 10.0, 3: 10.0})


@pytest.mark.parametrize(("kind", "name"), [(DISTANCE, b"fl"), (LINEAR, b"fl"), (ROTATIONAL, b"other")])
def test_a_drive_is_refused_whole_where_one_of_its_motors_is_missing_or_none(kind: int, name: bytes) -> None:
    others = b"".join(registration(ROTATIONAL, n, wheel) for n, wheel in ((1, b"fr"), (2, b"rl"), (3, b"rr")))
    car = Wire(options_of(**WHEELS), registration(kind, 0, name) + others + data(5, 1.0))
    with pytest.raises(Refused, match="fl"):
        car.drive(forward=0.5)
    assert car.frames() == []


def test_the_newest_drive_wins_where_the_link_was_slow(car: Wire) -> None:
    for number in range(200):
        car.drive(forward=number / 200)
    assert len(car.frames()) == 4
    car.drive(forward=0.5)
    assert set(car.values().values()) == {5.0}


# Stop


def test_a_stop_needs_no_kinematics_sets_every_rotational_motor_to_0_and_leaves_the_linear_ones(wire: Wire) -> None:
    wire.motor("lift", 0.25)
    wire.motor("rr", 5.0)
    wire.frames()
    wire.robot.stop(0.0, 1.0)
    assert wire.frames() == [bytes((0x82, 0x35, number)) + bytes(8) for number in (0, 1, 2, 3)]


def test_a_stop_is_repeated_for_a_second_and_a_routine_one_sent_to_every_motor_exactly_once(car: Wire) -> None:
    stopped = {0: 0.0, 1: 0.0, 2: 0.0, 3: 0.0}
    for _ in range(3):
        car.robot.stop(car.now, car.now)
        assert car.values() == stopped
        for _ in range(20):
            car.later(0.05)
            assert car.frames() == []
    start, rounds = car.now, 0
    car.robot.stop(start, start + 1.0)
    while car.now < start + 3.0:
        values = car.values()
        rounds += bool(values)
        assert values == {} or (values == stopped and car.now <= start + 1.01)
        car.later(0.01)
    assert 5 <= rounds <= 60


def test_a_stop_goes_before_what_waits_and_that_is_forgotten(car: Wire) -> None:
    """The link took nothing for a while: the last word to the wheel is the stop's."""
    for waiting in (lambda: car.drive(forward=1.0), lambda: car.motor("fl", 5.0)):
        waiting()
        car.robot.stop(car.now, car.now + 1.0)
        assert car.values() == {0: 0.0, 1: 0.0, 2: 0.0, 3: 0.0}


@pytest.mark.parametrize("motor", [False, True])
def test_a_command_after_a_stop_ends_its_repetition_for_its_motors(car: Wire, motor: bool) -> None:
    """Whoever acquired anew within the second in which the stop is repeated drives."""
    car.robot.stop(car.now, car.now + 1.0)
    car.frames()
    car.later(0.05)
    if motor:
        car.motor("fl", 5.0)
        assert car.values()[0] == 5.0
    else:
        car.drive(forward=1.0)
        assert set(car.values().values()) == {10.0}
    for _ in range(20):
        car.later(0.1)
        assert 0 not in car.values()


def test_a_motor_command_after_a_drive_is_the_last_word_to_its_motor(car: Wire) -> None:
    car.drive(forward=1.0)
    car.motor("fl", 5.0)
    assert car.values() == {0: 5.0, 1: 10.0, 2: 10.0, 3: 10.0}
    car.motor("fl", 6.0)
    car.drive(forward=0.5)
    assert car.values() == {0: 5.0, 1: 5.0, 2: 5.0, 3: 5.0}


# Draft


def test_the_draft_shows_its_configured_devices_at_once_and_reads_them() -> None:
    lamps = [{"name": "light0", "number": 0}, {"name": "a/b *", "number": 1, "kind": "lamp"}]
    wire = Wire(draft(devices=lamps))
    ((topic, devices),) = wire.begun
    assert topic is topics.DEVICES
    assert isinstance(devices, Devices)
    assert devices.devices == (Device("light0", 0, "light"), Device("a/b *", 1, "lamp"))
    assert wire.reading(light(0, 0.25)) == ("sensor/light0", Reading(0.25, "light", 0, False, stamp_ns=STAMP))
    assert wire.reading(light(1, 0.25))[0] == "sensor/a%2Fb%20%2A"
    assert wire.reading(light(7, 0.25))[0] == "sensor/light-7"
    assert wire.metrics.total("sensor_unregistered") == 1
    assert wire.frames() == []
    assert [topic.path for topic in wire.robot.on_demand] == ["sensor/light0", "sensor/a%2Fb%20%2A"]
    wire.robot.listened(wire.robot.on_demand[1], on=True)
    assert wire.frames() == [bytes.fromhex("80 00 01")]


def test_a_sensor_of_the_draft_is_enabled_on_the_first_listener_and_disabled_after_the_last() -> None:
    wire = Wire(draft(3))
    one, two, three = wire.robot.on_demand
    wire.robot.listened(two, on=True)
    assert wire.frames() == [bytes.fromhex("80 00 01")]
    wire.robot.listened(one, on=True)
    wire.robot.listened(two, on=False)
    assert wire.frames() == [bytes.fromhex("80 00 00"), bytes.fromhex("81 00 01")]
    wire.session.lost("closed by peer")
    wire.robot.listened(one, on=False)
    wire.robot.listened(three, on=True)
    for _ in range(2):  # who listens while nobody is connected is remembered for every connection
        wire.connect()
        assert wire.frames() == [bytes.fromhex("80 00 02")]
        wire.session.lost("closed by peer")


def test_pinned_sensors_are_all_enabled_at_once_and_stay_so() -> None:
    wire = Wire(draft(200, pinned=[f"light{number}" for number in range(200)]))
    assert sorted(wire.frames()) == [bytes((0x80, 0, number)) for number in range(200)]
    wire.robot.listened(wire.robot.on_demand[1], on=True)
    wire.robot.listened(wire.robot.on_demand[1], on=False)
    assert wire.frames() == []
    wire.connect()
    assert len(wire.frames()) == 200


@pytest.mark.parametrize(
    ("fields", "sent"),
    [
        ({"enable": True}, ["80 00 01"]),
        ({"enable": False}, ["81 00 01"]),
        ({"index": 2, "value": 0.25}, ["82 00 01 02 000000000000d03f"]),
        ({"values": (1.5, -2.0, 0.25)}, ["83 00 01 000000000000f83f 00000000000000c0 000000000000d03f"]),
        ({"enable": True, "index": 0, "value": 1.5}, ["80 00 01", "82 00 01 00 000000000000f83f"]),
    ],
)
def test_the_settings_of_a_sensor_are_enable_change_and_set(fields: dict[str, Any], sent: list[str]) -> None:
    wire = Wire(draft())
    wire.set("light1", **fields)
    assert wire.frames() == [bytes.fromhex(frame) for frame in sent]


@pytest.mark.parametrize("count", [0, 1, 5])
def test_how_many_configuration_values_a_sensor_has_is_a_setting(count: int) -> None:
    wire = Wire(draft(values=count))
    wire.set("light0", values=(1.5,) * count)
    assert wire.frames() == [bytes.fromhex("83 00 00") + bytes.fromhex("000000000000f83f") * count]
    for wrong in {count + 1, count + 2, abs(count - 1)} - {count}:
        with pytest.raises(Refused, match="values"):
            wire.set("light0", values=(1.5,) * wrong)
    assert wire.frames() == []


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("nobody", {"enable": True}),
        ("light0", {"index": 256, "value": 1.0}),
        ("light0", {"index": -1, "value": 1.0}),
        ("light0", {"values": (1.0, 2.0)}),
        ("light0", {"index": 3, "value": 1.0}),
        ("light0", {"index": 0, "value": NAN}),
        ("light0", {"values": (1.0, INF, 2.0)}),
        ("light0", {"index": 1}),
        ("light0", {"value": 1.0}),
        ("light0", {}),
        ("light0", {"enable": True, "index": 256, "value": 1.0}),
        ("light0", {"enable": True, "values": (1.0, 2.0)}),
        # in deployed, where a 130 of the draft would be stuck in the controller
        ("front", {"enable": True}),
        ("front", {"index": 0, "value": 1.0}),
        ("front", {"values": (1.0, 2.0, 3.0)}),
    ],
)
def test_a_setting_that_cannot_be_is_refused_whole_never_silently_dropped(name: str, fields: dict[str, Any]) -> None:
    wire = Wire(greeting=CAR + data(5, 1.0)) if name == "front" else Wire(draft())
    with pytest.raises(Refused):
        wire.set(name, **fields)
    assert wire.frames() == []


@pytest.mark.parametrize("kind", ["light", "rotational", "linear"])
def test_the_draft_has_no_motors_nothing_to_drive_and_nothing_to_stop(kind: str) -> None:
    wire = Wire(draft(devices=[{"name": "fl", "number": 0, "kind": kind}], factors={"fl": {"forward": 1.0}}))
    with pytest.raises((Refused, EncodeError)):
        wire.motor("fl", 1.0)
    with pytest.raises((Refused, EncodeError)):
        wire.drive(forward=1.0)
    wire.robot.stop(0.0, 1.0)
    assert wire.frames() == []


# Options


def test_the_defaults_are_those_of_the_page_and_a_webots_robot_has_one_link() -> None:
    options = options_of()
    assert options == Options()
    assert options.dialect == "deployed"
    assert (options.motor_types.rotational, options.motor_types.linear) == ((53,), (46,))
    with pytest.raises(ConfigError, match="link"):
        planned("wc2ec", 2)


TWO_NUMBERED_1 = [{"name": "a", "number": 1}, {"name": "b", "number": 1}]
TWO_CALLED_A = [{"name": "a", "number": 1}, {"name": "a", "number": 2}]
LAMP_A = [{"name": "a", "number": 1}]


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"dialect": "binary"}, "dialect"),
        ({"dialect": "draft"}, "devices"),
        ({"devices": LAMP_A}, "devices"),
        ({"dialect": "draft", "devices": TWO_NUMBERED_1}, "devices"),
        ({"dialect": "draft", "devices": TWO_CALLED_A}, "devices"),
        ({"dialect": "draft", "devices": LAMP_A, "pinned": ["b"]}, "pinned"),
        ({"unheard_of": 1}, "unheard_of"),
        ({"dialect": "draft", "devices": [{"name": "a", "number": 256}]}, "number"),
        ({"dialect": "draft", "devices": [{"name": "a"}]}, "number"),
        ({"dialect": "draft", "devices": [{"number": 1}]}, "name"),
        ({**WHEELS, **FACTORS}, "factors"),
        ({"differential": {**WHEELS["differential"], "wheel_radius_m": 0.0}}, "wheel_radius_m"),
        ({"differential": {**WHEELS["differential"], "track_m": -0.3}}, "track_m"),
        ({"differential": {"left": ["a"], "right": ["b"], "track_m": 0.3}}, "wheel_radius_m"),
        ({"differential": {**WHEELS["differential"], "left": ["a", "b"], "right": ["b"]}}, "b"),
        ({"factors": {"fl": {"backward": 1.0}}}, "backward"),
        ({"factors": {"fl": {"forward": "fast"}}}, "forward"),
        ({"factors": {"fl": {"forward": math.inf}}}, "forward"),
        ({"motor_types": {"rotational": [256]}}, "motor_types"),
        ({"tables": {"front": [[0.0, 1.0]]}}, "tables"),
        ({"tables": {"front": [[0.0, 1.0], [0.0, 2.0]]}}, "tables"),
        ({"tables": {"front": [[5.0, 1.0], [0.0, 2.0]]}}, "tables"),
        ({"tables": {"front": [[0.0, 1.0, 2.0], [1.0, 2.0, 3.0]]}}, "tables"),
        ({"bounds": {"front": [0.0]}}, "bounds"),
        ({"bounds": {"front": [1000.0, 0.0]}}, "bounds"),
        ({"bounds_default": [0.0, 1.0, 2.0]}, "bounds_default"),
        ({"bounds_default": [1000.0, 0.0]}, "bounds_default"),
        ({"scan_range_m": [0.0, -1.0]}, "scan_range_m"),
        ({"scan_range_m": [2.0, 1.0]}, "scan_range_m"),
        ({"bearings_deg": {"a": 0.0, "b": 1.0, "c": 1e9}}, "bearings_deg"),
        ({"values": -1}, "values"),
        ({"values": 256}, "values"),
    ],
)
def test_options_that_cannot_be_or_contradict_each_other_are_an_error_that_names_them(options, names) -> None:
    with pytest.raises(ConfigError, match=names):
        planned("wc2ec", **options)


def template() -> str:
    return robot_template(PROTOCOL).replace("{name}", "r1")


def test_the_template_is_a_configuration_and_names_every_option() -> None:
    plan = config.plan(tomllib.loads(template()))
    assert plan.device is not None
    assert plan.device.protocol is PROTOCOL
    assert [str(address) for address in plan.device.addresses] == ["tcp://127.0.0.1:27015"]
    for name in Options.__struct_fields__:
        assert f"{name} = " in robot_template(PROTOCOL) or f"[device.options.{name}]" in robot_template(PROTOCOL)


@pytest.mark.parametrize("dialect", ["deployed", "draft"])
def test_every_line_the_template_shows_as_left_out_can_be_put_in(dialect: str) -> None:
    lines = template()[template().index("[robot]") :].split("[bus]")[0].splitlines()
    fitting = [line for line in lines if "draft only" not in line or dialect == "draft"]
    shown = "\n".join(line.removeprefix("# ") for line in fitting if "[[hq]]" not in line)
    shown = shown.replace('dialect = "deployed"', f'dialect = "{dialect}"')
    options = config.plan(tomllib.loads(shown[: shown.index("[device.options.differential]")])).device.options
    assert isinstance(options, Options)
    assert options.bearings_deg == {"front": 0.0, "left": 90.0}
    assert options.pinned == (("light0",) if dialect == "draft" else ())


def test_the_options_of_the_simulated_robot_are_options() -> None:
    assert planned("wc2ec", **PROTOCOL.simulated).options.differential is not None
