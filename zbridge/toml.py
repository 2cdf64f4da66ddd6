"""TOML files as structs: what is wrong in a file is told with its key, its value and what was expected.

Reading never waits for somebody else: only regular files of a bounded size are read.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from zbridge.errors import ConfigError, ZbridgeError

T = TypeVar("T")

FILE_BYTES = 1_000_000
"""Largest file that is read, unless a host allows more for its robot files."""
_SHOWN = 200
"""Characters of a wrong value that an error shows."""
_KEY_PARTS = 1000
"""A longer dotted key is not read: the time that tomllib needs grows with the square of its parts."""
_BETWEEN_KEYS = re.compile(rb"[,=\[\]{}#\r\n]")
_PATH = re.compile(r" - at `\$(?:\.(?P<path>[^`]+)|(?P<index>\[[^`]+))?`$")

_SECRET = re.compile(r"pass|secret|token|key|credential|private|auth", re.IGNORECASE)
_IN_ADDRESS = re.compile(r"(?<=//)[^/@\s]*@")
_IN_QUERY = re.compile(rf"(?<=[?&;])([^=&#\s]*(?:{_SECRET.pattern})[^=&#\s]*=)[^&;#\s]*", re.IGNORECASE)
HIDDEN = "***"


def read_file(path: Path, most_bytes: int = FILE_BYTES, *, waits: bool = False) -> bytes:
    """Read a regular file of ``most_bytes`` at most; raise ConfigError, which names the file.

    waits: read a pipe too, which may take as long as its writer wants. Without it nothing is waited for but the disk.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOCTTY | (0 if waits else os.O_NONBLOCK))
        try:
            state = os.fstat(descriptor)
            if not (stat.S_ISREG(state.st_mode) or (waits and stat.S_ISFIFO(state.st_mode))):
                raise ConfigError(f"{path}: expected a regular file")
            with os.fdopen(descriptor, "rb", closefd=False) as file:
                content = file.read(most_bytes + 1)
        finally:
            os.close(descriptor)
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise ConfigError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    if len(content) > most_bytes:
        raise ConfigError(f"{path}: {max(state.st_size, len(content))} bytes, expected {most_bytes} at most")
    return content


def read_toml(path: Path, most_bytes: int = FILE_BYTES) -> dict[str, Any]:
    """Read a TOML file of ``most_bytes`` at most; raise ConfigError, which names the file."""
    return parse_toml(path, read_file(path, most_bytes))


def parse_toml(path: Path, content: bytes) -> dict[str, Any]:
    """Read the content of a TOML file; raise ConfigError, which names the file."""
    if any(part.count(b".") >= _KEY_PARTS for part in _BETWEEN_KEYS.split(content)):
        raise ConfigError(f"{path}: not TOML: nested too deeply")
    try:
        return tomllib.loads(content.decode("utf-8"))
    except ValueError as error:  # also of numbers with thousands of digits, and of bytes that are not UTF-8
        raise ConfigError(f"{path}: not TOML: {_short(str(error))}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: not TOML: nested too deeply") from error


def as_toml(value: object) -> str:
    """Write a value as TOML, on one line: JSON's forms of strings and numbers are TOML's, those of tables are not."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{as_toml(name)} = {as_toml(item)}" for name, item in value.items()) + "}"
    return msgspec.json.encode(value).decode()


def read_struct(path: Path, kind: type[T]) -> T:
    """Make a struct of a TOML file; raise ConfigError, which names file, key, value and what was expected."""
    raw = read_toml(path)
    with prefixed(f"{path}: "):
        return convert(raw, kind)


@contextlib.contextmanager
def prefixed(prefix: str, *errors: type[ZbridgeError]) -> Iterator[None]:
    """Raise ConfigErrors, and these other errors, as ConfigErrors with a prefix that says where: file or key."""
    kinds: tuple[type[ZbridgeError], ...] = (ConfigError, *errors)
    try:
        yield
    except kinds as error:
        raise ConfigError(f"{prefix}{error}") from error


def convert(raw: Any, kind: type[T], prefix: str = "") -> T:
    """Make a struct of a table; raise ConfigError, which names key, value and what was expected.

    prefix: what stands before the keys of this table, for example ``device.options.``
    """
    with prefixed(prefix):  # for options that contradict each other, too
        try:
            return msgspec.convert(raw, kind)
        except msgspec.ValidationError as error:
            raise ConfigError(_explain(raw, kind, str(error))) from error


def _explain(raw: Any, kind: type[Any], text: str) -> str:
    """Rewrite msgspec's message as ``key = value: what was expected``."""
    match = _PATH.search(text)
    path = (match["path"] or match["index"] or "") if match else ""
    what = text[: match.start()] if match else text
    if unknown := re.match(r"Object contains unknown field `(.+)`", what):
        known = ", ".join(field.encode_name for field in getattr(_type_at(kind, path), "fields", ()))
        key = f"{path}.{unknown[1]}" if path else unknown[1]
        return f"{_short(key)} = {_shown(raw, key)}: unknown key; expected one of {known}"
    if missing := re.match(r"Object missing required field `(.+)`", what):
        return f"{path}.{missing[1]}: missing, it is required" if path else f"{missing[1]}: missing, it is required"
    if what.startswith("Invalid enum value"):
        at = _type_at(kind, path)
        members = at.types if isinstance(at, inspect.UnionType) else (at,)
        literals = [value for member in members if isinstance(member, inspect.LiteralType) for value in member.values]
        what = f"expected one of {', '.join(map(repr, literals))}"
    return f"{path} = {_shown(raw, path)}: {what[:1].lower()}{what[1:]}"


def _shown(raw: Any, path: str) -> str:
    return _short(repr(_value(raw, path)))


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _parts(path: str) -> list[str]:
    return re.findall(r"[^.\[\]]+", path)


def _value(raw: Any, path: str) -> Any:
    for part in _parts(path):
        try:
            raw = raw[int(part)] if isinstance(raw, list) else raw[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return raw


def _type_at(kind: type[Any], path: str) -> inspect.Type:
    """Return the declared type at a path of a configuration."""
    at = _plain_type(inspect.type_info(kind))
    for part in _parts(path):
        if isinstance(at, inspect.StructType):
            fields = {field.encode_name: field.type for field in at.fields}
            at = _plain_type(fields.get(part, inspect.AnyType()))
        elif isinstance(at, inspect.VarTupleType | inspect.ListType):
            at = _plain_type(at.item_type)
    return at


def _plain_type(at: inspect.Type) -> inspect.Type:
    """Return X for ``X | None``."""
    if isinstance(at, inspect.UnionType):
        types = [member for member in at.types if not isinstance(member, inspect.NoneType)]
        return types[0] if len(types) == 1 else at
    return at


def without_secrets(value: Any, name: str = "") -> Any:
    """Return a configuration without what may be secret: values of telling names, the ``tls`` table, logins."""
    if name == "tls" or (_SECRET.search(name) and not isinstance(value, dict)):
        return HIDDEN
    if isinstance(value, dict):
        return {str(key): without_secrets(item, str(key)) for key, item in value.items()}
    if isinstance(value, list):
        return [without_secrets(item) for item in value]
    if isinstance(value, str):
        return _IN_QUERY.sub(rf"\g<1>{HIDDEN}", _IN_ADDRESS.sub(f"{HIDDEN}@", value))
    return value
