"""Takes scans from a WebSocket, and prints the p50 of their age, us: ``foxglove_taker zbridge|relay PORT SECONDS``."""

from __future__ import annotations

import json
import statistics
import sys
import time

import msgpack
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.views.protobuf import read
from zbridge.views.pictures import foxglove_schema

_HEAD = 13


def main(name: str, port: int, seconds: float) -> None:
    """Take for so many seconds; the stamps are read afterwards."""
    url, taken = f"ws://127.0.0.1:{port}", list[tuple[int, bytes]]()
    protocols = [Subprotocol("foxglove.sdk.v1")] if name == "zbridge" else None
    with connect(url, subprotocols=protocols, compression=None, max_size=None) as socket:
        while name == "zbridge":
            message = socket.recv()
            entries = json.loads(message).get("channels", []) if isinstance(message, str) else []
            scans = [entry["id"] for entry in entries if entry["topic"] == "/r0/scan"]
            if scans:
                wish = [{"id": 1, "channelId": scans[0]}]
                socket.send(json.dumps({"op": "subscribe", "subscriptions": wish}))
                break
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = socket.recv()
            if isinstance(message, bytes):
                taken.append((time.time_ns(), message))
    print(statistics.median(at_ns - stamp_ns(name, data) for at_ns, data in taken[10:]) / 1000, flush=True)


def stamp_ns(name: str, data: bytes) -> int:
    """Give the time at which a scan was put on the bus."""
    if name == "relay":
        return int(msgpack.unpackb(data)["stamp_ns"])
    text = read(foxglove_schema("LaserScan"), data[_HEAD:])["timestamp"]
    whole, _, fraction = text.rstrip("Z").partition(".")
    seconds = int(time.mktime(time.strptime(whole, "%Y-%m-%dT%H:%M:%S"))) - time.timezone
    return seconds * 10**9 + int(fraction.ljust(9, "0") or 0)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
