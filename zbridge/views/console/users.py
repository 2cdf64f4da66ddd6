"""The users of the console: a TOML file with their roles, hashed passwords and hashed tokens.

``[users.ann]`` has ``role``, ``password`` (scrypt, as :func:`hash_password` writes it) and ``tokens`` (SHA-256 of
random tokens, by the label of each). ``zbridge console user`` writes the file; a running console reads it again when it
changes.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
import re
import secrets
import stat
from pathlib import Path
from typing import Any

import msgspec

from zbridge.errors import ConfigError
from zbridge.security.files import SECRET, write
from zbridge.toml import as_toml, convert, prefixed, read_toml
from zbridge.views.console.rights import UserRole

N, R, P = 2**14, 8, 1
"""Parameters of scrypt: 55 ms and 16 MB for each hash."""
SHORTEST = 8
"""Characters of the shortest password."""
LONGEST = 1000
USERS, TOKENS = 1000, 20
"""Most users, and most tokens of one."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,47}")
"""A name without a dot: the lease of ``ann`` is asked for as ``console.ann``."""
_TOKEN = "zbc_"


class User(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One user. password, tokens: hashed; no password: tokens only."""

    role: UserRole
    password: str | None = None
    tokens: dict[str, str] = {}


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    users: dict[str, dict[str, Any]] = {}


def load_users(path: Path) -> dict[str, User]:
    """Read the users; raise ConfigError, which names the file, also if others can read it, or a group can write it."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    if mode & (stat.S_IWGRP | stat.S_IRWXO):  # systemd and Kubernetes let the group of a service read its secrets
        raise ConfigError(f"{path}: mode {stat.S_IMODE(mode):04o}: others can read or write it; expected 0600")
    raw = read_toml(path)
    with prefixed(f"{path}: "):
        tables = convert(raw, _File).users
        if len(tables) > USERS:
            raise ConfigError(f"{len(tables)} users, expected {USERS} at most")
        for name in tables:
            check_name(name)
        return {name: convert(table, User, f"users.{name}.") for name, table in tables.items()}


def save_users(path: Path, users: dict[str, User]) -> None:
    """Write the users, readable by their owner only; raise ConfigError."""
    lines = ["# Users of the console. Change this file with: zbridge console user"]
    for name, user in sorted(users.items()):
        fields: dict[str, Any] = {"role": user.role, "password": user.password, "tokens": user.tokens}
        lines += ["", f"[users.{name}]"]
        lines += [f"{field} = {as_toml(value)}" for field, value in fields.items() if value]
    write(path, "\n".join([*lines, ""]).encode(), SECRET)


def check_name(name: str) -> None:
    """Raise ConfigError for a name that no user may have."""
    if not _NAME.fullmatch(name):
        raise ConfigError(f"user {name!r:.60}: expected letters, digits, '_' and '-', 48 at most")


def hash_password(password: str) -> str:
    """Hash a password; raise ConfigError for one that is too short or too long."""
    if not SHORTEST <= len(password) <= LONGEST:
        raise ConfigError(f"a password of {len(password)} characters: expected {SHORTEST} to {LONGEST}")
    salt = os.urandom(16)
    return f"scrypt${N}${R}${P}${_text(salt)}${_text(_scrypt(password, salt, N, R, P))}"


def is_password(hashed: str | None, password: str) -> bool:
    """Return whether this is the password. Takes as long where there is none to compare with, and for a broken hash."""
    try:
        kind, n, r, p, salt, expected = (hashed or _NOBODY).split("$")
        numbers = (int(n), int(r), int(p))
        known = kind == "scrypt" and numbers == (N, R, P)
        found = _scrypt(password[:LONGEST], base64.b64decode(salt), N, R, P)
        return hmac.compare_digest(found, base64.b64decode(expected)) and known and hashed is not None
    except ValueError:
        return False


def new_token() -> tuple[str, str]:
    """Return a token for a program, and what the file keeps of it."""
    token = _TOKEN + secrets.token_urlsafe(32)
    return token, hash_token(token)


def hash_token(token: str) -> str:
    """Hash a token: it is random, so one round is enough."""
    return hashlib.sha256(token.encode()).hexdigest()


def _scrypt(password: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(password.encode("utf-8", "surrogatepass"), salt=salt, n=n, r=r, p=p, dklen=32)


def _text(raw: bytes) -> str:
    return base64.b64encode(raw).decode()


_NOBODY = f"scrypt${N}${R}${P}${_text(bytes(16))}${_text(bytes(32))}"
