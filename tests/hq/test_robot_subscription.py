"""What the listeners of a process follow of a robot: one subscription and one decoding for all of them."""

import pytest

from zbridge.bus.fake import FakeBus
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
        self.subscribed: list[str] = []
        subscribe = self.bus.subscribe

        def counted(key_expr: str, *args: object, **kwargs: object) -> object:
            self.subscribed.append(KEYS.path(key_expr))
            return subscribe(key_expr, *args, **kwargs)  # type: ignore[arg-type]

        self.bus.subscribe = counted  # type: ignore[method-assign, assignment]

    def say(self, topic: Topic, message: FleetMessage) -> None:
        self.raw(topic, payloads.encode(message))

    def raw(self, topic: Topic, payload: bytes) -> None:
        self.robot.publisher(KEYS.key(topic.path), topic).put(payload)

    def follower(self, *paths: str) -> Follower:
        """Make somebody who follows these."""
        follower = Follower()
        self.audience.follow(paths, follower.message, follower.gateway)
        return follower

    @property
    def subscribers(self) -> int:
        return len(self.bus._shared.subscribers)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_follower_hears_its_paths_and_the_states_of_the_gateway(scene: Scene) -> None:
    follower = scene.follower("pose", "sensor/*")
    scene.say(topics.POSE, POSE)
    scene.say(topics.SENSOR("front left"), Reading(value=1.0))
    scene.say(topics.STATUS, STATUS)
    scene.say(topics.CONTROL, Control(state="free"))
    scene.say(topics.LIDAR, Switch(on=True))
    assert follower.heard == [
        ("pose", POSE),
        ("sensor/front%20left", Reading(value=1.0)),
        ("status", STATUS),
        ("control", Control(state="free")),
    ]


def test_the_view_is_noted_before_a_follower_is_told(scene: Scene) -> None:
    seen: list[object] = []
    scene.audience.follow(("pose",), lambda topic, message: seen.append(scene.audience.view.pose), lambda alive: None)
    scene.say(topics.POSE, POSE)
    assert seen == [POSE]


def test_many_followers_share_one_subscription_and_one_decoding(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    followers = [scene.follower("pose") for _ in range(10)]
    assert sorted(scene.subscribed) == ["control", "pose", "status"]
    decoded: list[object] = []
    decode = payloads.decode

    def counted(kind: type[FleetMessage], payload: bytes) -> FleetMessage:
        decoded.append(kind)
        return decode(kind, payload)

    monkeypatch.setattr(payloads, "decode", counted)
    scene.say(topics.POSE, POSE)
    assert decoded == [Pose]
    assert all(follower.heard == [("pose", POSE)] for follower in followers)
    assert len({id(follower.heard[0][1]) for follower in followers}) == 1


def test_a_late_follower_finds_the_last_values(scene: Scene) -> None:
    scene.say(topics.STATUS, STATUS)
    scene.say(topics.LIDAR, Switch(on=True))
    scene.say(topics.POSE, POSE)
    follower = scene.follower("lidar", "pose")
    assert ("status", STATUS) in follower.heard
    assert ("lidar", Switch(on=True)) in follower.heard
    assert ("pose", POSE) not in follower.heard, "a stream keeps nothing"
    assert scene.audience.view.lidar == Switch(on=True)


def test_what_nobody_follows_any_more_is_not_subscribed_to(scene: Scene) -> None:
    first, second = Follower(), Follower()
    scene.audience.also_follow("scan", first.message)
    scene.audience.also_follow("scan", second.message)
    assert scene.subscribers == 1
    scene.audience.unfollow("scan", first.message)
    assert scene.subscribers == 1
    scene.audience.unfollow("scan", second.message)
    assert scene.subscribers == 0
    scene.audience.unfollow("scan", second.message)
    scene.audience.unfollow("pose", second.message)


def test_a_path_can_be_followed_again(scene: Scene) -> None:
    follower = Follower()
    for _ in range(3):
        scene.audience.also_follow("pose", follower.message)
        scene.say(topics.POSE, POSE)
        scene.audience.unfollow("pose", follower.message)
        scene.say(topics.POSE, POSE)
    assert follower.heard == [("pose", POSE)] * 3
    assert scene.subscribers == 0


def test_a_follower_may_leave_while_it_is_told(scene: Scene) -> None:
    heard: list[str] = []

    def once(topic: Topic, message: FleetMessage) -> None:
        heard.append("once")
        scene.audience.unfollow("pose", once)

    follower = Follower()
    scene.audience.also_follow("pose", once)
    scene.audience.also_follow("pose", follower.message)
    scene.say(topics.POSE, POSE)
    scene.say(topics.POSE, POSE)
    assert heard == ["once"]
    assert follower.heard == [("pose", POSE)] * 2


def test_malformed_telemetry_is_counted_and_told_to_nobody(scene: Scene) -> None:
    follower = scene.follower("pose")
    for payload in (b"\xc1", b"", payloads.pack({"x": "far"}), payloads.pack({"x": 1.0})):
        scene.raw(topics.POSE, payload)
    assert follower.heard == []
    assert scene.metrics.total("telemetry_malformed") == 4
    assert scene.audience.view.pose is None
    scene.say(topics.POSE, POSE)
    assert follower.heard == [("pose", POSE)]


def test_a_key_that_the_design_does_not_know_is_ignored(scene: Scene) -> None:
    follower = Follower()
    scene.audience.also_follow("**", follower.message)
    scene.raw(Topic("colour", Pose, topics.Delivery.STREAM), b"red")
    scene.say(topics.POSE, POSE)
    assert follower.heard == [("pose", POSE)]


def test_whether_the_gateway_lives_is_told_to_all_and_noted(scene: Scene) -> None:
    early = scene.follower()
    token = scene.robot.announce(KEYS.alive("gateway"))
    scene.audience.open()
    late = scene.follower()
    assert (early.alive, late.alive) == ([False, True], [True])
    assert scene.audience.view.alive
    scene.robot.announce(KEYS.alive("hq.toy.1")).close()
    token.close()
    assert (early.alive, late.alive) == ([False, True, False], [True, False])
    assert not scene.audience.view.alive


def test_a_closed_audience_leaves_nothing_on_the_bus(scene: Scene) -> None:
    scene.audience.open()
    follower = scene.follower("pose", "scan")
    scene.audience.close()
    scene.say(topics.POSE, POSE)
    scene.robot.announce(KEYS.alive("gateway"))
    assert (follower.heard, follower.alive) == ([], [False])
    assert scene.subscribers == 0


def test_an_audience_that_was_never_opened_can_be_closed(scene: Scene) -> None:
    scene.audience.close()
    assert repr(scene.audience) == "<RobotSubscription of r1, []>"


def test_names_that_a_robot_makes_up_for_ever_are_not_all_remembered(scene: Scene) -> None:
    follower = scene.follower("sensor/*")
    for number in range(3000):
        scene.say(topics.SENSOR(f"s{number}"), Reading(value=1.0))
    assert len(follower.heard) == 3000
    assert len(scene.audience._topics) <= 1024
    assert KEYS.key("sensor/s2999") in scene.audience._topics, "and the newest are known"
