"""TOML files as structs: what is wrong in a file is told with its key, its value and what was expected."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from zbridge.errors import ConfigError

T = TypeVar("T")

_PATH = re.compile(r" - at `\$(?:\.(?P<path>[^`]+)|(?P<index>\[[^`]+))?`$")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raise ConfigError, which names the file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error


def convert(raw: Any, kind: type[T], prefix: str = "") -> T:
    """Make a struct of a table; raise ConfigError, which names key, value and what was expected.

    prefix: what stands before the keys of this table, for example ``device.options.``
    """
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(prefix + _explain(raw, kind, str(error))) from error
    except ConfigError as error:  # options that contradict each other
        raise ConfigError(f"{prefix}{error}") from error


def _explain(raw: Any, kind: type[Any], text: str) -> str:
    """Rewrite msgspec's message as ``key = value: what was expected``."""
    match = _PATH.search(text)
    path = (match["path"] or match["index"] or "") if match else ""
    what = text[: match.start()] if match else text
    if unknown := re.match(r"Object contains unknown field `(.+)`", what):
        known = ", ".join(_field_names(_type_at(kind, path)))
        key = f"{path}.{unknown[1]}" if path else unknown[1]
        return f"{key} = {_value(raw, key)!r}: unknown key; expected one of {known}"
    if missing := re.match(r"Object missing required field `(.+)`", what):
        return f"{path}.{missing[1]}: missing, it is required" if path else f"{missing[1]}: missing, it is required"
    if what.startswith("Invalid enum value"):
        at = _type_at(kind, path)
        members = at.types if isinstance(at, inspect.UnionType) else (at,)
        literals = [value for member in members if isinstance(member, inspect.LiteralType) for value in member.values]
        what = f"expected one of {', '.join(map(repr, literals))}"
    return f"{path} = {_value(raw, path)!r}: {what[:1].lower()}{what[1:]}"


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


def _field_names(at: inspect.Type) -> list[str]:
    return [field.encode_name for field in at.fields] if isinstance(at, inspect.StructType) else []
