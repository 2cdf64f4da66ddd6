"""The lease client on a bus: questions are asked, the token is there while it must be."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

from tests.clock import jumping
from tests.proofs import numbered
from zbridge.bus import IncomingQuery
from zbridge.bus.fake import FakeBus
from zbridge.control.authority import Authority
from zbridge.control.lease_client import LeaseClient
from zbridge.control.lease_events import LeaseEvent, LeaseEventKind
from zbridge.control.lease_holder import LeaseHolder
from zbridge.control.proof import read
from zbridge.errors import BusError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Acquire
from zbridge.fleet.topics import KeySpace

KEYS = KeySpace("fleet", "r1")
TOKEN = "operator.ann.1"


class Scene:
    """A gateway's authority on a bus, and one program."""

    def __init__(self, *, wait_s: float | None = None) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = FakeBus("ann")
        self.authority = Authority(3.0, 2.0, numbered())
        self.asked: list[str] = []
        for name in ("acquire/*", "renew", "release"):
            self.bus.join("gateway").answer(KEYS.key(f"@rpc/control/{name}"), self._decide)
        self.events: list[LeaseEvent] = []
        self.tasks: set[asyncio.Task[None]] = set()
        request = Acquire(who="ann", alive=TOKEN)
        client = LeaseClient(KEYS, request, "ann", concerns=lambda refusal: True, wait_s=wait_s)
        self.holder = LeaseHolder(self.bus, client, spawn=self.spawn, on_event=self.events.append, clock=self.loop.time)

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = self.loop.create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def settle(self) -> None:
        while self.tasks:
            await asyncio.wait(self.tasks)

    async def tokens(self) -> list[str]:
        return await self.bus.alive(KEYS.alive("*"))

    def _decide(self, question: IncomingQuery) -> None:
        name = KEYS.path(question.key).removeprefix("@rpc/control/")
        self.asked.append(name)
        now = self.loop.time()
        if name.startswith("acquire"):
            lease = self.authority.acquire(payloads.decode(Acquire, question.payload), now)
        else:
            decide = self.authority.renew if name == "renew" else self.authority.release
            lease = decide(read(question.payload), question.key, now)
        question.answer(payloads.encode(lease))


async def test_the_token_is_there_from_the_first_question_until_the_lease_was_given_back() -> None:
    scene = Scene()
    assert await scene.tokens() == []
    scene.holder.want()
    assert await scene.tokens() == [KEYS.alive(TOKEN)]
    await scene.settle()
    assert [event.kind for event in scene.events] == [LeaseEventKind.GRANTED]
    scene.holder.close()
    assert await scene.tokens() == [KEYS.alive(TOKEN)]
    await scene.settle()
    assert await scene.tokens() == []
    assert scene.authority.state == "free"
    scene.holder.close()


async def test_a_lease_that_is_dropped_and_wanted_again_is_asked_for_after_it_was_given_back() -> None:
    scene = Scene()
    scene.holder.want()
    await scene.settle()
    scene.holder.drop()
    scene.holder.want()
    await scene.settle()
    assert scene.asked == ["acquire/ann", "release", "acquire/ann"]
    assert scene.holder.held


async def test_a_lease_that_control_shows_and_nobody_knows_of_loses_its_token() -> None:
    scene = Scene()
    scene.holder.announce()
    scene.authority.acquire(Acquire(who="ann"), scene.loop.time())
    scene.holder.look(scene.authority.report(scene.loop.time()))
    assert await scene.tokens() == []
    scene.authority.stop("its token is lost")
    scene.holder.want()
    assert await scene.tokens() == [KEYS.alive(f"{TOKEN}.1")], "the end of the first one ends no later lease"
    await scene.settle()
    scene.authority.vanished(TOKEN)
    assert scene.authority.state == "held"
    scene.authority.vanished(f"{TOKEN}.1")
    assert scene.authority.state == "stopped"


async def test_a_bus_that_cannot_be_asked_denies_the_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()

    async def fails(*args: Any, **named: Any) -> Any:
        raise BusError("the bus is closed")

    monkeypatch.setattr(scene.bus, "ask", fails)
    scene.holder.want()
    await scene.settle()
    assert [str(event.error) for event in scene.events] == ["the bus is closed"]


async def test_a_lease_is_given_back_although_what_was_commanded_before_cannot_be_flushed(monkeypatch) -> None:
    scene = Scene()

    async def fails() -> None:
        raise BusError("too long")

    scene.holder.want()
    await scene.settle()
    monkeypatch.setattr(scene.bus, "flush", fails)
    scene.holder.drop()
    await scene.settle()
    assert scene.authority.state == "free"


@jumping
async def test_keeping_renews_when_it_is_due_and_sleeps_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(wait_s=5.0)
    expirations = 0
    expire = scene.holder.expire

    def counted() -> None:
        nonlocal expirations
        expirations += 1
        expire()

    monkeypatch.setattr(scene.holder, "expire", counted)
    keeping = asyncio.create_task(scene.holder.keep())
    scene.holder.want()
    await asyncio.sleep(10.5)
    assert scene.asked == ["acquire/ann"] + ["renew"] * 10
    assert expirations <= 40
    assert scene.holder.held
    keeping.cancel()
