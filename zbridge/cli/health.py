"""``zbridge health``: one line and an exit code, as monitoring programs expect them."""

from __future__ import annotations

import msgspec

from zbridge.bus import BusSettings
from zbridge.cli.bus import console
from zbridge.client import connect
from zbridge.client.health import Health, HealthLevel, health
from zbridge.errors import BusError
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown

_NAMED = 5
"""Robots that the line names."""
_REASON = 120
"""Characters of a reason that the line shows."""


async def report_health(settings: BusSettings, realm: str, robot: str | None, *, as_json: bool) -> int:
    """Print how one robot is, or all of them; return the exit code: 0 ok, 1 warning, 2 critical."""
    try:
        async with connect(settings=settings, realm=realm) as fleet:
            robots = await health(fleet, robot)
        trouble = None if robots else f"no robots on {realm}/"
    except BusError as error:
        robots, trouble = {}, f"no bus: {error}"
    level = HealthLevel.CRITICAL if trouble is not None else max(each.level for each in robots.values())
    line = f"{level.name} - {trouble or _summary(robots)}"
    if as_json:
        fields = {
            name: {**msgspec.to_builtins(each), "level": each.level.name.lower()} for name, each in robots.items()
        }
        console.print(to_json({"level": level.name.lower(), "text": line, "robots": fields}))
    else:
        console.print(line)
    return int(level)


def _summary(robots: dict[str, Health]) -> str:
    """Count the robots that are well, and name the worst of the others with their reasons."""
    ill = sorted((name for name, each in robots.items() if each.level), key=lambda name: -robots[name].level)
    parts = [f"{len(robots) - len(ill)} of {len(robots)} robots established"]
    parts += [f"{name} {_trouble(robots[name])}" for name in ill[:_NAMED]]
    parts += [f"and {len(ill) - _NAMED} more"] * (len(ill) > _NAMED)
    return "; ".join(parts)


def _trouble(each: Health) -> str:
    return shown(": ".join(filter(None, (each.state or "is missing", each.reason))), _REASON)
