"""Fleet messages as bus payloads: MessagePack maps with the field names as declared. Sans-IO.

``ranges`` and ``cells`` are little-endian ``bin``, all other vectors plain arrays. ``stamp_ns``, ``seq`` and
``device_ms`` are absent where unknown; every other field is always present.
"""

from __future__ import annotations

from functools import cache
from typing import Any, TypeVar

import msgpack
import msgspec
import numpy as np

from zbridge.errors import PayloadError
from zbridge.fleet.messages import FleetMessage, Floats, Map

F = TypeVar("F", bound=FleetMessage)

ENCODING = "application/msgpack"


def schema(message: type[FleetMessage]) -> str:
    """Return the schema name of a message class: ``zbridge.Scan.v1``."""
    return f"zbridge.{message.__name__}.v1"


def _array_bytes(value: Any) -> memoryview:
    """Return the bytes of an array: uint8 unchanged, any other dtype as little-endian float32."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"{type(value).__name__} has no place in a payload")
    if value.dtype == _F4 and value.ndim == 1 and value.flags.c_contiguous:
        return value.data
    dtype = "|u1" if value.dtype == np.uint8 else "<f4"
    return np.ascontiguousarray(value, dtype).reshape(-1).view(np.uint8).data


encode = msgspec.msgpack.Encoder(enc_hook=_array_bytes).encode
"""``encode(message)``: the payload of a message, a MessagePack map."""


def decode(message: type[F], payload: bytes) -> F:
    """Decode a payload as ``message``; raise PayloadError with the field and what was expected.

    An empty payload is an empty map. Unknown fields are ignored; missing optional fields take their default.
    ``ranges`` becomes a read-only float32[n], ``cells`` a read-only uint8[rows, columns].
    """
    try:
        decoded: F = _decoder(message).decode(payload or _EMPTY)
        if isinstance(decoded, Map):
            decoded = _shaped(decoded)
    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
        raise PayloadError(f"{message.__name__}: {error}") from error
    return decoded


def pack(values: dict[str, Any]) -> bytes:
    """Pack a plain map as a payload."""
    payload: bytes = msgpack.packb(values)
    return payload


def unpack(payload: bytes) -> dict[str, Any]:
    """Unpack any payload into a plain map; an empty payload is an empty map."""
    if not payload:
        return {}
    try:
        values = msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise PayloadError(f"not MessagePack: {error}") from error
    if not isinstance(values, dict):
        raise PayloadError(f"a map was expected, got {type(values).__name__}")
    return values


_F4 = np.dtype("<f4")
_EMPTY = b"\x80"


@cache
def _decoder(message: type[FleetMessage]) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(message, dec_hook=_array)


def _array(kind: Any, value: Any) -> Any:
    """Read an array of the declared type."""
    dtype = np.dtype("<f4") if kind == Floats else np.dtype("|u1")
    if not isinstance(value, bytes) or len(value) % dtype.itemsize:
        raise ValueError(f"bin of {dtype.name} was expected")
    return np.frombuffer(value, dtype)


def _shaped(message: Map) -> Any:
    """Shape the cells to rows x columns; raise ValueError where their number differs."""
    rows, columns, cells = message.rows, message.columns, message.cells
    if rows < 0 or columns < 0 or rows * columns != cells.size:
        raise ValueError(f"{cells.size} cells do not fill {rows} rows x {columns} columns")
    return msgspec.structs.replace(message, cells=cells.reshape(rows, columns))
