"""Recordings for tests: made by the library ``mcap``, or record by record where they lie."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgpack
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

MAGIC = b"\x89MCAP0\r\n"
S_NS = 1_000_000_000
BEGAN_NS = 1_700_000_000 * S_NS


def packed(**fields: Any) -> bytes:
    """A fleet message."""
    payload: bytes = msgpack.packb(fields)
    return payload


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    """One record of the format; ``length`` lies."""
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def channel(number: int, topic: str, schema: int = 0) -> bytes:
    return record(0x04, struct.pack("<HH", number, schema) + text(topic) + text("msgpack") + struct.pack("<I", 0))


def message(number: int, data: bytes = b"\x80", log_ns: int = BEGAN_NS) -> bytes:
    return record(0x05, struct.pack("<HIQQ", number, 0, log_ns, log_ns) + data)


def chunk(
    data: bytes, *, size: int | None = None, checksum: int | None = None, compression: str = "", of: bytes = b""
) -> bytes:
    """A chunk with these records; the rest lies where it is given."""
    head = struct.pack(
        "<QQQI", 0, 0, len(data) if size is None else size, zlib.crc32(data) if checksum is None else checksum
    )
    body = of or data
    return record(0x06, head + text(compression) + struct.pack("<Q", len(body)) + body)


HEADER = record(0x01, text("") + text("test"))
END = record(0x0F, bytes(4)) + record(0x02, bytes(20)) + MAGIC


def written(path: Path, messages: Iterable[tuple[str, float, bytes]], *, chunk_bytes: int = 1000) -> Path:
    """Write (key, seconds, payload) as another program would; a channel whose key has ``#datagram`` is one of those."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[str, int] = {}
        for key, seconds, payload in messages:
            if key not in channels:
                topic, _, kind = key.partition("#")
                encoding = "octet-stream" if "/@wire/" in topic else "msgpack"
                channels[key] = writer.register_channel(topic, encoding, 0, {"transport": kind} if kind else {})
            log_ns = BEGAN_NS + int(seconds * 1e9)
            writer.add_message(channels[key], log_ns, payload, log_ns)
        writer.finish()
    return path


def read(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Read with the library: topic, log time, publish time, payload."""
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


def stream(*records: bytes) -> io.BytesIO:
    """A file of these records."""
    return io.BytesIO(MAGIC + HEADER + b"".join(records))
