"""One browser page on its socket: what it asks for, what waits to be sent to it, and the robot that it looks at."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from zbridge.fleet.topics import is_name
from zbridge.tasks import race
from zbridge.views.console.robot_watch import RobotWatch

MOST_BYTES = 4096
"""Bound of what a page sends at a time."""
PICTURES_HZ = 15.0
"""How often a page is sent at most what is new of the robot that it looks at."""
_Name = Annotated[str, msgspec.Meta(max_length=255)]


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks for. robot: whom it concerns; of ``look`` "" for none. name, on: of ``switch``."""

    do: Literal["stop_all", "release", "stop", "forget", "look", "switch"]
    robot: _Name = ""
    name: Literal["", "light", "lidar", "camera"] = ""
    on: bool = False


_decode = msgspec.json.Decoder(Request).decode


class Page:
    """A page. A slow one misses what came meanwhile and gets everything anew: of it one message waits at most.

    snapshot: returns all that a page needs to begin. ask: called with the page and its request.
    """

    def __init__(
        self, socket: WebSocket, snapshot: Callable[[], bytes], ask: Callable[[Page, Request], object]
    ) -> None:
        self._socket = socket
        self._snapshot = snapshot
        self._ask = ask
        self._waiting: bytes | None = None
        self._behind = True
        self._news = asyncio.Event()
        self._news.set()
        self._watch: RobotWatch | None = None
        self._shown = 0
        """Number of the newest message of that robot that was sent."""
        self._looking = asyncio.Event()

    def __repr__(self) -> str:
        return f"<Page {self._socket.client}>"

    def tell(self, message: bytes) -> None:
        """Send a message, or all anew if another one is still on its way."""
        self._behind = self._behind or self._waiting is not None
        self._waiting = message
        self._news.set()

    def look(self, watch: RobotWatch | None) -> RobotWatch | None:
        """Show what is published of another robot, or of none from now on; return the watch of the one before."""
        before, self._watch, self._shown = self._watch, watch, 0
        if watch is None:
            self._looking.clear()
        else:
            self._looking.set()
        return before

    async def serve(self) -> None:
        """Serve the page until it leaves, or sends what it must not."""
        with contextlib.suppress(WebSocketDisconnect):
            await race(self._send(), self._show_robot(), self._receive())

    async def _send(self) -> None:
        while True:
            await self._news.wait()
            self._news.clear()
            message = self._snapshot() if self._behind else self._waiting
            self._behind, self._waiting = False, None
            if message is not None:
                await self._socket.send_text(message.decode())

    async def _show_robot(self) -> None:
        """Send the newest messages of the robot as often as the socket accepts them, at most :data:`PICTURES_HZ`."""
        while True:
            await self._looking.wait()
            if self._watch is not None:
                self._shown, news = self._watch.news(self._shown)
                if news is not None:
                    await self._socket.send_bytes(news)
            await asyncio.sleep(1 / PICTURES_HZ)

    async def _receive(self) -> None:
        while True:
            try:
                text = await self._socket.receive_text()
                request = _decode(text)
            except (msgspec.MsgspecError, KeyError) as error:  # KeyError: of starlette, for a message of bytes
                await self._socket.close(1003, f"{error}"[:100])
                return
            if not request.robot or is_name(request.robot):
                self._ask(self, request)
