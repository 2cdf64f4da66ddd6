"""The binary codec: golden bytes both ways, truncation, surplus, counts that lie. Bytes are worked out by hand."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import F32, F64, I16, I32, U8, BinaryCodec, Blob, Bool, F32Array, Message, Rest, Text


class Fixed(Message, frozen=True):
    small: U8
    flag: Bool
    whole: I32
    real: F32
    fine: F64


class Empty(Message, frozen=True):
    pass


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


class Even(Message, frozen=True):
    text: Text

    def check(self) -> None:
        if len(self.text) % 2:
            raise ProtocolError(f"text of {len(self.text)} characters")


FIXED = BinaryCodec(Fixed)
MIXED = BinaryCodec(Mixed)
RANGES = BinaryCodec(Ranges)

GOLDEN = [
    (Fixed(7, True, -2, 1.5, -0.25), "07 01 feffffff 0000c03f 000000000000d0bf"),
    (Fixed(255, False, 2**31 - 1, -2.25, 1.0), "ff 00 ffffff7f 000010c0 000000000000f03f"),
    (Empty(), ""),
    (Mixed(1, "hi", b"\x00\xff"), "01 02000000 6869 02000000 00ff"),
    (Mixed(0, "", b""), "00 00000000 00000000"),
    (Tail(258, b"\x01\x02"), "02010000 0102"),
    (Tail(0, b""), "00000000"),
    (Opaque(b"\xaa"), "aa"),
    (Opaque(), ""),
    (Perhaps(1, b"\x02"), "01 01000000 02"),
    (Perhaps(1), "01"),
    (Even("ab"), "02000000 6162"),
]


@pytest.mark.parametrize(("message", "golden"), GOLDEN)
def test_a_message_and_its_bytes_are_made_from_each_other_and_what_stands_before_is_not_read(message, golden) -> None:
    codec = BinaryCodec(type(message))
    assert codec.encode(message) == bytes.fromhex(golden)
    assert codec.decode(bytes.fromhex(golden), 0) == message
    assert codec.decode(b"\xff\xff\xff" + bytes.fromhex(golden), 3) == message


@pytest.mark.parametrize(("message", "golden"), GOLDEN)
def test_a_truncated_body_and_a_byte_too_many_are_protocol_errors(message: Message, golden: str) -> None:
    whole, codec = bytes.fromhex(golden), BinaryCodec(type(message))
    cuts = range(len(whole)) if isinstance(message, Fixed | Mixed | Even) else ()
    surplus = [] if isinstance(message, Tail | Opaque) else [whole + b"\x00"]
    for wrong in (*(whole[:cut] for cut in cuts), *surplus):
        with pytest.raises(ProtocolError):
            codec.decode(wrong, 0)


@pytest.mark.parametrize("count", ["ffffffff", "00000080", "03000000", "ffffff7f"])
def test_a_count_that_lies_is_a_protocol_error(count: str) -> None:
    with pytest.raises(ProtocolError, match="count"):
        MIXED.decode(b"\x01" + bytes.fromhex(count) + b"ab", 0)


def test_every_byte_but_zero_is_true_and_floats_that_are_no_numbers_are_passed_on() -> None:
    message = FIXED.decode(bytes.fromhex("00 02 00000000 0000c07f 000000000000f0ff"), 0)
    assert message.flag is True
    assert math.isnan(message.real)
    assert message.fine == -math.inf


def test_a_text_that_is_not_ascii_is_shown_escaped() -> None:
    assert MIXED.decode(bytes.fromhex("00 03000000 61ff62 00000000"), 0).text == r"a\xffb"


def test_an_array_is_a_read_only_view_of_little_endian_floats() -> None:
    data = bytes.fromhex("ff 02000000 0000c03f 000010c0 09")
    message = RANGES.decode(data, 1)
    assert message.ranges.dtype == np.dtype("<f4")
    assert message.ranges.tolist() == [1.5, -2.25]
    assert not message.ranges.flags.writeable
    assert message.last == 9
    assert RANGES.encode(message) == data[1:]


@pytest.mark.parametrize("values", [[], [1, 2], np.array([1.0, 2.0, 3.0]), np.arange(10, dtype=np.float32)[::2]])
def test_an_array_is_encoded_from_anything_that_holds_numbers(values: object) -> None:
    expected = [float(value) for value in values]  # type: ignore[attr-defined]
    golden = struct.pack(f"<i{len(expected)}fB", len(expected), *expected, 1)
    assert RANGES.encode(Ranges(values, 1)) == golden  # type: ignore[arg-type]


def test_an_empty_array_at_the_very_end_is_read() -> None:
    class OnlyRanges(Message, frozen=True, eq=False):
        ranges: F32Array

    assert len(BinaryCodec(OnlyRanges).decode(bytes(4), 0).ranges) == 0


@pytest.mark.parametrize("count", ["ffffffff", "02000000", "ffffff3f", "ffffff7f"])
def test_an_array_whose_count_lies_is_a_protocol_error(count: str) -> None:
    with pytest.raises(ProtocolError):
        RANGES.decode(bytes.fromhex(count) + bytes(5), 0)


@pytest.mark.parametrize(
    "message",
    [
        Fixed(256, True, 0, 0.0, 0.0),
        Fixed(-1, True, 0, 0.0, 0.0),
        Fixed(0, True, 2**31, 0.0, 0.0),
        Fixed(0, True, 0, 1e39, 0.0),
        Fixed(0, True, 0, "fast", 0.0),  # type: ignore[arg-type]
        Mixed(0, "Grüße", b""),
        Mixed(300, "", b""),
        Mixed(0, None, b""),  # type: ignore[arg-type]
    ],
)
def test_a_value_the_wire_type_cannot_carry_is_an_encode_error(message: Message) -> None:
    with pytest.raises(EncodeError, match=type(message).__name__):
        BinaryCodec(type(message)).encode(message)


def test_values_that_do_not_go_together_are_a_protocol_error() -> None:
    with pytest.raises(ProtocolError, match="3 characters"):
        BinaryCodec(Even).decode(bytes.fromhex("03000000 616263"), 0)


def test_values_of_fixed_length_that_do_not_go_together_are_a_protocol_error() -> None:
    class Span(Message, frozen=True):
        start: U8
        end: U8

        def check(self) -> None:
            if self.end < self.start:
                raise ProtocolError(f"from {self.start} to {self.end}")

    codec = BinaryCodec(Span)
    assert codec.decode(bytes.fromhex("01 02"), 0) == Span(1, 2)
    with pytest.raises(ProtocolError, match="from 2 to 1"):
        codec.decode(bytes.fromhex("02 01"), 0)


class Untyped(Message, frozen=True):
    number: int


class TwoOptional(Message, frozen=True):
    first: Blob | None = None
    second: Blob | None = None


class BigEndianText(Message, frozen=True):
    byte_order = ">"
    text: Text


@pytest.mark.parametrize(
    ("declared", "what"), [(Untyped, "number"), (TwoOptional, "only the last field"), (BigEndianText, "fixed width")]
)
def test_a_mistake_of_the_declaration_is_told(declared: type[Message], what: str) -> None:
    with pytest.raises(TypeError, match=what):
        BinaryCodec(declared)


@given(st.binary(max_size=60), st.integers(0, 5))
def test_random_bytes_give_a_message_or_a_protocol_error(data: bytes, start: int) -> None:
    for declared in (Fixed, Empty, Mixed, Tail, Opaque, Perhaps, Ranges, Even):
        codec = BinaryCodec(declared)
        try:
            message = codec.decode(data, min(start, len(data)))
        except ProtocolError:
            continue
        assert isinstance(message, declared)


@given(st.builds(Mixed, st.integers(0, 255), st.text(st.characters(max_codepoint=127)), st.binary()))
def test_what_is_encoded_is_decoded_to_the_same(message: Mixed) -> None:
    assert MIXED.decode(MIXED.encode(message), 0) == message


class BigEndian(Message, frozen=True):
    byte_order = ">"
    velocity: I16
    radius: I16


def test_a_message_of_fixed_width_can_be_big_endian() -> None:
    codec = BinaryCodec(BigEndian)
    assert codec.encode(BigEndian(-200, 500)) == bytes.fromhex("ff38 01f4")
    assert codec.decode(bytes.fromhex("ff38 01f4"), 0) == BigEndian(-200, 500)


def test_fields_that_cannot_be_given_by_position_are_refused() -> None:
    class ByName(Message, frozen=True, kw_only=True):
        value: U8

    with pytest.raises(TypeError, match="ByName: fields are given by position"):
        BinaryCodec(ByName)
