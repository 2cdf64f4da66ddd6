"""Who may do what on a secure bus: one table, and the router's access rules made of it, in Zenoh's own form.

The table is :data:`GRANTS`: for each role, which messages it may send on which keys; ``roles.md`` shows it.
What it lacks is denied. Nothing is denied by name, because a denial of ``@cmd/drive`` would not match a put on
``@cmd/*``.

Ingress rules confine: each member may send what the table grants, and nothing else. One egress rule is shared by all
known members and is as wide as the widest key expression that anybody uses. A rule passes only what its key expression
includes: narrow egress rules would drop stops with wildcards, gets, and the declarations of subscriptions with
wildcards, without which publishers send nothing. A member receives only what it subscribed to or queried, and ingress
rules confine both. Knows no Zenoh: the rules are plain JSON values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from enum import Enum, StrEnum
from typing import Any, Literal

import msgspec

from zbridge.fleet.topics import CMD_STOP, size_bounds
from zbridge.security.roles import Member, Roles

STOPS_HZ = 1000.0
"""Stops a second that one member may send to one robot.

That many cost its gateway a few hundredths of a processor. A stop with wildcards counts for the first robot that it
matches, and Zenoh drops it if that robot was sent one just before: the interval must be short.
"""
MESSAGE_BYTES = 16 * 1024 * 1024
"""Most bytes of every other message: a large image. Zenoh's own bound is 1 GB per session."""
_EVERYBODY = "everybody"
_BOUNDED = ("put", "delete", "query", "reply")


class MessageKind(StrEnum):
    """The messages of Zenoh that its access rules distinguish."""

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

    ``{robot}``: a robot's name, or ``*``. ``{name}``: a member's name. Keys that begin with ``@/`` are Zenoh's own.
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
    INCIDENTS = ("{robot}/@rpc/blackbox/incidents",)
    INCIDENT_READ = ("{robot}/@rpc/blackbox/read/{name}",)
    INCIDENT_KEEP = ("{robot}/@rpc/blackbox/keep/{name}",)
    RPC = ("{robot}/@rpc/**",)
    HQ_ACQUIRE = ("{robot}/@rpc/control/acquire/hq.{name}", "{robot}/@rpc/control/acquire/hq.{name}.$*")
    HQ_REFUSED = ("{robot}/@rpc/control/refused/hq.{name}", "{robot}/@rpc/control/refused/hq.{name}.$*")
    HQ_SESSIONS = ("{robot}/@rpc/sessions/hq.{name}", "{robot}/@rpc/sessions/hq.{name}.$*")
    WIRE = ("{robot}/@wire/**",)
    STATS = ("{robot}/@gateway/*",)
    ALIVE = ("{robot}/@alive/**",)
    GATEWAY_TOKEN = ("{robot}/@alive/gateway",)
    OPERATOR_TOKEN = ("{robot}/@alive/operator.{name}.$*",)
    HQ_TOKEN = ("{robot}/@alive/hq.{name}.$*",)
    WHOAMI = ("@bus/whoami/{name}",)
    ADMIN = ("@/**",)
    EVERYTHING = (
        *("**", "**/@cmd/**", "**/@rpc/**", "**/@wire/**", "**/@alive/**", "**/@gateway/**"),
        *("**/@bus/**", "@mark", "@/**"),
    )


class Grant(msgspec.Struct, frozen=True):
    """What may be sent on a class of keys. own: only for the member's robots."""

    keys: Keys
    kinds: tuple[MessageKind, ...]
    own: bool = False


Column = Literal["viewer", "operator", "supervisor", "gateway", "gateway with listeners", "hq", "recorder", "router"]
"""The members that the table distinguishes: the roles, and a gateway whose process serves HQ programs too."""

_LISTEN = (MessageKind.SUBSCRIBE, MessageKind.QUERY)
_SEE = (MessageKind.ASK_ALIVE, MessageKind.WATCH_ALIVE)
_ANSWER = (MessageKind.QUERYABLE, MessageKind.REPLY)

_VIEWER = (
    Grant(Keys.DATA, _LISTEN),
    Grant(Keys.STATS, _LISTEN),
    Grant(Keys.ALIVE, _SEE),
    Grant(Keys.SESSIONS, (MessageKind.QUERY,)),
    Grant(Keys.INCIDENTS, (MessageKind.QUERY,)),
    Grant(Keys.STOP, (MessageKind.PUT,)),
    Grant(Keys.WHOAMI, (MessageKind.QUERY,)),
)
_DRIVER = (
    *_VIEWER,
    Grant(Keys.COMMANDS, (MessageKind.PUT,)),
    Grant(Keys.MARK, (MessageKind.PUT,)),
    Grant(Keys.INCIDENT_KEEP, (MessageKind.QUERY,)),
    Grant(Keys.ACQUIRE, (MessageKind.QUERY,)),
    Grant(Keys.LEASE, (MessageKind.QUERY,)),
    Grant(Keys.ASK, (MessageKind.QUERY,)),
    Grant(Keys.OPERATOR_TOKEN, (MessageKind.TOKEN,)),
)
_OPERATOR = (*_DRIVER, Grant(Keys.UNLATCH, (MessageKind.QUERY,)))
_SUPERVISOR = (
    *_OPERATOR,
    Grant(Keys.TAKEOVER, (MessageKind.QUERY,)),
    Grant(Keys.UNLATCH_FLEET, (MessageKind.QUERY,)),
    Grant(Keys.RESTART, (MessageKind.QUERY,)),
    Grant(Keys.INCIDENT_READ, (MessageKind.QUERY,)),
    Grant(Keys.WIRE, (MessageKind.SUBSCRIBE,)),
    Grant(Keys.ADMIN, (MessageKind.QUERY,)),
)
_HQ = (
    *(msgspec.structs.replace(grant, own=True) for grant in _DRIVER),
    Grant(Keys.HQ_ACQUIRE, (MessageKind.QUERY,), own=True),
    Grant(Keys.HQ_REFUSED, (MessageKind.QUERY,), own=True),
    Grant(Keys.HQ_SESSIONS, _ANSWER, own=True),
    Grant(Keys.HQ_TOKEN, (MessageKind.TOKEN,), own=True),
)
_GATEWAY = (
    Grant(Keys.DATA, (MessageKind.PUT, *_ANSWER), own=True),
    Grant(Keys.STATS, (MessageKind.PUT, *_ANSWER), own=True),
    Grant(Keys.COMMANDS, (MessageKind.SUBSCRIBE,), own=True),
    Grant(Keys.RPC, _ANSWER, own=True),
    Grant(Keys.CLAIM, (MessageKind.QUERY,), own=True),
    Grant(Keys.LATCH, (MessageKind.QUERY,)),
    Grant(Keys.WIRE, (MessageKind.PUT,), own=True),
    Grant(Keys.ALIVE, _SEE, own=True),
    Grant(Keys.GATEWAY_TOKEN, (MessageKind.TOKEN,), own=True),
    Grant(Keys.WHOAMI, (MessageKind.QUERY,)),
)
_RECORDER = (
    Grant(Keys.DATA, _LISTEN),
    Grant(Keys.STATS, _LISTEN),
    Grant(Keys.COMMANDS, (MessageKind.SUBSCRIBE,)),
    Grant(Keys.MARK, (MessageKind.SUBSCRIBE,)),
    Grant(Keys.WIRE, (MessageKind.SUBSCRIBE,)),
    Grant(Keys.ALIVE, _SEE),
    Grant(Keys.SESSIONS, (MessageKind.QUERY,)),
    Grant(Keys.WHOAMI, (MessageKind.QUERY,)),
)

GRANTS: Mapping[Column, tuple[Grant, ...]] = {
    "viewer": _VIEWER,
    "operator": _OPERATOR,
    "supervisor": _SUPERVISOR,
    "gateway": _GATEWAY,
    "gateway with listeners": (*_GATEWAY, *_HQ),
    "hq": _HQ,
    "recorder": _RECORDER,
    "router": (Grant(Keys.EVERYTHING, tuple(MessageKind)),),
}


def column(member: Member) -> Column:
    """Return what the table calls a member."""
    return "gateway with listeners" if member.listeners else member.role


def expressions(keys: Keys, realm: str, name: str, robots: Iterable[str]) -> Iterator[str]:
    """Return a class of keys as key expressions, for a member's name and these robots."""
    for path in keys.value:
        for robot in robots if "{robot}" in path else ("",):
            written = path.format(robot=robot, name=name)
            if written == "*/**":  # a rule passes what it includes: a subscription to all of a realm, too
                written = "**"
            yield written if path.startswith("@/") else f"{realm}/{written}"


def granted(name: str, member: Member, realm: str) -> dict[tuple[MessageKind, ...], tuple[str, ...]]:
    """Return the key expressions that a member may use, by the kinds of messages that it may send on them."""
    by_kinds: dict[tuple[MessageKind, ...], dict[str, None]] = {}
    for grant in GRANTS[column(member)]:
        robots = member.robots if grant.own else ("*",)
        for expression in expressions(grant.keys, realm, name, robots):
            by_kinds.setdefault(grant.kinds, {})[expression] = None
    return {kinds: tuple(written) for kinds, written in by_kinds.items()}


def access_control(roles: Roles, realm: str) -> dict[str, Any]:
    """Return Zenoh's ``access_control``: default deny, subjects by the common names of their certificates."""
    users: dict[tuple[tuple[MessageKind, ...], tuple[str, ...]], list[str]] = {}
    for name, member in roles.names.items():
        for rule in granted(name, member, realm).items():
            users.setdefault(rule, []).append(roles.common_name(name))
    rules = [_rule(_EVERYBODY, "egress", tuple(MessageKind), _widest(realm))]
    obeyed = {roles.common_name(name): [_EVERYBODY] for name in roles.names}
    for (kinds, key_exprs), common_names in users.items():
        more = f" and {len(common_names) - 1} more" if len(common_names) > 1 else ""
        rule_id = f"{common_names[0]}{more}: {', '.join(kinds)}"  # no two lists of one kind of rule begin with one name
        rules.append(_rule(rule_id, "ingress", kinds, key_exprs))
        for common_name in common_names:
            obeyed[common_name].append(rule_id)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in obeyed],
        "policies": [{"id": name, "rules": ids, "subjects": [name]} for name, ids in obeyed.items()],
    }


def low_pass_filter(realm: str, most_bytes: int = MESSAGE_BYTES) -> list[dict[str, Any]]:
    """Return Zenoh's ``low_pass_filter``: input must be no larger than its class allows.

    Commands and queries have the bounds of their keys, all else ``most_bytes`` (payload and attachment together).
    """
    bounds = [*size_bounds(), (_widest(realm), most_bytes)]
    return [
        {
            "id": f"at most {size} bytes",
            "flows": ["ingress"],
            "messages": list(_BOUNDED if size == most_bytes else _BOUNDED[:3]),
            "key_exprs": list(key_exprs),
            "size_limit": size,
        }
        for key_exprs, size in bounds
    ]


def downsampling(roles: Roles, realm: str, stops_hz: float = STOPS_HZ) -> list[dict[str, Any]]:
    """Return Zenoh's ``downsampling``: the stops per second of each member to each robot that ``roles.toml`` names.

    Zenoh counts per link and rule and keeps the first: one rule on all robots would lose the stops of all but one.
    There must be no rule on drives, because the first of a second is not the newest.
    """
    robots = sorted({robot for member in roles.names.values() for robot in member.robots})
    if not robots:
        return []
    rules = [{"key_expr": f"{realm}/{robot}/{CMD_STOP.path}", "freq": stops_hz} for robot in robots]
    return [{"id": "stops", "flows": ["ingress"], "messages": ["put"], "rules": rules}]


def _widest(realm: str) -> tuple[str, ...]:
    return tuple(expressions(Keys.EVERYTHING, realm, "", ()))


def _rule(name: str, flow: str, kinds: Iterable[MessageKind], key_exprs: Iterable[str]) -> dict[str, Any]:
    return {
        "id": name,
        "flows": [flow],
        "messages": [kind.value for kind in kinds],
        "permission": "allow",
        "key_exprs": list(key_exprs),
    }
