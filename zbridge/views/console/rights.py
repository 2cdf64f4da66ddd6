"""What the users of the console may do: what their role may do on a secure bus. Sans-IO.

The rights are read from the bus's own table (:mod:`zbridge.security.access`), so that both cannot differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal, get_args

import msgspec

from zbridge.security.access import GRANTS, Keys, MessageKind

UserRole = Literal["viewer", "operator", "supervisor"]
USER_ROLES: tuple[UserRole, ...] = get_args(UserRole)


class Action(StrEnum):
    """What a user asks the console for."""

    LOOK = "look"
    STOP = "stop"
    DRIVE = "drive"
    SWITCH = "switch"
    TAKE_OVER = "take_over"
    UNLATCH = "unlatch"
    UNLATCH_FLEET = "unlatch_fleet"
    FORGET = "forget"


NEEDS: Mapping[Action, tuple[Keys, MessageKind]] = {
    Action.LOOK: (Keys.DATA, MessageKind.SUBSCRIBE),
    Action.STOP: (Keys.STOP, MessageKind.PUT),
    Action.DRIVE: (Keys.ACQUIRE, MessageKind.QUERY),
    Action.SWITCH: (Keys.COMMANDS, MessageKind.PUT),
    Action.TAKE_OVER: (Keys.TAKEOVER, MessageKind.QUERY),
    Action.UNLATCH: (Keys.UNLATCH, MessageKind.QUERY),
    Action.UNLATCH_FLEET: (Keys.UNLATCH_FLEET, MessageKind.QUERY),
    Action.FORGET: (Keys.UNLATCH_FLEET, MessageKind.QUERY),  # a robot that is forgotten is missed by nobody
}
"""What on the bus a role must be permitted for an action."""
SAID: Mapping[Action, str] = {
    Action.LOOK: "watch robots",
    Action.STOP: "stop robots",
    Action.DRIVE: "drive",
    Action.SWITCH: "set switches",
    Action.TAKE_OVER: "take a robot over",
    Action.UNLATCH: "release a robot's latched stop",
    Action.UNLATCH_FLEET: "release the fleet's latched stop",
    Action.FORGET: "forget a robot",
}


def rights_of(role: str) -> frozenset[Action]:
    """Return what a role of the bus may do; nothing for one that is none of a person."""
    if role not in USER_ROLES:
        return frozenset()
    granted = {(grant.keys, kind) for grant in GRANTS[role] for kind in grant.kinds}
    return frozenset(action for action, need in NEEDS.items() if need in granted)


class Caller(msgspec.Struct, frozen=True):
    """Who asks for something. user: "" where the console knows no users. rights: of the user, and of the console.

    login, token: the secret of a browser's cookie, or of a program, hashed; both "" where there are no users.
    """

    user: str
    role: str
    rights: frozenset[Action]
    address: str = ""
    login: str = ""
    token: str = ""

    def may(self, action: Action) -> bool:
        """Return whether the caller may do this."""
        return action in self.rights

    def refusal(self, action: Action) -> str:
        """Say why the caller may not do this."""
        who = f"{self.user} ({self.role})" if self.user else f"this console ({self.role})"
        roles = " or ".join(role for role in USER_ROLES if action in rights_of(role))
        if self.user and action in rights_of(self.role):
            return f"the certificate of this console does not permit anybody to {SAID[action]}: it takes {roles}"
        return f"{who} may not {SAID[action]}: it takes the role {roles}"
