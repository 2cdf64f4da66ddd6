"""Publishers whose tokens come or go unheard: they are asked for."""

from __future__ import annotations

import asyncio
import struct
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus.interface import PriorityClass, Sample
from zbridge.client import Fleet
from zbridge.fleet import topics
from zbridge.fleet.messages import Control
from zbridge.fleet.payload import encode
from zbridge.metrics import Metrics
from zbridge.ros2.rmw_zenoh import KEEP_LAST_10, Attachment, Endpoint, Kind, Node
from zbridge.ros2.types import types_of
from zbridge.views.ros2.cmd_vel import TWIST
from zbridge.views.ros2.diagnostics import OK, WARN
from zbridge.views.ros2.driving import PUBLISHERS
from zbridge.views.ros2.outlets import RosSide
from zbridge.views.ros2.settings import RobotBody
from zbridge.views.ros2.teleop import ASK_S, RATE_HZ, SETTLE_S, STRANGERS_HZ, Teleop

pytestmark = pytest.mark.jumping
FORWARD = b"\x00\x01\x00\x00" + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0)


class Scene:
    """The cmd_vel of a robot, and what publishes there."""

    def __init__(self) -> None:
        self.bus = FakeBus()
        self.side = RosSide(self.bus, 0, types_of("jazzy"), Metrics())
        robot = Fleet(FakeBus(), "fleet", None)["r1"]
        node = self.side.node("/r1", "zbridge")
        self.fleet = FakeBus()
        self.teleop = Teleop(self.side, node, robot, RobotBody(), self.fleet, "fleet/r1/control", "ros2")
        self.driving: Any = self.teleop._driving
        self.takes = dict(self.bus.network.subscribers)
        """What is called for a sample, by its key; also after the end."""
        ((_, self.on_token),) = self.bus.network.watchers
        self.sort: Any = self.bus.network.priorities[self.endpoint().key]

    def needing(self) -> list[bool]:
        """Which publishers need neutral."""
        return [each.stick.needs_neutral is not None for each in self.driving.publishers.values()]

    def counted(self, what: str) -> int:
        return self.side.metrics.total(f"ros2_cmd_vel_{what}")

    def control(self, state: str) -> None:
        """Let the robot's gateway tell who drives."""
        self.fleet.publisher("fleet/r1/control", topics.CONTROL).put(encode(Control(state=state)))

    def endpoint(self, number: int = 1) -> Endpoint:
        return self.side.endpoint(
            Node(0, "abc", number, "/", "nav"), Kind.PUBLISHER, "/r1/cmd_vel", TWIST, KEEP_LAST_10
        )

    def put(self, endpoint: Endpoint) -> None:
        beside = Attachment(1, 1, endpoint.gid()).encode()
        self.takes[endpoint.key](Sample(endpoint.key, FORWARD, beside))

    def unheard(self, *tokens: str) -> None:
        """Change the publishers that are there, and tell nobody."""
        there = self.bus.network.tokens
        there[:] = [*(token for token in there if "/MP/" not in token), *tokens]


async def test_a_publisher_whose_token_came_unheard_is_found_when_it_commands_and_owes() -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    endpoint = scene.endpoint()
    scene.unheard(endpoint.token())
    scene.put(endpoint)
    assert scene.driving.publishers == {}
    await asyncio.sleep(ASK_S / 2)
    assert scene.needing() == [True]
    await scene.teleop.close()


async def test_publishers_that_went_unheard_make_room_for_others() -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    gone = [scene.bus.announce(scene.endpoint().token()) for _ in range(PUBLISHERS)]
    await asyncio.sleep(ASK_S)
    endpoint = scene.endpoint()
    scene.unheard()
    scene.bus.announce(endpoint.token())
    assert endpoint.gid() not in scene.driving.publishers, "there is no place"
    await asyncio.sleep(ASK_S / 2)
    assert list(scene.driving.publishers) == [endpoint.gid()]
    assert len(gone) == PUBLISHERS
    await scene.teleop.close()


async def test_a_publisher_that_was_heard_lately_stays_although_its_token_is_not_told() -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    known, stranger = scene.endpoint(), scene.endpoint()
    scene.bus.announce(known.token())
    scene.put(known)
    scene.unheard()
    scene.put(stranger)
    await asyncio.sleep(0.1)
    assert list(scene.driving.publishers) == [known.gid()]
    await scene.teleop.close()


async def test_a_publisher_that_goes_while_the_answer_is_on_its_way_is_not_entered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    endpoint = scene.endpoint()

    async def alive(_: str) -> list[str]:
        scene.bus.network.notify(endpoint.token(), False)
        return [endpoint.token()]

    monkeypatch.setattr(scene.bus, "alive", alive)
    scene.put(endpoint)
    await asyncio.sleep(ASK_S / 2)
    assert scene.driving.publishers == {}
    await scene.teleop.close()


@pytest.mark.parametrize("asked", [False, True])
async def test_a_stick_that_was_held_while_ros_s_router_was_away_owes_whatever_was_asked_meanwhile(
    monkeypatch: pytest.MonkeyPatch, asked: bool
) -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    stick, answered = scene.endpoint(), scene.bus.alive
    scene.bus.announce(stick.token())

    async def alive(key_expr: str) -> list[str]:
        there = await answered(key_expr)
        await asyncio.sleep(0.2)
        return there

    monkeypatch.setattr(scene.bus, "alive", alive)
    scene.put(stick)
    if asked:
        scene.put(scene.endpoint())
    await asyncio.sleep(0.1)
    scene.teleop.connected(False)
    await asyncio.sleep(2.0)
    assert scene.driving.publishers == {}
    scene.teleop.connected(True)
    scene.on_token(stick.token(), True)
    scene.put(stick)
    assert scene.needing() == [True]
    await scene.teleop.close()


async def test_a_twist_that_waited_until_the_end_takes_no_robot() -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    stick = scene.endpoint()
    scene.bus.announce(stick.token())
    closing = asyncio.ensure_future(scene.teleop.close())
    await asyncio.sleep(0)
    scene.put(stick)
    await closing
    assert scene.driving.driver is None


# What is heard at all, and what is told


async def test_what_a_known_publisher_sends_is_taken_at_a_bounded_rate_and_strangers_rarely() -> None:
    scene = Scene()
    known, stranger = scene.endpoint(), scene.endpoint()
    scene.bus.announce(known.token())

    def priorities(endpoint: Endpoint, count: int) -> int:
        beside = Attachment(1, 1, endpoint.gid()).encode()
        taken = [scene.sort("key", beside, len(FORWARD), lambda: FORWARD) for _ in range(count)]
        assert set(taken) <= {PriorityClass.OTHER, None}
        return sum(priority is not None for priority in taken)

    assert RATE_HZ <= priorities(known, 1000) < 2 * RATE_HZ
    assert STRANGERS_HZ <= priorities(stranger, 1000) < 2 * STRANGERS_HZ
    assert scene.counted("strangers") == 1000
    assert scene.counted("too_fast") > 500
    await asyncio.sleep(2 * SETTLE_S)
    scene.put(known)
    beside = Attachment(1, 1, known.gid()).encode()
    assert scene.sort("key", beside, len(FORWARD), lambda: FORWARD) is PriorityClass.COMMAND
    await scene.teleop.close()


@pytest.mark.parametrize(("beside", "size"), [(None, 52), (bytes(32), 52), (bytes(34), 52), (bytes(33), 64 + 34)])
async def test_what_is_no_command_by_its_size_is_dropped_and_counted(beside: bytes | None, size: int) -> None:
    scene = Scene()
    assert scene.sort("key", beside, size, lambda: b"") is None
    assert (scene.counted("malformed"), scene.counted("strangers")) == (1, 0)
    await scene.teleop.close()


async def test_tokens_of_other_types_are_counted_and_shown_until_they_go() -> None:
    scene = Scene()
    node = Node(0, "abc", 1, "/", "nav")
    wrong = Endpoint(node, 7, Kind.PUBLISHER, "/r1/cmd_vel", "std_msgs/msg/String", "RIHS01_0")
    other = Endpoint(node, 8, Kind.PUBLISHER, "/r1/cmd_vel", TWIST, "RIHS01_0")
    handles = [scene.bus.announce(each.token()) for each in (wrong, other)]
    scene.on_token("@ros2_lv/what", True)
    told = scene.teleop.diagnostics()
    assert told.level == WARN
    assert [value for name, value in told.values if name == "refused"] == [
        "/nav publishes std_msgs/msg/String RIHS01_0",
        f"/nav publishes {TWIST} RIHS01_0",
    ]
    assert (scene.counted("wrong_type"), scene.counted("tokens_unreadable")) == (2, 1)
    for handle in handles:
        handle.close()
    assert scene.teleop.diagnostics().level == OK
    assert scene.driving.publishers == {}
    await scene.teleop.close()


async def test_a_robot_that_somebody_stops_is_owed_a_zero_by_its_publishers() -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    publisher = scene.bus.announce(scene.endpoint().token())
    states = []
    for state in ("free", "held", "stopped"):
        scene.control(state)
        states.append(scene.needing())
    assert states == [[False], [False], [True]]
    told = scene.teleop.diagnostics()
    assert told.level == WARN
    assert "the robot was stopped: send a zero, or nothing for a second, then drive" in told.message
    publisher.close()
    assert scene.fleet.network.subscribers == [], "without publishers nobody looks"
    await scene.teleop.close()


async def test_a_robot_that_was_stopped_already_asks_nothing_of_who_comes() -> None:
    scene = Scene()
    await asyncio.sleep(SETTLE_S * 2)
    scene.bus.announce(scene.endpoint().token())
    for state in ("latched", "stopped"):
        scene.control(state)
    scene.fleet.publisher("fleet/r1/control", topics.CONTROL).put(b"?")
    assert scene.needing() == [False]
    await scene.teleop.close()


async def test_garbage_of_a_publisher_is_counted_and_moves_nothing() -> None:
    scene = Scene()
    endpoint = scene.endpoint()
    scene.bus.announce(endpoint.token())
    for beside, payload in ((b"?", FORWARD), (Attachment(1, 1, endpoint.gid()).encode(), FORWARD[:20])):
        scene.takes[endpoint.key](Sample(endpoint.key, payload, beside))
    assert scene.counted("malformed") == 2
    assert scene.driving.driver is None
    await scene.teleop.close()
