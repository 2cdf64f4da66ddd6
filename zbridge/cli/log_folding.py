"""Writes a repeated warning once, and later its count. Works without further records: a timer thread writes counts.

Theory of operation. A record of WARNING or above is written at once, and opens a window of :data:`FOLD_S` for its kind:
logger, level, event, robot and :data:`SUBJECTS`, a peer without its port. Further ones are counted. When the
window is over, the last of them is written with the count, and the next window begins; a window without a count just
ends. The thread runs only while something is counted, and takes no signals of the process. :meth:`LogHandler.close`,
which ``logging.shutdown`` calls at the exit, writes what is still counted.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import TextIO

import msgspec

from zbridge.cli.log_lines import plain
from zbridge.errors import describe
from zbridge.log import Log, current_robot

log = Log("zbridge.cli")

FOLD_S = 10.0
"""Seconds of a window."""
POLL_S = 1.0
"""Longest wait of the timer thread: an older window may meanwhile get its first count."""
KEYS = 256
"""Most kinds that are counted apart; all others share one window for each event."""
SUBJECTS = ("session", "peer", "file", "pid", "reason", "error", "warning", "violation")
"""Fields that tell two records of one event apart."""
_PORT = re.compile(r":\d+$")
_KEY_CHARACTERS = 200

Key = tuple[str, ...]
_EVENT = 3
"""Parts of a key that say what happened; the others say to whom."""
_OTHERS: Key = ()


class _Window(msgspec.Struct):
    """One kind. last: the record that was counted last."""

    since: float
    count: int = 0
    last: logging.LogRecord | None = None


class WarningFolds:
    """Decides which records are written, and what is told of the others. Sans-IO."""

    def __init__(self) -> None:
        self._windows: dict[Key, _Window] = {}

    def __repr__(self) -> str:
        return f"<WarningFolds of {len(self._windows)} kinds>"

    @property
    def deadline(self) -> float | None:
        """When the next count must be written; None: nothing is counted."""
        return min((window.since + FOLD_S for window in self._windows.values() if window.count), default=None)

    def admit(self, record: logging.LogRecord, now: float) -> bool:
        """Return whether a record is to be written now; otherwise it is counted. Call :meth:`due` before."""
        key = _key(record)
        wider = ((key, KEYS), (key[:_EVENT], 2 * KEYS), (_OTHERS, math.inf))
        key = next(each for each, most in wider if each in self._windows or len(self._windows) < most)
        window = self._windows.get(key)
        if window is None:
            self._windows[key] = _Window(now)
            return True
        window.count += 1
        window.last = _snapshot(record)
        return False

    def due(self, now: float, *, all_of_them: bool = False) -> list[logging.LogRecord]:
        """Return the records whose windows are over, with ``repeated``, their count, and ``repeated_s``, its time."""
        over = [key for key, each in self._windows.items() if all_of_them or now - each.since >= FOLD_S]
        written = []
        for key in over:
            window = self._windows.pop(key)
            if window.last is not None:
                self._windows[key] = _Window(now)
                window.last.__dict__.update(repeated=window.count, repeated_s=now - window.since)
                written.append(window.last)
        return written


class LogHandler(logging.StreamHandler[TextIO]):
    """Writes the log of a process to a stream, repeated warnings folded. robot: whose log it is, if it is one's."""

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self.robot = ""
        self._clock = clock
        self._folds = WarningFolds()
        self._timer: threading.Thread | None = None
        self._closing = threading.Event()

    def __repr__(self) -> str:
        return f"<LogHandler {self._folds!r}>"

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it. The handler's lock is held."""
        try:
            fields: Mapping[str, object] = getattr(record, "fields", {})
            record.__dict__["robot"] = fields.get("robot") or current_robot.get() or self.robot
            if record.levelno >= logging.WARNING:
                now = self._clock()
                for each in self._folds.due(now):
                    super().emit(each)
                if not self._closing.is_set() and not self._folds.admit(record, now):
                    self._start_timer()
                    return
        except Exception:  # what a field is may raise whatever it wants
            self.handleError(record)
        else:
            super().emit(record)

    def close(self) -> None:
        """Write all counts; idempotent. Records that follow are still written, and repeated ones no longer counted."""
        self._closing.set()
        self._write_counts(all_of_them=True)
        super().close()

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the library's name
        """Write that a record could not be written, and why; nothing if the stream takes nothing."""
        error = sys.exc_info()[1]
        if error is None or isinstance(error, OSError) or getattr(record, "event", "") == "record_unreadable":
            return
        template = "a record of {logger} cannot be written: {error}"
        reason = describe(error)
        super().emit(log.record(logging.ERROR, "record_unreadable", template, logger=record.name, error=reason))

    def _write_counts(self, *, all_of_them: bool = False) -> float | None:
        """Write the counts of windows that are over; return when the next one is."""
        self.acquire()
        try:
            for record in self._folds.due(self._clock(), all_of_them=all_of_them):
                super().emit(record)
            if self._folds.deadline is None:
                self._timer = None
            return self._folds.deadline
        finally:
            self.release()

    def _start_timer(self) -> None:
        if self._timer is None and not self._closing.is_set():
            timer = threading.Thread(target=self._run_timer, name="zbridge-log", daemon=True)
            with contextlib.suppress(RuntimeError):  # no thread to be had: the next warning tries again
                timer.start()
                self._timer = timer

    def _run_timer(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # the main thread waits for them
        deadline = self._write_counts()
        while deadline is not None and not self._closing.wait(min(max(0.0, deadline - self._clock()), POLL_S)):
            deadline = self._write_counts()


def _key(record: logging.LogRecord) -> Key:
    """Return what two records have in common that are one to people."""
    fields: Mapping[str, object] = getattr(record, "fields", {})
    subjects = (_PORT.sub("", str(fields[name])) if name in fields else "" for name in SUBJECTS)
    what = getattr(record, "event", None) or (record.getMessage() if record.msg == "%s" else str(record.msg))
    error = describe(record.exc_info[1]) if record.exc_info and record.exc_info[1] is not None else ""
    parts = (record.name, record.levelname, what, str(getattr(record, "robot", "")), error, *subjects)
    return tuple(part[:_KEY_CHARACTERS] for part in parts)


def _snapshot(record: logging.LogRecord) -> logging.LogRecord:
    """Copy a record as it reads now: without its traceback, and without what its fields refer to."""
    copy = logging.makeLogRecord(record.__dict__)
    fields: Mapping[str, object] = getattr(record, "fields", {})
    copy.__dict__.update(msg=record.getMessage(), args=None, exc_info=None, exc_text=None)
    copy.__dict__.update(fields={name: plain(value) for name, value in fields.items() if value is not None})
    return copy
