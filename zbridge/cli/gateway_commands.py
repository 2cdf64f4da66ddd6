"""``zbridge stop, unlatch, restart``: what they print is what the gateways of the robots confirmed."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Mapping

from zbridge.bus import Bus, BusSettings
from zbridge.bus.tls.files import own_name
from zbridge.bus.tls.membership import Right, lacking
from zbridge.cli.bus import console, errors, joined
from zbridge.client import connect
from zbridge.client.driver import default_who
from zbridge.client.stops import Outcome, StopWaits
from zbridge.errors import BusError, NotReady, Refused
from zbridge.fleet import topics
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import KeySpace, is_name, split_key

_NAMED = 20
"""Most robots that a finding names."""


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
        reason = f" ({latch.reason})" if latch.reason else ""
        console.print(shown(f"{robot}: released the stop of {latch.who or 'somebody'}{reason}"))
    if not released:
        console.print(f"{robot}: was not latched")
    return True


def _report(outcomes: Mapping[str, Outcome], done: str, realm: str, *, only: str | None = None) -> bool:
    """Print the outcome for each robot, reasons to stderr; return whether all succeeded."""
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
        return "not reached" if isinstance(error, StopWaits) else "offline"
    return "refused" if isinstance(error, Refused) else "did not confirm"


ANSWER_S = 60.0
"""Longest wait for a gateway: a successor has 30 s to start."""


async def restart(settings: BusSettings, realm: str, robot: str | None, *, who: str | None = None) -> bool:
    """Restart the gateway of one robot, or all; print the outcome of each; return whether all were restarted.

    who: the name under which the access rules know this program; by default that of its certificate, or ``user@host``.
    """
    who = who or own_name(settings.tls) or default_who()
    async with joined(settings, realm) as bus:
        names = [robot] if robot is not None else await _robots(bus, realm)
        keys = [KeySpace(realm, name) for name in names]
        refusals = await asyncio.gather(*(_restart_one(bus, each, who) for each in keys))
    for name, refusal in zip(names, refusals, strict=True):
        if refusal is None:
            console.print(shown(f"{name}: restarted"))
        else:
            errors.print(shown(f"{name}: {refusal}"))
    if not names:
        errors.print(f"no gateways on {realm}/")
    return bool(names) and not any(refusals)


async def _robots(bus: Bus, realm: str) -> list[str]:
    tokens = await bus.alive(f"{realm}/*/@alive/gateway")
    return sorted({split[1] for key in tokens if (split := split_key(key)) and is_name(split[1])})


async def _restart_one(bus: Bus, keys: KeySpace, who: str) -> str | None:
    """Return why a gateway was not restarted, or the role that this program lacks; None if it was."""
    try:
        answers = await bus.ask(keys.key(topics.RPC_RESTART(who).path), timeout_s=ANSWER_S)
    except BusError as error:
        return str(error)
    if not answers:
        return await lacking(bus.ask, keys.realm, who, keys.robot, Right.RESTART) or "no gateway answers"
    return next((str(answer.error) for answer in answers if answer.error is not None), None)
