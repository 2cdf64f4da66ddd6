"""The script a user writes in an afternoon to drive a robot from the bus: asyncio streams, struct, json.

``python -m tests.benchmarks.steering PORT ENDPOINT``. Written as one would: the standard event loop, whatever
arrives is decoded where it arrives and written by the loop. It asks nobody for a lease, and stops nothing.
"""

import asyncio
import json
import math
import struct
import sys

import zenoh

from tests.benchmarks.peer import open_session


async def bridge(session: zenoh.Session, port: int) -> None:
    loop = asyncio.get_running_loop()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    client_id = 0

    def take(sample: zenoh.Sample) -> None:
        drive = json.loads(sample.payload.to_bytes())
        forward, left = drive["forward"], drive["left"]
        speed = math.hypot(forward, left)
        if speed:
            packet = struct.pack("<iBBfff", 14, client_id, 11, -left / speed, forward / speed, min(1.0, speed))
        else:
            packet = struct.pack("<iBB", 2, client_id, 13)
        loop.call_soon_threadsafe(writer.write, packet)

    while True:
        header = await reader.readexactly(6)
        length, _sender, packet_id = struct.unpack("<iBB", header)
        body = await reader.readexactly(length - 2)
        if packet_id == 2:
            client_id, versions = body[0], b"1.1,1.2,1.3"
            settings = struct.pack("<i", len(versions)) + versions + bytes(7)
            writer.write(struct.pack("<iBB", 2 + len(settings), client_id, 3) + settings)
            await writer.drain()
            session.declare_subscriber("fleet/bench/@cmd/drive", take)


def main() -> None:
    with open_session(listen=sys.argv[2]) as session:
        try:
            asyncio.run(bridge(session, int(sys.argv[1])))
        except (asyncio.IncompleteReadError, ConnectionError):
            print("robot gone", file=sys.stderr)


if __name__ == "__main__":
    main()
