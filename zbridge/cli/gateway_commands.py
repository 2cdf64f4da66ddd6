"""``zbridge stop, unlatch, restart``: what they print is what the gateways of the robots confirmed."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from zbridge.bus import Bus, BusSettings
from zbridge.bus.tls.files import own_name, own_role
from zbridge.bus.tls.membership import Right, no_answer, require_right
from zbridge.cli.terminal import builtins, console, errors
from zbridge.client import connect, joined
from zbridge.client.driver import default_who
from zbridge.client.stops import Outcome, finding, summarize
from zbridge.errors import BusError, BusRefused, Refused, refusal
from zbridge.fleet import topics
from zbridge.fleet.messages import Latch
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import KeySpace, is_name, split_key


async def stop(
    settings: BusSettings, realm: str, robot: str | None, *, latch: bool, reason: str | None, as_json: bool = False
) -> bool:
    """Stop one robot, or all; return whether every gateway confirmed it. latch: nobody drives before ``unlatch``."""
    async with connect(settings=settings, realm=realm) as fleet:
        act = fleet.latch if latch else fleet.stop
        outcomes = await act([robot] if robot is not None else None, reason)
    return _report(outcomes, "latched" if latch else "stopped", realm, only=robot, as_json=as_json)


async def unlatch(settings: BusSettings, realm: str, robot: str | None, *, as_json: bool = False) -> bool:
    """Release the latched stops of one robot, or those of the whole fleet; return whether all were released."""
    released: tuple[Latch, ...] = ()
    async with connect(settings=settings, realm=realm) as fleet:
        if robot is None:
            return _report(await fleet.unlatch(), "unlatched", realm, as_json=as_json)
        try:
            released = await fleet[robot].unlatch()
        except (Refused, BusError) as error:
            if not as_json:
                raise
            return _report({robot: error}, "unlatched", realm, as_json=True)
    if as_json:
        return _report(
            {robot: None}, "unlatched", realm, as_json=True, released=[builtins(latch) for latch in released]
        )
    for latch in released:
        because = f" ({latch.reason})" if latch.reason else ""
        console.print(shown(f"{robot}: released the stop of {latch.who or 'somebody'}{because}"))
    if not released:
        console.print(f"{robot}: was not latched")
    return True


def _report(
    outcomes: Mapping[str, Outcome],
    done: str,
    realm: str,
    *,
    only: str | None = None,
    as_json: bool = False,
    **more: object,
) -> bool:
    """Print the outcome for each robot, reasons to stderr; return whether all succeeded. more: in JSON besides."""
    for robot, error in outcomes.items():
        if as_json:
            _print_json(robot, done if error is None else finding(error), error, **more)
        elif error is not None:
            errors.print(shown(str(error)))
    if not outcomes:
        errors.print(f"no gateways on {realm}/")
    elif not as_json and only is None:
        console.print(summarize(outcomes, done))
    elif not as_json and not any(outcomes.values()):
        console.print(f"{only}: {done}")
    return bool(outcomes) and not any(outcomes.values())


def _print_json(robot: str, outcome: str, error: Outcome, **more: object) -> None:
    reason = None if error is None else str(error)
    console.print(to_json({"robot": robot, "ok": error is None, "outcome": outcome, "reason": reason, **more}))


ANSWER_S = 60.0
"""Longest wait for a gateway: a successor has 30 s to start."""


async def restart(
    settings: BusSettings, realm: str, robot: str | None, *, who: str | None = None, as_json: bool = False
) -> bool:
    """Restart the gateway of one robot, or all; print the outcome of each; return whether all were restarted.

    who: the name under which the access rules know this program; by default that of its certificate, or ``user@host``.
    """
    who, role = who or own_name(settings.tls) or default_who(), own_role(settings.tls) or ""
    async with joined(settings, realm) as bus:
        names = [robot] if robot is not None else await _robots(bus, realm)
        keys = [KeySpace(realm, name) for name in names]
        found = await asyncio.gather(*(_restart_one(bus, each, who, role) for each in keys))
    outcomes = dict(zip(names, found, strict=True))
    for name, error in outcomes.items():
        refused = "refused" if isinstance(error, Refused) else "did not confirm"
        if as_json:
            _print_json(name, "restarted" if error is None else refused, error)
        elif error is None:
            console.print(shown(f"{name}: restarted"))
        else:
            errors.print(shown(str(error)))
    if not names:
        errors.print(f"no gateways on {realm}/")
    return bool(names) and not any(found)


async def _robots(bus: Bus, realm: str) -> list[str]:
    tokens = await bus.alive(f"{realm}/*/@alive/gateway")
    return sorted({split[1] for key in tokens if (split := split_key(key)) and is_name(split[1])})


async def _restart_one(bus: Bus, keys: KeySpace, who: str, role: str) -> Outcome:
    """Return why a gateway was not restarted, or the role that this program lacks; None if it was."""
    try:
        await require_right(bus.ask, keys.realm, who, Right.RESTART, keys.robot, role=role)
    except BusRefused as error:
        return error
    try:
        answers = await bus.ask(keys.key(topics.RPC_RESTART(who).path), timeout_s=ANSWER_S)
    except BusError as error:
        return BusError(f"{keys.robot}: {error}")
    if not answers:
        return BusError(f"{keys.robot}: {no_answer(who)}")
    said = next((answer.error for answer in answers if answer.error is not None), None)
    if isinstance(said, Refused):
        return refusal(said.code, f"{keys.robot}: {said}")
    return BusError(f"{keys.robot}: {said}") if said is not None else None
