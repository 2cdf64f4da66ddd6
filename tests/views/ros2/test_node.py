"""A robot's node: what it reads from the fleet while somebody listens, and what it puts, whichever thread brings it."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus import Handle, Sample
from zbridge.fleet.messages import Device, Devices, Pose, Reading, Scan, Scanner
from zbridge.fleet.payload import encode
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.ros2.rmw_zenoh import read_attachment
from zbridge.ros2.types import types_of
from zbridge.views.ros2.node import RobotNode
from zbridge.views.ros2.outlets import RosSide
from zbridge.views.ros2.pictures import RosPictures
from zbridge.views.ros2.settings import RobotBody

COUNT = 300
SCAN = encode(
    Scan(angle_min=0.0, angle_increment=0.1, range_min=0.1, range_max=9.0, ranges=bytes(8))  # type: ignore[arg-type]
)


class Told(FakeBus):
    """Tells which subscriptions are direct, by path."""

    def __init__(self) -> None:
        super().__init__()
        self.direct: dict[str, bool] = {}

    def subscribe(self, key_expr: str, handler: Callable[[Sample], None], **options: Any) -> Handle:
        self.direct[key_expr.removeprefix("fleet/r1/")] = options.get("direct", False)
        return super().subscribe(key_expr, handler, **options)


class Scene:
    """One robot's node between two fake buses."""

    def __init__(self) -> None:
        self.fleet, self.ros, self.metrics = Told(), FakeBus(), Metrics()
        side = RosSide(self.ros, 0, types_of("jazzy"), self.metrics)
        self.node = RobotNode(side, self.fleet, KeySpace("fleet", "r1"), RobotBody(), drive=False)

    def listen(self, name: str, anybody: bool = True) -> None:
        """Let somebody listen to a topic, or nobody any more."""
        for notify in self.notifiers(name):
            notify(anybody)

    def notifiers(self, name: str) -> list[Callable[[bool], None]]:
        """Give what is called when somebody begins or ends to listen to a topic."""
        return [notify for key, notify in self.ros.network.listened if key.startswith((f"0/r1/{name}/", f"0/{name}/"))]

    def put(self, path: str, payload: bytes) -> None:
        """Let the robot publish; the fake bus calls whoever subscribed on this thread."""
        for key_expr, handler in tuple(self.fleet.network.subscribers):
            if key_expr == f"fleet/r1/{path}":
                handler(Sample(key_expr, payload))

    def numbers(self, name: str) -> list[int]:
        """Give the numbers of what was put on a topic, in order."""
        shown = [sample.attachment for sample in self.ros.network.history if sample.key.startswith(f"0/r1/{name}/")]
        return [read_attachment(attachment).number for attachment in shown]


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    scene = Scene()
    yield scene
    await scene.node.close()


@pytest.fixture
def switching() -> Iterator[None]:
    """Let Python switch between threads as often as it can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


async def test_streams_are_read_where_they_come_in_and_states_on_the_event_loop(scene: Scene) -> None:
    for name in ("scan", "odom", "imu", "battery_state", "map"):
        scene.listen(name)
    streams, states = {"scan", "pose", "motion", "battery"}, {"scanner", "map", "devices"}
    assert scene.fleet.direct == dict.fromkeys(streams, True) | dict.fromkeys(states, False)


async def test_nothing_is_read_that_nobody_listens_to(scene: Scene) -> None:
    scene.listen("scan")
    scene.put("scan", SCAN)
    scene.listen("scan", False)
    scene.put("scan", SCAN)
    assert scene.numbers("scan") == [1]
    read = {key for key, _ in scene.fleet.network.subscribers}
    assert read == {"fleet/r1/devices"}


async def test_a_stream_of_another_thread_is_put_in_order_while_listeners_come_and_go(scene: Scene, switching) -> None:
    scene.listen("scan")
    scene.listen("pose")
    over = threading.Event()

    def publish() -> None:
        for number in range(COUNT):
            scene.put("scan", SCAN)
            scene.put("pose", encode(Pose(float(number), 0.0, 0.0)))
        over.set()

    thread = threading.Thread(target=publish)
    thread.start()
    while not over.is_set():
        for anybody in (True, False):
            scene.listen("tf", anybody)
            scene.listen("odom", anybody)
        scene.put("scanner", encode(Scanner(0.0, 0.1, 0.1, 0.0, 0.1, 9.0, 2)))
        await asyncio.sleep(0)
    thread.join()
    for name in ("scan", "pose"):
        assert scene.numbers(name) == list(range(1, COUNT + 1))
    for name in ("tf", "odom"):
        assert scene.numbers(name) == sorted(set(scene.numbers(name)))


async def test_who_listens_does_not_change_while_a_message_is_made(scene: Scene, monkeypatch) -> None:
    scene.listen("scan")
    other = threading.Thread(target=scene.listen, args=("tf",))
    made = RosPictures.make

    def make(*given: Any) -> Any:
        other.start()
        other.join(0.05)
        assert "tf" not in repr(scene.node)
        return made(*given)

    monkeypatch.setattr(RosPictures, "make", make)
    scene.put("scan", SCAN)
    other.join()
    assert "tf" in repr(scene.node)
    assert scene.numbers("scan") == [1]


@pytest.mark.parametrize("payload", [b"\xc1", b"", encode(Pose(0.0, 0.0, 0.0))])
async def test_what_is_no_message_of_its_key_is_counted_and_left_out(scene: Scene, payload: bytes) -> None:
    scene.listen("scan")
    scene.put("scan", payload)
    assert (scene.numbers("scan"), scene.metrics.total("ros2_malformed")) == ([], 1)


def devices(*names: str) -> bytes:
    """Make what a robot says of its distance sensors."""
    told = tuple(Device(name=name, number=number, kind="distance") for number, name in enumerate(names))
    return encode(Devices(devices=told))


async def test_a_robot_whose_sensors_get_other_names_has_topics_of_those_it_has_now(scene: Scene) -> None:
    scene.put("devices", devices("a", "b"))
    before = len(scene.ros.network.tokens)
    scene.listen("range/a")
    for number in range(20):
        scene.put("devices", devices(f"a{number}", f"b{number}"))
    assert len(scene.ros.network.tokens) == before
    ranges = {key.split("/")[3] for key, _ in scene.ros.network.listened if key.startswith("0/r1/range/")}
    assert ranges == {"a19", "b19"}
    assert "range/a" not in repr(scene.node)


async def test_what_is_told_after_the_end_declares_nothing(scene: Scene) -> None:
    notifiers = [notify for name in ("scan", "diagnostics") for notify in scene.notifiers(name)]
    (take,) = [take for key, take in scene.fleet.network.subscribers if key == "fleet/r1/devices"]
    await scene.node.close()
    for notify in notifiers:
        notify(True)
    take(Sample("fleet/r1/devices", devices("ghost")))
    assert scene.fleet.network.subscribers == []
    assert scene.ros.network.tokens == []
    assert scene.numbers("diagnostics") == []


async def test_readings_of_all_sensors_come_by_one_subscription_each_to_its_topic(scene: Scene) -> None:
    scene.put("devices", devices("a", "b"))
    for name in ("range/a", "range/b"):
        scene.listen(name)
    ((_, take),) = [(key, take) for key, take in scene.fleet.network.subscribers if key == "fleet/r1/sensor/*"]
    take(Sample("fleet/r1/sensor/b", encode(Reading(1.0, "distance", 1))))
    assert (scene.numbers("range/a"), scene.numbers("range/b")) == ([], [1])
