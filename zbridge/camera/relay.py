"""Serves ``/stream.mjpg`` to HQ programs from the one fetched stream, as if it were the camera.

Legacy programs read multipart naively. So they get what the camera itself wrote: its HTTP head, and the delimiter and
header of each picture, byte for byte and in order. Each client has a task of its own that sends the newest picture,
waits until the socket has accepted it, and then continues with the newest: a slow client gets fewer pictures and delays
nobody. Clients are accepted one by one, bounded in number; refused ones are closed at most 100 a second.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable

import msgspec

from zbridge.camera.demand import Demand
from zbridge.camera.mjpeg import MjpegPart, MjpegReader
from zbridge.camera.settings import CameraPlan
from zbridge.camera.upstream import explain
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.networks import is_among
from zbridge.protocol.session_table import Backoff
from zbridge.tasks import Tasks, race
from zbridge.transport.door import waiting_sockets


class Shot(msgspec.Struct, frozen=True):
    """One picture, and the stream it belongs to. number: rises by one."""

    number: int
    stream: MjpegReader
    part: MjpegPart


class Latest:
    """Keeps the newest picture only; a client waits for one that is newer than the last it got."""

    def __init__(self) -> None:
        self._number = 0
        self._shot: Shot | None = None
        self._came = asyncio.Event()

    def show(self, stream: MjpegReader, part: MjpegPart) -> None:
        self._number += 1
        self._shot = Shot(self._number, stream, part)
        self._came.set()
        self._came = asyncio.Event()

    def forget(self) -> None:
        """Drop the picture: the stream has ended."""
        self._shot = None

    async def after(self, number: int) -> Shot:
        """Return the newest picture as soon as its number is greater than ``number``."""
        while self._shot is None or self._shot.number <= number:
            await self._came.wait()
        return self._shot


log = Log("zbridge.camera")

PATH = b"/stream.mjpg"
REQUEST_S = 5.0
"""Longest time for a client's request, seconds."""
AWAY_S = 10.0
"""A client is closed when the camera has sent no picture for this long, as if the camera were gone; seconds."""
SEND_S = 10.0
"""Longest time in which a client must accept one picture, seconds."""
UNSENT_BYTES = 128 * 1024
"""The kernel's buffer for a client (it doubles the number): pictures in it are no longer the newest."""
_REFUSAL_S = 0.01
_REQUEST_BYTES = 8192
_NOT_FOUND = b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n"
_FORBIDDEN = b"HTTP/1.0 403 Forbidden\r\nContent-Length: 0\r\n\r\n"


class Relay:
    """Listens at ``address`` until cancelled. report: called with the reason if it cannot listen; None: it listens."""

    def __init__(
        self,
        plan: CameraPlan,
        address: Address,
        demand: Demand,
        latest: Latest,
        metrics: Metrics,
        report: Callable[[str | None], object],
    ) -> None:
        self._address = address
        self._allow = plan.allow
        self._most = plan.settings.clients
        self._demand = demand
        self._latest = latest
        self._report = report
        self._clients = Tasks()
        self._accepted = metrics.count("camera_relay_accepted")
        self._refused = metrics.count("camera_relay_refused")
        self._sent = metrics.count("camera_relay_pictures")
        self._skipped = metrics.count("camera_relay_skipped")

    def __repr__(self) -> str:
        return f"<Relay {self._address}, {len(self._clients)} clients>"

    async def run(self) -> None:
        """Accept clients until cancelled; retry if the address is not available."""
        backoff = Backoff()
        while True:
            try:
                sockets = await waiting_sockets(self._address)
            except OSError as error:
                self._report(f"camera relay {self._address.host}:{self._address.port}: {explain(error)}")
                await asyncio.sleep(backoff.delay_s())
                continue
            self._report(None)
            template = "camera: HQ programs find {path} at {address}"
            log.info("camera_relayed", template, path=PATH.decode(), address=self._address)
            try:
                async with asyncio.TaskGroup() as tasks:
                    for listening in sockets:
                        tasks.create_task(self._accept(listening))
            finally:
                for listening in sockets:
                    listening.close()
                await self._clients.end()

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                client, peer = await loop.sock_accept(listening)
            except OSError as error:  # no descriptor left: an immediate retry would use up the processor
                log.debug("camera_accept_failed", "camera relay: {error}", error=error)
                await asyncio.sleep(1.0)
                continue
            if len(self._clients) >= self._most or (self._allow and not is_among(peer[0], self._allow)):
                self._refused.value += 1
                client.close()
                await asyncio.sleep(_REFUSAL_S)
                continue
            self._accepted.value += 1
            self._clients.start(self._serve(client))

    async def _serve(self, client: socket.socket) -> None:
        """Answer one client, and send it pictures until it leaves or stalls."""
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            try:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, UNSENT_BYTES)
                reader, writer = await asyncio.open_connection(sock=client, limit=_REQUEST_BYTES)
            except BaseException:
                client.close()
                raise
            try:
                async with asyncio.timeout(REQUEST_S):
                    refusal = _refusal(await reader.readuntil(b"\r\n\r\n"))
                    if refusal is not None:
                        writer.write(refusal)
                        await writer.drain()
                        writer.close()
                        await writer.wait_closed()
                        return
                await self._give(reader, writer)
            finally:
                writer.transport.abort()

    async def _give(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send pictures until the client ends the connection, or sends more than a request."""
        writer.transport.set_write_buffer_limits(0)  # drain() returns when the socket has accepted all
        self._demand.join()
        try:
            await race(self._send(writer), reader.read(1))
        finally:
            self._demand.leave()

    async def _send(self, writer: asyncio.StreamWriter) -> None:
        number, boundary = 0, None
        while True:
            async with asyncio.timeout(AWAY_S):
                shot = await self._latest.after(number)
            if boundary is None:
                boundary = shot.stream.boundary
                writer.write(shot.stream.head)
            elif boundary != shot.stream.boundary:
                return  # another camera answers now: the client cannot read its parts
            elif shot.number > number + 1:
                self._skipped.value += shot.number - number - 1
            for data in (shot.part.head, shot.part.jpeg, b"\r\n"):
                writer.write(data)
            async with asyncio.timeout(SEND_S):
                await writer.drain()
            number = shot.number
            self._sent.value += 1


def _refusal(request: bytes) -> bytes | None:
    """Return the answer to a request that gets no stream; None if it gets one.

    A cross-origin web page sends ``Origin``; HQ programs do not.
    """
    line, _, fields = request.partition(b"\r\n")
    method, _, target = line.partition(b" ")
    path = target.partition(b" ")[0].partition(b"?")[0]
    if method != b"GET" or path != PATH:
        return _NOT_FOUND
    return _FORBIDDEN if b"\r\norigin:" in b"\r\n" + fields.lower() else None
