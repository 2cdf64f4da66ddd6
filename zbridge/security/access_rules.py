"""The access rules of a router, in Zenoh's own form, made of ``roles.toml`` and :mod:`zbridge.security.access`.

Ingress rules confine: each member may send what the table grants, and nothing else. One egress rule is shared by all
known members and is as wide as the widest key expression that anybody uses. A rule passes only what its key expression
includes: narrow egress rules would lose stops with wildcards, gets, and the news of subscriptions with wildcards,
without which publishers send nothing. A member receives only what it subscribed to or asked for, and ingress rules
confine both. Knows no Zenoh; all functions return what JSON can hold.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from zbridge.fleet.topics import CMD_STOP, size_bounds
from zbridge.security.access import Keys, Kind, expressions, granted
from zbridge.security.roles import Roles

STOPS_HZ = 1000.0
"""Stops a second that one member may send to one robot.

So many cost its gateway a few hundredths of a processor. A stop with wildcards counts for the first robot that it
matches, and Zenoh drops it if that robot was sent one a moment ago: the moment must be short.
"""
MESSAGE_BYTES = 16 * 1024 * 1024
"""Bound of every other message: a large image. Zenoh's own is 1 GB for each session."""
_EVERYBODY = "everybody"
_BOUNDED = ("put", "delete", "query", "reply")


def access_control(roles: Roles, realm: str) -> dict[str, Any]:
    """Return Zenoh's ``access_control``: default deny, subjects by the common names of their certificates."""
    users: dict[tuple[tuple[Kind, ...], tuple[str, ...]], list[str]] = {}
    for name, member in roles.names.items():
        for rule in granted(name, member, realm).items():
            users.setdefault(rule, []).append(roles.common_name(name))
    rules = [_rule(_EVERYBODY, "egress", tuple(Kind), _widest(realm))]
    obeyed = {roles.common_name(name): [_EVERYBODY] for name in roles.names}
    for (kinds, key_exprs), common_names in users.items():
        rule_id = f"{_some(common_names)}: {', '.join(kinds)}"
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
    """Return Zenoh's ``low_pass_filter``: what comes in must be no larger than its class allows.

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
    """Return Zenoh's ``downsampling``: so many stops a second of each member to each robot that ``roles.toml`` names.

    Zenoh counts per link and rule and keeps the first: one rule on all robots would lose the stops of all but one. On
    drives there must be no rule, since the first of a second is not the newest.
    """
    robots = sorted({robot for member in roles.names.values() for robot in member.robots})
    if not robots:
        return []
    rules = [{"key_expr": f"{realm}/{robot}/{CMD_STOP.path}", "freq": stops_hz} for robot in robots]
    return [{"id": "stops", "flows": ["ingress"], "messages": ["put"], "rules": rules}]


def _widest(realm: str) -> tuple[str, ...]:
    return tuple(expressions(Keys.EVERYTHING, realm, "", ()))


def _some(names: list[str]) -> str:
    """Name a few, and how many more there are; no two different lists of one kind of rule begin with the same name."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _rule(name: str, flow: str, kinds: Iterable[Kind], key_exprs: Iterable[str]) -> dict[str, Any]:
    return {
        "id": name,
        "flows": [flow],
        "messages": [kind.value for kind in kinds],
        "permission": "allow",
        "key_exprs": list(key_exprs),
    }
