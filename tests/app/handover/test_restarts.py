"""Who may ask for a restart, what is handed over, and how a request is answered. The handover itself is played."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from zbridge.app.config import GatewayPlan, plan
from zbridge.app.handover import restarts as module
from zbridge.app.handover.channel import VERSION, HandoverState
from zbridge.app.handover.restarts import ClaimPart, Restarts
from zbridge.app.handover.sequence import ColdStart, Incoming
from zbridge.errors import NotReady, Refused
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.kept import Budget, Exported
from zbridge.robot.ownership import Ownership
from zbridge.transport import Parcel

DEVICE = {"protocol": "alf", "connect": ["tcp://127.0.0.1:1"]}
ASKED = "fleet/r1/@rpc/restart/ann"
CLAIMED = {"since": 2.0, "yielded": False, "close_until": 4.0}


def planned(**bus: Any) -> GatewayPlan:
    return plan({"robot": {"name": "r1"}, "device": DEVICE, "bus": bus})


class Part:
    """What is handed over, or kept for a successor of a gateway that died."""

    def __init__(self, told: Exported | None) -> None:
        self.told = told

    def export(self, parcel: Parcel) -> Exported:
        return self.told or {}

    def deposit(self, parcel: Parcel, budget: Budget) -> Exported | None:
        return self.told


class Latches:
    flushed = False

    async def flush(self) -> None:
        self.flushed = True


class Drained(FakeBus):
    """Notes what was waited for."""

    def __init__(self) -> None:
        super().__init__("1")
        self.drained: list[str] = []
        self.flushed = False

    async def drain(self, key_expr: str) -> None:
        self.drained.append(key_expr)

    async def flush(self) -> None:
        self.flushed = True


class PlayedOutgoing:
    """Hands over what is described; ``end`` ends it."""

    made: list[PlayedOutgoing]

    def __init__(
        self,
        successor: object,
        parts: Callable[[], list[Any]],
        describe: Callable[[Parcel], HandoverState],
        *machine: object,
    ) -> None:
        self.parts, self.describe = parts, describe
        self.end: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.made.append(self)

    async def run(self) -> int:
        return await self.end


@pytest.fixture(autouse=True)
def handovers(monkeypatch: pytest.MonkeyPatch) -> list[PlayedOutgoing]:
    PlayedOutgoing.made = []
    monkeypatch.setattr(module, "Outgoing", PlayedOutgoing)
    return PlayedOutgoing.made


def made(config: GatewayPlan | None = None, incoming: Incoming | None = None, successor: Any = "some") -> Restarts:
    return Restarts(config or planned(), KeySpace("fleet", "r1"), incoming or ColdStart(), successor)


async def asked(restarts: Restarts, bus: FakeBus, key: str = ASKED) -> Any:
    """Ask for a restart, and let the answer be worked on."""
    entry = restarts.answer(bus)
    queries: list[Any] = []
    ((_, handler, _),) = bus.network.queryables
    from tests.fake_bus import FakeQuery

    queries.append(FakeQuery(ASKED, asked=key))
    handler(queries[0])
    entry.close()
    for _ in range(5):
        await asyncio.sleep(0)
    return queries[0]


def refusal(query: Any) -> str:
    (reply,) = query.replies
    return str(reply.error)


async def test_who_asks_is_answered_when_everything_is_handed_over_and_the_gateway_ends(
    handovers: list[PlayedOutgoing],
) -> None:
    restarts, bus = made(), Drained()
    query = await asked(restarts, bus)
    assert (query.replies, restarts.gone.is_set()) == ([], False)
    handovers[0].end.set_result(7)
    await asyncio.wait_for(restarts.gone.wait(), 5.0)
    (reply,) = query.replies
    assert reply.error is None
    assert bus.flushed, "the answer leaves before the gateway does"


async def test_a_handover_that_fails_is_told_and_may_be_asked_for_again(handovers: list[PlayedOutgoing]) -> None:
    restarts, bus = made(), FakeBus()
    query = await asked(restarts, bus)
    assert "a restart is in progress" in refusal(await asked(restarts, bus))
    handovers[0].end.set_exception(NotReady("not restarted: the robot moves"))
    for _ in range(5):
        await asyncio.sleep(0)
    assert refusal(query) == "not restarted: the robot moves"
    assert not restarts.gone.is_set()
    await asked(restarts, bus)
    assert len(handovers) == 2
    handovers[1].end.set_result(7)
    await asyncio.wait_for(restarts.gone.wait(), 5.0)
    assert "a restart is in progress" in refusal(await asked(restarts, bus)), "it has gone"


async def test_a_restart_is_refused_with_its_reason() -> None:
    near, far = socket.socketpair()
    with near:
        comes = Incoming(far, {})
        for restarts, told in (
            (made(successor=None), "nothing starts a successor of this process"),
            (made(planned(mode="peer", listen=["tcp/127.0.0.1:7447"])), "two processes cannot listen at one endpoint"),
            (made(incoming=comes), "a restart is in progress"),
        ):
            assert told in refusal(await asked(restarts, FakeBus()))
        assert "one robot and one name" in refusal(await asked(made(), FakeBus(), "fleet/*/@rpc/restart/ann"))
        comes.begun.set()
        assert (await asked(made(incoming=comes), FakeBus())).replies == [], "a successor that has begun may be asked"
        comes.fail("the test ends")


async def test_a_restart_of_the_process_itself_ends_it_or_changes_nothing(handovers: list[PlayedOutgoing]) -> None:
    for end, gone in ((NotReady("no"), False), (7, True)):
        restarts = made()
        running = asyncio.ensure_future(restarts.restart())
        await asyncio.sleep(0)
        future = handovers[-1].end
        future.set_exception(end) if isinstance(end, Refused) else future.set_result(end)
        await running
        assert restarts.gone.is_set() is gone


async def test_everything_the_gateway_has_is_described_in_order(handovers: list[PlayedOutgoing]) -> None:
    restarts = made()
    with socket.create_server(("127.0.0.1", 0)) as metrics:
        restarts.listeners = [Part({"a": 1}), Part({"b": 2})]  # type: ignore[list-item]
        restarts.device, restarts.claim = Part({"d": 4}), Part({"since": 1.0})  # type: ignore[assignment]
        restarts.metrics_sockets = [metrics]
        running = asyncio.ensure_future(restarts.restart())
        await asyncio.sleep(0)
        (handover,) = handovers
        assert [part.told for part in handover.parts()] == [{"a": 1}, {"b": 2}, {"d": 4}, {"since": 1.0}]
        parcel = Parcel()
        given = handover.describe(parcel)
        assert (given.version, given.setup, given.descriptors) == (VERSION, planned().setup, 1)
        assert (given.claim, given.device, given.listeners) == ({"since": 1.0}, {"d": 4}, ({"a": 1}, {"b": 2}))
        assert (given.metrics, len(parcel)) == ((0,), 1)
        parcel.close()
        handover.end.set_result(7)
        await running


async def test_latches_are_on_disk_and_the_claim_is_off_the_bus_before_the_successor_begins() -> None:
    bus, latches = Drained(), Latches()
    ownership = Ownership(bus, KeySpace("fleet", "r1"), clock=lambda: 5.0)
    part = ClaimPart(ownership, latches)  # type: ignore[arg-type]
    await part.restore(CLAIMED, Parcel())
    await part.resume()
    await part.withdraw()
    assert ownership.export() is None
    assert (bus.drained, latches.flushed) == (["fleet/r1/@rpc/claim/gateway"], True)


@pytest.mark.parametrize(
    ("device", "claim", "kept"),
    [({"d": 4}, {"since": 1.0}, True), (None, {"since": 1.0}, False), ({"d": 4}, {}, False), (None, None, False)],
)
def test_a_robot_is_kept_for_a_successor_only_where_it_is_owned_and_can_go_on(
    device: Exported | None, claim: Exported | None, kept: bool
) -> None:
    restarts = made()
    if device is not None or claim is not None:
        restarts.device, restarts.claim = Part(device), Part(claim)  # type: ignore[assignment]
    given = restarts.deposit(Parcel(), Budget(1000))
    assert (given is not None) is kept
    if given is not None:
        assert (given.version, given.device, given.claim, given.listeners) == (VERSION, device, claim, ())


async def test_a_claim_that_is_withdrawn_for_the_successor_is_still_deposited_and_comes_back() -> None:
    ownership = Ownership(FakeBus("1"), KeySpace("fleet", "r1"), clock=lambda: 5.0)
    part = ClaimPart(ownership, Latches())  # type: ignore[arg-type]
    assert part.export(Parcel()) == {}
    ownership.restore(CLAIMED)
    assert part.export(Parcel()) == CLAIMED
    await part.withdraw()
    assert ownership.export() is None
    assert part.export(Parcel()) == CLAIMED, "the successor may die before it has deposited any"
    await part.resume()
    assert ownership.export() == CLAIMED
    ownership.release()
    assert part.export(Parcel()) == {}


async def test_a_robot_that_was_left_to_another_gateway_during_a_restart_that_fails_is_not_claimed_again() -> None:
    ownership = Ownership(FakeBus("1"), KeySpace("fleet", "r1"), clock=lambda: 5.0)
    part = ClaimPart(ownership, Latches())  # type: ignore[arg-type]
    ownership.restore(CLAIMED)
    await part.prepare("gateway restarted", 1.0)
    assert part.export(Parcel()) == CLAIMED
    ownership.release()
    await part.resume()
    assert ownership.export() is None
