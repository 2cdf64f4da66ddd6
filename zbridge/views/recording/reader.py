"""Reads MCAP files from begin to end, also those that are cut off or lie. Every record and table is bounded.

Theory of operation. The reader never seeks and never trusts the summary at the end of a file. Records are framed by
their length, which is checked before anything is read; their contents are read within the record. A chunk is
decompressed to the size that it states, within :data:`CHUNK_BYTES`, and its checksum is compared. The first byte that
cannot be understood ends the file: what precedes it was read, and :attr:`RecordingReader.fault` names the damage.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import msgspec

from zbridge.errors import ConfigError, ZbridgeError

EXTRA = "needs the extra: pip install 'zbridge[foxglove]'"
MAGIC = b"\x89MCAP0\r\n"
RECORD_BYTES = 64 * 2**20
"""Longest record that is read."""
CHUNK_BYTES = 256 * 2**20
"""Largest chunk, uncompressed."""
TEXT_BYTES = 1024
"""Longest topic, and longest name of a schema or of an encoding."""
SCHEMA_BYTES = 2**20
TABLES_BYTES = 64 * 2**20
"""Bytes of all channels, schemas and metadata together."""
DATAGRAM = {"transport": "datagram"}
"""The metadata of a channel whose raw frames went by datagram; it tells two channels of one topic apart."""
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _METADATA, _DATA_END, _FOOTER = 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F, 0x02


class BrokenError(ZbridgeError):
    """A file is not what MCAP says."""


class RecordedChannel(msgspec.Struct, frozen=True):
    """A channel of a file, with its schema's name."""

    topic: str
    encoding: str
    schema: str = ""
    metadata: dict[str, str] = {}

    @property
    def datagram(self) -> bool:
        """Whether its raw frames went by datagram."""
        return DATAGRAM.items() <= self.metadata.items()

    def __hash__(self) -> int:
        return hash((self.topic, self.encoding, self.schema))


class RecordedMessage(msgspec.Struct, frozen=True, gc=False):
    """One message. log_ns, publish_ns: Unix time."""

    channel: RecordedChannel
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes


class RecordingReader:
    """Reads one file. :meth:`messages` may be called once for each reader."""

    def __init__(self, file: IO[bytes]) -> None:
        self.metadata: list[tuple[str, dict[str, str]]] = []
        """The metadata records that were read so far."""
        self.ended = False
        """Whether the proper end of the file was reached."""
        self.fault: str | None = None
        """Why the file could not be read further; None while nothing is wrong."""
        self._file = file
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, RecordedChannel] = {}
        self._tables = 0

    def __repr__(self) -> str:
        state = self.fault or ("ended" if self.ended else "reading")
        return f"<RecordingReader {len(self._channels)} channels, {state}>"

    def messages(self) -> Iterator[RecordedMessage]:
        """Yield the messages up to the end of the file, or to what cannot be read. Raises OSError."""
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise BrokenError("not an MCAP file")
            yield from self._records()
        except BrokenError as error:
            self.fault = str(error)

    def _records(self) -> Iterator[RecordedMessage]:
        while True:
            head = self._file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                raise BrokenError("cut off" if not head else "cut off in the head of a record")
            opcode, length = _HEAD.unpack(head)
            if length > RECORD_BYTES:
                raise BrokenError(f"a record of {length} bytes exceeds {RECORD_BYTES}")
            content = self._file.read(length)
            if len(content) < length:
                raise BrokenError("cut off in a record")
            if opcode in (_DATA_END, _FOOTER):
                self.ended = True
                return
            if opcode == _CHUNK_OP:
                yield from self._inner(_decompressed(content))
            elif opcode == _MESSAGE_OP:
                yield self._message(memoryview(content))
            else:
                self._read_record(opcode, memoryview(content))

    def _inner(self, data: bytes) -> Iterator[RecordedMessage]:
        view = memoryview(data)
        while view:
            if len(view) < _HEAD.size:
                raise BrokenError("a chunk ends in the head of a record")
            opcode, length = _HEAD.unpack_from(view)
            view = view[_HEAD.size :]
            if length > len(view):
                raise BrokenError(f"a record of {length} bytes in a chunk that has {len(view)} more")
            content, view = view[:length], view[length:]
            if opcode == _MESSAGE_OP:
                yield self._message(content)
            else:
                self._read_record(opcode, content)

    def _message(self, content: memoryview) -> RecordedMessage:
        if len(content) < _MESSAGE.size:
            raise BrokenError(f"a message of {len(content)} bytes")
        number, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
        channel = self._channels.get(number)
        if channel is None:
            raise BrokenError(f"a message of channel {number}, which was not declared")
        return RecordedMessage(channel, log_ns, publish_ns, sequence, bytes(content[_MESSAGE.size :]))

    def _read_record(self, opcode: int, content: memoryview) -> None:
        """Take a record that is no message; others than those known are skipped."""
        read = _RECORDS.get(opcode)
        if read is not None:
            self._tables += len(content)
            if self._tables > TABLES_BYTES:
                raise BrokenError(f"more than {TABLES_BYTES} bytes of channels, schemas and metadata")
            read(self, Fields(content))

    def _schema(self, fields: Fields) -> None:
        number, name, _ = fields.number("<H"), fields.text(), fields.text()
        if fields.number("<I") > SCHEMA_BYTES:
            raise BrokenError(f"schema {name[:40]!r} exceeds {SCHEMA_BYTES} bytes")
        self._schemas[number] = name

    def _channel(self, fields: Fields) -> None:
        number, schema = fields.number("<H"), fields.number("<H")
        topic, encoding, metadata = fields.text(), fields.text(), fields.pairs()
        if schema and schema not in self._schemas:
            raise BrokenError(f"channel {topic[:40]!r} has schema {schema}, which was not declared")
        channel = RecordedChannel(topic, encoding, self._schemas.get(schema, ""), metadata)
        known = self._channels.setdefault(number, channel)
        if known != channel:
            raise BrokenError(f"channel {number} is {known.topic[:40]!r}, and then {topic[:40]!r}")

    def _metadata(self, fields: Fields) -> None:
        self.metadata.append((fields.text(), fields.pairs(RECORD_BYTES)))


class Fields:
    """Reads the fields of a record one by one; raises BrokenError behind its end."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._at = 0

    def number(self, form: str) -> int:
        size = struct.calcsize(form)
        value: int = struct.unpack(form, self.octets(size))[0]
        return value

    def octets(self, size: int) -> memoryview:
        if size > len(self._content) - self._at:
            raise BrokenError(f"a field of {size} bytes in a record that has {len(self._content) - self._at} more")
        self._at += size
        return self._content[self._at - size : self._at]

    def text(self, most: int = TEXT_BYTES) -> str:
        """Read a text with its length before it."""
        size = self.number("<I")
        if size > most:
            raise BrokenError(f"a text of {size} bytes exceeds {most}")
        try:
            return str(self.octets(size), "utf-8")
        except UnicodeDecodeError as error:
            raise BrokenError("a text is not UTF-8") from error

    def pairs(self, most: int = TEXT_BYTES) -> dict[str, str]:
        """Read pairs of texts with their bytes before them."""
        inner = Fields(self.octets(self.number("<I")))
        pairs: dict[str, str] = {}
        while inner._at < len(inner._content):
            name = inner.text()
            pairs[name] = inner.text(most)
        return pairs


_RECORDS: dict[int, Callable[[RecordingReader, Fields], None]] = {
    _SCHEMA: RecordingReader._schema,
    _CHANNEL: RecordingReader._channel,
    _METADATA: RecordingReader._metadata,
}


def _decompressed(content: bytes) -> bytes:
    """Return the records of a chunk; raise BrokenError if its size or checksum is not as stated."""
    fields = Fields(memoryview(content))
    _, _, size, checksum = _CHUNK.unpack(fields.octets(_CHUNK.size))
    compression = fields.text()
    packed = fields.octets(fields.number("<Q"))
    if size > CHUNK_BYTES:
        raise BrokenError(f"a chunk of {size} bytes exceeds {CHUNK_BYTES}")
    if compression not in _DECOMPRESS:
        raise BrokenError(f"a chunk compressed with {compression[:20]!r}, which is unknown")
    try:
        data = _DECOMPRESS[compression](bytes(packed), size)
    except ConfigError:
        raise
    except Exception as error:  # whatever the library raises
        raise BrokenError(f"a chunk that cannot be decompressed: {error}") from error
    if len(data) != size:
        raise BrokenError(f"a chunk of {len(data)} bytes says that it has {size}")
    if checksum and zlib.crc32(data) != checksum:
        raise BrokenError("a chunk whose checksum differs")
    return data


def _zstd(packed: bytes, size: int) -> bytes:
    with _library("zstandard").ZstdDecompressor(max_window_size=2**27).stream_reader(packed) as stream:
        data: bytes = stream.read(size + 1)
        return data


def _lz4(packed: bytes, size: int) -> bytes:
    data: bytes = _library("lz4.frame").LZ4FrameDecompressor().decompress(packed, size + 1)
    return data


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(f"a compressed recording {EXTRA}") from error


_DECOMPRESS: dict[str, Callable[[bytes, int], bytes]] = {"": lambda packed, size: packed, "zstd": _zstd, "lz4": _lz4}


def open_recording(path: Path) -> IO[bytes]:
    """Open a file for a reader; raise ConfigError if that is not possible."""
    try:
        return path.open("rb", buffering=2**20)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
