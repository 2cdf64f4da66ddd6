"""Serves the metrics to Prometheus, and two probes: three pages over HTTP/1.0. Knows no bus and no robot.

``/metrics``: the metrics. ``/healthz``: the process lives and its event loop turns. ``/readyz``: status 200 if the
process is of use now, else 503 with the reasons, one a line.

Theory of operation. Clients are accepted in batches with a pause between them, so that a flood takes a bounded part of
the event loop's time. A client costs one descriptor, at most :data:`SEND_BYTES` of the kernel's memory, and no task,
and has :data:`REQUEST_S` to send its request. Where more than :data:`CLIENTS` are connected, the one of the busiest
address is closed that has sent or read nothing for longest, but none that waits for its answer. So a thousand slow
clients keep no scrape waiting. What is no request is refused with its first bytes. All who ask for the metrics within a
moment get the same text.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import socket
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from http import HTTPStatus

from zbridge.app.process_usage import most_files
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.metrics.exposition import CONTENT_TYPE
from zbridge.protocol.address import Address
from zbridge.tasks import Tasks
from zbridge.transport.door import waiting_sockets

log = Log("zbridge.metrics")

REQUEST_S = 2.0
"""Longest time for a request, and for a client to read some of its answer."""
CLIENTS = 256
"""Clients at a time; fewer where the process may not have four times as many descriptors."""
BATCH, PAUSE_S = 8, 0.005
"""Clients that are accepted at once, and seconds to the next ones."""
WAITING = 1024
"""Most clients that wait in the kernel's queue."""
FRESH_S, FRESH_TIMES, FRESH_MOST_S = 0.1, 20, 1.0
"""A text of the metrics is served again for FRESH_S, or FRESH_TIMES as long as it took, FRESH_MOST_S at most."""
REQUEST_BYTES = 8192
SEND_BYTES = 64 * 1024
"""Most bytes of an answer that wait in the kernel: all that a client which reads nothing can take."""
_LINE = re.compile(rb"(?P<method>[A-Z]{1,16}) (?P<path>/[!-~]{0,1024}) HTTP/1\.[0-9]\r?\n")
_BEGINS = re.compile(rb"[A-Z]{1,16}(?: (?:/[!-~]*(?: [!-~]*\r?)?)?)?")
"""What an unfinished first line may look like."""

Missing = Callable[[], tuple[str, ...]]
"""``missing()``: why the process is of no use now; nothing if it is."""
Read = Callable[[], Awaitable[str]]
"""``await read()``: the metrics, as text."""


@contextlib.asynccontextmanager
async def serve_metrics(
    address: Address, metrics: Metrics | Read, missing: Missing = lambda: (), adopted: Sequence[socket.socket] = ()
) -> AsyncIterator[list[socket.socket]]:
    """Serve the three pages while the context lasts.

    Gives the sockets at which it listens; ``adopted``: those of another process, in place of new ones. An address in
    use is logged as an error and otherwise ignored.
    """
    try:
        sockets = list(adopted) or await waiting_sockets(address, WAITING)
    except OSError as error:
        reason = error.strerror or error
        log.error("metrics_unavailable", "metrics endpoint {address}: {reason}", address=address, reason=reason)
        yield []
        return
    endpoint = MetricsServer(_of_process(metrics) if isinstance(metrics, Metrics) else metrics, missing)
    for listening in sockets:
        listening.setblocking(False)
        endpoint.listen(listening)
    try:
        yield sockets
    finally:
        await endpoint.close()
        for listening in sockets:
            listening.close()


def _of_process(metrics: Metrics) -> Read:
    async def read() -> str:
        return metrics.exposition()

    return read


class MetricsServer:
    """Accepts clients and answers them. read: gives the metrics. missing: why the process is not ready."""

    def __init__(self, read: Read, missing: Missing) -> None:
        self._loop = asyncio.get_running_loop()
        self._read = read
        self._missing = missing
        self._clients: dict[_Client, None] = {}
        """Those that are connected, the oldest first."""
        self._pauses: dict[socket.socket, asyncio.TimerHandle | None] = {}
        """The sockets at which this endpoint listens, with the timer of a pause."""
        self._sweep: asyncio.TimerHandle | None = None
        self._text: asyncio.Task[bytes] | None = None
        self._fresh_until = -math.inf
        self._tasks = Tasks()
        self._most = min(CLIENTS, most_files() // 4 or CLIENTS)

    def __repr__(self) -> str:
        return f"<MetricsServer of {len(self._clients)} clients>"

    def listen(self, listening: socket.socket) -> None:
        """Accept clients at a socket that does not block; they inherit its bounds."""
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * REQUEST_S))
        self._resume(listening)

    async def close(self) -> None:
        """Accept nobody, and close all clients."""
        for listening, pause in self._pauses.items():
            self._loop.remove_reader(listening)
            if pause is not None:
                pause.cancel()
        for client in tuple(self._clients):
            client.close()
        if self._sweep is not None:
            self._sweep.cancel()
        if self._text is not None:
            self._text.cancel()
        await self._tasks.end()

    def _resume(self, listening: socket.socket) -> None:
        self._pauses[listening] = None
        self._loop.add_reader(listening, self._accept, listening)

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(BATCH):
            if len(self._clients) >= self._most and not self._make_room():
                break
            try:
                connection, (host, *_) = listening.accept()
            except BlockingIOError:
                return
            except OSError as error:  # no descriptor left: an immediate retry would use up the processor
                log.debug("metrics_accept_failed", "metrics endpoint: {error}", error=error)
                self._make_room()
                break
            self._admit(connection, host)
        self._loop.remove_reader(listening)
        self._pauses[listening] = self._loop.call_later(PAUSE_S, self._resume, listening)

    def _make_room(self) -> bool:
        """Close the client that has done nothing for longest; False if all wait for an answer, which comes soon."""
        idle = [client for client in self._clients if not client.waits]
        if idle:
            busiest, _ = Counter(client.host for client in idle).most_common(1)[0]
            next(client for client in idle if client.host == busiest).close()
        return bool(idle)

    def _admit(self, connection: socket.socket, host: str) -> None:
        connection.setblocking(False)
        client = _Client(self._loop, connection, host, self)
        self._clients[client] = None
        client.begin()
        if self._sweep is None:
            self._sweep = self._loop.call_later(REQUEST_S, self._close_late)

    def forget(self, client: _Client) -> None:
        """Note that a client's connection is closed."""
        del self._clients[client]

    def prolong(self, client: _Client) -> None:
        """Give a client its time anew: it reads its answer."""
        del self._clients[client]
        client.since = self._loop.time()
        self._clients[client] = None

    def _close_late(self) -> None:
        """Close the clients whose time is over, and set the timer for the oldest of the others."""
        self._sweep, now = None, self._loop.time()
        while self._clients:
            oldest = next(iter(self._clients))
            if now < oldest.since + REQUEST_S:
                self._sweep = self._loop.call_at(oldest.since + REQUEST_S, self._close_late)
                return
            oldest.close()

    def answer(self, client: _Client, path: str) -> None:
        """Answer a request for a page, at once where that is possible."""
        match path:
            case "/metrics" | "/":
                self._tasks.start(self._show_metrics(client))
            case "/healthz":
                client.send(HTTPStatus.OK, b"ok\n")
            case "/readyz":
                reasons = self._missing()
                body = "".join(f"{reason}\n" for reason in reasons) or "ok\n"
                client.send(HTTPStatus.SERVICE_UNAVAILABLE if reasons else HTTPStatus.OK, body.encode())
            case _:
                client.send(HTTPStatus.NOT_FOUND, b"see /metrics, /healthz, /readyz\n")

    async def _show_metrics(self, client: _Client) -> None:
        if self._text is None or (self._text.done() and self._loop.time() >= self._fresh_until):
            self._text = self._loop.create_task(self._write())
        try:
            body = await asyncio.shield(self._text)
        except Exception:
            log.exception("metrics_unreadable", "the metrics cannot be read")
            client.send(HTTPStatus.INTERNAL_SERVER_ERROR, b"the metrics cannot be read: see the log\n")
        else:
            client.send(HTTPStatus.OK, body)

    async def _write(self) -> bytes:
        begun = self._loop.time()
        text = (await self._read()).encode()
        now = self._loop.time()
        self._fresh_until = now + min(FRESH_MOST_S, max(FRESH_S, FRESH_TIMES * (now - begun)))
        return text


class _Client:
    """One connection: reads a request, writes an answer, and closes. host: its address."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, connection: socket.socket, host: str, endpoint: MetricsServer
    ) -> None:
        self.host = host
        self.since = loop.time()
        self.waits = False
        """Whether it has asked, and its answer is being made."""
        self._loop = loop
        self._connection = connection
        self._endpoint = endpoint
        self._request = b""
        self._left: list[memoryview] = []
        """What is still to be sent; all clients share the text of the metrics."""
        self._bodiless = False

    def begin(self) -> None:
        """Read what is there, and what comes."""
        self._loop.add_reader(self._connection, self._receive)
        self._receive()

    def close(self) -> None:
        """Close the connection; idempotent."""
        if self._connection.fileno() >= 0:
            self._loop.remove_reader(self._connection)
            self._loop.remove_writer(self._connection)
            self._connection.close()
            self._endpoint.forget(self)

    def send(self, status: HTTPStatus, body: bytes) -> None:
        """Send an answer, and close the connection then; nothing happens once it is closed."""
        if self._connection.fileno() < 0:
            return
        self._loop.remove_reader(self._connection)
        self.waits = False
        self._left = [memoryview(head_of(status, body)), memoryview(b"" if self._bodiless else body)]
        self._loop.add_writer(self._connection, self._write)
        self._write()

    def _receive(self) -> None:
        try:
            data = self._connection.recv(REQUEST_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        self._request += data
        found = parse(self._request)
        if isinstance(found, HTTPStatus):
            self.send(found, f"{found.phrase}\n".encode())
        elif found is not None:
            self._loop.remove_reader(self._connection)
            method, path = found
            self._bodiless, self.waits = method == "HEAD", True
            self._endpoint.answer(self, path)

    def _write(self) -> None:
        try:
            while self._left:
                sent = self._connection.send(self._left[0])
                self._left[0] = self._left[0][sent:]
                if not self._left[0]:
                    self._left.pop(0)
                self._endpoint.prolong(self)
            self._connection.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            return
        except OSError:
            pass
        self.close()


def parse(request: bytes) -> tuple[str, str] | HTTPStatus | None:
    """Return method and path of a request, the status that refuses it, or None if its end is still missing."""
    line = _LINE.match(request)
    if line is None:
        unfinished = b"\n" not in request and _BEGINS.fullmatch(request)
        return None if unfinished and len(request) <= REQUEST_BYTES else HTTPStatus.BAD_REQUEST
    method = line["method"].decode()
    if method not in ("GET", "HEAD"):
        return HTTPStatus.METHOD_NOT_ALLOWED
    if b"\r\n\r\n" in request or b"\n\n" in request:
        return method, line["path"].decode().partition("?")[0]
    return None if len(request) <= REQUEST_BYTES else HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE


def head_of(status: HTTPStatus, body: bytes) -> bytes:
    """Write the head of an answer."""
    return (
        f"HTTP/1.0 {status.value} {status.phrase}\r\nContent-Type: {CONTENT_TYPE}\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    ).encode()
