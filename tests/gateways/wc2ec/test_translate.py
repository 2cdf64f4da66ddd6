"""What the fleet is told of a Webots robot and what is sent to it, worked out by hand from the page and the design."""

import math
import struct
import tomllib
from typing import Any, Self

import pytest

from gateways.wc2ec import PROTOCOL
from gateways.wc2ec.session import ExternalRole
from gateways.wc2ec.settings import Options
from gateways.wc2ec.translate import Wc2EcRobot
from tests.gateways.rig import drained, planned
from tests.gateways.wc2ec.golden import DISTANCE, LINEAR, ROTATIONAL, data, light, registration
from zbridge.app import config
from zbridge.app.templates import robot_template
from zbridge.errors import ConfigError, EncodeError, ProtocolError, Refused
from zbridge.fleet import payload, topics
from zbridge.fleet.messages import Device, Devices, Drive, FleetMessage, Motor, Reading, Scan, Text
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

NAN, INF = math.nan, math.inf
SIDES = {"left": ["fl", "rl"], "right": ["fr", "rr"]}
FACTORS = {
    "factors": {"fl": {"forward": 10.0, "left": -4.0, "turn": -3.0}, "fr": {"forward": 10.0, "left": 4.0, "turn": 3.0}}
}
LAMP = {"name": "lamp", "number": 1}
DRAFT: dict[str, Any] = {"dialect": "draft", "devices": [{"name": "a/b", "number": 0, "kind": "lamp"}, LAMP]}
CAR = b"".join(registration(ROTATIONAL, number, name) for number, name in enumerate((b"fl", b"fr", b"rl", b"rr")))
CAR += registration(LINEAR, 4, b"lift") + registration(DISTANCE, 5, b"front")
READY = CAR + data(5, 1.0)
STOPPED = {0: 0.0, 1: 0.0, 2: 0.0, 3: 0.0}
STAMP = 1_700_000_000_000_000_000


def options_of(**options: Any) -> Options:
    made = planned("wc2ec", **options).options
    assert isinstance(made, Options)
    return made


ROBOTS: dict[str, dict[str, Any]] = {
    "no kinematics": {},
    "car": {"differential": {**SIDES, "wheel_radius_m": 0.05, "track_m": 0.3}},
    "fast car": {
        "differential": {**SIDES, "wheel_radius_m": 0.1, "track_m": 0.3, "speed_full_m_s": 2.0, "turn_full_rad_s": 0.5}
    },
    "factors": FACTORS,
    "draft": DRAFT,
    "draft with 0 values": {**DRAFT, "values": 0},
    "draft with 5 values": {**DRAFT, "values": 5},
    "draft with a motor": {**DRAFT, "devices": [{"name": "fl", "number": 0, "kind": "rotational"}], **FACTORS},
}


def meant(value: str) -> Any:
    """A field of a command: ``true``, ``manual``, ``2``, ``-inf``, ``(1,inf)``."""
    if value.startswith("("):
        return tuple(float(one) for one in value[1:-1].split(",") if one)
    if value in ("true", "false"):
        return value == "true"
    return int(value) if value.removeprefix("-").isdecimal() else value if value.isalpha() else float(value)


class Wire:
    """A robot that is connected, what it tells the fleet, and what leaves it."""

    def __init__(self, greeting: bytes = b"", **options: Any) -> None:
        self.metrics = Metrics()
        self.robot = Wc2EcRobot(options_of(**options), 1, self.metrics)
        self.now = 0.0
        self.session: ExternalRole
        self.connect(greeting)

    @classmethod
    def of(cls, robot: str) -> Self:
        """One of the ROBOTS; those of deployed programs are the CAR, which has sent data."""
        return cls(b"" if robot.startswith("draft") else READY, **ROBOTS[robot])

    def connect(self, greeting: bytes = b"") -> tuple[tuple[Topic, FleetMessage], ...]:
        """Connect, for the first time or again; give what the fleet is told at once."""
        self.session = self.robot.session("robot", "tcp://robot.test:1")
        self.session.open(self.now)
        begun = self.robot.begun(STAMP) if self.session.state is State.ESTABLISHED else ()
        self.told(greeting)
        return begun

    def told(self, received: bytes) -> list[tuple[Topic, FleetMessage]]:
        """What the fleet is told of what came in one read."""
        messages = self.session.receive(received, self.now)
        assert self.session.traffic.malformed == 0
        return [told for message in messages for told in self.robot.telemetry(message, STAMP)]

    def table(self, received: bytes) -> list[Device]:
        """The device table after this."""
        tables = [message for _, message in self.told(received) if isinstance(message, Devices)]
        return list(tables[-1].devices)

    def reading(self, received: bytes) -> tuple[str, Reading]:
        """The key and the one reading that this is."""
        ((topic, reading),) = self.told(received)
        assert isinstance(reading, Reading)
        return topic.path, reading

    def does(self, said: str) -> str | None:
        """Give a command, ``"motor/fl value=1.5"``; what of it was left out."""
        path, *fields = said.split()
        topic = topics.find(f"@cmd/{path}")
        assert topic is not None
        named = {name: meant(value) for name, _, value in (field.partition("=") for field in fields)}
        command = topic.message(**named)
        return self.robot.command(topic, command, self.now).left_out

    def frames(self) -> list[bytes]:
        return drained(self.session, self.now)

    def values(self) -> dict[int, float]:
        """The motors' last values among what leaves now, by number; every frame is a command to a motor."""
        values = {}
        for frame in self.frames():
            command, kind, number, value = struct.unpack("<BBBd", frame)
            assert (command, kind) in ((130, ROTATIONAL), (130, LINEAR))
            values[number] = value
        return values


@pytest.fixture
def car() -> Wire:
    return Wire.of("car")


# Devices and their readings


def test_a_reading_of_any_type_is_on_the_key_of_its_name_with_kind_device_and_stamp(car: Wire) -> None:
    expected = Reading(value=750.5, kind="distance", device=5, fault=False, stamp_ns=STAMP)
    for kind in (0, 37, 46, 255):
        assert car.reading(data(5, 750.5, kind)) == ("sensor/front", expected)
    assert car.robot.on_demand == (), "it measures without being asked"


@pytest.mark.parametrize(
    ("name", "chunk"),
    [
        (b"a/*#@%2F", "a%2F%2A%23%40%252F"),
        (b"", "%"),
        (b"\xff\xfe\x00", "%FF%FE%00"),
    ],
)
def test_a_name_is_escaped_in_its_key_and_its_motor_is_found_by_it(name: bytes, chunk: str) -> None:
    wire = Wire()
    for _, message in wire.told(registration(ROTATIONAL, 8, name)):
        assert payload.decode(type(message), payload.encode(message)) == message
    assert wire.reading(data(8, 1.0))[0] == f"sensor/{chunk}"
    wire.does(f"motor/{chunk} value=1.5")
    assert wire.frames() == [bytes.fromhex("82 35 08 000000000000f83f")]


def test_the_numbers_of_node_types_are_options_and_motors_may_be_listed_by_name() -> None:
    wire = Wire(motor_types={"rotational": [60], "linear": [61, 62]}, motors={"rotational": ["k99"], "linear": ["k63"]})
    table = wire.table(b"".join(registration(kind, kind, b"k%d" % kind) for kind in (38, 46, 53, 60, 62, 63, 99)))
    kinds = {entry.name: entry.kind for entry in table}
    assert kinds == {"k38": "distance", "k46": "type46", "k53": "type53"} | {
        "k60": "rotational",
        "k62": "linear",
        "k63": "linear",
        "k99": "rotational",
    }
    wire.does("motor/k60 value=1.5")
    wire.does("motor/k99 value=1.5")
    assert wire.frames() == [bytes.fromhex("82 3c 3c 000000000000f83f"), bytes.fromhex("82 63 63 000000000000f83f")]
    with pytest.raises(Refused):
        wire.does("motor/k53 value=1.5")


def test_data_before_registration_is_shown_under_its_number_and_counted() -> None:
    wire = Wire()
    path, reading = wire.reading(data(9, 4.5))
    assert (path, reading.value, reading.device, reading.kind) == ("sensor/distance-9", 4.5, 9, "distance")
    wire.told(registration(DISTANCE, 9, b"late"))
    assert wire.reading(data(9, 4.5))[0] == "sensor/late"
    assert wire.metrics.total("sensor_unregistered") == 1
    ((topic, text),) = wire.told(bytes.fromhex("7f 25 09"))
    assert (topic, text) == (topics.TEXT, Text("error of device 9", stamp_ns=STAMP))


def test_the_device_table_grows_with_every_registration_and_a_name_that_is_taken_gets_its_number() -> None:
    """However the names are chosen, every device has a key of its own and every motor moves by its own name alone."""
    wire = Wire()
    assert wire.table(registration(DISTANCE, 1, b"eye#8")) == [Device("eye#8", 1, "distance")]
    told = wire.told(b"".join(registration(ROTATIONAL, number, b"eye") for number in (2, 7, 8)))
    first, second = [message.text for _, message in told if isinstance(message, Text)]
    assert "'eye'" in first
    assert "2 and 7" in first
    assert "eye#7" in first
    assert "2 and 8" in second
    chunks = ["eye%238", "eye", "eye%237", "eye%238%238"]
    table = wire.table(registration(LINEAR, 9, b"lift"))
    assert [entry.name for entry in table] == [*(chunk.replace("%23", "#") for chunk in chunks), "lift"]
    assert [wire.reading(data(number, 1.0))[0] for number in (1, 2, 7, 8)] == [f"sensor/{chunk}" for chunk in chunks]
    for number, chunk in zip((2, 7, 8), chunks[1:], strict=True):
        wire.does(f"motor/{chunk} value=1.5")
        assert wire.values() == {number: 1.5}


def test_a_number_that_is_registered_twice_is_a_protocol_error_and_changes_nothing(car: Wire) -> None:
    for name in (b"front", b"other"):
        with pytest.raises(ProtocolError, match="device 5 registered again"):
            car.told(registration(DISTANCE, 5, name))
    assert car.reading(data(5, 1.0))[0] == "sensor/front"
    assert [entry.name for entry in car.table(registration(DISTANCE, 6, b"more"))].count("front") == 1


def test_a_new_connection_begins_with_a_fresh_table(car: Wire) -> None:
    car.session.lost("closed by peer")
    car.connect()
    for table in ([], [Device("fl", 0, "distance")]):
        with pytest.raises(Refused):
            car.does("motor/fl value=1")
        assert car.frames() == []
        assert table or car.table(registration(DISTANCE, 0, b"fl")) == [Device("fl", 0, "distance")]
    assert car.reading(data(5, 1.0))[0] == "sensor/distance-5"


def test_255_devices_may_be_registered_and_every_rotational_motor_is_stopped_at_once() -> None:
    wire = Wire(b"".join(registration(ROTATIONAL, number, b"m%d" % number) for number in range(254)))
    assert len(wire.table(registration(DISTANCE, 254, b"eye"))) == 255
    wire.robot.stop(0.0, 1.0)
    assert wire.values() == dict.fromkeys(range(254), 0.0)


TO_1000: dict[str, Any] = {"bounds_default": [0.0, 1000.0]}
FRONT_TO_5000: dict[str, Any] = {"bounds": {"front": [-1.0, 5000.0]}, **TO_1000}
FALLING: dict[str, Any] = {"tables": {"front": [[0.0, 1.0], [1000.0, 0.02]]}, **TO_1000}
BENT: dict[str, Any] = {"tables": {"front": [[0, 0], [10, 1], [30, 5]]}}


@pytest.mark.parametrize(
    ("options", "number", "value", "shown"),
    [
        *((TO_1000, 5, value, value) for value in (0.0, 500.0, 1000.0)),
        *((TO_1000, 5, value, "fault") for value in (-0.001, 1000.001, NAN, INF, -INF)),
        *((FRONT_TO_5000, 5, value, value) for value in (-1.0, 5000.0)),
        (FRONT_TO_5000, 5, 5000.5, "fault"),
        (FRONT_TO_5000, 99, 1001.0, "fault"),  # the others have the default
        ({"bounds": {"front": [0.0, 0.0]}}, 5, 0.5, "fault"),
        ({}, 5, -1e300, -1e300),
        *(({}, 5, value, "fault") for value in (NAN, INF)),
        *((FALLING, 5, value, shown) for value, shown in ((0.0, 1.0), (250.0, 0.755), (1000.0, 0.02))),
        (FALLING, 5, 1500.0, "fault"),  # the bounds are of what the sensor said; a fault is not looked up
        *((BENT, 5, value, shown) for value, shown in ((5.0, 0.5), (20.0, 3.0), (-50.0, 0.0), (200.0, 5.0))),
        (BENT, 99, 20.0, 20.0),  # it is of one sensor
    ],
)
def test_a_value_is_looked_up_in_its_table_or_a_fault_that_is_counted(options, number, value, shown) -> None:
    wire = Wire(CAR, **options)
    _, reading = wire.reading(data(number, value))
    assert reading.fault is (shown == "fault")
    assert repr(reading.value) == repr(value) if reading.fault else reading.value == pytest.approx(shown)
    assert wire.metrics.total("sensor_faults") == reading.fault


def test_sensors_with_bearings_are_a_scan_too_once_each_has_a_value_of_this_connection() -> None:
    ring = b"".join(registration(DISTANCE, number, b"ds%d" % number) for number in range(4))
    bearings = {"ds0": -90.0, "ds1": 0.0, "ds2": 90.0}
    tables = {name: [[0.0, 0.0], [1000.0, 4.0]] for name in bearings}
    wire = Wire(ring, bearings_deg=bearings, scan_range_m=[0.1, 2.0], tables=tables, **TO_1000)
    assert len(wire.told(data(0, 250.0) + data(1, -1.0) + data(3, 9.0))) == 3
    wire.connect(ring)
    assert len(wire.told(data(2, 500.0) + data(1, 750.0) + data(1, -1.0))) == 3, "the value before is forgotten"
    (path, _), (topic, scan) = wire.told(data(0, 250.0))
    assert (path.path, topic) == ("sensor/ds0", topics.SCAN)
    assert isinstance(scan, Scan)
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((-math.pi / 2, math.pi / 2))
    assert (scan.range_min, scan.range_max, scan.stamp_ns) == (0.1, 2.0, STAMP)
    assert scan.ranges.tolist() == pytest.approx([1.0, NAN, 2.0], nan_ok=True), "in metres; a fault is no distance"


# Commands


@pytest.mark.parametrize(
    ("robot", "said", "sent"),
    [
        ("no kinematics", "motor/fr value=1.5", ["82 35 01 000000000000f83f"]),
        ("no kinematics", "motor/lift value=0.25", ["82 2e 04 000000000000d03f"]),
        ("draft", "sensor/lamp enable=true", ["80 00 01"]),
        ("draft", "sensor/lamp enable=false", ["81 00 01"]),
        ("draft", "sensor/lamp index=2 value=0.25", ["82 00 01 02 000000000000d03f"]),
        ("draft", "sensor/lamp enable=true index=0 value=1.5", ["80 00 01", "82 00 01 00 000000000000f83f"]),
        ("draft", "sensor/lamp values=(1.5,1.5,1.5)", ["83 00 01" + "000000000000f83f" * 3]),
        ("draft with 0 values", "sensor/a%2Fb values=()", ["83 00 00"]),
        ("draft with 5 values", "sensor/a%2Fb values=(1.5,1.5,1.5,1.5,1.5)", ["83 00 00" + "000000000000f83f" * 5]),
    ],
)
def test_a_command_to_a_device_is(robot: str, said: str, sent: list[str]) -> None:
    wire = Wire.of(robot)
    wire.does(said)
    assert wire.frames() == [bytes.fromhex(frame) for frame in sent]


REFUSED = {
    # after a 130 to a device that is no motor, or is unknown, every later command is stuck
    "no kinematics": [
        *(f"motor/{name} value=1" for name in ("front", "nobody", "%", "FL", "%231", "0", "rotational-0")),
        *(f"motor/fl value={value}" for value in ("+nan", "+inf", "-inf")),
        *("drive forward=0.5", "sensor/front enable=true", "sensor/front index=0 value=1"),
        *("mode mode=manual", "light on=true", "lidar on=true", "text text=hello", "raw/wc2ec id=130"),
    ],
    "car": ["drive left=0.5"],
    "draft with a motor": ["motor/fl value=1", "drive forward=1"],
    "draft": [
        "sensor/nobody enable=true",
        *("sensor/lamp", "sensor/lamp index=1", "sensor/lamp value=1"),
        *(f"sensor/lamp index={index} value=1" for index in (-1, 3, 256)),
        *("sensor/lamp index=0 value=+nan", "sensor/lamp values=(1,inf,2)"),
        *("sensor/lamp values=(1,2)", "sensor/lamp values=(1,2,3,4)"),
        *("sensor/lamp enable=true index=256 value=1", "sensor/lamp enable=true values=(1,2)"),
    ],
}


@pytest.mark.parametrize(("robot", "said"), [(robot, said) for robot, them in REFUSED.items() for said in them])
def test_what_cannot_be_is_refused_whole_and_nothing_is_sent(robot: str, said: str) -> None:
    wire = Wire.of(robot)
    with pytest.raises((Refused, EncodeError)):
        wire.does(said)
    with pytest.raises(Refused):
        wire.robot.ask(topics.RPC_MAP)
    assert wire.frames() == []


def test_before_the_first_connection_everything_is_refused() -> None:
    robot = Wc2EcRobot(options_of(**ROBOTS["car"]))
    assert (robot.driving, robot.ready) == (None, False)
    for topic, command in ((topics.CMD_DRIVE, Drive(forward=0.5)), (topics.CMD_MOTOR("fl"), Motor(value=1.0))):
        with pytest.raises(Refused):
            robot.command(topic, command, 0.0)


# Drive and stop


@pytest.mark.parametrize(
    ("robot", "said", "left", "right"),
    [
        ("car", "drive forward=0.5 turn=0.5", 3.5, 6.5),
        ("car", "drive", 0.0, 0.0),
        ("fast car", "drive forward=0.5 turn=1", 9.25, 10.75),  # 1 m/s and 0.5 rad/s: (1 -+ 0.075) / 0.1
        ("factors", "drive forward=0.5 left=-0.25 turn=-1", 9.0, 1.0),
        ("factors", "drive", 0.0, 0.0),
    ],
)
def test_a_drive_is_what_two_sides_of_wheels_or_factors_make_of_it(robot, said, left, right) -> None:
    wire = Wire.of(robot)
    assert wire.does(said) is None
    rear = {} if robot == "factors" else {2: left, 3: right}
    assert wire.values() == pytest.approx({0: left, 1: right, **rear})
    wire.now = 10.0
    assert wire.frames() == [], "a value holds until the next one"


def test_what_a_car_cannot_do_is_left_out_beside_other_motion(car: Wire) -> None:
    for more, said in (("left=0.5", "left"), ("light=true", "light")):
        assert said in (car.does(f"drive forward=1 {more}") or "")
        assert car.values() == pytest.approx({0: 10.0, 2: 10.0, 1: 10.0, 3: 10.0})


@pytest.mark.parametrize(("kind", "name"), [(DISTANCE, b"fl"), (LINEAR, b"fl"), (ROTATIONAL, b"other")])
def test_a_drive_is_refused_whole_where_one_of_its_motors_is_missing_or_none(kind: int, name: bytes) -> None:
    others = b"".join(registration(ROTATIONAL, n, wheel) for n, wheel in ((1, b"fr"), (2, b"rl"), (3, b"rr")))
    car = Wire(registration(kind, 0, name) + others, **ROBOTS["car"])
    with pytest.raises(Refused, match="fl"):
        car.does("drive forward=0.5")
    assert car.frames() == []


def test_where_the_link_was_slow_the_last_word_to_each_motor_is_sent(car: Wire) -> None:
    for number in range(200):
        car.does(f"drive forward={number / 200}")
    car.does("motor/fl value=5")
    frames = car.frames()
    assert len(frames) == 4
    assert bytes.fromhex("82 35 00 0000000000001440") in frames
    car.does("motor/fl value=6")
    car.does("drive forward=0.5")
    assert set(car.values().values()) == {5.0}


def test_a_stop_sets_every_rotational_motor_to_0_before_what_waits_and_leaves_the_linear_ones() -> None:
    wire = Wire.of("no kinematics")
    for said in ("motor/fl value=5", "motor/rr value=5", "motor/lift value=0.25"):
        wire.does(said)
    wire.robot.stop(0.0, 1.0)
    assert wire.frames() == [bytes((0x82, 0x35, number)) + bytes(8) for number in (0, 1, 2, 3)]


def test_where_no_motor_is_registered_there_is_nothing_to_stop() -> None:
    for wire in (Wire(data(9, 1.0, ROTATIONAL)), Wire.of("draft with a motor")):
        wire.robot.stop(0.0, 1.0)
        assert wire.frames() == []


def test_a_stop_is_repeated_for_a_second_and_a_routine_one_sent_once(car: Wire) -> None:
    for seconds, least, most in ((0.0, 1, 1), (1.0, 5, 60), (0.0, 1, 1)):
        start, rounds = car.now, 0
        car.does("drive forward=1")
        car.robot.stop(start, start + seconds)
        for step in range(300):
            car.now = start + step / 100
            values = car.values()
            rounds += bool(values)
            assert values == {} or (values == STOPPED and step / 100 <= seconds + 0.01)
        assert least <= rounds <= most


@pytest.mark.parametrize(
    ("said", "moved"), [("motor/fl value=5", {0: 5.0}), ("drive forward=1", dict.fromkeys(STOPPED, 10.0))]
)
def test_a_command_after_a_stop_ends_its_repetition_for_its_motors(car: Wire, said, moved) -> None:
    """Whoever acquired anew within the second in which the stop is repeated drives."""
    car.robot.stop(0.0, 1.0)
    car.frames()
    car.now = 0.05
    car.does(said)
    assert car.values() == moved
    for _ in range(20):
        car.now += 0.1
        assert not car.values().keys() & moved.keys()


# Draft


def test_the_draft_shows_its_configured_devices_at_once_and_reads_them() -> None:
    wire = Wire(**DRAFT)
    ((topic, devices),) = wire.connect()
    assert (topic, devices) == (
        topics.DEVICES,
        Devices((Device("a/b", 0, "lamp"), Device("lamp", 1, "light")), stamp_ns=STAMP),
    )
    assert wire.reading(light(0, 0.25)) == ("sensor/a%2Fb", Reading(0.25, "lamp", 0, False, stamp_ns=STAMP))
    assert wire.reading(light(7, 0.25))[0] == "sensor/light-7"
    assert wire.metrics.total("sensor_unregistered") == 1
    assert wire.frames() == []


def test_a_sensor_of_the_draft_is_enabled_while_somebody_listens_and_a_pinned_one_always() -> None:
    wire = Wire(**{**DRAFT, "devices": [*DRAFT["devices"], {"name": "pinned", "number": 2}], "pinned": ["pinned"]})
    one, two, three = wire.robot.on_demand
    assert [topic.path for topic in (one, two, three)] == ["sensor/a%2Fb", "sensor/lamp", "sensor/pinned"]
    for topic, on, sent in (
        (three, True, "80 00 02"),  # of the connection itself
        (three, False, ""),
        (two, True, "80 00 01"),
        (one, True, "80 00 00"),
        (two, False, "81 00 01"),
    ):
        wire.robot.listened(topic, on=on)
        assert b"".join(wire.frames()) == bytes.fromhex(sent)
    wire.session.lost("closed by peer")
    wire.robot.listened(one, on=False)
    wire.robot.listened(two, on=True)
    for _ in range(2):  # who listens while nobody is connected is remembered for every connection
        wire.connect()
        assert wire.frames() == [bytes.fromhex("80 00 01"), bytes.fromhex("80 00 02")]
        wire.session.lost("closed by peer")


# Options


def test_the_defaults_are_those_of_the_page_and_a_webots_robot_has_one_link() -> None:
    options = options_of()
    assert options == Options()
    assert (options.dialect, options.motor_types.rotational, options.motor_types.linear) == ("deployed", (53,), (46,))
    with pytest.raises(ConfigError, match="link"):
        planned("wc2ec", 2)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"dialect": "draft"}, "devices"),
        ({"devices": [LAMP]}, "devices"),
        ({"dialect": "draft", "devices": [LAMP, {"name": "b", "number": 1}]}, "devices"),
        ({"dialect": "draft", "devices": [LAMP, {"name": "lamp", "number": 2}]}, "devices"),
        ({"dialect": "draft", "devices": [{"name": "a", "number": 256}]}, "number"),
        ({**DRAFT, "pinned": ["b"]}, "pinned"),
        ({"unheard_of": 1}, "unheard_of"),
        ({**ROBOTS["car"], **FACTORS}, "factors"),
        ({"differential": {**ROBOTS["car"]["differential"], "wheel_radius_m": 0.0}}, "wheel_radius_m"),
        ({"differential": {**ROBOTS["car"]["differential"], "left": ["a", "b"], "right": ["b"]}}, "b"),
        ({"factors": {"fl": {"forward": math.inf}}}, "forward"),
        ({"tables": {"front": [[0.0, 1.0]]}}, "tables"),
        ({"tables": {"front": [[0.0, 1.0], [0.0, 2.0]]}}, "tables"),
        ({"bounds": {"front": [1000.0, 0.0]}}, "bounds"),
        ({"bounds_default": [1000.0, 0.0]}, "bounds_default"),
        ({"scan_range_m": [2.0, 1.0]}, "scan_range_m"),
        ({"bearings_deg": {"a": 1e9}}, "bearings_deg"),
        ({"values": 256}, "values"),
    ],
)
def test_options_that_cannot_be_or_contradict_each_other_are_an_error_that_names_them(options, names) -> None:
    with pytest.raises(ConfigError, match=names):
        planned("wc2ec", **options)


def test_the_template_names_every_option() -> None:
    template = robot_template(PROTOCOL)
    for name in Options.__struct_fields__:
        assert f"{name} = " in template or f"[device.options.{name}]" in template


@pytest.mark.parametrize("dialect", ["deployed", "draft"])
def test_every_line_the_template_shows_as_left_out_can_be_put_in(dialect: str) -> None:
    template = robot_template(PROTOCOL).replace("{name}", "r1")
    lines = template[template.index("[robot]") :].split("[bus]")[0].splitlines()
    fitting = [line for line in lines if "draft only" not in line or dialect == "draft"]
    shown = "\n".join(line.removeprefix("# ") for line in fitting if "[[hq]]" not in line)
    shown = shown.replace('dialect = "deployed"', f'dialect = "{dialect}"')
    plan = config.plan(tomllib.loads(shown[: shown.index("[device.options.differential]")]))
    assert isinstance(plan.device.options, Options)
    assert [str(address) for address in plan.device.addresses] == ["tcp://127.0.0.1:27015"]
    assert plan.device.options.bearings_deg == {"front": 0.0, "left": 90.0}
    assert plan.device.options.pinned == (("light0",) if dialect == "draft" else ())
