"""The lease client on a bus: questions are asked, the token is there while it must be."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from tests.clock import jumping
from tests.fake_bus import FakeBus
from tests.lease import decide
from tests.proofs import numbered
from zbridge.bus import IncomingQuery
from zbridge.control.authority import Authority
from zbridge.errors import BusError
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.topics import KeySpace
from zbridge.lease.lease_client import LeaseClient
from zbridge.lease.lease_events import LeaseEvent, LeaseEventKind
from zbridge.lease.lease_holder import LeaseHolder

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
        self.tasks: list[asyncio.Task[None]] = []
        request = Acquire(who="ann", alive=TOKEN)
        client = LeaseClient(KEYS, request, "ann", concerns=lambda refusal: True, clock_ms=lambda: 0.0, wait_s=wait_s)
        self.holder = LeaseHolder(
            self.bus, client, spawn=self._spawn, on_event=self.events.append, clock=self.loop.time
        )

    async def settle(self) -> None:
        while under_way := [task for task in self.tasks if not task.done()]:
            await asyncio.wait(under_way)

    async def tokens(self) -> list[str]:
        return await self.bus.alive(KEYS.alive("*"))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        self.tasks.append(self.loop.create_task(work))

    def _decide(self, question: IncomingQuery) -> None:
        self.asked.append(KEYS.path(question.key).removeprefix("@rpc/control/"))
        lease = decide(self.authority, question.key, question.payload, self.loop.time())
        question.answer(payloads.encode(lease))


async def test_the_token_is_there_from_the_first_question_until_the_lease_was_given_back() -> None:
    scene = Scene()
    assert await scene.tokens() == []
    scene.holder.want()
    assert await scene.tokens() == [KEYS.alive(TOKEN)]
    await scene.settle()
    assert [event.kind for event in scene.events] == [LeaseEventKind.GRANTED]
    scene.holder.drop()
    scene.holder.want()
    await scene.settle()
    assert scene.asked == ["acquire/ann", "release", "acquire/ann"]
    assert scene.holder.held
    scene.holder.close()
    assert await scene.tokens() == [KEYS.alive(TOKEN)]
    await scene.settle()
    assert await scene.tokens() == []
    assert scene.authority.state == "free"
    scene.holder.close()


async def test_a_lease_that_control_shows_and_nobody_knows_of_loses_its_token() -> None:
    scene = Scene()
    scene.holder.announce()
    scene.authority.acquire(Acquire(who="ann"), scene.loop.time())
    scene.holder.read_control(scene.authority.report(scene.loop.time()))
    assert await scene.tokens() == []
    scene.authority.stop("its token is lost")
    scene.holder.want()
    assert await scene.tokens() == [KEYS.alive(f"{TOKEN}.1")], "the end of the first one ends no later lease"
    await scene.settle()
    scene.authority.vanished(TOKEN)
    assert scene.authority.state == "held"
    scene.authority.vanished(f"{TOKEN}.1")
    assert scene.authority.state == "stopped"


async def test_a_bus_that_fails_denies_the_lease_but_keeps_none_from_being_given_back(monkeypatch) -> None:
    async def fails(*args: Any, **named: Any) -> Any:
        raise BusError("the bus is closed")

    scene = Scene()
    with monkeypatch.context() as patch:
        patch.setattr(scene.bus, "ask", fails)
        scene.holder.want()
        await scene.settle()
    assert [str(event.error) for event in scene.events] == ["the bus is closed"]
    scene.holder.want()
    await scene.settle()
    monkeypatch.setattr(scene.bus, "flush", fails)
    scene.holder.drop()
    await scene.settle()
    assert scene.authority.state == "free"


@jumping
async def test_keeping_renews_when_it_is_due() -> None:
    scene = Scene(wait_s=5.0)
    keeping = asyncio.create_task(scene.holder.keep())
    scene.holder.want()
    await asyncio.sleep(10.5)
    assert scene.asked == ["acquire/ann"] + ["renew"] * 10
    assert scene.holder.held
    keeping.cancel()
