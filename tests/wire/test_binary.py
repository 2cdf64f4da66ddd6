"""The binary codec: golden bytes both ways, truncation, surplus, counts that lie. Bytes are worked out by hand."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import F32, F64, I16, I32, U8, U32, BinaryCodec, Blob, Bool, F32Array, I64Fill, Message, Rest, Text


class Fixed(Message, frozen=True):
    small: U8
    flag: Bool
    whole: I32
    real: F32
    fine: F64


class Empty(Message, frozen=True):
    pass


class BigEndian(Message, frozen=True):
    byte_order = ">"
    velocity: I16
    radius: I16


class Mixed(Message, frozen=True):
    number: U8
    text: Text
    blob: Blob


class Tail(Message, frozen=True):
    number: I32
    rest: Rest


class Opaque(Message, frozen=True):
    body: Rest = b""


class Perhaps(Message, frozen=True):
    number: U8
    blob: Blob | None = None


class Ranges(Message, frozen=True, eq=False):
    ranges: F32Array
    last: U8


class OnlyRanges(Message, frozen=True, eq=False):
    ranges: F32Array


class Packed(Message, frozen=True, eq=False):
    sequence: U32
    points: I64Fill
    first: U8
    last: U32


class Even(Message, frozen=True):
    text: Text

    def check(self) -> None:
        if len(self.text) % 2:
            raise ProtocolError(f"text of {len(self.text)} characters")


class Span(Message, frozen=True):
    start: U8
    end: U8

    def check(self) -> None:
        if self.end < self.start:
            raise ProtocolError(f"from {self.start} to {self.end}")


GOLDEN = [
    (Fixed(7, True, -2, 1.5, -0.25), "07 01 feffffff 0000c03f 000000000000d0bf"),
    (Empty(), ""),
    (BigEndian(-200, 500), "ff38 01f4"),
    (Mixed(1, "hi", b"\x00\xff"), "01 02000000 6869 02000000 00ff"),
    (Mixed(0, "", b""), "00 00000000 00000000"),
    (Tail(258, b"\x01\x02"), "02010000 0102"),
    (Opaque(b"\xaa"), "aa"),
    (Opaque(), ""),
    (Perhaps(1, b"\x02"), "01 01000000 02"),
    (Perhaps(1), "01"),
    (Even("ab"), "02000000 6162"),
    (Span(1, 2), "01 02"),
]


@pytest.mark.parametrize(("message", "golden"), GOLDEN)
def test_a_message_and_its_bytes_are_made_from_each_other_and_what_stands_before_is_not_read(message, golden) -> None:
    codec, whole = BinaryCodec(type(message)), bytes.fromhex(golden)
    assert codec.encode(message) == whole
    assert codec.decode(whole, 0) == codec.decode(b"\xff\xff\xff" + whole, 3) == message
    open_ended = isinstance(message, Tail | Opaque)
    cuts = () if open_ended or isinstance(message, Perhaps) else range(len(whole))
    for wrong in (*(whole[:cut] for cut in cuts), *(() if open_ended else (whole + b"\x00",))):
        with pytest.raises(ProtocolError):
            codec.decode(wrong, 0)


def test_the_bytes_that_are_always_there_are_known() -> None:
    sizes = [BinaryCodec(declared).fixed_size for declared in (Empty, BigEndian, Fixed, Packed)]
    assert sizes == [0, 4, 1 + 1 + 4 + 4 + 8, 9]


def test_odd_values_are_read_every_byte_but_zero_is_true_and_a_text_that_is_not_ascii_is_escaped() -> None:
    message = BinaryCodec(Fixed).decode(bytes.fromhex("00 02 00000000 0000c07f 000000000000f0ff"), 0)
    assert message.flag is True
    assert math.isnan(message.real)
    assert message.fine == -math.inf
    assert BinaryCodec(Mixed).decode(bytes.fromhex("00 03000000 61ff62 00000000"), 0).text == r"a\xffb"


@pytest.mark.parametrize(
    ("declared", "body", "what"),
    [
        *((Mixed, f"01 {count} 6162", "count") for count in ("ffffffff", "00000080", "03000000", "ffffff7f")),
        *((Ranges, f"{count} 0000000000", "count") for count in ("ffffffff", "02000000", "ffffff3f", "ffffff7f")),
        (Even, "03000000 616263", "3 characters"),
        (Span, "02 01", "from 2 to 1"),
    ],
)
def test_a_count_that_lies_and_values_that_do_not_go_together_are_a_protocol_error(declared, body, what: str) -> None:
    with pytest.raises(ProtocolError, match=what):
        BinaryCodec(declared).decode(bytes.fromhex(body), 0)


HEAD, TAIL = "07000000", "01 feffffff"
ARRAYS: list[tuple[Any, str, list[float]]] = [
    (Ranges([1.5, -2.25], 9), "02000000 0000c03f 000010c0 09", [1.5, -2.25]),  # type: ignore[arg-type]
    (Ranges(np.array([1.5, 0, -2.25])[::2], 9), "02000000 0000c03f 000010c0 09", [1.5, -2.25]),  # type: ignore[arg-type]
    (OnlyRanges([]), "00000000", []),  # type: ignore[arg-type]
    (Packed(7, (1, -2), 1, 2**32 - 2), HEAD + "0100000000000000 feffffffffffffff" + TAIL, [1, -2]),  # type: ignore[arg-type]
    (
        Packed(7, np.array([1, 9, -(2**63), 9], ">i8")[::2], 1, 2**32 - 2),
        HEAD + "0100000000000000 0000000000000080" + TAIL,
        [1, -(2**63)],
    ),
    (Packed(7, np.array([], np.int16), 1, 2**32 - 2), HEAD + TAIL, []),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("message", "golden", "values"), ARRAYS)
def test_an_array_is_written_of_anything_that_holds_numbers_and_read_as_a_view(message, golden, values) -> None:
    codec, whole = BinaryCodec(type(message)), bytes.fromhex(golden)
    assert codec.encode(message) == whole
    read = codec.decode(b"\xff" + whole, 1)
    array = read.points if isinstance(read, Packed) else read.ranges
    assert array.tolist() == values
    assert array.dtype == np.dtype("<i8" if isinstance(read, Packed) else "<f4")
    assert not array.flags.writeable
    assert codec.encode(read) == whole


def test_a_message_that_is_no_multiple_of_items_or_shorter_than_its_other_fields_is_a_protocol_error() -> None:
    codec = BinaryCodec(Packed)
    for length in range(34):
        if length in (9, 17, 25, 33):
            assert len(codec.decode(bytes(length), 0).points) == (length - 9) // 8
        else:
            with pytest.raises(ProtocolError, match="Packed"):
                codec.decode(bytes(length), 0)


@pytest.mark.parametrize(
    "message",
    [
        Fixed(256, True, 0, 0.0, 0.0),
        Fixed(-1, True, 0, 0.0, 0.0),
        Fixed(0, True, 0, 1e39, 0.0),
        Fixed(0, True, 0, "fast", 0.0),  # type: ignore[arg-type]
        Mixed(0, "Grüße", b""),
        Mixed(300, "", b""),
        Mixed(0, None, b""),  # type: ignore[arg-type]
        *(Packed(7, points, 1, 2) for points in (["near"], [None], [2**63], [math.nan], np.array([math.inf]))),
    ],
    ids=repr,
)
def test_a_value_the_wire_type_cannot_carry_is_an_encode_error(message: Message) -> None:
    with pytest.raises(EncodeError, match=type(message).__name__):
        BinaryCodec(type(message)).encode(message)


@pytest.mark.parametrize(
    ("fields", "more", "what"),
    [
        ([("number", int)], {}, "number: <class 'int'> is no wire type"),
        ([("first", Blob | None, None), ("second", Blob | None, None)], {}, "only the last field"),
        ([("text", Text)], {"namespace": {"byte_order": ">"}}, "fixed width"),
        ([("points", I64Fill), ("name", Text)], {}, "points: only fields of fixed width may follow"),
        ([("value", U8)], {"kw_only": True}, "Declared: fields are given by position"),
    ],
)
def test_a_mistake_of_the_declaration_is_told(fields: list[Any], more: dict[str, Any], what: str) -> None:
    with pytest.raises(TypeError, match=what):
        BinaryCodec(msgspec.defstruct("Declared", fields, bases=(Message,), frozen=True, **more))


@given(st.binary(max_size=60), st.integers(0, 5))
def test_random_bytes_give_a_message_or_a_protocol_error(data: bytes, start: int) -> None:
    for declared in (Fixed, Empty, Mixed, Tail, Opaque, Perhaps, Ranges, Packed, Even):
        try:
            message = BinaryCodec(declared).decode(data, min(start, len(data)))
        except ProtocolError:
            continue
        assert isinstance(message, declared)
