"""The bytes of the benchmark of listeners: what its robot publishes, and what HQ programs read and write.

Written by the protocol pages, without the gateway's own codec: a fault there must not measure itself. Every message
has a running number, 0 for a probe: of a position it is ``x``, of motion the temperature, of a scan its own.
"""

from __future__ import annotations

import struct
import time
from typing import Any, Literal

import msgpack
import numpy as np

from tests.benchmarks import alf_wire, wire
from tests.benchmarks.peer import ROBOT

Kind = Literal["tcp", "udp", "alf"]
KINDS: tuple[Kind, ...] = ("tcp", "udp", "alf")

SMALL_HZ, SCANS_HZ = 50, 10
POSE_KEY = f"fleet/{ROBOT}/pose"
MOTION_KEY = f"fleet/{ROBOT}/motion"
SCAN_KEY = alf_wire.SCAN_KEY
STATUS_KEY = f"fleet/{ROBOT}/status"
ALIVE_KEY = f"fleet/{ROBOT}/@alive/gateway"

SETTINGS, ANSWER, START_UDP, HELLO, HEARD, REPORT, POSITION = 2, 3, 4, 5, 6, 7, 55
"""Packet ids."""
_SERVER = 1
_VERSIONS = struct.pack("<i", 11) + b"1.1,1.2,1.3"


def small_key(kind: Kind) -> str:
    """Give the key of what clients of this kind get at 50 Hz."""
    return MOTION_KEY if kind == "alf" else POSE_KEY


def small(kind: Kind, number: int) -> bytes:
    """Write what is published at 50 Hz."""
    now_ns = time.time_ns()
    if kind != "alf":
        return wire.payload("pose", number, now_ns)
    moving = {"speed": 0.5, "acceleration": [1.25, -2.5, 9.75], "gyro": [0.01, -0.02, 0.25]}
    return _pack({**moving, "temperature": float(number), "stamp_ns": now_ns})


def scan(number: int) -> bytes:
    """Write what is published at 10 Hz."""
    return alf_wire.payload(number, number * 20, time.time_ns())


def status(kind: Kind) -> bytes:
    """Write the state of a robot that can be used, of the clients' own protocol."""
    known = {"protocol": "alf", "dialect": "text"} if kind == "alf" else {"protocol": "tcpudp", "version": "1.3"}
    return _pack({"state": "established", "features": ["joystick", "slam_map"], "stamp_ns": time.time_ns(), **known})


# What the bare loop makes of it


def position_of(published: bytes) -> bytes:
    """Write packet 55."""
    return wire.position(wire.sequence_of(published))


def info_of(published: bytes) -> bytes:
    """Write message 4 in text."""
    values = msgpack.unpackb(published)
    rest = (*values["acceleration"], *values["gyro"], values["temperature"])
    return b"4|%d|%f|%f|%f|%f|%f|%f|%f;" % (round(values["speed"] * 100), *rest)


def measurement_of(published: bytes) -> bytes:
    """Write message 1 in text."""
    values = msgpack.unpackb(published)
    ranges = np.nan_to_num(np.frombuffer(values["ranges"], "<f4"))
    points = "|".join(map(str, np.rint(ranges * 1000).astype(int).tolist()))
    return b"1|%d|%d|%b|%d|%d;" % (values["seq"], values["device_ms"], points.encode(), alf_wire.FIRST, alf_wire.LAST)


# Packets of the handshake


def packet(sender: int, packet_id: int, body: bytes = b"") -> bytes:
    """Write a TCP/UDP packet."""
    return wire.HEADER.pack(2 + len(body), sender, packet_id) + body


def settings(client: int) -> bytes:
    """Write packet 2 of a robot of version 1.3 with UDP."""
    flags = bytes((1, 0, 1, 0, 0, 0, 1))
    return packet(_SERVER, SETTINGS, bytes((client,)) + _VERSIONS + flags + struct.pack("<ii", 1000, 10))


def answer(client: int, *, udp: bool) -> bytes:
    """Write packet 3 of an HQ of version 1.3."""
    return packet(client, ANSWER, _VERSIONS + bytes((udp, 0, 1, 0, 0, 0, 1)))


START = packet(_SERVER, START_UDP)
HEARD_YOU = packet(_SERVER, HEARD, b"\x01")


def _pack(values: dict[str, Any]) -> bytes:
    packed: bytes = msgpack.packb(values)
    return packed
