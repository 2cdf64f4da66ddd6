"""The files of the black box: blocks of records, each with a checksum. Sans-IO.

A segment is a sequence of blocks: 3 bytes of magic, one byte of kind, length and CRC-32 of the body as u32
little-endian, and the body in MessagePack. A block of kind ``H`` has a :class:`SegmentHead`, and begins a segment; one
of kind ``R`` a list of records. A damaged block costs itself: the reader goes on at the next magic.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Any
from zlib import crc32

import msgspec

from zbridge.fleet.messages import FleetMessage

Record = tuple[int, str, bytes, bytes | None]
"""When it came (CLOCK_MONOTONIC, ns), its key, payload and attachment. Raw frames have the keys of ``@wire``."""
BLOCK_BYTES = 256 * 1024
"""A block is closed when it has so many bytes."""
MOST_BYTES = 64 * 2**20
"""A longer block was not written by a gateway."""
SUFFIX = ".zbb"
LOG = "@log"
"""The path of log lines below the robot."""
_MAGIC = b"ZB\xb1"
_HEADER = struct.Struct("<3scII")
_HEAD, _RECORDS = b"H", b"R"
_encode = msgspec.msgpack.Encoder().encode


class LogLine(FleetMessage, frozen=True):
    """One line of the gateway's log."""

    level: str
    logger: str
    message: str
    event: str | None = None


class SegmentHead(msgspec.Struct, frozen=True):
    """What a segment begins with.

    wall_ns, mono_ns: the same moment in Unix time and on CLOCK_MONOTONIC of ``boot``. lost: messages that the gateway's
    black box had lost by then. about: versions, and the configuration without secrets.
    """

    realm: str
    robot: str
    boot: str
    pid: int
    wall_ns: int
    mono_ns: int
    lost: int = 0
    about: dict[str, Any] = {}


class Damage(msgspec.Struct, frozen=True):
    """Bytes that could not be read. at: of the first of them, from the begin of the segment."""

    at: int
    size: int


_decode_head = msgspec.msgpack.Decoder(SegmentHead).decode
_decode_records = msgspec.msgpack.Decoder(list[Record]).decode


def head_block(head: SegmentHead) -> bytes:
    """Write the begin of a segment."""
    return _block(_HEAD, _encode(head))


def record_blocks(records: Iterable[Record]) -> Iterator[tuple[int, bytes]]:
    """Write records as blocks of about :data:`BLOCK_BYTES`: the number of records, and the block."""
    waiting: list[Record] = []
    size = 0
    for record in records:
        waiting.append(record)
        size += len(record[1]) + len(record[2]) + len(record[3] or b"") + 16
        if size >= BLOCK_BYTES:
            yield len(waiting), _block(_RECORDS, _encode(waiting))
            waiting, size = [], 0
    if waiting:
        yield len(waiting), _block(_RECORDS, _encode(waiting))


def read_segment(data: bytes) -> Iterator[SegmentHead | list[Record] | Damage]:
    """Read the bytes of a segment, or of several one after the other; never raises."""
    at = good = 0
    while at < len(data):
        found = _read_block(data, at)
        if found is None:
            at = data.find(_MAGIC, at + 1)
            at = at if at >= 0 else len(data)
            continue
        if at > good:
            yield Damage(good, at - good)
        content, at = found
        good = at
        yield content
    if good < len(data):
        yield Damage(good, len(data) - good)


def read_head(data: bytes) -> SegmentHead | None:
    """Read the head of a segment from its first bytes; None if it is damaged, or longer."""
    found = _read_block(data, 0)
    return found[0] if found is not None and isinstance(found[0], SegmentHead) else None


def _block(kind: bytes, body: bytes) -> bytes:
    return _HEADER.pack(_MAGIC, kind, len(body), crc32(body)) + body


def _read_block(data: bytes, at: int) -> tuple[SegmentHead | list[Record], int] | None:
    begin = at + _HEADER.size
    if begin > len(data):
        return None
    magic, kind, size, checksum = _HEADER.unpack_from(data, at)
    end = begin + size
    if magic != _MAGIC or size > MOST_BYTES or end > len(data):
        return None
    body = data[begin:end]
    if crc32(body) != checksum:
        return None
    try:
        return (_decode_head(body) if kind == _HEAD else _decode_records(body)), end
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return None
