"""Carries out ``zbridge blackbox ls, show, export, rm``, and the keeping of ``zbridge mark --keep``."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from zbridge.blackbox.incidents import INFO, BoxFolder, IncidentInfo, boxes, is_incident_name
from zbridge.blackbox.reading import Findings, list_incidents, read_records
from zbridge.blackbox.segments import LogLine
from zbridge.bus import Answer, Bus, BusSettings
from zbridge.bus.tls.files import own_name, own_role
from zbridge.bus.tls.membership import Right, require_right
from zbridge.cli.terminal import Column, Table, console, errors
from zbridge.client import joined
from zbridge.client.driver import default_who
from zbridge.errors import BusError, PayloadError, ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.incidents import IncidentEntry, IncidentPart, Incidents, ReadIncident
from zbridge.fleet.messages import Query, Text
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import KeySpace, split_key
from zbridge.views.recording.contents import Pictures, is_log
from zbridge.views.recording.incident import export_incident

_COLUMNS = (
    *(Column("incident"), Column("began", 1), Column("faults", 2)),
    *(Column("MB", 3, number=True), Column("", 4), Column("host", 5)),
)
_LINES = 20
"""Last lines of the log before the first cause that are shown."""
ASK_S = 5.0
"""Longest wait for one part."""
LIST_S = 2.0
"""The same for lists."""
_ATTEMPTS = 3
_Listed = list[tuple[str, IncidentEntry, str | None]]
"""Robot, incident, host."""


def list_here(folder: Path, *, as_json: bool) -> None:
    """Print the incidents below a folder."""
    found: _Listed = []
    for box in boxes(folder):
        listed = list_incidents(box)
        found += [(box.robot, entry, listed.host) for entry in listed.incidents]
    _print(found, as_json=as_json)


async def list_fleet(settings: BusSettings, realm: str, *, as_json: bool) -> None:
    """Print the incidents of all gateways of a realm."""
    async with joined(settings, realm) as bus:
        found = await _listed(bus, realm)
    _print(found, as_json=as_json)


async def _listed(bus: Bus, realm: str) -> _Listed:
    found: _Listed = []
    for answer in await bus.ask(f"{realm}/*/{topics.RPC_INCIDENTS.path}", payloads.encode(Query()), timeout_s=LIST_S):
        split = split_key(answer.key)
        if split is None:
            continue
        if answer.error is not None:
            errors.print(shown(f"{split[1]}: {answer.error}"))
            continue
        listed = payloads.decode(Incidents, answer.payload)
        found += [(split[1], entry, listed.host) for entry in listed.incidents]
    return sorted(found, key=lambda each: each[1].began_ns)


def _print(found: _Listed, *, as_json: bool) -> None:
    if as_json:
        for robot, entry, host in found:
            console.print(to_json({"robot": robot, **msgspec.to_builtins(entry), "host": host}))
        return
    if not found:
        console.print("no incidents")
        return
    rows = [
        (
            entry.name,
            _time(entry.began_ns),
            " ".join(entry.codes),
            f"{entry.bytes / 1e6:.1f}",
            "open" if entry.open else "",
            host or "",
        )
        for _, entry, host in found
    ]
    Table(_COLUMNS, rows).print()


def show_here(folder: Path, name: str, *, as_json: bool) -> None:
    """Print an incident of this host; raise ZbridgeError if there is none."""
    box, info = _find(folder, name)
    findings = Findings()
    segments = [path for path in box.parts(name) if path.name != INFO]
    lines: list[str] = []
    for record in read_records(segments, findings):
        if is_log(record.key) and record.at_ns <= info.began_ns + 1_000_000_000:
            lines.append(_line(record.payload, record.at_ns))
            del lines[:-_LINES]
    _show(info, findings, lines, as_json=as_json)


def _line(payload: bytes, at_ns: int) -> str:
    try:
        line = payloads.decode(LogLine, payload)
    except PayloadError:
        return f"{_time(at_ns)} (not readable)"
    return f"{_time(at_ns)} {line.level} {line.logger}: {line.message}"


async def show_fetched(settings: BusSettings, realm: str, name: str, *, as_json: bool) -> None:
    """Print an incident that a gateway has; raise ZbridgeError."""
    async with joined(settings, realm) as bus:
        reader = await IncidentReader.find(bus, settings, realm, name)
        info = await reader.info()
    _show(info, None, [], as_json=as_json)


def _show(info: IncidentInfo, findings: Findings | None, lines: Sequence[str], *, as_json: bool) -> None:
    if as_json:
        more = {} if findings is None else {"read": _found(findings), "log": list(lines)}
        console.print(to_json({**msgspec.to_builtins(info), **more}))
        return
    console.print(shown(f"{info.name}: {info.realm}/{info.robot}{'' if info.ended_ns else ', no end yet'}"))
    for cause in info.causes:
        console.print(shown(f"{_time(cause.at_ns)} {cause.code}: {cause.text}"))
    if info.more:
        console.print(f"and {info.more} more causes")
    if info.before is not None:
        console.print(shown(f"the minutes before are in {info.before}"))
    for name, value in info.frame.items():
        if name != "configuration":
            console.print(shown(f"{name}: {_short(value)}"))
    if findings is not None:
        _print_findings(findings)
    for line in lines:
        console.print(shown(line))


def _short(value: Any) -> str:
    """Write a part of the freeze frame without what is empty."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {_short(each)}" for key, each in value.items() if each not in (None, [], {}, ""))
    if isinstance(value, list):
        return "; ".join(map(_short, value))
    return str(value)


def _found(findings: Findings) -> dict[str, object]:
    return {
        "messages": findings.records,
        "damaged_bytes": findings.damaged,
        "lost": findings.lost,
        "set_back_s": round(findings.set_back_s, 3),
    }


def _print_findings(findings: Findings) -> None:
    console.print(f"{findings.records} messages in {len(findings.heads)} segments")
    if findings.damaged:
        console.print(f"damaged: {findings.damaged} bytes could not be read")
    if findings.lost:
        console.print(f"lost: {findings.lost} messages, the disk was too slow or full")
    if findings.set_back_s:
        console.print(f"the clock was set back by {findings.set_back_s:.1f} s: times continue as before")


def export_here(folder: Path, name: str, output: Path, *, pictures: bool) -> None:
    """Write an incident of this host as a recording."""
    box, info = _find(folder, name)
    _export(box.parts(name), info, output, pictures=pictures)


async def export_fetched(settings: BusSettings, realm: str, name: str, output: Path, *, pictures: bool) -> None:
    """Fetch an incident from its gateway, and write it as a recording."""
    _require_new(output)
    with tempfile.TemporaryDirectory(prefix="zbridge-") as temporary:
        async with joined(settings, realm) as bus:
            reader = await IncidentReader.find(bus, settings, realm, name)
            info, parts = await reader.info(), await reader.fetch(Path(temporary))
        _export(parts, info, output, pictures=pictures)


def _export(parts: list[Path], info: IncidentInfo, output: Path, *, pictures: bool) -> None:
    _require_new(output)
    findings = export_incident(parts, info, output, Pictures() if pictures else None)
    _print_findings(findings)
    console.print(shown(f"written to {output}"))


def _require_new(output: Path) -> None:
    if output.exists():
        raise ZbridgeError(f"{output} exists: give another name with -o")


def remove_here(folder: Path, names: Sequence[str]) -> None:
    """Delete incidents of this host; raise ZbridgeError for the first that there is not."""
    for name in names:
        box, info = _find(folder, name, damaged=True)
        if info.ended_ns is None and info.causes and box.is_live():
            raise ZbridgeError(f"{name} is still being written: wait a minute")
        box.remove(name)
        console.print(shown(f"{name}: deleted"))


def _find(folder: Path, name: str, *, damaged: bool = False) -> tuple[BoxFolder, IncidentInfo]:
    """Return the box that has an incident, and what is known of it; raise ZbridgeError.

    damaged: also one whose description cannot be read.
    """
    for box in boxes(folder) if is_incident_name(name) else ():
        info = box.info(name)
        if info is not None:
            return box, info
        if (box.incidents / name).is_dir():
            if damaged:
                return box, IncidentInfo(name, box.realm, box.robot, 0, ())
            raise ZbridgeError(f"{box.incidents / name / INFO}: damaged")
    raise ZbridgeError(f"{name}: no such incident below {folder}")


class IncidentReader:
    """Reads one incident through the robot's gateway, in parts. keys: of the robot. who: as access rules know us."""

    def __init__(self, bus: Bus, keys: KeySpace, who: str, name: str) -> None:
        self._bus = bus
        self._key = keys.key(topics.RPC_INCIDENT_READ(who).path)
        self._name = name
        self._robot = keys.robot

    def __repr__(self) -> str:
        return f"<IncidentReader {self._name}>"

    @classmethod
    async def find(cls, bus: Bus, settings: BusSettings, realm: str, name: str) -> IncidentReader:
        """Find the gateway that has an incident; raise ZbridgeError."""
        who = own_name(settings.tls) or default_who()
        await require_right(bus.ask, realm, who, Right.READ_INCIDENT, role=own_role(settings.tls) or "")
        for robot, entry, _ in await _listed(bus, realm):
            if entry.name == name:
                return cls(bus, KeySpace(realm, robot), who, name)
        raise ZbridgeError(f"{name}: no gateway on {realm}/ has this incident")

    async def info(self) -> IncidentInfo:
        """Return what the gateway knows of it."""
        content = b"".join([part async for part in self._parts(INFO)])
        try:
            return msgspec.json.decode(content, type=IncidentInfo)
        except (msgspec.MsgspecError, UnicodeError) as error:
            raise ZbridgeError(f"{self._name}: {INFO} is damaged: {error}") from error

    async def fetch(self, folder: Path) -> list[Path]:
        """Write the files of the incident to a folder; return them in order."""
        found = []
        for name, _ in (await self._ask("", 0)).files:
            if is_incident_name(name):
                path = folder / name
                with path.open("wb") as file:
                    async for part in self._parts(name):
                        file.write(part)
                found.append(path)
        return found

    async def _parts(self, file: str) -> Any:
        offset = 0
        while part := (await self._ask(file, offset)).data:
            yield part
            offset += len(part)

    async def _ask(self, file: str, offset: int) -> IncidentPart:
        question, error = payloads.encode(ReadIncident(self._name, file, offset)), BusError("no answer")
        for _ in range(_ATTEMPTS):
            for answer in await self._bus.ask(self._key, question, timeout_s=ASK_S):
                if answer.error is not None:
                    raise ZbridgeError(f"{self._robot}: {answer.error}")
                return payloads.decode(IncidentPart, answer.payload)
        raise BusError(f"{self._robot}: {error}")


async def keep_minutes(bus: Bus, realm: str, who: str, text: str) -> bool:
    """Let all black boxes keep the minutes before now, and print whose did; False if there is none."""
    question, path = payloads.encode(Text(text, "chat", who)), topics.RPC_INCIDENT_KEEP(who).path

    async def ask(robot: str) -> list[Answer]:
        return await bus.ask(KeySpace(realm, robot).key(path), question, timeout_s=LIST_S)

    tokens = await bus.alive(f"{realm}/*/@alive/gateway")
    robots = sorted({split[1] for key in tokens if (split := split_key(key))})
    found = dict(zip(robots, await asyncio.gather(*map(ask, robots)), strict=True))
    for robot, answers in found.items():
        for error in filter(None, (answer.error for answer in answers)):
            errors.print(shown(f"{robot}: {error}"))
    kept = [robot for robot, answers in found.items() if any(answer.error is None for answer in answers)]
    console.print(shown(f"kept: {', '.join(kept)}" if kept else "no gateway has a black box"))
    return bool(kept)


def _time(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9).astimezone().isoformat(sep=" ", timespec="milliseconds")[:23]
