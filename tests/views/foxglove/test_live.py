"""Robots on a fake bus: channels come and go with gateways, and only what is wanted is subscribed to."""

import json
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from tests.views.foxglove.test_hub import Looking, ids
from zbridge.client import Fleet
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Device, Devices, FleetMessage, Latch, Pose, Reading, Status, Switch
from zbridge.fleet.payload import encode
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.views.foxglove.commands import RobotCommands
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.live import LiveSource
from zbridge.views.foxglove.requests import Scale

GATEWAY = "fleet/r1/@alive/gateway"


class Scene:
    """A robot's side of a fake bus, the live source, and one viewer."""

    def __init__(self, *robots: str) -> None:
        self.robot = FakeBus()
        self.bus = self.robot.join("2")
        self.metrics = Metrics()
        self.hub = Hub()
        commands = RobotCommands(self.hub, Fleet(self.bus), {"": Scale()}, "foxglove")
        self.live = LiveSource(self.hub, self.bus, "fleet", frozenset(robots), commands, self.metrics)
        self.before = self.keys()
        self.live.start()
        self.viewer = Looking()
        self.hub.join(self.viewer)

    def keys(self) -> list[str]:
        """Give the keys and expressions that are subscribed to, but those of the server itself."""
        own = ("fleet/*/devices", "fleet/*/control", "fleet/*/status", "fleet/*/@gateway/stats")
        return sorted(key for key, _ in self.bus.network.subscribers if key not in own)

    def put(self, topic: Topic, message: FleetMessage | bytes) -> None:
        payload = message if isinstance(message, bytes) else encode(message)
        self.robot.publisher(f"fleet/r1/{topic.path}", topic).put(payload)

    def subscribe(self, *topics_: str) -> None:
        for topic in topics_:
            channel_id = ids(self.viewer)[topic]
            assert self.hub.subscribe(self.viewer, channel_id, channel_id)

    def leave(self, topic: str) -> None:
        self.hub.unsubscribe(self.viewer, ids(self.viewer)[topic])

    def shown(self, topic: str) -> list[bytes]:
        return [data for number, data in self.viewer.shown if number == ids(self.viewer)[topic]]


@pytest.fixture
def scene() -> Scene:
    scene = Scene()
    scene.robot.announce(GATEWAY)
    return scene


async def test_only_what_somebody_wants_is_subscribed_to(scene: Scene) -> None:
    assert scene.keys() == []
    scene.subscribe("/r1/pose")
    assert scene.keys() == ["fleet/r1/pose"]
    scene.subscribe("/r1/tf")  # of poses and scans
    assert scene.keys() == ["fleet/r1/pose", "fleet/r1/scan"]
    scene.put(topics.POSE, Pose(1.0, 2.0, 3.0))
    assert (len(scene.shown("/r1/pose")), len(scene.shown("/r1/tf"))) == (1, 1)
    scene.leave("/r1/pose")
    assert scene.keys() == ["fleet/r1/pose", "fleet/r1/scan"]
    scene.put(topics.POSE, Pose(1.0, 2.0, 3.0))
    assert (len(scene.shown("/r1/pose")), len(scene.shown("/r1/tf"))) == (1, 2)
    scene.leave("/r1/tf")
    assert scene.keys() == []


async def test_a_robot_is_there_while_its_gateway_is_and_leaves_nothing_behind() -> None:
    scene = Scene()
    assert ids(scene.viewer) == {}
    token = scene.robot.announce(GATEWAY)
    assert {"/r1/scan", "/r1/pose", "/r1/map", "/r1/log"} <= set(ids(scene.viewer))
    assert {service.name for service in scene.live.commands.services()} >= {
        "/stop",
        "/r1/stop",
        "/r1/light",
        "/r1/mode",
    }
    scene.subscribe("/r1/pose")
    token.close()
    assert scene.keys() == []
    assert {service.name for service in scene.live.commands.services()} == {"/stop", "/latch", "/unlatch"}
    assert scene.viewer.over


async def test_only_named_robots_are_shown() -> None:
    scene = Scene("r2")
    scene.robot.announce(GATEWAY)
    scene.robot.announce("fleet/r2/@alive/gateway")
    assert {topic.split("/")[1] for topic in ids(scene.viewer)} == {"r2"}


async def test_sensors_have_channels_as_they_are_announced_or_heard_of(scene: Scene) -> None:
    scene.put(topics.DEVICES, Devices((Device("front left", 1, "distance"),)))
    assert "/r1/sensor/front%20left" in ids(scene.viewer)
    scene.subscribe("/r1/sensor/front%20left", "/r1/sensors")
    assert scene.keys() == ["fleet/r1/sensor/*"]
    scene.put(topics.SENSOR("front left"), Reading(1.5, "distance"))
    scene.put(topics.SENSOR("other"), Reading(2.5))
    assert "/r1/sensor/other" in ids(scene.viewer)
    assert [json.loads(data)["value"] for data in scene.shown("/r1/sensor/front%20left")] == [1.5]
    all_of_them = [json.loads(data) for data in scene.shown("/r1/sensors")]
    assert [(reading["sensor"], reading["value"]) for reading in all_of_them] == [("front left", 1.5), ("other", 2.5)]


async def test_garbage_on_the_bus_is_counted_and_shown_to_nobody(scene: Scene) -> None:
    scene.subscribe("/r1/pose")
    scene.put(topics.POSE, b"\xc1garbage")
    scene.put(topics.DEVICES, b"\xc1garbage")
    scene.put(topics.CONTROL, b"\xc1garbage")
    assert scene.shown("/r1/pose") == []
    assert scene.metrics.total("foxglove_malformed") == 3


async def test_viewers_are_warned_of_a_latched_robot_for_as_long_as_it_is() -> None:
    scene = Scene()
    token = scene.robot.announce(GATEWAY)
    latch = Latch(b"a" * 16, "ann", "a cable is loose")
    for control in (Control("free"), Control("latched", latches=(latch,)), Control("latched", latches=(latch,))):
        scene.put(topics.CONTROL, control)
    later = Looking()
    scene.hub.join(later)
    warned = {"op": "status", "level": 1, "id": "latched.r1", "message": "r1: latched by ann (a cable is loose)"}
    for viewer in (scene.viewer, later):
        assert [said for said in viewer.said if said["op"] == "status"] == [warned]
    scene.put(topics.CONTROL, Control("stopped"))
    removed = {"op": "removeStatus", "statusIds": ["latched.r1"]}
    assert scene.viewer.said[-1] == later.said[-1] == removed
    scene.put(topics.CONTROL, Control("latched", latches=(latch,)))
    token.close()
    assert [said for said in later.said if said["op"] == "removeStatus"] == [removed] * 2


async def test_viewers_are_warned_of_a_robot_that_is_away_and_why(scene: Scene) -> None:
    away = {"op": "status", "level": 1, "id": "state.r1", "message": "r1: offline: no route to host"}
    scene.put(topics.STATUS, Status("established"))
    scene.put(topics.STATUS, Status("offline", reason="no route to host"))
    scene.put(topics.STATUS, Status("offline", reason="no route to host"))
    assert [said for said in scene.viewer.said if said["op"] == "status"] == [away]
    scene.put(topics.STATUS, Status("established", stalled=True))
    assert scene.viewer.said[-1] == away | {"message": "r1: the robot's link is stalled"}
    scene.put(topics.STATUS, Status("established"))
    assert scene.viewer.said[-1] == {"op": "removeStatus", "statusIds": ["state.r1"]}


async def test_parameters_follow_the_robot_while_somebody_watches_them(scene: Scene) -> None:
    told: list[dict[str, Any]] = []
    scene.viewer.parameters_changed = told.append  # type: ignore[method-assign]
    assert scene.keys() == []
    scene.live.watch_parameters(True)
    assert scene.keys() == ["fleet/*/camera", "fleet/*/lidar"]
    scene.put(topics.LIDAR, Switch(True))
    scene.put(topics.LIDAR, Switch(True))
    assert told == [{"r1.lidar": True}]
    scene.live.watch_parameters(False)
    assert scene.keys() == []
    scene.put(topics.CAMERA, Switch(True))
    assert (await scene.live.parameters(("r1.camera", "r1.mode"))) == {"r1.camera": True, "r1.mode": "none"}
