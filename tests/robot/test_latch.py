"""A latched robot on the bus: what it is sent, what is shown, who may release it, and what other gateways know."""

from __future__ import annotations

import asyncio
from typing import Any

import msgpack
import pytest

from tests.proofs import packed
from tests.robot.scene import STOP, OpenBus, Rig
from tests.robot.test_device import established, serving
from zbridge.bus import Answer, PriorityClass
from zbridge.control.latch import Latches, LatchRecord
from zbridge.fleet import topics
from zbridge.fleet.messages import Latch
from zbridge.protocol.kept import Budget
from zbridge.transport import Parcel

pytestmark = pytest.mark.jumping

IDS = [bytes([number]) * 16 for number in range(1, 9)]
ALL = "fleet/*/@cmd/stop"


def stop(rig: Rig, stop_id: bytes, key: str = "fleet/r1/@cmd/stop", **fields: Any) -> None:
    rig.bus.join("somebody").publisher(key, topics.CMD_STOP).put(packed({"id": stop_id, **fields}))


def latch(rig: Rig, stop_id: bytes, key: str = "fleet/r1/@cmd/stop") -> None:
    stop(rig, stop_id, key, latch=True, who="ann", reason="wet floor")


def unlatch(rig: Rig, stop_id: bytes, how: str = "unlatch", asked: str | None = None) -> str:
    """Ask for a release; tell what came of it."""
    (reply,) = rig.ask(f"control/{how}/op1", packed({"id": stop_id}), asked=asked).replies
    return getattr(reply.error, "code", "ok")


def asks(rig: Rig, how: str = "acquire") -> str:
    """Ask for the lease in the name of other; tell the code of what came of it."""
    (reply,) = rig.ask(f"control/{how}/other", packed({"who": "other"})).replies
    return reply.error.code if reply.error is not None else msgpack.unpackb(reply.payload)["code"] or "ok"


async def test_a_latched_robot_is_sent_its_stop_for_as_long_as_it_is_latched_and_control_shows_why() -> None:
    async with established(idle_stop_s=0.0, deadman_s=5.0) as rig:
        await rig.play("left > left")
        latch(rig, IDS[0])
        await asyncio.sleep(0.02)
        assert rig.written()[:1] == [STOP]
        shown = rig.last("control")
        assert (shown["state"], shown["stops"]) == ("latched", [IDS[0]])
        assert shown["latches"] == [{"id": IDS[0], "who": "ann", "reason": "wet floor", "fleet": False}]
        await asyncio.sleep(2.0)
        rig.forget_written()
        await asyncio.sleep(10.0)
        assert 9 <= len(rig.written()) <= 11, "although idle_stop_s = 0"
        answer = rig.other.acquire()
        assert (answer["ok"], answer["code"], answer["reason"]) == (False, "latched", "latched by ann (wet floor)")
        assert unlatch(rig, IDS[0]) == "ok"
        await rig.settle()
        assert rig.last("control")["state"] == "stopped"
        assert rig.other.acquire()["ok"]


async def test_a_stop_with_an_id_is_confirmed_also_by_a_robot_that_is_stopped() -> None:
    async with established() as rig:
        for number, stop_id in enumerate(IDS[:5], 1):
            stop(rig, stop_id)
            await rig.settle()
            assert rig.last("control")["stops"] == IDS[max(0, number - 4) : number]
        assert rig.last("control")["state"] == "stopped"


async def test_who_may_release_what() -> None:
    async with established() as rig:
        latch(rig, IDS[0])
        latch(rig, IDS[1], ALL)
        assert unlatch(rig, IDS[1]) == "unsupported", "of the fleet"
        assert unlatch(rig, IDS[0], "unlatch_fleet") == "unsupported", "of this robot"
        assert unlatch(rig, IDS[2]) == "malformed", "of nobody"
        assert unlatch(rig, b"short") == "malformed"
        assert unlatch(rig, IDS[1], "unlatch_fleet", "fleet/*/@rpc/control/unlatch_fleet/op1") == "malformed"
        await rig.settle()
        assert [each["fleet"] for each in rig.last("control")["latches"]] == [False, True]
        assert unlatch(rig, IDS[1], "unlatch_fleet") == "ok"
        assert unlatch(rig, IDS[0]) == "ok"
        assert unlatch(rig, IDS[0]) == "ok", "once more"
        assert rig.hold()["ok"]
        lines = "\n".join(rig.audit_lines)
        assert '"event": "latched", "who": "ann", "reason": "wet floor"' in lines
        assert '"event": "unlatched", "who": "op1"' in lines


@pytest.mark.parametrize(
    ("key", "fleet"),
    [(ALL, True), ("fleet/r1/@cmd/stop", False), ("fleet/**/@cmd/stop", False), ("*/*/@cmd/stop", False)],
)
async def test_a_stop_is_the_fleets_only_by_its_very_key(key: str, fleet: bool) -> None:
    async with established() as rig:
        latch(rig, IDS[0], key)
        await rig.settle()
        assert [each["fleet"] for each in rig.last("control")["latches"]] == [fleet]
        (reply,) = rig.ask("latch").replies
        assert [each["id"] for each in msgpack.unpackb(reply.payload)["latches"]] == [IDS[0]] * fleet


async def test_the_gate_lets_every_id_through_once_and_folds_what_repeats_it() -> None:
    async with established() as rig:
        priority = rig.bus.priorities["fleet/r1/@cmd/**"]
        assert callable(priority)

        def sorted_as(payload: bytes) -> PriorityClass | None:
            return priority("fleet/r1/@cmd/stop", None, len(payload), lambda: payload)  # type: ignore[operator]

        named = packed({"id": IDS[0], "latch": True})
        assert sorted_as(b"") is sorted_as(packed({"latch": True})) is sorted_as(b"\xc1") is PriorityClass.STOP
        assert sorted_as(named) is PriorityClass.LATCH
        latch(rig, IDS[0])
        await rig.settle()
        assert sorted_as(b"") is sorted_as(named) is None, "these change nothing now"
        assert sorted_as(packed({"id": IDS[1]})) is PriorityClass.LATCH
        await asyncio.sleep(0.06)
        assert sorted_as(named) is PriorityClass.LATCH, "a while later it is a stop again"


# Other gateways of the fleet


class SlowBus(OpenBus):
    """Takes a while to answer what is asked of all gateways, or as long as it may take."""

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        answers = await super().ask(key_expr, payload, timeout_s=timeout_s)
        if "*" in key_expr:
            await asyncio.sleep(min(SLOW_S, timeout_s))
        return answers


SLOW_S = 7.0


class Others:
    """Other gateways of the realm, and what they answer."""

    def __init__(self, bus: OpenBus) -> None:
        self._bus = bus
        self.asked = 0

    def says(self, robot: str, latches: tuple[bytes, ...] = (), released: tuple[bytes, ...] = ()) -> None:
        answer = {
            "latches": [{"id": each, "who": "ann", "fleet": True} for each in latches],
            "released": list(released),
        }

        def tell(query: Any) -> None:
            self.asked += 1
            query.answer(packed(answer))

        self._bus.join(robot).answer(f"fleet/{robot}/@rpc/latch", tell)


async def test_a_gateway_that_starts_adopts_the_fleets_latches_and_grants_nothing_before() -> None:
    bus = SlowBus()
    others = Others(bus)
    others.says("r2", (IDS[0], IDS[1]))
    others.says("r3", (IDS[2],), (IDS[1],))
    bus.join("r4").answer("fleet/r4/@rpc/latch", lambda query: query.answer(b"\xc1"))
    async with serving(bus=bus, hold=False) as rig:
        assert asks(rig) == asks(rig, "takeover") == "not_ready"
        await asyncio.sleep(0.99)
        assert asks(rig) == "not_ready"
        await asyncio.sleep(0.02)
        assert {each["id"] for each in rig.last("control")["latches"]} == {IDS[0], IDS[2]}
        assert asks(rig) == asks(rig, "takeover") == "latched"


async def test_when_the_bus_returns_the_others_are_asked_again_and_nothing_is_granted_until_then() -> None:
    bus = OpenBus()
    others = Others(bus)
    async with established(bus=bus) as rig:
        rig.bus.connection(False)
        others.says("r2", (IDS[0],))
        rig.bus.connection(True)
        await rig.settle()
        assert asks(rig) == asks(rig, "takeover") == "not_ready"
        await asyncio.sleep(1.01)
        assert others.asked == 1
        assert rig.last("control")["state"] == "latched"


async def test_nobody_is_waited_for_longer_than_a_second() -> None:
    async with serving(bus=SlowBus(), hold=False) as rig:
        await asyncio.sleep(0.99)
        assert asks(rig) == "not_ready"
        await asyncio.sleep(0.02)
        assert asks(rig) == "ok"


@pytest.mark.parametrize(("crashed", "answer"), [(False, "ok"), (True, "not_ready")])
async def test_a_successor_knows_what_the_gateway_before_it_knew_unless_that_died(
    *, crashed: bool, answer: str
) -> None:
    async with established() as rig:
        await rig.device.prepare("gateway restarted", 1.0)
        rig.device.suspend()
        given = rig.device.deposit(Parcel(), Budget(1000)) if crashed else rig.device.export(Parcel())
        heir = Rig(bus=SlowBus())
        await heir.device.restore(msgpack.unpackb(msgpack.packb(given)), Parcel())
        task = asyncio.ensure_future(heir.device.run(heir.settle))
        await heir.settle()
        await heir.settle()
        assert asks(heir) == answer
        await asyncio.sleep(1.1)
        task.cancel()
        await asyncio.wait([task])


async def test_what_was_written_down_is_in_force_before_anything_is_served_and_changes_are_written() -> None:
    written: list[LatchRecord] = []
    async with serving(keep_latches=lambda latches: written.append(latches.record)) as rig:
        rig.device.restore_latches(Latches(LatchRecord((Latch(IDS[0], "ann"),))))
        await rig.establish()
        assert asks(rig) == "latched"
        latch(rig, IDS[1])
        assert [each.id for each in written[-1].latches] == IDS[:2]
        unlatch(rig, IDS[0])
        assert [each.id for each in written[-1].latches] == [IDS[1]]
        assert written[-1].released == (IDS[0],)


async def test_a_latched_stop_is_confirmed_when_it_is_written_down_and_the_robot_is_stopped_before() -> None:
    writing: list[asyncio.Future[None]] = []

    def keep(latches: Latches) -> asyncio.Future[None] | None:
        if len(latches.in_force) == len(writing):
            return None
        writing.append(asyncio.get_running_loop().create_future())
        return writing[-1]

    async with established(keep_latches=keep) as rig:
        latch(rig, IDS[0])
        await asyncio.sleep(0.1)
        assert STOP in rig.written()
        stop(rig, IDS[2])
        latch(rig, IDS[1])
        shown = rig.last("control")
        assert (shown["state"], [each["id"] for each in shown["latches"]]) == ("latched", IDS[:2])
        assert shown["stops"] == [IDS[2]], "a plain stop needs no disk"
        writing[0].set_result(None)
        await rig.settle()
        assert rig.last("control")["stops"] == [IDS[2]], "the other one is on its way"
        writing[1].set_result(None)
        await rig.settle()
        assert rig.last("control")["stops"] == [IDS[0], IDS[2], IDS[1]]
