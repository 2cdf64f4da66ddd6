"""The audit log: who acquired, released, was refused, stopped the robot, and why. JSON lines, rotated, never rewritten.

Repeated events are folded, so that a flood neither fills the disk nor rotates older lines away:

- The first of equal events (kind, who, command, reason) is a line; the others are one line a second with their count.
- An actor whose events differ has :data:`BURST` lines for each kind of event, then a share of one line a second. The
  rest of its events is counted together, as ``others``. Beyond :data:`ACTORS` actors at a time, new ones share one
  budget, because an actor may take any name. Each kind of event has its own budgets: no flood hides another kind.
- Lines with counts have a budget too (:data:`COUNTS`); when it is used up, counting continues and is written later.

A thread of its own writes the lines: a disk that hangs delays no stop. Lines that cannot be written wait, and the
gateway's status says so.
"""

from __future__ import annotations

import errno
import os
import queue
import stat
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from zbridge.control.events import AuthorityEvent, EventKind
from zbridge.errors import ConfigError
from zbridge.fleet.printable import as_json
from zbridge.log import Log
from zbridge.metrics import Metrics

log = Log("zbridge.control")

CLOSE_S = 1.0
"""Longest wait for the disk at the end, seconds; it is waited for twice."""
RETRY_S = 1.0
"""Seconds between two attempts to write what could not be written."""
WAITING = 4096
"""Lines that may wait for the disk; more are dropped and counted."""
KINDS = 256
"""Different events that are counted separately at a time; more are counted as others."""
ACTORS = 64
"""Actors that have a budget of their own at a time, for each kind of event."""
BURST = 20.0
"""Lines of one kind of event that an actor has at once."""
COUNTS = 200.0
"""Lines with counts that may be written at once; then :data:`COUNTS_HZ` a second."""
COUNTS_HZ = 0.5
LINES_HZ = 1.0
"""Lines a second of one kind of event that its actors share when their bursts are used up."""
MOST = 20
"""The most files there are, as a multiple of ``audit_files``, however young they are."""
OTHERS = "others"
_DAY_S = 86_400.0
_MAY_PASS = (errno.ENXIO, errno.ENOSPC, errno.EDQUOT, errno.EIO)
"""Errors of opening a file that may pass: a pipe that nobody reads, a full disk."""

_Kind = tuple[EventKind, str | None, str | None, str | None, bool]


class _Folded(msgspec.Struct):
    """An event that was written, and how often it happened since."""

    event: AuthorityEvent
    count: int = 0


class Audit:
    """Writes events by ``write`` and to the gateway's log; :meth:`flush` must be called about once a second."""

    def __init__(self, robot: str, write: Callable[[str], None], clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._robot = robot
        self._write = write
        self._clock_ns = clock_ns
        self._folded: dict[_Kind, _Folded] = {}
        self._budgets: dict[EventKind, dict[str | None, float]] = {what: {} for what in EventKind}
        self._strangers = dict.fromkeys(EventKind, BURST)
        self._counts = COUNTS

    def __repr__(self) -> str:
        return f"<Audit {self._robot}>"

    def write(self, event: AuthorityEvent) -> None:
        """Write one event, or count it for the next :meth:`flush` if it repeats itself or comes too often."""
        kind = (event.what, event.who, event.command, event.reason, event.stops)
        folded = self._folded.get(kind)
        if folded is not None:
            folded.count += 1
        elif len(self._folded) < KINDS and self._affords(event):
            self._line(event, 1)
            self._folded[kind] = _Folded(event)
        else:
            who = event.who if event.who in self._budgets[event.what] else None
            others = AuthorityEvent(event.what, who, OTHERS, stops=event.stops)
            self._folded.setdefault((event.what, who, None, OTHERS, event.stops), _Folded(others)).count += 1

    def flush(self) -> None:
        """Write what was counted since the last call, and refill the budgets."""
        self._counts = min(COUNTS, self._counts + COUNTS_HZ)
        for what, budgets in self._budgets.items():
            share = LINES_HZ / (len(budgets) + 1)
            filled = {who: left + share for who, left in budgets.items()}
            self._budgets[what] = {who: left for who, left in filled.items() if left < BURST}
            self._strangers[what] = min(BURST, self._strangers[what] + share)
        waiting, written = dict[_Kind, _Folded](), dict[_Kind, _Folded]()
        for kind, folded in self._folded.items():
            if folded.count and self._counts < 1:
                waiting[kind] = folded
            elif folded.count:
                self._counts -= 1
                self._line(folded.event, folded.count)
                written[kind] = _Folded(folded.event)
        self._folded = waiting | written  # those that had to wait are first the next time

    def close(self) -> None:
        """Write all that was counted."""
        self._counts = float(len(self._folded))
        self.flush()

    def _affords(self, event: AuthorityEvent) -> bool:
        """Return whether the actor may have another line, and take it off its budget."""
        budgets = self._budgets[event.what]
        left = budgets.get(event.who, BURST)
        if event.who not in budgets and len(budgets) >= ACTORS:
            left = self._strangers[event.what]
            self._strangers[event.what] -= left >= 1
        elif left >= 1:
            budgets[event.who] = left - 1
        return left >= 1

    def _line(self, event: AuthorityEvent, count: int) -> None:
        if event.what is not EventKind.REFUSED:
            log.info(
                "authority_changed",
                "{robot}: {what}{times}",
                robot=self._robot,
                what=event,
                times=f", {count} times" if count > 1 else "",
                kind=event.what.value,
                who=event.who,
                count=count,
            )
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
        self._write(as_json({name: value for name, value in fields.items() if value is not None}))


class AuditFile:
    """Appends lines to a file by a thread; see :class:`_Appended` for its rotation.

    ``tell`` is called on that thread with the reason when lines cannot be written, and with None when they can again.
    """

    def __init__(
        self,
        path: Path,
        metrics: Metrics,
        *,
        file_bytes: int,
        files: int,
        days: float = 0.0,
        tell: Callable[[str | None], object] = lambda text: None,
    ) -> None:
        self._dropped = metrics.count("audit_lines_dropped")
        self._failed = metrics.count("audit_write_failures")
        self._tell = tell
        self._path = path
        self._failing = False
        self._ending = threading.Event()
        self._closed = False
        self._file = _Appended(path, file_bytes=file_bytes, files=files, days=days)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file.open()
        except OSError as error:
            if error.errno not in _MAY_PASS:
                raise ConfigError(f"control.audit = {str(path)!r}: {error.strerror or error}") from error
            self._fail(error)
        self._lines: queue.Queue[bytes | None] = queue.Queue(WAITING)
        self._writer = threading.Thread(target=self._work, name="zbridge-audit", daemon=True)
        self._writer.start()

    def write(self, line: str) -> None:
        """Append a line soon; drop and count it if too many wait."""
        try:
            self._lines.put_nowait(line.encode() + b"\n")
        except queue.Full:
            self._dropped.value += 1

    def close(self) -> None:
        """Write what waits, for :data:`CLOSE_S` at most, and close the file; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._ending.set()
        try:
            self._lines.put(None, timeout=CLOSE_S)
        except queue.Full:
            self._lines.get_nowait()
            self._dropped.value += 1
            self._lines.put_nowait(None)
        self._writer.join(CLOSE_S)
        if self._writer.is_alive():
            self._dropped.value += self._lines.qsize() - 1

    def _work(self) -> None:
        if self._failing:
            self._insist(self._file.open)
        while (line := self._lines.get()) is not None:
            self._file.take(line)
            if not self._insist(self._file.write):
                self._dropped.value += 1
        self._file.close()

    def _insist(self, do: Callable[[], None]) -> bool:
        """Try until it succeeds, at the end of the gateway only once; return whether it did."""
        while True:
            try:
                do()
            except OSError as error:
                self._fail(error)
            else:
                self._recover()
                return True
            if self._ending.wait(RETRY_S):
                return False

    def _fail(self, error: OSError) -> None:
        self._failed.value += 1
        if not self._failing:
            self._failing = True
            why = f"the audit log is not written: {error.strerror or error}"
            log.error("audit_not_written", "{reason} ({file})", reason=why, file=self._path)
            self._tell(why)

    def _recover(self) -> None:
        if self._failing:
            self._failing = False
            text = "the audit log is written again, {dropped} lines were dropped ({file})"
            log.warning("audit_written_again", text, dropped=self._dropped.value, file=self._path)
            self._tell(None)


class _Appended:
    """The file in use, and older files beside it; ``.1`` is the youngest of them.

    A file that reaches ``file_bytes`` becomes an older file. The oldest is deleted when there are more than ``files``
    and it is older than ``days``, or when there are :data:`MOST` times as many.

    After :meth:`take`, call :meth:`write` until it raises no OSError.
    """

    def __init__(self, path: Path, *, file_bytes: int, files: int, days: float) -> None:
        self._path = path
        self._file_bytes = file_bytes
        self._files = files
        self._days = days
        self._descriptor: int | None = None
        self._rotates = False
        self._line = self._rest = b""

    def open(self) -> None:
        """Open the file if it is not open; do not wait, not even for the reader of a pipe."""
        if self._descriptor is None:
            descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK, 0o666)
            os.set_blocking(descriptor, True)
            self._descriptor = descriptor
            self._rotates = stat.S_ISREG(os.fstat(descriptor).st_mode)

    def take(self, line: bytes) -> None:
        """Set the line to write next."""
        self._line = self._rest = line

    def write(self) -> None:
        """Write the line, or the rest of it; raise OSError if that is not possible now."""
        try:
            self.open()
            if self._rest is self._line:
                self._rotate_before(len(self._line))
            while self._rest:
                assert self._descriptor is not None
                self._rest = self._rest[os.write(self._descriptor, self._rest) :]
        except OSError:
            if not self._rotates:  # the next reader of a pipe has not seen the beginning
                self._rest = self._line
            self.close()
            raise

    def close(self) -> None:
        """Close the file; idempotent."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _rotate_before(self, size: int) -> None:
        assert self._descriptor is not None
        used = os.fstat(self._descriptor).st_size
        if not self._rotates or not used or used + size <= self._file_bytes:
            return
        self.close()
        last = 0
        while self._older(last + 1).exists():
            last += 1
        while last >= self._files and (last >= MOST * self._files or self._age_days(last) > self._days):
            self._older(last).unlink()
            last -= 1
        for number in range(last, -1, -1):
            self._older(number).rename(self._older(number + 1))
        self.open()

    def _older(self, number: int) -> Path:
        return self._path.with_name(f"{self._path.name}.{number}") if number else self._path

    def _age_days(self, number: int) -> float:
        return (time.time() - self._older(number).stat().st_mtime) / _DAY_S
