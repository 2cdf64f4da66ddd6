"""Spools on one folder, with a clock of the test's own and processes that only have an id."""

from __future__ import annotations

import errno
import io
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from zbridge.blackbox.incidents import BoxFolder, IncidentCause, IncidentInfo, segments_of
from zbridge.blackbox.reading import Findings, KeptRecord, read_records
from zbridge.blackbox.segments import Record, SegmentHead, head_block, record_blocks
from zbridge.blackbox.settings import SEGMENT_S, BlackBoxSettings
from zbridge.blackbox.spool import Item, Keep, NextSegment, Spool
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Status

S_NS = 1_000_000_000
EPOCH_NS = 1_767_225_600 * S_NS
"""The first second of 2026, UTC."""
STATUS = payloads.encode(Status(state="established", protocol="tcpudp"))


class Scene:
    """The black box of one robot, its clocks, and the disk."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = path
        self.folder = BoxFolder(path, "fleet", "r1")
        self.now = 1000.0
        self.set_s = 0.0
        """By how much the wall clock was set."""
        self.boot = "boot"
        self.booted = 0.0
        self.pid = 0
        monkeypatch.setattr("os.getpid", lambda: self.pid)

    @property
    def wall_ns(self) -> int:
        return EPOCH_NS + int((self.now - 1000.0 + self.set_s) * S_NS)

    @property
    def mono_ns(self) -> int:
        return int((self.now - self.booted) * S_NS)

    def process(self, pid: int = 100, **settings: Any) -> Process:
        return Process(self, pid, BlackBoxSettings(**settings))

    def kept(self, name: str) -> list[str]:
        """Return the payloads of an incident."""
        return texts(segments_of(self.folder.incidents / name))

    @property
    def ring(self) -> list[Path]:
        return segments_of(self.folder.ring)

    @property
    def names(self) -> list[str]:
        return [info.name for info in self.folder.infos()]

    def only_incident(self) -> IncidentInfo:
        (info,) = self.folder.infos()
        return info

    def files(self) -> list[Path]:
        return [path for path in self.folder.path.rglob("*") if path.is_file()]


class Process:
    """A process that writes the black box; each of its steps is done under its id."""

    def __init__(self, scene: Scene, pid: int, settings: BlackBoxSettings) -> None:
        self.scene = scene
        self.pid = pid
        self.lost = 0
        self.counts = Counter[str]()
        self.spool = Spool(scene.folder, settings, self._head, lambda what: self.counts.update([what]))

    def _head(self) -> SegmentHead:
        mono_ns = self.scene.mono_ns
        about = {"versions": {"zbridge": f"of {self.pid}"}, "configuration": {"robot": "r1"}}
        return SegmentHead("fleet", "r1", self.scene.boot, self.pid, self.scene.wall_ns, mono_ns, self.lost, about)

    def begin(self) -> list[int]:
        self.scene.pid = self.pid
        return self.spool.begin(self.scene.now, self.scene.wall_ns)

    def write(self, *items: Item) -> None:
        self.scene.pid = self.pid
        self.spool.write(items, self.scene.now)

    def record(self, text: str | bytes, path: str = "debug") -> Record:
        payload = text.encode() if isinstance(text, str) else text
        return (self.scene.mono_ns, f"fleet/r1/{path}", payload, None)

    def say(self, *texts: str | bytes) -> None:
        self.write(*map(self.record, texts))

    def keep(self, code: str = "deadman", *, frame: Sequence[Record] = (), died: bool = False) -> None:
        self.write(Keep(IncidentCause(code, f"why {code}", self.scene.wall_ns), frame, died))

    def run(self, seconds: float, text: str = "{now:.0f}") -> None:
        """Let time pass: each segment has one message, which says when it came."""
        end = self.scene.now + seconds
        while self.scene.now < end:
            self.write()
            self.write(NextSegment((self.record(STATUS, "status"),)), self.record(text.format(now=self.scene.now)))
            self.scene.now += SEGMENT_S
        self.scene.now = end
        self.write()

    def end(self) -> None:
        self.scene.pid = self.pid
        self.spool.close()

    def die(self) -> None:
        """End without an orderly shutdown: the lock goes, the file stays."""
        self.end()
        (self.scene.folder.live / str(self.pid)).touch()


class Disk:
    """Fails as it is told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._write, self._open, self._mkdir = os.write, os.open, os.mkdir
        self.room: int | None = None
        """Bytes that are free; None: enough."""
        self.fault: int | None = None
        """errno of whatever makes a file or a folder."""
        monkeypatch.setattr("os.write", self.write)
        monkeypatch.setattr("os.open", self.open)
        monkeypatch.setattr("os.mkdir", self.mkdir)
        monkeypatch.setattr("os.fdopen", self.fdopen)

    def write(self, descriptor: int, data: bytes | memoryview) -> int:
        if self.room is None:
            return self._write(descriptor, data)
        if not self.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = self._write(descriptor, data[: self.room])
        self.room -= written
        return written

    def open(self, path: Any, flags: int, *more: Any, **named: Any) -> int:
        if self.fault is not None and flags & os.O_CREAT:
            raise OSError(self.fault, os.strerror(self.fault), str(path))
        return self._open(path, flags, *more, **named)

    def fdopen(self, descriptor: int, mode: str) -> io.RawIOBase:
        file = io.FileIO(descriptor, mode)
        if self.room is not None:
            file.write = lambda data: self.write(descriptor, data)  # type: ignore[method-assign]
        return file

    def mkdir(self, path: Any, *more: Any, **named: Any) -> None:
        if self.fault is not None and not os.path.exists(path):
            raise OSError(self.fault, os.strerror(self.fault), str(path))
        self._mkdir(path, *more, **named)


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(tmp_path, monkeypatch)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def messages(segments: Sequence[Path], findings: Findings | None = None) -> list[KeptRecord]:
    """Read segments, without the states that each begins with."""
    records = read_records(list(segments), findings or Findings())
    return [record for record in records if not record.key.endswith("/status")]


def texts(segments: Sequence[Path]) -> list[str]:
    return [record.payload.decode() for record in messages(segments)]


def segment(*records: Record, head: SegmentHead | None = None) -> bytes:
    """Make the bytes of a segment, each record in a block of its own."""
    head = head or SegmentHead("fleet", "r1", "boot", 100, EPOCH_NS, 0)
    return head_block(head) + b"".join(block for record in records for _, block in record_blocks([record]))
