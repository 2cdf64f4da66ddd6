"""The bytes of commands: drives on the bus, how they are authorised, and what a robot reads of them.

Written by the design and the protocol page, without the gateway's own codec. Every drive has a running number,
which travels as its speed: a multiple of 2**-20, exact in a float32.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import msgpack

from tests.benchmarks.peer import ROBOT
from tests.benchmarks.wire import HEADER

DRIVE = f"fleet/{ROBOT}/@cmd/drive"
CONTROL = f"fleet/{ROBOT}/@rpc/control"
ADVERSE = 2**19
"""The numbers from here on are an adversary's: a robot that reads one was driven by somebody who may not."""
_STEPS = 2**20
_MOVE, _STOP = 11, 13
_MOVE_BODY = struct.Struct("<fff")


def drive(number: int) -> dict[str, float]:
    """Give the fields of the drive with this number; 0 is neutral."""
    return {"forward": number / _STEPS, "left": 0.0, "turn": 0.0}


def number(payload: bytes) -> int:
    """Read the number of a drive as the gateway reads it."""
    forward: float = msgpack.unpackb(payload)["forward"]
    return round(forward * _STEPS)


def packed(fields: dict[str, Any]) -> bytes:
    """Write a payload as the gateway reads it."""
    payload: bytes = msgpack.packb(fields)
    return payload


def plain(fields: dict[str, Any]) -> bytes:
    """Write a payload as the script reads it."""
    return json.dumps(fields).encode()


def moves(reads: list[tuple[int, bytes]]) -> list[tuple[int, int]]:
    """Find the packets 11 in what a robot read: the time of the read that completed each, and its number."""
    return [
        (at_ns, round(_MOVE_BODY.unpack(body)[2] * _STEPS))
        for at_ns, packet, body in _packets(reads)
        if packet == _MOVE
    ]


def stops(reads: list[tuple[int, bytes]]) -> list[int]:
    """Find the packets 13 in what a robot read: the time of the read that completed each."""
    return [at_ns for at_ns, packet, _ in _packets(reads) if packet == _STOP]


def _packets(reads: list[tuple[int, bytes]]) -> Iterator[tuple[int, int, bytes]]:
    """Cut what a robot read into packets: the time of the read that completed each, its id and its body.

    Packets of one read are a nanosecond apart, so that their times tell their order.
    """
    rest = b""
    for read_ns, data in reads:
        rest += data
        at_ns = read_ns
        while len(rest) >= HEADER.size and len(rest) >= (end := 4 + HEADER.unpack_from(rest)[0]):
            yield at_ns, rest[5], rest[HEADER.size : end]
            rest = rest[end:]
            at_ns += 1
