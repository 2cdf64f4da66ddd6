"""What the fleet is told of a Webots robot and what is sent to it, worked out by hand from the page and the design."""

import math
import struct
import tomllib
from typing import Any, Self

import pytest

from gateways.wc2ec import PROTOCOL
from gateways.wc2ec.options import Wc2EcOptions
from gateways.wc2ec.session import ExternalRole
from gateways.wc2ec.translate import Wc2EcRobot
from tests.conformance.scene import table
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

TO_1000: dict[str, Any] = {"bounds_default": [0.0, 1000.0]}
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


def options_of(**options: Any) -> Wc2EcOptions:
    made = planned("wc2ec", **options).options
    assert isinstance(made, Wc2EcOptions)
    return made


ROBOTS: dict[str, dict[str, Any]] = {
    "no kinematics": {},
    "car": {"differential": {**SIDES, "wheel_radius_m": 0.05, "track_m": 0.3}},
    "fast car": {
        "differential": {**SIDES, "wheel_radius_m": 0.1, "track_m": 0.3, "speed_full_m_s": 2.0, "turn_full_rad_s": 0.5}
    },
    "factors": FACTORS,
    "to 1000": TO_1000,
    "front to 5000": {"bounds": {"front": [-1.0, 5000.0]}, **TO_1000},
    "falling": {"tables": {"front": [[0.0, 1.0], [1000.0, 0.02]]}, **TO_1000},
    "bent": {"tables": {"front": [[0, 0], [10, 1], [30, 5]]}},
    "draft": DRAFT,
    "draft with 0 values": {**DRAFT, "values": 0},
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
        self.now, self.faults = 0.0, 0
        self.session: ExternalRole
        self.connect(greeting)

    @classmethod
    def of(cls, robot: str) -> Self:
        """One of the ROBOTS; those of legacy programs are the CAR, which has sent data, and was sent its stop."""
        made = cls(b"" if robot.startswith("draft") else READY, **ROBOTS[robot])
        made.frames()
        return made

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

    def play(self, steps: list[str]) -> None:
        """Do what is said. After ``>`` it is what leaves, values of motors by number; after ``>>`` in hex."""
        left_out = None
        for step in steps:
            match step.split():
                case ["refused", *said]:
                    with pytest.raises((Refused, EncodeError)):
                        self.does(" ".join(said))
                    assert self.frames() == []
                case [number, "reads", value, ">", key, shown]:
                    path, reading = self.reading(data(int(number), float(value)))
                    self.faults += shown == "fault"
                    assert (path, reading.device, reading.fault) == (key, int(number), shown == "fault")
                    assert f"{reading.value:g}" == f"{float(value if reading.fault else shown):g}", step
                    assert self.metrics.total("sensor_faults") == self.faults
                case ["stop", seconds]:
                    self.robot.stop(self.now, self.now + float(seconds))
                case ["at", seconds]:
                    self.now = float(seconds)
                case [">", *expected]:
                    told = " ".join(f"{number}={value:g}" for number, value in sorted(self.values().items()))
                    assert (told or "nothing") == " ".join(expected), step
                case [">>", *expected]:
                    assert b"".join(self.frames()) == bytes.fromhex("".join(expected))
                case ["left", "out", *expected]:
                    assert (left_out or "nothing").startswith(" ".join(expected)), step
                case _:
                    left_out = self.does(step)

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
    ("name", "chunk"), [(b"a/*#@%2F", "a%2F%2A%23%40%252F"), (b"", "%"), (b"\xff\xfe\x00", "%FF%FE%00")]
)
def test_a_name_is_escaped_in_its_key_and_its_motor_is_found_by_it(name: bytes, chunk: str) -> None:
    wire = Wire()
    for _, message in wire.told(registration(ROTATIONAL, 8, name)):
        assert payload.decode(type(message), payload.encode(message)) == message
    assert wire.reading(data(8, 1.0))[0] == f"sensor/{chunk}"
    wire.play([f"motor/{chunk} value=1.5", ">> 82 35 08 000000000000f83f"])


def test_the_numbers_of_node_types_are_options_and_motors_may_be_listed_by_name() -> None:
    wire = Wire(motor_types={"rotational": [60], "linear": [61, 62]}, motors={"rotational": ["k99"], "linear": ["k63"]})
    table = wire.table(b"".join(registration(kind, kind, b"k%d" % kind) for kind in (38, 46, 53, 60, 62, 63, 99)))
    kinds = ["distance", "type46", "type53", "rotational", "linear", "linear", "rotational"]
    assert [entry.kind for entry in table] == kinds
    wire.play(["motor/k60 value=1.5", ">> 82 3c 3c 000000000000f83f", "refused motor/k53 value=1.5"])
    wire.play(["motor/k99 value=1.5", ">> 82 63 63 000000000000f83f"])


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
        wire.play([f"motor/{chunk} value=1.5", f"> {number}=1.5"])


def test_a_number_that_is_registered_twice_is_a_protocol_error_and_changes_nothing(car: Wire) -> None:
    for name in (b"front", b"other"):
        with pytest.raises(ProtocolError, match="device 5 registered again"):
            car.told(registration(DISTANCE, 5, name))
    assert car.reading(data(5, 1.0))[0] == "sensor/front"
    assert [entry.name for entry in car.table(registration(DISTANCE, 6, b"more"))].count("front") == 1


def test_a_new_connection_begins_with_a_fresh_table(car: Wire) -> None:
    car.session.fail("closed by peer")
    car.connect()
    car.play(["refused motor/fl value=1"])
    assert car.table(registration(DISTANCE, 0, b"fl")) == [Device("fl", 0, "distance")]
    car.play(["refused motor/fl value=1"])
    assert car.reading(data(5, 1.0))[0] == "sensor/distance-5"


def test_motors_that_come_in_the_read_that_establishes_the_session_or_later_are_stopped() -> None:
    wire = Wire(READY, **ROBOTS["car"])
    assert wire.values() == STOPPED
    wire.told(registration(ROTATIONAL, 9, b"arm") + registration(LINEAR, 10, b"lift two"))
    assert wire.values() == {9: 0.0}


def test_255_devices_may_be_registered_and_every_rotational_motor_is_stopped_at_once() -> None:
    wire = Wire(b"".join(registration(ROTATIONAL, number, b"m%d" % number) for number in range(254)))
    assert len(wire.table(registration(DISTANCE, 254, b"eye"))) == 255
    wire.robot.stop(0.0, 1.0)
    assert wire.values() == dict.fromkeys(range(254), 0.0)


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
    assert scan.ranges.tolist() == pytest.approx([1.0, math.nan, 2.0], nan_ok=True), "in metres; a fault is no distance"


# Commands


@table(
    """
    bounds | to 1000 | 5 reads 0 > sensor/front 0; 5 reads 1000 > sensor/front 1000; 5 reads -0.001 > sensor/front fault
        ; 5 reads 1000.001 > sensor/front fault; 5 reads nan > sensor/front fault; 5 reads -inf > sensor/front fault
    bounds of one sensor | front to 5000 | 5 reads -1 > sensor/front -1; 5 reads 5000 > sensor/front 5000
        ; 5 reads 5000.5 > sensor/front fault; 99 reads 1001 > sensor/distance-99 fault
    no bounds | car | 5 reads -1e+300 > sensor/front -1e+300; 5 reads nan > sensor/front fault
        ; 5 reads inf > sensor/front fault
    bounds are of what the sensor said, and a fault is not looked up | falling | 5 reads 0 > sensor/front 1
        ; 5 reads 250 > sensor/front 0.755; 5 reads 1000 > sensor/front 0.02; 5 reads 1500 > sensor/front fault
    a lookup table of one sensor, which ends where it ends | bent | 5 reads 5 > sensor/front 0.5
        ; 5 reads 20 > sensor/front 3; 5 reads -50 > sensor/front 0; 5 reads 200 > sensor/front 5
        ; 99 reads 20 > sensor/distance-99 20
    a rotational motor | no kinematics | motor/fr value=1.5; >> 82 35 01 000000000000f83f
    a linear motor | no kinematics | motor/lift value=0.25; >> 82 2e 04 000000000000d03f
    enable | draft | sensor/lamp enable=true; >> 80 00 01
    disable | draft | sensor/lamp enable=false; >> 81 00 01
    change | draft | sensor/lamp index=2 value=0.25; >> 82 00 01 02 000000000000d03f
    enable and change | draft | sensor/lamp enable=true index=0 value=1.5; >> 80 00 01 82 00 01 00 000000000000f83f
    set | draft | sensor/lamp values=(1.5,1.5,0.25); >> 83 00 01 000000000000f83f 000000000000f83f 000000000000d03f
    set none | draft with 0 values | sensor/a%2Fb values=(); >> 83 00 00
    two sides of wheels, 1/4 m/s and 1/2 rad/s | car | drive forward=0.5 turn=0.5; left out nothing
        ; > 0=3.5 1=6.5 2=3.5 3=6.5; at 10; > nothing
    other wheels, 1 m/s and 1/2 rad/s | fast car | drive forward=0.5 turn=1; > 0=9.25 1=10.75 2=9.25 3=10.75
    factors | factors | drive forward=0.5 left=-0.25 turn=-1; > 0=9 1=1
    a neutral drive | car | drive; > 0=0 1=0 2=0 3=0
    what a car cannot do beside other motion | car | drive forward=1 left=0.5 light=true; left out left and light
        ; > 0=10 1=10 2=10 3=10
    sideways alone | car | refused drive left=0.5
    the last word to each motor, where the link was slow | car | drive forward=0.25; drive forward=1; motor/fl value=5
        ; > 0=5 1=10 2=10 3=10; motor/fl value=6; drive forward=0.5; > 0=5 1=5 2=5 3=5
    no kinematics | no kinematics | refused drive forward=0.5
    what is no motor: every later command would be stuck | no kinematics | refused motor/front value=1
        ; refused motor/nobody value=1; refused motor/% value=1; refused motor/FL value=1; refused motor/%231 value=1
        ; refused motor/0 value=1; refused motor/rotational-0 value=1
    what is no number | no kinematics | refused motor/fl value=+nan; refused motor/fl value=+inf
        ; refused motor/fl value=-inf
    a 130 of the draft | no kinematics | refused sensor/front enable=true; refused sensor/front index=0 value=1
    what a Webots robot has not | no kinematics | refused mode mode=manual; refused light on=true; refused lidar on=true
        ; refused text text=hello; refused raw/wc2ec id=130
    motors of the draft | draft with a motor | refused motor/fl value=1; refused drive forward=1; stop 1; > nothing
    settings that cannot be | draft | refused sensor/nobody enable=true; refused sensor/lamp
        ; refused sensor/lamp index=1; refused sensor/lamp value=1; refused sensor/lamp index=-1 value=1
        ; refused sensor/lamp index=3 value=1; refused sensor/lamp index=0 value=+nan
        ; refused sensor/lamp values=(1,inf,2); refused sensor/lamp values=(1,2); refused sensor/lamp values=(1,2,3,4)
        ; refused sensor/lamp enable=true index=256 value=1; refused sensor/lamp enable=true values=(1,2)
    a stop is first, leaves linear motors and what waits is forgotten | no kinematics | motor/fl value=5
        ; motor/rr value=5; motor/lift value=0.25; stop 1
        ; >> 823500 0000000000000000 823501 0000000000000000 823502 0000000000000000 823503 0000000000000000
    a drive after a stop ends its repetition: who acquired anew drives | car | stop 1; > 0=0 1=0 2=0 3=0; at 0.05
        ; drive forward=1; > 0=10 1=10 2=10 3=10; at 0.15; > nothing; at 0.5; > nothing; at 2; > nothing
    a motor that is set after a stop is repeated no more | car | stop 1; > 0=0 1=0 2=0 3=0; at 0.05; motor/fl value=5
        ; > 0=5; at 0.15; > 1=0 2=0 3=0; at 1; > 1=0 2=0 3=0
    """,
    ROBOTS,
)
def test_what_is_told_of_the_robot_and_what_leaves_for_it(options: dict[str, Any], steps: list[str]) -> None:
    wire = Wire(b"" if "dialect" in options else READY, **options)
    wire.frames()
    wire.play(steps)


def test_a_webots_robot_cannot_be_asked_for_anything(car: Wire) -> None:
    for topic in (topics.RPC_MAP, topics.RPC_POSE):
        with pytest.raises(Refused):
            car.robot.ask(topic)


def test_before_the_first_connection_everything_is_refused() -> None:
    robot = Wc2EcRobot(options_of(**ROBOTS["car"]))
    assert (robot.driving, robot.ready) == (None, False)
    for topic, command in ((topics.CMD_DRIVE, Drive(forward=0.5)), (topics.CMD_MOTOR("fl"), Motor(value=1.0))):
        with pytest.raises(Refused):
            robot.command(topic, command, 0.0)


# Drive and stop


def test_a_drive_is_refused_whole_where_one_of_its_motors_is_missing_or_none() -> None:
    others = b"".join(registration(ROTATIONAL, n, wheel) for n, wheel in ((1, b"fr"), (2, b"rl"), (3, b"rr")))
    for kind, name in ((DISTANCE, b"fl"), (LINEAR, b"fl"), (ROTATIONAL, b"other")):
        wire = Wire(registration(kind, 0, name) + others, **ROBOTS["car"])
        wire.play(["refused drive forward=0.5"])


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


def test_the_frames_of_a_stop_set_every_rotational_motor_to_zero_and_change_nothing(car: Wire) -> None:
    car.does("drive forward=1")
    frames = car.robot.stop_frames()
    assert car.values() != STOPPED
    car.robot.stop(car.now, car.now)
    assert set(frames) == set(drained(car.session, car.now))


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
    wire.session.fail("closed by peer")
    wire.robot.listened(one, on=False)
    wire.robot.listened(two, on=True)
    for _ in range(2):  # who listens while nobody is connected is remembered for every connection
        wire.connect()
        assert wire.frames() == [bytes.fromhex("80 00 01"), bytes.fromhex("80 00 02")]
        wire.session.fail("closed by peer")


def test_all_sensors_may_be_pinned_and_are_enabled_at_once() -> None:
    devices = [{"name": f"light{number}", "number": number} for number in range(200)]
    wire = Wire(dialect="draft", devices=devices, pinned=[str(device["name"]) for device in devices])
    assert sorted(wire.frames()) == [bytes((0x80, 0, number)) for number in range(200)]


# Options


def test_the_defaults_are_those_of_the_page_and_a_webots_robot_has_one_link() -> None:
    options = options_of()
    assert options == Wc2EcOptions()
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
    for name in Wc2EcOptions.__struct_fields__:
        assert f"{name} = " in template or f"[device.options.{name}]" in template


@pytest.mark.parametrize("dialect", ["deployed", "draft"])
def test_every_line_the_template_shows_as_left_out_can_be_put_in(dialect: str) -> None:
    template = robot_template(PROTOCOL).replace("{name}", "r1")
    lines = template[template.index("[robot]") :].split("[bus]")[0].splitlines()
    fitting = [line for line in lines if "draft only" not in line or dialect == "draft"]
    shown = "\n".join(line.removeprefix("# ") for line in fitting if "[[hq]]" not in line)
    shown = shown.replace('dialect = "deployed"', f'dialect = "{dialect}"')
    plan = config.plan(tomllib.loads(shown[: shown.index("[device.options.differential]")]))
    assert isinstance(plan.device.options, Wc2EcOptions)
    assert [str(address) for address in plan.device.addresses] == ["tcp://127.0.0.1:27015"]
    assert plan.device.options.bearings_deg == {"front": 0.0, "left": 90.0}
    assert plan.device.options.pinned == (("light0",) if dialect == "draft" else ())
