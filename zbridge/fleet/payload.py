"""Fleet messages as bus payloads: MessagePack maps with the field names as declared. Sans-IO.

``ranges`` and ``cells`` are little-endian ``bin``, all other vectors plain arrays. ``stamp_ns``, ``seq`` and
``device_ms`` are absent where unknown, ``t`` and ``max_age_s`` where nothing is dated; every other field is always
present.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, TypeVar

import msgpack
import msgspec

from zbridge.errors import PayloadError
from zbridge.fleet.messages import FleetMessage, Map, Scan

F = TypeVar("F", bound=FleetMessage)

ENCODING = "application/msgpack"
_STAMP_NAME = b"\xa8stamp_ns\xcf"
"""The field as our encoder writes it: the first of the map, its number in 8 bytes."""
_STAMP_AT = 1 + len(_STAMP_NAME)
_MAPS = range(0x80, 0x90)
_LARGEST_STAMP = 2**64 - 1


def schema(message: type[FleetMessage]) -> str:
    """Return the schema name of a message class: ``zbridge.Scan.v1``."""
    return f"zbridge.{message.__name__}.v1"


def _array_bytes(value: Any) -> memoryview:
    """Return the bytes of an array: uint8 unchanged, any other dtype as little-endian float32."""
    import numpy as np

    if not isinstance(value, np.ndarray):
        raise TypeError(f"{type(value).__name__} has no place in a payload")
    if value.dtype == "<f4" and value.ndim == 1 and value.flags.c_contiguous:
        return value.data
    dtype = "|u1" if value.dtype == np.uint8 else "<f4"
    return np.ascontiguousarray(value, dtype).reshape(-1).view(np.uint8).data


encode = msgspec.msgpack.Encoder(enc_hook=_array_bytes).encode
"""``encode(message)``: the payload of a message, a MessagePack map."""


def decode(message: type[F], payload: bytes, *, arrays: bool = True) -> F:
    """Decode a payload as ``message``; raise PayloadError with the field and what was expected.

    An empty payload is an empty map. Unknown fields are ignored; missing optional fields take their default.
    ``ranges`` becomes a read-only float32[n], ``cells`` a read-only uint8[rows, columns]; without ``arrays`` both stay
    bytes, of any length.
    """
    try:
        decoded: F = _decoder(message).decode(payload or _EMPTY)
        if not arrays:
            pass
        elif isinstance(decoded, Map):
            decoded = _with_cells(decoded)
        elif isinstance(decoded, Scan):
            decoded = _with_ranges(decoded)
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


def measured_ns(stamp_ns: int | msgspec.UnsetType, now_ns: int, end_ns: int) -> int:
    """Return the stamp, Unix nanoseconds; ``now_ns`` where there is none, or none from 0 to before ``end_ns``."""
    return stamp_ns if isinstance(stamp_ns, int) and 0 <= stamp_ns < end_ns else now_ns


def with_stamp(payload: bytes, stamp_ns: int) -> bytes:
    """Return a payload with this stamp in place of its own; unchanged where it has none or cannot be read."""
    stamp_ns = min(max(stamp_ns, 0), _LARGEST_STAMP)
    if payload[1:_STAMP_AT] == _STAMP_NAME and payload[0] in _MAPS and len(payload) >= _STAMP_AT + 8:
        return payload[:_STAMP_AT] + struct.pack(">Q", stamp_ns) + payload[_STAMP_AT + 8 :]
    if b"stamp_ns" not in payload:
        return payload
    try:
        values = unpack(payload)
    except PayloadError:
        return payload
    return pack(values | {"stamp_ns": stamp_ns}) if "stamp_ns" in values else payload


_EMPTY = b"\x80"


@cache
def _decoder(message: type[FleetMessage]) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(message)


def _with_ranges(scan: Scan) -> Any:
    """Read the bytes of the ranges as an array; raise ValueError if the last one is incomplete."""
    import numpy as np

    if len(scan.ranges) % 4:
        raise ValueError("ranges: a bin of float32 was expected")
    return msgspec.structs.replace(scan, ranges=np.frombuffer(scan.ranges, "<f4"))


def _with_cells(grid: Map) -> Any:
    """Read the bytes of the cells as rows x columns; raise ValueError where their number differs."""
    import numpy as np

    rows, columns, cells = grid.rows, grid.columns, np.frombuffer(grid.cells, np.uint8)
    if rows < 0 or columns < 0 or rows * columns != cells.size:
        raise ValueError(f"{cells.size} cells do not fill {rows} rows x {columns} columns")
    return msgspec.structs.replace(grid, cells=cells.reshape(rows, columns))
