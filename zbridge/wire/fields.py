"""The wire types a legacy message is declared with: one annotated field a line.

    class ServerPosition(Message):
        x: F32
        y: F32
        heading_deg: F32

The last field may be missing if it is declared ``Blob | None = None``. A group that repeats, behind its count, is a
message in a message: ``sonars: Annotated[tuple[Sonar, ...], Counted("B")]``. A message may define ``check()``, which
raises ProtocolError for decoded values that contradict each other. A field whose text form differs from its binary form
names both: ``Annotated[float, Scalar("h"), Decimal()]``. Sans-IO; a codec makes the bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

import msgspec


class Message(msgspec.Struct, frozen=True, gc=False):
    """A typed legacy value; its fields are declared with the wire types of this module.

    ``byte_order = ">"``: its fields are big-endian in binary.
    """

    byte_order: ClassVar[str] = "<"

    def check(self) -> None:
        """Raise ProtocolError where decoded values contradict each other."""


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
    """A count of items, then that many items of one dtype, written as for little-endian."""

    count_code: str
    dtype: str


class Remainder(msgspec.Struct, frozen=True):
    """All remaining bytes of the body."""


class Counted(msgspec.Struct, frozen=True):
    """A count of groups, then that many groups of fields; ``count_code`` is the count's :mod:`struct` character.

    The annotated type is ``tuple[Item, ...]``, where ``Item`` is a :class:`Message` of fields of fixed width.
    """

    count_code: str


class Groups(msgspec.Struct, frozen=True):
    """What :class:`Counted` declares, with the message of one group."""

    count_code: str
    item: type[Message]


class Filling(msgspec.Struct, frozen=True):
    """Items of one dtype, written as for little-endian, that fill the room the other fields leave."""

    dtype: str


class Whole(msgspec.Struct, frozen=True):
    """In text: an integer from ``low`` to ``high``."""

    low: int
    high: int

    def __str__(self) -> str:
        return f"{self.low} to {self.high}"


class Decimal(msgspec.Struct, frozen=True):
    """In text: a number with six decimals, never an exponent."""


if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Floats = npt.NDArray[np.float32]
    Doubles = npt.NDArray[np.float64]
    Ints = npt.NDArray[np.int64]
else:  # numpy is loaded when the first array comes
    Floats = Doubles = Ints = Any

WireType = Scalar | CountedText | CountedBytes | CountedArray | Groups | Remainder | Filling
TextType = Whole | Decimal

I8 = Annotated[int, Scalar("b")]
U8 = Annotated[int, Scalar("B")]
I16 = Annotated[int, Scalar("h")]
U16 = Annotated[int, Scalar("H")]
U32 = Annotated[int, Scalar("I")]
I32 = Annotated[int, Scalar("i")]
F32 = Annotated[float, Scalar("f")]
F64 = Annotated[float, Scalar("d")]
Bool = Annotated[bool, Scalar("?")]
Text = Annotated[str, CountedText("i")]
Blob = Annotated[bytes, CountedBytes("i")]
Rest = Annotated[bytes, Remainder()]
F32Array = Annotated[Floats, CountedArray("i", "<f4")]
I64Fill = Annotated[Ints, Filling("<i8")]
F64Fill = Annotated[Doubles, Filling("<f8")]


class Field(msgspec.Struct, frozen=True):
    """One field of a declaration: what it is on the wire, and in text where that differs."""

    name: str
    wire: WireType
    text: TextType | None
    optional: bool


def declared_fields(message: type[Message]) -> list[Field]:
    """Return the fields of a declaration; raise TypeError that names class and field if one has no wire type."""
    hints = get_type_hints(message, include_extras=True)
    return [_field(message, field.name, hints[field.name]) for field in msgspec.structs.fields(message)]


def _field(message: type[Message], name: str, hint: Any) -> Field:
    extras = [extra for candidate in (hint, *get_args(hint)) for extra in getattr(candidate, "__metadata__", ())]
    wire = next((extra for extra in extras if isinstance(extra, WireType)), None)
    counted = next((extra for extra in extras if isinstance(extra, Counted)), None)
    if counted is not None:
        wire = Groups(counted.count_code, _item(f"{message.__qualname__}.{name}", get_args(hint)[0]))
    if wire is None:
        raise TypeError(
            f"{message.__qualname__}.{name}: {hint} is no wire type; expected one of zbridge.wire, as U8, or "
            f'Annotated[int, Scalar("B")]'
        )
    text = next((extra for extra in extras if isinstance(extra, TextType)), None)
    return Field(name, wire, text, optional=type(None) in get_args(hint))


def _item(where: str, hint: Any) -> type[Message]:
    """Return the message of one group, of ``tuple[Item, ...]``."""
    item = next(iter(get_args(hint)), None)
    if get_origin(hint) is tuple and isinstance(item, type) and issubclass(item, Message):
        return item
    raise TypeError(f"{where}: {hint}; Counted expects tuple[Item, ...], where Item is a Message")
