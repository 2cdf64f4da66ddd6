"""The schemas of pictures: Foxglove's own (protobuf), and JSON schemas made of the declarations of fleet messages."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect

from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.payload import schema as schema_name


class Schema(msgspec.Struct, frozen=True):
    """How a viewer reads the messages of a channel.

    encoding: of the schema, ``protobuf`` (a FileDescriptorSet) or ``jsonschema``. message_encoding: of the messages,
    ``protobuf`` or ``json``.
    """

    name: str
    encoding: str
    data: bytes
    message_encoding: str


@cache
def foxglove_schema(name: str) -> Schema:
    """Return the schema of one of Foxglove's messages, by its name without the package: ``LaserScan``."""
    from foxglove import messages

    schema = getattr(messages, name).get_schema()
    return Schema(schema.name, schema.encoding, schema.data, "protobuf")


@cache
def json_schema(message: type[FleetMessage]) -> Schema:
    """Return the schema of a fleet message written as JSON.

    Viewers read plain schemas only: no references, and one type a field. A field that may be null has the type that it
    has otherwise; bytes are base64.
    """
    schema = _described(inspect.type_info(message))
    return Schema(schema_name(message), "jsonschema", json.dumps(schema).encode(), "json")


def _described(kind: inspect.Type) -> dict[str, Any]:
    """Describe a declared type as a JSON schema."""
    if isinstance(kind, inspect.Metadata):
        return _described(kind.type)
    if isinstance(kind, inspect.UnionType):
        return _described(next(one for one in kind.types if not isinstance(one, inspect.NoneType)))
    if isinstance(kind, inspect.StructType):
        fields = {field.encode_name: _described(field.type) for field in kind.fields}
        return {"type": "object", "properties": fields}
    if isinstance(kind, inspect.VarTupleType | inspect.ListType):
        return {"type": "array", "items": _described(kind.item_type)}
    if isinstance(kind, inspect.TupleType):
        return {"type": "array", "items": _described(kind.item_types[0])}
    if isinstance(kind, inspect.BytesType):
        return {"type": "string", "contentEncoding": "base64"}
    return {"type": _PLAIN[type(kind)]}


_PLAIN: dict[type[inspect.Type], str] = {
    inspect.BoolType: "boolean",
    inspect.DictType: "object",
    inspect.FloatType: "number",
    inspect.IntType: "integer",
    inspect.LiteralType: "string",
    inspect.StrType: "string",
}
