"""The robots as a program sees them: which there are, questions, commands that need no lease, and the stop."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

import tests.client
from tests.client import subscriptions, tokens
from tests.fake_bus import FakeBus
from zbridge.bus import Answer, IncomingQuery, Sample
from zbridge.client import Fleet, Robot
from zbridge.client.stops import CONFIRM_S, REPEAT_S
from zbridge.control.events import StopCause
from zbridge.errors import BusError, NotReady, PayloadError, Refused, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Control,
    FleetMessage,
    Map,
    Pose,
    Query,
    Scan,
    SensorSetting,
    Status,
    Stop,
    Switch,
    Text,
)
from zbridge.fleet.topics import Topic

pytestmark = pytest.mark.jumping

POSE = Pose(x=1.0, y=2.0, heading=0.5)
MAP = Map(rows=1, columns=2, cell=0.1, origin=(0.0, 0.0), cells=np.array([[1, 2]], np.uint8))
SCAN = Scan(angle_min=0.0, angle_increment=0.1, range_min=0.1, range_max=4.0, ranges=np.ones(3, np.float32))
SETTING = SensorSetting(enable=True, values=(1.0, 2.0))
ESTABLISHED = Status(state="established")


class World(tests.client.World):
    @property
    def stopped(self) -> list[str]:
        """The robots that were stopped."""
        return [name for name, gateway in self.gateways.items() if gateway.machine.stops > 0]

    def taken(self, path: str) -> list[Sample]:
        """Give the samples that came on a key of r1."""
        return [sample for sample in self.bus.network.history if sample.key == f"fleet/r1/{path}"]


async def test_a_robot_has_a_feed_of_every_message_that_is_published() -> None:
    robot = World("r1").fleet["r1"]
    declared = [topic for topic in vars(topics).values() if isinstance(topic, Topic)]
    published = [topic.path for topic in declared if not topic.path.startswith("@")]
    assert len(published) >= 13
    assert [path for path in published if not hasattr(robot, path)] == []


async def test_robots_lists_what_has_a_gateway_or_a_status_in_its_own_realm() -> None:
    world = World("r2", "r1", "r3")
    world.gateways["r3"].put(topics.STATUS, b"\xc1")
    world.bus.announce("fleet/starting/@alive/gateway")
    world.bus.announce("fleet/r9/@alive/operator.7")
    status = Status(state="offline", reason="gone")
    world.bus.publisher("fleet/old/status", topics.STATUS).put(payloads.encode(status))
    robots = await world.fleet.robots()
    assert robots == {"old": status, "r1": ESTABLISHED, "r2": ESTABLISHED, "r3": None, "starting": None}
    assert list(robots) == sorted(robots)
    other = Fleet(world.bus.join("other"), "lab")
    assert await other.robots() == await other.stop() == {}
    assert world.stopped == []


@pytest.mark.parametrize(
    ("topic", "message", "ask"),
    [(topics.RPC_POSE, POSE, lambda robot: robot.ask_pose()), (topics.RPC_MAP, MAP, lambda robot: robot.ask_map())],
    ids=["pose", "map"],
)
async def test_questions_are_answered_refused_or_not_answered(topic, message, ask) -> None:
    world = World(served=False)
    with pytest.raises(BusError, match=r"^r1: no gateway answered"):
        await ask(world.robot)
    asked: list[IncomingQuery] = []

    def answer(question: IncomingQuery) -> None:
        asked.append(question)
        if len(asked) == 1:
            question.answer(payloads.encode(message))
        else:
            question.refuse(NotReady("offline"))

    world.bus.answer(f"fleet/r1/{topic.path}", answer)
    got = await ask(world.robot)
    assert type(got) is type(message)
    assert payloads.encode(got) == payloads.encode(message)
    if isinstance(got, Map):
        assert (got.cells.dtype, got.cells.shape) == (np.uint8, (1, 2))
    assert payloads.decode(Query, asked[0].payload) == Query()
    with pytest.raises(NotReady, match=r"^r1: offline$"):
        await ask(world.robot)


@pytest.mark.parametrize(
    ("path", "message", "work"),
    [
        ("light", Switch(on=True), lambda robot: robot.set_light(True)),
        ("lidar", Switch(on=False), lambda robot: robot.set_lidar(False)),
        ("camera", Switch(on=True), lambda robot: robot.set_camera(True)),
        ("text", Text(text="hello"), lambda robot: robot.say("hello")),
        ("scan", SCAN, lambda robot: robot.feed_scan(SCAN)),
        ("sensor/front%20left", SETTING, lambda robot: robot.set_sensor("front left", SETTING)),
    ],
)
async def test_commands_that_need_no_lease(path: str, message: FleetMessage, work: Callable[[Robot], Any]) -> None:
    world = World("r1")
    await work(world.robot)
    (sample,) = world.taken(f"@cmd/{path}")
    assert payloads.encode(payloads.decode(type(message), sample.payload)) == payloads.encode(message)
    assert sample.attachment is None
    ((taken, command),) = world.machine.commands
    assert (taken, type(command)) == (path, type(message))


SWITCHES = ("light", "lidar", "camera")


@pytest.mark.parametrize(
    ("status", "error", "text"),
    [
        (
            Status("established", commands=("stop", "drive")),
            Unsupported,
            "does not accept light; it accepts stop, drive",
        ),
        (Status("offline", reason="connection refused"), NotReady, "the robot is offline: connection refused"),
        (Status("connecting"), NotReady, "the robot is connecting$"),
    ],
)
async def test_what_a_robot_does_not_accept_is_refused_before_it_is_sent(
    status: Status, error: type[Refused], text: str
) -> None:
    world = World("r1")
    world.gateway.publish(topics.STATUS, status)
    with pytest.raises(error, match=text):
        await world.robot.set_light(True)
    assert world.taken("@cmd/light") == []


async def test_a_switch_of_a_robot_without_a_gateway_is_not_reported_as_sent() -> None:
    with pytest.raises(BusError, match="no gateway answers"):
        await World("r1", served=False).robot.set_lidar(True)


@pytest.mark.parametrize("name", SWITCHES)
async def test_a_listed_command_is_sent(name: str) -> None:
    world = World("r1")
    world.gateway.publish(topics.STATUS, Status("established", commands=("stop", *SWITCHES)))
    await getattr(world.robot, f"set_{name}")(True)
    assert len(world.taken(f"@cmd/{name}")) == 1


# The stop


async def test_a_stop_returns_when_the_gateway_has_confirmed_it() -> None:
    world = World("r1")
    async with world.robot.control("ann@here") as drive:
        await drive(forward=0.5)
        asked_at = world.loop.time()
        await Fleet(world.bus.join("passer-by"))["r1"].stop()
        assert world.loop.time() - asked_at < 0.1
        stops = world.machine.stops
        assert stops >= 1
        assert (world.gateway.control.state, world.gateway.control.holder) == ("stopped", None)
    sent = world.taken("@cmd/stop")
    (stop,) = {payloads.decode(Stop, sample.payload) for sample in sent}
    assert isinstance(stop.id, bytes), "by its id it is confirmed"
    assert stop.latch is msgspec.UNSET
    await asyncio.sleep(1.0)
    assert world.taken("@cmd/stop") == sent, "not sent any more"
    assert subscriptions(world.bus, "fleet/r1/control") == 0
    await world.robot.stop()
    assert world.machine.stops > stops, "a robot that is stopped is stopped too"
    async with world.robot.control("ann@here") as drive:
        await drive(forward=0.5)
    assert len(world.gateway.driven) == 2, "and can be taken again"


@pytest.mark.parametrize("shown", [b"\xc1", payloads.encode(Control(state="held", holder="ann@here")), None])
async def test_a_stop_nobody_confirms_was_sent_many_times_and_says_so(shown: bytes | None) -> None:
    world = World(served=False)
    world.bus.publisher("fleet/r1/control", topics.CONTROL).put(payloads.encode(Control(state="stopped")))
    control = world.bus.publisher("fleet/r1/control", topics.TEXT)
    if shown is not None:
        world.bus.subscribe("fleet/r1/@cmd/stop", lambda sample: control.put(shown) and None)
    asked_at = world.loop.time()
    with pytest.raises(BusError, match=r"^r1: stop sent, but no gateway confirmed it within 3 s$"):
        await world.robot.stop()
    assert world.loop.time() - asked_at == pytest.approx(CONFIRM_S, abs=0.1)
    assert len(world.taken("@cmd/stop")) == 1 + CONFIRM_S / REPEAT_S
    assert subscriptions(world.bus, "fleet/r1/control") == 0


async def test_refusals_of_long_ago_or_of_a_listener_are_none_of_this_stop() -> None:
    world = World("r1")
    world.machine.unstoppable = "not now"
    world.gateway.enforcer.stop("stop", StopCause.COMMAND)
    world.machine.unstoppable = None
    forged = NotReady("somebody said so")
    world.bus.subscribe(
        "fleet/r1/@cmd/stop", lambda _: world.gateway.authority.refuse("stop", forged, "hq.x.1", by="hq.x")
    )
    subscribers = world.bus.network.subscribers
    subscribers.insert(0, subscribers.pop())
    await world.robot.stop()
    assert world.stopped == ["r1"]
    assert world.gateway.control.refusals[-1].by == "hq.x"


@pytest.mark.parametrize(
    ("status", "why"),
    [
        (Status(state="connecting", reason="no route to host"), "connecting: no route to host"),
        (Status(state="offline"), "offline: no reason known"),
    ],
)
async def test_a_stop_taken_for_a_robot_that_cannot_be_reached_says_so(status: Status, why: str) -> None:
    world = World("r1")
    world.gateway.publish(topics.STATUS, status)
    with pytest.raises(Refused, match=rf"^r1: stop accepted, but the robot is {why}$"):
        await world.robot.stop()
    assert world.taken("@cmd/stop") != []


class SlowToAsk(FakeBus):
    """Gives every question all the time it may take."""

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(timeout_s)
        return await super().ask(key_expr, payload, timeout_s=timeout_s)


@pytest.mark.parametrize("topic", [topics.CONTROL, topics.STATUS], ids=["control", "status"])
async def test_a_stop_is_sent_before_anything_is_asked_and_although_a_state_cannot_be_read(topic: Topic) -> None:
    world = World("r1")
    world.gateway.put(topic, b"\xc1")
    stopping = asyncio.create_task(Fleet(SlowToAsk("slow", world.bus.network))["r1"].stop())
    await asyncio.sleep(0.05)
    assert world.stopped == ["r1"]
    assert not stopping.done()
    with contextlib.suppress(Refused, PayloadError):
        await stopping


async def test_all_robots_are_stopped_at_once_and_each_has_its_outcome() -> None:
    world = World("r1", "r2", "r3", "r4")
    world.gateways["r2"].machine.unstoppable = "this version knows no stop"
    world.gateways["r4"].put(topics.STATUS, b"\xc1")
    for token in ("dead1/@alive/gateway", "dead2/@alive/gateway", "program/@alive/operator.1"):
        world.bus.announce(f"fleet/{token}")
    asked_at = world.loop.time()
    outcomes = await world.fleet.stop()
    assert world.loop.time() - asked_at < CONFIRM_S + 0.2, "not one after the other"
    assert list(outcomes) == ["dead1", "dead2", "r1", "r2", "r3", "r4"]
    assert outcomes["r1"] is outcomes["r3"] is None
    assert str(outcomes["r2"]) == "r2: cannot be stopped: this version knows no stop"
    assert [type(outcomes[name]) for name in ("dead1", "dead2", "r4")] == [BusError, BusError, NotReady]
    assert world.stopped == ["r1", "r3", "r4"]
    again = (await world.fleet.stop(["r2"]))["r2"]
    assert str(again) == str(outcomes["r2"]), "every time"
    assert world.gateways["r2"].control.state == "stopped", "nobody drives it any more, whatever it does"


@pytest.mark.parametrize(("names", "stopped"), [(iter(["r3", "r1", "r3"]), ["r1", "r3"]), ("r1", ["r1"])])
async def test_only_the_named_robots_are_stopped(names: Any, stopped: list[str]) -> None:
    world = World("r1", "r2", "r3")
    assert await world.fleet.stop(names) == dict.fromkeys(stopped)
    assert world.stopped == stopped


async def test_several_robots_are_driven_at_once() -> None:
    world = World("r1", "r2")
    async with world.fleet["r1"].control("ann@here") as one, world.fleet["r2"].control("ann@here") as two:
        assert tokens(world.bus, "r1") == tokens(world.bus, "r2") == ["operator.ann%40here.mine"]
        await asyncio.gather(one.during(1.0, forward=0.5), two.during(1.0, turn=0.5))
        assert one.loss is None
        await world.fleet["r1"].stop()
        await asyncio.wait_for(one.lost.wait(), 0.1)
        assert two.loss is None
    assert len(world.gateways["r1"].driven) == len(world.gateways["r2"].driven)
