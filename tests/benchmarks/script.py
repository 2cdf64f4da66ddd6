"""The script a user writes in an afternoon instead of a gateway: asyncio streams, struct, json, ``session.put``.

``python -m tests.benchmarks.script PORT ENDPOINT``. Written as one would: the standard event loop, two reads a
packet, the key as a string, the same values in the same units. Only the congestion control is not the default:
BLOCK, because with DROP a saturated run would lose packets and so leave out work that the gateway does.
"""

import asyncio
import json
import math
import struct
import sys
import time

import zenoh

from tests.benchmarks.peer import open_session


async def bridge(session: zenoh.Session, port: int) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    while True:
        header = await reader.readexactly(6)
        length, _sender, packet_id = struct.unpack("<iBB", header)
        body = await reader.readexactly(length - 2)
        if packet_id == 2:
            client_id, versions = body[0], b"1.1,1.2,1.3"
            settings = struct.pack("<i", len(versions)) + versions + bytes(7)
            writer.write(struct.pack("<iBB", 2 + len(settings), client_id, 3) + settings)
            await writer.drain()
        elif packet_id == 55:
            x, y, heading_deg = struct.unpack("<fff", body)
            pose = {
                "x": x * 0.01,
                "y": y * 0.01,
                "heading": math.radians(heading_deg) + math.pi / 2,
                "stamp_ns": time.time_ns(),
            }
            session.put("fleet/bench/pose", json.dumps(pose), congestion_control=zenoh.CongestionControl.BLOCK)


def main() -> None:
    with open_session(listen=sys.argv[2]) as session:
        try:
            asyncio.run(bridge(session, int(sys.argv[1])))
        except (asyncio.IncompleteReadError, ConnectionError):
            print("robot gone", file=sys.stderr)


if __name__ == "__main__":
    main()
