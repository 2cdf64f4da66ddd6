"""How one record of the log is written: as a line for people, or as a line of JSON for programs.

A line of JSON has at most :data:`LINE_BYTES`, so that lines of processes that share a pipe do not mix. Its texts hold
no control characters, in escaped form either: a text that a program decodes is safe to print.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from zbridge.fleet.printable import shown

LINE_BYTES = 4096
"""Most bytes of a line of JSON, with its end: as many as a pipe takes as a whole (PIPE_BUF of Linux)."""
NAME_BYTES = 200
"""Most bytes of each name in it: logger, robot, peer, session, event."""
MESSAGE_BYTES = 1600
"""Most bytes of its sentence, if the line would become too long."""
NAMES = ("robot", "peer", "session")
"""Fields that are keys of their own."""
_CUT = "..."
_LEAST = 40
"""Bytes of room that are too few for a part of a text."""
_INTEGERS = range(-(2**63), 2**63)
_encode = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode


class LineFormatter(logging.Formatter):
    """Formats a record as one line that is safe to print, whatever peers sent; a traceback follows on further lines."""

    def __init__(self, whose: str = "") -> None:
        super().__init__(f"%(asctime)s %(levelname)-7s {whose.replace('%', '%%')}%(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the library's names
        return shown(super().formatMessage(record)) + _repeated(record)

    def formatException(self, ei: Any) -> str:  # noqa: N802
        return _shown_lines(super().formatException(ei))


class JsonFormatter(logging.Formatter):
    """Formats a record as a JSON object in printable ASCII: one line, of at most :data:`LINE_BYTES` with its end."""

    def format(self, record: logging.LogRecord) -> str:
        own: Mapping[str, object] = getattr(record, "fields", {})
        names = {"robot": getattr(record, "robot", ""), **{key: own[key] for key in NAMES if own.get(key) is not None}}
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
            "level": record.levelname.lower(),
            "logger": _name(record.name),
            **{key: _name(value) for key, value in names.items() if value != ""},
        }
        if (event := getattr(record, "event", None)) is not None:
            line["event"] = _name(event)
        line["message"] = shown(record.getMessage())
        if (repeated := getattr(record, "repeated", 0)) > 0:
            line["repeated"] = repeated
        if fields := {key: plain(value) for key, value in own.items() if key not in NAMES and value is not None}:
            line["fields"] = fields
        if record.exc_info:
            line["traceback"] = _shown_lines(self.formatException(record.exc_info))
        text = _encode(line)
        return text if len(text) < LINE_BYTES else _encode(_fitted(line))


def plain(value: object) -> str | float:
    """Return a field as JSON shows it: numbers and truth values as they are, bytes as hex, all else as text."""
    if isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value) if value in _INTEGERS else shown(hex(value))
    if isinstance(value, float) and math.isfinite(value):
        return float(value)
    if isinstance(value, bytes | bytearray | memoryview):
        return shown(value.hex())
    return shown(value)


def _repeated(record: logging.LogRecord) -> str:
    count = getattr(record, "repeated", 0)
    if not count:
        return ""
    times = "once" if count == 1 else f"{count} times"
    return f" ({times} more in {getattr(record, 'repeated_s', 0.0):.0f} s)"


def _shown_lines(text: str) -> str:
    return "\n".join(map(shown, text.split("\n")))


def _name(value: object) -> str:
    return cut(shown(value), NAME_BYTES)


def cut(text: str, most: int, *, end: bool = False) -> str:
    """Shorten a text to ``most`` bytes as JSON, with its quotation marks; end: keep its end."""
    if len(_encode(text)) <= most:
        return text
    room, count = most - len(_CUT) - 2, 0
    for character in reversed(text) if end else text:
        room -= len(_encode(character)) - 2
        if room < 0:
            break
        count += 1
    return _CUT + text[len(text) - count :] if end else text[:count] + _CUT


def _fitted(line: dict[str, Any]) -> dict[str, Any]:
    """Shorten what fills a line: the sentence to its bound; then fields, and last a traceback, get what is left."""
    fields, traceback = line.pop("fields", {}), line.pop("traceback", None)
    line["message"] = cut(line["message"], MESSAGE_BYTES)
    room = LINE_BYTES - len(_encode(line)) - len(',"fields":{}\n')
    kept: dict[str, Any] = {}
    for number, (key, value) in enumerate(fields.items()):
        left = room // (len(fields) - number) - len(_encode(key)) - len(":,")  # a fair share
        if isinstance(value, str) and left >= _LEAST:
            value = cut(value, left)
        if (size := len(_encode(value))) <= left:
            kept[key] = value
            room -= len(_encode(key)) + len(":,") + size
    line |= {"fields": kept} if kept else {}
    room = LINE_BYTES - len(_encode(line)) - len(',"traceback":\n')
    return line | ({"traceback": cut(traceback, room, end=True)} if traceback and room >= _LEAST else {})
