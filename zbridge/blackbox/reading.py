"""Reads what a black box has kept. All calls may wait for the disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from zbridge.blackbox.incidents import BoxFolder, IncidentInfo, head_of, is_incident_name
from zbridge.blackbox.segments import Damage, Record, SegmentHead, read_segment
from zbridge.errors import Unsupported
from zbridge.fleet.incidents import FILES, PART_BYTES, IncidentEntry, IncidentPart, Incidents, ReadIncident

_STEP_NS = 100_000_000
"""A smaller step of the clock is not told."""


class KeptRecord(msgspec.Struct, frozen=True):
    """One message of an incident. at_ns: when it came, Unix time; it rises also where the clock was set back."""

    at_ns: int
    key: str
    payload: bytes
    attachment: bytes | None


class Findings(msgspec.Struct):
    """What was found while an incident was read.

    damaged: bytes that could not be read. lost: messages that the gateways had lost. set_back_s: by how much the clock
    was set back in all. heads: of the segments.
    """

    records: int = 0
    damaged: int = 0
    lost: int = 0
    set_back_s: float = 0.0
    heads: list[SegmentHead] = []


def list_incidents(folder: BoxFolder) -> Incidents:
    """Return the incidents of one robot."""
    live = folder.is_live()
    entries = tuple(_entry(folder, info, live) for info in folder.infos())
    return Incidents(entries, os.uname().nodename)


def _entry(folder: BoxFolder, info: IncidentInfo, live: bool) -> IncidentEntry:
    size = sum(path.stat().st_size for path in folder.parts(info.name))
    codes = tuple(dict.fromkeys(cause.code for cause in info.causes))
    return IncidentEntry(info.name, codes, info.causes[0].text, info.began_ns, live and info.ended_ns is None, size)


def read_part(folder: BoxFolder, question: ReadIncident) -> IncidentPart:
    """Answer a question for a part of a file; raise Unsupported if there is no such file, and OSError."""
    name = question.incident
    paths = {path.name: path for path in folder.parts(name)} if is_incident_name(name) else {}
    if not paths:
        raise Unsupported(f"no incident {name!r}")
    if not question.file:
        files = tuple((path.name, path.stat().st_size) for path in paths.values())
        return IncidentPart(files[:FILES])
    path = paths.get(question.file)
    if path is None:
        raise Unsupported(f"{name} has no file {question.file!r}")
    with path.open("rb") as file:
        file.seek(min(question.offset, os.fstat(file.fileno()).st_size))
        return IncidentPart(data=file.read(PART_BYTES))


def read_records(segments: list[Path], findings: Findings) -> Iterator[KeptRecord]:
    """Yield the messages of segments in order; note in ``findings`` what was found. Raises OSError."""
    boot = None
    first = next((head for path in segments if (head := head_of(path)) is not None), None)
    offset_ns = first.wall_ns - first.mono_ns if first is not None else 0  # until the first head that is not damaged
    lost: dict[int, int] = {}
    for path in segments:
        for content in read_segment(path.read_bytes()):
            if isinstance(content, Damage):
                findings.damaged += content.size
            elif isinstance(content, SegmentHead):
                findings.heads.append(content)
                before = lost.get(content.pid, content.lost)
                findings.lost += content.lost - before if content.lost >= before else content.lost
                lost[content.pid] = content.lost
                found_ns = content.wall_ns - content.mono_ns
                if boot == content.boot and found_ns < offset_ns:
                    if offset_ns - found_ns > _STEP_NS:
                        findings.set_back_s = max(findings.set_back_s, (offset_ns - found_ns) / 1e9)
                    found_ns = offset_ns
                boot, offset_ns = content.boot, found_ns
            else:
                findings.records += len(content)
                yield from (_kept(record, offset_ns) for record in content)


def _kept(record: Record, offset_ns: int) -> KeptRecord:
    at_ns, key, payload, attachment = record
    return KeptRecord(at_ns + offset_ns, key, payload, attachment)
