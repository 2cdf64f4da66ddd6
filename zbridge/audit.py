"""The audit log: who acquired, released, was refused, stopped the robot, and why. JSON lines, rotated, never rewritten.

Lines are written by a thread of their own: a disk that stands still delays no stop.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from datetime import UTC, datetime
from logging.handlers import QueueHandler, QueueListener, RotatingFileHandler
from pathlib import Path
from queue import Full, Queue
from typing import Any

from zbridge.errors import ConfigError
from zbridge.metrics import Metrics
from zbridge.session.control import Event, What

CLOSE_S = 1.0
"""Longest time a full queue is given to empty at the end."""
WAITING = 4096
"""Lines that may wait for the disk; what is more is dropped and counted."""
KINDS = 256
"""Different refusals counted at a time; the rest is counted as one kind."""

_Kind = tuple[What, str | None, str | None, str | None]


class Audit:
    """Writes events down. The same refusal again and again becomes a line, then one a second with its count."""

    def __init__(self, robot: str, write: Callable[[str], None], clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._robot = robot
        self._write = write
        self._clock_ns = clock_ns
        self._repeated: dict[_Kind, list[Any]] = {}

    def __repr__(self) -> str:
        return f"<Audit {self._robot}>"

    def write(self, event: Event) -> None:
        """Write one event down, now or, where it repeats itself, with the next :meth:`flush`."""
        if event.who is not None and event.what is not What.REFUSED:
            self._line(event, 1)
            return
        kind = (event.what, event.who, event.command, event.reason)
        if event.what is What.REFUSED and kind not in self._repeated and len(self._repeated) >= KINDS:
            event = Event(What.REFUSED, reason="others")
            kind = (What.REFUSED, None, None, "others")
        if kind in self._repeated:
            self._repeated[kind][1] += 1
        else:
            self._line(event, 1)
            self._repeated[kind] = [event, 0]

    def flush(self) -> None:
        """Write what repeated itself since the last call; to be called about once a second."""
        for event, count in self._repeated.values():
            if count:
                self._line(event, count)
        self._repeated = {kind: [event, 0] for kind, (event, count) in self._repeated.items() if count}

    def _line(self, event: Event, count: int) -> None:
        fields = {
            "time": datetime.fromtimestamp(self._clock_ns() / 1e9, UTC).isoformat(timespec="milliseconds"),
            "robot": self._robot,
            "event": event.what.value,
            "who": event.who,
            "priority": event.priority,
            "command": event.command,
            "reason": event.reason,
            "stops": event.stops or None,
            "count": count if count > 1 else None,
        }
        self._write(json.dumps({name: value for name, value in fields.items() if value is not None}))


class AuditFile:
    """A file that lines are appended to, ``files`` of ``file_bytes`` at most besides the one in use."""

    def __init__(self, path: Path, metrics: Metrics, *, file_bytes: int, files: int) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = RotatingFileHandler(path, maxBytes=file_bytes, backupCount=files, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"control.audit = {str(path)!r}: {error.strerror or error}") from error
        lines: Queue[Any] = Queue(WAITING)
        self._inlet = _Inlet(lines, metrics)
        self._listener: _Outlet | None = _Outlet(lines, self._file)
        self._listener.start()

    def write(self, line: str) -> None:
        """Append a line, soon."""
        self._inlet.handle(logging.makeLogRecord({"msg": line}))

    def close(self) -> None:
        """Write what waits, for a few seconds at most, and close the file; idempotent."""
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.stop()
            self._file.close()


class _Inlet(QueueHandler):
    """Counts what finds no room, instead of printing it."""

    def __init__(self, lines: Queue[Any], metrics: Metrics) -> None:
        super().__init__(lines)
        self._dropped = metrics.count("audit_dropped")

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            self.queue.put_nowait(record)
        except Full:
            self._dropped.value += 1


class _Outlet(QueueListener):
    """Ends when it has written what waits, also where the queue is full."""

    def __init__(self, lines: Queue[Any], file: logging.Handler) -> None:
        super().__init__(lines, file)
        self._lines = lines

    def enqueue_sentinel(self) -> None:
        try:
            self._lines.put(None, timeout=CLOSE_S)  # None is the listener's own sign of the end
        except Full:
            self._lines.get_nowait()
            self._lines.put_nowait(None)
