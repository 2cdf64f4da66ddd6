r"""The text codec: the declarations of :mod:`zbridge.wire.fields` as numbers between separators. Sans-IO.

Read: a field is every match of ``-?[0-9]*\.?[0-9]+``; all other bytes separate. Written: integers, floats with six
decimals and never an exponent, truth as 1 or 0. A message may have one array, which takes the fields the others leave.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire.fields import Decimal, Field, Filling, Ints, Message, Scalar, Whole, declared_fields

M = TypeVar("M", bound=Message)

NUMBER = re.compile(rb"-?[0-9]*\.?[0-9]+")
_QUOTED = 24
_DIGITS = b"0123456789"
_UNCLIPPED = 2**63 - 2
"""The largest number of a row that is surely not a larger one, clipped by numpy."""
_MOST = 2**31 - 1
"""The largest number of an array: legacy readers hold 32 bits."""


class TextCodec(Generic[M]):
    """Turns the fields of one message class, without its id, into messages and back.

    ``decode(body)`` raises ProtocolError where fields are missing, too many, no numbers or out of range;
    ``encode(message)`` returns ``v|v|...|v`` and raises EncodeError for values that have no form in text.
    """

    def __init__(self, message: type[M]) -> None:
        self.message = message
        self._fields = [_TextField(field) for field in declared_fields(message)]
        self._array = next((place for place, field in enumerate(self._fields) if field.array), None)

    def decode(self, body: bytes) -> M:
        """Read the fields of a message: the bytes between its id and the terminator."""
        if self._array is not None:
            values = self._with_array(body, self._array)
        else:
            numbers = NUMBER.findall(body)
            if len(numbers) != len(self._fields):
                raise ProtocolError(f"{self._name} of {len(numbers)} fields, expected {len(self._fields)}")
            values = [self._read(field, number) for field, number in zip(self._fields, numbers, strict=True)]
        message = self.message(*values)
        message.check()
        return message

    def encode(self, message: M) -> bytes:
        """Write the fields of a message."""
        try:
            return b"|".join([field.write(getattr(message, field.name)) for field in self._fields])
        except (ValueError, TypeError, ArithmeticError) as error:
            raise EncodeError(f"{self._name}: {error}") from error

    @property
    def _name(self) -> str:
        return self.message.__name__

    def _read(self, field: _TextField, number: bytes) -> Any:
        try:
            return field.read(number)
        except (ValueError, OverflowError) as error:
            raise ProtocolError(f"{self._name}.{field.name} = {number[:_QUOTED]!r}: {error}") from error

    def _with_array(self, body: bytes, place: int) -> list[Any]:
        """Read a message with an array: numpy reads all fields, since the array is nearly all of the message."""
        numbers = _integers(body)
        behind = len(self._fields) - place - 1
        if len(numbers) < place + behind:
            raise ProtocolError(f"{self._name} of {len(numbers)} fields, expected {place + behind} at least")
        end = len(numbers) - behind
        array = numbers[place:end]
        if array.size and array.max() > _MOST:
            raise ProtocolError(f"{self._name}.{self._fields[place].name}: a number over {_MOST}")
        values = [*numbers[:place].tolist(), array, *numbers[end:].tolist()]
        for field, value in zip(self._fields, values, strict=True):
            if field.whole is not None and not field.whole.low <= value <= min(field.whole.high, _UNCLIPPED):
                raise ProtocolError(f"{self._name}.{field.name} = {value}: expected {field.whole}")
        return values


class _TextField:
    """One field: how it is read from a number and written."""

    def __init__(self, field: Field) -> None:
        self.name = field.name
        self.array = isinstance(field.wire, Filling)
        kind = _kind(field)
        self.whole = kind if isinstance(kind, Whole) else None
        self.read: Callable[[bytes], Any]
        self.write: Callable[[Any], bytes]
        if self.array:
            self.read, self.write = _integers, _write_array
        elif not isinstance(field.wire, Scalar):
            raise TypeError(f"{field.name}: {field.wire} has no form in text")
        elif isinstance(kind, Whole):
            self.read, self.write = _whole(kind)
        elif isinstance(kind, Decimal):
            self.read, self.write = _read_decimal, _write_decimal
        else:
            self.read, self.write = _read_truth, lambda value: b"1" if value else b"0"


def _kind(field: Field) -> Whole | Decimal | None:
    """Return the text type of a field; None for truth, and for an array."""
    if field.text is not None or not isinstance(field.wire, Scalar):
        return field.text
    code = field.wire.code
    if code == "?":
        return None
    if code in "fd":
        return Decimal()
    bits = 8 * struct.calcsize("<" + code)
    return Whole(0, 2**bits - 1) if code.isupper() else Whole(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _whole(kind: Whole) -> tuple[Callable[[bytes], int], Callable[[Any], bytes]]:
    def ranged(value: int) -> int:
        if not kind.low <= value <= kind.high:
            raise ValueError(f"expected {kind}")
        return value

    def read(number: bytes) -> int:
        if b"." in number:
            whole, _, fraction = number.partition(b".")
            if fraction.strip(b"0"):
                raise ValueError("expected an integer")
            number = whole or b"0"
        return ranged(int(number))

    return read, lambda value: b"%d" % ranged(int(value))


def _read_truth(number: bytes) -> bool:
    return _read_decimal(number) != 0


def _read_decimal(number: bytes) -> float:
    value = float(number)
    if not math.isfinite(value):
        raise ValueError("expected a finite number")
    return value


def _write_decimal(value: float) -> bytes:
    if not math.isfinite(value):
        raise ValueError(f"{value} has no form in text")
    return b"%.6f" % value


def _write_array(values: Any) -> bytes:
    import numpy as np

    with np.errstate(invalid="raise"):
        numbers = np.asarray(values, np.int64)
    if numbers.size and numbers.max() > _MOST:
        raise ValueError(f"a number over {_MOST}")
    return b"|".join([b"%d" % value for value in numbers.tolist()])


def _integers(body: bytes) -> Ints:
    """Read a row of integers by numpy; number by number where numpy would read something else."""
    import numpy as np

    bars = body.translate(None, _DIGITS)
    if bars != b"|" * len(bars):
        return _integers_one_by_one(body)
    try:
        numbers = np.fromstring(body, np.int64, sep="|")
    except (DeprecationWarning, ValueError):  # what numpy says of a row it cannot read to its end
        return _integers_one_by_one(body)
    return numbers if len(numbers) == len(bars) + 1 else _integers_one_by_one(body)


def _integers_one_by_one(body: bytes) -> Ints:
    import numpy as np

    numbers = NUMBER.findall(body)
    try:
        return np.array([int(number) for number in numbers], np.int64)
    except (ValueError, OverflowError) as error:
        raise ProtocolError(f"no row of integers: {error}") from error
