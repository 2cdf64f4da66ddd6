"""The audit log: who acquired, released, was refused, stopped the robot, and why. JSON lines, rotated, never rewritten.

Lines are written by a thread of their own: a disk that stands still delays no stop.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path
from queue import Full, Queue
from typing import Any

from zbridge.errors import ConfigError
from zbridge.metrics import Count, Metrics
from zbridge.session.control import Event, What

CLOSE_S = 1.0
"""Longest time the disk is given at the end, twice."""
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
        self._dropped = metrics.count("audit_dropped")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _File(path, self._dropped, file_bytes=file_bytes, files=files)
        except OSError as error:
            raise ConfigError(f"control.audit = {str(path)!r}: {error.strerror or error}") from error
        self._lines: Queue[logging.LogRecord | None] = Queue(WAITING)
        self._writer = threading.Thread(target=self._work, name="zbridge-audit", daemon=True)
        self._writer.start()

    def write(self, line: str) -> None:
        """Append a line, soon."""
        try:
            self._lines.put_nowait(logging.makeLogRecord({"msg": line}))
        except Full:
            self._dropped.value += 1

    def close(self) -> None:
        """Write what waits, for :data:`CLOSE_S` at most, and close the file; idempotent."""
        if self._file.abandoned:
            return
        try:
            self._lines.put(None, timeout=CLOSE_S)
        except Full:
            self._lines.get_nowait()
            self._dropped.value += 1
            self._lines.put_nowait(None)
        self._writer.join(CLOSE_S)
        if self._writer.is_alive():
            self._dropped.value += self._lines.qsize() - 1
        self._file.abandoned = True

    def _work(self) -> None:
        while (record := self._lines.get()) is not None:
            self._file.emit(record)
        self._file.finish()


class _File(RotatingFileHandler):
    """Counts what the disk does not take; abandoned, it keeps nobody waiting for a disk that stands still."""

    def __init__(self, path: Path, dropped: Count, *, file_bytes: int, files: int) -> None:
        super().__init__(path, maxBytes=file_bytes, backupCount=files, encoding="utf-8")
        self.abandoned = False
        self._dropped = dropped

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the library's name
        self._dropped.value += 1

    def finish(self) -> None:
        """Close the file, by the thread that writes it."""
        super().close()

    def flush(self) -> None:
        if not self.abandoned:
            super().flush()

    def close(self) -> None:
        if not self.abandoned:
            super().close()
