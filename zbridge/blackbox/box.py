"""The black box of one robot as its gateway uses it: a queue that the disk's thread empties. Never waits for the disk.

All methods but :meth:`BlackBox.log_line` are for the event loop. What finds no room is dropped and counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from zbridge.blackbox.disk_thread import DISK, DiskThread
from zbridge.blackbox.incidents import BoxFolder, IncidentCause
from zbridge.blackbox.segments import LOG, LogLine, Record, SegmentHead
from zbridge.blackbox.settings import SEGMENT_S, BlackBoxSettings
from zbridge.blackbox.spool import Item, Keep, NextSegment, Spool
from zbridge.errors import describe
from zbridge.fleet import payload as payloads
from zbridge.fleet.topics import KeySpace
from zbridge.log import Log, current_robot
from zbridge.metrics import Reading

log = Log("zbridge.blackbox")

QUEUE_BYTES = 1_000_000
"""Messages that may wait for the disk, with what each costs in memory."""
RECORD_BYTES = 150
"""What a message costs in memory besides its payload, about."""
WAKE_BYTES = QUEUE_BYTES // 3
"""The thread begins at once when so much waits."""
ORDERS = 64
"""Orders that may wait."""
STATES = 8
"""No order with all states is added to so many that wait."""
LINES = 500
"""Log lines that may wait."""
TEXT_CHARACTERS = 500
"""Characters of a cause; a longer one is cut."""
LINE_CHARACTERS = 2000
"""Characters of a log line; a longer one is cut."""
SMALL_BYTES = 4096
"""A larger state is repeated in every :data:`LARGE_EVERY`-th segment only."""
LARGE_EVERY = 10
KEEP_S = 1.0
"""Least time between two causes of one code that are noted."""
FRAME_S = 5.0
"""Least time between two recordings of all states for a cause."""
STUCK_S = 5.0
"""Seconds without a completed round after which the disk counts as hung."""
CLOSE_S = 1.0
"""Longest wait for the disk at the end."""

Snapshot = Callable[[], Iterable[tuple[str, bytes]]]
"""Returns keys and payloads of the last value of every state, and of the session table."""


class BlackBox:
    """The black box of one robot, from :meth:`begin` to :meth:`close`.

    about: stored in each segment: versions, and the configuration without secrets. tell: called with what is wrong with
    the box, None when it is right again. died: called with a text if the process before this one did not shut down
    cleanly. alone: whether the process serves no other robot, so that all its log lines are this robot's.
    """

    def __init__(
        self,
        keys: KeySpace,
        folder: Path,
        settings: BlackBoxSettings,
        about: dict[str, Any],
        *,
        tell: Callable[[str | None], object] = lambda text: None,
        died: Callable[[str], object] = lambda text: None,
        alone: bool = True,
        disk: DiskThread = DISK,
    ) -> None:
        self.folder = BoxFolder(folder, keys.realm, keys.robot)
        self.snapshot: Snapshot = tuple
        self.incidents = Counter[str]()
        """Incidents that began, by the code of their first cause."""
        self._keys = keys
        self._about = about
        self._tell = tell
        self._died = died
        self._alone = alone
        self.disk = disk
        self._spool = Spool(self.folder, settings, self._head, self._count)
        self._boot = _boot_id()
        self._waiting: deque[Item] = deque()
        self._lines: deque[Record] = deque(maxlen=LINES)
        self._put_bytes = self._taken_bytes = 0
        self._put_orders = self._taken_orders = 0
        self._lines_lost = 0
        self._full = 0
        """Messages and causes that found no room."""
        self._segments = 0
        self._repeated: dict[str, int] = {}
        """The segment in which a large state was repeated last."""
        self._kept_at: dict[str, float] = {}
        self._framed_at = 0.0
        self._worked_at = 0.0
        """When the thread ended its last round."""
        self._error: str | None = None
        """Why the disk did not take the last round."""
        self._reported: str | None = None
        self._full_before = 0
        """How many had found no room when the current segment began."""
        self._begun = self._ready = self._ending = False
        self._ended = threading.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._handler = _BoxHandler(self)
        self._loop = asyncio.get_running_loop()

    def __repr__(self) -> str:
        return f"<BlackBox {self.folder.path.name} {len(self._waiting)} waiting, {self.lost} lost>"

    @property
    def lost(self) -> int:
        """Messages that were lost so far."""
        return self._full + self._lines_lost + self._spool.unwritten

    def readings(self) -> Iterator[Reading]:
        """Read the metrics."""
        yield "blackbox_bytes", {}, self._spool.bytes
        yield "blackbox_lost", {"reason": "queue"}, self._full + self._lines_lost
        yield "blackbox_lost", {"reason": "disk"}, self._spool.unwritten
        for code, number in dict(self.incidents).items():
            yield "blackbox_incidents", {"code": code}, number
        yield "blackbox_incidents_removed", {}, self._spool.removed

    def begin(self) -> None:
        """Begin to write; idempotent."""
        if not self._begun:
            self._begun = True
            self._worked_at = time.monotonic()
            logging.getLogger().addHandler(self._handler)
            self.disk.add(self._work)
            self._next_segment()
            self.disk.wake()  # from now on, a process that dies is noticed

    def close(self, error: BaseException | None = None) -> None:
        """Write what waits; idempotent. error: the fault by which the gateway ends.

        Waits for :data:`CLOSE_S` at most, and not at all in a process that serves other robots.
        """
        if not self._begun or self._ending:
            return
        logging.getLogger().removeHandler(self._handler)
        if self._timer is not None:
            self._timer.cancel()
        if error is not None:
            self._kept_at.clear()
            self.keep("gateway_died", f"the gateway failed: {describe(error)}")
        self._ending = True
        self.disk.wake()
        if self._alone:
            self._ended.wait(CLOSE_S)

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Record a message, or drop and count it where too much waits."""
        size = len(payload) + RECORD_BYTES
        if attachment is not None:
            size += len(attachment)
        waiting = self._put_bytes - self._taken_bytes
        if waiting > QUEUE_BYTES:
            self._full += 1
            return
        self._put_bytes += size
        self._waiting.append((time.monotonic_ns(), key, payload, attachment))
        if waiting <= WAKE_BYTES < waiting + size:
            self.disk.wake()

    def keep(self, code: str, text: str, *, died: bool = False) -> bool:
        """Keep the minutes before now; return whether the disk will be told to.

        died: the minutes before the last segment of the process before this one.
        """
        now, cause = time.monotonic(), IncidentCause(code, _readable(text, TEXT_CHARACTERS), time.time_ns())
        if not self._begun or now - self._kept_at.get(code, 0.0) < KEEP_S:
            return False
        self._kept_at[code] = now
        if now - self._framed_at < FRAME_S or self._put_orders - self._taken_orders >= STATES:
            return self._order(Keep(cause, died=died))
        try:
            frame = self._records(self.snapshot())
        except Exception:  # a stop may be under way
            log.exception("states_not_kept", "the states of the moment cannot be kept")
            frame = []
        self._framed_at = now
        return self._order(Keep(cause, frame, died)) and self._order(NextSegment(frame))

    def _order(self, order: Keep | NextSegment) -> bool:
        if self._put_orders - self._taken_orders >= ORDERS:
            self._full += 1
            return False
        self._put_orders += 1
        self._put_bytes += RECORD_BYTES
        self._waiting.append(order)
        return True

    def log_line(self, record: logging.LogRecord) -> None:
        """Record a line of the log; from any thread."""
        if not self._alone and current_robot.get() != self._keys.robot:
            return
        text = record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            text += f" ({describe(record.exc_info[1])})"
        event, stamp_ns = getattr(record, "event", None), int(record.created * 1e9)
        text = _readable(text, LINE_CHARACTERS)
        line = LogLine(record.levelname.lower(), record.name, text, event, stamp_ns=stamp_ns)
        self._lines_lost += len(self._lines) == LINES
        self._lines.append((time.monotonic_ns(), self._keys.key(LOG), payloads.encode(line), None))

    # Segments

    def _next_segment(self) -> None:
        self._timer = self._loop.call_later(SEGMENT_S, self._next_segment)
        self._report()
        self._full_before = self._full
        self._segments += 1
        if self._put_bytes - self._taken_bytes <= QUEUE_BYTES and self._put_orders - self._taken_orders < STATES:
            self._order(NextSegment(self._records(filter(self._is_due, self.snapshot()))))

    def _is_due(self, state: tuple[str, bytes]) -> bool:
        key, payload = state
        if len(payload) <= SMALL_BYTES:
            return True
        is_due = self._segments >= self._repeated.get(key, -LARGE_EVERY) + LARGE_EVERY
        if is_due:
            self._repeated[key] = self._segments
        return is_due

    def _records(self, states: Iterable[tuple[str, bytes]]) -> list[Record]:
        now_ns = time.monotonic_ns()
        return [(now_ns, key, payload, None) for key, payload in states]

    def _report(self) -> None:
        """Tell what is wrong now, if that is new."""
        text = self._error
        if time.monotonic() - self._worked_at > STUCK_S and not self._ended.is_set():
            text = "the black box is not written: the disk does not answer"
        elif text is None and self._full > self._full_before:
            text = "the black box loses messages: too many wait for the disk"
        if text == self._reported:
            return
        robot = self._keys.robot
        if self._reported is None:
            log.error("blackbox_not_written", "{robot}: {reason}", robot=robot, reason=text)
        elif text is None:
            template = "{robot}: the black box is written again: {lost} lost"
            log.warning("blackbox_written_again", template, robot=robot, lost=self.lost)
        self._reported = text
        self._tell(text)

    # On the thread

    def _work(self) -> None:
        """Write what waits; one round of the thread."""
        token = current_robot.set(self._keys.robot)
        try:
            self._write()
        except Exception as error:
            log.exception("blackbox_failed", "{robot}: the black box failed, and ends", robot=self._keys.robot)
            self._error = f"the black box failed: {describe(error)}"
            self._end()
        finally:
            current_robot.reset(token)
            if self._error != self._reported:
                self._call(self._report)

    def _end(self) -> None:
        self.disk.remove(self._work)
        self._ended.set()

    def _write(self) -> None:
        ending, spool, now = self._ending, self._spool, time.monotonic()  # read first: what came before is written
        error = None if self._ready else self._open(spool, now)
        lines = [self._lines.popleft() for _ in range(len(self._lines))]
        items = [self._waiting.popleft() for _ in range(len(self._waiting))]
        spool.write(_in_order(lines, items), now)
        self._taken_bytes += sum(map(_size_of, items))
        self._taken_orders += sum(1 for item in items if type(item) is not tuple)
        self._note_dead(spool.died)
        spool.died = []
        self._worked_at = time.monotonic()
        error = error or spool.error
        where = self.folder.path
        self._error = f"the black box is not written: {where}: {error.strerror or error}" if error else None
        if ending:
            spool.close()
            self._end()

    def _open(self, spool: Spool, now: float) -> OSError | None:
        """Begin with what the process before left; return why that failed: then it is tried again."""
        try:
            dead = spool.begin(now, time.time_ns())
        except OSError as error:
            return error
        self._ready = True
        self._note_dead(dead)
        return None

    def _note_dead(self, dead: list[int]) -> None:
        if dead:
            pids = ", ".join(map(str, dead))
            self._call(self._died, f"process {pids} did not shut down cleanly: it crashed, was killed, or lost power")

    def _call(self, function: Callable[..., object], *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function, *arguments)

    def _head(self) -> SegmentHead:
        keys = self._keys
        times = (time.time_ns(), time.monotonic_ns())
        return SegmentHead(keys.realm, keys.robot, self._boot, os.getpid(), *times, self.lost, self._about)

    def _count(self, what: str) -> None:
        self.incidents[what] += 1


class _BoxHandler(logging.Handler):
    """Gives the lines of the log to a black box."""

    def __init__(self, box: BlackBox) -> None:
        super().__init__(logging.INFO)
        self._box = box

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._box.log_line(record)
        except Exception:
            self.handleError(record)


def _in_order(lines: list[Record], items: list[Item]) -> Iterator[Item]:
    """Yield lines of the log at their time between what waited."""
    at = 0
    for item in items:
        while at < len(lines) and type(item) is tuple and lines[at][0] <= item[0]:
            yield lines[at]
            at += 1
        yield item
    yield from lines[at:]


def _size_of(item: Item) -> int:
    if type(item) is tuple:
        return RECORD_BYTES + len(item[2]) + len(item[3] or b"")
    return RECORD_BYTES


def _readable(text: str, most: int) -> str:
    """Cut a text, and replace what is no character: names in keys may hold any bytes."""
    return text[:most].encode(errors="replace").decode()


def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""
