"""The text codec: golden text both ways, a reader's tolerance, numbers that are none; and the array that fills a
binary message, which the same declaration makes. Texts and bytes are written by hand.
"""

import contextlib
import math
import re
import warnings
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import (
    F32,
    F64,
    I16,
    I32,
    U8,
    U32,
    BinaryCodec,
    Bool,
    Decimal,
    I64Fill,
    Message,
    Scalar,
    Text,
    TextCodec,
    Whole,
)

GOOGOL4 = b"1" + b"0" * 400
"""10^400: more than an int64, a float64, and a float32 can hold."""

Raw = Annotated[float, Scalar("h"), Decimal()]
Angle = Annotated[int, Scalar("B"), Whole(-90, 90)]
Counter = Annotated[int, Scalar("I"), Whole(0, 2**63 - 1)]


class Everything(Message, frozen=True):
    small: U8
    short: I16
    whole: I32
    counter: U32
    real: F32
    fine: F64
    flag: Bool
    raw: Raw
    angle: Angle


class Pair(Message, frozen=True):
    first: I32
    second: I32


class Real(Message, frozen=True):
    value: F64


class Reals(Message, frozen=True):
    first: F32
    second: F32


class Flag(Message, frozen=True):
    on: Bool


class Nothing(Message, frozen=True):
    pass


class Sweep(Message, frozen=True, eq=False):
    sequence: Counter
    points: I64Fill
    last: U32


class Bare(Message, frozen=True, eq=False):
    points: I64Fill


class Span(Message, frozen=True):
    start: U8
    end: U8

    def check(self) -> None:
        if self.end < self.start:
            raise ProtocolError(f"from {self.start} to {self.end}")


class Even(Message, frozen=True, eq=False):
    points: I64Fill
    last: U8

    def check(self) -> None:
        if len(self.points) % 2:
            raise ProtocolError(f"{len(self.points)} points")


PAIR, REAL, REALS, FLAG = TextCodec(Pair), TextCodec(Real), TextCodec(Reals), TextCodec(Flag)
EVERYTHING, SWEEP = TextCodec(Everything), TextCodec(Sweep)

GOLDEN = [
    (
        Everything(7, -300, -2, 4_000_000_000, 1.5, -0.25, True, 0.987654, -90),
        b"7|-300|-2|4000000000|1.500000|-0.250000|1|0.987654|-90",
    ),
    (
        Everything(255, -32768, -(2**31), 2**32 - 1, 0.0, 1e6, False, -2.75, 90),
        b"255|-32768|-2147483648|4294967295|0.000000|1000000.000000|0|-2.750000|90",
    ),
    (Pair(0, 2**31 - 1), b"0|2147483647"),
    (Reals(-135.0, 119.882812), b"-135.000000|119.882812"),
    (Flag(True), b"1"),
    (Nothing(), b""),
    (Span(1, 2), b"1|2"),
]


def row(sweep: Sweep) -> tuple[int, list[int], int]:
    """A message with an array, for comparing."""
    return sweep.sequence, sweep.points.tolist(), sweep.last


@pytest.mark.parametrize(("message", "golden"), GOLDEN)
def test_a_message_and_its_text_are_made_from_each_other(message: Message, golden: bytes) -> None:
    codec = TextCodec(type(message))
    assert codec.encode(message) == golden
    assert codec.decode(golden) == message


def test_every_field_has_the_type_that_is_declared() -> None:
    message = EVERYTHING.decode(b"7|-300|-2|4|1|2|1|3|-90")
    assert [type(getattr(message, name)) for name in message.__struct_fields__] == [
        *(int, int, int, int),
        *(float, float, bool, float, int),
    ]


# Floats, as std::to_string writes them


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, b"0.000000"),
        (-0.5, b"-0.500000"),
        (0.25, b"0.250000"),
        (36.529999, b"36.529999"),
        (123.456001, b"123.456001"),
        (1e-3, b"0.001000"),
        (1e-9, b"0.000000"),
        (-1e-9, b"-0.000000"),
        (1e15, b"1000000000000000.000000"),
        (1e22, b"10000000000000000000000.000000"),
        (3.4028234663852886e38, b"340282346638528859811704183484516925440.000000"),
    ],
)
def test_a_float_has_six_decimals_a_leading_digit_and_never_an_exponent(value: float, text: bytes) -> None:
    assert REAL.encode(Real(value)) == text


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_no_float_is_written_with_an_exponent_and_each_is_read_back_to_six_decimals(value: float) -> None:
    text = REAL.encode(Real(value))
    assert re.fullmatch(rb"-?[0-9]+\.[0-9]{6}", text)
    assert REAL.decode(text).value == pytest.approx(value, rel=1e-15, abs=5.1e-7)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "fast", None])
def test_what_is_no_finite_number_is_not_written(value: Any) -> None:
    with pytest.raises(EncodeError, match="Real"):
        REAL.encode(Real(value))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (b".5", 0.5),
        (b"-.5", -0.5),
        (b"5.", 5.0),
        (b"5", 5.0),
        (b"-5", -5.0),
        (b"007.250", 7.25),
        (b"0.0000000000000000000000001", 1e-25),
        (b"1" + b"0" * 300, 1e300),
    ],
)
def test_a_float_is_read_in_any_length_with_or_without_a_point(text: bytes, value: float) -> None:
    assert REAL.decode(text) == Real(value)


def test_an_integer_may_have_a_fraction_of_zeros_and_no_other() -> None:
    assert PAIR.decode(b"80.000000|-30.0") == Pair(80, -30)
    with pytest.raises(ProtocolError, match=r"Pair\.first"):
        PAIR.decode(b"80.5|0")


@pytest.mark.parametrize(("text", "on"), [(b"0", False), (b"1", True), (b"0.000000", False), (b"2", True)])
def test_truth_is_every_number_but_zero(text: bytes, on: bool) -> None:
    assert FLAG.decode(text) == Flag(on)
    assert FLAG.encode(Flag(on)) == (b"1" if on else b"0")


# Readers take every match of -?[0-9]*\.?[0-9]+ as a field and everything else as a separator


@pytest.mark.parametrize(
    "body",
    [
        b"1|-2", b"|1|-2|", b"1||-2", b"1-2", b"1 -2", b"1,-2", b"1\n-2\r\n", b"speed 1, angle -2 degrees",
        b"- 1|--2", b"+1|+-2", b"01|-002", b"\x00\xff1\x00-2\xfe", b"1;-2",
    ],
)  # fmt: skip
def test_everything_but_a_number_separates(body: bytes) -> None:
    assert PAIR.decode(body) == Pair(1, -2)


@pytest.mark.parametrize(
    ("codec", "body", "message"),
    [
        (PAIR, b"- 1|-|2", Pair(1, 2)),  # a minus belongs to a number only where it touches it
        (REALS, b"1.2.3", Reals(1.2, 0.3)),  # a number has one point
        (REALS, b"1...2", Reals(1.0, 0.2)),
        (REALS, b"1.5e3", Reals(1.5, 3.0)),  # an exponent is a field of its own
    ],
)
def test_a_number_ends_where_it_can_be_no_longer(codec: TextCodec[Any], body: bytes, message: Message) -> None:
    assert codec.decode(body) == message


# Fields that are missing, too many, empty, no numbers, out of range


@pytest.mark.parametrize(
    ("codec", "body", "what"),
    [
        (PAIR, b"", "0 fields, expected 2"),
        (PAIR, b"1", "1 fields, expected 2"),
        (PAIR, b"1|", "1 fields"),
        (PAIR, b"|", "0 fields"),
        (PAIR, b"1|nan", "1 fields"),
        (PAIR, b"one|two", "0 fields"),
        (PAIR, b"1|2|3", "3 fields"),
        (REAL, b"1.5e3", "2 fields, expected 1"),
        (REAL, b"inf", "0 fields"),
        (REAL, b".", "0 fields"),
        (REAL, b"-", "0 fields"),
        (TextCodec(Nothing), b"1", "1 fields, expected 0"),
        (SWEEP, b"", "Sweep of 0 fields"),
        (SWEEP, b"7", "Sweep of 1 fields"),
    ],
)
def test_a_wrong_number_of_fields_is_a_protocol_error(codec: TextCodec[Any], body: bytes, what: str) -> None:
    with pytest.raises(ProtocolError, match=what):
        codec.decode(body)


FIELDS = [b"7", b"-300", b"-2", b"4", b"1.5", b"-0.25", b"1", b"0.9", b"-90"]
"""Of a message with every kind of field."""


def everything_with(place: int, number: bytes) -> bytes:
    return b"|".join([*FIELDS[:place], number, *FIELDS[place + 1 :]])


@pytest.mark.parametrize("place", range(9))
@pytest.mark.parametrize("number", [GOOGOL4, b"-" + GOOGOL4, b"9" * 6000], ids=["10^400", "-10^400", "6000 nines"])
def test_a_number_that_nothing_can_hold_is_a_protocol_error_in_every_kind_of_field(place: int, number: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        EVERYTHING.decode(everything_with(place, number))
    assert len(str(caught.value)) < 300


OUT_OF_RANGE = {0: (256, -1), 1: (32768, -32769), 2: (2147483648, -2147483649), 3: (4294967296, -1), 8: (91, -91)}


@pytest.mark.parametrize(
    ("place", "number"), [(place, number) for place in OUT_OF_RANGE for number in OUT_OF_RANGE[place]]
)
def test_an_integer_out_of_its_range_is_a_protocol_error(place: int, number: int) -> None:
    with pytest.raises(ProtocolError, match=r"Everything\.\w+ = .*expected -?\d+ to \d+"):
        EVERYTHING.decode(everything_with(place, b"%d" % number))


@pytest.mark.parametrize(
    "message",
    [
        Span(256, 0),
        Span(-1, 0),
        Span("slow", 1),  # type: ignore[arg-type]
        Pair(2**31, 0),
        Pair(0, None),  # type: ignore[arg-type]
        Everything(0, 0, 0, 0, 0.0, 0.0, False, 0.0, 91),
        Everything(0, 0, 0, 0, 0.0, 0.0, False, 0.0, -91),
        Everything(0, 0, 0, 0, 0.0, 0.0, False, math.nan, 0),
    ],
)
def test_a_value_that_text_cannot_carry_is_an_encode_error(message: Message) -> None:
    with pytest.raises(EncodeError, match=type(message).__name__):
        TextCodec(type(message)).encode(message)


def test_a_decimal_has_no_range_of_its_binary_width() -> None:
    message = Everything(0, 0, 0, 0, 0.0, 0.0, False, 123456.5, 0)
    assert EVERYTHING.decode(EVERYTHING.encode(message)) == message


def test_values_that_do_not_go_together_are_a_protocol_error() -> None:
    with pytest.raises(ProtocolError, match="from 2 to 1"):
        TextCodec(Span).decode(b"2|1")
    even = TextCodec(Even)
    assert even.decode(b"1|2|9").points.tolist() == [1, 2]
    with pytest.raises(ProtocolError, match="3 points"):
        even.decode(b"1|2|3|9")


def test_a_field_without_a_form_in_text_is_a_mistake_of_the_declaration() -> None:
    class Wrong(Message, frozen=True):
        name: Text

    with pytest.raises(TypeError, match="name"):
        TextCodec(Wrong)


# Arrays


def test_an_array_takes_the_fields_that_the_others_leave() -> None:
    sweep = SWEEP.decode(b"5|1000|0|-3|2147483647|768")
    assert row(sweep) == (5, [1000, 0, -3, 2147483647], 768)
    assert sweep.points.dtype == np.int64
    assert type(sweep.sequence) is int
    assert type(sweep.last) is int
    assert SWEEP.encode(sweep) == b"5|1000|0|-3|2147483647|768"


def test_an_array_may_be_empty_or_alone() -> None:
    assert row(SWEEP.decode(b"5|768")) == (5, [], 768)
    assert TextCodec(Bare).decode(b"1|2|3").points.tolist() == [1, 2, 3]
    assert TextCodec(Bare).decode(b"").points.tolist() == []
    assert TextCodec(Bare).decode(b"|||").points.tolist() == []


@pytest.mark.parametrize(
    "values", [[1, 2, 3], (1, 2, 3), np.array([1, 2, 3], np.int32), np.arange(6)[1::2] // 2 + 1, np.arange(1.0, 4.0)]
)
def test_an_array_is_written_from_anything_that_holds_numbers(values: Any) -> None:
    assert SWEEP.encode(Sweep(5, values, 9)) == b"5|1|2|3|9"


NOT_FINITE = ([math.nan], [1, math.inf], np.array([1.0, math.nan]), np.array([1.0, -math.inf], np.float32))


@pytest.mark.parametrize("values", [*NOT_FINITE, ["near"], [None], [2**31], [2**70], None], ids=repr)
def test_an_array_that_readers_cannot_hold_is_an_encode_error(values: Any) -> None:
    with pytest.raises(EncodeError, match="Sweep"):
        SWEEP.encode(Sweep(5, values, 9))


@pytest.mark.parametrize(
    "body",
    [
        *(b"5|10|20|9|", b"|5|10|20|9", b"5||10|20|9", b"5|10 20|9", b"5|10|20 9", b"5|10|20|9x", b"5, 10, 20, 9\r\n"),
        *(b"5|\x0010|\xff20|9", b"5|+10|20|9", b"5| 10|\t20|9", b"5|010|0020|9", b"5|- 10|20|9", b"5|-|10|20|9"),
        *(b"5|+|10|20|9", b"5|10|20|-|9", b"5|10|-\n20|9"),
    ],
)
def test_everything_but_a_number_separates_around_an_array_too(body: bytes) -> None:
    assert row(SWEEP.decode(body)) == (5, [10, 20], 9)


@pytest.mark.parametrize(("body", "points"), [(b"5|10-20|9", [10, -20]), (b"5|--10|20|9", [-10, 20])])
def test_a_minus_that_touches_a_number_of_an_array_belongs_to_it(body: bytes, points: list[int]) -> None:
    assert row(SWEEP.decode(body)) == (5, points, 9)


@pytest.mark.parametrize("place", range(5))
@pytest.mark.parametrize(
    "number",
    [GOOGOL4, b"-" + GOOGOL4, b"9" * 6000, b"9223372036854775808", b"1.5"],
    ids=["10^400", "-10^400", "6000 nines", "2^63", "1.5"],
)
@pytest.mark.parametrize("separator", [b"|", b" x"], ids=["in order", "with garbage"])
def test_a_number_that_is_too_large_or_no_integer_is_never_clipped_wherever_it_stands(place, number, separator) -> None:
    fields = [b"5", b"10", b"20", b"30", b"9"]
    fields[place] = number
    with pytest.raises(ProtocolError) as caught:
        SWEEP.decode(separator.join(fields))
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "body", [b"-1|10|9", b"5|10|-1", b"5|10|4294967296", b"5|2147483648|9", b"5|10 2147483648|9", b"-1|10 20|9"]
)
def test_a_number_out_of_its_range_around_or_in_an_array_is_a_protocol_error(body: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"Sweep\.\w+"):
        SWEEP.decode(body)


def test_the_largest_numbers_pass() -> None:
    body = b"9223372036854775806|2147483647|4294967295"
    assert row(SWEEP.decode(body)) == (2**63 - 2, [2**31 - 1], 2**32 - 1)
    assert row(SWEEP.decode(body.replace(b"|", b" x"))) == (2**63 - 2, [2**31 - 1], 2**32 - 1)


def by_the_book(body: bytes) -> tuple[int, list[int], int] | None:
    """What the reference reader makes of a sweep; None where that is no sweep."""
    numbers = [int(number) for number in re.findall(rb"-?[0-9]*\.?[0-9]+", body)]
    if len(numbers) < 2:
        return None
    sequence, *points, last = numbers
    right = 0 <= sequence < 2**63 and 0 <= last < 2**32 and all(-(2**63) <= point < 2**31 for point in points)
    return (sequence, points, last) if right else None


@given(
    st.lists(
        st.one_of(
            st.integers(-3000, 6000).map(lambda number: b"%d" % number),
            st.sampled_from([b"|"] * 6 + [b" ", b"-", b"+", b"x", b"\n", b"\x00", b"||", b"2147483648", b"0" * 30]),
        ),
        max_size=40,
    ).map(b"".join)
)
@example(b"1|2|3 4")
@example(b"1|-|3")
@example(b"1|- 2|3")
def test_a_row_is_read_as_the_reference_reader_reads_it(body: bytes) -> None:
    expected = by_the_book(body)
    if expected is None:
        with pytest.raises(ProtocolError):
            SWEEP.decode(body)
    else:
        assert row(SWEEP.decode(body)) == expected


@given(st.lists(st.integers(-3000, 2**31 - 1), max_size=800), st.integers(0, 2**63 - 2), st.integers(0, 2**32 - 1))
def test_a_row_in_order_is_read_as_one_with_garbage_is(points: list[int], sequence: int, last: int) -> None:
    body = b"|".join(b"%d" % number for number in (sequence, *points, last))
    assert row(SWEEP.decode(body)) == (sequence, points, last)
    assert row(SWEEP.decode(body.replace(b"|", b" |x "))) == (sequence, points, last)


@pytest.mark.parametrize("body", [b"1|2|3 4", b"1|2|3x4", b"1||2", b"x"])
def test_a_numpy_that_only_warns_of_what_it_did_not_read_loses_no_field(body, monkeypatch: pytest.MonkeyPatch) -> None:
    """numpy 1.26 to 2.3 warn and give what they have read; who runs a gateway has warnings ignored, not raised."""

    def fromstring(data: bytes, dtype: Any, *, sep: str) -> Any:
        read = re.match(rb"(?:[0-9]+(?:\|[0-9]+)*\|?)?", data)
        assert read is not None
        if read.end() < len(data):
            warnings.warn("string or file could not be read to its end", DeprecationWarning, stacklevel=2)
        return np.array([int(number) for number in read.group().split(b"|") if number], dtype)

    monkeypatch.setattr(np, "fromstring", fromstring)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("ignore")
        assert TextCodec(Bare).decode(body).points.tolist() == [int(number) for number in re.findall(rb"[0-9]+", body)]
    assert not warned


@pytest.mark.parametrize("body", [b"", b"1|2|3 4", b"1|-|2", b"1||2", b"5|" + GOOGOL4 + b"|9", b"1.5|2", b"\x00", b"|"])
def test_no_warning_is_left_behind(body: bytes) -> None:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for codec in (SWEEP, PAIR, EVERYTHING, REAL):
            with contextlib.suppress(ProtocolError):
                codec.decode(body)
    assert [str(warning.message) for warning in warned] == []


@given(st.one_of(st.binary(max_size=80), st.text("0123456789.|- ", max_size=80).map(str.encode)))
def test_random_bytes_give_a_message_or_a_protocol_error(body: bytes) -> None:
    for declared in (Everything, Pair, Real, Flag, Nothing, Sweep, Bare, Span, Even):
        try:
            message = TextCodec(declared).decode(body)
        except ProtocolError:
            continue
        assert isinstance(message, declared)


# The same declaration in binary: an array that fills what the fields around it leave


class Packed(Message, frozen=True, eq=False):
    sequence: U32
    points: I64Fill
    first: U8
    last: U32


PACKED = BinaryCodec(Packed)
HEAD, TAIL = "07000000", "01 feffffff"
POINTS = "e803000000000000 0000000000000000 fdffffffffffffff 0000000000000080"


@pytest.mark.parametrize(("points", "values"), [(POINTS, [1000, 0, -3, -(2**63)]), ("", [])])
def test_an_array_that_fills_a_message_is_read_and_written_and_may_be_empty(points: str, values: list[int]) -> None:
    body = bytes.fromhex(HEAD + points + TAIL)
    message = PACKED.decode(body, 0)
    assert (message.sequence, message.first, message.last) == (7, 1, 2**32 - 2)
    assert message.points.tolist() == values
    assert message.points.dtype == np.dtype("<i8")
    assert not message.points.flags.writeable
    assert PACKED.encode(message) == body
    assert PACKED.decode(b"\xff\xff" + body, 2).points.tolist() == values


def test_the_bytes_that_are_always_there_are_known() -> None:
    assert PACKED.fixed_size == 9
    assert BinaryCodec(Pair).fixed_size == 8
    assert BinaryCodec(Nothing).fixed_size == 0
    assert BinaryCodec(Everything).fixed_size == 1 + 2 + 4 + 4 + 4 + 8 + 1 + 2 + 1


def test_a_message_that_is_no_multiple_of_items_or_shorter_than_its_other_fields_is_a_protocol_error() -> None:
    body = bytes.fromhex(HEAD + POINTS + TAIL)
    for length in range(len(body) + 8):
        data = (body + bytes(8))[:length]
        if length >= 9 and (length - 9) % 8 == 0:
            assert len(PACKED.decode(data, 0).points) == (length - 9) // 8
        else:
            with pytest.raises(ProtocolError, match="Packed"):
                PACKED.decode(data, 0)


@pytest.mark.parametrize(
    "values", [[1, -2], (1, -2), np.array([1, -2], np.int16), np.array([1, -2], ">i8"), np.array([1, 9, -2, 9])[::2]]
)
def test_an_array_that_fills_is_written_from_anything_that_holds_numbers(values: Any) -> None:
    golden = bytes.fromhex(HEAD + "0100000000000000 feffffffffffffff" + TAIL)
    assert PACKED.encode(Packed(7, values, 1, 2**32 - 2)) == golden


@pytest.mark.parametrize(
    "values", [["near"], [None], [2**63], [math.nan], np.array([math.nan]), np.array([math.inf], np.float32)], ids=repr
)
def test_an_array_that_its_items_cannot_hold_is_an_encode_error(values: Any) -> None:
    with pytest.raises(EncodeError, match=r"Packed\.points"):
        PACKED.encode(Packed(7, values, 1, 2))


def test_only_fields_of_fixed_width_may_follow_an_array_that_fills() -> None:
    class Wrong(Message, frozen=True, eq=False):
        points: I64Fill
        name: Text

    with pytest.raises(TypeError, match="points: only fields of fixed width may follow"):
        BinaryCodec(Wrong)


@given(st.binary(max_size=60))
def test_random_bytes_fill_a_message_or_are_a_protocol_error(data: bytes) -> None:
    try:
        message = PACKED.decode(data, 0)
    except ProtocolError:
        return
    assert PACKED.encode(message) == data
