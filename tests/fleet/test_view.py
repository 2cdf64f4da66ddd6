"""What is known of a robot from the bus: its last values, and whether it can be used."""

from typing import Any

import numpy as np
import pytest

from zbridge.fleet import messages as m
from zbridge.fleet import topics
from zbridge.fleet.messages import Reading, Status, Switch
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import READINGS, RobotView

ESTABLISHED = Status("established", protocol="toy", version="1.3", features=("udp", "lidar"))
POSE = m.Pose(1.0, 2.0, 0.5)
KEPT: dict[Topic, m.FleetMessage] = {
    topics.STATUS: ESTABLISHED,
    topics.CONTROL: m.Control("free"),
    topics.POSE: POSE,
    topics.MAP: m.Map(1, 1, 0.1, (0.0, 0.0), np.zeros((1, 1), np.uint8)),
    topics.SCAN: m.Scan(0.0, 0.1, 0.1, 10.0, np.ones(3, np.float32)),
    topics.MOTION: m.Motion(speed=0.5),
    topics.SCANNER: m.Scanner(0.0, 1.0, 0.5, 0.0, 0.1, 10.0, 3),
    topics.LIDAR: Switch(on=True),
    topics.CAMERA: Switch(on=False),
    topics.DEVICES: m.Devices((m.Device("front", 0, "distance"),)),
}
NOBODY = "no gateway serves the robot"


def known(view: RobotView) -> dict[str, Any]:
    return {topic.path: getattr(view, topic.path) for topic in KEPT if getattr(view, topic.path) is not None}


def agreed(view: RobotView) -> tuple[Any, ...]:
    return view.protocol, view.version, view.features


@pytest.fixture
def view() -> RobotView:
    """A view of a robot that is established, and of which all is known."""
    view = RobotView()
    view.alive = True
    for topic, message in KEPT.items():
        view.note(topic, message)
    view.note(topics.SENSOR("front"), Reading(1.0))
    return view


@pytest.mark.parametrize("topic", KEPT, ids=lambda topic: topic.path)
def test_the_last_value_is_kept_and_a_new_view_knows_nothing(topic: Topic) -> None:
    view = RobotView()
    assert (known(view), agreed(view), view.readings, view.missing) == ({}, (None, None, None), {}, NOBODY)
    view.note(topic, KEPT[topic])
    assert known(view) == {topic.path: KEPT[topic]}
    view.note(topics.STATUS, ESTABLISHED)
    assert known(view) == {topic.path: KEPT[topic], "status": ESTABLISHED}, "what came before it belongs to the robot"


def test_what_is_no_state_of_the_robot_is_not_kept(view: RobotView) -> None:
    view.note(topics.TEXT, m.Text("hi"))
    view.note(topics.CMD_DRIVE, m.Drive(forward=1.0))
    view.note(topics.CMD_LIDAR, Switch(on=False))
    assert known(view) == {topic.path: message for topic, message in KEPT.items()}


def test_readings_are_kept_by_the_names_of_their_sensors_so_many_and_no_more() -> None:
    view = RobotView()
    names = ["front", "front left", "", "ü/*", *(f"s{number}" for number in range(READINGS))]
    for name in names:
        view.note(topics.SENSOR(name), Reading(1.0))
    view.note(topics.SENSOR("front"), Reading(2.0))
    assert list(view.readings) == names[:READINGS]
    assert [view.readings[name].value for name in names[:4]] == [2.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("status", "missing"),
    [
        (ESTABLISHED, None),
        (Status("offline", "no route to host"), "robot offline: no route to host"),
        (Status("handshaking"), "robot handshaking"),
    ],
)
def test_it_says_why_the_robot_cannot_be_used(status: Status, missing: str | None) -> None:
    view = RobotView()
    view.alive = True
    assert view.missing == NOBODY, "nothing is known of it"
    view.note(topics.STATUS, status)
    assert view.missing == missing
    view.alive = False
    assert view.missing == NOBODY


@pytest.mark.parametrize("state", ["offline", "connecting", "handshaking", "closing"])
def test_a_robot_that_is_away_for_a_moment_keeps_what_was_agreed_but_may_have_other_sensors(view, state) -> None:
    view.note(topics.STATUS, Status(state, protocol="toy"))
    assert (agreed(view), view.readings) == (("toy", "1.3", ("udp", "lidar")), {})
    view.note(topics.STATUS, Status("established", protocol="toy", version="1.1"))
    assert agreed(view) == ("toy", "1.1", ())
    assert view.pose is POSE


def test_a_robot_of_another_protocol_is_another_robot_but_its_lease_is_the_gateways(view: RobotView) -> None:
    other = Status("established", protocol="other")
    view.note(topics.STATUS, other)
    assert known(view) == {"status": other, "control": KEPT[topics.CONTROL]}
    assert (agreed(view), view.readings, view.missing) == (("other", None, ()), {}, None)
