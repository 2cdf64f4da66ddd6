"""``zbridge ls, health, echo``: the commands that read the bus."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from typing import Any

import msgspec
import numpy as np
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from zbridge.bus import Bus, BusSettings, Sample, open_bus, read_key_expr
from zbridge.bus.tls.refusal import why_not
from zbridge.client import connect
from zbridge.client.health import Health, HealthLevel, health
from zbridge.errors import BusError, ConfigError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, SessionEntry, Status
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import is_concrete, is_name, split_key
from zbridge.metrics import Metrics
from zbridge.tasks import occurs

_SHOWN = 8
"""Bytes of a value that are printed."""
_TABLE = 180
"""Least width of a session table, characters, also on narrower terminals."""
_CELL = 200
"""Characters of a cell of a table, at most."""
_MESSAGE = 20_000
"""Characters of a message that is printed as text, at most."""
_SESSION_COLUMNS = (
    *("robot", "process", "session", "peer", "state", "version"),
    *("by", "in", "out", "lost", "left out", "reason"),
)
_SUMMED_UP = 20
"""From this number of robots on, a line below the table counts them."""
_DEPTH = 32
"""Levels of nested maps and arrays that are printed."""

console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)
errors = Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)


@contextlib.asynccontextmanager
async def joined(settings: BusSettings, realm: str | None) -> AsyncIterator[Bus]:
    """Open the bus while the context lasts; raise BusError. realm: in which a router must know us; None: any."""
    bus = await open_bus(settings, Metrics(), wait_for_peers=True, realm=realm)
    try:
        yield bus
    finally:
        await bus.close()


async def list_robots(settings: BusSettings, realm: str, *, as_json: bool) -> None:
    """Print the robots that have a gateway or a status."""
    async with connect(settings=settings, realm=realm) as fleet:
        robots = await fleet.robots()
    if as_json:
        for name, status in robots.items():
            fields = msgspec.to_builtins(status) if status is not None else {"state": None}
            console.print(to_json({"robot": name, **fields}))
    elif robots:
        console.print(_robot_table(robots))
        if len(robots) >= _SUMMED_UP:
            console.print(_summary(robots))
    else:
        finding = await why_not(settings) if settings.tls is None else None  # the router may speak TLS
        more = f": {shown(finding.text)}" if finding is not None and finding.refused else ""
        errors.print(f"no robots on {realm}/{more}")


async def list_sessions(settings: BusSettings, realm: str, *, as_json: bool) -> None:
    """Print the session tables of all processes that serve a robot or HQ programs."""
    async with connect(settings=settings, realm=realm) as fleet:
        tables = await fleet.sessions()
    if as_json:
        for (robot, who), sessions in tables.items():
            for entry in sessions:
                console.print(to_json({"robot": robot, "who": who, **msgspec.to_builtins(entry)}))
    elif tables:
        console.width = max(console.width, _TABLE)
        console.print(_session_table(tables), crop=False)
    else:
        errors.print(f"no gateways on {realm}/")


def _session_table(tables: dict[tuple[str, str], tuple[SessionEntry, ...]]) -> Table:
    table = Table(box=None)
    for title in _SESSION_COLUMNS:
        table.add_column(title, no_wrap=title not in ("left out", "reason"), overflow="fold")
    for (robot, who), sessions in tables.items():
        for entry in sessions:
            kinds = (("frames_in",), ("frames_out",), ("malformed", "dropped", "refused"))
            counts = [str(sum(entry.counters.get(name, 0) for name in names)) for names in kinds]
            left_out = ", ".join(f"{name} {count}" for name, count in entry.left_out.items())
            agreed = (entry.state, entry.version or "", entry.transport)
            table.add_row(
                *map(cell, (robot, who, entry.name, entry.peer, *agreed, *counts, left_out, entry.reason or ""))
            )
    return table


def cell(text: str) -> Text:
    """Return a cell of a table: text that is safe to print, not interpreted as markup."""
    return Text(shown(text, _CELL))


def print_columns(rows: Sequence[tuple[str, ...]]) -> None:
    """Print rows of equal length in columns. A table of rich takes a millisecond per row."""
    cells = [[shown(text, _CELL) for text in row] for row in rows]
    widths = [max(map(cell_len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        padded = (text + " " * (width - cell_len(text)) for text, width in zip(row, widths, strict=True))
        print(" ", "  ".join(padded).rstrip(), sep="")  # noqa: T201


def _robot_table(robots: dict[str, Status | None]) -> Table:
    table = Table("robot", "state", "host", "protocol", "version", "features", "reason", box=None)
    for name, status in robots.items():
        if status is None:
            cells = (name, "?", "", "", "", "", "the gateway has published no status yet")
        else:
            agreed = (status.protocol or "", status.version or "", " ".join(status.features))
            cells = (name, status.state, status.host or "", *agreed, status.reason or "")
        table.add_row(*map(cell, cells))
    return table


def _summary(robots: dict[str, Status | None]) -> str:
    """Count robots by state: ``1000 robots: 998 established, 2 offline``."""
    counts = Counter("without status" if status is None else status.state for status in robots.values())
    return f"{len(robots)} robots: " + ", ".join(f"{count} {state}" for state, count in counts.most_common())


async def echo(
    settings: BusSettings,
    key: str,
    *,
    realm: str | None = None,
    as_json: bool = False,
    count: int = 0,
    seconds: float = 0.0,
) -> bool:
    """Print the messages on a key, the last value of each state first. realm: None takes that of the key.

    count, seconds: end after this many, 0 = never. Return False if ``seconds`` passed with fewer messages than
    ``count``, or with none. Raise ConfigError for an invalid key expression, or one of another realm.
    """
    key = read_key_expr("KEY", key)
    seen, done = 0, asyncio.Event()
    realm = _realm_of(key, realm)

    def show(sample: Sample) -> None:
        nonlocal seen
        if count and seen >= count:
            return
        seen += 1
        console.print(_line(sample, as_json=as_json))
        if seen == count:
            done.set()

    async with joined(settings, realm) as bus:
        bus.subscribe(key, show, history=True)
        await occurs(done, seconds or None)
    if seen and seen >= count:
        return True
    errors.print(shown(f"{seen or 'no'} messages on {key} within {seconds:g} s"))
    return False


def _realm_of(key: str, realm: str | None) -> str | None:
    """Return the realm of a key expression, None if it has several; raise ConfigError if it is not ``realm``."""
    first = key.partition("/")[0]
    if realm is None:
        return first if is_name(first) else None
    if not is_name(realm):
        raise ConfigError(f"realm = {realm!r}: expected letters, digits, '_', '.' and '-' only")
    if is_concrete(first) and first != realm:
        raise ConfigError(f"KEY = {key!r}: expected a key of realm {realm}, as {realm + '/' + key!r}")
    return realm


def _line(sample: Sample, *, as_json: bool) -> str:
    try:
        fields = _fields(sample)
    except PayloadError as error:
        fields = {"error": str(error)}
    if as_json:
        return to_json({"key": sample.key} | _plain(fields) | {"key": sample.key})
    line = f"{sample.key} " + " ".join(f"{name}={_short(value)}" for name, value in fields.items())
    return shown(line, _MESSAGE)


def _fields(sample: Sample) -> dict[str, Any]:
    split = split_key(sample.key)
    topic = topics.find(split[2]) if split else None
    if topic is None:
        return payloads.unpack(sample.payload)
    message: FleetMessage = payloads.decode(topic.message, sample.payload)
    fields = msgspec.structs.asdict(message)
    return {name: value for name, value in fields.items() if value is not None and value is not msgspec.UNSET}


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, bytes):
        return f"{value[:_SHOWN].hex(' ')}{'...' if len(value) > _SHOWN else ''} ({len(value)} bytes)"
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(_plain(value), ensure_ascii=False)


def _plain(value: Any, depth: int = _DEPTH) -> Any:
    """Return a value that JSON can hold: arrays as lists, bytes as hex, NaN and infinity as null, the rest as text."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict | list | tuple) and not depth:
        return "..."
    if isinstance(value, dict):
        return {str(name): _plain(item, depth - 1) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, depth - 1) for item in value]
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int) else str(value)


_NAMED_ILL = 5
"""Most robots that the line names."""
_REASON = 120
"""Most characters of a reason in the line."""


async def report_health(settings: BusSettings, realm: str, robot: str | None, *, as_json: bool) -> int:
    """Print how one robot is, or all of them; return the exit code: 0 ok, 1 warning, 2 critical."""
    try:
        async with connect(settings=settings, realm=realm) as fleet:
            robots = await health(fleet, robot)
        trouble = None if robots else f"no robots on {realm}/"
    except BusError as error:
        robots, trouble = {}, f"no bus: {error}"
    level = HealthLevel.CRITICAL if trouble is not None else max(each.level for each in robots.values())
    line = f"{level.name} - {trouble or _health_line(robots)}"
    if as_json:
        fields = {
            name: {**msgspec.to_builtins(each), "level": each.level.name.lower()} for name, each in robots.items()
        }
        console.print(to_json({"level": level.name.lower(), "text": line, "robots": fields}))
    else:
        console.print(line)
    return int(level)


def _health_line(robots: dict[str, Health]) -> str:
    """Count the robots that are well, and name the worst of the others with their reasons."""
    ill = sorted((name for name, each in robots.items() if each.level), key=lambda name: -robots[name].level)
    parts = [f"{len(robots) - len(ill)} of {len(robots)} robots established"]
    for name in ill[:_NAMED_ILL]:
        reasons = filter(None, (robots[name].state or "is missing", robots[name].reason))
        parts.append(f"{name} {shown(': '.join(reasons), _REASON)}")
    parts += [f"and {len(ill) - _NAMED_ILL} more"] * (len(ill) > _NAMED_ILL)
    return "; ".join(parts)
