"""The binary codec: a message declaration compiled once into functions between bytes and message. Sans-IO.

Little endian, or big-endian where the message says so.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire.fields import (
    CountedArray,
    CountedBytes,
    CountedText,
    Field,
    Filling,
    Groups,
    Message,
    Remainder,
    Scalar,
    declared_fields,
)

M = TypeVar("M", bound=Message)

Decode = Callable[[bytes, int], tuple[Any, int]]
"""``decode(data, position)``: the value there and the position behind it."""
Encode = Callable[[Any], bytes]


class BinaryCodec(Generic[M]):
    """Turns the bytes of one message class into messages and back.

    ``decode(data, start)`` reads the whole body ``data[start:]``; it raises ProtocolError for too few or too many bytes
    and for a count that exceeds them. ``encode(message)`` raises EncodeError for values outside the wire types.
    """

    decode: Callable[[bytes, int], M]
    encode: Callable[[M], bytes]

    def __init__(self, message: type[M]) -> None:
        self.message = message
        fields = declared_fields(message)
        if message.__match_args__ != message.__struct_fields__:
            raise TypeError(f"{message.__name__}: fields are given by position, so kw_only is not possible")
        widths = [struct.calcsize("<" + field.wire.code) for field in fields if isinstance(field.wire, Scalar)]
        self.fixed_size = sum(widths)
        """Bytes of the fields of fixed width."""
        scalars = _all_scalars(fields)
        if any(field.optional for field in fields[:-1]):
            raise TypeError(f"{message.__name__}: only the last field may be missing")
        if scalars is None:
            order = message.byte_order
            self._steps = [(field, *_coders(field, fields[place + 1 :], order)) for place, field in enumerate(fields)]
            self.decode, self.encode = self._decode_steps, self._encode_steps
        else:
            self._fixed = struct.Struct(message.byte_order + scalars)
            self._names = [field.name for field in fields]
            self.decode = _fixed_decoder(message, self._fixed)
            self.encode = self._encode_fixed

    def _encode_fixed(self, message: M) -> bytes:
        values = [getattr(message, name) for name in self._names]
        try:
            return self._fixed.pack(*values)
        except (struct.error, OverflowError) as error:
            raise EncodeError(f"{message!r}: {error}; expected {_expected(self.message)}") from error

    def _decode_steps(self, data: bytes, start: int) -> M:
        values = []
        position, end = start, len(data)
        for field, decode, _ in self._steps:
            if field.optional and position == end:
                break
            try:
                value, position = decode(data, position)
            except (struct.error, ValueError) as error:
                raise ProtocolError(f"{self.message.__name__}.{field.name}: {error}") from error
            values.append(value)
        if position != end:
            raise ProtocolError(f"{self.message.__name__}: {end - position} bytes too many")
        message = self.message(*values)
        message.check()
        return message

    def _encode_steps(self, message: M) -> bytes:
        parts = []
        for field, _, encode in self._steps:
            value = getattr(message, field.name)
            if value is None and field.optional:
                break
            try:
                parts.append(encode(value))
            except (struct.error, ArithmeticError, ValueError, TypeError, AttributeError) as error:
                raise EncodeError(f"{self.message.__name__}.{field.name}: {error}") from error
        return b"".join(parts)


def _expected(message: type[Message]) -> str:
    """Name the fields of a message, all of fixed width, with the codes of their widths."""
    fields = declared_fields(message)
    return ", ".join(f"{field.name}: {field.wire.code}" for field in fields if isinstance(field.wire, Scalar))


def _coders(field: Field, behind: Sequence[Field], order: str) -> tuple[Decode, Encode]:
    """Return how one field of a message of variable length is read and written."""
    if not isinstance(field.wire, Filling):
        return _CODERS[type(field.wire)](field.wire, order)
    scalars = _all_scalars(behind)
    if scalars is None:
        raise TypeError(f"{field.name}: only fields of fixed width may follow it")
    return _filling(field.wire, order, struct.calcsize("<" + scalars))


def _all_scalars(fields: Sequence[Field]) -> str | None:
    codes = [field.wire.code for field in fields if isinstance(field.wire, Scalar) and not field.optional]
    return "".join(codes) if len(codes) == len(fields) else None


def _fixed_decoder(message: type[M], layout: struct.Struct) -> Callable[[bytes, int], M]:
    unpack, size = layout.unpack_from, layout.size
    checks = message.check is not Message.check

    def decode(data: bytes, start: int) -> M:
        if len(data) - start != size:
            raise ProtocolError(f"{message.__name__} of {len(data) - start} bytes, expected {size}")
        decoded = message(*unpack(data, start))
        if checks:
            decoded.check()
        return decoded

    return decode


def _scalar(wire: Scalar, order: str) -> tuple[Decode, Encode]:
    layout = struct.Struct(order + wire.code)

    def decode(data: bytes, position: int) -> tuple[Any, int]:
        return layout.unpack_from(data, position)[0], position + layout.size

    return decode, layout.pack


def _counted(
    count_code: str, order: str, item_size: int
) -> tuple[Callable[[bytes, int], tuple[int, int]], struct.Struct]:
    count = struct.Struct(order + count_code)

    def span(data: bytes, position: int) -> tuple[int, int]:
        (items,) = count.unpack_from(data, position)
        first = position + count.size
        if items < 0 or first + items * item_size > len(data):
            raise ValueError(f"count {items} does not fit the {len(data) - first} bytes that follow")
        return first, first + items * item_size

    return span, count


def _counted_bytes(wire: CountedBytes, order: str) -> tuple[Decode, Encode]:
    span, count = _counted(wire.count_code, order, 1)

    def decode(data: bytes, position: int) -> tuple[bytes, int]:
        first, end = span(data, position)
        return data[first:end], end

    def encode(value: bytes) -> bytes:
        return count.pack(len(value)) + value

    return decode, encode


def _counted_text(wire: CountedText, order: str) -> tuple[Decode, Encode]:
    decode_bytes, encode_bytes = _counted_bytes(CountedBytes(wire.count_code), order)

    def decode(data: bytes, position: int) -> tuple[str, int]:
        raw, end = decode_bytes(data, position)
        # A byte that is not ASCII becomes \xNN: the rest stays readable, and no session ends for it.
        return raw.decode("ascii", "backslashreplace"), end

    def encode(value: str) -> bytes:
        return encode_bytes(value.encode("ascii"))

    return decode, encode


def _counted_array(wire: CountedArray, order: str) -> tuple[Decode, Encode]:
    dtype, item_size = wire.dtype.replace("<", order), _item_size(wire.dtype)
    span, count = _counted(wire.count_code, order, item_size)

    def decode(data: bytes, position: int) -> tuple[Any, int]:
        import numpy as np

        first, end = span(data, position)
        return np.frombuffer(data, dtype, (end - first) // item_size, first), end

    def encode(value: Any) -> bytes:
        import numpy as np

        return count.pack(len(value)) + np.ascontiguousarray(value, dtype).tobytes()

    return decode, encode


def _groups(wire: Groups, order: str) -> tuple[Decode, Encode]:
    scalars = _all_scalars(declared_fields(wire.item))
    if scalars is None:
        raise TypeError(f"{wire.item.__qualname__}: a group that repeats has fields of fixed width only")
    item, layout, checks = wire.item, struct.Struct(order + scalars), wire.item.check is not Message.check
    span, count = _counted(wire.count_code, order, layout.size)
    names = [field.name for field in declared_fields(item)]

    def decode(data: bytes, position: int) -> tuple[Any, int]:
        first, end = span(data, position)
        items = tuple(item(*values) for values in layout.iter_unpack(data[first:end]))
        if checks:
            for each in items:
                each.check()
        return items, end

    def encode(value: Sequence[Message]) -> bytes:
        packed = [layout.pack(*(getattr(each, name) for name in names)) for each in value]
        return count.pack(len(packed)) + b"".join(packed)

    return decode, encode


def _filling(wire: Filling, order: str, behind: int) -> tuple[Decode, Encode]:
    dtype, item_size = wire.dtype.replace("<", order), _item_size(wire.dtype)

    def decode(data: bytes, position: int) -> tuple[Any, int]:
        import numpy as np

        count, rest = divmod(len(data) - behind - position, item_size)
        if count < 0 or rest:
            raise ValueError(f"{len(data) - position} bytes, expected {behind} and a multiple of {item_size}")
        return np.frombuffer(data, dtype, count, position), position + count * item_size

    def encode(value: Any) -> bytes:
        import numpy as np

        with np.errstate(invalid="raise"):
            return np.ascontiguousarray(value, dtype).tobytes()

    return decode, encode


def _item_size(dtype: str) -> int:
    """Return the bytes of one item: the number at the end of ``<f4``."""
    return int(dtype[-1])


def _remainder(wire: Remainder, order: str) -> tuple[Decode, Encode]:
    return (lambda data, position: (data[position:], len(data))), bytes


_CODERS: dict[type[Any], Callable[[Any, str], tuple[Decode, Encode]]] = {
    Scalar: _scalar,
    CountedText: _counted_text,
    CountedBytes: _counted_bytes,
    CountedArray: _counted_array,
    Groups: _groups,
    Remainder: _remainder,
}
