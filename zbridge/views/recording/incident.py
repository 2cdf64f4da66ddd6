"""Writes what a black box has kept as a recording (MCAP), which Foxglove and ``zbridge replay`` open."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import msgspec

from zbridge.blackbox.incidents import INFO, IncidentInfo
from zbridge.blackbox.reading import Findings, KeptRecord, read_records
from zbridge.errors import ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Text
from zbridge.views.recording.contents import Pictures
from zbridge.views.recording.intake import Arrival
from zbridge.views.recording.message_writer import MessageWriter
from zbridge.views.recording.tape import Tape, TapeSettings

_OFTEN = 256
"""Messages between two flushes."""
_ANY_ROBOT = re.compile(r"^([^/]+)/[^/]*\*[^/]*/")
"""The begin of a key that is meant for several robots: of a stop for all of them."""


def export_incident(parts: list[Path], info: IncidentInfo, output: Path, pictures: Pictures | None) -> Findings:
    """Write the segments of an incident to a new file; raise ZbridgeError.

    parts: files of the incident, in order. pictures: what draws Foxglove's messages; None: fleet messages only.
    """
    findings = Findings()
    tape = Tape(TapeSettings(output))
    writer = MessageWriter(tape, _metadata(info), pictures=pictures)
    writer.begin()
    try:
        segments = [path for path in parts if path.name != INFO]
        for number, arrival in enumerate(_with_marks(read_records(segments, findings), info)):
            writer.write(arrival)
            if not number % _OFTEN:
                writer.keep_time(arrival.arrived_ns)
        tape.close()
    except OSError as error:
        tape.salvage()
        raise ZbridgeError(f"{error.filename or output}: {error.strerror or error}") from error
    return findings


def _with_marks(records: Iterator[KeptRecord], info: IncidentInfo) -> Iterator[Arrival]:
    """Yield the messages, and between them a mark at each cause."""
    marks = [_mark(info, number) for number in range(len(info.causes))]
    for record in records:
        while marks and marks[0].arrived_ns <= record.at_ns:
            yield marks.pop(0)
        key = _ANY_ROBOT.sub(rf"\1/{info.robot}/", record.key)
        yield Arrival(record.at_ns, key, record.payload, record.attachment)
    yield from marks


def _mark(info: IncidentInfo, number: int) -> Arrival:
    cause = info.causes[number]
    mark = Text(f"{cause.code}: {cause.text}", "chat", f"{info.robot} black box", stamp_ns=cause.at_ns)
    return Arrival(cause.at_ns, f"{info.realm}/@mark", payloads.encode(mark))


def _metadata(info: IncidentInfo) -> dict[str, dict[str, str]]:
    frame = {name: value for name, value in info.frame.items() if name != "configuration"}
    incident = {
        "name": info.name,
        "robot": info.robot,
        "causes": json.dumps(msgspec.to_builtins(info.causes)),
        "more_causes": str(info.more),
        "before": info.before or "",
        "frame": json.dumps(frame),
    }
    versions = info.frame.get("versions")
    version = str(versions.get("zbridge", "")) if isinstance(versions, dict) else ""
    configuration = json.dumps(info.frame.get("configuration", {}))
    return {
        "zbridge": {"version": version, "realm": info.realm, "robots": info.robot, "wire": "true"},
        "incident": incident,
        f"configuration/{info.robot}": {"configuration": configuration},
    }
