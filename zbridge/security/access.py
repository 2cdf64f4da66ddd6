"""Who may do what on a secure bus: one table, of which the router's rules and the page ``docs/security.md`` are made.

The table is :data:`GRANTS`: for each role, which messages it may send on which keys. What it lacks is denied; nothing
is denied by name, for a denial of ``@cmd/drive`` would not catch a put on ``@cmd/*``. Knows no Zenoh.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from enum import Enum, StrEnum
from typing import Literal

import msgspec

from zbridge.security.roles import Member, Role


class Kind(StrEnum):
    """The messages of Zenoh that its access rules tell apart."""

    PUT = "put"
    DELETE = "delete"
    SUBSCRIBE = "declare_subscriber"
    QUERY = "query"
    QUERYABLE = "declare_queryable"
    REPLY = "reply"
    TOKEN = "liveliness_token"
    ASK_ALIVE = "liveliness_query"
    WATCH_ALIVE = "declare_liveliness_subscriber"


class Keys(Enum):
    """The classes of keys: key expressions below the realm.

    ``{robot}``: a robot's name, or ``*``. ``{name}``: a member's name. What begins with ``@/`` is Zenoh's own.
    """

    DATA = ("{robot}/**",)
    STOP = ("{robot}/@cmd/stop",)
    COMMANDS = ("{robot}/@cmd/**",)
    MARK = ("@mark",)
    ACQUIRE = ("{robot}/@rpc/control/acquire/{name}",)
    TAKEOVER = ("{robot}/@rpc/control/takeover/{name}",)
    UNLATCH = ("{robot}/@rpc/control/unlatch/{name}",)
    UNLATCH_FLEET = ("{robot}/@rpc/control/unlatch_fleet/{name}",)
    LEASE = ("{robot}/@rpc/control/renew", "{robot}/@rpc/control/release")
    ASK = ("{robot}/@rpc/map", "{robot}/@rpc/pose")
    RESTART = ("{robot}/@rpc/restart/{name}",)
    SESSIONS = ("{robot}/@rpc/sessions/*",)
    LATCH = ("{robot}/@rpc/latch",)
    CLAIM = ("{robot}/@rpc/claim/gateway",)
    RPC = ("{robot}/@rpc/**",)
    HQ_ACQUIRE = ("{robot}/@rpc/control/acquire/hq.{name}", "{robot}/@rpc/control/acquire/hq.{name}.$*")
    HQ_REFUSED = ("{robot}/@rpc/control/refused/hq.{name}", "{robot}/@rpc/control/refused/hq.{name}.$*")
    HQ_SESSIONS = ("{robot}/@rpc/sessions/hq.{name}", "{robot}/@rpc/sessions/hq.{name}.$*")
    WIRE = ("{robot}/@wire/**",)
    ALIVE = ("{robot}/@alive/**",)
    GATEWAY_TOKEN = ("{robot}/@alive/gateway",)
    OPERATOR_TOKEN = ("{robot}/@alive/operator.{name}.$*",)
    HQ_TOKEN = ("{robot}/@alive/hq.{name}.$*",)
    WHOAMI = ("@bus/whoami/{name}",)
    ADMIN = ("@/**",)
    EVERYTHING = ("**", "**/@cmd/**", "**/@rpc/**", "**/@wire/**", "**/@alive/**", "**/@bus/**", "@mark", "@/**")


class Grant(msgspec.Struct, frozen=True):
    """What may be sent on a class of keys. own: of the member's robots only, not of all."""

    keys: Keys
    kinds: tuple[Kind, ...]
    own: bool = False


Column = Literal["viewer", "operator", "supervisor", "gateway", "gateway with listeners", "hq", "recorder", "router"]
"""What members the table tells apart: the roles, and a gateway whose process serves HQ programs too."""

_LISTEN = (Kind.SUBSCRIBE, Kind.QUERY)
_SEE = (Kind.ASK_ALIVE, Kind.WATCH_ALIVE)
_ANSWER = (Kind.QUERYABLE, Kind.REPLY)

_VIEWER = (
    Grant(Keys.DATA, _LISTEN),
    Grant(Keys.ALIVE, _SEE),
    Grant(Keys.SESSIONS, (Kind.QUERY,)),
    Grant(Keys.STOP, (Kind.PUT,)),
    Grant(Keys.WHOAMI, (Kind.QUERY,)),
)
_DRIVER = (
    *_VIEWER,
    Grant(Keys.COMMANDS, (Kind.PUT,)),
    Grant(Keys.MARK, (Kind.PUT,)),
    Grant(Keys.ACQUIRE, (Kind.QUERY,)),
    Grant(Keys.LEASE, (Kind.QUERY,)),
    Grant(Keys.ASK, (Kind.QUERY,)),
    Grant(Keys.OPERATOR_TOKEN, (Kind.TOKEN,)),
)
_OPERATOR = (*_DRIVER, Grant(Keys.UNLATCH, (Kind.QUERY,)))
_SUPERVISOR = (
    *_OPERATOR,
    Grant(Keys.TAKEOVER, (Kind.QUERY,)),
    Grant(Keys.UNLATCH_FLEET, (Kind.QUERY,)),
    Grant(Keys.RESTART, (Kind.QUERY,)),
    Grant(Keys.WIRE, (Kind.SUBSCRIBE,)),
    Grant(Keys.ADMIN, (Kind.QUERY,)),
)
_HQ = (
    *(msgspec.structs.replace(grant, own=True) for grant in _DRIVER),
    Grant(Keys.HQ_ACQUIRE, (Kind.QUERY,), own=True),
    Grant(Keys.HQ_REFUSED, (Kind.QUERY,), own=True),
    Grant(Keys.HQ_SESSIONS, _ANSWER, own=True),
    Grant(Keys.HQ_TOKEN, (Kind.TOKEN,), own=True),
)
_GATEWAY = (
    Grant(Keys.DATA, (Kind.PUT, *_ANSWER), own=True),
    Grant(Keys.COMMANDS, (Kind.SUBSCRIBE,), own=True),
    Grant(Keys.RPC, _ANSWER, own=True),
    Grant(Keys.CLAIM, (Kind.QUERY,), own=True),
    Grant(Keys.LATCH, (Kind.QUERY,)),
    Grant(Keys.WIRE, (Kind.PUT,), own=True),
    Grant(Keys.ALIVE, _SEE, own=True),
    Grant(Keys.GATEWAY_TOKEN, (Kind.TOKEN,), own=True),
    Grant(Keys.WHOAMI, (Kind.QUERY,)),
)
_RECORDER = (
    Grant(Keys.DATA, _LISTEN),
    Grant(Keys.COMMANDS, (Kind.SUBSCRIBE,)),
    Grant(Keys.MARK, (Kind.SUBSCRIBE,)),
    Grant(Keys.WIRE, (Kind.SUBSCRIBE,)),
    Grant(Keys.ALIVE, _SEE),
    Grant(Keys.SESSIONS, (Kind.QUERY,)),
    Grant(Keys.WHOAMI, (Kind.QUERY,)),
)

GRANTS: Mapping[Column, tuple[Grant, ...]] = {
    "viewer": _VIEWER,
    "operator": _OPERATOR,
    "supervisor": _SUPERVISOR,
    "gateway": _GATEWAY,
    "gateway with listeners": (*_GATEWAY, *_HQ),
    "hq": _HQ,
    "recorder": _RECORDER,
    "router": (Grant(Keys.EVERYTHING, tuple(Kind)),),
}

NEEDED: Mapping[str, Role] = {
    "run, a robot": "gateway",
    "run, HQ programs only": "hq",
    "replay": "gateway",
    "ls, echo, stop, top, foxglove, ros2, console": "viewer",
    "drive, unlatch, mark; foxglove, ros2 and console that drive": "operator",
    "drive --takeover, unlatch --all, restart, doctor": "supervisor",
    "record": "recorder",
    "router": "router",
}
"""Which role each command needs at least."""


def column(member: Member) -> Column:
    """Return what the table calls a member."""
    return "gateway with listeners" if member.listeners else member.role


def expressions(keys: Keys, realm: str, name: str, robots: Iterable[str]) -> Iterator[str]:
    """Write a class of keys as key expressions, for a member's name and for these robots."""
    for path in keys.value:
        for robot in robots if "{robot}" in path else ("",):
            written = path.format(robot=robot, name=name)
            if written == "*/**":  # a rule passes what it includes: a subscription to all of a realm, too
                written = "**"
            yield written if path.startswith("@/") else f"{realm}/{written}"


def granted(name: str, member: Member, realm: str) -> dict[tuple[Kind, ...], tuple[str, ...]]:
    """Return the key expressions that a member may use, by the kinds of messages that it may send on them."""
    by_kinds: dict[tuple[Kind, ...], dict[str, None]] = {}
    for grant in GRANTS[column(member)]:
        robots = member.robots if grant.own else ("*",)
        for expression in expressions(grant.keys, realm, name, robots):
            by_kinds.setdefault(grant.kinds, {})[expression] = None
    return {kinds: tuple(written) for kinds, written in by_kinds.items()}
