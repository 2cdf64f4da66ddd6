"""The bytes of the benchmark: what its robot sends, and what the gateway makes of it on the bus.

Written by the protocol page, without the gateway's own codec: a fault there must not measure itself.
The running number of a position travels in ``x`` (exact in a float32 up to 2**24).
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any, Literal

import msgpack
import numpy as np

Kind = Literal["pose", "map"]

SIDE = 200
"""Cells along a side of the map: 40 000 bytes of cells."""
UNIT_M = 0.01
"""The robot's unit of length."""
CELL_UNITS = 10
"""Side of a map cell in the robot's unit."""

HEADER = struct.Struct("<iBB")
POSITION = struct.Struct("<iBBfff")
_VERSIONS = b"1.1,1.2,1.3"
_SERVER_ID, _CLIENT_ID = 1, 2
_SERVER_SETTINGS, CLIENT_SETTINGS, _MAP, _POSITION = 2, 3, 53, 55
_Y, _HEADING_DEG = 250.0, 30.0
_LAYOUT = np.dtype(
    [("length", "<i4"), ("sender", "u1"), ("id", "u1"), ("x", "<f4"), ("y", "<f4"), ("heading_deg", "<f4")]
)


def server_settings() -> bytes:
    """Write packet 2 of a robot of version 1.3 without UDP."""
    flags = bytes((0, 1, 1, 1, 1, 1, 1))  # UDP, Cam, Joystick, Chat, Lidar, LidarSim, SLAMMap
    sizes = struct.pack("<ii", SIDE * CELL_UNITS, CELL_UNITS)
    body = bytes((_CLIENT_ID,)) + _text(_VERSIONS) + flags + sizes
    return _packet(_SERVER_ID, _SERVER_SETTINGS, body)


def client_settings() -> bytes:
    """Write packet 3 of an HQ of version 1.3 without UDP."""
    return _packet(_CLIENT_ID, CLIENT_SETTINGS, _text(_VERSIONS) + bytes(7))


def position(sequence: int) -> bytes:
    """Write packet 55, 18 bytes."""
    return POSITION.pack(POSITION.size - 4, _SERVER_ID, _POSITION, sequence, _Y, _HEADING_DEG)


def positions(first: int, last: int) -> bytes:
    """Write the packets 55 with the numbers ``first`` to ``last``, joined."""
    packets = np.zeros(last - first + 1, _LAYOUT)
    packets["length"], packets["sender"], packets["id"] = POSITION.size - 4, _SERVER_ID, _POSITION
    packets["x"] = np.arange(first, last + 1)
    packets["y"], packets["heading_deg"] = _Y, _HEADING_DEG
    return packets.tobytes()


def slam_map(side: int = SIDE) -> bytes:
    """Write packet 53 with ``side * side`` cells, 40 000 of them by default."""
    return _packet(_SERVER_ID, _MAP, struct.pack("<i", side * side) + _cells(side))


def payload(kind: Kind, sequence: int, stamp_ns: int) -> bytes:
    """Write what the gateway publishes for a packet: the payload of the bare loop."""
    if kind == "pose":
        heading = math.radians(_HEADING_DEG) + math.pi / 2
        return _pack({"x": sequence * UNIT_M, "y": _Y * UNIT_M, "heading": heading, "stamp_ns": stamp_ns})
    cell = CELL_UNITS * UNIT_M
    origin = [-SIDE * cell / 2] * 2
    values = {"rows": SIDE, "columns": SIDE, "cell": cell, "origin": origin, "cells": _cells(), "stamp_ns": stamp_ns}
    return _pack(values)


def sequence_of(published: bytes) -> int:
    """Read the running number from a published position, MessagePack (gateway, bare loop) or JSON (script)."""
    values: dict[str, float] = json.loads(published) if published[:1] == b"{" else msgpack.unpackb(published)
    return round(values["x"] / UNIT_M)


def _pack(values: dict[str, Any]) -> bytes:
    packed: bytes = msgpack.packb(values)
    return packed


def _packet(sender: int, packet_id: int, body: bytes) -> bytes:
    return HEADER.pack(2 + len(body), sender, packet_id) + body


def _text(text: bytes) -> bytes:
    return struct.pack("<i", len(text)) + text


def _cells(side: int = SIDE) -> bytes:
    return bytes(index % 3 for index in range(side * side))
