"""What is known of a robot from the bus: its last values, and whether it can be used."""

import numpy as np
import pytest

from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Control,
    Device,
    Devices,
    Drive,
    FleetMessage,
    Map,
    Motion,
    Pose,
    Reading,
    Scan,
    Scanner,
    Status,
    Switch,
    Text,
)
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import READINGS, RobotView

ESTABLISHED = Status(state="established", protocol="toy", version="1.3", features=("udp", "lidar"))
POSE = Pose(x=1.0, y=2.0, heading=0.5)
KEPT: list[tuple[Topic, str, FleetMessage]] = [
    (topics.STATUS, "status", ESTABLISHED),
    (topics.CONTROL, "control", Control(state="free")),
    (topics.POSE, "pose", POSE),
    (topics.MAP, "map", Map(1, 1, 0.1, (0.0, 0.0), np.zeros((1, 1), np.uint8))),
    (topics.SCAN, "scan", Scan(0.0, 0.1, 0.1, 10.0, np.ones(3, np.float32))),
    (topics.MOTION, "motion", Motion(speed=0.5)),
    (topics.SCANNER, "scanner", Scanner(0.0, 1.0, 0.5, 0.0, 0.1, 10.0, 3)),
    (topics.LIDAR, "lidar", Switch(on=True)),
    (topics.CAMERA, "camera", Switch(on=False)),
    (topics.DEVICES, "devices", Devices(devices=(Device("front", 0, "distance"),))),
]


@pytest.fixture
def view() -> RobotView:
    """A view of a robot that is established."""
    view = RobotView()
    view.alive = True
    view.note(topics.STATUS, ESTABLISHED)
    return view


def test_a_new_view_knows_nothing() -> None:
    view = RobotView()
    assert all(getattr(view, name) is None for _, name, _ in KEPT)
    assert (view.protocol, view.version, view.features, view.readings) == (None, None, None, {})
    assert view.missing == "no gateway serves the robot"


@pytest.mark.parametrize(("topic", "name", "message"), KEPT, ids=[name for _, name, _ in KEPT])
def test_the_last_value_is_kept(view: RobotView, topic: Topic, name: str, message: FleetMessage) -> None:
    others = {other: getattr(view, other) for _, other, _ in KEPT if other != name}
    view.note(topic, message)
    assert getattr(view, name) is message
    assert {other: getattr(view, other) for other in others} == others


def test_what_is_no_state_of_the_robot_is_not_kept(view: RobotView) -> None:
    before = {name: value for name, value in vars(view).items() if name != "readings"}
    view.note(topics.TEXT, Text(text="hi"))
    view.note(topics.CMD_DRIVE, Drive(forward=1.0))
    view.note(topics.CMD_LIDAR, Switch(on=True))
    assert {name: value for name, value in vars(view).items() if name != "readings"} == before


def test_readings_are_kept_by_the_names_of_their_sensors(view: RobotView) -> None:
    for name in ("front", "front left", "", "ü/*"):
        view.note(topics.SENSOR(name), Reading(value=1.0))
    view.note(topics.SENSOR("front"), Reading(value=2.0))
    values = {name: reading.value for name, reading in view.readings.items()}
    assert values == {"front": 2.0, "front left": 1.0, "": 1.0, "ü/*": 1.0}


def test_readings_of_so_many_sensors_are_kept_and_no_more(view: RobotView) -> None:
    for number in range(READINGS + 10):
        view.note(topics.SENSOR(f"s{number}"), Reading(value=1.0))
    view.note(topics.SENSOR("s0"), Reading(value=2.0))
    assert len(view.readings) == READINGS
    assert view.readings["s0"].value == 2.0


@pytest.mark.parametrize(
    ("status", "missing"),
    [
        (ESTABLISHED, None),
        (Status(state="offline", reason="no route to host"), "robot offline: no route to host"),
        (Status(state="offline"), "robot offline"),
        (Status(state="handshaking"), "robot handshaking"),
        (Status(state="closing", reason="gateway stopped"), "robot closing: gateway stopped"),
    ],
)
def test_it_says_why_the_robot_cannot_be_used(status: Status, missing: str | None) -> None:
    view = RobotView()
    view.alive = True
    assert view.missing == "no gateway serves the robot", "nothing is known of it"
    view.note(topics.STATUS, status)
    assert view.missing == missing
    view.alive = False
    assert view.missing == "no gateway serves the robot"


def test_a_robot_that_is_away_for_a_moment_keeps_what_was_agreed(view: RobotView) -> None:
    view.note(topics.POSE, POSE)
    view.note(topics.STATUS, Status(state="offline", protocol="toy"))
    assert (view.protocol, view.version, view.features) == ("toy", "1.3", ("udp", "lidar"))
    assert view.pose is POSE
    view.note(topics.STATUS, Status(state="established", protocol="toy", version="1.1"))
    assert (view.version, view.features) == ("1.1", ())
    assert view.pose is POSE


def test_a_robot_of_another_protocol_is_another_robot(view: RobotView) -> None:
    for topic, _, message in KEPT:
        view.note(topic, message)
    view.note(topics.SENSOR("front"), Reading(value=1.0))
    other = Status(state="established", protocol="other")
    view.note(topics.STATUS, other)
    assert (view.protocol, view.version, view.features) == ("other", None, ())
    assert view.status is other
    assert view.missing is None
    assert view.control is not None, "the lease is the gateway's"
    gone = [name for _, name, _ in KEPT if name not in ("status", "control")]
    assert [getattr(view, name) for name in gone] == [None] * len(gone)
    assert view.readings == {}


def test_what_came_before_the_first_status_belongs_to_the_robot() -> None:
    """A late joiner is given the last values in any order."""
    view = RobotView()
    view.note(topics.POSE, POSE)
    view.note(topics.STATUS, ESTABLISHED)
    assert view.pose is POSE


def test_a_view_prints_the_robots_protocol_and_what_is_missing(view: RobotView) -> None:
    assert repr(view) == "<RobotView toy established>"
    view.alive = False
    assert repr(view) == "<RobotView toy no gateway serves the robot>"


@pytest.mark.parametrize("state", ["offline", "connecting", "handshaking", "closing"])
def test_readings_of_a_connection_that_is_gone_make_room_for_those_of_the_next(view: RobotView, state: str) -> None:
    for number in range(READINGS + 10):
        view.note(topics.SENSOR(f"old {number}"), Reading(1.0))
    view.note(topics.STATUS, Status(state=state, protocol="toy"))  # type: ignore[arg-type]
    assert view.readings == {}
    view.note(topics.STATUS, ESTABLISHED)
    view.note(topics.SENSOR("new"), Reading(2.0))
    assert view.readings == {"new": Reading(2.0)}
