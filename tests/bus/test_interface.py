"""What the bus promises, over Zenoh itself (one session on loopback) and on the fake bus of the tests."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from tests.bus import Seen
from tests.fake_bus import FakeBus
from zbridge.bus import Bus, BusSettings, IncomingQuery, open_bus
from zbridge.errors import Held
from zbridge.fleet import topics
from zbridge.metrics import Metrics


@pytest.fixture(params=["zenoh", "fake"])
async def bus(request: pytest.FixtureRequest) -> AsyncIterator[Bus]:
    alone = BusSettings(multicast=False, listen=("tcp/127.0.0.1:0",))
    opened: Bus = FakeBus() if request.param == "fake" else await open_bus(alone, Metrics())
    yield opened
    await opened.close()


async def test_a_sample_reaches_whoever_subscribed_until_they_close(bus: Bus) -> None:
    star, other, exact = Seen(), Seen(), Seen()
    handle = bus.subscribe("fleet/*/pose", lambda sample: star.take(sample.key))
    bus.subscribe("fleet/r2/pose", lambda sample: other.take(sample.key))
    bus.subscribe("fleet/r1/pose", lambda sample: exact.take(sample.key, sample.payload, sample.attachment))
    pose = bus.publisher("fleet/r1/pose", topics.POSE)
    pose.put(b"one", b"attached")
    await star.until(lambda: star == ["fleet/r1/pose"])
    handle.close()
    handle.close()
    pose.put(b"two")
    await exact.until(lambda: len(exact) == 2)
    assert exact == [("fleet/r1/pose", b"one", b"attached"), ("fleet/r1/pose", b"two", None)]
    bus.publisher("fleet/*/pose", topics.POSE).put(b"")
    await other.until(lambda: other == ["fleet/*/pose"])
    assert len(star) == 1


async def test_a_state_is_kept_for_queries_until_its_publisher_goes(bus: Bus) -> None:
    bus.publisher("fleet/r1/pose", topics.POSE).put(b"pose")
    status = bus.publisher("fleet/r1/status", topics.STATUS)
    for payload in (b"one", b"two"):
        status.put(payload)
    assert [(reply.key, reply.payload) for reply in await bus.ask("fleet/*/*")] == [("fleet/r1/status", b"two")]
    status.close()
    assert await bus.ask("fleet/*/status") == []


async def test_a_question_knows_what_was_asked_and_is_answered_on_a_concrete_key_or_refused(bus: Bus) -> None:
    def answer(question: IncomingQuery) -> None:
        if "*" in question.key:
            question.refuse(Held("held by ann"))
        else:
            question.answer(question.asked.encode() + question.payload)

    acquire, renew = "fleet/r1/@rpc/control/acquire/", "fleet/r1/@rpc/control/renew"
    handles = [bus.answer(key, answer) for key in (acquire + "*", renew)]
    for asked, key in ((acquire + "user%40host", acquire + "user%40host"), ("fleet/*/@rpc/control/renew", renew)):
        (reply,) = await bus.ask(asked, b"!")
        assert (reply.key, reply.payload, reply.error) == (key, asked.encode() + b"!", None)
        assert reply.replier == bus.zid
    for asked in (acquire + "*", "fleet/*/@rpc/control/acquire/op1"):
        (reply,) = await bus.ask(asked)
        assert isinstance(reply.error, Held)
    for handle in handles:
        handle.close()
    assert await bus.ask(renew) == []


async def test_who_watches_tokens_is_told_those_there_are_those_that_come_and_those_that_go(bus: Bus) -> None:
    first = bus.announce("fleet/r1/@alive/first")
    elsewhere = bus.announce("fleet/r2/@alive/elsewhere")
    seen, again = Seen(), Seen()
    handle = bus.watch_alive("fleet/r1/@alive/*", seen.take)
    await seen.until(lambda: len(seen) == 1)
    second = bus.announce("fleet/r1/@alive/second")
    await seen.until(lambda: len(seen) == 2)
    assert sorted(await bus.alive("fleet/*/@alive/*")) == [
        f"fleet/{name}" for name in ("r1/@alive/first", "r1/@alive/second", "r2/@alive/elsewhere")
    ]
    elsewhere.close()
    first.close()
    await seen.until(lambda: len(seen) == 3)
    assert seen == [("fleet/r1/@alive/first", True), ("fleet/r1/@alive/second", True), ("fleet/r1/@alive/first", False)]
    handle.close()
    handle.close()
    bus.watch_alive("fleet/r1/@alive/*", again.take)
    second.close()
    await again.until(lambda: ("fleet/r1/@alive/second", False) in again)
    assert len(seen) == 3, "a closed watch is told nothing"
