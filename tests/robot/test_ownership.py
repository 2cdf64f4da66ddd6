"""One gateway per robot, on a fake bus and a clock that jumps."""

import asyncio
import logging
import random
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack
import pytest

from tests.tables import documented, executed
from zbridge.bus import Answer, Handle, IncomingQuery, Lane
from zbridge.bus.fake import FakeBus
from zbridge.bus.interface import Sort
from zbridge.fleet.topics import KeySpace
from zbridge.robot.ownership import ANNOUNCE_S, LOOKS, MOST_S, RIVALS, WATCH_S, Ownership

pytestmark = pytest.mark.jumping

KEYS = KeySpace("fleet", "r1")
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

    def answer(self, key: str, handler: Callable[[IncomingQuery], None], *, lane: Lane | Sort = Lane.OTHER) -> Handle:
        return self._later(lambda: super(Distant, self).answer(key, handler, lane=lane))

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
    claim = Ownership(bus, keys)
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
    shared = FakeBus()._shared
    claims = {zid: Ownership(Distant(zid, shared), KEYS) for zid in zids}
    takes = {zid: asyncio.create_task(claim.take()) for zid, claim in claims.items()}
    await asyncio.sleep(5.0)
    winner, loser = sorted(zids)
    assert (takes[winner].done(), takes[loser].done()) == (True, False)
    claims[winner].release()
    await asyncio.wait_for(takes[loser], 1.0)


@pytest.mark.parametrize("count", [2, 3])
async def test_of_those_that_start_together_one_goes_on_a_hundred_times_of_a_hundred(count: int) -> None:
    settled = []
    for seed in range(100):
        rng, shared = random.Random(seed), FakeBus()._shared
        takes = []
        for number in range(count):
            bus = Distant(str(number), shared)
            bus.late_s = partial(rng.uniform, 0.0, ANNOUNCE_S * 0.9)
            takes.append(asyncio.create_task(Ownership(bus, KEYS).take()))
            await asyncio.sleep(rng.uniform(0.0, 0.2))
        await asyncio.sleep(10.0)
        settled.append([take.done() for take in takes].count(True))
    assert settled == [1] * 100


async def test_one_that_holds_the_robot_is_not_driven_out_by_a_lower_id_that_does_not_see_its_token() -> None:
    bus = FakeBus("9")
    await owned(bus)
    bus._shared.tokens.remove(TOKEN)
    await kept_waiting(bus.join("1"))


def watched(claim: Ownership, *, has: bool) -> tuple[list[tuple[str, ...]], asyncio.Task[None]]:
    """Watch a claim; give what is told of others, and what ends when the robot was left to another."""
    told: list[tuple[str, ...]] = []
    return told, asyncio.create_task(claim.watch(lambda: has, told.append))


# Forged claims


def forge(bus: FakeBus, *claims: Any) -> Handle:
    """Answer for a gateway that there is not: with these claims, or these bytes, one after the other."""

    def answer(question: IncomingQuery) -> None:
        for claim in claims:
            question.answer(claim if isinstance(claim, bytes) else msgpack.packb(claim))

    return bus.answer(CLAIM, answer)


IMPLAUSIBLE = [
    *({"held_s": held_s, "has": True} for held_s in (MOST_S * 2, float("inf"), float("nan"), -1.0, 0.0, "9", [1.0])),
    {"held_s": None},
    {"held_s": 1.0, "has": "yes"},
    [1.0, True],
    b"",
    b"\xc1",
    b"\x91" * 2000,
]


@pytest.mark.parametrize("claim", IMPLAUSIBLE, ids=range(len(IMPLAUSIBLE)))
async def test_what_nobody_can_claim_is_no_claim(claim: Any) -> None:
    bus = FakeBus("5")
    forge(bus.join("1"), claim)
    told, watching = watched(await owned(bus), has=False)
    await asyncio.sleep(3 * WATCH_S)
    assert (set(told), watching.done()) == ({()}, False)


async def test_whoever_goes_on_answering_delays_a_start_and_nothing_else() -> None:
    bus = FakeBus("1")
    forged = forge(bus.join("9"), EVIL)
    taking = await kept_waiting(bus)
    forged.close()
    await asyncio.wait_for(taking, 1.0)


EVIL = {"held_s": 3600.0, "has": True}


@pytest.mark.parametrize("claims", [[{"held_s": 0.0, "zid": "1"}], [{"held_s": 0.0}, EVIL, EVIL]])
async def test_whose_claim_it_is_the_bus_tells_and_no_payload_and_only_the_first_counts(claims: list[Any]) -> None:
    bus = FakeBus("5")
    forge(bus.join("9"), *claims)
    told, _ = watched(await owned(bus), has=True)  # of two that begin the lower one goes on: 5
    await asyncio.sleep(WATCH_S + 1.0)
    assert set(told) == {()}


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
        "there is a token of a gateway of r1 and no gateway that answers: it is ignored"
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
    await kept_waiting(Silent("0", bus._shared))


# Keeping the robot


@pytest.mark.parametrize("claim", [{"held_s": MOST_S, "has": True}, {"held_s": 1e-6}])
async def test_a_gateway_that_has_its_robot_leaves_it_to_nobody_and_tells_of_them(claim: dict[str, Any]) -> None:
    bus = FakeBus("5")
    told, watching = watched(await owned(bus), has=True)
    await asyncio.sleep(1.0)
    forged = forge(bus.join("1"), claim)
    await asyncio.sleep(WATCH_S + 1.0)
    assert told[-1] == ("1",), "found while the bus stays"
    for up in (False, True):
        bus.connection(up)
        await asyncio.sleep(1.0)
        assert told[-1] == ("1",)
    forged.close()
    await asyncio.sleep(WATCH_S + 1.0)
    assert (told[-1], watching.done(), await bus.alive(TOKEN)) == ((), False, [TOKEN])


@pytest.mark.parametrize(
    ("first_has", "second_has", "left"),  # the first served the robot longer, and has the higher id
    [
        (True, False, (False, True)),
        (False, True, (True, False)),
        (True, True, (False, False)),
        (False, False, (False, True)),
    ],
)
async def test_when_two_see_each_other_again_the_one_that_has_the_robot_keeps_it(first_has, second_has, left) -> None:
    bus, other = FakeBus("9"), FakeBus("1")
    clock = asyncio.get_running_loop().time
    first, second = Ownership(bus, KEYS, clock), Ownership(other, KEYS, clock)
    await first.take()
    await asyncio.sleep(30.0)
    await second.take()
    (told, one), (told_other, two) = watched(first, has=first_has), watched(second, has=second_has)
    await asyncio.sleep(1.0)
    for session in (bus, other):
        session.connection(False)
    bus._shared.queryables += other._shared.queryables
    bus._shared.tokens += other._shared.tokens
    other._shared = bus._shared
    for session in (bus, other):
        session.connection(True)
    await asyncio.sleep(2 * WATCH_S)
    assert (one.done(), two.done()) == left
    if left == (False, False):
        assert (told[-1], told_other[-1]) == (("1",), ("9",))


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("control.md", "found") == executed(Ownership.TABLE)
