"""``zbridge ls, health``: what the processes on the bus say of themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from zbridge.bus import BusSettings
from zbridge.bus.tls.refusal import why_not
from zbridge.cli.terminal import Column, Table, builtins, console, errors
from zbridge.client import connect
from zbridge.client.fleet_model import RobotEntry
from zbridge.client.health import Health, HealthLevel, health
from zbridge.errors import BusError
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.processes import SessionEntry

_ROBOT_COLUMNS = (
    *(Column("robot"), Column("state", 1), Column("driver", 2), Column("host", 6), Column("protocol", 4)),
    *(Column("version", 5), Column("features", 7), Column("reason", 3)),
)
_SESSION_COLUMNS = (
    *(Column("robot"), Column("process", 5), Column("session"), Column("peer", 4), Column("state", 1)),
    *(Column("version", 6), Column("by", 7), Column("in", 2, number=True), Column("out", 2, number=True)),
    *(Column("lost", 2, number=True), Column("left out", 8), Column("reason", 3)),
)
_SUMMED_UP = 20
"""From this number of robots on, a line below the table counts them."""


async def list_robots(settings: BusSettings, realm: str, *, as_json: bool) -> None:
    """Print the robots that have a gateway or a status."""
    async with connect(settings=settings, realm=realm) as fleet, fleet.watch() as model:
        robots = sorted(model.robots.values(), key=lambda robot: robot.name)
    if as_json:
        for robot in robots:
            console.print(to_json(_robot_fields(robot)))
    elif robots:
        Table(_ROBOT_COLUMNS, map(_robot_row, robots)).print()
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
    rows = [(*process, entry) for process, sessions in tables.items() for entry in sessions]
    if as_json:
        for robot, who, entry in rows:
            console.print(to_json({"robot": robot, "who": who, **builtins(entry)}))
    elif tables:
        Table(_SESSION_COLUMNS, (_session_row(*row) for row in rows)).print()
    else:
        errors.print(f"no gateways on {realm}/")


def _session_row(robot: str, who: str, entry: SessionEntry) -> tuple[object, ...]:
    kinds = (("frames_in",), ("frames_out",), ("malformed", "dropped", "refused"))
    counts = (sum(entry.counters.get(name, 0) for name in names) for names in kinds)
    left_out = ", ".join(f"{name} {count}" for name, count in entry.left_out.items())
    agreed = (entry.state, entry.version or "", entry.transport)
    return (robot, who, entry.name, entry.peer, *agreed, *counts, left_out, entry.reason or "")


def _robot_row(robot: RobotEntry) -> tuple[str, ...]:
    driver, status = robot.driver or robot.stopped_by, robot.status
    if status is None:
        return (robot.name, "?", driver, "", "", "", "", "the gateway has published no status yet")
    agreed = (status.protocol or "", status.version or "", " ".join(status.features))
    return (robot.name, status.state, driver, status.host or "", *agreed, status.reason or "")


def _robot_fields(robot: RobotEntry) -> dict[str, Any]:
    """Return what ``ls --json`` prints of a robot: the fields of its status, and what its gateway says besides."""
    status = builtins(robot.status) if robot.status is not None else {"state": None}
    more = {name: builtins(each) for name, each in (("control", robot.control), ("stats", robot.stats)) if each}
    return {"robot": robot.name, **status, "driver": robot.driver or None, "control": None, "stats": None, **more}


def _summary(robots: Sequence[RobotEntry]) -> str:
    """Count robots by state: ``1000 robots: 998 established, 2 offline``."""
    counts = Counter("without status" if robot.status is None else robot.status.state for robot in robots)
    return f"{len(robots)} robots: " + ", ".join(f"{count} {state}" for state, count in counts.most_common())


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
        fields = {name: {**builtins(each), "level": each.level.name.lower()} for name, each in robots.items()}
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
