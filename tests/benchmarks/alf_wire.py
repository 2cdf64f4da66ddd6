"""The bytes of the ALF benchmark: what its vehicle sends in both dialects, and what the gateway makes of a scan.

Written by the protocol page, without the gateway's own codec: a fault there must not measure itself.
"""

from __future__ import annotations

import math
import random
import struct
from typing import Literal

import msgpack
import numpy as np

from tests.benchmarks.peer import ROBOT

Dialect = Literal["text", "binary"]

SCAN_KEY = f"fleet/{ROBOT}/scan"
POINTS, FIRST, LAST = 769, 44, 725
"""Points of a scan, and which of them are valid, both inclusive."""
RANGE_MM = (20, 5600)
_ANGLE_MIN_DEG, _ANGLE_MAX_DEG, _STEP_DEG, _SCAN_MS = -135.0, 119.882812, 0.351562, 100
_INFO = (50, 0.125, -0.25, 1.0, 0.5, -0.5, 12.25, 36.5)
_BINARY_INFO = (50, 125, -250, 1000, 5, -5, 122, 36.5)
_COMMAND_BYTES = 5


def _sweep() -> list[int]:
    """Make the points of a scan, mm: some are 0, some codes below the range, some beyond it."""
    rng = random.Random(1)
    points = [rng.randint(*RANGE_MM) for _ in range(POINTS)]
    for place in rng.sample(range(POINTS), POINTS // 20):
        points[place] = rng.choice((0, rng.randrange(RANGE_MM[0]), RANGE_MM[1] + 1))
    return points


SWEEP = _sweep()
_TEXT_REST = b"%b|%d|%d;" % (b"|".join(b"%d" % point for point in SWEEP), FIRST, LAST)
_BINARY_REST = struct.pack(f"<{POINTS}qII", *SWEEP, FIRST, LAST)


def scan(dialect: Dialect, sequence: int, timestamp_ms: int) -> bytes:
    """Write message 1."""
    if dialect == "text":
        return b"1|%d|%d|%b" % (sequence, timestamp_ms, _TEXT_REST)
    return struct.pack("<BII", 1, sequence, timestamp_ms) + _BINARY_REST


def geometry(dialect: Dialect) -> bytes:
    """Write message 2."""
    values = (_ANGLE_MIN_DEG, _ANGLE_MAX_DEG, _STEP_DEG, _SCAN_MS, *RANGE_MM)
    if dialect == "text":
        return b"2|%f|%f|%f|%d|%d|%d;" % values
    return struct.pack("<B3f3i", 2, *values)


def info(dialect: Dialect) -> bytes:
    """Write message 4."""
    if dialect == "text":
        return b"4|%d|%f|%f|%f|%f|%f|%f|%f;" % _INFO
    return struct.pack("<BB6hf", 4, *_BINARY_INFO)


def commands(dialect: Dialect, read: bytes) -> int:
    """Count the drive commands in what the vehicle read."""
    return read.count(b";") if dialect == "text" else len(read) // _COMMAND_BYTES


def payload(sequence: int, timestamp_ms: int, stamp_ns: int) -> bytes:
    """Write what the gateway publishes for a scan: the payload of the bare loop."""
    mm = np.array(SWEEP, np.int64)
    ranges = mm.astype(np.float32) / np.float32(1000)
    ranges[(mm < RANGE_MM[0]) | (mm > RANGE_MM[1])] = np.nan
    ranges[:FIRST] = ranges[LAST + 1 :] = np.nan
    values = {
        "stamp_ns": stamp_ns,
        "seq": sequence,
        "device_ms": timestamp_ms,
        "angle_min": math.radians(_ANGLE_MIN_DEG),
        "angle_increment": math.radians(_STEP_DEG),
        "range_min": RANGE_MM[0] * 1e-3,
        "range_max": RANGE_MM[1] * 1e-3,
        "ranges": ranges.astype("<f4").tobytes(),
    }
    packed: bytes = msgpack.packb(values)
    return packed
