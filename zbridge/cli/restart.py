"""``zbridge restart``: asks gateways to hand everything to a new process of the installed version, and waits."""

from __future__ import annotations

import asyncio
from functools import partial

from zbridge.bus import Bus, BusSettings
from zbridge.bus.tls.member import own_name
from zbridge.bus.tls.membership import Right, lacking
from zbridge.cli.bus import console, errors, joined
from zbridge.client.driver import default_who
from zbridge.errors import BusError
from zbridge.fleet import topics
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import KeySpace, is_name, split_key

ANSWER_S = 60.0
"""Longest wait for a gateway: a successor has 30 s to start."""
_UNANSWERED = "no gateway answers"


async def restart(settings: BusSettings, realm: str, robot: str | None, *, who: str | None = None) -> bool:
    """Restart the gateway of one robot, or all; print the outcome of each; return whether all were restarted.

    who: the name under which the access rules know this program; by default that of its certificate, or ``user@host``.
    """
    who = who or own_name(settings.tls) or default_who()
    async with joined(settings, realm) as bus:
        names = [robot] if robot is not None else await _robots(bus, realm)
        keys = [KeySpace(realm, name) for name in names]
        refusals = await asyncio.gather(*(_restart_one(bus, each, who) for each in keys))
        if _UNANSWERED in refusals:
            refusals = await asyncio.gather(*map(partial(_explained, bus, who), keys, refusals))
    for name, refusal in zip(names, refusals, strict=True):
        if refusal is None:
            console.print(shown(f"{name}: restarted"))
        else:
            errors.print(shown(f"{name}: {refusal}"))
    if not names:
        errors.print(f"no gateways on {realm}/")
    return bool(names) and not any(refusals)


async def _explained(bus: Bus, who: str, keys: KeySpace, refusal: str | None) -> str | None:
    """Return the refusal, or the role that this program lacks where nobody answered."""
    if refusal != _UNANSWERED:
        return refusal
    return await lacking(bus.ask, keys.realm, who, keys.robot, Right.RESTART) or refusal


async def _robots(bus: Bus, realm: str) -> list[str]:
    tokens = await bus.alive(f"{realm}/*/@alive/gateway")
    return sorted({split[1] for key in tokens if (split := split_key(key)) and is_name(split[1])})


async def _restart_one(bus: Bus, keys: KeySpace, who: str) -> str | None:
    """Return why a gateway was not restarted; None where it was."""
    try:
        answers = await bus.ask(keys.key(topics.RPC_RESTART(who).path), timeout_s=ANSWER_S)
    except BusError as error:
        return str(error)
    if not answers:
        return _UNANSWERED
    return next((str(answer.error) for answer in answers if answer.error is not None), None)
