"""The robots as a program sees them: which there are, questions, commands that need no lease, and the stop."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.client import Gateway, settle, subscriptions, tokens
from zbridge.bus import Answer, IncomingQuery, Sample
from zbridge.bus.fake import FakeBus
from zbridge.client import Fleet, Robot
from zbridge.client.fleet import CONFIRM_S
from zbridge.errors import BusError, Held, NotReady, PayloadError, Refused
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


class World:
    """Some robots, each with its gateway, and a program."""

    def __init__(self, *names: str) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = FakeBus()
        self.fleet = Fleet(self.bus.join("program"))
        self.robot: Robot = self.fleet["r1"]
        self.gateways = {name: Gateway(self.bus, name) for name in names}
        for gateway in self.gateways.values():
            gateway.serve()

    @property
    def gateway(self) -> Gateway:
        return self.gateways["r1"]

    def taken(self, path: str) -> list[Sample]:
        """Give the samples that came on a key of r1."""
        return [sample for sample in self.bus._shared.history if sample.key == f"fleet/r1/{path}"]


# Which robots there are


async def test_robots_lists_what_has_a_gateway_or_a_status() -> None:
    world = World("r2", "r1")
    world.bus.announce("fleet/starting/@alive/gateway")
    world.bus.announce("fleet/r9/@alive/operator.7")
    status = Status(state="offline", reason="gone")
    world.bus.publisher("fleet/old/status", topics.STATUS).put(payloads.encode(status))
    Gateway(FakeBus(), "elsewhere").serve()
    established = Status(state="established")
    assert await world.fleet.robots() == {"old": status, "r1": established, "r2": established, "starting": None}
    assert list(await world.fleet.robots()) == ["old", "r1", "r2", "starting"], "in order of their names"


async def test_a_status_nobody_can_read_counts_as_none() -> None:
    world = World("r1", "r2")
    world.gateway.put(topics.STATUS, b"\xc1")
    assert await world.fleet.robots() == {"r1": None, "r2": Status(state="established")}


async def test_without_robots_the_list_is_empty() -> None:
    assert await World().fleet.robots() == {}
    assert await World().fleet.stop() == {}


async def test_a_realm_sees_its_own_robots_only() -> None:
    world = World("r1")
    other = Fleet(world.bus.join("other"), "lab")
    assert await other.robots() == {}
    assert await other.stop() == {}
    assert await other["r1"].status.last() is None
    assert world.gateway.machine.stops == 0


async def test_fleet_and_robots_print_what_they_are() -> None:
    world = World()
    assert repr(world.fleet) == "<Fleet fleet>"
    assert repr(world.robot) == "<Robot fleet/r1>"
    assert repr(Fleet(world.bus, "lab")["r2"]) == "<Robot lab/r2>"
    assert world.robot.name == "r1"
    assert repr(world.robot.control) == "<ControlFeed fleet/r1/control>"


# Questions


@pytest.mark.parametrize(
    ("topic", "message", "ask"),
    [(topics.RPC_POSE, POSE, lambda robot: robot.ask_pose()), (topics.RPC_MAP, MAP, lambda robot: robot.ask_map())],
    ids=["pose", "map"],
)
async def test_questions_are_answered_refused_or_not_answered(topic, message, ask) -> None:
    world = World()
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
    assert payloads.decode(Query, asked[0].payload) == Query()
    with pytest.raises(NotReady, match=r"^r1: offline$"):
        await ask(world.robot)


async def test_an_asked_maps_cells_are_an_array_of_rows_and_columns() -> None:
    world = World()
    world.bus.answer("fleet/r1/@rpc/map", lambda question: question.answer(payloads.encode(MAP)))
    cells = (await world.robot.ask_map()).cells
    assert (cells.dtype, cells.shape) == (np.uint8, (1, 2))


# Commands that everybody may give


@pytest.mark.parametrize(
    ("path", "message", "work"),
    [
        ("light", Switch(on=True), lambda robot: robot.set_light(True)),
        ("lidar", Switch(on=False), lambda robot: robot.set_lidar(False)),
        ("camera", Switch(on=True), lambda robot: robot.set_camera(True)),
        ("text", Text(text="hello"), lambda robot: robot.say("hello")),
        ("scan", SCAN, lambda robot: robot.feed_scan(SCAN)),
        (
            "sensor/front%20left",
            SensorSetting(enable=True, values=(1.0, 2.0)),
            lambda robot: robot.set_sensor("front left", SensorSetting(enable=True, values=(1.0, 2.0))),
        ),
    ],
)
async def test_commands_that_need_no_lease(path: str, message: FleetMessage, work: Callable[[Robot], Any]) -> None:
    world = World("r1")
    await work(world.robot)
    (sample,) = world.taken(f"@cmd/{path}")
    assert payloads.encode(payloads.decode(type(message), sample.payload)) == payloads.encode(message)
    assert sample.attachment is None
    ((taken, command),) = world.gateway.machine.commands
    assert taken == path
    assert type(command) is type(message)


# The stop


async def test_a_stop_returns_when_the_gateway_has_confirmed_it() -> None:
    world = World("r1")
    async with world.robot.control("ann@here") as drive:
        await drive(forward=0.5)
        asked_at = world.loop.time()
        await Fleet(world.bus.join("passer-by"))["r1"].stop()
        assert world.loop.time() - asked_at < 0.1
        assert world.gateway.machine.stops >= 1
        assert world.gateway.control.state == "stopped"
        assert world.gateway.control.holder is None
    sent = world.taken("@cmd/stop")
    assert {payloads.decode(Stop, sample.payload) for sample in sent} == {Stop()}
    await asyncio.sleep(1.0)
    assert world.taken("@cmd/stop") == sent, "not sent any more"
    assert subscriptions(world.bus, "fleet/r1/control") == 0


async def test_a_robot_that_is_free_or_stopped_is_stopped_too() -> None:
    world = World("r1")
    await world.robot.stop()
    stops = world.gateway.machine.stops
    assert stops >= 1
    await world.robot.stop()
    assert world.gateway.machine.stops > stops


async def test_a_stop_that_is_lost_is_sent_again() -> None:
    world = World()
    heard: list[Sample] = []

    def confirm(sample: Sample) -> None:
        heard.append(sample)
        if len(heard) == 5:
            control = payloads.encode(Control(state="stopped"))
            world.loop.call_later(0.01, world.bus.publisher("fleet/r1/control", topics.CONTROL).put, control)

    world.bus.subscribe("fleet/r1/@cmd/stop", confirm)
    asked_at = world.loop.time()
    await world.robot.stop()
    assert world.loop.time() - asked_at < 0.3
    assert 5 <= len(heard) <= 6


async def test_what_was_stopped_before_is_no_confirmation() -> None:
    world = World()
    world.bus.publisher("fleet/r1/control", topics.CONTROL).put(payloads.encode(Control(state="stopped")))
    with pytest.raises(BusError, match="no gateway confirmed"):
        await world.robot.stop()


@pytest.mark.parametrize("payload", [b"\xc1", payloads.encode(Control(state="held", holder="ann@here"))])
async def test_anything_else_on_control_is_no_confirmation(payload: bytes) -> None:
    world = World()
    publisher = world.bus.publisher("fleet/r1/control", topics.TEXT)
    world.bus.subscribe("fleet/r1/@cmd/stop", lambda sample: publisher.put(payload) and None)
    with pytest.raises(BusError, match="no gateway confirmed"):
        await world.robot.stop()


async def test_a_stop_nobody_confirms_was_sent_many_times_and_says_so() -> None:
    world = World()
    asked_at = world.loop.time()
    with pytest.raises(BusError, match=r"^r1: stop sent, but no gateway confirmed it within 2 s$"):
        await world.robot.stop()
    assert world.loop.time() - asked_at == pytest.approx(CONFIRM_S, abs=0.1)
    assert len(world.taken("@cmd/stop")) >= 20
    assert subscriptions(world.bus, "fleet/r1/control") == 0


async def test_who_tells_that_a_listener_refused_a_stop_makes_no_stop_fail() -> None:
    world = World("r1")

    def tell(_: Sample) -> None:
        world.gateway.authority.refuse("stop", NotReady("somebody said so"), "hq.x.1", by="hq.x")

    subscribers = world.bus._shared.subscribers
    world.bus.subscribe("fleet/r1/@cmd/stop", tell)
    subscribers.insert(0, subscribers.pop())
    await world.robot.stop()
    assert world.gateway.control.refusals[0].command == "stop"


async def test_a_robot_that_cannot_be_stopped_is_refused_with_the_reason_every_time() -> None:
    world = World("r1")
    world.gateway.machine.unstoppable = "this version knows no stop"
    for _ in range(2):
        with pytest.raises(Refused, match=r"^r1: cannot be stopped: this version knows no stop$"):
            await world.robot.stop()
    assert world.gateway.control.state == "stopped", "nobody drives it any more, whatever it does"


async def test_a_refusal_of_long_ago_is_none_of_this_stop() -> None:
    world = World("r1")
    world.gateway.machine.unstoppable = "not now"
    world.gateway.enforcer.stop("stop")
    world.gateway.machine.unstoppable = None
    await world.robot.stop()
    assert world.gateway.machine.stops >= 1


async def test_a_stop_taken_for_a_robot_that_cannot_be_reached_says_so() -> None:
    world = World("r1")
    world.gateway.publish(topics.STATUS, Status(state="connecting", reason="no route to host"))
    with pytest.raises(Refused, match=r"^r1: stop taken, but the robot is connecting: no route to host$"):
        await world.robot.stop()
    world.gateway.publish(topics.STATUS, Status(state="offline"))
    with pytest.raises(Refused, match=r"^r1: stop taken, but the robot is offline: no reason known$"):
        await world.robot.stop()
    assert len(world.taken("@cmd/stop")) >= 2


@pytest.mark.parametrize("topic", [topics.CONTROL, topics.STATUS], ids=["control", "status"])
async def test_a_stop_is_sent_although_a_state_cannot_be_read(topic: Topic) -> None:
    world = World("r1")
    world.gateway.put(topic, b"\xc1")
    with contextlib.suppress(Refused, PayloadError):
        await world.robot.stop()
    assert world.gateway.machine.stops >= 1


class SlowToAsk(FakeBus):
    """Gives every question all the time it may take."""

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(timeout_s)
        return await super().ask(key_expr, payload, timeout_s=timeout_s)


async def test_a_stop_is_sent_before_anything_is_asked() -> None:
    world = World("r1")
    stopping = asyncio.create_task(Fleet(SlowToAsk("slow", world.bus._shared))["r1"].stop())
    await asyncio.sleep(0.05)
    assert world.gateway.machine.stops >= 1
    assert not stopping.done()
    await stopping


async def test_all_robots_are_stopped_at_once_and_each_has_its_outcome() -> None:
    world = World("r1", "r2", "r3")
    world.gateways["r2"].machine.unstoppable = "no"
    world.bus.announce("fleet/dead1/@alive/gateway")
    world.bus.announce("fleet/dead2/@alive/gateway")
    world.bus.announce("fleet/program/@alive/operator.1")
    asked_at = world.loop.time()
    outcomes = await world.fleet.stop()
    assert world.loop.time() - asked_at < CONFIRM_S + 0.2, "not one after the other"
    assert list(outcomes) == ["dead1", "dead2", "r1", "r2", "r3"]
    assert outcomes["r1"] is outcomes["r3"] is None
    assert str(outcomes["r2"]) == "r2: cannot be stopped: no"
    assert isinstance(outcomes["r2"], Refused)
    assert isinstance(outcomes["dead1"], BusError)
    assert isinstance(outcomes["dead2"], BusError)
    assert [gateway.machine.stops > 0 for gateway in world.gateways.values()] == [True, False, True]


async def test_one_robots_unreadable_status_leaves_every_robot_its_stop_and_outcome() -> None:
    world = World("r1", "r2")
    world.gateway.put(topics.STATUS, b"\xc1")
    outcomes = await world.fleet.stop()
    assert list(outcomes) == ["r1", "r2"]
    assert isinstance(outcomes["r1"], Refused)
    assert outcomes["r2"] is None
    assert all(gateway.machine.stops > 0 for gateway in world.gateways.values())


async def test_only_the_named_robots_are_stopped() -> None:
    world = World("r1", "r2", "r3")
    outcomes = await world.fleet.stop(name for name in ("r3", "r1", "r3"))
    assert set(outcomes) == {"r1", "r3"}
    assert not any(outcomes.values())
    assert [gateway.machine.stops > 0 for gateway in world.gateways.values()] == [True, False, True]


async def test_a_single_name_is_one_robot_to_stop() -> None:
    world = World("r1", "r2")
    assert await world.fleet.stop("r1") == {"r1": None}
    assert world.gateways["r2"].machine.stops == 0


async def test_a_program_can_stop_what_it_drives_and_take_it_again() -> None:
    world = World("r1")
    async with world.robot.control("ann@here"):
        await world.robot.stop()
    async with world.robot.control("ann@here") as drive:
        await drive(forward=0.5)
    assert len(world.gateway.driven) == 1


async def test_several_robots_are_driven_at_once() -> None:
    world = World("r1", "r2")
    async with world.fleet["r1"].control("ann@here") as one, world.fleet["r2"].control("ann@here") as two:
        assert tokens(world.bus, "r1") == tokens(world.bus, "r2") == ["operator.ann%40here.program"]
        await asyncio.gather(one.during(1.0, forward=0.5), two.during(1.0, turn=0.5))
        with pytest.raises(Held):
            await Fleet(world.bus.join("bob"))["r1"].control("bob@there").__aenter__()
        assert one.loss is None
        await world.fleet["r1"].stop()
        await asyncio.wait_for(one.lost.wait(), 0.1)
        assert two.loss is None
    await settle()
    assert len(world.gateways["r1"].driven) == len(world.gateways["r2"].driven)
