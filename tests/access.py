"""Who may do what as a table: what the code grants, what a router was seen to let through, and the page, in one form.

``python -m tests.access`` prints the table of ``roles.md`` as the code grants it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import zenoh

from zbridge.security.access import Column, MessageKind, column, granted
from zbridge.security.roles import Member, Roles

REALM = "fleet"
OWN, OTHER = "r1", "r2"
"""The robot that members name, where their role names robots; and another one."""
STRANGER = "zed"
"""A name that no member has."""

LAB = Roles(
    {
        "v1": Member("viewer"),
        "op1": Member("operator"),
        "sup1": Member("supervisor"),
        "g1": Member("gateway", (OWN,)),
        "g2": Member("gateway", (OWN,), listeners=True),
        "h1": Member("hq", (OWN,)),
        "rec1": Member("recorder"),
        "main": Member("router"),
    }
)
COLUMNS: dict[Column, str] = {column(member): name for name, member in LAB.names.items()}
"""The member of each column."""

PATHS = (
    "status",
    "scan",
    "raw/tcpudp",
    "sensor/front",
    "@cmd/stop",
    "@cmd/drive",
    "@cmd/raw/tcpudp",
    "@rpc/control/acquire/{name}",
    "@rpc/control/acquire/{stranger}",
    "@rpc/control/acquire/hq.{name}",
    "@rpc/control/acquire/hq.{stranger}",
    "@rpc/control/takeover/{name}",
    "@rpc/control/takeover/{stranger}",
    "@rpc/control/unlatch/{name}",
    "@rpc/control/unlatch/{stranger}",
    "@rpc/control/unlatch_fleet/{name}",
    "@rpc/control/unlatch_fleet/{stranger}",
    "@rpc/control/renew",
    "@rpc/control/release",
    "@rpc/control/refused/hq.{name}",
    "@rpc/control/refused/hq.{stranger}",
    "@rpc/map",
    "@rpc/pose",
    "@rpc/restart/{name}",
    "@rpc/blackbox/incidents",
    "@rpc/blackbox/read/{name}",
    "@rpc/blackbox/keep/{name}",
    "@rpc/blackbox/read/{stranger}",
    "@rpc/blackbox/keep/{stranger}",
    "@rpc/restart/{stranger}",
    "@rpc/latch",
    "@rpc/claim/gateway",
    "@rpc/sessions/gateway",
    "@rpc/sessions/hq.{name}.1",
    "@rpc/sessions/hq.{stranger}.1",
    "@wire/robot/in",
    "@gateway/stats",
    "@alive/gateway",
    "@alive/operator.{name}.a1.1",
    "@alive/operator.{stranger}.a1.1",
    "@alive/hq.{name}.7",
    "@alive/hq.{stranger}.7",
)
"""Keys below a robot."""
OTHERS = ("fleet/@mark", "fleet/@bus/whoami/{name}", "fleet/@bus/whoami/{stranger}", "@/a1/router")
"""Keys that are no robot's: of the realm, and of Zenoh's admin space."""


class Try(NamedTuple):
    """One message of one member: what the tests try, and what the table has a word for."""

    column: Column
    path: str
    kind: MessageKind
    robot: str | None

    @property
    def key(self) -> str:
        written = self.path.format(name=COLUMNS[self.column], stranger=STRANGER)
        return written if self.robot is None else f"{REALM}/{self.robot}/{written}"


def tries() -> list[Try]:
    """Give every message that can be tried: role x key class x kind of message."""
    return [
        Try(column, path, kind, robot)
        for column in COLUMNS
        for paths, robots in ((PATHS, (OWN, OTHER)), (OTHERS, (None,)))
        for path in paths
        for robot in robots
        for kind in MessageKind
    ]


def granted_by_the_code(roles: Roles = LAB) -> set[Try]:
    """Give the tries that the code's table allows."""
    rules = {
        column: [
            (kinds, [zenoh.KeyExpr(written) for written in key_exprs])
            for kinds, key_exprs in granted(name, roles.names[name], REALM).items()
        ]
        for column, name in COLUMNS.items()
    }
    return {
        each
        for each in tries()
        if any(
            each.kind in kinds and any(allowed.includes(zenoh.KeyExpr(each.key)) for allowed in key_exprs)
            for kinds, key_exprs in rules[each.column]
        )
    }


WORDS: tuple[tuple[str, tuple[MessageKind, ...]], ...] = (
    ("everything", tuple(MessageKind)),
    ("put", (MessageKind.PUT,)),
    ("delete", (MessageKind.DELETE,)),
    ("subscribe", (MessageKind.SUBSCRIBE,)),
    ("query", (MessageKind.QUERY,)),
    ("answer", (MessageKind.QUERYABLE, MessageKind.REPLY)),
    ("offer", (MessageKind.QUERYABLE,)),
    ("reply", (MessageKind.REPLY,)),
    ("token", (MessageKind.TOKEN,)),
    ("see", (MessageKind.ASK_ALIVE, MessageKind.WATCH_ALIVE)),
    ("ask alive", (MessageKind.ASK_ALIVE,)),
    ("watch alive", (MessageKind.WATCH_ALIVE,)),
)


def in_words(kinds: set[MessageKind]) -> list[str]:
    left, words = set(kinds), []
    for word, meant in WORDS:
        if left.issuperset(meant):
            words.append(word)
            left -= set(meant)
    return words


def cell(allowed: Callable[[str | None], set[MessageKind]], robots: tuple[str | None, ...]) -> str:
    """Write what is allowed on a path: of all robots, and of the own one only."""
    of_all = set.intersection(*map(allowed, robots))
    own = allowed(robots[0]) - of_all
    other = set.union(*map(allowed, robots)) - of_all - own
    parts = [", ".join(in_words(of_all))] if of_all else []
    parts += [f"own: {', '.join(in_words(own))}"] if own else []
    parts += [f"OTHER ONLY: {', '.join(in_words(other))}"] if other else []
    return "; ".join(parts) or "-"


def table(allowed: set[Try]) -> str:
    """Write the table of ``roles.md``; paths that no column tells apart share a row."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for paths, robots in ((PATHS, (OWN, OTHER)), (OTHERS, (None,))):
        for path in paths:
            cells = tuple(
                cell(
                    lambda robot, column=column, path=path: {
                        kind for kind in MessageKind if Try(column, path, kind, robot) in allowed
                    },
                    robots,
                )
                for column in COLUMNS
            )
            shown = path.format(name="<name>", stranger="<other>").removeprefix("fleet/")
            rows.setdefault(cells, []).append(f"`{shown}`")
    lines = ["| keys | " + " | ".join(COLUMNS) + " |", "|---" * (1 + len(COLUMNS)) + "|"]
    lines += [f"| {', '.join(paths)} | " + " | ".join(cells) + " |" for cells, paths in rows.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(table(granted_by_the_code()), end="")
