"""Writes one segment after the other; a block is written whole, or nothing of it. All calls may raise OSError."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from zbridge.blackbox.segments import SUFFIX, SegmentHead, head_block

_ATTEMPTS = 100
"""Numbers that are tried: another process, which hands over, may use some too."""


class SegmentWriter:
    """The segment that is being written. head: describes one that begins now. fsync: wait for the disk."""

    def __init__(self, head: Callable[[], SegmentHead], *, fsync: bool) -> None:
        self.bytes = 0
        """Written so far, to all segments."""
        self.number = 0
        """Of the segment; segments rise in number."""
        self.size = 0
        self.began = 0.0
        self._head = head
        self._fsync = fsync
        self._descriptor: int | None = None

    def __repr__(self) -> str:
        return f"<SegmentWriter {self.number}, {self.size} bytes>"

    @property
    def is_open(self) -> bool:
        """Whether there is a segment."""
        return self._descriptor is not None

    def begin(self, folder: Path, now: float) -> None:
        """Make the next segment in a folder. now: seconds."""
        self.end()
        for _ in range(_ATTEMPTS):
            self.number += 1
            path = folder / f"{self.number:010d}{SUFFIX}"
            with contextlib.suppress(FileExistsError):
                self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
                break
        else:
            raise OSError(errno.EEXIST, f"no free number after {self.number}")
        self.size, self.began = 0, now
        try:
            self.append(head_block(self._head()))
        except OSError:
            path.unlink(missing_ok=True)
            raise
        if self._fsync:
            sync_folder(folder)

    def append(self, block: bytes) -> None:
        """Write a block."""
        assert self._descriptor is not None
        rest = memoryview(block)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.size)
            raise
        self.size += len(block)
        self.bytes += len(block)

    def sync(self) -> None:
        """Wait for the disk, where that is wanted."""
        if self._fsync and self._descriptor is not None:
            os.fdatasync(self._descriptor)

    def end(self) -> None:
        """Close the segment; idempotent. Never raises."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
