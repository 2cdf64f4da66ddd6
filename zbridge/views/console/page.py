"""One browser page on its socket: what waits to be sent to it, and what it asks for."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from zbridge.fleet.topics import is_name
from zbridge.tasks import race

MOST_BYTES = 4096
"""Bound of what a page sends at a time."""
_Name = Annotated[str, msgspec.Meta(max_length=255)]


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks for. robot: of ``stop`` and ``forget``."""

    do: Literal["stop_all", "release", "stop", "forget"]
    robot: _Name = ""


_decode = msgspec.json.Decoder(Request).decode


class Page:
    """A page. A slow one misses what came meanwhile and gets everything anew: of it one message waits at most.

    snapshot: returns all that a page needs to begin.
    """

    def __init__(self, socket: WebSocket, snapshot: Callable[[], bytes], ask: Callable[[Request], object]) -> None:
        self._socket = socket
        self._snapshot = snapshot
        self._ask = ask
        self._waiting: bytes | None = None
        self._behind = True
        self._news = asyncio.Event()
        self._news.set()

    def __repr__(self) -> str:
        return f"<Page {self._socket.client}>"

    def tell(self, message: bytes) -> None:
        """Send a message, or all anew if another one is still on its way."""
        self._behind = self._behind or self._waiting is not None
        self._waiting = message
        self._news.set()

    async def serve(self) -> None:
        """Serve the page until it leaves, or sends what it must not."""
        with contextlib.suppress(WebSocketDisconnect):
            await race(self._send(), self._receive())

    async def _send(self) -> None:
        while True:
            await self._news.wait()
            self._news.clear()
            message = self._snapshot() if self._behind else self._waiting
            self._behind, self._waiting = False, None
            if message is not None:
                await self._socket.send_text(message.decode())

    async def _receive(self) -> None:
        while True:
            text = await self._socket.receive_text()
            try:
                request = _decode(text)
            except msgspec.MsgspecError as error:
                await self._socket.close(1003, f"{error}"[:100])
                return
            if not request.robot or is_name(request.robot):
                self._ask(request)
