"""What a test finds in the black box of a robot, on its disk."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import msgpack

from zbridge.blackbox import BoxFolder, IncidentInfo
from zbridge.blackbox.incidents import segments_of
from zbridge.blackbox.reading import Findings, KeptRecord, read_records


class Box:
    """The files of one robot's black box."""

    def __init__(self, folder: Path, robot: str = "r1") -> None:
        self.folder = BoxFolder(folder, "fleet", robot)

    @property
    def incidents(self) -> list[IncidentInfo]:
        """Its incidents, oldest first."""
        return self.folder.infos()

    @property
    def codes(self) -> list[list[str]]:
        """The causes of each incident."""
        return [[cause.code for cause in info.causes] for info in self.incidents]

    @property
    def alive(self) -> list[str]:
        """The processes that have not taken leave."""
        return sorted(path.name for path in self.folder.live.iterdir())

    def ring(self) -> Kept:
        """Read the ring."""
        return self._read(self.folder.ring)

    def kept(self, info: IncidentInfo) -> Kept:
        """Read an incident."""
        return self._read(self.folder.incidents / info.name)

    def _read(self, folder: Path) -> Kept:
        while True:
            with contextlib.suppress(FileNotFoundError):  # a segment is renamed, or deleted, meanwhile
                return Kept(segments_of(folder), self.folder.robot)


class Kept:
    """The records of one robot, and the heads of the segments that they come from."""

    def __init__(self, segments: list[Path], robot: str) -> None:
        self.findings = Findings()
        self.records: list[KeptRecord] = list(read_records(segments, self.findings))
        self._prefix = f"fleet/{robot}/"

    def of(self, path: str) -> list[KeptRecord]:
        """The records of one key."""
        return [record for record in self.records if record.key == self._prefix + path]

    def messages(self, path: str) -> list[dict[str, Any]]:
        """The messages of one key."""
        return [msgpack.unpackb(record.payload) for record in self.of(path)]

    @property
    def pids(self) -> set[int]:
        """The processes that wrote them."""
        return {head.pid for head in self.findings.heads}

    @property
    def lines(self) -> list[str]:
        """The lines of the log."""
        return [line["message"] for line in self.messages("@log")]
