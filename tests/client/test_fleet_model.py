"""The model of the fleet: what gateways publish of themselves, and nothing that a robot streams."""

from __future__ import annotations

import pytest

from tests.fake_bus import FakeBus
from zbridge.client import fleet_model
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import SILENT_S, FleetModel
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Latch, Pose, Refusal, Status
from zbridge.fleet.processes import ProcessStats, Stats
from zbridge.fleet.topics import KeySpace, Topic

pytestmark = pytest.mark.jumping
STATS = Stats(ProcessStats("hub", 7, "0.1.0"), {"pose": 20.0})


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def put(bus: FakeBus, robot: str, topic: Topic, message: FleetMessage) -> None:
    bus.publisher(KeySpace("fleet", robot).key(topic.path), topic).put(payloads.encode(message))


def opened(bus: FakeBus) -> tuple[FleetModel, Clock, list[str]]:
    clock, changed = Clock(), list[str]()
    model = FleetModel(bus.join("watcher"), "fleet", changed.append, clock)
    model.open()
    return model, clock, changed


async def test_what_gateways_said_last_is_known_after_a_query_and_what_they_say_later_replaces_it() -> None:
    bus = FakeBus()
    bus.announce("fleet/r1/@alive/gateway")
    put(bus, "r1", topics.STATUS, Status("connecting"))
    async with Fleet(bus.join("watcher")).watch() as model:
        robot = model.robots["r1"]
        assert (robot.alive, robot.status, robot.stats, robot.published_at) == (True, Status("connecting"), None, None)
        put(bus, "r1", topics.STATUS, Status("established"))
        put(bus, "r1", topics.STATS, STATS)
        put(bus, "r1", topics.CONTROL, Control("held", holder="ann"))
        assert (robot.status, robot.stats, robot.driver) == (Status("established"), STATS, "ann")


async def test_a_last_value_that_was_queried_never_replaces_what_was_published_meanwhile() -> None:
    bus = FakeBus()
    model, _, _ = opened(bus)
    put(bus, "r1", topics.STATUS, Status("established"))
    bus.network.last["fleet/r1/status"] = payloads.encode(Status("connecting"))
    await model.query()
    assert model.robots["r1"].status == Status("established")


async def test_no_stream_is_subscribed_to() -> None:
    bus = FakeBus()
    _, _, changed = opened(bus)
    put(bus, "r1", topics.POSE, Pose(1.0, 2.0, 0.0))
    assert changed == []
    subscribed = {key_expr for key_expr, _ in bus.network.subscribers}
    assert subscribed == {"fleet/*/status", "fleet/*/control", "fleet/*/@gateway/stats"}


async def test_a_gateway_that_hangs_is_silent_though_the_bus_still_answers_for_it() -> None:
    bus = FakeBus()
    put(bus, "r1", topics.STATUS, Status("established"))
    model, clock, _ = opened(bus)
    await model.query()
    robot = model.robots["r1"]
    assert not model.silent(robot), "it has not been listened to for long enough"
    clock.now += SILENT_S
    assert model.silent(robot)
    put(bus, "r1", topics.STATUS, Status("established"))
    assert not model.silent(robot)


async def test_a_robot_whose_gateway_has_gone_stays_in_the_model() -> None:
    bus = FakeBus()
    model, _, changed = opened(bus)
    token = bus.announce("fleet/r1/@alive/gateway")
    token.close()
    assert not model.robots["r1"].alive
    assert changed == ["r1", "r1"]


async def test_refusals_are_summed_up_and_latched_stops_described() -> None:
    bus = FakeBus()
    model, _, _ = opened(bus)
    refusals = tuple(Refusal(who="ann", command="drive", reason="held", count=count) for count in (2, 3))
    latches = (Latch(b"1" * 16, "bob", "wet floor"), Latch(b"2" * 16))
    put(bus, "r1", topics.CONTROL, Control("latched", refusals=refusals, latches=latches))
    robot = model.robots["r1"]
    assert (robot.refused, robot.driver, robot.stopped_by) == (5, "", "latched by bob (wet floor); latched")


async def test_garbage_and_invalid_names_are_counted_and_harm_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_model, "ROBOTS", 1)
    bus = FakeBus()
    model, _, _ = opened(bus)
    put(bus, "r1", topics.STATUS, Status("established"))
    bus.publisher("fleet/r1/status", topics.STATUS).put(b"\xc1")
    put(bus, "r%2A", topics.STATUS, Status("established"))
    put(bus, "r2", topics.STATUS, Status("established"))
    assert (list(model.robots), model.malformed.value, model.left_out) == (["r1"], 1, {"r2"})
    assert model.robots["r1"].status == Status("established")


async def test_a_lazy_model_reads_the_newest_message_of_each_key_when_it_is_told_to() -> None:
    bus, clock, changed = FakeBus(), Clock(), list[str]()
    model = FleetModel(bus.join("watcher"), "fleet", changed.append, clock, lazy=True)
    model.open()
    put(bus, "r1", topics.STATUS, Status("connecting"))
    put(bus, "r1", topics.STATUS, Status("established"))
    clock.now += 1.0
    assert model.robots == {}
    model.take()
    robot = model.robots["r1"]
    assert (robot.status, robot.published_at, changed) == (Status("established"), 100.0, ["r1"])
    model.take()
    assert changed == ["r1"]


async def test_a_closed_model_follows_nothing() -> None:
    bus = FakeBus()
    model, _, changed = opened(bus)
    model.close()
    model.close()
    put(bus, "r1", topics.STATUS, Status("established"))
    bus.announce("fleet/r1/@alive/gateway")
    assert (changed, model.robots) == ([], {})
