"""Fleet messages as bus payloads: MessagePack maps with the field names as declared. Sans-IO.

``ranges`` and ``cells`` travel as little-endian ``bin``, all other vectors as plain arrays. The optional
``stamp_ns``, ``seq`` and ``device_ms`` are left out where unknown; every other field is always there.
"""

from __future__ import annotations

from typing import Any, TypeGuard, TypeVar

import msgpack
import msgspec
import numpy as np

from zbridge.errors import PayloadError
from zbridge.fleet.messages import FleetMessage, Map, Scan

F = TypeVar("F", bound=FleetMessage)

ENCODING = "application/msgpack"

_OPTIONAL = FleetMessage.__struct_fields__
_ARRAYS: dict[type[FleetMessage], tuple[str, str]] = {Scan: ("ranges", "<f4"), Map: ("cells", "|u1")}

_pack = msgpack.Packer(default=msgspec.structs.asdict).pack


def schema(message: type[FleetMessage]) -> str:
    """Name a message class as the schema of its encoding: ``zbridge.Scan.v1``."""
    return f"zbridge.{message.__name__}.v1"


def encode(message: FleetMessage) -> bytes:
    """Encode a fleet message as the MessagePack map its key carries."""
    values: dict[str, Any] = msgspec.structs.asdict(message)
    for name in _OPTIONAL:
        if values[name] is None:
            del values[name]
    array = _ARRAYS.get(type(message))
    if array is not None:
        name, dtype = array
        values[name] = np.ascontiguousarray(values[name], dtype).reshape(-1).view(np.uint8).data
    return pack(values)


def decode(message: type[F], payload: bytes) -> F:
    """Decode a payload as ``message``; raise PayloadError naming the field and what was expected.

    Unknown fields are ignored and missing optional ones take their default. ``ranges`` becomes a read-only
    float32[n], ``cells`` a read-only uint8[rows, columns].
    """
    values = unpack(payload)
    array = _ARRAYS.get(message)
    if array is not None:
        values = _with_array(message, values, *array)
    try:
        return msgspec.convert(values, message, dec_hook=_keep_array)
    except (msgspec.ValidationError, ValueError) as error:
        raise PayloadError(f"{message.__name__}: {error}") from error


def pack(values: dict[str, Any]) -> bytes:
    """Pack a plain map as a payload."""
    payload: bytes = _pack(values)
    return payload


def unpack(payload: bytes) -> dict[str, Any]:
    """Unpack any fleet payload into a plain map; an empty payload is an empty map."""
    if not payload:
        return {}
    try:
        values = msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise PayloadError(f"not MessagePack: {error}") from error
    if not isinstance(values, dict):
        raise PayloadError(f"a map was expected, got {type(values).__name__}")
    return values


def _with_array(message: type[FleetMessage], values: dict[str, Any], name: str, dtype: str) -> dict[str, Any]:
    raw = values.get(name)
    if not isinstance(raw, bytes) or len(raw) % np.dtype(dtype).itemsize:
        raise PayloadError(f"{message.__name__}.{name}: bin of {dtype} was expected")
    array = np.frombuffer(raw, dtype)
    if message is Map:
        rows, columns = values.get("rows"), values.get("columns")
        if not (_is_count(rows) and _is_count(columns) and rows * columns == array.size):
            raise PayloadError(f"Map.cells: {array.size} cells do not fill {rows} rows x {columns} columns")
        try:
            array = array.reshape(rows, columns)
        except (ValueError, OverflowError) as error:
            raise PayloadError(f"Map.cells: {rows} rows x {columns} columns: {error}") from error
    return {**values, name: array}


def _is_count(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and value >= 0


def _keep_array(kind: type[Any], value: Any) -> Any:
    return value
