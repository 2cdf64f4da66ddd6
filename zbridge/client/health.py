"""The health of robots for monitoring: ok, warning or critical, with the reason.

A status that was queried as the last value may be old. A gateway publishes its status once a second: one that arrives
live shows that the gateway's event loop runs.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from enum import IntEnum

import msgspec

from zbridge.client.fleet import Fleet
from zbridge.fleet.messages import LinkStatus, Status
from zbridge.fleet.printable import shown

LISTEN_S = 3.0
"""Seconds in which a gateway must publish its status: it does so once a second."""
_NAMED = 3
"""Most other robots that a reason names."""
_PEER = 80
"""Most characters of an address in a reason."""


class HealthLevel(IntEnum):
    """The exit code that monitoring expects."""

    OK = 0
    WARNING = 1
    CRITICAL = 2


class Health(msgspec.Struct, frozen=True):
    """The health of one robot. reason: what is wrong, or was noticed."""

    level: HealthLevel
    state: str | None = None
    reason: str | None = None
    host: str | None = None


def judge(status: Status | None, *, fresh: bool) -> Health:
    """Judge a robot by its last status, None if there is none. fresh: its gateway published a status just now."""
    if status is None:
        return Health(HealthLevel.CRITICAL, reason="no gateway serves it")
    level, reason = _LEVELS.get(status.state, HealthLevel.CRITICAL), status.reason
    if not fresh:
        level, reason = HealthLevel.CRITICAL, f"its gateway has published nothing for {LISTEN_S:g} s"
    elif level is HealthLevel.OK and reason:
        level = HealthLevel.WARNING
    return Health(level, status.state, reason, status.host)


def same_addresses(statuses: Mapping[str, Status]) -> dict[str, str]:
    """Return for each robot which others name the same robot address without declaring it shared.

    Addresses of one machine only (loopback, serial lines) are ignored. In two networks one address may be two robots.
    """
    named: dict[str, list[str]] = {}
    for robot, status in sorted(statuses.items()):
        for link in status.links:
            if _is_of_the_network(link) and robot not in (robots := named.setdefault(link.peer, [])):
                robots.append(robot)
    found: dict[str, str] = {}
    for peer, robots in named.items():
        for robot in robots if len(robots) > 1 else ():
            others = ", ".join(each for each in robots[: _NAMED + 1] if each != robot)
            found[robot] = f"{shown(peer, _PEER)} is the address of {others} too"
    return found


def _is_of_the_network(link: LinkStatus) -> bool:
    host = link.peer.partition("://")[2].rpartition(":")[0].strip("[]")
    here = host in ("", "localhost", "::1") or host.startswith("127.")
    return link.peer.startswith("tcp://") and not here and link.shared is not True


async def health(fleet: Fleet, robot: str | None = None) -> dict[str, Health]:
    """Judge one robot, or all that have a gateway or a status, by name. Takes 1 s, up to LISTEN_S if one is silent."""
    received: dict[str, Status] = {}
    came = asyncio.Event()

    async def receive() -> None:
        async for name, status in fleet.statuses(robot):
            received[name] = status
            came.set()

    receiving = asyncio.ensure_future(receive())
    try:
        known = await fleet.robots()
        wanted = {robot} if robot is not None else set(known)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LISTEN_S):
                while not wanted or not wanted <= set(received):
                    came.clear()
                    await came.wait()
    finally:
        receiving.cancel()
        await asyncio.gather(receiving, return_exceptions=True)
    names = wanted if robot is not None else wanted | set(received)
    statuses = {name: status for name, status in {**known, **received}.items() if status is not None}
    judged = {name: judge(statuses.get(name), fresh=name in received) for name in sorted(names)}
    for name, text in same_addresses(statuses).items():
        if (each := judged.get(name)) is not None:
            reason = "; ".join(filter(None, (each.reason, text)))
            judged[name] = msgspec.structs.replace(each, level=max(each.level, HealthLevel.WARNING), reason=reason)
    return judged


_LEVELS: dict[str, HealthLevel] = {
    "established": HealthLevel.OK,
    "handshaking": HealthLevel.WARNING,
    "connecting": HealthLevel.WARNING,
    "closing": HealthLevel.WARNING,
    "offline": HealthLevel.CRITICAL,
}
