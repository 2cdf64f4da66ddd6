"""``zbridge stop, unlatch``: what they print is what the robots' gateways confirmed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from zbridge.bus import BusSettings
from zbridge.cli.bus import console, errors
from zbridge.client import connect
from zbridge.client.stops import Outcome
from zbridge.errors import NotReady, Refused
from zbridge.fleet.messages import Latch
from zbridge.fleet.printable import shown

_NAMED = 20
"""Robots of one finding that are named, at most."""


async def stop(settings: BusSettings, realm: str, robot: str | None, *, latch: bool, reason: str | None) -> bool:
    """Stop one robot, or all; return whether every gateway confirmed it. latch: nobody drives before ``unlatch``."""
    async with connect(settings=settings, realm=realm) as fleet:
        act = fleet.latch if latch else fleet.stop
        outcomes = await act([robot] if robot is not None else None, reason)
    return _report(outcomes, "latched" if latch else "stopped", realm, only=robot)


async def unlatch(settings: BusSettings, realm: str, robot: str | None) -> bool:
    """Release the latched stops of one robot, or those of the whole fleet; return whether all were released."""
    async with connect(settings=settings, realm=realm) as fleet:
        if robot is None:
            return _report(await fleet.unlatch(), "unlatched", realm)
        released = await fleet[robot].unlatch()
    for latch in released:
        console.print(shown(f"{robot}: released the stop {_told(latch)}"))
    if not released:
        console.print(f"{robot}: was not latched")
    return True


def _report(outcomes: Mapping[str, Outcome], done: str, realm: str, *, only: str | None = None) -> bool:
    """Print what came of each robot, the reasons to stderr; return whether all is well."""
    for error in outcomes.values():
        if error is not None:
            errors.print(shown(str(error)))
    if only is not None and not any(outcomes.values()):
        console.print(f"{only}: {done}")
    elif only is None and outcomes:
        console.print(summary(outcomes, done))
    elif not outcomes:
        errors.print(f"no gateways on {realm}/")
    return bool(outcomes) and not any(outcomes.values())


def summary(outcomes: Mapping[str, Outcome], done: str) -> str:
    """Sum up in one line: ``38 of 40 stopped; r7 offline; r9 did not confirm``."""
    findings = {name: _finding(error) for name, error in outcomes.items() if error is not None}
    parts = [f"{len(outcomes) - len(findings)} of {len(outcomes)} {done}"]
    for finding, count in Counter(findings.values()).items():
        names = [name for name, found in findings.items() if found == finding]
        more = f" and {count - _NAMED} more" if count > _NAMED else ""
        parts.append(f"{', '.join(names[:_NAMED])}{more} {finding}")
    return "; ".join(parts)


def _finding(error: Exception) -> str:
    if isinstance(error, NotReady):
        return "offline"
    return "refused" if isinstance(error, Refused) else "did not confirm"


def _told(latch: Latch) -> str:
    reason = f" ({latch.reason})" if latch.reason else ""
    return f"of {latch.who or 'somebody'}{reason}"
