"""What external controllers are shown and what they command: bytes of the protocol page, written by hand."""

import math
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateways.wc2ec.conformance.fragile_hq import Reader
from gateways.wc2ec.hq import HqOptions, Wc2EcHq, Wheels, device_table, display
from gateways.wc2ec.messages import Dialect as WireDialect
from gateways.wc2ec.messages import Wc2EcMessage
from gateways.wc2ec.settings import DeviceOption, Options
from gateways.wc2ec.translate import Wc2EcRobot
from tests.captures import stream
from tests.gateways.rig import HqScene, drained
from tests.gateways.wc2ec.golden import (
    DISTANCE,
    LINEAR,
    ROTATIONAL,
    data,
    light,
    registration,
)
from zbridge.errors import ConfigError, ProtocolError
from zbridge.fleet import payload, topics
from zbridge.fleet.messages import (
    Device,
    Devices,
    Drive,
    FleetMessage,
    Motor,
    Reading,
    Scan,
    Scanner,
    SensorSetting,
    Status,
)
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol.plugin import Telemetry
from zbridge.protocol.session import Role, State

NAN, INF = math.nan, math.inf
CAPTURE, PORT = "wc2ec-deployed.hex", 27515
LEFT_RIGHT = bytes.fromhex("00 35 00 04 6c656674") + bytes.fromhex("00 35 01 05 7269676874")
"""The two motors of a robot without any: devices 0 and 1."""
CAR = (Device("fl", 0, "rotational"), Device("fr", 1, "rotational"), Device("lift", 4, "linear"))
CAR += (Device("front", 7, "distance"),)
CAR_BYTES = (
    bytes.fromhex("00 35 00 02 666c")
    + bytes.fromhex("00 35 01 02 6672")
    + bytes.fromhex("00 2e 04 04 6c696674")
    + bytes.fromhex("00 25 07 05 66726f6e74")
)
CAR_FAULT = bytes.fromhex("01 25 07 000000000000f0bf")
"""-1 of its one sensor: nothing is known of it yet."""
LIGHTS = (DeviceOption("light0", 0), DeviceOption("light1", 9), DeviceOption("sector0", 3, "distance"))


class Scene(HqScene):
    """One listener, what is known of its robot, and its clients."""

    def __init__(
        self,
        protocol: str | None = "wc2ec",
        devices: Iterable[Device] | None = None,
        *,
        clients: int = 1,
        options: HqOptions | None = None,
        **more: Any,
    ) -> None:
        view = RobotView()
        super().__init__(Wc2EcHq(options or HqOptions(**more), view), view)
        self.there = False
        if devices is not None:
            self.tell(topics.DEVICES, Devices(tuple(devices)))
        if protocol is not None:
            self.established(protocol)
        for _ in range(clients):
            self.connect()

    def established(self, protocol: str) -> None:
        self.view.alive = True
        self.tell(topics.STATUS, Status("established", protocol=protocol))
        self._notice()

    def goes(self, *, gateway: bool = False) -> None:
        """Let the robot be lost, or its gateway."""
        if gateway:
            self.view.alive = False
            self.view.status = None
        else:
            self.tell(topics.STATUS, Status("connecting", protocol=self.view.protocol))
        self._notice()

    def _notice(self) -> None:
        """Let the listener tell that the robot is there or not, where that is new."""
        there = self.view.missing is None
        if there is not self.there:
            self.there = there
            self.send(self.side.presence(there))

    def tell(self, topic: Topic, message: FleetMessage) -> None:
        """Let the robot publish something, which the listener follows or does not."""
        self.view.note(topic, message)
        wanted = {topic.path for topic in self.side.wanted()} | {"status"}
        family = f"{topic.path.rpartition('/')[0]}/*"
        if self.clients and {topic.path, family} & {*self.side.follows, *wanted}:
            self.send(self.side.show(topic, message))

    def reads(
        self, name: str, value: float, number: int | None = None, kind: str | None = "distance", *, fault: bool = False
    ) -> None:
        self.tell(topics.SENSOR(name), Reading(value, kind, number, fault))

    def told(self, client: int = 0) -> bytes:
        """What leaves for a client now."""
        return b"".join(drained(self.clients[client]))

    def means(self, data: bytes, client: int = 0) -> list[Telemetry]:
        """What comes of bytes of a client when nothing follows."""
        return [*self.says(data, client), *self.side.expire(self.clients[client], 1.0)]


def set_value(number: int, value: float, kind: int = ROTATIONAL) -> bytes:
    return struct.pack("<BBBd", 130, kind, number, value)


def around(ranges: Iterable[float], *, first_deg: float = 0.0, step_deg: float = 1.0, range_max: float = 10.0) -> Scan:
    metres = np.array(list(ranges), np.float32)
    return Scan(math.radians(first_deg), math.radians(step_deg), 0.02, range_max, metres)


def sectors(*numbers: int, first: int = 2, value: float | None = -1.0) -> bytes:
    """Registrations of sectors, numbered from ``first``, and what they measure."""
    named = b"".join(registration(DISTANCE, first + at, b"sector%d" % number) for at, number in enumerate(numbers))
    return named + b"".join(data(first + at, value) for at, _ in enumerate(numbers) if value is not None)


def draft(protocol: str = "wc2ec", *, clients: int = 1, values: int = 3) -> Scene:
    return Scene(protocol, clients=clients, options=HqOptions(dialect="draft", devices=LIGHTS, values=values))


# Registration


def test_a_client_is_told_all_devices_with_the_robots_own_numbers_at_once_and_once() -> None:
    scene = Scene(devices=CAR)
    assert drained(scene.clients[0]) == [CAR_BYTES, CAR_FAULT], "joined, in one write"
    assert (scene.clients[0].role, scene.clients[0].state) == (Role.ROBOT, State.ESTABLISHED)
    for stamp in range(3):
        scene.tell(topics.DEVICES, Devices(CAR, stamp_ns=stamp))
        scene.established("wc2ec")
    assert scene.told() == b"", "however often the robot says it has them"
    scene.reads("front", 0.0, 7)
    assert scene.told() == data(7, 0.0)


def test_a_device_that_appears_later_is_registered_with_everybody_and_before_all_data_that_waits() -> None:
    scene = Scene(devices=CAR, clients=2)
    scene.told(0)
    scene.told(1)
    scene.reads("front", 1.0, 7)
    scene.tell(topics.DEVICES, Devices((*CAR, Device("rear", 9, "distance"))))
    scene.reads("rear", 2.0, 9)
    scene.connect()
    new = registration(DISTANCE, 9, b"rear")
    assert scene.told(0) == scene.told(1) == new + data(7, 1.0) + data(9, 2.0)
    assert scene.told(2) == CAR_BYTES + new + data(7, 1.0) + data(9, 2.0)


def test_a_sensor_that_the_device_table_does_not_name_is_registered_with_its_number() -> None:
    scene = Scene(devices=CAR)
    scene.told()
    scene.reads("distance-200", 3.0, 200)
    assert scene.told() == registration(DISTANCE, 200, b"distance-200") + data(200, 3.0)


@pytest.mark.parametrize("clients", [0, 1])
def test_a_client_that_came_before_the_robot_or_while_it_is_registering_gets_its_devices_and_no_others(clients) -> None:
    """A simulation that was started again: its table grows device by device, sensors first. No left, no right."""
    scene = Scene(None, clients=clients)
    table = (Device("front", 0, "distance"), Device("rear", 1, "distance"), Device("wheel", 2, "rotational"))
    scene.tell(topics.STATUS, Status("handshaking", protocol="wc2ec"))
    for count in (1, 2, 3):
        scene.tell(topics.DEVICES, Devices(table[:count]))
        if not scene.clients:
            scene.connect()
    scene.established("wc2ec")
    assert registered(scene.told()) == [(0, "front"), (1, "rear"), (2, "wheel")]


def registered(sent: bytes) -> list[tuple[int, str]]:
    """Number and name of every registration."""
    told = Reader("deployed").take(sent)
    assert not any(one.deadly for one in told)
    return [(one.number, one.value) for one in told if isinstance(one.value, str)]


def test_devices_keep_their_numbers_when_the_robot_comes_back_with_others() -> None:
    scene = Scene(devices=CAR)
    scene.told()
    scene.tell(topics.STATUS, Status("connecting", protocol="wc2ec"))
    changed = (Device("front", 0, "distance"), Device("fl", 7, "rotational"), Device("new", 1, "distance"))
    scene.tell(topics.DEVICES, Devices(changed))
    scene.established("wc2ec")
    ((number, name),) = registered(scene.told())
    assert name == "new"
    assert number not in (0, 1, 4, 7), "those are taken"
    scene.reads("front", 1.0, 0)
    assert scene.told() == data(7, 1.0)
    assert scene.says(set_value(0, 2.0)) == [(topics.CMD_MOTOR("fl"), Motor(2.0))]
    scene.connect()
    assert {*registered(scene.told(1))} == {*registered(CAR_BYTES), (number, "new")}


def test_the_type_bytes_are_settings() -> None:
    scene = Scene(devices=CAR, distance_type=38, rotational_type=54, linear_type=47)
    expected = [(54, 0, b"fl"), (54, 1, b"fr"), (47, 4, b"lift"), (38, 7, b"front")]
    assert scene.told() == b"".join(registration(*device) for device in expected) + data(7, -1.0, 38)
    scene.reads("front", 1.0, 7)
    assert scene.told() == data(7, 1.0, 38)


@pytest.mark.parametrize(
    ("device", "shown"),
    [
        (Device("x", 9, "distance"), (37, 9, b"x")),
        (Device("x", 9, "type90"), (90, 9, b"x")),
        (Device("x", 9, "type255"), (255, 9, b"x")),
        # a kind whose type byte is not known
        *((Device("x", 9, kind), (37, 9, b"x")) for kind in ("type256", "light", "type", "type²")),
        # a number beyond 254 is replaced while there is a free one
        (Device("x", 255, "distance"), (37, 2, b"x")),
        (Device("x", -1, "distance"), (37, 2, b"x")),
        # a name that a registration cannot hold
        (Device("n" * 255, 9, "distance"), (37, 9, b"n" * 255)),
        *((Device(name, 9, "distance"), None) for name in ("n" * 256, "ü" * 128, "")),
    ],
)
def test_a_device_has_the_type_byte_of_its_kind_a_number_that_fits_and_a_name_that_fits(device, shown) -> None:
    told = Scene(devices=(*CAR, device)).told()
    if shown is None:
        assert told == CAR_BYTES + CAR_FAULT
    else:
        kind, number, _ = shown
        value = data(number, -1.0 if device.kind == "distance" else 0.0, kind)
        assert told == CAR_BYTES + registration(*shown) + CAR_FAULT + value


def test_names_that_are_not_utf_8_reach_controllers_as_the_robot_has_them() -> None:
    """The table on the bus shows their bytes escaped, the keys hold them: ``caf%E9``."""
    devices = (
        Device("caf\\xe9", 0, "distance"),
        Device("r\\xe4der", 1, "rotational"),
        Device("gr\u00fcn", 2, "distance"),
    )
    scene = Scene(devices=devices)
    scene.reads("caf\udce9", 1.0, 0)
    scene.reads("gr\u00fcn", 2.0, 2)
    assert scene.told() == (
        registration(DISTANCE, 0, b"caf\xe9")
        + registration(ROTATIONAL, 1, b"r\xe4der")
        + registration(DISTANCE, 2, b"gr\xc3\xbcn")
        + data(0, 1.0)
        + data(2, 2.0)
    )
    ((topic, command),) = scene.says(set_value(1, 3.0))
    assert (topic.path, command) == ("@cmd/motor/r%E4der", Motor(3.0))
    assert topics.SENSOR("caf\udce9").path == "sensor/caf%E9"


def test_255_devices_have_the_numbers_0_to_254_and_one_more_has_none() -> None:
    devices = [Device(f"d{number}", number, "distance") for number in range(254)]
    scene = Scene(devices=(*devices, Device("m", 254, "rotational"), Device("late", 255, "distance")))
    assert registered(scene.told()) == [*((number, f"d{number}") for number in range(254)), (254, "m")]
    for number in range(254):
        scene.reads(f"d{number}", number / 2, number)
    scene.reads("late", 1.0, 255)
    sent = [struct.unpack("<BBBd", frame) for frame in drained(scene.clients[0])]
    assert sorted(sent) == [(1, DISTANCE, number, number / 2) for number in range(254)]


# Readings


def test_of_readings_that_wait_the_newest_is_sent_to_everybody() -> None:
    scene = Scene(devices=CAR, clients=3)
    for client in range(3):
        scene.told(client)
    for value in (*range(1000), 123.456):
        scene.reads("front", float(value), 7)
    for client in range(3):
        assert scene.told(client) == bytes.fromhex("01 25 07 77be9f1a2fdd5e40")
        assert drained(scene.clients[client], 1000.0) == [], "and once"


@pytest.mark.parametrize(
    ("kind", "value", "fault", "shown"),
    [
        ("distance", NAN, False, -1.0),
        ("distance", INF, False, -1.0),
        ("distance", -INF, True, -1.0),
        ("distance", 1500.0, True, -1.0),
        ("distance", 0.5, True, -1.0),
        ("type90", 3.0, True, 3.0),
        ("type90", NAN, True, None),
        ("type90", INF, True, None),
        ("type90", -INF, True, None),
    ],
)
def test_what_is_no_distance_is_shown_as_a_fault_and_what_is_no_number_of_another_sensor_not(
    kind: str, value: float, fault: bool, shown: float | None
) -> None:
    """A fault is published as it came, others in metres: what it is must not be taken for one of those."""
    scene, node_type = Scene(devices=(Device("m", 0, "linear"), Device("x", 9, kind))), 37 if kind == "distance" else 90
    scene.reads("x", 2.0, 9, kind)
    scene.told()
    scene.reads("x", value, 9, kind, fault=fault)
    assert scene.told() == (b"" if shown is None else data(9, shown, node_type))
    scene.connect()
    assert scene.told(1).endswith(data(9, 0.0 if shown is None else shown, node_type))


# A controller is ready with its first data, and a fault is what nothing is known of


@pytest.mark.parametrize("known", [False, True])
def test_the_last_known_value_of_every_sensor_follows_the_registration(known: bool) -> None:
    scene = Scene(devices=(*CAR, Device("x", 9, "type90"), Device("rear", 8, "distance")), clients=0)
    if known:
        scene.reads("front", 0.5, 7)
        scene.reads("front", 0.25, 7)
        scene.reads("x", 5.0, 9, "type90")
    scene.connect()
    first = data(7, 0.25 if known else -1.0) + data(9, 5.0 if known else 0.0, 90) + data(8, -1.0)
    assert scene.told() == CAR_BYTES + registration(90, 9, b"x") + registration(DISTANCE, 8, b"rear") + first


@pytest.mark.parametrize("gateway", [False, True])
def test_distance_sensors_are_told_a_fault_once_when_the_robot_is_lost_also_to_who_comes_then(gateway: bool) -> None:
    scene = Scene(devices=(*CAR, Device("rear", 9, "distance"), Device("x", 10, "type90")), clients=2)
    for name, number in (("front", 7), ("rear", 9)):
        scene.reads(name, 0.5, number)
    scene.reads("x", 5.0, 10, "type90")
    for client in range(2):
        scene.told(client)
    scene.goes(gateway=gateway)
    faults = data(7, -1.0) + data(9, -1.0)
    for client in range(2):
        assert scene.told(client) == faults
    scene.goes(gateway=gateway)
    scene.reads("front", 0.25, 7)
    assert scene.told() == b"", "what was on its way when it was lost is nothing that is known"
    scene.connect()
    new = registration(DISTANCE, 9, b"rear") + registration(90, 10, b"x")
    assert scene.told(2) == CAR_BYTES + new + faults + data(10, 0.0, 90)


def test_a_robot_that_came_back_is_known_by_what_it_says_since() -> None:
    scene = Scene(devices=(*CAR, Device("rear", 9, "distance")))
    scene.reads("front", 0.5, 7)
    scene.reads("rear", 0.5, 9)
    scene.goes()
    scene.told()
    scene.reads("rear", 0.75, 9)
    scene.established("wc2ec")
    assert scene.told() == data(9, 0.75)
    scene.connect()
    assert scene.told(1) == CAR_BYTES + registration(DISTANCE, 9, b"rear") + CAR_FAULT + data(9, 0.75)
    scene.reads("front", 0.125, 7)
    assert scene.told() == data(7, 0.125)


@pytest.mark.parametrize("protocol", ["alf", "tcpudp"])
def test_the_sectors_of_a_scan_are_registered_once_and_before_any_scan_came(protocol: str) -> None:
    scene = Scene(protocol)
    assert scene.told() == LEFT_RIGHT + sectors(*range(8))
    for metres in (2.0, 3.0):
        scene.tell(topics.SCAN, around([metres] * 360))
        assert scene.told() == b"".join(data(number, metres) for number in range(2, 10))
    scene.connect()
    assert scene.told(1) == LEFT_RIGHT + sectors(*range(8), value=3.0)


@pytest.mark.parametrize("early", [False, True], ids=["before the scanner", "after it"])
@pytest.mark.parametrize(
    ("broken", "numbers"),
    [
        ({}, (0, 1, 7)),
        ({"points": 0}, range(8)),
        ({"points": -5}, range(8)),
        ({"angle_min": NAN}, range(8)),
        ({"angle_increment": INF}, range(8)),
    ],
)
def test_the_sectors_are_those_that_a_scanner_covers_which_is_known_and_covers_any(early, broken, numbers) -> None:
    """-45 to 45 degrees: sectors 7, 0 and 1 of 8."""
    fields = {"angle_min": -math.pi / 4, "angle_max": math.pi / 4, "angle_increment": math.radians(1), "points": 91}
    scene = Scene(None, clients=int(early))
    scene.tell(topics.SCANNER, Scanner(**{**fields, **broken}, time_increment_s=0.0, range_min=0.02, range_max=5.0))
    scene.established("alf")
    if not early:
        scene.connect()
    assert scene.told() == LEFT_RIGHT + sectors(*numbers)


def test_sectors_in_their_unit_are_told_a_fault_when_the_robot_is_lost_and_are_known_by_a_new_scan_alone() -> None:
    scene = Scene("alf", sectors=2, sector_unit_m=0.01)
    assert scene.told() == LEFT_RIGHT + sectors(0, 1), "a fault has no unit"
    scene.tell(topics.SCAN, around([2.5] * 360))
    assert scene.told() == data(2, 250.0) + data(3, 250.0)
    scene.goes()
    assert scene.told() == data(2, -1.0) + data(3, -1.0)
    scene.tell(topics.SCAN, around([2.0] * 360))
    assert scene.told() == b""
    scene.goes(gateway=True)
    scene.connect()
    assert scene.told(1) == LEFT_RIGHT + sectors(0, 1)


def test_a_client_that_comes_when_nobody_was_there_for_a_while_is_told_the_last_scan() -> None:
    scene = Scene("alf", clients=0, sectors=1)
    scene.view.note(topics.SCAN, around([2.0] * 360))
    scene.connect()
    scene.told()
    scene.clients[0].lost("EOF")
    scene.view.note(topics.SCAN, around([3.0] * 360))
    scene.connect()
    assert scene.told(1) == LEFT_RIGHT + sectors(0, value=3.0)


def test_readings_of_a_robot_of_another_protocol_are_distance_sensors() -> None:
    scene = Scene("tcpudp", clients=0)
    scene.tell(topics.SENSOR("battery"), Reading(12.5))
    scene.connect()
    sent = scene.told()
    assert {name for _, name in registered(sent)} == {"left", "right", "battery"}, "and no sectors of a scan"
    number = {name: number for number, name in registered(sent)}["battery"]
    assert sent.endswith(data(number, 12.5))
    scene.tell(topics.SENSOR("battery"), Reading(12.25))
    assert scene.told() == data(number, 12.25)


# A scan, cut into sectors


def sectors_of(scene: Scene) -> dict[str, float]:
    """The values of what was registered as distance sensors, by name."""
    sent = Reader("deployed").take(scene.told())
    names = {one.number: str(one.value) for one in sent if isinstance(one.value, str)}
    return {names[one.number]: one.value for one in sent if isinstance(one.value, float)}


OBSTACLES = {-22: 1.0, 22: 1.5, 23: 2.0, 90: 2.5, 112: 3.0, 180: 4.0, 247: 5.0, 248: 6.0}
EIGHT = [1.0, 2.0, 2.5, 10.0, 4.0, 5.0, 6.0, 10.0]
LEFT_OF_IT = [2.0 if degree == 90 else 9.0 for degree in range(360)]


@pytest.mark.parametrize(
    ("sectors", "scan", "cut"),
    [
        # a point a degree, 10 m but for an obstacle or two in most; sector 0 is -22.5 to 22.5 degrees
        (8, around([OBSTACLES.get(degree, 10.0) for degree in range(-22, 338)], first_deg=-22.0), EIGHT),
        (4, around([9.0] * 89 + [9.0, 2.0] + [9.0] * 269, step_deg=-1.0), [9.0, 9.0, 9.0, 2.0]),
        (8, around([1.0] * 91, first_deg=-45.0), {"sector7": 1.0, "sector0": 1.0, "sector1": 1.0}),
        (1, around([4.0, -1.0, 3.0, -INF]), [3.0]),
        *(
            (4, around(LEFT_OF_IT[first:] + LEFT_OF_IT[:first], first_deg=begins), [9.0, 2.0, 9.0, 9.0])
            for first, begins in ((180, -180.0), (225, -135.0), (0, 0.0), (90, 90.0), (0, 360.0))
        ),
    ],
)
def test_a_scan_is_cut_into_sectors_counter_clockwise_from_straight_ahead(sectors, scan, cut) -> None:
    """Wherever the scan begins and however it turns; a point below zero is no distance."""
    scene = Scene("tcpudp", clients=0, sectors=sectors)
    scene.tell(topics.SCAN, scan)
    scene.connect()
    values = cut if isinstance(cut, dict) else {f"sector{number}": value for number, value in enumerate(cut)}
    assert sectors_of(scene) == values


def test_a_sector_where_nothing_was_measured_is_free_as_far_as_the_scanner_sees() -> None:
    scene = Scene("tcpudp", clients=0, sectors=2)
    scene.tell(topics.SCAN, around([NAN] * 180 + [INF] * 90 + [3.0] + [NAN] * 89, range_max=5.5))
    scene.connect()
    assert sectors_of(scene) == {"sector0": 3.0, "sector1": 5.5}
    scene.tell(topics.SCAN, around([NAN] * 360, range_max=INF))
    assert scene.told() == data(2, -1.0) + data(3, -1.0), "how far it sees is not known"


# What controllers set


def test_a_motor_of_the_robot_is_set_by_its_name_and_at_once() -> None:
    scene = Scene(devices=CAR)
    scene.told()
    assert scene.says(bytes.fromhex("82 35 01 0000000000000440")) == [(topics.CMD_MOTOR("fr"), Motor(2.5))]
    assert scene.says(set_value(4, -0.125, LINEAR)) == [(topics.CMD_MOTOR("lift"), Motor(-0.125))]
    assert scene.says(set_value(0, 0.0, 99)) == [(topics.CMD_MOTOR("fl"), Motor(0.0))], "never by the type alone"
    assert (scene.told(), scene.side.deadline(scene.clients[0])) == (b"", INF)
    scene.established("tcpudp")
    with pytest.raises(ProtocolError):  # the robot has become another one
        scene.says(set_value(0, 1.0))


def test_a_webots_robot_without_motors_gets_a_left_and_a_right_one_once_its_table_is_known() -> None:
    assert Scene("wc2ec").told() == b""
    scene = Scene(devices=(Device("front", 0, "distance"),))
    wheels = registration(ROTATIONAL, 1, b"left") + registration(ROTATIONAL, 2, b"right")
    assert scene.told() == registration(DISTANCE, 0, b"front") + wheels + data(0, -1.0)


@pytest.mark.parametrize(
    ("left", "right", "forward", "turn"),
    [
        (10.0, 10.0, 1.0, 0.0),
        (-5.0, -5.0, -0.5, 0.0),
        (-3.0, 3.0, 0.0, 1.0),
        (3.0, -3.0, 0.0, -1.0),
        (3.5, 6.5, 0.5, 0.5),
        (0.0, 3.0, 0.15, 0.5),
        (20.0, 20.0, 1.0, 0.0),
        (8.0, 16.0, 0.9, 1.0),
        (-30.0, 30.0, 0.0, 1.0),
        (1e9, -1e9, 0.0, -1.0),
        (0.0, 0.0, 0.0, 0.0),
    ],
)
def test_what_is_set_on_left_and_right_is_a_drive_by_the_inverse_kinematics(left, right, forward, turn) -> None:
    """Wheels of 5 cm, 30 cm apart; full scale is 0.5 m/s and 1 rad/s. Too fast keeps the curve: 1.2, 4/3 is 0.9, 1."""
    scene = Scene("tcpudp")
    *neutral, (topic, command) = scene.means(set_value(0, left) + set_value(1, right))
    assert topic is topics.CMD_DRIVE
    assert neutral == ([(topic, Drive())] if left == 0.0 else []), (
        "while all stand each value is one: a stop never waits"
    )
    assert isinstance(command, Drive)
    assert (command.forward, command.turn) == pytest.approx((forward, turn), abs=1e-12)
    assert (command.left, command.light) == (0.0, None)
    assert max(abs(command.forward), abs(command.turn)) <= 1.0


def test_the_wheels_of_the_kinematics_are_settings_and_every_controller_has_its_own() -> None:
    wheels = Wheels(wheel_radius_m=0.1, track_m=0.5, speed_full_m_s=2.0, turn_full_rad_s=4.0)
    scene = Scene("alf", wheels=wheels, clients=2)
    scene.says(set_value(0, 9.0), client=0)
    *_, (_, command) = scene.says(set_value(0, 5.0) + set_value(1, 15.0), client=1)
    assert isinstance(command, Drive)
    assert (command.forward, command.turn) == pytest.approx((0.5, 0.5))
    ((_, command),) = scene.says(set_value(1, 9.0), client=0)
    assert isinstance(command, Drive)
    assert (command.forward, command.turn) == pytest.approx((0.45, 0.0))


# A controller sets its wheels one after the other


def joined(*said: tuple[float, bytes], join_s: float = 0.03, until: float = 1.0) -> list[tuple[float, FleetMessage]]:
    """The drives that come of what is said at these moments, with theirs, to the millisecond."""
    scene = Scene("tcpudp", join_s=join_s)
    client, told = scene.clients[0], []
    for at, now_said in (*said, (until, b"")):
        due = scene.side.deadline(client)
        if due <= at:
            assert scene.side.expire(client, due - 0.0001) == ()
            told += [(due, command) for _, command in scene.side.expire(client, due)]
            assert scene.side.deadline(client) == INF
        told += [(at, command) for _, command in scene.says(now_said, now=at)]
    return [(round(at, 3), command) for at, command in told]


GO_LEFT, GO_RIGHT = set_value(0, 10.0), set_value(1, 10.0)
STOP_LEFT, STOP_RIGHT = set_value(0, 0.0), set_value(1, 0.0)
AHEAD = Drive(forward=1.0)


def rounded(drives: list[tuple[float, FleetMessage]]) -> list[tuple[float, float, float]]:
    return [(at, round(one.forward, 3), round(one.turn, 3)) for at, one in drives if isinstance(one, Drive)]


@pytest.mark.parametrize("wait_s", [0.0, 0.011, 0.02, 0.0299])
def test_two_wheels_that_are_set_shortly_after_each_other_make_one_drive_with_the_second(wait_s: float) -> None:
    """Deployed controllers take 11 to 20 ms from one to the other."""
    for first, second in ((GO_LEFT, GO_RIGHT), (GO_RIGHT, GO_LEFT)):
        assert joined((0.1, first), (0.1 + wait_s, second)) == [(round(0.1 + wait_s, 3), AHEAD)]


ALONE = (0.3, -1.0)
"""10 rad/s of the left wheel alone: 0.5 and -5/3, to full scale."""


@pytest.mark.parametrize(
    ("join_s", "said", "driven"),
    [
        (0.03, [(0.1, GO_LEFT)], [(0.13, *ALONE)]),
        (0.03, [(0.1, GO_LEFT), (0.14, GO_RIGHT), (0.16, GO_LEFT)], [(0.13, *ALONE), (0.16, 1.0, 0.0)]),
        # a wheel that is set again does not put the drive off
        (0.03, [(0.1, GO_LEFT), (0.11, GO_LEFT), (0.12, GO_LEFT)], [(0.13, *ALONE)]),
        # what is set may be driven at once
        (0.0, [(0.1, GO_LEFT), (0.11, GO_RIGHT)], [(0.1, *ALONE), (0.11, 1.0, 0.0)]),
        # a stop is never put off
        (0.03, [(0.1, STOP_RIGHT)], [(0.1, 0.0, 0.0)]),
        (1.0, [(0.1, STOP_RIGHT)], [(0.1, 0.0, 0.0)]),
        (1.0, [(0.1, GO_LEFT), (0.11, STOP_LEFT)], [(0.11, 0.0, 0.0)]),
        (
            1.0,
            [(0.1, GO_LEFT), (0.11, GO_RIGHT), (0.2, STOP_LEFT), (0.215, STOP_RIGHT)],
            [(0.11, 1.0, 0.0), (0.215, 0.0, 0.0)],
        ),
    ],
)
def test_a_wheel_that_nobody_follows_is_driven_alone_after_a_while_but_a_stop_at_once(join_s, said, driven) -> None:
    assert rounded(joined(*said, join_s=join_s, until=5.0)) == driven


def test_what_waited_is_nothing_for_a_robot_that_has_motors_by_now() -> None:
    scene = Scene("tcpudp")
    scene.says(GO_LEFT)
    scene.tell(topics.DEVICES, Devices(CAR))
    assert scene.side.expire(scene.clients[0], 1.0) == ()
    assert scene.side.deadline(scene.clients[0]) == INF


class User:
    """A client that holds the robot: what its side made it do."""

    def __init__(self, silent_s: float) -> None:
        self.silent_s = silent_s
        self.did: list[str] = []

    def repeat(self) -> None:
        self.did.append("repeat")

    def let_go(self, why: str) -> None:
        self.did.append(why)


@pytest.mark.parametrize(
    ("hold", "silent_s", "did"),
    [
        (True, 0.0, ["repeat"]),
        (True, 0.4, ["repeat"]),
        (True, 0.41, ["the connection is silent"]),
        (False, 0.0, []),
        (False, 0.41, []),
    ],
)
def test_values_are_repeated_until_the_machine_falls_silent(hold: bool, silent_s: float, did: list[str]) -> None:
    side, user = Scene("tcpudp", hold=hold).side, User(silent_s)
    assert (side.name, side.deadman_s, side.initial_commands()) == ("wc2ec", 0.5, ())
    side.attend(user)
    assert user.did == did


@pytest.mark.parametrize(
    ("number", "value", "kind"),
    [
        (7, 1.0, DISTANCE),
        (7, 1.0, ROTATIONAL),
        (9, 1.0, ROTATIONAL),
        (255, 1.0, ROTATIONAL),
        *((0, value, ROTATIONAL) for value in (NAN, INF, -INF, 1.001e9)),
    ],
)
def test_what_no_motor_can_be_set_to_is_refused_and_the_next_command_is_taken(number, value, kind) -> None:
    scene, wheels = Scene(devices=CAR), Scene("tcpudp")
    wheels.says(GO_LEFT)
    for refusing in (scene, wheels) if number == 0 and not math.isfinite(value) else (scene,):
        with pytest.raises(ProtocolError):
            refusing.says(set_value(number, value, kind))
    assert scene.says(set_value(0, 1.0)) == [(topics.CMD_MOTOR("fl"), Motor(1.0))]
    assert wheels.says(GO_RIGHT) == [(topics.CMD_DRIVE, AHEAD)], "a wheel that is set to no number keeps its velocity"
    assert scene.clients[0].state is State.ESTABLISHED


@pytest.mark.parametrize("command", [0, 127, 128, 131, 255])
def test_a_command_that_no_controller_of_the_field_sends_ends_its_session(command: int) -> None:
    scene = Scene(devices=CAR)
    said = set_value(0, 1.0) + bytes((command, 0, 0)) + set_value(0, 2.0)
    assert scene.says(said) == [(topics.CMD_MOTOR("fl"), Motor(1.0))]
    assert scene.clients[0].state is State.CLOSED


# The draft


def wanted(scene: Scene) -> list[str]:
    return [topic.path for topic in scene.side.wanted()]


def test_controllers_of_the_draft_are_registered_nothing_and_told_what_they_enabled() -> None:
    scene = draft(clients=2)
    assert (scene.told(0), wanted(scene)) == (b"", [])
    assert scene.says(bytes.fromhex("80 00 09"), client=0) == []
    assert wanted(scene) == ["sensor/light1"]
    scene.reads("light0", 0.5, 0, "light")
    scene.reads("light1", 1.5, 9, "light")
    assert scene.told(0) == bytes.fromhex("00 00 09 000000000000f83f")
    assert scene.told(1) == b""
    scene.says(bytes.fromhex("80 00 09 80 00 00"), client=1)
    scene.reads("light1", 1.0, 9, "light")
    assert scene.says(bytes.fromhex("81 00 09"), client=0) == []
    scene.reads("light1", 2.0, 9, "light")
    assert scene.told(0) == b"", "disabled: not even what waited"
    assert scene.told(1) == light(9, 2.0)
    assert wanted(scene) == ["sensor/light0", "sensor/light1"], "what anybody wants, until nobody does"
    scene.clients[1].lost("EOF")
    assert wanted(scene) == []


@pytest.mark.parametrize("values", [0, 1, 3, 255])
def test_settings_of_sensors_are_passed_on_and_how_many_values_they_have_is_a_setting(values: int) -> None:
    scene = draft(values=values)
    said = bytes.fromhex("83 00 00") + struct.pack(f"<{values}d", *range(values))
    expected = SensorSetting(values=tuple(map(float, range(values))))
    assert scene.says(said + said) == [(topics.CMD_SENSOR("light0"), expected)] * 2
    assert scene.says(bytes.fromhex("82 00 09 00 000000000000f83f")) == [
        (topics.CMD_SENSOR("light1"), SensorSetting(index=0, value=1.5))
    ]


@pytest.mark.parametrize("command", ["80 00 05", "81 00 05", "82 00 05 00 0000000000000000"])
def test_a_sensor_that_is_not_configured_is_refused(command: str) -> None:
    scene = draft()
    with pytest.raises(ProtocolError):
        scene.says(bytes.fromhex(command))
    assert scene.side.wanted() == ()


def test_a_configured_sector_of_a_scan_is_sent_to_who_enabled_it() -> None:
    scene = draft("alf")
    scene.says(bytes.fromhex("80 00 03"))
    scene.tell(topics.SCAN, around([4.0] * 360))
    assert scene.told() == light(3, 4.0)
    for number in {*range(256)} - {0, 3, 9}:
        with pytest.raises(ProtocolError):
            scene.says(bytes((0x80, 0, number)))


def test_the_draft_must_have_its_devices_listed_each_once() -> None:
    for options in (
        {"dialect": "draft"},
        {"devices": LIGHTS},
        {"dialect": "draft", "devices": (DeviceOption("a", 0), DeviceOption("b", 0))},
        {"dialect": "draft", "devices": (DeviceOption("a", 0), DeviceOption("a", 1))},
    ):
        with pytest.raises(ConfigError):
            HqOptions(**options)


# Many clients


def test_a_message_is_encoded_once_however_many_clients_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    write, encoded = display.write, []

    def counting(message: Wc2EcMessage, dialect: WireDialect) -> bytes:
        encoded.append(message)
        return write(message, dialect)

    for module in (device_table, display):
        monkeypatch.setattr(module, "write", counting)
    scene = Scene(devices=CAR, clients=250)
    assert len(encoded) == len(CAR) + 1
    scene.tell(topics.DEVICES, Devices((*CAR, Device("rear", 9, "distance"))))
    assert len(encoded) == len(CAR) + 1 + 2
    for value in range(10):
        scene.reads("front", float(value), 7)
    assert len(encoded) == len(CAR) + 1 + 2 + 10
    first = scene.told(0)
    assert all(scene.told(client) == first for client in range(1, 250))

    encoded.clear()
    scene = Scene("tcpudp", clients=250, sectors=8)
    for metres in range(1, 11):
        scene.tell(topics.SCAN, around([float(metres)] * 360))
    assert len(encoded) == 2 + 8 + 8 + 10 * 8


# Nothing deployed controllers break on

names = st.sampled_from(["a", "b", "left", "right", "sector0", "caf\udce9", "x" * 300, ""]) | st.text(
    st.characters(codec="utf-8"), max_size=3
)
shown_names = names.map(lambda name: name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace"))
kinds = st.sampled_from(["distance", "rotational", "linear", "light", "type7", "type999"])
tables = st.lists(st.builds(Device, shown_names, st.integers(-1, 256), kinds), max_size=6)
readings = st.builds(Reading, st.floats(), st.none() | kinds, st.none() | st.integers(-1, 300))
sweeps = st.builds(
    around, st.lists(st.floats(width=32), max_size=12), first_deg=st.floats(-400, 400), step_deg=st.floats(-90, 90)
)
published = st.one_of(
    st.tuples(st.just(topics.DEVICES), tables.map(lambda table: Devices(tuple(table)))),
    st.tuples(names.map(topics.SENSOR), readings),
    st.tuples(st.just(topics.SCAN), sweeps),
    st.tuples(
        st.just(topics.STATUS),
        st.sampled_from(["wc2ec", "tcpudp", "alf"]).map(lambda protocol: Status("established", protocol=protocol)),
    ),
)


@given(history=st.lists(published | st.just(None), max_size=12))
def test_whatever_is_on_the_bus_each_name_and_number_is_registered_once_and_before_its_data(history) -> None:
    scene = Scene(None)
    readers = [Reader("deployed")]
    known: list[dict[int, tuple[int, str]]] = [{}]
    for event in history:
        if event is None:
            scene.connect()
            readers.append(Reader("deployed"))
            known.append({})
        else:
            scene.tell(*event)
        for at, reader in enumerate(readers):
            for told in reader.take(scene.told(at)):
                assert not told.deadly
                if isinstance(told.value, str):
                    name = told.raw[4:].decode("latin-1")
                    assert name
                    assert told.number not in known[at]
                    assert told.number < 255
                    assert name not in {seen for _, seen in known[at].values()}
                    known[at][told.number] = (told.node_type, name)
                else:
                    assert known[at][told.number][0] == told.node_type
                    assert math.isfinite(told.value or 0.0)
            assert reader.rest == b""
    assert all(devices == known[0] for devices in known) or None in history


# The recording


@pytest.mark.parametrize(
    "sent",
    [
        stream(CAPTURE, source=PORT),
        registration(ROTATIONAL, 3, b"r\xe4der") + registration(DISTANCE, 200, b"caf\xe9/\\") + data(200, 0.25),
        registration(DISTANCE, 0, b"a") + registration(LINEAR, 1, b"a") + data(0, 5e-324) + data(0, 1.7e308),
    ],
    ids=["recorded", "not UTF-8", "a name twice"],
)
def test_what_a_webots_robot_sent_passes_the_bus_and_reaches_a_controller_as_it_was(sent: bytes) -> None:
    robot, scene = Wc2EcRobot(Options()), Scene(None)
    session = robot.session("robot", "tcp://robot.test:1")
    session.open(0.0)
    written = b""
    for message in session.receive(sent, 0.0):
        for topic, telemetry in robot.telemetry(message, 0):
            if isinstance(telemetry, Reading) and scene.view.protocol is None:
                scene.established("wc2ec")
                written += drained(scene.clients[0])[0]
            scene.tell(topic, payload.decode(topic.message, payload.encode(telemetry)))
        written += scene.told()
    assert written == sent.replace(b"\x00\x2e\x01\x01a", b"\x00\x2e\x01\x03a#1")
    motor = next(one.number for one in Reader("deployed").take(sent) if one.node_type in (ROTATIONAL, LINEAR))
    ((topic, command),) = scene.says(set_value(motor, 0.5))
    robot.command(topic, command, 0.0)
    assert (session.outgoing(0.0) or b"")[2:] == set_value(motor, 0.5)[2:]


def test_a_robot_that_makes_up_new_names_is_shown_to_controllers_that_come_later() -> None:
    scene = Scene("wc2ec", clients=0)
    for connection in range(5):
        names = [f"c{connection} s{number}" for number in range(255)]
        scene.tell(topics.STATUS, Status("offline", protocol="wc2ec"))
        scene.tell(topics.DEVICES, Devices(tuple(Device(name, n, "distance") for n, name in enumerate(names))))
        scene.established("wc2ec")
        scene.reads(names[0], 1.0, 0)
        client = scene.connect()
        expected = b"".join(bytes((0, 37, n, len(name))) + name.encode() for n, name in enumerate(names))
        assert scene.told(connection).startswith(expected)
        client.lost("gone")
    assert len(scene.side._table.by_name) <= 255
    assert len(scene.side._table.registrations) <= 255


def test_a_controller_that_stays_is_never_given_a_number_for_something_else() -> None:
    scene = Scene("wc2ec", [Device(f"old {number}", number, "distance") for number in range(255)])
    first = scene.told()
    scene.tell(topics.DEVICES, Devices((Device("new", 0, "distance"),)))
    scene.reads("new", 1.0, 0)
    assert scene.told() == b"", "it knows 255 devices, and can be told of no other"
    assert first.startswith(bytes.fromhex("00 25 00 05") + b"old 0")
