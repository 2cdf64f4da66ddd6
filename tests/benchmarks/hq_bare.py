"""The bare loop: one subscriber, a translation by hand, and the bytes written to every socket; nothing else.

``python -m tests.benchmarks.hq_bare KIND ENDPOINT PORT``. On uvloop, as the listener is. It has no queues, no limits,
no versions and no commands.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from typing import Any

import uvloop
import zenoh

from tests.benchmarks import hq_wire
from tests.benchmarks.hq_wire import Kind
from tests.benchmarks.peer import open_session

HOST = "127.0.0.1"
Write = Callable[[bytes], None]


class Server:
    """Everybody who is to be written to."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.writes: list[Write] = []
        self.accepted = 1

    def show(self, translate: Callable[[bytes], bytes], published: bytes) -> None:
        """Write one message to all."""
        frame = translate(published)
        for write in self.writes:
            write(frame)


class Stream(asyncio.Protocol):
    """One client."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        self._server.accepted += 1
        if self._server.kind == "alf":
            self._server.writes.append(self._transport.write)
        else:
            self._transport.write(hq_wire.settings(self._server.accepted))

    def data_received(self, data: bytes) -> None:
        if self._server.kind != "alf" and data[5] == hq_wire.ANSWER:
            if self._server.kind == "udp":
                self._transport.write(hq_wire.START)
            else:
                self._server.writes.append(self._transport.write)


class Datagrams(asyncio.DatagramProtocol):
    """All clients of ``udp``."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        sendto = self._transport.sendto
        if data[5] == hq_wire.HELLO:
            sendto(hq_wire.HEARD_YOU, addr)
            self._server.writes.append(lambda frame: sendto(frame, addr))


async def serve(kind: Kind, endpoint: str, port: int) -> None:
    """Serve until the process is ended."""
    loop, server = asyncio.get_running_loop(), Server(kind)
    await loop.create_server(lambda: Stream(server), HOST, port)
    if kind == "udp":
        await loop.create_datagram_endpoint(lambda: Datagrams(server), (HOST, port))
    with open_session(listen=endpoint, shared_memory=False) as session:

        def follow(key: str, translate: Callable[[bytes], bytes]) -> None:
            def take(sample: zenoh.Sample) -> None:
                loop.call_soon_threadsafe(server.show, translate, sample.payload.to_bytes())

            session.declare_subscriber(key, take)

        follow(hq_wire.small_key(kind), hq_wire.info_of if kind == "alf" else hq_wire.position_of)
        if kind == "alf":
            follow(hq_wire.SCAN_KEY, hq_wire.measurement_of)
        await asyncio.Event().wait()


def main() -> None:
    """Serve."""
    kind: Kind = next(kind for kind in hq_wire.KINDS if kind == sys.argv[1])
    uvloop.run(serve(kind, sys.argv[2], int(sys.argv[3])))


if __name__ == "__main__":
    main()
