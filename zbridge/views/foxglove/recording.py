"""A recording (MCAP) as a playback reads it: its channels, its times, and its messages from any time on.

A recording that was cut off has no index: it is read from its begin, up to the cut.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import msgspec
from mcap.reader import McapReader, NonSeekingReader, SeekingReader

from zbridge.errors import ZbridgeError, describe
from zbridge.views.pictures import ViewerChannel
from zbridge.views.schemas import Schema

log = logging.getLogger("zbridge.foxglove")

CHANNELS = 4096
"""Most channels of a recording that are shown."""
RECORD_BYTES = 256 * 1024 * 1024
"""The longest record that is read."""
SCHEMA_BYTES = 1024 * 1024
"""The longest schema that viewers are told; a channel with a longer one is left out."""
TOPIC_CHARACTERS = 1024
SHOWN = ("protobuf", "json", "ros1", "cdr", "flatbuffer")
"""Encodings that viewers read; the fleet messages of a recording (MessagePack) are for other readers."""
_LAST_NS = 2**63 - 1
_Entry = tuple[Any, Any, Any]
"""Schema, channel and message, as the library reads them."""


class PlayedMessage(msgspec.Struct, frozen=True, gc=False):
    """A recorded message. log_ns: Unix nanoseconds."""

    topic: str
    log_ns: int
    payload: bytes


class IndexedRecording:
    """A recording in a file; raises ZbridgeError, which names the file, if nothing of it can be shown.

    whole: whether it has an index. begin_ns, end_ns: its first and last time, Unix nanoseconds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = True
        self.begin_ns = self.end_ns = 0
        self.channels: dict[str, ViewerChannel] = {}
        try:
            with path.open("rb") as file:
                self.whole = self._read_index(file)
            if not self.whole:
                self._read_through()
        except OSError as error:
            raise ZbridgeError(f"{path}: {error.strerror or error}") from error
        if not self.channels or not 0 <= self.begin_ns <= self.end_ns <= _LAST_NS:
            raise ZbridgeError(f"{path}: nothing in it that a viewer can show")

    def __repr__(self) -> str:
        return f"<IndexedRecording {self.path}, {len(self.channels)} channels>"

    def messages(self, from_ns: int) -> Iterator[PlayedMessage]:
        """Yield the messages from a time on, in the order of their times; of a cut recording as they were written.

        The first thing that cannot be read is the end. Raise OSError.
        """
        with self.path.open("rb") as file:
            for _, channel, message in self._until_fault(file, starting_at=from_ns):
                if channel.topic in self.channels:
                    yield PlayedMessage(channel.topic, message.log_time, message.data)

    def last_before(self, topics: Iterable[str], at_ns: int, since_ns: int) -> list[PlayedMessage]:
        """Return the last message of each topic until a time, inclusive, but of none from before ``since_ns``."""
        wanted, found = set(topics), dict[str, PlayedMessage]()
        if not wanted or at_ns < since_ns:
            return []
        with self.path.open("rb") as file:
            entries = self._until_fault(
                file, topics=list(wanted), starting_at=since_ns, ending_at=at_ns, reverse=self.whole
            )
            for _, channel, message in entries:
                if not self.whole or channel.topic not in found:
                    found[channel.topic] = PlayedMessage(channel.topic, message.log_time, message.data)
                if self.whole and len(found) == len(wanted):
                    break
        return sorted(found.values(), key=lambda message: message.log_ns)

    def _read_index(self, file: IO[bytes]) -> bool:
        """Read channels and times from the index; False where there is none."""
        try:
            summary = SeekingReader(file, record_size_limit=RECORD_BYTES).get_summary()
        except Exception:  # whatever a damaged index makes the library raise: the messages may still be good
            return False
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return False
        for channel in summary.channels.values():
            self._add(channel, summary.schemas.get(channel.schema_id))
        self.begin_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        return True

    def _read_through(self) -> None:
        """Read everything up to the cut, for channels and times."""
        begin_ns, end_ns = _LAST_NS, 0
        with self.path.open("rb") as file:
            for schema, channel, message in self._until_fault(file):
                self._add(channel, schema)
                begin_ns, end_ns = min(begin_ns, message.log_time), max(end_ns, message.log_time)
        self.begin_ns, self.end_ns = begin_ns, end_ns

    def _add(self, channel: Any, schema: Any) -> None:
        encoding = channel.message_encoding
        if encoding not in SHOWN or len(self.channels) >= CHANNELS or len(channel.topic) > TOPIC_CHARACTERS:
            return
        name, kind, data = (schema.name, schema.encoding, schema.data) if schema is not None else ("", "", b"")
        if len(data) <= SCHEMA_BYTES and len(name) <= TOPIC_CHARACTERS:
            shown = ViewerChannel(channel.topic, channel.topic, Schema(name, kind, data, encoding))
            self.channels.setdefault(channel.topic, shown)

    def _until_fault(self, file: IO[bytes], **filters: Any) -> Iterator[_Entry]:
        """Yield entries up to what cannot be read. The order of times needs the index."""
        try:
            reader: McapReader
            if self.whole:
                reader = SeekingReader(file, record_size_limit=RECORD_BYTES)
            else:
                reader = NonSeekingReader(file, record_size_limit=RECORD_BYTES)
            yield from reader.iter_messages(log_time_order=self.whole, **filters)
        except OSError:
            raise
        except Exception as error:  # whatever the library raises; a cut is the usual cause
            log.info("%s: read up to: %s", self.path, describe(error))
