"""Robots latched and released by programs: what is reported is what gateways confirmed."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.client import World
from tests.fake_bus import FakeBus
from zbridge.bus import Sample
from zbridge.client import Fleet
from zbridge.client.stops import CONFIRM_S, StopWaits, new_stop
from zbridge.errors import BusError, Latched, NotReady, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Latch, Status, Stop

pytestmark = pytest.mark.jumping


def latches(world: World, robot: str = "r1") -> list[tuple[str | None, str | None, bool]]:
    return [(each.who, each.reason, each.fleet) for each in world.gateways[robot].control.latches]


async def test_a_latched_robot_is_driven_by_nobody_until_it_is_released() -> None:
    world = World("r1")
    world.fleet = Fleet(world.bus.join("mine"), name="ann")
    async with world.others.control("bob@here") as drive:
        await drive(forward=0.5)
        await world.fleet["r1"].latch("wet floor")
        assert world.machine.stops >= 1
    assert latches(world) == [("ann", "wet floor", False)]
    for takeover in (False, True):
        with pytest.raises(Latched, match=r"^r1: latched by ann \(wet floor\)$"):
            async with world.others.control("bob@here", takeover=takeover):
                pytest.fail("nobody holds a latched robot")
    (released,) = await world.fleet["r1"].unlatch()
    assert isinstance(released, Latch)
    assert (released.who, released.reason) == ("ann", "wet floor")
    assert await world.fleet["r1"].unlatch() == (), "none is in force"
    async with world.others.control("bob@here") as drive:
        await drive(forward=0.5)


async def test_the_fleet_is_latched_by_one_id_and_released_everywhere() -> None:
    world = World("r1", "r2", "r3")
    await world.fleet["r2"].latch("its own")
    assert await world.fleet.latch(reason="fire") == dict.fromkeys(("r1", "r2", "r3"))
    ids = {latch.id for gateway in world.gateways.values() for latch in gateway.control.latches if latch.fleet}
    assert len(ids) == 1
    with pytest.raises(Unsupported, match="belongs to the whole fleet: release it with zbridge unlatch --all"):
        await world.fleet["r1"].unlatch()
    assert await world.fleet.unlatch() == dict.fromkeys(("r1", "r2", "r3"))
    assert [world.gateways[name].control.state for name in ("r1", "r2", "r3")] == ["stopped", "latched", "stopped"]
    assert [reason for _, reason, _ in latches(world, "r2")] == ["its own"]


class LosesWildcards(FakeBus):
    """Lets no stop of all robots through."""

    def publisher(self, key: str, topic: Any, last: bytes | None = None) -> Any:
        return super().publisher(key.replace("fleet/*/", "nowhere/*/"), topic, last)


async def test_a_robot_that_the_stop_of_all_did_not_reach_is_latched_by_name_and_released_with_the_others() -> None:
    world = World("r1", "r2")
    fleet = Fleet(LosesWildcards("mine", world.bus.network))
    assert await fleet.latch(reason="fire") == {"r1": None, "r2": None}
    assert [fleetwide for _, _, fleetwide in latches(world)] == [False]
    stop = world.bus.join("late").publisher("fleet/*/@cmd/stop", topics.CMD_STOP)
    sent = next(sample for sample in world.bus.network.history if sample.key == "fleet/r1/@cmd/stop")
    world.gateways["r2"].commands.take(Sample("fleet/*/@cmd/stop", sent.payload))
    assert [fleetwide for _, _, fleetwide in latches(world, "r2")] == [True]
    assert await fleet.unlatch() == {"r1": None, "r2": None}
    stop.put(sent.payload)  # what was held up comes now
    assert [gateway.control.state for gateway in world.gateways.values()] == ["stopped", "stopped"]


async def test_robots_without_a_gateway_share_one_wait_and_one_that_gets_one_meanwhile_is_stopped() -> None:
    world = World("r1", "late", served=False)
    world.gateways["r1"].serve()
    missing = [f"gone{number}" for number in range(200)]
    began = world.loop.time()
    stopping = asyncio.create_task(world.fleet.latch(reason="fire", also=["late", *missing]))
    await asyncio.sleep(CONFIRM_S / 2)
    assert world.gateways["r1"].control.state == "latched"
    world.gateways["late"].serve()
    await asyncio.sleep(CONFIRM_S / 4)
    assert world.gateways["late"].control.state == "latched", "it does not wait for the others"
    outcomes = await stopping
    assert world.loop.time() - began < CONFIRM_S + 0.5
    assert (outcomes["r1"], outcomes["late"]) == (None, None)
    assert list(outcomes) == sorted(outcomes)
    assert {str(outcomes[name]) for name in missing[:1]} == {"gone0: stop sent, but no gateway confirmed it within 3 s"}
    assert all(isinstance(outcomes[name], BusError) for name in missing)


async def test_a_stop_whose_gateway_leaves_once_it_has_confirmed_it_is_not_reported_as_done() -> None:
    world = World("r1")
    gateway = world.gateways["r1"]

    class LeavesThen(FakeBus):
        """Its gateway is gone when the status is asked for."""

        async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> Any:
            if key_expr.endswith("/status"):
                await gateway.vanish()
            return await super().ask(key_expr, payload, timeout_s=timeout_s)

    with pytest.raises(NotReady, match=r"^r1: stop accepted, but its gateway has left: nobody knows whether"):
        await Fleet(LeavesThen("mine", world.bus.network))["r1"].stop()
    assert world.machine.stops >= 1


async def test_each_robot_has_its_outcome_confirmed_or_not() -> None:
    world = World("r1", "r2", "r3", "r4")
    world.gateways["r2"].publish(topics.STATUS, Status(state="offline", reason="no route"))
    world.gateways["r4"].publish(topics.STATUS, Status(state="established", stalled=True))
    await world.gateways["r3"].vanish()
    world.bus.announce("fleet/r3/@alive/gateway")
    asked_at = world.loop.time()
    outcomes = await world.fleet.latch()
    assert world.loop.time() - asked_at < CONFIRM_S + 0.5
    assert outcomes["r1"] is None
    assert isinstance(outcomes["r2"], NotReady)
    assert isinstance(outcomes["r4"], StopWaits)
    assert str(outcomes["r4"]) == "r4: stop accepted, but it waits: the robot's link is stalled"
    assert isinstance(outcomes["r3"], BusError)
    assert world.gateways["r2"].control.state == "latched", "its gateway keeps it"
    outcomes = await world.fleet.unlatch()
    assert {name: outcome and type(outcome) for name, outcome in outcomes.items()} == {
        "r1": None,
        "r2": None,
        "r3": BusError,
        "r4": None,
    }


@pytest.mark.parametrize(("who", "reason"), [("a" * 300, "r" * 300), ("ä" * 300, "ü" * 300), ("", None)])
def test_a_stop_fits_its_bound_whatever_it_says(who: str, reason: str | None) -> None:
    payload = payloads.encode(new_stop(who, reason, latch=True))
    assert len(payload) <= topics.SMALL_BYTES
    assert payloads.decode(Stop, payload).latch is True
