"""Serves the counters to Prometheus, and two probes: three pages over HTTP/1.0. Knows no bus and no robot.

``/metrics``: the counters. ``/healthz``: the process lives and its event loop turns. ``/readyz``: status 200 if the
gateway is of use now, else 503 with the reasons, one a line.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Callable, Sequence

from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.transport.waiting import waiting_sockets

log = logging.getLogger("zbridge.metrics")

REQUEST_S = 2.0
"""Longest time a client may take to send its request and read the answer."""
CLIENTS = 4
"""Clients served at a time."""
_REQUEST_BYTES = 8192

Missing = Callable[[], tuple[str, ...]]
"""``missing()``: why the gateway is of no use now; nothing if it is."""


@contextlib.asynccontextmanager
async def serve_metrics(
    address: Address, metrics: Metrics, missing: Missing = lambda: (), given: Sequence[socket.socket] = ()
) -> AsyncIterator[list[socket.socket]]:
    """Serve ``GET /metrics``, ``/healthz`` and ``/readyz`` while the context lasts.

    Gives the sockets at which it listens; ``given``: those of another process, in place of new ones. An address in use
    is logged as an error and otherwise ignored.

    Connections are accepted only while fewer than CLIENTS are served: a server of asyncio accepts all at once and
    starves the rest of the process meanwhile.
    """
    try:
        sockets = list(given) or await waiting_sockets(address)
    except OSError as error:
        log.error("metrics endpoint %s: %s", address, error.strerror or error)
        yield []
        return
    room = asyncio.Semaphore(CLIENTS)
    tasks = [asyncio.create_task(_accept(each, room, metrics, missing)) for each in sockets]
    try:
        yield sockets
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for listening in sockets:
            listening.close()


async def _accept(listening: socket.socket, room: asyncio.Semaphore, metrics: Metrics, missing: Missing) -> None:
    """Accept and serve clients, while there is room, until cancelled."""
    loop, clients = asyncio.get_running_loop(), dict[asyncio.Task[None], socket.socket]()

    def gone(task: asyncio.Task[None]) -> None:
        clients.pop(task).close()
        room.release()

    try:
        while True:
            await room.acquire()
            try:
                client, _ = await loop.sock_accept(listening)
            except OSError as error:  # no descriptor left: an immediate retry would use up the processor
                log.debug("metrics endpoint: %s", error)
                room.release()
                await asyncio.sleep(REQUEST_S)
                continue
            task = asyncio.create_task(_serve(client, metrics, missing))
            clients[task] = client
            task.add_done_callback(gone)
    finally:
        for task in tuple(clients):
            task.cancel()
        await asyncio.gather(*clients, return_exceptions=True)


async def _serve(client: socket.socket, metrics: Metrics, missing: Missing) -> None:
    """Read one request and answer it."""
    loop, request = asyncio.get_running_loop(), b""
    with contextlib.suppress(OSError, TimeoutError):
        async with asyncio.timeout(REQUEST_S):
            while b"\r\n\r\n" not in request:
                data = await loop.sock_recv(client, _REQUEST_BYTES)
                request += data
                if not data or len(request) > _REQUEST_BYTES:
                    return
            await loop.sock_sendall(client, _response(request, metrics, missing))


def _response(request: bytes, metrics: Metrics, missing: Missing) -> bytes:
    status = "200 OK"
    if request.startswith((b"GET /metrics ", b"GET / ")):
        body = metrics.exposition().encode()
    elif request.startswith(b"GET /healthz "):
        body = b"ok\n"
    elif request.startswith(b"GET /readyz "):
        reasons = missing()
        status = "503 Service Unavailable" if reasons else status
        body = ("".join(f"{reason}\n" for reason in reasons) or "ok\n").encode()
    else:
        body, status = b"see /metrics, /healthz, /readyz\n", "404 Not Found"
    head = f"HTTP/1.0 {status}\r\nContent-Type: text/plain; version=0.0.4\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body
