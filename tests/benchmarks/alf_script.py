"""The script a user writes in an afternoon to have a vehicle's scans: asyncio streams, int, json, ``session.put``.

``python -m tests.benchmarks.alf_script PORT ENDPOINT``. Written as one would: the standard event loop, one message up
to each ``;``, every point by ``int``. It judges no point, drives nobody, and leaves stamps as they are. Only the
congestion control is not the default: BLOCK, because with DROP a saturated run would lose scans and so leave out work
that the gateway does.
"""

import asyncio
import json
import math
import sys
import time

import zenoh

from tests.benchmarks.peer import open_session


async def bridge(session: zenoh.Session, port: int) -> None:
    reader, _writer = await asyncio.open_connection("127.0.0.1", port)
    scanner: list[float] = []
    while True:
        message = (await reader.readuntil(b";")).decode()[:-1]
        kind, _, body = message.partition("|")
        if kind == "2":
            scanner = [float(x) for x in body.split("|")]
        elif kind == "1":
            sequence, device_ms, *points = [int(x) for x in body.split("|")]
            first, last = points[-2:]
            scan = {
                "angle_min": math.radians(scanner[0]),
                "angle_increment": math.radians(scanner[2]),
                "range_min": scanner[4] / 1000,
                "range_max": scanner[5] / 1000,
                "ranges": [mm / 1000 for mm in points[:-2]],
                "first": first,
                "last": last,
                "stamp_ns": time.time_ns(),
                "seq": sequence,
                "device_ms": device_ms,
            }
            session.put("fleet/bench/scan", json.dumps(scan), congestion_control=zenoh.CongestionControl.BLOCK)


def main() -> None:
    with open_session(listen=sys.argv[2]) as session:
        try:
            asyncio.run(bridge(session, int(sys.argv[1])))
        except (asyncio.IncompleteReadError, ConnectionError):
            print("vehicle gone", file=sys.stderr)


if __name__ == "__main__":
    main()
