"""Shows the counters to Prometheus: one page over HTTP/1.0, nothing else."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator

from zbridge.link import Address
from zbridge.metrics import Metrics

log = logging.getLogger("zbridge.metrics")

REQUEST_S = 2.0
"""Seconds a client has to send its request."""
_REQUEST_BYTES = 8192


@contextlib.asynccontextmanager
async def serve_metrics(address: Address, metrics: Metrics) -> AsyncIterator[None]:
    """Serve ``GET /metrics`` while the context lasts; without the address the gateway runs all the same."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            async with asyncio.timeout(REQUEST_S):
                request = await reader.readuntil(b"\r\n\r\n")
                writer.write(_response(request, metrics))
                await writer.drain()
        writer.close()

    try:
        server = await asyncio.start_server(answer, address.host, address.port, limit=_REQUEST_BYTES)
    except OSError as error:
        log.error("metrics endpoint %s: %s", address, error.strerror or error)
        yield
        return
    async with server:
        yield


def _response(request: bytes, metrics: Metrics) -> bytes:
    if request.startswith((b"GET /metrics ", b"GET / ")):
        body, status = metrics.exposition().encode(), "200 OK"
    else:
        body, status = b"see /metrics\n", "404 Not Found"
    head = f"HTTP/1.0 {status}\r\nContent-Type: text/plain; version=0.0.4\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body
