"""The binary codec, beyond the messages of the protocols: counts that lie, arrays, what cannot be written."""

import math
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import (
    F32,
    F64,
    I16,
    I32,
    U8,
    U16,
    U32,
    BinaryCodec,
    Blob,
    Bool,
    Counted,
    F32Array,
    I64Fill,
    Message,
    Rest,
    Text,
)


class Fixed(Message, frozen=True):
    small: U8
    flag: Bool
    whole: I32
    real: F32
    fine: F64

    def check(self) -> None:
        if self.small == 13:
            raise ProtocolError("small is 13")


class BigEndian(Message, frozen=True):
    byte_order = ">"
    velocity: I16
    radius: I16


class Pair(Message, frozen=True):
    number: U8
    range_mm: U16

    def check(self) -> None:
        if self.number == 13:
            raise ProtocolError("number is 13")


class Grouped(Message, frozen=True):
    kind: U8
    pairs: Annotated[tuple[Pair, ...], Counted("B")]
    behind: I16


class BigEndianGrouped(Message, frozen=True):
    byte_order = ">"
    pairs: Annotated[tuple[Pair, ...], Counted("H")]
    floats: F32Array
    rest: Rest


class Mixed(Message, frozen=True):
    number: U8
    text: Text
    blob: Blob | None = None

    def check(self) -> None:
        if len(self.text) % 2:
            raise ProtocolError(f"text of {len(self.text)} characters")


class Ranges(Message, frozen=True, eq=False):
    ranges: F32Array
    last: U8


class Packed(Message, frozen=True, eq=False):
    sequence: U32
    ranges: I64Fill
    first: U8
    last: U32


@pytest.mark.parametrize(
    ("message", "golden"),
    [
        (Fixed(7, True, -2, 1.5, -math.inf), "07 01 feffffff 0000c03f 000000000000f0ff"),
        (BigEndian(-200, 500), "ff38 01f4"),
        (Mixed(1, "hi", b"\x00\xff"), "01 02000000 6869 02000000 00ff"),
        (Mixed(1, "hi", b""), "01 02000000 6869 00000000"),
        (Mixed(0, ""), "00 00000000"),
    ],
)
def test_a_message_and_its_bytes_are_made_from_each_other_and_what_stands_before_is_not_read(message, golden) -> None:
    codec, whole = BinaryCodec(type(message)), bytes.fromhex(golden)
    assert codec.encode(message) == whole
    assert codec.decode(whole, 0) == codec.decode(b"\xff\xff\xff" + whole, 3) == message


@pytest.mark.parametrize(
    ("declared", "body", "what"),
    [
        *((Mixed, f"00 {count} 6162", "count") for count in ("ffffffff", "00000080", "03000000", "ffffff7f")),
        *((Ranges, f"{count} 0000000000", "count") for count in ("ffffffff", "02000000", "ffffff3f", "ffffff7f")),
        (Mixed, "00 00000000 00000000 00", "1 bytes too many"),
        (Mixed, "00 03000000 616263", "text of 3 characters"),
        (Fixed, "0d 02 00000000 0000c07f 000000000000f0ff", "small is 13"),
        *((Packed, bytes(size).hex(), "Packed") for size in range(34) if size not in (9, 17, 25, 33)),
    ],
)
def test_a_count_that_lies_and_values_that_do_not_go_together_are_a_protocol_error(declared, body, what: str) -> None:
    with pytest.raises(ProtocolError, match=what):
        BinaryCodec(declared).decode(bytes.fromhex(body), 0)


def test_odd_values_are_read_as_the_programs_of_the_field_read_them() -> None:
    message = BinaryCodec(Fixed).decode(bytes.fromhex("00 02 00000000 0000c07f 000000000000f0ff"), 0)
    assert (message.flag, math.isnan(message.real)) == (True, True)
    assert BinaryCodec(Mixed).decode(bytes.fromhex("00 03000000 61ff62"), 0).text == r"a\xffb"


HEAD, TAIL = "07000000", "01 feffffff"


@pytest.mark.parametrize(
    ("message", "golden", "values"),
    [
        (Ranges([1.5, -2.25], 9), "02000000 0000c03f 000010c0 09", [1.5, -2.25]),
        (Ranges(np.array([1.5, 0, -2.25])[::2], 9), "02000000 0000c03f 000010c0 09", [1.5, -2.25]),
        (Ranges([], 9), "00000000 09", []),
        (Packed(7, (1, -2), 1, 2**32 - 2), HEAD + "0100000000000000 feffffffffffffff" + TAIL, [1, -2]),
        (Packed(7, np.array([1, 9, 1, 9], ">i8")[::2], 1, 2**32 - 2), HEAD + 2 * "0100000000000000" + TAIL, [1, 1]),
        (Packed(7, np.array([], np.int16), 1, 2**32 - 2), HEAD + TAIL, []),
    ],
)
def test_an_array_is_written_of_anything_that_holds_numbers_and_read_as_a_view(message, golden, values) -> None:
    codec, whole = BinaryCodec(type(message)), bytes.fromhex(golden)
    assert codec.encode(message) == whole
    read = codec.decode(b"\xff" + whole, 1)
    assert read.ranges.tolist() == values
    assert read.ranges.dtype == np.dtype("<f4" if isinstance(read, Ranges) else "<i8")
    assert not read.ranges.flags.writeable
    assert codec.encode(read) == whole


@pytest.mark.parametrize(
    "message",
    [
        *(Fixed(small, True, 0, 0.0, 0.0) for small in (256, -1)),
        *(Fixed(0, True, 0, real, 0.0) for real in (1e39, "fast")),
        *(Mixed(0, text) for text in ("Grüße", None)),
        Mixed(300, ""),
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
        ([("number", int)], {}, "Declared.number: <class 'int'> is no wire type; expected one of zbridge.wire"),
        ([("pairs", Annotated[list[Pair], Counted("B")])], {}, r"Declared.pairs: list\[.*Pair\]; Counted expects"),
        (
            [("pairs", Annotated[tuple[Mixed, ...], Counted("B")])],
            {},
            "Mixed: a group that repeats has fields of fixed",
        ),
        ([("first", Blob | None, None), ("second", Blob | None, None)], {}, "only the last field"),
        ([("points", I64Fill), ("name", Text)], {}, "points: only fields of fixed width may follow"),
        ([("value", U8)], {"kw_only": True}, "Declared: fields are given by position"),
    ],
)
def test_a_mistake_of_the_declaration_is_told(fields: list[Any], more: dict[str, Any], what: str) -> None:
    with pytest.raises(TypeError, match=what):
        BinaryCodec(msgspec.defstruct("Declared", fields, bases=(Message,), frozen=True, **more))


@given(st.binary(max_size=60), st.integers(0, 5))
def test_random_bytes_give_a_message_or_a_protocol_error(data: bytes, start: int) -> None:
    for declared in (Fixed, Mixed, Ranges, Packed):
        try:
            message = BinaryCodec(declared).decode(data, min(start, len(data)))
        except ProtocolError:
            continue
        assert isinstance(message, declared)


def test_a_group_that_repeats_is_read_and_written_behind_its_count() -> None:
    codec = BinaryCodec(Grouped)
    whole = bytes.fromhex("07 02 00e803 05ffff feff")
    message = Grouped(7, (Pair(0, 1000), Pair(5, 65535)), -2)
    assert codec.decode(whole, 0) == message
    assert codec.encode(message) == whole
    assert codec.decode(bytes.fromhex("070001 00"), 0) == Grouped(7, (), 1)
    for wrong, why in (
        ("07 03 00e803 05ffff feff", "count 3 does not fit the 8 bytes that follow"),
        ("07 01 00e803 05ffff feff", "3 bytes too many"),
        ("07 01 0de803 feff", "number is 13"),
    ):
        with pytest.raises(ProtocolError, match=why):
            codec.decode(bytes.fromhex(wrong), 0)
    for unwritable in (Grouped(7, (Pair(0, 65536),), 0), Grouped(7, (None,), 0), Grouped(7, (Pair(0, 0),) * 256, 0)):
        with pytest.raises(EncodeError, match=r"Grouped\.pairs"):
            codec.encode(unwritable)


def test_every_field_of_a_big_endian_message_is_big_endian() -> None:
    codec = BinaryCodec(BigEndianGrouped)
    whole = bytes.fromhex("0001 0503e8 00000001 3f800000 0102")
    message = codec.decode(whole, 0)
    assert (message.pairs, message.floats.tolist(), message.rest) == ((Pair(5, 1000),), [1.0], b"\x01\x02")
    assert codec.encode(message) == whole


def test_a_value_that_does_not_fit_names_class_values_and_widths() -> None:
    with pytest.raises(EncodeError, match="expected velocity: h"):
        BinaryCodec(BigEndian).encode(BigEndian(40000, 0))
