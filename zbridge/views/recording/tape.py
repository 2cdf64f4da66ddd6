"""Writes MCAP files: chunks on the disk within a second, files that are split, kept and ended, a disk that fills.

The library ``mcap`` writes the records. foxglove-sdk's writer is as fast, but knows no publish time.

Theory of operation. :class:`Tape` gives messages to the library, which gathers them to a chunk in memory. A chunk ends
after :data:`CHUNK_BYTES` or :data:`CHUNK_S`, and goes to the disk by one write: a process that is killed leaves a file
that is readable to its last chunk. Where a write fails the file is cut back to its last whole chunk, or to an earlier
one, until the few bytes of a proper end have room; what was in the chunks that are gone is counted by topic.
"""

from __future__ import annotations

import os
import struct
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from zbridge.errors import ConfigError
from zbridge.views.recording.contents import ChannelKind
from zbridge.views.recording.intake import Losses
from zbridge.views.recording.reader import DATAGRAM, EXTRA

CHUNK_BYTES = 2**20
"""Bytes of a chunk, uncompressed, about."""
CHUNK_S = 1.0
"""Longest time that a message waits for the end of its chunk."""
CHANNELS = 16_384
"""Most channels of a file."""
INDEX_ENTRIES = 1_000_000
"""Entries of a file's index, which is in memory until its end, some 100 bytes each; then another file begins."""
_BLOCKS = 16
"""Last writes that can be taken back where not even the end of the file has room."""
_END = struct.pack("<BQI", 0x0F, 4, 0) + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + b"\x89MCAP0\r\n"
"""End of the data, a footer without summary, the magic bytes."""

Compression = Literal["zstd", "lz4", "none"]


class TapeSettings(msgspec.Struct, frozen=True):
    """Where and how a recording is written. split_bytes, split_s: begin another file then. keep: so many files."""

    path: Path
    compression: Compression = "zstd"
    split_bytes: int | None = None
    split_s: float | None = None
    keep: int | None = None

    def file(self, number: int) -> Path:
        """Return the path of the file of this number, from 1; the first has a number only where others may follow."""
        if number == 1 and self.split_bytes is None and self.split_s is None:
            return self.path
        return self.path.with_name(f"{self.path.stem}-{number:04d}{self.path.suffix}")


class OutputFile:
    """A new file, written in blocks; raises FileExistsError, OSError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644)
        self.pending = bytearray()
        """Gathered for the next flush."""
        self.written = 0
        """Bytes that are in the file."""

    def __repr__(self) -> str:
        return f"<OutputFile {self.path} {self.tell()} bytes>"

    def write(self, data: Any) -> int:
        """Gather bytes for the next flush."""
        self.pending += data
        return len(data)

    def tell(self) -> int:
        """Return the size of the file with all that was gathered."""
        return self.written + len(self.pending)

    def flush(self) -> None:
        """Write what was gathered; raise OSError where not all of it could be written."""
        view = memoryview(self.pending)
        done = 0
        while done < len(view):
            done += os.write(self._descriptor, view[done:])
        view.release()
        self.written += done
        self.pending = bytearray()

    def cut(self, size: int) -> None:
        """Forget what was gathered, and all that was written behind ``size``."""
        self.pending = bytearray()
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self.written = size

    def close(self) -> None:
        """Close the file; idempotent."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


class Tape:
    """The files of one recording. Call :meth:`begin` first. Where a method raises OSError, call :meth:`salvage`."""

    def __init__(self, settings: TapeSettings) -> None:
        self.unwritten = Losses()
        """Messages that were in memory, or taken back from the disk, when the disk was full."""
        self.messages = 0
        """Messages in all files so far, as a reader of the files counts them."""
        self.number = 0
        """The number of the current file, from 1."""
        self.files: list[Path] = []
        self.bytes_before = 0
        self._settings = settings
        self._file: OutputFile | None = None
        self._writer: Any = None
        self._schemas: dict[str, int] = {}
        self._channels = 0
        self._blocks: deque[tuple[int, dict[str, int]]] = deque(maxlen=_BLOCKS)
        """What each write to the disk held: where it began, and its messages by topic."""
        self._counts: dict[str, int] = {}
        self._entries = 0
        self._whole = 0
        """Bytes of the current file that are whole blocks."""
        self._begun = self._flushed = 0.0

    def __repr__(self) -> str:
        return f"<Tape {self._file!r}>"

    @property
    def bytes_written(self) -> int:
        return self.bytes_before + (self._file.written if self._file is not None else 0)

    def begin(self, now: float, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Begin a new file; end the one before it. now: seconds of any clock."""
        self.close()
        self.number += 1
        self._writer = None
        self._file = file = OutputFile(self._settings.file(self.number))
        self.files.append(file.path)
        while self._settings.keep is not None and len(self.files) > self._settings.keep:
            self.files.pop(0).unlink(missing_ok=True)
        self._schemas, self._channels, self._entries, self._whole = {}, 0, 0, 0
        self._blocks.clear()
        self._counts = {}
        self._begun = self._flushed = now
        self._writer = make_writer(file, self._settings.compression)
        self._writer.start(library="zbridge")
        for name, pairs in metadata.items():
            self.add_metadata(name, pairs)
        self._flush_file(now)

    def add_metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(pairs))

    def register(self, kind: ChannelKind) -> int | None:
        """Add a channel to the current file; return its id, None if there are too many."""
        if self._channels >= CHANNELS:
            return None
        self._channels += 1
        schema, number = kind.schema, 0
        if schema is not None and not (number := self._schemas.get(schema.name, 0)):
            number = self._schemas[schema.name] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        channel: int = self._writer.register_channel(
            kind.topic, kind.encoding, number, DATAGRAM if kind.datagram else {}
        )
        return channel

    def write(self, topic: str, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        self.messages += 1
        self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(channel, log_ns, data, publish_ns, sequence)

    def keep_time(self, now: float) -> None:
        """Bring to the disk what is due. To be called after every batch, and several times a second."""
        if self._file is None:
            return
        if not self._counts:
            self._flushed = now
        elif self._file.pending or now - self._flushed >= CHUNK_S:
            self._writer.flush()  # what follows a full chunk, too: then a block has all of its messages
            self._flush_file(now)

    def full(self, now: float) -> bool:
        """Return whether another file has to begin."""
        settings, file = self._settings, self._file
        if file is None:
            return False
        return (
            self._entries >= INDEX_ENTRIES
            or (settings.split_bytes is not None and file.tell() >= settings.split_bytes)
            or (settings.split_s is not None and now - self._begun >= settings.split_s)
        )

    def close(self) -> None:
        """End the current file properly; idempotent."""
        if self._file is None:
            return
        self._writer.flush()
        self._flush_file(self._flushed)  # the summary is a block of its own: without room for it nothing else is lost
        self._writer.finish()
        self._flush_file(self._flushed)
        self._release()

    def salvage(self) -> bool:
        """End the current file with what of it is on the disk; False if it could not be ended properly."""
        file = self._file
        if file is None:
            return True
        self._lose(self._counts)
        size = self._whole
        while True:
            try:
                file.cut(size)
                file.write(_END)
                file.flush()
            except OSError:
                if len(self._blocks) < 2:  # the first block is the header
                    self._release()
                    return False
                size, counts = self._blocks.pop()
                self._lose(counts)
            else:
                self._release()
                return True

    def _lose(self, counts: dict[str, int]) -> None:
        for topic, count in counts.items():
            self.messages -= count
            self.unwritten.add(topic, count)

    def _flush_file(self, now: float) -> None:
        file = self._file
        assert file is not None
        file.flush()
        self._blocks.append((self._whole, self._counts))
        self._whole = file.written  # not before this: the library flushes the file itself, too
        self._entries += len(self._counts) + 1
        self._counts, self._flushed = {}, now

    def _release(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            self.bytes_before += file.written
            file.close()


def make_writer(stream: Any, compression: Compression) -> Any:
    """Make the library's writer; raise ConfigError if it is not installed."""
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError as error:
        raise ConfigError(f"a recording {EXTRA}") from error
    return Writer(stream, CHUNK_BYTES, CompressionType[compression.upper()])
