"""Writes recordings as tables (CSV, one for each key) and as numpy arrays (scans and poses)."""

from __future__ import annotations

import csv
import json
from array import array
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec

from zbridge.errors import ConfigError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import FleetMessage, Pose, Scan
from zbridge.fleet.topics import split_key
from zbridge.views.recording.contents import MSGPACK, OCTETS, message_of
from zbridge.views.recording.reader import RecordedMessage, RecordingReader, open_recording
from zbridge.views.recording.selection import Selection

if TYPE_CHECKING:
    import numpy as np

OPEN_TABLES = 64
"""Tables that are open at a time."""
TABLES = 10_000
"""Most tables of an export."""
ARRAY_BYTES = 2**31
"""Bytes of all arrays of an export, which are in memory."""
_CHOOSE = "choose some by --keys, --from and --to"
_TIMES = ("log_ns", "publish_ns")
_ARRAYS: dict[type[FleetMessage], tuple[str, ...]] = {
    Pose: ("x", "y", "heading"),
    Scan: ("angle_min", "angle_increment"),
}
"""The numbers of which an array is made."""


class Export(msgspec.Struct):
    """What was written. skipped: messages that could not be read. fault: why the recording ended early."""

    files: int = 0
    messages: int = 0
    skipped: int = 0
    fault: str | None = None


def first_ns(path: Path) -> int:
    """Return the log time of the first message; 0 where there is none."""
    with open_recording(path) as file:
        return next((message.log_ns for message in RecordingReader(file).messages()), 0)


def export_tables(path: Path, folder: Path, selection: Selection) -> Export:
    """Write a table for each key of fleet messages and raw frames below ``folder``; raise ConfigError, OSError.

    Columns: log and publish time, then the message's fields; lists are JSON, bytes are hex.
    """
    done, tables = Export(), _Tables(folder)
    try:
        for message in _chosen(path, selection, done):
            try:
                names, values = _row(message)
            except PayloadError:
                done.skipped += 1
                continue
            tables.write(message.channel.topic, names, [message.log_ns, message.publish_ns, *values])
            done.messages += 1
    finally:
        tables.close()
    done.files = len(tables.topics)
    return done


def export_arrays(path: Path, output: Path, selection: Selection) -> Export:
    """Write scans and poses to one ``.npz``; raise ConfigError if they exceed ARRAY_BYTES, OSError.

    Arrays: ``<robot>/pose/x``, ``y``, ``heading``; ``<robot>/scan/ranges`` float32[scans, points] filled with NaN,
    ``angle_min``, ``angle_increment``; each with ``log_ns`` and ``stamp_ns`` (int64, the publish time).
    """
    import numpy as np

    done, size = Export(), 0
    found: dict[str, dict[str, _Columns]] = {"pose": {}, "scan": {}}
    for message in _chosen(path, selection, done):
        split = split_key(message.channel.topic)
        kind = message_of(message.channel.topic)
        if split is None or message.channel.encoding != MSGPACK or kind is None or kind not in _ARRAYS:
            continue
        try:
            decoded = payloads.decode(kind, message.data)
        except PayloadError:
            done.skipped += 1
            continue
        size += len(message.data) + 40
        if size > ARRAY_BYTES:
            raise ConfigError(f"more than {ARRAY_BYTES} bytes of scans and poses: {_CHOOSE}")
        found[kind.__name__.lower()].setdefault(split[1], _Columns(_ARRAYS[kind])).add(message, decoded)
        done.messages += 1
    arrays: dict[str, Any] = {
        f"{robot}/{what}/{name}": values
        for what, robots in found.items()
        for robot, columns in robots.items()
        for name, values in columns.arrays(np).items()
    }
    with output.open("xb") as file:
        np.savez_compressed(file, **arrays)
    done.files = 1
    return done


def _chosen(path: Path, selection: Selection, done: Export) -> Iterator[RecordedMessage]:
    with open_recording(path) as file:
        reader = RecordingReader(file)
        yield from filter(selection.includes, reader.messages())
        done.fault = None if reader.ended else reader.fault


def _row(message: RecordedMessage) -> tuple[tuple[str, ...], list[Any]]:
    """Return the columns and the values of a message; raise PayloadError."""
    if message.channel.encoding == OCTETS:
        return ("octets",), [message.data.hex()]
    if message.channel.encoding != MSGPACK:
        raise PayloadError(f"{message.channel.encoding} has no table")
    kind = message_of(message.channel.topic)
    if kind is None:
        return ("fields",), [_cell(payloads.unpack(message.data))]
    decoded: FleetMessage = payloads.decode(kind, message.data)
    fields = msgspec.structs.asdict(decoded)
    return tuple(fields), [_cell(value) for value in fields.values()]


def _cell(value: Any) -> Any:
    if value is None or value is msgspec.UNSET:
        return ""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, str | int | float):
        return value
    return json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, msgspec.Struct):
        return msgspec.structs.asdict(value)
    return value.tolist() if hasattr(value, "tolist") else str(value)


class _Tables:
    """The tables of an export, of which few are open at a time."""

    def __init__(self, folder: Path) -> None:
        self.topics: set[str] = set()
        self._folder = folder
        self._open: OrderedDict[str, IO[str]] = OrderedDict()

    def write(self, topic: str, names: tuple[str, ...], values: list[Any]) -> None:
        if topic not in self.topics:
            if len(self.topics) >= TABLES:
                raise ConfigError(f"more than {TABLES} keys: choose some by --keys")
            self.topics.add(topic)
            csv.writer(self._file(topic, "x")).writerow((*_TIMES, *names))
        csv.writer(self._file(topic, "a")).writerow(values)

    def close(self) -> None:
        for file in self._open.values():
            file.close()
        self._open.clear()

    def _file(self, topic: str, mode: str) -> IO[str]:
        file = self._open.get(topic)
        if file is None:
            path = self._path(topic)
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                file = path.open(mode, encoding="utf-8", newline="")
            except FileExistsError as error:
                raise ConfigError(f"{path} exists: give another folder") from error
            self._open[topic] = file
            if len(self._open) > OPEN_TABLES:
                self._open.popitem(last=False)[1].close()
        self._open.move_to_end(topic)
        return file

    def _path(self, topic: str) -> Path:
        """Return a path within the folder, whatever the topic is."""
        chunks = [quote(chunk, safe="@ %").replace(".", "%2E") or "%" for chunk in topic.split("/")]
        return self._folder.joinpath(*(chunk[:100] for chunk in chunks[:16])).with_suffix(".csv")


class _Columns:
    """The poses or scans of one robot, column by column; scans with fewer points are filled up with NaN."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._times = {"log_ns": array("Q"), "stamp_ns": array("Q")}
        self._columns = {name: array("d") for name in names}
        self._ranges: list[Any] = []

    def add(self, message: RecordedMessage, decoded: FleetMessage) -> None:
        self._times["log_ns"].append(message.log_ns)
        self._times["stamp_ns"].append(message.publish_ns)
        for name, column in self._columns.items():
            column.append(getattr(decoded, name))
        if isinstance(decoded, Scan):
            self._ranges.append(decoded.ranges)

    def arrays(self, np: Any) -> dict[str, np.ndarray]:
        arrays = {name: np.array(times).astype(np.int64) for name, times in self._times.items()}
        arrays |= {name: np.array(column) for name, column in self._columns.items()}
        return arrays | ({"ranges": self._filled(np)} if self._ranges else {})

    def _filled(self, np: Any) -> Any:
        points = max(map(len, self._ranges))
        if points * len(self._ranges) * 4 > ARRAY_BYTES:
            raise ConfigError(f"more than {ARRAY_BYTES} bytes of scans: {_CHOOSE}")
        filled = np.full((len(self._ranges), points), np.nan, np.float32)
        for row, scan in zip(filled, self._ranges, strict=True):
            row[: len(scan)] = scan
        return filled
