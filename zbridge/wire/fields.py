"""The wire types a legacy message is declared with: one annotated field a line.

    class ServerPosition(Message):
        x: F32
        y: F32
        heading_deg: F32

The last field may be declared ``Blob | None = None``: then it may be missing. A message may define ``check()``,
which raises ProtocolError for decoded values that do not go together. Sans-IO; a codec makes the bytes.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt


class Message(msgspec.Struct, frozen=True, gc=False):
    """A typed legacy value; its fields are declared with the wire types of this module."""

    def check(self) -> None:
        """Raise ProtocolError where decoded values do not go together."""


class Scalar(msgspec.Struct, frozen=True):
    """One number of fixed width; ``code`` is its :mod:`struct` character."""

    code: str


class CountedText(msgspec.Struct, frozen=True):
    """A count of bytes, then that many ASCII bytes without terminator."""

    count_code: str


class CountedBytes(msgspec.Struct, frozen=True):
    """A count of bytes, then that many bytes."""

    count_code: str


class CountedArray(msgspec.Struct, frozen=True):
    """A count of items, then that many items of one little-endian dtype."""

    count_code: str
    dtype: str


class Remainder(msgspec.Struct, frozen=True):
    """All bytes that are left of the body."""


WireType = Scalar | CountedText | CountedBytes | CountedArray | Remainder

U8 = Annotated[int, Scalar("B")]
I32 = Annotated[int, Scalar("i")]
F32 = Annotated[float, Scalar("f")]
F64 = Annotated[float, Scalar("d")]
Bool = Annotated[bool, Scalar("?")]
Text = Annotated[str, CountedText("i")]
Blob = Annotated[bytes, CountedBytes("i")]
F32Array = Annotated[npt.NDArray[np.float32], CountedArray("i", "<f4")]
Rest = Annotated[bytes, Remainder()]
