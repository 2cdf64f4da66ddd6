"""What a recording holds: robots, keys, counts, rates, gaps. Works through any file once, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import msgspec

from zbridge.fleet.topics import split_key
from zbridge.views.recording.reader import RecordedChannel, RecordedMessage, RecordingReader, open_recording

GAP_FACTOR = 10.0
"""A pause is a gap if it is so many times as long as the usual one of its key."""
GAP_S = 1.0
"""Shorter pauses are no gaps."""
_LEARN = 8
"""Messages of a key before its pauses are judged."""
_SMOOTH = 0.05


class KeySummary(msgspec.Struct):
    """One channel. first_ns, last_ns: log times. gap_s: the longest pause, gaps: how many were unusually long."""

    topic: str
    encoding: str
    schema: str
    count: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    usual_s: float = 0.0
    gap_s: float = 0.0
    gaps: int = 0

    @property
    def rate_hz(self) -> float:
        """Messages a second between the first and the last one."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span_ns if self.count > 1 and span_ns > 0 else 0.0

    def note(self, message: RecordedMessage) -> None:
        if self.count:
            self._judge((message.log_ns - self.last_ns) / 1e9)
        else:
            self.first_ns = message.log_ns
        self.count += 1
        self.bytes += len(message.data)
        self.last_ns = max(self.last_ns, message.log_ns)

    def _judge(self, pause_s: float) -> None:
        self.gap_s = max(self.gap_s, pause_s)
        if self.count >= _LEARN and pause_s >= max(GAP_S, GAP_FACTOR * self.usual_s):
            self.gaps += 1
        elif pause_s >= 0:
            self.usual_s += (pause_s - self.usual_s) * max(_SMOOTH, 1 / self.count)


class Summary(msgspec.Struct):
    """A whole recording. fault: what is wrong with the file, None if it ends properly."""

    path: str
    size: int
    keys: list[KeySummary]
    metadata: list[tuple[str, dict[str, str]]]
    begin_ns: int = 0
    end_ns: int = 0
    messages: int = 0
    fault: str | None = None

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.begin_ns) / 1e9

    @property
    def robots(self) -> list[str]:
        return robots_of(key.topic for key in self.keys)


def robots_of(topics: Iterable[str]) -> list[str]:
    """Return the names of robots in keys."""
    splits = filter(None, map(split_key, topics))
    return sorted({robot for realm, robot, _ in splits if realm and not robot.startswith(("@", "*"))})


def summarize(path: Path) -> Summary:
    """Count what a file holds; raise ConfigError if it cannot be opened or is no recording at all."""
    with open_recording(path) as file:
        reader = RecordingReader(file)
        keys: dict[RecordedChannel, KeySummary] = {}
        begin_ns, end_ns, total = 2**64, 0, 0
        for message in reader.messages():
            channel = message.channel
            key = keys.get(channel)
            if key is None:
                key = keys[channel] = KeySummary(channel.topic, channel.encoding, channel.schema)
            key.note(message)
            begin_ns, end_ns = min(begin_ns, message.log_ns), max(end_ns, message.log_ns)
            total += 1
        return Summary(
            str(path),
            path.stat().st_size,
            sorted(keys.values(), key=lambda key: (key.topic, key.schema)),
            reader.metadata,
            begin_ns if total else 0,
            end_ns,
            total,
            None if reader.ended else reader.fault or "cut off",
        )
