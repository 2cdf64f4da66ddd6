"""One gateway per robot, on a fake bus and a clock that jumps."""

import asyncio
import logging
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from unittest.mock import ANY

import msgpack
import pytest

from tests.fake_bus import FakeBus
from tests.tables import documented, executed
from zbridge.bus import Answer, Handle, IncomingQuery, PriorityClass
from zbridge.bus.interface import Sort
from zbridge.control.latch import LatchRecord
from zbridge.fleet.messages import Latch
from zbridge.fleet.topics import KeySpace
from zbridge.robot.claim import LOOKS, MOST_S, RIVALS, YOUNG_S, Claim, Standing
from zbridge.robot.claim_bus import CLOSE_S, WATCH_S
from zbridge.robot.ownership import ANNOUNCE_S, Ownership

pytestmark = pytest.mark.jumping

KEYS = KeySpace("fleet", "r1")
INF, NAN = math.inf, math.nan
TOKEN, CLAIM = "fleet/r1/@alive/gateway", "fleet/r1/@rpc/claim/gateway"


class Distant(FakeBus):
    """A bus on which all takes its time: what is announced, asked and answered gets about within a moment."""

    late_s: Callable[[], float] = staticmethod(lambda: 0.01)

    def _later(self, do: Callable[[], Handle]) -> Handle:
        done: list[Handle] = []
        timer = asyncio.get_running_loop().call_later(self.late_s(), lambda: done.append(do()))

        class Declared:
            def close(self) -> None:
                timer.cancel()
                for handle in done:
                    handle.close()

        return Declared()

    def answer(
        self,
        key: str,
        handler: Callable[[IncomingQuery], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
    ) -> Handle:
        return self._later(lambda: super(Distant, self).answer(key, handler, priority=priority))

    def announce(self, key: str) -> Handle:
        return self._later(lambda: super(Distant, self).announce(key))

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        await asyncio.sleep(self.late_s())
        return await super().alive(key_expr, timeout_s=timeout_s)

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(self.late_s())
        answers = await super().ask(key_expr, payload, timeout_s=timeout_s)
        await asyncio.sleep(self.late_s())
        return answers


async def owned(bus: FakeBus, keys: KeySpace = KEYS) -> Ownership:
    """Take the robot at once."""
    claim = Ownership(bus, keys, asyncio.get_running_loop().time)
    await asyncio.wait_for(claim.take(), 1.0)
    return claim


async def kept_waiting(bus: FakeBus) -> asyncio.Task[None]:
    """Let another gateway want the robot: it must wait."""
    taking = asyncio.create_task(Ownership(bus, KEYS).take())
    await asyncio.sleep(10.0)
    assert not taking.done()
    return taking


async def test_the_only_gateway_takes_the_robot_and_shows_it_until_it_releases_it() -> None:
    bus = FakeBus("1")
    claim = await owned(bus)
    assert await bus.join("2").alive("fleet/*/@alive/*") == [TOKEN]
    await owned(bus.join("2"), KeySpace("other", "r1"))  # another robot's
    claim.release()
    claim.release()
    assert (await bus.alive(TOKEN), await bus.ask(CLAIM)) == ([], [])
    await asyncio.wait_for(claim.take(), 1.0)
    alone = FakeBus("1")
    alone.connection(False)
    await owned(alone)  # nobody is on the bus yet


async def test_a_second_gateway_waits_until_the_first_goes_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    bus = FakeBus("5")
    first = await owned(bus)
    with caplog.at_level(logging.WARNING):
        waiting = await kept_waiting(bus.join("1"))
    assert [record.getMessage() for record in caplog.records] == ["another gateway serves r1: waiting until it goes"]
    assert await bus.alive(TOKEN) == [TOKEN]
    first.release()
    await asyncio.wait_for(waiting, 1.0)


@pytest.mark.parametrize("zids", [("1", "2"), ("b", "a")])
async def test_of_two_that_start_at_the_same_moment_the_lower_id_goes_on(zids: tuple[str, str]) -> None:
    shared = FakeBus().network
    claims = {zid: Ownership(Distant(zid, shared), KEYS) for zid in zids}
    takes = {zid: asyncio.create_task(claim.take()) for zid, claim in claims.items()}
    await asyncio.sleep(5.0)
    winner, loser = sorted(zids)
    assert (takes[winner].done(), takes[loser].done()) == (True, False)
    claims[winner].release()
    await asyncio.wait_for(takes[loser], 1.0)


@pytest.mark.parametrize("count", [2, 3])
async def test_of_those_that_start_together_one_goes_on(count: int) -> None:
    settled = []
    for seed in range(20):
        rng, shared = random.Random(seed), FakeBus().network
        takes = []
        for number in range(count):
            bus = Distant(str(number), shared)
            bus.late_s = partial(rng.uniform, 0.0, ANNOUNCE_S * 0.9)
            takes.append(asyncio.create_task(Ownership(bus, KEYS).take()))
            await asyncio.sleep(rng.uniform(0.0, 0.2))
        await asyncio.sleep(10.0)
        settled.append([take.done() for take in takes].count(True))
    assert settled == [1] * 20


async def test_one_that_holds_the_robot_is_not_driven_out_by_a_lower_id_that_does_not_see_its_token() -> None:
    bus = FakeBus("9")
    await owned(bus)
    bus.network.tokens.remove(TOKEN)
    await kept_waiting(bus.join("1"))


@dataclass
class Robot:
    """What serves a robot: how it stands, and what it was told."""

    healthy: bool = True
    connected_at: float | None = 0.0
    record: LatchRecord = field(default_factory=LatchRecord)
    rivals: list[set[str]] = field(default_factory=list)
    heard_latches: set[Latch] = field(default_factory=set)
    merged: list[LatchRecord] = field(default_factory=list)
    turns: list[str] = field(default_factory=list)

    @property
    def standing(self) -> Standing:
        now = asyncio.get_running_loop().time()
        age_s = now - self.connected_at if self.must_stay else 0.0
        return Standing(self.healthy, age_s, self.record)

    @property
    def must_stay(self) -> bool:
        return self.connected_at is not None

    def heard(self, claims: Mapping[str, Claim]) -> None:
        self.rivals.append(set(claims))
        self.heard_latches.update(latch for claim in claims.values() for latch in claim.latches)

    def merge(self, record: LatchRecord) -> None:
        self.merged.append(record)

    async def step_aside(self) -> None:
        self.turns.append("aside")

    async def step_in(self) -> None:
        self.turns.append("in")


def watched(claim: Ownership, robot: Robot | None = None) -> tuple[Robot, asyncio.Task[None]]:
    """Watch a claim; give the robot, and what ends when it was left to another."""
    robot = robot or Robot(connected_at=asyncio.get_running_loop().time())
    return robot, asyncio.create_task(claim.watch(robot))


# Forged claims


def forge(bus: FakeBus, *claims: Any) -> Handle:
    """Answer for a gateway that there is not: with these claims, or these bytes, one after the other."""

    def answer(question: IncomingQuery) -> None:
        for claim in claims:
            question.answer(claim if isinstance(claim, bytes) else msgpack.packb(claim))

    return bus.answer(CLAIM, answer)


IMPLAUSIBLE = [
    *({"held_s": held_s, "healthy": True} for held_s in (MOST_S * 2, INF, NAN, -1.0, 0.0, "9", [1.0])),
    *({"held_s": 9.0, "connected_s": age_s} for age_s in (MOST_S * 2, INF, NAN, -1.0, "9")),
    {"held_s": 0.0, "connected_s": 9.0},
    {"held_s": None},
    {"held_s": 1.0, "healthy": "yes"},
    {"held_s": 1.0, "latches": [{"id": b"short"}]},
    [1.0, True],
    b"",
    b"\xc1",
    b"\x91" * 2000,
    b"\x81\xa7latches\x91\x82\xa2id\xc4\x10" + bytes(16) + b"\xa3who\xa1\xff",  # a text that is no UTF-8
]


@pytest.mark.parametrize("claim", IMPLAUSIBLE, ids=range(len(IMPLAUSIBLE)))
async def test_what_nobody_can_claim_is_no_claim(claim: Any) -> None:
    bus = FakeBus("5")
    forge(bus.join("1"), claim)
    robot, watching = watched(await owned(bus), Robot(healthy=False, connected_at=None))
    await asyncio.sleep(3 * WATCH_S)
    assert (set(map(tuple, robot.rivals)), watching.done()) == ({()}, False)


async def test_whoever_goes_on_answering_delays_a_start_and_nothing_else() -> None:
    bus = FakeBus("1")
    forged = forge(bus.join("9"), EVIL)
    taking = await kept_waiting(bus)
    forged.close()
    await asyncio.wait_for(taking, 1.0)


EVIL = {"held_s": 3600.0, "healthy": True, "connected_s": 3600.0}


@pytest.mark.parametrize("claims", [[{"held_s": 0.0, "zid": "1"}], [{"held_s": 0.0}, EVIL, EVIL]])
async def test_whose_claim_it_is_the_bus_tells_and_no_payload_and_only_the_first_counts(claims: list[Any]) -> None:
    bus = FakeBus("5")
    forge(bus.join("9"), *claims)
    robot, _ = watched(await owned(bus))  # of two that begin the lower one continues: 5
    await asyncio.sleep(WATCH_S + 1.0)
    assert set(map(tuple, robot.rivals)) == {()}


async def test_a_crowd_of_weak_claims_hides_no_good_one() -> None:
    bus = FakeBus("5")
    for number in range(3 * RIVALS):
        forge(bus.join(f"f{number:02}"), {"held_s": 0.0})
    await owned(bus.join("a"))
    await kept_waiting(bus.join("0"))


async def test_a_token_without_a_claim_behind_it_is_said_once_and_ignored(caplog: pytest.LogCaptureFixture) -> None:
    bus = FakeBus("5")
    bus.join("1").announce(TOKEN)
    with caplog.at_level(logging.WARNING):
        await asyncio.wait_for(Ownership(bus, KEYS).take(), 5.0)
    assert [record.getMessage() for record in caplog.records] == [
        "a gateway of r1 has a token but does not answer: ignoring it"
    ]


async def test_a_gateway_that_does_not_answer_at_once_is_waited_for() -> None:
    class Silent(FakeBus):
        """The first questions find no answer, as where a gateway is busy."""

        left = LOOKS - 1

        async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
            self.left -= 1
            return [] if self.left >= 0 else await super().ask(key_expr, payload, timeout_s=timeout_s)

    bus = FakeBus("1")
    await owned(bus)
    await kept_waiting(Silent("0", bus.network))


# Two that serve one robot


class Two:
    """Two gateways of one robot, which do not see each other before :meth:`heal`; the first one has the lower id."""

    def __init__(self) -> None:
        self.buses = tuple(Distant(zid) for zid in "19")
        clock = asyncio.get_running_loop().time
        self.ownerships = tuple(Ownership(bus, KEYS, clock) for bus in self.buses)
        self.robots: list[Robot] = []
        self.watching: list[asyncio.Task[None]] = []

    async def serve(self, *robots: Robot, apart_s: tuple[float, float] = (0.0, 0.0)) -> None:
        """Let each take the robot, one so much later than the other."""

        async def take(ownership: Ownership, robot: Robot, after_s: float) -> asyncio.Task[None]:
            await asyncio.sleep(after_s)
            await ownership.take()
            return asyncio.create_task(ownership.watch(robot))

        self.robots = list(robots)
        self.watching = await asyncio.gather(*map(take, self.ownerships, robots, apart_s))

    def heal(self, *, noticed: bool) -> None:
        """Join the two networks; noticed: both sessions have lost their bus, and find it again now."""
        one, other = self.buses
        one.network.queryables += other.network.queryables
        one.network.tokens += other.network.tokens
        other.network = one.network
        if noticed:
            for up in (False, True):
                for bus in self.buses:
                    bus.connection(up)

    @property
    def serving(self) -> list[bool]:
        """Who serves the robot; the first one first."""
        return [
            not watching.done() and robot.turns[-1:] != ["aside"]
            for watching, robot in zip(self.watching, self.robots, strict=True)
        ]


FIRST, SECOND = [True, False], [False, True]


@pytest.mark.parametrize("noticed", [False, True])
@pytest.mark.parametrize(
    ("first", "second", "apart_s", "serves"),  # (healthy, connected at)
    [
        ((True, 5.0), (True, 0.0), (0.0, 0.0), SECOND),  # the older connection
        ((True, 5.0), (False, 0.0), (0.0, 0.0), FIRST),  # the healthy robot
        ((False, 5.0), (True, None), (0.0, 0.0), SECOND),
        ((False, None), (False, None), (20.0, 0.0), SECOND),  # longer service
    ],
)
async def test_of_two_that_meet_exactly_one_serves_within_2_s(
    first: tuple[bool, float | None],
    second: tuple[bool, float | None],
    apart_s: tuple[float, float],
    serves: list[bool],
    *,
    noticed: bool,
) -> None:
    two = Two()
    await two.serve(Robot(*first), Robot(*second), apart_s=apart_s)
    await asyncio.sleep(9.0)
    two.heal(noticed=noticed)
    await asyncio.sleep(2.0)
    assert two.serving == serves
    await asyncio.sleep(60.0)
    assert two.serving == serves
    winner, loser = serves.index(True), serves.index(False)
    assert two.robots[winner].turns == [], "who serves on is not disturbed"
    assert two.robots[loser].turns == ["aside"]
    assert two.watching[loser].done() is not two.robots[loser].must_stay
    if two.robots[loser].must_stay:
        assert two.robots[winner].rivals[-1] == {two.buses[loser].zid}
    assert two.buses[0].network.tokens == [TOKEN]


@pytest.mark.parametrize("seed", range(50))
async def test_two_that_began_at_nearly_the_same_moment_settle_and_stay_settled(seed: int) -> None:
    rng, two = random.Random(seed), Two()
    for bus in two.buses:
        bus.late_s = partial(rng.uniform, 0.0, 0.1)
    await two.serve(Robot(True, 0.0), Robot(True, rng.uniform(-0.1, 0.1)), apart_s=(0.0, rng.uniform(0.0, 0.1)))
    await asyncio.sleep(9.0)
    two.heal(noticed=True)
    await asyncio.sleep(6.0)
    serving = two.serving
    assert serving in (FIRST, SECOND)
    await asyncio.sleep(60.0)
    assert two.serving == serving


async def test_who_yielded_serves_again_when_the_other_goes_or_is_worse() -> None:
    two = Two()
    await two.serve(Robot(True, 5.0), Robot(True, 0.0))
    two.heal(noticed=True)
    await asyncio.sleep(3.0)
    assert two.serving == SECOND
    two.robots[1].healthy = False
    await asyncio.sleep(2.0)
    assert two.serving == FIRST
    two.robots[1].healthy = True
    await asyncio.sleep(60.0)
    assert two.serving == FIRST, "the older connection alone is no reason to change again"
    two.watching[0].cancel()
    two.ownerships[0].release()
    await asyncio.sleep(2.0)
    assert two.serving[1]
    assert two.robots[1].turns == ["aside", "in"]


async def test_who_yielded_and_loses_its_connection_lets_go() -> None:
    two = Two()
    await two.serve(Robot(True, 5.0), Robot(True, 0.0))
    two.heal(noticed=True)
    await asyncio.sleep(3.0)
    two.robots[0].connected_at = None
    await asyncio.sleep(1.0)
    assert (two.watching[0].done(), await two.buses[1].ask(CLAIM, timeout_s=0.1)) == (True, ANY)
    assert len(await two.buses[1].ask(CLAIM)) == 1


async def looks_within(bus: FakeBus, seconds: float) -> int:
    """Count the questions for claims."""
    asked = 0

    def count(question: IncomingQuery) -> None:
        nonlocal asked
        asked += 1

    handle = bus.join("x").answer(CLAIM, count)
    await asyncio.sleep(seconds)
    handle.close()
    return asked


@pytest.mark.parametrize("goodbye", [False, True])
async def test_who_takes_over_without_a_goodbye_looks_twice_a_second(goodbye: bool) -> None:
    bus = FakeBus("5")
    first, second = await owned(bus), Ownership(bus.join("1"), KEYS, asyncio.get_running_loop().time)
    taking = asyncio.create_task(second.take())
    await asyncio.sleep(YOUNG_S)
    if goodbye:
        first.leave()
        await asyncio.sleep(0.5)
    first.release()
    await asyncio.wait_for(taking, 2.0)
    watched(second)
    asked = await looks_within(bus, 100.0)
    assert asked in (range(15, 25) if goodbye else range(180, 210))


async def test_who_found_nobody_looks_closely_for_a_minute() -> None:
    bus = FakeBus("5")
    watched(await owned(bus))
    assert await looks_within(bus, YOUNG_S) in range(100, 125)
    assert await looks_within(bus, YOUNG_S) in range(9, 15)


async def test_a_foreign_question_makes_the_owner_ask_and_its_own_does_not() -> None:
    bus = FakeBus("5")
    robot, _ = watched(await owned(bus))
    await asyncio.sleep(2 * YOUNG_S)
    forge(bus.join("1"), EVIL)
    await bus.join("1").ask(CLAIM, msgpack.packb({"zid": "5", "serves": True}))
    await bus.join("2").ask(CLAIM, msgpack.packb({"zid": "2", "serves": False}))
    for question in (b"\xc1", b"\x81\xa3zid\xa1\xff"):
        await bus.join("2").ask(CLAIM, question)
    seen = len(robot.rivals)
    await asyncio.sleep(0.3)
    assert len(robot.rivals) == seen
    await bus.join("1").ask(CLAIM, msgpack.packb({"zid": "1", "serves": True}))
    await asyncio.sleep(0.6)
    assert robot.turns == ["aside"]


async def test_whoever_answers_better_claims_silences_a_gateway_for_as_long_as_it_answers() -> None:
    """On an open bus nobody can tell a forged claim from a true one: a documented risk."""
    bus = FakeBus("5")
    robot, watching = watched(await owned(bus))
    forged = forge(bus.join("1"), EVIL)
    await asyncio.sleep(2.0)
    assert (robot.turns, await bus.alive(TOKEN)) == (["aside"], [])
    forged.close()
    await asyncio.sleep(2.0)
    assert (robot.turns, await bus.alive(TOKEN), watching.done()) == (["aside", "in"], [TOKEN], False)


async def test_a_waiting_gateway_hears_of_the_latches_and_releases_of_the_one_that_serves() -> None:
    bus, mirrored = FakeBus("5"), list[LatchRecord]()
    latch = Latch(b"a" * 16, "ann", "a cable is loose", fleet=True)
    first = await owned(bus)
    robot, _ = watched(first)
    taking = asyncio.create_task(Ownership(bus.join("1"), KEYS, mirror=mirrored.append).take())
    await asyncio.sleep(1.0)
    assert {*mirrored} == {LatchRecord()}
    robot.record = LatchRecord((latch,), (b"b" * 16,), (b"c" * 16,), autonomous=True)
    await asyncio.sleep(1.0)
    assert mirrored[-1] == robot.record
    assert not taking.done()


@pytest.mark.parametrize("known", [LatchRecord(autonomous=True), LatchRecord((Latch(b"a" * 16, "ann"),))])
async def test_the_gateway_that_serves_hears_from_one_that_waits_what_that_one_knows(known: LatchRecord) -> None:
    bus, records = FakeBus("5"), [LatchRecord(released=(b"b" * 16,), released_fleet=(b"c" * 16,))]
    robot, _ = watched(await owned(bus))
    taking = asyncio.create_task(Ownership(bus.join("1"), KEYS, record=lambda: records[-1]).take())
    await asyncio.sleep(1.0)
    assert robot.merged == [], "whoever asks may release nothing"
    records.append(known)
    await asyncio.sleep(1.0)
    assert {*robot.merged} == {known}
    assert not taking.done()


# A restart


async def test_a_successor_is_no_rival_before_it_has_begun_and_its_claim_keeps_others_away() -> None:
    bus = FakeBus("5")
    first = await owned(bus)
    robot, _ = watched(first)
    first.hands_over = True
    exported = first.export()
    assert exported is not None
    second = Ownership(bus.join("1"), KEYS)
    second.restore(exported)
    successor, _ = watched(second, Robot(True, robot.connected_at))
    await asyncio.sleep(20.0)
    first.hands_over = False  # the successor has failed, but is not gone yet
    await asyncio.sleep(10.0)
    assert (robot.turns, successor.turns) == ([], [])
    first.release()
    await kept_waiting(bus.join("0"))
    second.begin()
    await asyncio.sleep(10.0)
    assert successor.turns == []


async def test_who_waits_for_a_robot_does_not_take_it_while_a_successor_starts() -> None:
    bus = FakeBus("5")
    first = await owned(bus)
    waiting = Ownership(bus.join("1"), KEYS)
    taking = asyncio.create_task(waiting.take())
    await asyncio.sleep(1.0)
    first.release()
    for _ in range(200):
        await asyncio.sleep(0.01)
        if await bus.alive(TOKEN):  # it announces its claim
            break
    waiting.hands_over = True
    await asyncio.sleep(10.0)
    assert not taking.done()
    waiting.hands_over = False  # the successor has failed
    await asyncio.sleep(2.0)
    assert taking.done()


async def test_the_successor_of_one_that_had_yielded_has_yielded() -> None:
    two = Two()
    await two.serve(Robot(True, 5.0), Robot(True, 0.0))
    two.heal(noticed=True)
    await asyncio.sleep(3.0)
    first = two.ownerships[0]
    exported = first.export()
    assert exported is not None
    second = Ownership(two.buses[0].join("2"), KEYS, asyncio.get_running_loop().time)
    second.restore(exported)
    successor, _ = watched(second, Robot(True, 5.0))
    second.begin()
    two.watching[0].cancel()
    first.release()
    await asyncio.sleep(10.0)
    assert (successor.turns, two.robots[1].turns) == (["aside"], [])


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("reference/state-tables.md", "found") == executed(Ownership.TABLE)


@pytest.mark.parametrize("noticed", [False, True])
async def test_a_latched_stop_of_the_one_that_leaves_is_heard_by_the_one_that_stays(*, noticed: bool) -> None:
    latch = Latch(b"\x07" * 16, "ann")
    for first, second, winner in [
        (Robot(True, 0.0), Robot(False, None, LatchRecord((latch,))), 0),
        (Robot(False, None, LatchRecord((latch,))), Robot(True, 0.0), 1),
        (Robot(True, 0.0), Robot(True, 5.0, LatchRecord((latch,))), 0),
    ]:
        two = Two()
        await two.serve(first, second)
        await asyncio.sleep(9.0)
        two.heal(noticed=noticed)
        await asyncio.sleep(2.0)
        assert two.serving == [FIRST, SECOND][winner]
        assert two.robots[winner].heard_latches == {latch}
        for watching in two.watching:
            watching.cancel()


async def test_who_has_no_connection_steps_aside_too_before_it_leaves_the_robot() -> None:
    """It would connect once more while it ends, and a robot that accepts nobody else would hear the wrong one."""
    two = Two()
    await two.serve(Robot(True, 0.0), Robot(False, None))
    await asyncio.sleep(9.0)
    two.heal(noticed=False)
    await asyncio.wait_for(two.watching[1], 2.0)
    assert two.robots[1].turns == ["aside"]


@pytest.mark.parametrize("goodbye", [False, True])
async def test_who_has_yielded_serves_again_after_a_goodbye_or_once_three_looks_in_a_row_found_nobody(
    *, goodbye: bool
) -> None:
    two = Two()
    await two.serve(Robot(True, 0.0), Robot(True, 5.0))
    await asyncio.sleep(9.0)
    two.heal(noticed=False)
    await asyncio.sleep(2.0)
    assert two.robots[1].turns == ["aside"]
    if goodbye:
        two.ownerships[0].leave()
    else:
        two.watching[0].cancel()
        two.ownerships[0].release()
    await asyncio.sleep(LOOKS * CLOSE_S - 0.6)
    assert two.robots[1].turns == ["aside", "in"][: 1 + goodbye]
    await asyncio.sleep(1.0)
    assert two.robots[1].turns == ["aside", "in"]


async def test_who_has_yielded_and_hears_nothing_because_the_bus_is_gone_leaves_the_robot_alone() -> None:
    two = Two()
    await two.serve(Robot(True, 0.0), Robot(True, 5.0))
    await asyncio.sleep(9.0)
    two.heal(noticed=True)
    await asyncio.sleep(2.0)
    two.buses[1].connection(False)
    two.watching[0].cancel()
    two.ownerships[0].release()
    await asyncio.sleep(60.0)
    assert two.robots[1].turns == ["aside"]
    two.buses[1].connection(True)
    await asyncio.sleep(3.0)
    assert two.robots[1].turns == ["aside", "in"]
