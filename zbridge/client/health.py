"""How robots are, as monitoring asks: ok, warning or critical, with the reason.

A status that is answered by the bus's last value may be old: a gateway publishes its own once a second, and one that
was heard while somebody listened shows that the gateway's event loop turns.
"""

from __future__ import annotations

import asyncio
import contextlib
from enum import IntEnum

import msgspec

from zbridge.client.fleet import Fleet
from zbridge.fleet.messages import Status

LISTEN_S = 3.0
"""Seconds in which a gateway must publish its status: it does so once a second."""


class Level(IntEnum):
    """The exit code that monitoring expects."""

    OK = 0
    WARNING = 1
    CRITICAL = 2


class Health(msgspec.Struct, frozen=True):
    """How one robot is. reason: what is wrong, or was noticed."""

    level: Level
    state: str | None = None
    reason: str | None = None
    host: str | None = None


def judge(status: Status | None, *, heard: bool) -> Health:
    """Judge a robot by its last status, None if there is none. heard: its gateway published a status just now."""
    if status is None:
        return Health(Level.CRITICAL, reason="no gateway serves it")
    level, reason = _LEVELS.get(status.state, Level.CRITICAL), status.reason
    if not heard:
        level, reason = Level.CRITICAL, f"its gateway has said nothing for {LISTEN_S:g} s"
    elif level is Level.OK and reason:
        level = Level.WARNING
    return Health(level, status.state, reason, status.host)


async def health(fleet: Fleet, robot: str | None = None) -> dict[str, Health]:
    """Judge one robot, or all that have a gateway or a status, by name. Takes 1 s, up to LISTEN_S if one is silent."""
    heard: dict[str, Status] = {}
    came = asyncio.Event()

    async def hear() -> None:
        async for name, status in fleet.statuses(robot):
            heard[name] = status
            came.set()

    hearing = asyncio.ensure_future(hear())
    try:
        known = await fleet.robots()
        wanted = {robot} if robot is not None else set(known)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LISTEN_S):
                while not wanted or not wanted <= set(heard):
                    came.clear()
                    await came.wait()
    finally:
        hearing.cancel()
        await asyncio.gather(hearing, return_exceptions=True)
    names = wanted if robot is not None else wanted | set(heard)
    return {name: judge(heard.get(name) or known.get(name), heard=name in heard) for name in sorted(names)}


_LEVELS: dict[str, Level] = {
    "established": Level.OK,
    "handshaking": Level.WARNING,
    "connecting": Level.WARNING,
    "closing": Level.WARNING,
    "offline": Level.CRITICAL,
}
