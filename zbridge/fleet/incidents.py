"""What a gateway tells of its black box: the incidents, and parts of their files."""

from __future__ import annotations

from typing import Annotated

import msgspec

from zbridge.fleet.messages import FleetMessage

PART_BYTES = 256 * 1024
"""Most bytes of one part."""
FILES = 4096
"""Most files of an incident that are listed."""


class IncidentEntry(msgspec.Struct, frozen=True):
    """One incident.

    name: of time, robot and first cause. codes: of its causes, each once. text: of the first cause, for people.
    began_ns: the first cause, Unix time. open: whether it is still being written. bytes: of all its files.
    """

    name: str
    codes: tuple[str, ...]
    text: str
    began_ns: int
    open: bool
    bytes: int


class Incidents(FleetMessage, frozen=True):
    """The incidents that one gateway keeps.

    incidents: oldest first. host: the machine they are on.
    """

    incidents: tuple[IncidentEntry, ...]
    host: str | None = None


class ReadIncident(FleetMessage, frozen=True):
    """Asks for a part of an incident's file.

    incident: its name. file: of :class:`IncidentPart`; empty: list the files. offset: of the first byte.
    """

    incident: Annotated[str, msgspec.Meta(max_length=200)]
    file: Annotated[str, msgspec.Meta(max_length=64)] = ""
    offset: Annotated[int, msgspec.Meta(ge=0)] = 0


class IncidentPart(FleetMessage, frozen=True):
    """A part of an incident's file, or the list of its files.

    files: names and sizes, in order. data: the bytes from the offset on, empty at the end of the file.
    """

    files: tuple[tuple[str, int], ...] = ()
    data: bytes = b""
