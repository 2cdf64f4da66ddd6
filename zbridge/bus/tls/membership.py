"""Whether the router knows our name.

A router lets every certificate of its authority connect, and sends nothing to a name that it does not know.

``zbridge router`` tells each member its role, and nobody else may ask (``@bus/whoami/<name>``). Zenoh's own router
answers nobody; the ids of the sessions distinguish them.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Awaitable, Callable, Sequence
from enum import Enum

from zbridge.bus.interface import Answer
from zbridge.bus.tls.certificate import Certificate
from zbridge.errors import BusError, BusRefused, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.processes import Membership

_MARK = "7a627264"
"""The prefix of the ids of routers that answer: "zbrd"."""
_ASKED = 3
_APART_S = 0.3
WHOAMI_S = 0.3
"""Longest wait for a router that tells its members their role; it takes 8 ms."""

Ask = Callable[[str], Awaitable[list[Answer]]]


class Right(Enum):
    """An action that needs a role: what it is, and the roles that permit it."""

    DRIVE = ("drive it", ("operator", "supervisor", "hq"))
    TAKE_OVER = ("take it over", ("supervisor",))
    RESTART = ("restart its gateway", ("supervisor",))
    UNLATCH = ("release its latched stop", ("operator", "supervisor"))
    MARK = ("write a mark", ("operator", "supervisor", "hq"))
    READ_INCIDENT = ("read its incidents", ("supervisor",))
    UNLATCH_FLEET = ("release the fleet's latched stop", ("supervisor",))


def router_id() -> str:
    """Return a new id for a router that answers its members."""
    return _MARK + secrets.token_hex(12)


async def require_member(
    ask: Ask, routers: Sequence[str], certificate: Certificate, realm: str, robot: str | None
) -> None:
    """Raise BusRefused if the router does not know our name, or denies us this robot.

    routers: the ids of the routers that we are connected to. Does nothing if none of them answers members, or the
    certificate names no member.
    """
    name = certificate.name
    if not topics.is_name(name) or not any(each.startswith(_MARK) for each in routers):
        return
    member = await membership(ask, realm, name)
    if member is None:
        raise BusRefused(
            f"connected, but the router does not know {certificate.common_name} in realm {realm}: its roles.toml does"
            " not name it (issued later, or revoked?); it reads the file when it starts"
        )
    if member.role != certificate.role:
        raise BusRefused(
            f"connected, but roles.toml of the router names {member.role}.{name}, and the certificate is of"
            f" {certificate.common_name}"
        )
    if robot is not None and member.robots and robot not in member.robots:
        raise BusRefused(
            f"connected, but {certificate.common_name} is for {', '.join(member.robots)} and not for {robot}:"
            " roles.toml of the router says so"
        )


async def require_right(
    ask: Ask, realm: str, name: str, right: Right, robot: str | None = None, *, role: str = ""
) -> None:
    """Raise BusRefused, which names the missing role, if the router knows a member that may not do this.

    Call this before anything that a router silently drops. Nobody is asked for a name that no certificate has, like
    ``user@host``. Where nobody answers within :data:`WHOAMI_S`, the bus is open or its router is Zenoh's own, and
    ``role`` counts: that in the certificate, if it is given.
    """
    if not topics.is_name(name):
        return
    member = None
    with contextlib.suppress(TimeoutError, BusError):
        async with asyncio.timeout(WHOAMI_S):
            member = await membership(ask, realm, name, 1)
    if member is None and role:
        member = Membership(name=name, role=role)
    what, roles = right.value
    if member is None or member.role == "gateway":  # it may have listeners
        return
    who, begin = f"{member.role}.{member.name}", f"{robot}: " if robot is not None else ""
    if member.role not in roles:
        expected = f"that takes the role {' or '.join(roles)} in roles.toml of the router"
        raise BusRefused(f"{begin}{who} may not {what}: {expected}")
    if robot is not None and member.robots and robot not in member.robots:
        raise BusRefused(f"{begin}{who} is for {', '.join(member.robots)} only: roles.toml of the router says so")


def no_answer(name: str, within_s: float | None = None) -> str:
    """Say that a query had no answer. name: of the member that asked; rules may concern it if a certificate can."""
    within = f" within {within_s:g} s" if within_s is not None else ""
    if topics.is_name(name):
        return f"no answer{within}: no gateway, or the router's rules forbid it"
    return f"no gateway answered{within}"


async def membership(ask: Ask, realm: str, name: str, attempts: int = _ASKED) -> Membership | None:
    """Return what the router knows of a member; None if it does not answer. name: in our certificate."""
    for attempt in range(attempts):
        if attempt:
            await asyncio.sleep(_APART_S)
        for answer in await ask(topics.whoami(realm, topics.escape(name))):
            if answer.error is None:
                try:
                    return payloads.decode(Membership, answer.payload)
                except PayloadError:
                    continue
    return None


def may(role: str, right: Right) -> bool:
    """Return whether a role permits something."""
    return role in right.value[1]
