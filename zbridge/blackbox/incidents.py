"""The files of one robot's black box: the ring, the incidents, and which processes write them.

=============================  ========================================================================================
``ring/0000000012.zbb``        the last segments, by running number
``incidents/<name>/``          what was kept: segments, and ``incident.json`` with causes and freeze frame
``live/<pid>``                 of a process that writes; locked while it lives, deleted when it ends in order
=============================  ========================================================================================

All calls may wait for the disk, and raise OSError.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec

from zbridge.blackbox.segments import SUFFIX, SegmentHead, read_head

INFO = "incident.json"
CAUSES = 64
"""Causes of an incident that are listed; further ones are counted."""
_HEAD_BYTES = 64 * 1024
_INFO_BYTES = 4 * 2**20
_SEGMENT = re.compile(rf"\d{{10}}{re.escape(SUFFIX)}")
_NAME = re.compile(r"[A-Za-z0-9_.-]+")


class IncidentCause(msgspec.Struct, frozen=True):
    """Why something was kept. code: of the fault, or ``mark``. at_ns: Unix time."""

    code: str
    text: str
    at_ns: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class IncidentInfo(msgspec.Struct, frozen=True):
    """``incident.json``.

    number: rises from incident to incident. ended_ns: when the last segment was kept; None: it is still being written.
    more: causes beyond those listed. before: the incident that has the minutes before, if another one took them.
    frame: ``status``, ``control``, session table, versions and configuration at the time of the first cause.
    """

    name: str
    realm: str
    robot: str
    number: int
    causes: Annotated[tuple[IncidentCause, ...], msgspec.Meta(min_length=1)]
    ended_ns: int | None = None
    more: int = 0
    before: str | None = None
    frame: dict[str, Any] = {}

    @property
    def began_ns(self) -> int:
        """When the first cause was noted, Unix time."""
        return self.causes[0].at_ns

    def joined(self, cause: IncidentCause) -> IncidentInfo:
        """Return it with one more cause."""
        if len(self.causes) >= CAUSES:
            return msgspec.structs.replace(self, more=self.more + 1)
        return msgspec.structs.replace(self, causes=(*self.causes, cause))


_decode_info = msgspec.json.Decoder(IncidentInfo).decode


def is_incident_name(name: str) -> bool:
    """Return whether a text can be the name of an incident: it is no path."""
    return _NAME.fullmatch(name) is not None and name.strip(".") != ""


class BoxFolder:
    """The files of one robot below the folder of all black boxes."""

    def __init__(self, folder: Path, realm: str, robot: str) -> None:
        self.realm = realm
        self.robot = robot
        self.path = folder / f"{realm}@{robot}"
        self.ring = self.path / "ring"
        self.incidents = self.path / "incidents"
        self.live = self.path / "live"

    def __repr__(self) -> str:
        return f"<BoxFolder {self.path}>"

    def make(self) -> None:
        """Make the folders; only their owner may read them: commands and configurations are in them."""
        for folder in (self.ring, self.incidents, self.live):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def last_number(self) -> int:
        """Return the number of the newest segment of all; 0 if there is none."""
        folders = (self.ring, *self._incident_folders())
        return max((number_of(path) for folder in folders for path in segments_of(folder)), default=0)

    def infos(self) -> list[IncidentInfo]:
        """Return the incidents that can be read, oldest first."""
        found = (self.info(folder.name) for folder in self._incident_folders())
        return sorted((info for info in found if info is not None), key=lambda info: info.number)

    def info(self, name: str) -> IncidentInfo | None:
        """Return what is known of an incident; None if there is none, or its file is damaged."""
        try:
            with (self.incidents / name / INFO).open("rb") as file:
                return msgspec.structs.replace(_decode_info(file.read(_INFO_BYTES)), name=name)
        except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError):
            return None

    def write_info(self, info: IncidentInfo, *, fsync: bool = False) -> None:
        """Replace ``incident.json``."""
        folder = self.incidents / info.name
        descriptor, temporary = tempfile.mkstemp(prefix=".", dir=folder)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.format(msgspec.json.encode(info), indent=1) + b"\n")
                file.flush()
                if fsync:
                    os.fsync(file.fileno())
            os.replace(temporary, folder / INFO)
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise

    def parts(self, name: str) -> list[Path]:
        """Return the files of an incident: the description, and the segments in order."""
        folder = self.incidents / name
        info = [folder / INFO] if (folder / INFO).exists() else []
        return info + segments_of(folder)

    def remove(self, name: str) -> None:
        """Delete an incident."""
        shutil.rmtree(self.incidents / name)

    def surplus(self, keep: int) -> list[str]:
        """Return the names of incidents beyond ``keep``: damaged ones, then the oldest of the most frequent code.

        So a cause that comes again and again makes way for a rare one.
        """
        known = self.infos()
        names = {info.name for info in known}
        damaged = [folder.name for folder in self._incident_folders() if folder.name not in names]
        count = max(0, len(damaged) + len(known) - keep)
        surplus = damaged[:count]
        while len(surplus) < count:
            codes = Counter(info.causes[0].code for info in known)
            oldest = next(info for info in known if codes[info.causes[0].code] == max(codes.values()))
            known.remove(oldest)
            surplus.append(oldest.name)
        return surplus

    def _incident_folders(self) -> list[Path]:
        with contextlib.suppress(FileNotFoundError):
            return sorted(path for path in self.incidents.iterdir() if path.is_dir())
        return []

    # The processes that write

    def is_live(self) -> bool:
        """Return whether a process writes."""
        with contextlib.suppress(FileNotFoundError):
            return any(map(_is_locked, self.live.iterdir()))
        return False

    def dead(self) -> list[int]:
        """Return the ids of processes that did not shut down cleanly, and forget them."""
        found = []
        for path in sorted(self.live.iterdir()):
            with contextlib.suppress(OSError), path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
                found += [int(path.name)] if path.name.isdecimal() else []
        return found

    def others(self) -> bool:
        """Return whether other processes write."""
        return any(path.name != str(os.getpid()) for path in self.live.iterdir())

    def take_life(self) -> int:
        """Lock a file that shows that this process writes; return its descriptor."""
        path = self.live / str(os.getpid())
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    def end_life(self, descriptor: int) -> None:
        """Show that this process has ended in order."""
        with contextlib.suppress(OSError):
            (self.live / str(os.getpid())).unlink()
        os.close(descriptor)


def boxes(folder: Path) -> Iterator[BoxFolder]:
    """Yield the black boxes below the folder of all."""
    with contextlib.suppress(FileNotFoundError):
        for path in sorted(folder.iterdir()):
            realm, at, robot = path.name.partition("@")
            if at and path.is_dir():
                yield BoxFolder(folder, realm, robot)


def _is_locked(path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    return False


def segments_of(folder: Path) -> list[Path]:
    """Return the segments of a folder in order."""
    with contextlib.suppress(FileNotFoundError):
        return sorted(folder / name for name in os.listdir(folder) if _SEGMENT.fullmatch(name))
    return []


def number_of(segment: Path) -> int:
    """Return the running number of a segment."""
    return int(segment.name[: -len(SUFFIX)])


def head_of(segment: Path) -> SegmentHead | None:
    """Read the head of a segment; None if it is damaged."""
    try:
        with segment.open("rb") as file:
            return read_head(file.read(_HEAD_BYTES))
    except OSError:
        return None
