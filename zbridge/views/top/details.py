"""All that ``zbridge top`` knows of one robot, as lines of text. Text of peers is safe to print."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from zbridge.client.fleet_model import RobotEntry
from zbridge.fleet.messages import Latch, LinkStatus, Refusal
from zbridge.fleet.printable import shown
from zbridge.fleet.processes import ListenerStats, ProcessStats, SessionEntry, Sessions, Stats
from zbridge.views.rows import RobotRow
from zbridge.views.top.board import ScreenLine, Tone

Tables = Mapping[tuple[str, str], Sessions]
"""The sessions of processes, by robot and process, as :meth:`zbridge.client.Fleet.processes` returns them."""


def detail_lines(entry: RobotEntry, row: RobotRow, tables: Tables | None) -> list[ScreenLine]:
    """Return the lines of one robot. tables: None while they are being queried."""
    status, control, stats = entry.status, entry.control, entry.stats
    sections = [
        ("", _overview(entry, row)),
        ("gateway", _gateway(stats, row)),
        ("rates", _rates(stats)),
        ("latched stops", [_latch(latch) for latch in control.latches] if control is not None else []),
        ("links", [_link(link) for link in status.links] if status is not None else []),
        ("sessions", _sessions(tables)),
        ("listeners", _listeners(stats, tables)),
        ("refusals, the newest first", [_refusal(each) for each in reversed(control.refusals)] if control else []),
    ]
    return [line for title, texts in sections for line in _section(title, texts)]


def _section(title: str, texts: list[str]) -> Iterator[ScreenLine]:
    if title:
        yield ScreenLine("")
        yield ScreenLine(title if texts else f"{title}: none", Tone.TITLE)
    for text in texts:
        yield ScreenLine(("  " if title else "") + shown(text))


def _overview(entry: RobotEntry, row: RobotRow) -> list[str]:
    status, control = entry.status, entry.control
    lines = [f"{row.name}: {row.state.word}" + (f": {row.reason}" if row.reason else "")]
    if status is not None and status.protocol is not None:
        dialect = f", dialect {status.dialect}" if status.dialect else ""
        features = f", features {' '.join(status.features)}" if status.features else ""
        lines.append(f"{status.protocol}, version {status.version or 'not known'}{dialect}{features}")
    if control is not None:
        ends = f", its lease ends in {control.expires_in_s:.1f} s" if control.expires_in_s is not None else ""
        priority = f" (priority {control.priority})" if control.priority is not None else ""
        driver = f"{entry.driver}{priority}{ends}" if entry.driver else "nobody"
        lines.append(f"driver: {driver}; control is {control.state}")
    return lines


def _gateway(stats: Stats | None, row: RobotRow) -> list[str]:
    if stats is None:
        return []
    process = stats.process
    lines = [
        f"host {process.host}, pid {process.pid}, zbridge {process.version}, up {duration(process.uptime_s)}",
        _usage(process),
        f"since its start: {stats.gaps} gaps, {stats.refused} commands refused, {stats.dropped} messages dropped",
    ]
    lines += [f"disk for {disk.use}: {disk.free_bytes / 1e9:.1f} GB free at {disk.path}" for disk in stats.disks]
    if row.cpu is None:
        lines.insert(0, "its last message:")
    elif process.robots > 1:
        lines.insert(1, f"the process serves {process.robots} robots")
    return lines


def _usage(process: ProcessStats) -> str:
    proportional = process.proportional_bytes
    memory = f"{process.resident_bytes / 1e6:.0f} MB resident"
    if proportional is not None:
        memory = f"{proportional / 1e6:.0f} MB ({memory})"
    files = f", {process.files} of {process.most_files} descriptors" if process.files else ""
    return f"{100 * process.cpu:.1f} % of a core, {memory}{files}, event loop {1e3 * process.late_s:.1f} ms late"


def _rates(stats: Stats | None) -> list[str]:
    return [f"{key} {rate:.1f}/s" for key, rate in sorted(stats.rates.items())] if stats is not None else []


def _latch(latch: Latch) -> str:
    return latch.described + (", with the whole fleet" if latch.fleet else "")


def _link(link: LinkStatus) -> str:
    shared = ", an address that other robots share" if link.shared is True else ""
    return f"{link.name}: {link.state}, {link.peer}{shared}" + (f": {link.reason}" if link.reason else "")


def _sessions(tables: Tables | None) -> list[str]:
    if tables is None:
        return ["(asking)"]
    return [_session(process, entry) for (_, process), table in tables.items() for entry in table.sessions]


def _session(process: str, entry: SessionEntry) -> str:
    counts = entry.counters
    lost = sum(counts.get(name, 0) for name in ("malformed", "dropped", "refused"))
    parts = [
        f"{process}: {entry.name} {entry.peer}: {entry.state}",
        f"{entry.version or 'no version'} by {entry.transport}",
        f"{counts.get('frames_in', 0)} in, {counts.get('frames_out', 0)} out, {lost} lost",
    ]
    parts += ["left out " + ", ".join(f"{name} {count}" for name, count in entry.left_out.items())] * bool(
        entry.left_out
    )
    return ", ".join(parts) + (f": {entry.reason}" if entry.reason else "")


def _listeners(stats: Stats | None, tables: Tables | None) -> list[str]:
    lines = [_listener("gateway", each) for each in (stats.listeners if stats is not None else ())]
    for (_, process), table in (tables or {}).items():
        lines += [_listener(process, each) for each in table.listeners]
    return lines


def _listener(process: str, listener: ListenerStats) -> str:
    does = "listening" if listener.listening else "NOT listening"
    return f"{process}: {listener.name}, {listener.protocol} at {listener.address}, {does}, {listener.clients} clients"


def _refusal(refusal: Refusal) -> str:
    by = f", by {refusal.by}" if refusal.by is not None else ""
    return f"{refusal.count} x {refusal.command} of {refusal.who or 'somebody'}: {refusal.code}: {refusal.reason}{by}"


def duration(seconds: float) -> str:
    """Write a time in its two largest units: ``3 h 12 min``."""
    for size, unit, below, smaller in ((86_400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if seconds >= size:
            return f"{int(seconds // size)} {unit} {int(seconds % size // below)} {smaller}"
    return f"{seconds:.0f} s"
