"""The names that may use a secure bus, and the role of each: ``roles.toml``.

``zbridge certs`` writes the file, and the router derives its access rules from it. Knows no certificate and no rule.
The common name of a member's certificate is ``role.name``. A name has no dots: ``operator.op1.$*``, which stands in
access rules for what belongs to op1, must not include what belongs to another name.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec

from zbridge.errors import ConfigError
from zbridge.fleet.topics import is_name
from zbridge.security.files import write
from zbridge.toml import as_toml, convert, prefixed, read_toml

Role = Literal["viewer", "operator", "supervisor", "gateway", "hq", "recorder", "router"]
ROLES: tuple[Role, ...] = get_args(Role)
OF_ROBOTS: tuple[Role, ...] = ("gateway", "hq")
"""Roles that are limited to named robots; all other roles are for the whole fleet."""

ROLES_BYTES = 16_000_000
"""Largest file of roles: a fleet's members have some 100 bytes each."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,47}")
"""With the longest role it fits the 64 characters of a common name."""
_RESERVED = ("hq",)
"""Forbidden names: a member that may query ``acquire/hq`` could do so as any listener, ``hq.<name>.<id>``."""


class Member(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The role of a name. robots: those of a gateway or an hq, at least one; no other role has any.

    listeners: a gateway whose process serves HQ programs too, so that it drives its robots for them.
    """

    role: Role
    robots: tuple[str, ...] = ()
    listeners: bool = False


class Roles(msgspec.Struct, frozen=True):
    """Who may use the bus. revoked: names that were revoked, and are never issued again."""

    names: dict[str, Member] = {}
    revoked: tuple[str, ...] = ()

    def common_name(self, name: str) -> str:
        """Return the common name of a member's certificate; raise KeyError for an unknown name."""
        return common_name(name, self.names[name].role)

    def with_member(self, name: str, member: Member) -> Roles:
        """Return these roles with a name added or replaced; raise ConfigError for what may not stand in the file."""
        return _checked(Roles({**self.names, name: member}, self.revoked))

    def without(self, name: str) -> Roles:
        """Return these roles with a name revoked; raise ConfigError if nobody has it."""
        if name not in self.names:
            known = ", ".join(self.names) or "nobody yet"
            raise ConfigError(f"{name!r}: not a name of this bus; known: {known}")
        names = {other: member for other, member in self.names.items() if other != name}
        return Roles(names, (*self.revoked, name))


class _RolesFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    names: dict[str, dict[str, Any]] = {}
    revoked: tuple[str, ...] = ()


def common_name(name: str, role: Role) -> str:
    """Return the common name of the certificate of a name with a role: ``operator.op1``."""
    return f"{role}.{name}"


def load_roles(path: Path) -> Roles:
    """Read ``roles.toml``; raise ConfigError, which names file, key, value and what was expected."""
    raw = read_toml(path, ROLES_BYTES)
    with prefixed(f"{path}: "):
        file = convert(raw, _RolesFile)
        names = {name: convert(table, Member, f"names.{name}.") for name, table in file.names.items()}
        return _checked(Roles(names, file.revoked))


def save_roles(path: Path, roles: Roles) -> None:
    """Replace ``roles.toml`` as a whole; raise ConfigError if the file cannot be written or the roles are not valid."""
    text = f"{_HEAD}revoked = {as_toml(_checked(roles).revoked)}\n"
    text += "".join(_table(name, member) for name, member in roles.names.items())
    write(path, text.encode())


def check_name(key: str, name: str) -> None:
    """Raise ConfigError if ``name`` cannot be a name in ``roles.toml``; ``key`` says where it stands."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{key} = {name!r}: expected at most 48 letters, digits, '_' and '-', a letter or digit first"
        )
    if name in _RESERVED:
        raise ConfigError(f"{key} = {name!r}: the names of all listeners begin with it; expected another name")


def check_member(key: str, member: Member) -> None:
    """Raise ConfigError if the robots do not fit the role, or are none; ``key`` says where they stand."""
    robots = list(member.robots)
    if member.role in OF_ROBOTS and not robots:
        raise ConfigError(f"{key} = []: expected the robots of this {member.role}, at least one")
    if member.role not in OF_ROBOTS and robots:
        raise ConfigError(
            f"{key} = {robots}: expected none: the role {member.role} is for all robots; only {' and '.join(OF_ROBOTS)}"
            " name theirs"
        )
    if member.listeners and member.role != "gateway":
        raise ConfigError(f"{key.removesuffix('.robots')}.listeners = true: expected only in a gateway")
    for robot in robots:
        if not is_name(robot):
            raise ConfigError(f"{key} = {robots}: {robot!r}: expected letters, digits, '_', '.' and '-' only")
    if len(set(robots)) < len(robots):
        raise ConfigError(f"{key} = {robots}: expected each robot once")


def _checked(roles: Roles) -> Roles:
    for name, member in roles.names.items():
        check_name("names", name)
        check_member(f"names.{name}.robots", member)
        if name in roles.revoked:
            raise ConfigError(f"names = {name!r}: this name is revoked; expected a new name")
    for name in roles.revoked:
        check_name("revoked", name)
    return roles


def _table(name: str, member: Member) -> str:
    robots = f"robots = {as_toml(member.robots)}\n" if member.robots else ""
    listeners = "listeners = true\n" if member.listeners else ""
    return f'\n[names.{name}]\nrole = "{member.role}"\n{robots}{listeners}'


_HEAD = """\
# Who may use the bus. The router makes its access rules of this file: restart it after a change.
# `zbridge certs` rewrites the file as a whole, and keeps no comments. A revoked name is never given again.
"""
