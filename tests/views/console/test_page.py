"""A slow page: of what it is told one message waits, and what it missed it gets anew; of its robot the newest."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect, WebSocketDisconnected

from zbridge.views.console import page as page_module
from zbridge.views.console.page import FleetFollower, Page


class SlowSocket:
    """A page's socket that takes a message only when it is told to."""

    client = ("127.0.0.1", 1)

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.takes = asyncio.Semaphore(0)

    async def send_text(self, text: str) -> None:
        await self.takes.acquire()
        self.sent.append(text)

    async def send_bytes(self, payload: bytes) -> None:
        await self.takes.acquire()
        self.sent.append(payload.decode())

    async def receive_text(self) -> str:
        await asyncio.Event().wait()
        raise AssertionError


@contextlib.asynccontextmanager
async def served() -> AsyncIterator[tuple[SlowSocket, Page]]:
    socket: Any = SlowSocket()
    follower = FleetFollower(lambda: b"all")
    page = Page(socket, follower, lambda: True, lambda request: None)
    page.tell = follower.tell  # type: ignore[attr-defined]
    serving = asyncio.create_task(page.serve())
    try:
        await asyncio.sleep(0)
        yield socket, page
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def take(socket: SlowSocket, count: int) -> list[str]:
    for _ in range(count):
        socket.takes.release()
        await asyncio.sleep(0.01)
    return socket.sent


async def test_a_page_begins_with_all_and_then_gets_what_is_told() -> None:
    async with served() as (socket, page):
        await take(socket, 1)
        for message in (b"1", b"2"):
            page.tell(message)
            await take(socket, 1)
        assert socket.sent == ["all", "1", "2"]


async def test_of_a_thousand_messages_that_a_page_did_not_take_none_waits_and_all_is_sent_anew() -> None:
    async with served() as (socket, page):
        await take(socket, 1)
        for number in range(1000):
            page.tell(b"%d" % number)
            await asyncio.sleep(0)
        assert await take(socket, 5) == ["all", "0", "all"]
        page.tell(b"next")
        assert (await take(socket, 1))[-1] == "next"


class CountingWatch:
    """A robot that publishes faster than any page reads."""

    robot = "r1"

    def __init__(self) -> None:
        self.number = 0
        self.asked: list[int] = []

    def news(self, since: int) -> tuple[int, bytes | None]:
        self.asked.append(since)
        return (self.number, b"robot %d" % self.number) if self.number > since else (since, None)


async def test_of_its_robot_a_slow_page_gets_the_newest_when_it_takes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "PICTURES_HZ", 1000.0)
    watch: Any = CountingWatch()
    async with served() as (socket, page):
        await take(socket, 1)
        page.look(watch)
        watch.number = 1
        await asyncio.sleep(0.05)
        for watch.number in range(2, 1000):
            await asyncio.sleep(0)
        asked = len(watch.asked)
        await asyncio.sleep(0.05)
        assert len(watch.asked) == asked, "nothing is prepared for a page that takes nothing"
        assert await take(socket, 3) == ["all", "robot 1", "robot 999"]
        assert page.look(None) is watch
        watch.number += 1
        await take(socket, 1)
        assert socket.sent[-1] == "robot 999"


async def test_a_page_that_looks_again_gets_all_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "PICTURES_HZ", 1000.0)
    watch: Any = CountingWatch()
    watch.number = 5
    async with served() as (socket, page):
        await take(socket, 1)
        for _ in range(2):
            page.look(watch)
            await asyncio.sleep(0.02)
            await take(socket, 1)
            page.look(None)
        assert socket.sent == ["all", "robot 5", "robot 5"]


@pytest.mark.parametrize("error", [WebSocketDisconnect(1006), WebSocketDisconnected("closed")])
async def test_a_page_that_has_left_while_something_is_sent_to_it_ends_without_an_error(error: Exception) -> None:
    class Gone(SlowSocket):
        async def send_text(self, text: str) -> None:
            raise error

    socket: Any = Gone()
    await Page(socket, FleetFollower(lambda: b"all"), lambda: True, lambda request: None).serve()
