"""Serves the counters to Prometheus, and two probes: three pages over HTTP/1.0. Knows no bus and no robot.

``/metrics``: the counters. ``/healthz``: the process lives and its event loop turns. ``/readyz``: status 200 if the
gateway is of use now, else 503 with the reasons, one a line.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import socket
from collections.abc import AsyncIterator, Callable, Sequence

from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.tasks import Tasks
from zbridge.transport.door import waiting_sockets

log = logging.getLogger("zbridge.metrics")

REQUEST_S = 2.0
"""Longest time a client may take to send its request and read the answer."""
CLIENTS = 32
"""Clients at a time; one more, and the oldest is closed: silent clients must not keep a scrape waiting."""
PAUSE_S = 0.005
"""Seconds from one accepted client to the next: a flood must not take the event loop's time."""
_REQUEST_BYTES = 8192

Missing = Callable[[], tuple[str, ...]]
"""``missing()``: why the gateway is of no use now; nothing if it is."""


Clients = dict[asyncio.Task[None], socket.socket]


@contextlib.asynccontextmanager
async def serve_metrics(
    address: Address, metrics: Metrics, missing: Missing = lambda: (), adopted: Sequence[socket.socket] = ()
) -> AsyncIterator[list[socket.socket]]:
    """Serve ``GET /metrics``, ``/healthz`` and ``/readyz`` while the context lasts.

    Gives the sockets at which it listens; ``adopted``: those of another process, in place of new ones. An address in
    use is logged as an error and otherwise ignored.

    Connections are accepted one by one, PAUSE_S apart: a server of asyncio accepts all at once and starves the rest of
    the process meanwhile. Of more than CLIENTS the oldest is closed, so that whoever sends a request is answered.
    """
    try:
        sockets = list(adopted) or await waiting_sockets(address)
    except OSError as error:
        log.error("metrics endpoint %s: %s", address, error.strerror or error)
        yield []
        return
    clients: Clients = {}
    accepting = Tasks()
    for each in sockets:
        accepting.start(_accept(each, clients, metrics, missing))
    try:
        yield sockets
    finally:
        await accepting.end()
        for listening in sockets:
            listening.close()


async def _accept(listening: socket.socket, clients: Clients, metrics: Metrics, missing: Missing) -> None:
    """Accept and serve clients until cancelled. clients: of all sockets, the oldest first."""
    loop = asyncio.get_running_loop()
    try:
        while True:
            try:
                client, _ = await loop.sock_accept(listening)
            except OSError as error:  # no descriptor left: an immediate retry would use up the processor
                log.debug("metrics endpoint: %s", error)
                await asyncio.sleep(REQUEST_S)
                continue
            if len(clients) >= CLIENTS:
                oldest = next(iter(clients))
                del clients[oldest]
                oldest.cancel()
            task = asyncio.create_task(_serve(client, metrics, missing))
            clients[task] = client
            task.add_done_callback(functools.partial(_close, clients, client))
            await asyncio.sleep(PAUSE_S)
    finally:
        for task in clients:
            task.cancel()
        await asyncio.gather(*clients, return_exceptions=True)


def _close(clients: Clients, client: socket.socket, task: asyncio.Task[None]) -> None:
    """Close a client whose task is over: before that, the event loop still watches the descriptor."""
    clients.pop(task, None)
    client.close()


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
            await loop.sock_sendall(client, respond(request, metrics, missing))


def respond(request: bytes, metrics: Metrics, missing: Missing) -> bytes:
    """Answer an HTTP request. missing: gives the reasons for which the process is not ready."""
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
