"""What external controllers are shown and what they command, after the protocol page.

Most tests are scripts (see ``Scene.play``). A device is written ``name/number/kind``, a registration that a controller
got ``name/number/type byte``, and a value that it got ``number=value``.
"""

import math
import re
import struct
from collections.abc import Iterable
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateways.wc2ec import device_table
from gateways.wc2ec import hq as display
from gateways.wc2ec.conformance.parser import ControllerReader as Reader
from gateways.wc2ec.hq import Wc2EcHq
from gateways.wc2ec.options import DeviceOption, Wc2EcHqOptions, Wc2EcOptions, Wheels
from gateways.wc2ec.translate import Wc2EcRobot
from tests.bounds import most_kept
from tests.captures import stream
from tests.conformance.scene import table
from tests.gateways.rig import HqScene, drained
from tests.gateways.wc2ec.golden import DISTANCE, LINEAR, ROTATIONAL, data, light, registration
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
from zbridge.protocol.session import Role, State

NAN, INF = math.nan, math.inf
CAPTURE, PORT = "wc2ec-deployed.hex", 27515
CAR = "fl/0/rotational fr/1/rotational lift/4/linear front/7/distance"
SHORT = {
    "CAR": "fl/0/53 fr/1/53 lift/4/46 front/7/37",
    "WHEELS": "left/0/53 right/1/53",
    "ALL": "fl/0/53 fr/1/53 lift/4/46 front/7/37 rear/9/37 x/10/90",
    "SECTORS": " ".join(f"sector{number}/{number + 2}/37" for number in range(8)),
}
LIGHTS = (DeviceOption("light0", 0), DeviceOption("light1", 9), DeviceOption("sector0", 3, "distance"))


def device(text: str) -> Device:
    name, number, kind = text.split("/")
    return Device(name, int(number), kind)


def around(ranges: Iterable[float], *, first_deg: float = 0.0, step_deg: float = 1.0, range_max: float = 10.0) -> Scan:
    metres = np.array(list(ranges), np.float32)
    return Scan(math.radians(first_deg), math.radians(step_deg), 0.02, range_max, metres)


def understood(sent: bytes) -> str:
    """What a legacy controller makes of bytes."""
    heard = Reader("deployed").take(sent)
    assert not any(one.deadly for one in heard)
    assert b"".join(one.raw for one in heard) == sent
    return " ".join(
        f"{one.value}/{one.number}/{one.node_type}" if isinstance(one.value, str) else f"{one.number}={one.value:g}"
        for one in heard
    )


def written_out(expected: list[str]) -> str:
    """Words with their abbreviations written out: ``EIGHT=-1`` is the same value of all eight sectors."""
    text = re.sub(r"EIGHT(=\S+)", lambda found: " ".join(f"{n}{found[1]}" for n in range(2, 10)), " ".join(expected))
    return " ".join(SHORT.get(word, word) for word in text.split())


def set_value(number: int, value: float, kind: int = ROTATIONAL) -> bytes:
    return struct.pack("<BBBd", 130, kind, number, value)


class Scene(HqScene):
    """One listener, what is known of its robot, and its clients."""

    def __init__(self, script: str = "", **options: Any) -> None:
        view = RobotView()
        super().__init__(Wc2EcHq(Wc2EcHqOptions(**options), view), view)
        self.there = False
        self.play(script)

    def play(self, script: str) -> None:  # noqa: C901, PLR0912
        """Do the steps of a script.

        ``table CAR rear/9/distance``, ``is wc2ec`` (established), ``ready`` (both, with a client), ``robot goes``,
        ``gateway goes``, ``reads front/7 0.5``, ``faults front/7 0.5``, ``scan 2.0`` (all around), ``scanner 91``
        (points, from -45 degrees); ``client`` (connects), ``0 leaves``, ``0: 7=0.5`` (what client 0 is told until
        now), ``0 sets 7 0.5 > motor/lift 0.5`` (what comes of it).
        """
        for step in re.split(r"[;\n]\s*", script):
            match step.split():
                case ["table", *devices]:
                    told = tuple(map(device, " ".join(devices).replace("CAR", CAR).split()))
                    self.tell(topics.DEVICES, Devices(told))
                case ["is", protocol]:
                    self.view.alive = True
                    self.tell(topics.STATUS, Status("established", protocol=protocol))
                case ["ready"]:
                    self.play("table CAR; is wc2ec; client; 0: CAR 7=-1")
                case ["rear", "and", "x"]:
                    self.play("table CAR rear/9/distance x/10/type90; is wc2ec")
                case ["robot", "goes"]:
                    self.tell(topics.STATUS, Status("connecting", protocol=self.view.protocol))
                case ["gateway", "goes"]:
                    self.view.alive, self.view.status = False, None
                case ["reads" | "faults" as verb, sensor, value]:
                    name, number, kind = (*sensor.split("/"), "", "distance")[:3] if "/" in sensor else (sensor, "", "")
                    reading = Reading(float(value), kind or None, int(number) if number else None, verb == "faults")
                    self.tell(topics.SENSOR(name), reading)
                case ["scan", metres]:
                    self.tell(topics.SCAN, around([float(metres)] * 360))
                case ["scanner", points]:
                    angles = -math.pi / 4, math.pi / 4, math.radians(1)
                    self.tell(topics.SCANNER, Scanner(*angles, 0.0, 0.02, 5.0, int(points)))
                case ["client"]:
                    self.connect()
                case [client, "leaves"]:
                    self.clients[int(client)].fail("EOF")
                case [client, "sets", number, value, ">", *expected]:
                    assert self.sets(int(number), float(value), int(client)) == " ".join(expected), step
                case [client, *expected]:
                    assert understood(self.told(int(client.removesuffix(":")))) == written_out(expected), step
            there = self.view.missing is None
            if there is not self.there:  # the listener tells the clients
                self.there = there
                self.send(self.side.presence(there))

    def tell(self, topic: Topic, message: FleetMessage) -> None:
        """Let the robot publish something, which the listener follows or does not."""
        self.view.note(topic, message)
        wanted = {topic.path for topic in self.side.wanted()} | {"status"}
        family = f"{topic.path.rpartition('/')[0]}/*"
        if self.clients and {topic.path, family} & {*self.side.follows, *wanted}:
            self.send(self.side.show(topic, message))

    def told(self, client: int = 0) -> bytes:
        """What leaves for a client until long after now."""
        return b"".join(drained(self.clients[client], 1000.0))

    def sets(self, number: int, value: float, client: int = 0) -> str:
        try:
            said = self.says(set_value(number, value), client)
        except ProtocolError:
            return "refused"
        return " ".join(f"{topic.path.removeprefix('@cmd/')} {command.value:g}" for topic, command in said)  # type: ignore[attr-defined]


# What controllers are shown


def test_a_client_is_told_all_devices_with_the_robots_own_numbers_in_one_write_and_once() -> None:
    scene = Scene("table CAR; is wc2ec; client")
    assert drained(scene.clients[0]) == [
        bytes.fromhex("00 35 00 02 666c")
        + bytes.fromhex("00 35 01 02 6672")
        + bytes.fromhex("00 2e 04 04 6c696674")
        + bytes.fromhex("00 25 07 05 66726f6e74"),
        bytes.fromhex("01 25 07 000000000000f0bf"),
    ]
    assert (scene.clients[0].role, scene.clients[0].state) == (Role.ROBOT, State.ESTABLISHED)
    scene.play("table CAR; is wc2ec; 0:; reads front/7 123.456; ")
    assert scene.told() == bytes.fromhex("01 25 07 77be9f1a2fdd5e40")


@table(
    """
    a device that appears later is registered with everybody and before all data that waits | plain | ready; client
        ; 1: CAR 7=-1; reads front/7 1; table CAR rear/9/distance; reads rear/9 2; client; 0: rear/9/37 7=1 9=2
        ; 1: rear/9/37 7=1 9=2; 2: CAR rear/9/37 7=1 9=2
    a sensor that the device table does not name is registered with its number | plain | ready; reads distance-200/200 3
        ; 0: distance-200/200/37 200=3
    a client that came while the robot is registering, sensors first, gets no left and right | plain | client
        ; table front/0/distance; table front/0/distance wheel/2/rotational; is wc2ec; 0: front/0/37 wheel/2/53 0=-1
    a client is told nothing of a robot before its table is known | plain | is wc2ec; client; 0:
    a Webots robot without motors gets a left and a right one once its table is known | plain | table front/0/distance
        ; is wc2ec; client; 0: front/0/37 left/1/53 right/2/53 0=-1
    devices keep their numbers when the robot comes back with others | plain | ready; robot goes; 0: 7=-1
        ; table front/0/distance fl/7/rotational new/1/distance; is wc2ec; 0: new/2/37 2=-1; reads front/0 1; 0: 7=1
        ; 0 sets 0 2 > motor/fl 2; client; 1: CAR new/2/37 7=1 2=-1
    of readings that wait the newest is sent, once and to everybody | plain | ready; client; 1: CAR 7=-1
        ; reads front/7 1; reads front/7 2; reads front/7 3; 0: 7=3; 0:; 1: 7=3
    a distance that is none is a fault, and what is no number of another sensor is left out | plain | rear and x; client
        ; 0: ALL 7=-1 9=-1 10=0; reads front/7 2; 0: 7=2; reads front/7 nan; 0: 7=-1; reads front/7 2; reads rear/9 -inf
        ; faults front/7 0.5; 0: 7=-1 9=-1; faults x/10/type90 3; 0: 10=3; reads x/10/type90 nan; 0:; client
        ; 1: ALL 7=-1 9=-1 10=0
    the last known value of every sensor follows the registration | plain | rear and x; reads front/7 0.5
        ; reads front/7 0.25; reads x/10/type90 5; client; 0: ALL 7=0.25 9=-1 10=5
    distance sensors are told a fault once when the robot goes, also to who comes then | plain | rear and x
        ; reads front/7 0.5; reads x/10/type90 5; client; 0: ALL 7=0.5 9=-1 10=5; robot goes; 0: 7=-1 9=-1; robot goes
        ; reads front/7 0.25; 0:; client; 1: ALL 7=-1 9=-1 10=0
    distance sensors are told a fault once when the gateway goes, also to who comes then | plain | rear and x
        ; reads front/7 0.5; reads x/10/type90 5; client; 0: ALL 7=0.5 9=-1 10=5; gateway goes; 0: 7=-1 9=-1
        ; gateway goes; reads front/7 0.25; 0:; client; 1: ALL 7=-1 9=-1 10=0
    a robot that came back is known by what it says since | plain | rear and x; client; reads front/7 0.5
        ; reads rear/9 0.5; robot goes; 0: ALL 7=-1 9=-1 10=0; reads rear/9 0.75; is wc2ec; 0: 9=0.75; client
        ; 1: ALL 7=-1 9=0.75 10=0; reads front/7 0.125; 0: 7=0.125
    the sectors of a scan are registered before any scan came | plain | is alf; client; 0: WHEELS SECTORS EIGHT=-1
        ; scan 3; 0: EIGHT=3; scan 2; client; 1: WHEELS SECTORS EIGHT=2
    the sectors are those that a scanner covers, also to a client that came before | plain | client; scanner 91; is alf
        ; client; 0: WHEELS sector0/2/37 sector1/3/37 sector7/4/37 2=-1 3=-1 4=-1
        ; 1: WHEELS sector0/2/37 sector1/3/37 sector7/4/37 2=-1 3=-1 4=-1
    a scanner that covers nothing tells no sectors | plain | scanner -5; is alf; client; 0: WHEELS SECTORS EIGHT=-1
    readings of a robot of another protocol are distance sensors, and no sectors are | plain | is tcpudp
        ; reads battery 12.5; client; 0: battery/0/37 left/1/53 right/2/53 0=12.5; reads battery 12.25; 0: 0=12.25
    the type byte is that of the kind, where it is known | plain | ready
        ; table a/9/type255 b/10/type256 c/11/light d/12/type e/13/type²; reads b/10 2; reads c/11 2
        ; 0: a/9/255 b/10/37 c/11/37 d/12/37 e/13/37 9=0 10=2 11=2 12=0 13=0
    a number beyond 254 is replaced while there is a free one | plain | ready; table a/255/distance b/-1/distance
        ; 0: a/2/37 b/3/37 2=-1 3=-1
    a motor is set by its name, never by the type alone | plain | ready; 0 sets 1 2.5 > motor/fr 2.5
        ; 0 sets 4 -0.125 > motor/lift -0.125; 0:
    what is no motor or no number is refused, and the next is taken | plain | ready; 0 sets 7 1 > refused
        ; 0 sets 9 1 > refused; 0 sets 255 1 > refused; 0 sets 0 nan > refused; 0 sets 0 -inf > refused
        ; 0 sets 0 1.001e9 > refused; 0 sets 0 1 > motor/fl 1
    the motors of a robot that has become another one are refused | plain | ready; is tcpudp; table
        ; 0 sets 0 1 > refused
    the type bytes are settings | other types | table CAR; is wc2ec; client
        ; 0: fl/0/54 fr/1/54 lift/4/47 front/7/38 7=-1; reads front/7 1; 0: 7=1
    sectors in their unit are faults when the robot is lost, and known by a new scan alone | two sectors | is alf
        ; client; 0: WHEELS sector0/2/37 sector1/3/37 2=-1 3=-1; scan 2.5; 0: 2=250 3=250; robot goes; 0: 2=-1 3=-1
        ; scan 2; 0:; is alf; 0 leaves; scan 3; client; 1: WHEELS sector0/2/37 sector1/3/37 2=300 3=300; gateway goes
        ; client; 2: WHEELS sector0/2/37 sector1/3/37 2=-1 3=-1
    """,
    {
        "plain": {},
        "other types": {"distance_type": 38, "rotational_type": 54, "linear_type": 47},
        "two sectors": {"sectors": 2, "sector_unit_m": 0.01},
    },
)
def test_what_controllers_are_shown_and_set(options: dict[str, Any], steps: list[str]) -> None:
    Scene("; ".join(steps), **options)


def test_a_name_that_a_registration_cannot_hold_is_left_out() -> None:
    names = ("n" * 255, "n" * 256, "ü" * 128, "")
    table = " ".join(f"{name}/{number}/distance" for number, name in enumerate(names))
    Scene(f"table {table} m/9/linear; is wc2ec; client; 0: {names[0]}/0/37 m/9/46 0=-1")


def test_sectors_are_counted_counter_clockwise_from_straight_ahead_and_free_as_far_as_the_scanner_sees() -> None:
    scene = Scene("is tcpudp; client; 0: WHEELS SECTORS EIGHT=-1")
    obstacles = {-22: 1.0, 22: 1.5, 23: 2.0, 90: 2.5, 112: 3.0, 180: 4.0, 247: 5.0, 248: 6.0}
    scene.tell(topics.SCAN, around([obstacles.get(degree, NAN) for degree in range(-22, 338)], first_deg=-22.0))
    scene.play("0: 2=1 3=2 4=2.5 5=10 6=4 7=5 8=6 9=10")
    scene.tell(topics.SCAN, around([NAN] * 360, range_max=INF))
    scene.play("0: EIGHT=-1")


def test_a_name_that_is_not_utf_8_is_shown_escaped_and_reaches_a_controller_as_the_robot_has_it() -> None:
    scene = Scene("table caf\\xe9/0/distance r\\xe4der/1/rotational gr\u00fcn/2/distance; is wc2ec; client")
    scene.tell(topics.SENSOR("caf\udce9"), Reading(1.0, "distance", 0))
    registered = registration(DISTANCE, 0, b"caf\xe9") + registration(ROTATIONAL, 1, b"r\xe4der")
    assert scene.told() == registered + registration(DISTANCE, 2, b"gr\xc3\xbcn") + data(0, 1.0) + data(2, -1.0)
    assert scene.sets(1, 3.0) == "motor/r%E4der 3"


def test_255_devices_have_the_numbers_0_to_254_and_one_more_has_none() -> None:
    names = [f"d{number}/{number}" for number in range(255)]
    scene = Scene(f"table {' '.join(f'{name}/type7' for name in names)} late/255/type7; is wc2ec; client")
    scene.play(f"0: {' '.join(f'{name}/7' for name in names)} {' '.join(f'{number}=0' for number in range(255))}")
    scene.play("reads d254/254 1; reads late/255 1; 0: 254=1")


def test_numbers_of_names_that_are_gone_are_given_to_others_but_never_while_a_controller_knows_them() -> None:
    scene = Scene()
    for connection in range(5):
        names = [f"c{connection}s{number}/{number}" for number in range(255)]
        scene.play(f"robot goes; table {' '.join(f'{name}/distance' for name in names)}; is wc2ec; client")
        assert understood(scene.told(connection)).startswith(" ".join(f"{name}/37" for name in names))
        if connection < 4:
            scene.clients[connection].fail("gone")
    assert most_kept(scene.side, depth=2) == 255
    scene.play("table new/0/distance; reads new/0 1; 4:")


def test_a_message_is_encoded_once_however_many_clients_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    write = Mock(wraps=display.write)
    for module in (device_table, display):
        monkeypatch.setattr(module, "write", write)
    scene = Scene("table CAR; is wc2ec; " + "client\n" * 250)
    assert write.call_count == 4 + 1
    scene.play("table CAR rear/9/distance; " + "\n".join(f"reads front/7 {value}" for value in range(10)))
    assert write.call_count == 4 + 1 + 2 + 10
    assert {scene.told(client) for client in range(1, 250)} == {scene.told(0)}


# What controllers set


@pytest.mark.parametrize("command", [0, 127, 128, 131, 255])
def test_a_command_that_no_controller_of_the_field_sends_ends_its_session_and_no_other(command: int) -> None:
    scene = Scene("ready; client")
    said = set_value(0, 1.0) + bytes((command, 0, 0)) + set_value(0, 2.0)
    assert scene.says(said) == [(topics.CMD_MOTOR("fl"), Motor(1.0))]
    assert [client.state for client in scene.clients] == [State.CLOSED, State.ESTABLISHED]


OTHER = Wheels(wheel_radius_m=0.1, track_m=0.5, speed_full_m_s=2.0, turn_full_rad_s=4.0)


@pytest.mark.parametrize(
    ("wheels", "left", "right", "forward", "turn"),
    [
        # wheels of 5 cm, 30 cm apart; full scale is 0.5 m/s and 1 rad/s
        (Wheels(), -3.0, 3.0, 0.0, 1.0),
        (Wheels(), 3.5, 6.5, 0.5, 0.5),
        (Wheels(), 8.0, 16.0, 0.9, 1.0),  # 1.2 and 4/3: too fast keeps the curve
        (Wheels(), 1e9, -1e9, 0.0, -1.0),
        (Wheels(), 0.0, 0.0, 0.0, 0.0),
        (OTHER, 5.0, 15.0, 0.5, 0.5),
    ],
)
def test_what_is_set_on_left_and_right_is_a_drive_by_the_inverse_kinematics(wheels, left, right, forward, turn) -> None:
    scene = Scene("is tcpudp; client; client", wheels=wheels)
    scene.says(GO_RIGHT, client=1)  # every controller has wheels of its own
    *neutral, (topic, command) = scene.says(set_value(0, left) + set_value(1, right))
    assert topic is topics.CMD_DRIVE
    assert neutral == ([(topic, Drive())] if left == 0.0 else []), "while all stand each is one: a stop never waits"
    assert isinstance(command, Drive)
    assert (command.forward, command.left, command.turn) == pytest.approx((forward, 0.0, turn), abs=1e-12)


GO_LEFT, GO_RIGHT = set_value(0, 10.0), set_value(1, 10.0)


def joined(said: str, join_s: float) -> str:
    """The drives that come of what is set on the wheels, ``"0.1 left 10; 0.12 right 10"``: ``"0.12: 1 0"``."""
    scene = Scene("is tcpudp; client", join_s=join_s)
    client, told = scene.clients[0], list[tuple[float, Any]]()
    for step in (*said.split("; "), "5"):
        at, *setting = step.split()
        due = scene.side.deadline(client)
        if due <= float(at):
            assert scene.side.expire(client, due - 0.0001) == ()
            told += [(due, command) for _, command in scene.side.expire(client, due)]
            assert scene.side.deadline(client) == INF
        for wheel, value in (setting,) if setting else ():
            set_to = set_value(["left", "right"].index(wheel), float(value))
            told += [(float(at), command) for _, command in scene.says(set_to, now=float(at))]
    return "; ".join(f"{at:g}: {drive.forward:.3g} {drive.turn + 0.0:.3g}" for at, drive in told)


@pytest.mark.parametrize(
    ("join_s", "said", "driven"),
    [
        # legacy controllers take 11 to 20 ms from one wheel to the other
        *((0.03, f"0.1 left 10; {at} right 10", f"{at}: 1 0") for at in (0.1, 0.111, 0.129)),
        (0.03, "0.1 right 10; 0.12 left 10", "0.12: 1 0"),
        # of one wheel alone there are 0.5 m/s and -5/3 rad/s, to full scale
        (0.03, "0.1 left 10", "0.13: 0.3 -1"),
        (0.03, "0.1 left 10; 0.14 right 10; 0.16 left 10", "0.13: 0.3 -1; 0.16: 1 0"),
        # a wheel that is set again does not put the drive off
        (0.03, "0.1 left 10; 0.11 left 10; 0.12 left 10", "0.13: 0.3 -1"),
        # what is set may be driven at once
        (0.0, "0.1 left 10; 0.11 right 10", "0.1: 0.3 -1; 0.11: 1 0"),
        # a stop is never put off
        (1.0, "0.1 right 0", "0.1: 0 0"),
        (1.0, "0.1 left 10; 0.11 left 0", "0.11: 0 0"),
        (1.0, "0.1 left 10; 0.11 right 10; 0.2 left 0; 0.215 right 0", "0.11: 1 0; 0.215: 0 0"),
    ],
)
def test_wheels_that_are_set_one_after_the_other_are_one_drive_but_a_stop_is_one_at_once(join_s, said, driven) -> None:
    assert joined(said, join_s) == driven


def test_what_waited_is_nothing_for_a_robot_that_has_motors_by_now_and_no_number_changes_no_wheel() -> None:
    scene = Scene("is tcpudp; client")
    scene.says(GO_LEFT)
    scene.play("0 sets 0 nan > refused; table CAR")
    assert scene.side.expire(scene.clients[0], 1.0) == ()
    assert scene.side.deadline(scene.clients[0]) == INF
    scene.play("table")
    assert scene.says(GO_RIGHT) == []
    assert [*scene.side.expire(scene.clients[0], 1.0)] == [(topics.CMD_DRIVE, Drive(forward=1.0))]


def test_values_are_repeated_until_the_machine_falls_silent() -> None:
    assert (Wc2EcHq.name, Wc2EcHq.deadman_s, Scene().side.initial_commands()) == ("wc2ec", 0.5, ())
    for hold, silent_s, did in (
        (True, 0.4, [call.repeat()]),
        (True, 0.41, [call.let_go("the connection is silent")]),
        (False, 0.41, []),
    ):
        user = Mock(silent_s=silent_s)
        Scene(hold=hold).side.attend(user)
        assert user.mock_calls == did


# The draft


def test_controllers_of_the_draft_are_registered_nothing_and_told_what_they_enabled() -> None:
    scene = Scene("is alf; client; client; 0:", dialect="draft", devices=LIGHTS)
    assert scene.side.wanted() == ()
    assert scene.says(bytes.fromhex("80 00 09 80 00 03"), client=0) == []
    assert [topic.path for topic in scene.side.wanted()] == ["sensor/sector0", "sensor/light1"]
    scene.play("reads light0/0/light 0.5; reads light1/9/light 1.5; scan 4")
    assert scene.told(0) == bytes.fromhex("00 00 09 000000000000f83f") + light(3, 4.0)
    assert scene.told(1) == b""
    scene.says(bytes.fromhex("80 00 09 80 00 00"), client=1)
    scene.play("reads light1/9/light 1")
    assert scene.says(bytes.fromhex("81 00 09"), client=0) == []
    scene.play("reads light1/9/light 2; 0:")
    assert scene.told(1) == light(9, 2.0)
    scene.play("0 leaves")
    assert [topic.path for topic in scene.side.wanted()] == ["sensor/light0", "sensor/light1"]


@pytest.mark.parametrize("values", [0, 1, 3, 255])
def test_settings_of_sensors_are_passed_on_and_how_many_values_they_have_is_a_setting(values: int) -> None:
    scene = Scene("is wc2ec; client", dialect="draft", devices=LIGHTS, values=values)
    said = bytes.fromhex("83 00 00") + struct.pack(f"<{values}d", *range(values))
    expected = SensorSetting(values=tuple(map(float, range(values))))
    assert scene.says(said + said) == [(topics.CMD_SENSOR("light0"), expected)] * 2
    assert scene.says(bytes.fromhex("82 00 09 00 000000000000f83f")) == [
        (topics.CMD_SENSOR("light1"), SensorSetting(index=0, value=1.5))
    ]
    for refused in ("80 00 05", "81 00 05", "82 00 05 00 0000000000000000", "82 00 00 00 000000000000f87f"):
        with pytest.raises(ProtocolError):
            scene.says(bytes.fromhex(refused))
    assert scene.side.wanted() == ()


def test_the_draft_must_have_its_devices_listed_each_once() -> None:
    with pytest.raises(ConfigError):
        Wc2EcHqOptions(dialect="draft", devices=(DeviceOption("a", 0), DeviceOption("b", 0)))


# Whatever happens

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
    scene, readers, known = Scene(), list[Reader](), list[dict[int, tuple[int, bytes]]]()
    for event in (None, *history):
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
                    assert told.raw[4:] not in {b"", *(name for _, name in known[at].values())}
                    assert told.number not in known[at]
                    assert told.number < 255
                    known[at][told.number] = (told.node_type, told.raw[4:])
                else:
                    assert known[at][told.number][0] == told.node_type
                    assert math.isfinite(told.value or 0.0)
            assert reader.rest == b""


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
    robot, scene = Wc2EcRobot(Wc2EcOptions()), Scene("client")
    session = robot.session("robot", "tcp://robot.test:1")
    session.open(0.0)
    written = b""
    for message in session.receive(sent, 0.0):
        for topic, telemetry in robot.telemetry(message, 0):
            if isinstance(telemetry, Reading) and scene.view.protocol is None:
                scene.play("is wc2ec")
                written += drained(scene.clients[0])[0]
            scene.tell(topic, payload.decode(topic.message, payload.encode(telemetry)))
        written += scene.told()
    assert written == sent.replace(b"\x00\x2e\x01\x01a", b"\x00\x2e\x01\x03a#1")
    drained(session)  # the stops of motors that came in the read that established the session
    motor = next(one.number for one in Reader("deployed").take(sent) if one.node_type in (ROTATIONAL, LINEAR))
    ((topic, command),) = scene.says(set_value(motor, 0.5))
    robot.command(topic, command, 0.0)
    assert (session.outgoing(0.0) or b"")[2:] == set_value(motor, 0.5)[2:]
