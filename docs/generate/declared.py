"""The fields of a declared struct, as rows of a table: name, type with its range, default, meaning.

Docstrings explain fields as ``name: text.`` or ``name, other: text.`` after their first sentence.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from inspect import getsource
from itertools import pairwise
from typing import Any

import msgspec
from msgspec import UNSET, inspect

from zbridge.fleet.incidents import IncidentEntry
from zbridge.fleet.messages import Device, Fault, FleetMessage, Latch, LinkStatus, Refusal
from zbridge.fleet.processes import DiskSpace, ListenerStats, ProcessStats, SessionEntry
from zbridge.toml import as_toml

ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):`(?:[~.])?(?:zbridge\.\w+\.)*([^`]+)`")
UNITS = {
    "s": "seconds", "ms": "milliseconds", "ns": "nanoseconds", "hz": "a second", "m": "metres", "bytes": "bytes",
    "deg": "degrees", "days": "days", "mps": "m/s", "radps": "rad/s", "rad": "radians", "m_s": "m/s", "rad_s": "rad/s",
    "m_s2": "m/s2", "per_s": "a second",
}  # fmt: skip
PARTS = (
    Device
    | Fault
    | Latch
    | LinkStatus
    | Refusal
    | DiskSpace
    | ListenerStats
    | ProcessStats
    | SessionEntry
    | IncidentEntry
)
"""Parts of messages, which have a heading of their own."""
FAR = 1e9
"""A bound so far away only keeps out what is no number."""
PLAIN = {
    inspect.FloatType: "number", inspect.IntType: "integer", inspect.StrType: "text", inspect.BoolType: "true, false",
    inspect.BytesType: "bytes", inspect.AnyType: "any",
}  # fmt: skip


@dataclass(frozen=True)
class Field:
    """One field of a struct, for people."""

    name: str
    type: str
    default: str
    meaning: str


def table(heading: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Write a table of Markdown."""
    heading = list(heading)
    lines = [heading, ["---"] * len(heading), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def plain(text: str) -> str:
    """Write the text of a docstring as Markdown on one line."""
    return re.sub(r"\s+", " ", ROLE.sub(r"`\1`", text)).replace("``", "`").strip()


def fields(struct: type[msgspec.Struct]) -> list[Field]:
    """Return the fields of a struct in their order."""
    info = inspect.type_info(struct)
    assert isinstance(info, inspect.StructType)
    told = meanings(struct)
    return [
        Field(
            each.encode_name,
            described(each.type) + unit(each.encode_name, each.type),
            default(each),
            told.get(each.name, ""),
        )
        for each in info.fields
    ]


def meanings(struct: type[msgspec.Struct]) -> dict[str, str]:
    """Read what the docstring of a struct says of its fields."""
    told: dict[str, str] = {}
    for base in reversed(struct.__mro__):
        if issubclass(base, msgspec.Struct):
            _, *parts = split(base, struct.__struct_fields__)
            for names, text in zip(parts[::2], parts[1::2], strict=True):
                told |= dict.fromkeys(names.split(", "), text.strip(" .;,"))
    return told


def members(enum: type[Enum]) -> Iterator[tuple[str, str]]:
    """Yield each member of an enum, and the text below it."""
    (declared,) = ast.parse(getsource(enum)).body
    assert isinstance(declared, ast.ClassDef)
    for member, text in pairwise(declared.body):
        if isinstance(member, ast.Assign) and isinstance(text, ast.Expr):
            yield ast.literal_eval(member.value), ast.literal_eval(text.value)


def summary(struct: type[Any]) -> str:
    """Return what the docstring of a struct says of the whole, before it turns to fields."""
    return split(struct, struct.__struct_fields__)[0].strip()


def split(struct: type[Any], names: Iterable[str]) -> list[str]:
    """Split a docstring at the labels of fields: what comes before, then alternating labels and texts."""
    known = "|".join(sorted(names, key=len, reverse=True)) or "-"
    return re.split(rf"(?:(?<=\. )|^)((?:{known})(?:, (?:{known}))*): ", plain(struct.__doc__ or ""))


def documented(body: list[ast.stmt]) -> dict[str, str]:
    """Read the docstrings of assigned names: a string below each."""
    told = {}
    for statement, below in pairwise(body):
        if isinstance(statement, ast.Assign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            told[ast.unparse(statement.targets[0])] = plain(str(below.value.value))
    return told


def described(kind: inspect.Type) -> str:
    """Describe a type with its range."""
    if isinstance(kind, inspect.Metadata):
        return described(kind.type)
    if isinstance(kind, inspect.UnionType):
        return ", or ".join(described(each) for each in kind.types if not isinstance(each, inspect.NoneType))
    if isinstance(kind, inspect.LiteralType):
        return ", ".join(f"`{value}`" for value in kind.values)
    if isinstance(kind, inspect.VarTupleType | inspect.ListType):
        return f"list of {described(kind.item_type)}"
    if isinstance(kind, inspect.TupleType):
        return f"[{', '.join(described(each) for each in kind.item_types)}]"
    if isinstance(kind, inspect.DictType):
        return "table"
    if isinstance(kind, inspect.StructType):
        return kind.cls.__name__ if issubclass(kind.cls, FleetMessage | PARTS) else "table"
    return PLAIN[type(kind)] + bounds(kind)


def bounds(kind: inspect.Type) -> str:
    """Write the range of a number, or the length of bytes."""
    low = [sign + number(value) for sign, value in _limits(kind, ("ge", "from "), ("gt", "above "))]
    high = [sign + number(value) for sign, value in _limits(kind, ("le", "to "), ("lt", "below "))]
    least, most = getattr(kind, "min_length", None), getattr(kind, "max_length", None)
    if least is not None and least == most:
        low.append(f"of {least}")
    return f" {' '.join(low + high)}" if low or high else ""


def number(value: float) -> str:
    """Write a number as people do: 1 000 000, 0.01."""
    return f"{value:_.0f}".replace("_", " ") if value == int(value) else f"{value:.4g}"


def _limits(kind: inspect.Type, *named: tuple[str, str]) -> Iterator[tuple[str, float]]:
    for name, sign in named:
        value = getattr(kind, name, None)
        if value is not None and abs(value) < FAR:
            yield sign, value


def unit(name: str, kind: inspect.Type) -> str:
    """Return the unit that the name of a number ends with."""
    endings = ("_".join(name.split("_")[place:]) for place in range(1, name.count("_") + 1))
    found = next((UNITS[ending] for ending in endings if ending in UNITS), None)
    return f", {found}" if found and isinstance(kind, inspect.FloatType | inspect.IntType | inspect.UnionType) else ""


def default(field: inspect.Field) -> str:
    """Write the default of a field, or that it is required."""
    if field.required:
        return "required"
    value: Any = UNSET  # a field that is left out has neither
    if field.default is not msgspec.NODEFAULT:
        value = field.default
    elif field.default_factory is not msgspec.NODEFAULT:
        value = field.default_factory()
    if value is None or value is UNSET:
        return "-"
    if isinstance(value, msgspec.Struct):
        return "its defaults"
    return f"`{as_toml(value)}`"
