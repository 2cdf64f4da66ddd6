"""A bare relay: what comes on the bus goes to every WebSocket as it is. ``foxglove_relay ENDPOINT PORT``."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys

import uvloop
import zenoh
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed


async def main(endpoint: str, port: int) -> None:
    """Relay the poses until killed."""
    loop, queues = asyncio.get_running_loop(), set[asyncio.Queue[bytes]]()

    def give(data: bytes) -> None:
        for queue in queues:
            queue.put_nowait(data)

    def take(sample: zenoh.Sample) -> None:
        loop.call_soon_threadsafe(give, sample.payload.to_bytes())

    async def view(socket: ServerConnection) -> None:
        queue: asyncio.Queue[bytes] = asyncio.Queue()
        queues.add(queue)
        try:
            with contextlib.suppress(ConnectionClosed):
                while True:
                    await socket.send(await queue.get())
        finally:
            queues.discard(queue)

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber("fleet/r1/pose", take)
        async with serve(view, "127.0.0.1", port, compression=None):
            print("relaying", flush=True)
            await asyncio.Event().wait()
        subscriber.undeclare()


if __name__ == "__main__":
    uvloop.run(main(sys.argv[1], int(sys.argv[2])))
