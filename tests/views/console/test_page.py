"""A slow page: of all that it is told one message waits, and what it missed it gets anew."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from zbridge.views.console.page import Page


class SlowSocket:
    """A page's socket that takes a message only when it is told to."""

    client = ("127.0.0.1", 1)

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.takes = asyncio.Semaphore(0)

    async def send_text(self, text: str) -> None:
        await self.takes.acquire()
        self.sent.append(text)

    async def receive_text(self) -> str:
        await asyncio.Event().wait()
        raise AssertionError


@contextlib.asynccontextmanager
async def served() -> AsyncIterator[tuple[SlowSocket, Page]]:
    socket: Any = SlowSocket()
    page = Page(socket, lambda: b"all", lambda page, request: None)
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
