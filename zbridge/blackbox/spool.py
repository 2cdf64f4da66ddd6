"""Writes the black box of one robot: all that touches the disk, and the decision what is kept. No thread, no loop.

Theory of operation. :meth:`Spool.write` gets what came since the call before, in order: records, and orders between
them. Records go to the current segment. A segment ends at :class:`NextSegment`, which brings what the next one begins
with, or when it is large or old. Without an incident the next segment is made in the ring, whose oldest are deleted.

:class:`Keep` begins an incident, unless one is open: the ring's segments are renamed into its folder, and further ones
are made there until :data:`AFTER_S` after the last cause, but no longer than :attr:`Spool.longest_s`. Later causes join
it. What follows has an incident of its own, which names the one with the minutes before.

An OSError while records are written ends the segment, and they are counted. The next call tries again; causes that
could not be noted are kept for it. A full disk costs the oldest segment of the ring at each attempt. What the process
before left open is continued. In a restart two processes write for a moment: segments have different names, causes are
added to what the file says, and the incident that the first one began last is continued when it has left.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from zbridge.blackbox.incidents import BoxFolder, IncidentCause, IncidentInfo, head_of, number_of, segments_of
from zbridge.blackbox.segment_writer import SegmentWriter, sync_folder
from zbridge.blackbox.segments import Record, SegmentHead, read_segment, record_blocks
from zbridge.blackbox.settings import SEGMENT_S, BlackBoxSettings
from zbridge.log import Log

log = Log("zbridge.blackbox")

AFTER_S = 60.0
"""Seconds after the last cause that are kept."""
SEGMENT_BYTES = 8 * 2**20
"""A segment ends at this size."""
PENDING = 64
"""Causes that wait for a disk that fails."""
FRAME = ("status", "control", "@rpc/sessions/gateway")
"""Paths of the messages that ``incident.json`` shows."""
_LATE = 1.5
"""A segment that lasts so many times its time ends by itself: the event loop hangs."""
_FULL = (errno.ENOSPC, errno.EDQUOT)


class NextSegment(msgspec.Struct, frozen=True):
    """The next segment begins, with these records."""

    records: Sequence[Record] = ()


class Keep(msgspec.Struct, frozen=True):
    """Something happened: keep the minutes before. Comes before a :class:`NextSegment` with the state of that moment.

    died: it concerns the process before this one, so the minutes before its last segment are meant.
    """

    cause: IncidentCause
    frame: Sequence[Record] = ()
    died: bool = False


Item = Record | NextSegment | Keep


class Spool:
    """The writer of one robot's folder.

    head: describes a segment that begins now. counted: called with the code of each incident that begins.
    """

    def __init__(
        self,
        folder: BoxFolder,
        settings: BlackBoxSettings,
        head: Callable[[], SegmentHead],
        counted: Callable[[str], object] = lambda what: None,
    ) -> None:
        self.folder = folder
        self.unwritten = 0
        """Records that the disk did not take."""
        self.removed = 0
        """Incidents that were deleted for newer ones."""
        self.incident: IncidentInfo | None = None
        """The one that is open."""
        self.error: OSError | None = None
        """Why the last attempt to write something failed; None: it did not."""
        self.longest_s = settings.minutes * 60 + AFTER_S
        """Most seconds from the first cause of an incident to its end."""
        self._most_made = settings.segments + round(AFTER_S / SEGMENT_S)
        """Most segments of an incident after its first cause: a robot that floods makes large ones in a short time."""
        self._settings = settings
        self._head = head
        self._counted = counted
        self._life: int | None = None
        self._shared = True
        """Whether a process that hands over to this one may still write."""
        self.died: list[int] = []
        """Processes that did not shut down cleanly since :meth:`begin`."""
        self._dead: list[int] = []
        """Of :meth:`begin`, which may fail and be called again."""
        self._before = 0
        """Segments up to this number are of processes before this one; its id may be the same in a container."""
        self._segment = SegmentWriter(head, fsync=settings.fsync)
        self._incident_began = self._until = 0.0
        self._last: str | None = None
        """The incident before, while the ring lacks what it took."""
        self._pending: deque[Keep] = deque()
        self._made = 0
        """Segments that were made in the incident that is open."""

    def __repr__(self) -> str:
        return f"<Spool {self.folder.path} {self._segment!r}, incident {self.incident and self.incident.name}>"

    @property
    def bytes(self) -> int:
        """Written so far."""
        return self._segment.bytes

    def begin(self, now: float, wall_ns: int) -> list[int]:
        """Begin; return the processes before this one that did not shut down cleanly. now: seconds. Raises OSError."""
        self.folder.make()
        self._segment.number = self._before = self.folder.last_number()
        self._dead += self.folder.dead()
        if self._life is None:
            self._life = self.folder.take_life()
        self._adopt(now, wall_ns)
        return self._dead

    def write(self, items: Iterable[Item], now: float) -> None:
        """Write what came; never raises. ``error`` says whether the disk took it."""
        before, self.error, written = self.error, None, self.bytes
        for is_record, group in groupby(items, lambda item: type(item) is tuple):
            if is_record:
                self._attempt_records(group, now)  # type: ignore[arg-type]
            else:
                for order in group:
                    self._take_order(order, now)  # type: ignore[arg-type]
        if self._shared and self._life is not None:
            self._attempt(self._inherit, now)
        if self._pending:
            self._attempt(self._keep_pending, now)
        if self.incident is not None and (
            now >= min(self._until, self._incident_began + self.longest_s) or self._made > self._most_made
        ):
            self._attempt(self._end_incident)
        if self.error is None and self.bytes == written:  # there was nothing to write: that says nothing of the disk
            self.error = before

    def close(self) -> None:
        """End in order; the next process continues an incident that is open, or ends it. Never raises."""
        self._segment.end()
        if self._life is not None:
            self.folder.end_life(self._life)
            self._life = None

    # Segments

    def _attempt(self, work: Callable[..., None], *arguments: Any) -> None:
        try:
            work(*arguments)
        except OSError as error:
            self.error = error
            with contextlib.suppress(OSError, IndexError):
                if error.errno in _FULL:
                    segments_of(self.folder.ring)[0].unlink()
                elif error.errno == errno.ENOENT:
                    self._restore()

    def _restore(self) -> None:
        """Make folders that somebody deleted, and forget an incident that was."""
        self.folder.make()
        if self.incident is not None and not (self.folder.incidents / self.incident.name).exists():
            self.incident = None

    def _take_order(self, order: NextSegment | Keep, now: float) -> None:
        if isinstance(order, Keep):
            if len(self._pending) < PENDING:
                self._pending.append(msgspec.structs.replace(order, frame=()) if self._pending else order)
            self._attempt(self._keep_pending, now)
        else:
            self._segment.end()
            self._attempt_records(iter(order.records), now)

    def _attempt_records(self, records: Iterator[Record], now: float) -> None:
        self._attempt(self._write_records, records, now)
        self.unwritten += sum(1 for _ in records)

    def _write_records(self, records: Iterable[Record], now: float) -> None:
        segment = self._segment
        if segment.is_open and now - segment.began >= _LATE * SEGMENT_S:
            segment.end()
        for count, block in record_blocks(records):
            try:
                if not segment.is_open or segment.size >= SEGMENT_BYTES:
                    self._next_segment(now)
                segment.append(block)
            except OSError:
                self.unwritten += count
                segment.end()
                raise
        segment.sync()

    def _next_segment(self, now: float) -> None:
        self._segment.begin(self._folder, now)
        self._made += 1
        if self.incident is None:
            for old in segments_of(self.folder.ring)[: -self._settings.segments]:
                old.unlink(missing_ok=True)

    @property
    def _folder(self) -> Path:
        """Where segments are made."""
        return self.folder.ring if self.incident is None else self.folder.incidents / self.incident.name

    # Incidents

    def _keep_pending(self, now: float) -> None:
        while self._pending:
            try:
                self._keep(self._pending[0], now)
            except OSError:
                raise
            except Exception:  # one cause that cannot be kept must not hold up all others
                log.exception("cause_not_kept", "a cause cannot be kept: {cause}", cause=self._pending[0].cause)
            self._pending.popleft()

    def _keep(self, order: Keep, now: float) -> None:
        if self.incident is not None and now >= self._incident_began + self.longest_s:
            self._end_incident()
        if self.incident is None:
            self._begin_incident(order, now)
        else:
            joined = self._noted(self.incident).joined(order.cause)
            if joined.more == self.incident.more:
                self.folder.write_info(joined, fsync=self._settings.fsync)
            self.incident = joined
        self._until = now + AFTER_S

    def _begin_incident(self, order: Keep, now: float) -> None:
        folder, cause = self.folder, order.cause
        fresh = self._fresh(order)
        moment = datetime.fromtimestamp(cause.at_ns / 1e9, UTC)
        name = unique = f"{moment:%Y%m%dT%H%M%SZ}-{folder.robot}-{cause.code}"
        for copy in range(2, 1000):
            if not (folder.incidents / unique).exists():
                break
            unique = f"{name}-{copy}"
        before = self._last if not fresh or len(fresh) < self._settings.segments - 1 else None
        info = IncidentInfo(
            unique,
            folder.realm,
            folder.robot,
            self._segment.number,
            (cause,),
            None,
            0,
            before,
            self._frame(order, fresh),
        )
        (folder.incidents / unique).mkdir(mode=0o700)
        try:
            folder.write_info(info, fsync=self._settings.fsync)
        except OSError:
            shutil.rmtree(folder.incidents / unique, ignore_errors=True)
            raise
        self.incident, self._incident_began, self._made = info, now, 0
        self._counted(cause.code)
        text = "{robot}: kept as {name}: {reason}"
        log.warning("incident", text, robot=folder.robot, name=unique, reason=cause.text, code=cause.code)
        for segment in fresh:
            with contextlib.suppress(FileNotFoundError):  # another process, which hands over, deletes some too
                segment.rename(folder.incidents / unique / segment.name)
        if self._settings.fsync:
            sync_folder(folder.incidents / unique)
        for surplus in folder.surplus(self._settings.keep):
            self._attempt(self._remove, surplus)

    def _fresh(self, order: Keep) -> list[Path]:
        """Return the segments of the ring that belong to the minutes before."""
        ring = segments_of(self.folder.ring)
        heads = {path: head_of(path) for path in ring}
        reference: SegmentHead | None = self._head()
        if order.died:
            theirs = [head for path, head in heads.items() if head is not None and number_of(path) <= self._before]
            reference = theirs[-1] if theirs else reference
        most_s = (self._settings.segments + 1) * SEGMENT_S
        return [path for path in ring if _age_s(heads[path], reference) <= most_s]

    def _frame(self, order: Keep, fresh: Sequence[Path]) -> dict[str, Any]:
        """Return what ``incident.json`` shows of the moment: the frame, else the last words on disk."""
        head, records = self._head(), order.frame
        if order.died or not records:
            heads = ((path, head_of(path)) for path in fresh if not order.died or number_of(path) <= self._before)
            known = [(path, each) for path, each in heads if each is not None]
            if known:
                head = known[-1][1]
                records = [record for path, _ in known[-2:] for record in _records_of(path)]
        frame: dict[str, Any] = {"host": os.uname().nodename, "pid": head.pid, "lost": head.lost, **head.about}
        for _, key, payload, _ in records:
            path = key.split("/", 2)[-1]
            if path in FRAME:
                with contextlib.suppress(msgspec.MsgspecError, UnicodeError):
                    frame[path.removeprefix("@rpc/").partition("/")[0]] = msgspec.msgpack.decode(payload)
        return frame

    def _end_incident(self) -> None:
        assert self.incident is not None
        ended_ns = self._head().wall_ns
        info = msgspec.structs.replace(self._noted(self.incident), ended_ns=ended_ns)
        self.folder.write_info(info, fsync=self._settings.fsync)
        self._last, self.incident = self.incident.name, None
        self._segment.end()

    def _noted(self, info: IncidentInfo) -> IncidentInfo:
        """Return an incident with the causes that a process which hands over has noted since."""
        found = self.folder.info(info.name)
        if found is None or len(found.causes) <= len(info.causes):
            return info
        return msgspec.structs.replace(info, causes=found.causes)

    def _inherit(self, now: float) -> None:
        """Adopt what the process that hands over began last, once it has left."""
        self.died += self.folder.dead()
        if not self.folder.others():
            self._shared = False
            self._adopt(now, self._head().wall_ns)

    def _adopt(self, now: float, wall_ns: int) -> None:
        """Continue the newest incident that another process left open, and end all others."""
        own = self.incident.name if self.incident is not None else None
        for info in reversed(self.folder.infos()):
            if info.ended_ns is None and info.name != own:
                self._continue(info, now, wall_ns)

    def _continue(self, info: IncidentInfo, now: float, wall_ns: int) -> None:
        """Continue an incident if it is the newest, and its time is not over; else end it."""
        began_s = (wall_ns - info.began_ns) / 1e9
        since_s = (wall_ns - max(info.causes[-1].at_ns, info.began_ns)) / 1e9
        if self.incident is not None or began_s >= self.longest_s or not 0.0 <= since_s < AFTER_S:
            self.folder.write_info(msgspec.structs.replace(info, ended_ns=wall_ns), fsync=self._settings.fsync)
            self._last = info.name
            return
        self.incident, self._incident_began, self._made = info, now - max(began_s, 0.0), 0
        self._until = now + AFTER_S - since_s

    def _remove(self, name: str) -> None:
        if self.incident is None or name != self.incident.name:
            self.folder.remove(name)
            self.removed += 1
            text = "{robot}: {name} was deleted: keep = {keep}"
            log.warning("incident_removed", text, robot=self.folder.robot, name=name, keep=self._settings.keep)


def _records_of(segment: Path) -> Iterator[Record]:
    for content in read_segment(segment.read_bytes()):
        if isinstance(content, list):
            yield from content


def _age_s(head: SegmentHead | None, reference: SegmentHead | None) -> float:
    """Return how much older a segment is than another one; a damaged one counts as of the same time."""
    if head is None or reference is None:
        return 0.0
    if head.boot == reference.boot:
        return (reference.mono_ns - head.mono_ns) / 1e9
    return (reference.wall_ns - head.wall_ns) / 1e9
