"""One browser page on its socket: what it asks for, what it is told, and the robot that it looks at."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from zbridge.fleet.topics import is_name
from zbridge.protocol.rate_limit import RateLimit
from zbridge.tasks import race
from zbridge.views.console.robot_watch import RobotWatch

MOST_BYTES = 4096
"""Bound of what a page sends at a time."""
REQUESTS_HZ = 50.0
"""Most requests a second; a page that sends more is closed."""
PICTURES_HZ = 15.0
"""How often a page is sent at most what is new of the robot that it looks at."""
LOGIN_ENDED = 4401
_MALFORMED, _TOO_MANY = 1003, 1008
_Name = Annotated[str, msgspec.Meta(max_length=255)]


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks for. robot: whom it concerns; of ``look`` "" for none. name, on: of ``switch``."""

    do: Literal["stop_all", "release", "stop", "unlatch", "forget", "look", "switch"]
    robot: _Name = ""
    name: Literal["", "light", "lidar", "camera"] = ""
    on: bool = False


_decode = msgspec.json.Decoder(Request).decode


class FleetFollower:
    """One page, or one program. snapshot: returns all that it needs to begin.

    A slow one misses what came meanwhile and gets everything anew: one message waits at most.
    """

    def __init__(self, snapshot: Callable[[], bytes]) -> None:
        self._snapshot = snapshot
        self._waiting: bytes | None = None
        self._behind = True
        self._news = asyncio.Event()
        self._news.set()

    def __repr__(self) -> str:
        return f"<FleetFollower {'behind' if self._behind else 'up to date'}>"

    def tell(self, message: bytes) -> None:
        """Send a message, or all anew if another one still waits."""
        self._behind = self._behind or self._waiting is not None
        self._waiting = message
        self._news.set()

    async def next(self) -> bytes:
        """Wait for the next message to send."""
        while True:
            await self._news.wait()
            self._news.clear()
            message = self._snapshot() if self._behind else self._waiting
            self._behind, self._waiting = False, None
            if message is not None:
                return message


class Page:
    """A page. follower: what it is told. is_valid: whether its login has not ended. ask: gets what it asks for."""

    def __init__(
        self,
        socket: WebSocket,
        follower: FleetFollower,
        is_valid: Callable[[], bool],
        ask: Callable[[Request], object],
    ) -> None:
        self._socket = socket
        self._follower = follower
        self._is_valid = is_valid
        self._ask = ask
        self._warning: bytes | None = None
        self._rate = RateLimit(REQUESTS_HZ)
        self._watch: RobotWatch | None = None
        self._shown = 0
        """Number of the newest message of that robot that was sent."""
        self._looking = asyncio.Event()
        self._warned = asyncio.Event()

    def __repr__(self) -> str:
        return f"<Page {self._socket.client}>"

    def warn(self, request: Request, text: str) -> None:
        """Tell this page alone why what it asked for was not done; a newer warning replaces one that waits."""
        self._warning = msgspec.json.encode({"warning": text, "action": request.do, "robot": request.robot})
        self._warned.set()

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
        with contextlib.suppress(WebSocketDisconnect, WebSocketDisconnected):
            await race(self._send(), self._send_warnings(), self._show_robot(), self._receive())

    async def _send(self) -> None:
        while self._is_valid():
            await self._socket.send_text((await self._follower.next()).decode())
        await self._socket.close(LOGIN_ENDED, "the login has ended")

    async def _send_warnings(self) -> None:
        while True:
            await self._warned.wait()
            self._warned.clear()
            if self._warning is not None:
                await self._socket.send_text(self._warning.decode())

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
                request = _decode(await self._socket.receive_text())
            except (msgspec.MsgspecError, KeyError) as error:  # KeyError: of starlette, for a message of bytes
                await self._socket.close(_MALFORMED, f"{error}"[:100])
                return
            if not self._rate.take(asyncio.get_running_loop().time()):
                await self._socket.close(_TOO_MANY, f"more than {REQUESTS_HZ:g} requests a second")
                return
            if not self._is_valid():
                await self._socket.close(LOGIN_ENDED, "the login has ended")
                return
            if not request.robot or is_name(request.robot):
                self._ask(request)
