"""One gateway per robot, on a fake bus and a clock that jumps."""

import asyncio
import logging
import random
from collections.abc import Callable
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
TOKEN = "fleet/r1/@alive/gateway"


class Slow(FakeBus):
    """A bus on which tokens and answers take a moment."""

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        seen = await super().alive(key_expr, timeout_s=timeout_s)
        await asyncio.sleep(0.01)
        return seen

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(0.01)
        return await super().ask(key_expr, payload, timeout_s=timeout_s)

    def join(self, zid: str) -> "Slow":
        return Slow(zid, self._shared)


async def test_the_only_gateway_takes_the_robot_and_shows_it() -> None:
    bus = FakeBus("1")
    claim = Ownership(bus, KEYS)
    assert repr(claim) == "<Ownership r1 not held>"
    await claim.take()
    assert repr(claim) == "<Ownership r1 held>"
    assert await bus.join("2").alive("fleet/*/@alive/*") == [TOKEN]


async def test_a_second_gateway_waits_until_the_first_goes_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    bus = FakeBus("5")
    first, second = Ownership(bus, KEYS), Ownership(bus.join("1"), KEYS)
    await first.take()
    with caplog.at_level(logging.WARNING):
        waiting = asyncio.create_task(second.take())
        await asyncio.sleep(10.0)
    assert not waiting.done()
    assert [record.getMessage() for record in caplog.records] == ["another gateway serves r1: waiting until it goes"]
    assert await bus.alive(TOKEN) == [TOKEN]
    first.release()
    await asyncio.wait_for(waiting, 1.0)
    assert repr(second) == "<Ownership r1 held>"


async def test_gateways_of_different_robots_do_not_meet() -> None:
    bus = FakeBus("1")
    await Ownership(bus, KEYS).take()
    await asyncio.wait_for(Ownership(bus.join("2"), KeySpace("fleet", "r2")).take(), 1.0)
    await asyncio.wait_for(Ownership(bus.join("3"), KeySpace("other", "r1")).take(), 1.0)


@pytest.mark.parametrize("zids", [("1", "2"), ("2", "1"), ("a", "b"), ("b", "a")])
async def test_of_two_that_start_at_the_same_moment_the_lower_id_goes_on(zids: tuple[str, str]) -> None:
    bus = Slow(zids[0])
    claims = {zids[0]: Ownership(bus, KEYS), zids[1]: Ownership(bus.join(zids[1]), KEYS)}
    takes = {zid: asyncio.create_task(claim.take()) for zid, claim in claims.items()}
    await asyncio.sleep(5.0)
    winner, loser = sorted(zids)
    assert takes[winner].done()
    assert not takes[loser].done()
    claims[winner].release()
    await asyncio.wait_for(takes[loser], 1.0)


async def test_of_many_that_start_together_exactly_one_goes_on() -> None:
    bus = Slow("0")
    claims = [Ownership(bus, KEYS), *(Ownership(bus.join(str(number)), KEYS) for number in range(1, 6))]
    takes = [asyncio.create_task(claim.take()) for claim in claims]
    await asyncio.sleep(10.0)
    assert [take.done() for take in takes].count(True) == 1
    for take in takes:
        take.cancel()
    await asyncio.gather(*takes, return_exceptions=True)


async def test_one_that_holds_the_robot_is_not_driven_out_by_a_lower_id() -> None:
    bus = Slow("9")
    first = Ownership(bus, KEYS)
    await first.take()
    token = next(iter(await bus.alive(TOKEN)))
    bus._shared.tokens.remove(token)  # the token is not seen, for once
    second = asyncio.create_task(Ownership(bus.join("1"), KEYS).take())
    await asyncio.sleep(0.2)
    assert not second.done()
    second.cancel()
    with pytest.raises(asyncio.CancelledError):
        await second


async def test_a_gateway_starts_although_nobody_else_is_on_the_bus_yet() -> None:
    bus = FakeBus("1")
    bus.connection(False)
    await asyncio.wait_for(Ownership(bus, KEYS).take(), 1.0)


async def test_an_answer_that_is_no_map_does_not_decide() -> None:
    bus = FakeBus("5")
    bus.join("1").answer("fleet/r1/@rpc/claim/gateway", lambda question: question.answer(b"\xc1"))
    await asyncio.wait_for(Ownership(bus, KEYS).take(), 1.0)


async def test_a_released_claim_leaves_nothing_behind_and_releasing_twice_does_no_harm() -> None:
    bus = FakeBus("1")
    claim = Ownership(bus, KEYS)
    await claim.take()
    claim.release()
    claim.release()
    assert repr(claim) == "<Ownership r1 not held>"
    assert await bus.alive("**/@alive/*") == []
    assert await bus.ask("fleet/r1/@rpc/claim/gateway") == []
    await asyncio.wait_for(claim.take(), 1.0)


# Forged claims


CLAIM = "fleet/r1/@rpc/claim/gateway"


def forge(bus: FakeBus, *claims: Any) -> Handle:
    """Answer for a gateway that there is not: with these claims, or these bytes, one after the other."""

    def answer(question: IncomingQuery) -> None:
        for claim in claims:
            question.answer(claim if isinstance(claim, bytes) else msgpack.packb(claim))

    return bus.answer(CLAIM, answer)


IMPLAUSIBLE = [
    {"held_s": 1e300, "has": True},
    {"held_s": MOST_S * 2, "has": True},
    {"held_s": float("inf"), "has": True},
    {"held_s": float("nan"), "has": True},
    {"held_s": -1.0, "has": True},
    {"held_s": 0.0, "has": True},
    {"held_s": "9", "has": True},
    {"held_s": None},
    {"held_s": True},
    {"held_s": 1.0, "has": "yes"},
    {"held_s": [1.0]},
    [1.0, True],
    b"",
    b"\xc1",
    b"\x91" * 2000,
]


@pytest.mark.parametrize("claim", IMPLAUSIBLE, ids=range(len(IMPLAUSIBLE)))
async def test_what_nobody_can_claim_is_no_claim(claim: Any) -> None:
    bus = FakeBus("5")
    forge(bus.join("1"), claim)
    ours = Ownership(bus, KEYS)
    await asyncio.wait_for(ours.take(), 1.0)
    watch = Watch(ours, has=False)
    await asyncio.sleep(3 * WATCH_S)
    assert not watch.over
    assert set(watch.told) == {()}
    await watch.end()


async def test_whoever_goes_on_answering_delays_a_start_and_nothing_else() -> None:
    bus = FakeBus("1")
    forged = forge(bus.join("9"), {"held_s": 3600.0, "has": True})
    taking = asyncio.create_task(Ownership(bus, KEYS).take())
    await asyncio.sleep(60.0)
    assert not taking.done()
    forged.close()
    await asyncio.wait_for(taking, 1.0)


async def test_whose_claim_it_is_the_bus_tells_and_no_payload() -> None:
    bus = FakeBus("5")
    forge(bus.join("9"), {"held_s": 0.0, "zid": "1"})
    await asyncio.wait_for(Ownership(bus, KEYS).take(), 1.0)  # of two that begin the lower one goes on: 5


async def test_what_one_answers_several_times_counts_once() -> None:
    bus, evil = FakeBus("5"), {"held_s": 3600.0, "has": True}
    forge(bus.join("9"), {"held_s": 0.0}, evil, evil)
    ours = Ownership(bus, KEYS)
    await asyncio.wait_for(ours.take(), 1.0)
    watch = Watch(ours, has=True)
    await asyncio.sleep(WATCH_S + 1.0)
    assert set(watch.told) == {()}
    await watch.end()


async def test_a_crowd_of_weak_claims_hides_no_good_one() -> None:
    bus = FakeBus("5")
    for number in range(3 * RIVALS):
        forge(bus.join(f"f{number:02}"), {"held_s": 0.0})
    true = Ownership(bus.join("a"), KEYS)
    await asyncio.wait_for(true.take(), 60.0)
    taking = asyncio.create_task(Ownership(bus.join("0"), KEYS).take())
    await asyncio.sleep(10.0)
    assert not taking.done()
    taking.cancel()


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
    await Ownership(bus, KEYS).take()
    taking = asyncio.create_task(Ownership(Silent("0", bus._shared), KEYS).take())
    await asyncio.sleep(10.0)
    assert not taking.done()
    taking.cancel()


# Keeping the robot


class Watch:
    """A claim that is held and watched, and what was told of others."""

    def __init__(self, claim: Ownership, *, has: bool) -> None:
        self.told: list[tuple[str, ...]] = []
        self._task = asyncio.create_task(claim.watch(lambda: has, self.told.append))

    @property
    def over(self) -> bool:
        """Whether the robot was left to another."""
        return self._task.done()

    async def end(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


EVIL = [{"held_s": 3600.0, "has": True}, {"held_s": MOST_S, "has": True}, {"held_s": 1e-6}]


@pytest.mark.parametrize("claim", EVIL)
async def test_a_gateway_that_has_its_robot_leaves_it_to_nobody_and_tells_of_them(claim: dict[str, Any]) -> None:
    bus = FakeBus("5")
    ours = Ownership(bus, KEYS)
    await ours.take()
    watch = Watch(ours, has=True)
    await asyncio.sleep(1.0)
    forged = forge(bus.join("1"), claim)
    for _ in range(3):
        bus.connection(False)
        await asyncio.sleep(1.0)
        bus.connection(True)
        await asyncio.sleep(1.0)
        assert watch.told[-1] == ("1",)
    forged.close()
    await asyncio.sleep(WATCH_S + 1.0)
    assert watch.told[-1] == ()
    assert not watch.over
    assert await bus.alive(TOKEN) == [TOKEN]
    await watch.end()


async def test_others_are_found_while_the_bus_stays() -> None:
    bus = FakeBus("5")
    ours = Ownership(bus, KEYS)
    await ours.take()
    watch = Watch(ours, has=True)
    await asyncio.sleep(1.0)
    forge(bus.join("1"), {"held_s": 1.0})
    await asyncio.sleep(WATCH_S + 1.0)
    assert watch.told[-1] == ("1",)
    await watch.end()


HEALED = [
    # who has the robot: the one that served it longer, with the higher id; the other one; and who lets go
    (True, False, (False, True)),
    (False, True, (True, False)),
    (True, True, (False, False)),
    (False, False, (False, True)),
]


@pytest.mark.parametrize(("first_has", "second_has", "left"), HEALED)
async def test_when_two_see_each_other_again_the_one_that_has_the_robot_keeps_it(first_has, second_has, left) -> None:
    bus, other = FakeBus("9"), FakeBus("1")
    clock = asyncio.get_running_loop().time
    first, second = Ownership(bus, KEYS, clock), Ownership(other, KEYS, clock)
    await first.take()
    await asyncio.sleep(30.0)
    await second.take()
    watches = Watch(first, has=first_has), Watch(second, has=second_has)
    await asyncio.sleep(1.0)
    for session in (bus, other):
        session.connection(False)
    bus._shared.queryables += other._shared.queryables
    bus._shared.tokens += other._shared.tokens
    other._shared = bus._shared
    for session in (bus, other):
        session.connection(True)
    await asyncio.sleep(2 * WATCH_S)
    assert tuple(watch.over for watch in watches) == left
    if left == (False, False):
        assert [watch.told[-1] for watch in watches] == [("1",), ("9",)]
    for watch in watches:
        await watch.end()


# Starting together


class Distant(FakeBus):
    """A bus on which all takes its time: what is announced, asked and answered gets about within a moment."""

    rng = random.Random(0)
    late_s = 0.0

    def _later(self, do: Callable[[], Handle]) -> Handle:
        done: list[Handle] = []
        timer = asyncio.get_running_loop().call_later(self.rng.uniform(0.0, self.late_s), lambda: done.append(do()))

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
        await asyncio.sleep(self.rng.uniform(0.0, self.late_s))
        return await super().alive(key_expr, timeout_s=timeout_s)

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(self.rng.uniform(0.0, self.late_s))
        answers = await super().ask(key_expr, payload, timeout_s=timeout_s)
        await asyncio.sleep(self.rng.uniform(0.0, self.late_s))
        return answers


@pytest.mark.parametrize("count", [2, 3])
async def test_of_those_that_start_together_one_goes_on_a_hundred_times_of_a_hundred(count: int) -> None:
    settled = []
    for seed in range(100):
        rng = random.Random(seed)
        shared = FakeBus()._shared
        claims = []
        for number in range(count):
            bus = Distant(str(number), shared)
            bus.rng, bus.late_s = rng, ANNOUNCE_S * 0.9
            claims.append(Ownership(bus, KEYS))

        async def start(claim: Ownership, after_s: float) -> None:
            await asyncio.sleep(after_s)
            await claim.take()

        takes = [asyncio.create_task(start(claim, rng.uniform(0.0, 0.4))) for claim in claims]
        await asyncio.sleep(10.0)
        settled.append([take.done() for take in takes].count(True))
        for take in takes:
            take.cancel()
        await asyncio.gather(*takes, return_exceptions=True)
    assert settled == [1] * 100


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("control.md", "found") == executed(Ownership.TABLE)
