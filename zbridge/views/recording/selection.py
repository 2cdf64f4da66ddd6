"""Chooses messages of a recording by key and time, and reads amounts that people write: ``1GB``, ``1:30``. Sans-IO."""

from __future__ import annotations

import re
from datetime import datetime

import msgspec

from zbridge.errors import ConfigError
from zbridge.fleet.topics import matches
from zbridge.views.recording.reader import RecordedMessage

_LAST_NS = 2**64


class Selection(msgspec.Struct, frozen=True):
    """Which messages: of keys that ``key_expr`` matches (None: all), from ``since_ns`` to before ``until_ns``."""

    key_expr: str | None = None
    since_ns: int = 0
    until_ns: int = _LAST_NS

    def includes(self, message: RecordedMessage) -> bool:
        if not self.since_ns <= message.log_ns < self.until_ns:
            return False
        return self.key_expr is None or matches(self.key_expr, message.channel.topic)


_AMOUNT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]*)\s*")
_BYTES = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
_SECONDS = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0}
LEAST_BYTES = 100_000
"""A file is at least so large."""
_CLOCK = re.compile(r"(?:(\d+):)?(\d+):(\d+(?:\.\d+)?)")


def read_split(text: str) -> tuple[int | None, float | None]:
    """Read ``1GB`` or ``10min`` as (bytes, None) or (None, seconds); raise ConfigError."""
    found = _AMOUNT.fullmatch(text)
    unit = found[2].lower() if found else ""
    if found and unit in _BYTES and float(found[1]) * _BYTES[unit] >= LEAST_BYTES:
        return int(float(found[1]) * _BYTES[unit]), None
    if found and unit in _SECONDS and float(found[1]) * _SECONDS[unit] >= 1.0:
        return None, float(found[1]) * _SECONDS[unit]
    raise ConfigError(f"split = {text!r}: expected a size (100kB or more) or a time (1s or more): 1GB, 10min")


def read_seconds(name: str, text: str) -> float:
    """Read ``90``, ``90s``, ``10min`` or ``1h`` as seconds; raise ConfigError that names the option."""
    found = _AMOUNT.fullmatch(text)
    if found and (found[2].lower() or "s") in _SECONDS:
        return float(found[1]) * _SECONDS[found[2].lower() or "s"]
    raise ConfigError(f"{name} = {text!r}: expected a time: 90s, 10min, 1h")


def read_moment(name: str, text: str, begin_ns: int) -> int:
    """Read a moment of a recording as Unix nanoseconds; raise ConfigError that names the option.

    ``12.5``, ``90s``, ``1:30`` count from the begin of the recording; ``2026-11-22T05:00:00+01:00`` is a time of day,
    of this machine's zone where it names none.
    """
    clock = _CLOCK.fullmatch(text)
    if clock:
        seconds = int(clock[1] or 0) * 3600 + int(clock[2]) * 60 + float(clock[3])
        return begin_ns + int(seconds * 1e9)
    try:
        if "T" in text:
            return int(datetime.fromisoformat(text).timestamp() * 1e9)
        return begin_ns + int(read_seconds(name, text) * 1e9)
    except (ValueError, OverflowError, ConfigError) as error:
        raise ConfigError(f"{name} = {text!r}: expected 12.5, 1:30 or 2026-11-22T05:00:00") from error


def read_selection(begin_ns: int, since: str, until: str, key_expr: str | None = None) -> Selection:
    """Read ``--from`` and ``--to``, empty if they were not given; raise ConfigError. begin_ns: of the recording."""
    return Selection(
        key_expr,
        read_moment("from", since, begin_ns) if since else 0,
        read_moment("to", until, begin_ns) if until else _LAST_NS,
    )
