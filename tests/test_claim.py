"""One gateway per robot, on a fake bus and a clock that jumps."""

import asyncio
import logging

import pytest

from tests.clock import jumping
from zbridge.bus import Answer
from zbridge.bus.fake import FakeBus
from zbridge.claim import Claim
from zbridge.fleet.topics import KeySpace

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


@jumping
async def test_the_only_gateway_takes_the_robot_and_shows_it() -> None:
    bus = FakeBus("1")
    claim = Claim(bus, KEYS)
    assert repr(claim) == "<Claim r1 not held>"
    await claim.take()
    assert repr(claim) == "<Claim r1 held>"
    assert await bus.join("2").alive("fleet/*/@alive/*") == [TOKEN]


@jumping
async def test_a_second_gateway_waits_until_the_first_goes_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    bus = FakeBus("5")
    first, second = Claim(bus, KEYS), Claim(bus.join("1"), KEYS)
    await first.take()
    with caplog.at_level(logging.WARNING):
        waiting = asyncio.create_task(second.take())
        await asyncio.sleep(10.0)
    assert not waiting.done()
    assert [record.getMessage() for record in caplog.records] == ["another gateway serves r1: waiting until it goes"]
    assert await bus.alive(TOKEN) == [TOKEN]
    first.release()
    await asyncio.wait_for(waiting, 1.0)
    assert repr(second) == "<Claim r1 held>"


@jumping
async def test_gateways_of_different_robots_do_not_meet() -> None:
    bus = FakeBus("1")
    await Claim(bus, KEYS).take()
    await asyncio.wait_for(Claim(bus.join("2"), KeySpace("fleet", "r2")).take(), 1.0)
    await asyncio.wait_for(Claim(bus.join("3"), KeySpace("other", "r1")).take(), 1.0)


@pytest.mark.parametrize("zids", [("1", "2"), ("2", "1"), ("a", "b"), ("b", "a")])
@jumping
async def test_of_two_that_start_at_the_same_moment_the_lower_id_goes_on(zids: tuple[str, str]) -> None:
    bus = Slow(zids[0])
    claims = {zids[0]: Claim(bus, KEYS), zids[1]: Claim(bus.join(zids[1]), KEYS)}
    takes = {zid: asyncio.create_task(claim.take()) for zid, claim in claims.items()}
    await asyncio.sleep(5.0)
    winner, loser = sorted(zids)
    assert takes[winner].done()
    assert not takes[loser].done()
    claims[winner].release()
    await asyncio.wait_for(takes[loser], 1.0)


@jumping
async def test_of_many_that_start_together_exactly_one_goes_on() -> None:
    bus = Slow("0")
    claims = [Claim(bus, KEYS), *(Claim(bus.join(str(number)), KEYS) for number in range(1, 6))]
    takes = [asyncio.create_task(claim.take()) for claim in claims]
    await asyncio.sleep(10.0)
    assert [take.done() for take in takes].count(True) == 1
    for take in takes:
        take.cancel()
    await asyncio.gather(*takes, return_exceptions=True)


@jumping
async def test_one_that_holds_the_robot_is_not_driven_out_by_a_lower_id() -> None:
    bus = Slow("9")
    first = Claim(bus, KEYS)
    await first.take()
    token = next(iter(await bus.alive(TOKEN)))
    bus._shared.tokens.remove(token)  # the token is not seen, for once
    second = asyncio.create_task(Claim(bus.join("1"), KEYS).take())
    await asyncio.sleep(0.2)
    assert not second.done()
    second.cancel()
    with pytest.raises(asyncio.CancelledError):
        await second


@jumping
async def test_a_gateway_starts_although_nobody_else_is_on_the_bus_yet() -> None:
    bus = FakeBus("1")
    bus.connection(False)
    await asyncio.wait_for(Claim(bus, KEYS).take(), 1.0)


@jumping
async def test_an_answer_that_is_no_map_does_not_decide() -> None:
    bus = FakeBus("5")
    bus.join("1").answer("fleet/r1/@rpc/claim/gateway", lambda question: question.answer(b"\xc1"))
    await asyncio.wait_for(Claim(bus, KEYS).take(), 1.0)


@jumping
async def test_a_released_claim_leaves_nothing_behind_and_releasing_twice_does_no_harm() -> None:
    bus = FakeBus("1")
    claim = Claim(bus, KEYS)
    await claim.take()
    claim.release()
    claim.release()
    assert repr(claim) == "<Claim r1 not held>"
    assert await bus.alive("**/@alive/*") == []
    assert await bus.ask("fleet/r1/@rpc/claim/gateway") == []
    await asyncio.wait_for(claim.take(), 1.0)
