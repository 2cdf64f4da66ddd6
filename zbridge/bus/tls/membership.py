"""Whether the router knows our name.

A router lets every certificate of its authority connect, and sends nothing to a name that it does not know.

``zbridge router`` tells each member its role, and nobody else may ask (``@bus/whoami/<name>``). Zenoh's own router
answers nobody; the ids of the sessions distinguish them.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Sequence
from enum import Enum

from zbridge.bus.interface import Answer
from zbridge.bus.tls.certificate import Certificate
from zbridge.errors import BusRefused, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Membership

_MARK = "7a627264"
"""The prefix of the ids of routers that answer: "zbrd"."""
_ASKED = 3
_APART_S = 0.3
_ANSWER_S = 1.0

Ask = Callable[[str], Awaitable[list[Answer]]]


class Right(Enum):
    """An action that needs a role: what it is, and the roles that permit it."""

    DRIVE = ("drive it", ("operator", "supervisor", "hq"))
    TAKE_OVER = ("take it over", ("supervisor",))
    RESTART = ("restart its gateway", ("supervisor",))
    UNLATCH = ("release its latched stop", ("operator", "supervisor"))
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
    membership = await _asked(ask, topics.whoami(realm, name))
    if membership is None:
        raise BusRefused(
            f"connected, but the router does not know {certificate.common_name} in realm {realm}: its roles.toml does"
            " not name it (issued later, or revoked?); it reads the file when it starts"
        )
    if membership.role != certificate.role:
        raise BusRefused(
            f"connected, but roles.toml of the router names {membership.role}.{name}, and the certificate is of"
            f" {certificate.common_name}"
        )
    if robot is not None and membership.robots and robot not in membership.robots:
        raise BusRefused(
            f"connected, but {certificate.common_name} is for {', '.join(membership.robots)} and not for {robot}:"
            " roles.toml of the router says so"
        )


async def lacking(ask: Ask, realm: str, name: str, robot: str, right: Right) -> str | None:
    """Return which role a program lacks; None if it has one, or nothing is known: no router answers, the bus is open.

    Call this when a query had no answer: a router silently drops what a role may not query. name: in the certificate.
    """
    member = await _asked(ask, topics.whoami(realm, topics.escape(name)), 1)
    what, roles = right.value
    if member is None or member.role == "gateway":  # it may have listeners
        return None
    who = f"{member.role}.{member.name}"
    if member.role not in roles:
        return f"{who} may not {what}: that takes the role {' or '.join(roles)} in roles.toml of the router"
    if member.robots and robot not in member.robots:
        return f"{who} is for {', '.join(member.robots)} only: roles.toml of the router says so"
    return None


async def _asked(ask: Ask, key: str, attempts: int = _ASKED) -> Membership | None:
    for attempt in range(attempts):
        if attempt:
            await asyncio.sleep(_APART_S)
        for answer in await ask(key):
            if answer.error is None:
                try:
                    return payloads.decode(Membership, answer.payload)
                except PayloadError:
                    continue
    return None
