"""What the listeners of a process follow of a robot: one subscription and one decoding for all of them."""

import pytest

from tests.bounds import most_kept
from tests.fake_bus import FakeBus
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Pose, Reading, Status, Switch
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.metrics import Metrics

KEYS = KeySpace("fleet", "r1")
POSE = Pose(x=1.0, y=2.0, heading=0.5)
STATUS = Status(state="established", protocol="toy")


class Follower:
    def __init__(self) -> None:
        self.heard: list[tuple[str, FleetMessage]] = []
        self.alive: list[bool] = []

    def message(self, topic: Topic, message: FleetMessage) -> None:
        self.heard.append((topic.path, message))

    def gateway(self, alive: bool) -> None:
        self.alive.append(alive)


class Scene:
    def __init__(self) -> None:
        self.bus = FakeBus("hq")
        self.robot = self.bus.join("gw")
        self.metrics = Metrics()
        self.audience = RobotSubscription(self.bus, KEYS, self.metrics)

    def say(self, topic: Topic, message: FleetMessage | bytes) -> None:
        payload = message if isinstance(message, bytes) else payloads.encode(message)
        self.robot.publisher(KEYS.key(topic.path), topic).put(payload)

    def follower(self, *paths: str) -> Follower:
        """Make somebody who follows these."""
        follower = Follower()
        self.audience.follow(paths, follower.message, follower.gateway)
        return follower

    @property
    def subscribed(self) -> list[str]:
        return sorted(KEYS.path(key) for key, _ in self.bus.network.subscribers)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_follower_hears_its_paths_and_the_states_of_the_gateway_and_a_late_one_the_last_states(scene: Scene) -> None:
    scene.say(topics.LIDAR, Switch(on=True))
    follower = scene.follower("pose", "sensor/*")
    said = [(topics.POSE, POSE), (topics.SENSOR("front left"), Reading(value=1.0)), (topics.STATUS, STATUS)]
    said.append((topics.CONTROL, Control(state="free")))
    for topic, message in (*said, (topics.CAMERA, Switch(on=True))):
        scene.say(topic, message)
    assert follower.heard == [(topic.path, message) for topic, message in said]
    assert said[1][0].path == "sensor/front%20left"
    late = scene.follower("lidar", "pose")
    assert late.heard == [("lidar", Switch(on=True))], "a stream keeps nothing"
    assert scene.audience.view.lidar == Switch(on=True)


def test_many_followers_share_one_subscription_and_one_decoding(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    followers = [scene.follower("pose") for _ in range(10)]
    assert scene.subscribed == ["control", "pose", "status"]
    decoded: list[object] = []
    decode = payloads.decode

    def counted(kind: type[FleetMessage], payload: bytes) -> FleetMessage:
        decoded.append(kind)
        return decode(kind, payload)

    monkeypatch.setattr(payloads, "decode", counted)
    seen: list[object] = []
    scene.audience.also_follow("pose", lambda topic, message: seen.append(scene.audience.view.pose))
    scene.say(topics.POSE, POSE)
    assert decoded == [Pose]
    assert all(follower.heard == [("pose", POSE)] for follower in followers)
    assert seen == [POSE], "the view is noted before a follower is told"


def test_what_nobody_follows_any_more_is_not_subscribed_to_until_somebody_follows_it_again(scene: Scene) -> None:
    first, second = Follower(), Follower()
    for _ in range(3):
        scene.audience.also_follow("pose", first.message)
        scene.audience.also_follow("pose", second.message)
        scene.say(topics.POSE, POSE)
        scene.audience.unfollow("pose", first.message)
        assert scene.subscribed == ["pose"]
        for _ in range(2):
            scene.audience.unfollow("pose", second.message)
        assert scene.subscribed == []
        scene.say(topics.POSE, POSE)
    assert first.heard == second.heard == [("pose", POSE)] * 3


def test_a_follower_may_leave_while_it_is_told(scene: Scene) -> None:
    once, follower = Follower(), Follower()

    def leave(topic: Topic, message: FleetMessage) -> None:
        once.message(topic, message)
        scene.audience.unfollow("pose", leave)

    scene.audience.also_follow("pose", leave)
    scene.audience.also_follow("pose", follower.message)
    for _ in range(2):
        scene.say(topics.POSE, POSE)
    assert (len(once.heard), len(follower.heard)) == (1, 2)


def test_malformed_telemetry_is_counted_and_told_to_nobody_and_unknown_keys_are_ignored(scene: Scene) -> None:
    follower = scene.follower("pose", "colour")
    for payload in (b"\xc1", b"", payloads.pack({"x": "far"}), payloads.pack({"x": 1.0})):
        scene.say(topics.POSE, payload)
    scene.say(Topic("colour", Pose, topics.Delivery.STREAM), b"red")
    assert follower.heard == []
    assert scene.metrics.total("telemetry_malformed") == 4
    assert scene.audience.view.pose is None
    scene.say(topics.POSE, POSE)
    assert follower.heard == [("pose", POSE)]


def test_whether_the_gateway_lives_is_told_to_all_and_noted_until_the_end(scene: Scene) -> None:
    early = scene.follower("pose")
    token = scene.robot.announce(KEYS.alive("gateway"))
    scene.audience.open()
    late = scene.follower()
    scene.say(topics.STATUS, STATUS)
    assert (early.alive, late.alive) == ([False, True], [True])
    assert scene.audience.view.alive
    scene.robot.announce(KEYS.alive("hq.toy.1")).close()
    token.close()
    assert (early.alive, late.alive) == ([False, True, False], [True, False])
    assert not scene.audience.view.alive
    assert scene.audience.view.status is None, "it says nothing about the next gateway"
    scene.audience.close()
    scene.say(topics.POSE, POSE)
    scene.robot.announce(KEYS.alive("gateway"))
    assert (late.alive, early.heard, scene.subscribed) == ([True, False], [("status", STATUS)], [])


def test_names_that_a_robot_makes_up_for_ever_are_not_all_remembered(scene: Scene) -> None:
    follower = scene.follower("sensor/*")
    for number in range(3000):
        scene.say(topics.SENSOR(f"s{number}"), Reading(value=1.0))
    assert len(follower.heard) == 3000
    assert most_kept(scene.audience) <= 1024
