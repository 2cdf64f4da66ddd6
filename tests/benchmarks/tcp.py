"""Bare TCP: a receiver on the same event loop as the gateway's that only notes when a packet came.

``python -m tests.benchmarks.tcp PORT``
"""

from __future__ import annotations

import asyncio
import sys
import threading
from typing import Any

import uvloop

from tests.benchmarks import wire
from tests.benchmarks.peer import Sink


class Receiver(asyncio.Protocol):
    """Answers the settings, then stores every read; a read of paced packets is one packet, or a few."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._transport: Any = None
        self._greeted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        if not self._greeted:
            self._greeted = True
            self._transport.write(wire.client_settings())
            return
        for start in range(0, len(data), wire.POSITION.size):
            self._sink.take(data[start : start + wire.POSITION.size])


def main() -> None:
    """Receive on this thread, talk to the harness on another."""
    sink = Sink(keep=True, read_sequences=_read_sequences)
    threading.Thread(target=lambda: uvloop.run(_receive(sink, int(sys.argv[1]))), daemon=True).start()
    sink.obey()


async def _receive(sink: Sink, port: int) -> None:
    await asyncio.get_running_loop().create_connection(lambda: Receiver(sink), "127.0.0.1", port)
    await asyncio.Event().wait()


def _read_sequences(packets: list[Any]) -> list[int]:
    return [int(wire.POSITION.unpack(packet)[3]) for packet in packets]


if __name__ == "__main__":
    main()
