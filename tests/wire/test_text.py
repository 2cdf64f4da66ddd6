"""The text codec: a reader's tolerance, and numbers that are none. Texts are written by hand."""

import contextlib
import itertools
import math
import re
import warnings
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import F32, F64, I16, I32, U8, U32, Bool, Decimal, I64Fill, Message, Scalar, Text, TextCodec, Whole


class Everything(Message, frozen=True):
    small: U8
    short: I16
    whole: I32
    counter: U32
    real: F32
    fine: F64
    flag: Bool
    raw: Annotated[float, Scalar("h"), Decimal()]
    angle: Annotated[int, Scalar("B"), Whole(-90, 90)]


class Pair(Message, frozen=True):
    first: I32
    second: I32

    def check(self) -> None:
        if self.second == 13:
            raise ProtocolError("the second is 13")


class Reals(Message, frozen=True):
    first: F32
    second: F64


class Sweep(Message, frozen=True, eq=False):
    sequence: Annotated[int, Scalar("I"), Whole(0, 2**63 - 1)]
    points: I64Fill
    last: U32

    def check(self) -> None:
        if self.last == 13:
            raise ProtocolError("the last is 13")


class Bare(Message, frozen=True, eq=False):
    points: I64Fill


PAIR, REALS, EVERYTHING, SWEEP, BARE = map(TextCodec, (Pair, Reals, Everything, Sweep, Bare))


def row(sweep: Sweep) -> tuple[int, list[int], int]:
    """A message with an array, for comparing."""
    return sweep.sequence, sweep.points.tolist(), sweep.last


@pytest.mark.parametrize(
    ("message", "golden"),
    [
        (
            Everything(7, -300, -2, 4_000_000_000, 1.5, -0.25, True, 0.987654, -90),
            b"7|-300|-2|4000000000|1.500000|-0.250000|1|0.987654|-90",
        ),
        (
            Everything(255, -32768, -(2**31), 2**32 - 1, 0.0, 1e6, False, 123456.5, 90),
            b"255|-32768|-2147483648|4294967295|0.000000|1000000.000000|0|123456.500000|90",
        ),
    ],
)
def test_a_message_and_its_text_are_made_from_each_other(message: Everything, golden: bytes) -> None:
    assert EVERYTHING.encode(message) == golden
    assert repr(EVERYTHING.decode(golden)) == repr(message), "of the same types too"


@given(st.floats(allow_nan=False, allow_infinity=False))
@example(-1e-9)
@example(36.529999)
@example(3.4028234663852886e38)
def test_no_float_is_written_with_an_exponent_and_each_is_read_back_to_six_decimals(value: float) -> None:
    text = REALS.encode(Reals(0.0, value))
    assert re.fullmatch(rb"0\.000000\|-?[0-9]+\.[0-9]{6}", text)
    assert REALS.decode(text).second == pytest.approx(value, rel=1e-15, abs=5.1e-7)


SEPARATED = (b"|1||-2|", b"1-2", b"speed 1, angle -2\r\n", b"- 1|--2", b"+1|+-2", b"01\x00\xff-002", b"1.000000|-2.0")


@pytest.mark.parametrize(
    ("codec", "body", "message"),
    [
        *((PAIR, body, Pair(1, -2)) for body in SEPARATED),  # everything but a number separates
        (PAIR, b"- 1|-|2", Pair(1, 2)),  # a minus belongs to a number only where it touches it
        (REALS, b"1.2.3", Reals(1.2, 0.3)),  # a number has one point
        (REALS, b"1.5e3", Reals(1.5, 3.0)),  # an exponent is a field of its own
        *((REALS, body, Reals(-0.5, 5.0)) for body in (b"-.5|5.", b"-000.50|5", b"-0.5.|05.0")),
        (REALS, b"0|1" + b"0" * 300, Reals(0.0, 1e300)),
    ],
)
def test_a_reader_takes_every_number_as_a_field_and_no_more(codec: TextCodec[Any], body: bytes, message) -> None:
    assert codec.decode(body) == message


HUGE = (b"1" + b"0" * 400, b"-1" + b"0" * 400, b"9" * 6000)
"""More than an int64, a float64, and a float32 can hold."""
FIELDS = (b"7", b"-300", b"-2", b"4", b"1.5", b"-0.25", b"1", b"0.9", b"-90")
OUT_OF_RANGE = {0: (256, -1), 1: (32768, -32769), 2: (2147483648, -2147483649), 3: (4294967296, -1), 8: (91, -91)}


def everything_with(place: int, number: bytes) -> bytes:
    return b"|".join([*FIELDS[:place], number, *FIELDS[place + 1 :]])


def test_truth_is_every_number_but_zero() -> None:
    numbers = (b"0", b"0.000000", b"1", b"2", b"-.5")
    assert [EVERYTHING.decode(everything_with(6, number)).flag for number in numbers] == [
        False,
        False,
        True,
        True,
        True,
    ]


@pytest.mark.parametrize(
    ("codec", "body", "what"),
    [
        *((PAIR, body, "1 fields, expected 2") for body in (b"1", b"1|", b"1|nan")),
        *((PAIR, body, "0 fields, expected 2") for body in (b"", b"|", b"one|two")),
        (PAIR, b"1|2|3", "3 fields, expected 2"),
        (PAIR, b"80.5|0", r"Pair\.first"),
        *((REALS, body, "0 fields") for body in (b"inf", b".", b"-")),
        (SWEEP, b"", "Sweep of 0 fields"),
        (SWEEP, b"7", "Sweep of 1 fields"),
        (PAIR, b"2|13", "the second is 13"),
        (SWEEP, b"1|2|3|13", "the last is 13"),
        *(
            (EVERYTHING, everything_with(place, b"%d" % number), r"Everything\.\w+ = .*expected -?\d+ to \d+")
            for place, numbers in OUT_OF_RANGE.items()
            for number in numbers
        ),
        *((SWEEP, body, r"Sweep\.\w+") for body in (b"-1|10|9", b"5|10|-1", b"5|10|4294967296", b"5|2147483648|9")),
    ],
)
def test_wrong_fields_are_a_protocol_error_that_says_what_was_expected(codec: TextCodec[Any], body, what: str) -> None:
    with pytest.raises(ProtocolError, match=what):
        codec.decode(body)


SWEPT = (b"5", b"10", b"20", b"30", b"9")


@pytest.mark.parametrize(
    ("codec", "fields", "separator", "numbers"),
    [
        (EVERYTHING, FIELDS, b"|", HUGE),
        *((SWEEP, SWEPT, separator, (*HUGE, b"9223372036854775808", b"1.5")) for separator in (b"|", b" x")),
    ],
    ids=["every kind of field", "an array in order", "an array with garbage"],
)
def test_a_number_that_its_field_cannot_hold_is_never_clipped_wherever_it_stands(codec, fields, separator, numbers):
    for number, place in itertools.product(numbers, range(len(fields))):
        with pytest.raises(ProtocolError) as caught:
            codec.decode(separator.join([*fields[:place], number, *fields[place + 1 :]]))
        assert len(str(caught.value)) < 300


NOT_FINITE = ([math.nan], [1, math.inf], np.array([1.0, math.nan]), np.array([1.0, -math.inf], np.float32))


@pytest.mark.parametrize(
    "message",
    [
        *(Reals(0.0, value) for value in (math.nan, math.inf, -math.inf, "fast", None)),
        *(Pair(value, 0) for value in (2**31, -(2**31) - 1, "slow", None)),
        *(Everything(0, 0, 0, 0, 0.0, 0.0, False, raw, angle) for raw, angle in ((0.0, 91), (0.0, -91), (math.nan, 0))),
        *(Sweep(5, points, 9) for points in (*NOT_FINITE, ["near"], [None], [2**31], [2**70], None)),
    ],
    ids=repr,
)
def test_a_value_that_text_or_its_readers_cannot_hold_is_an_encode_error(message: Message) -> None:
    with pytest.raises(EncodeError, match=type(message).__name__):
        TextCodec(type(message)).encode(message)


def test_a_field_without_a_form_in_text_is_a_mistake_of_the_declaration() -> None:
    with pytest.raises(TypeError, match="name"):
        TextCodec(msgspec.defstruct("Wrong", [("name", Text)], bases=(Message,), frozen=True))


# Arrays


def test_an_array_takes_the_fields_that_the_others_leave_and_is_written_from_anything_that_holds_numbers() -> None:
    sweep = SWEEP.decode(b"5|1000|0|-3|2147483647|768")
    assert row(sweep) == (5, [1000, 0, -3, 2147483647], 768)
    assert (sweep.points.dtype, type(sweep.sequence), type(sweep.last)) == (np.int64, int, int)
    assert SWEEP.encode(sweep) == b"5|1000|0|-3|2147483647|768"
    for points in ((1, 2, 3), np.array([1, 2, 3], np.int32), np.arange(6)[1::2] // 2 + 1, np.arange(1.0, 4.0)):
        assert SWEEP.encode(Sweep(5, points, 9)) == b"5|1|2|3|9"
    assert row(SWEEP.decode(b"5|768")) == (5, [], 768)
    assert [BARE.decode(body).points.tolist() for body in (b"1|2|3", b"", b"|||")] == [[1, 2, 3], [], []]


def by_the_book(body: bytes) -> tuple[int, list[int], int] | None:
    """What the reference reader makes of a sweep; None where that is no sweep."""
    numbers = [int(number) for number in re.findall(rb"-?[0-9]*\.?[0-9]+", body)]
    if len(numbers) < 2:
        return None
    sequence, *points, last = numbers
    right = (
        0 <= sequence < 2**63
        and 0 <= last < 2**32
        and last != 13
        and all(-(2**63) <= point < 2**31 for point in points)
    )
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
@example(b"0|13")
@example(b"5|10-20|--9|9")
@example(b"|5|+10|\xff020||- 3|9x\r\n")
@example(b"9223372036854775806|2147483647|4294967295")
def test_a_row_is_read_as_the_reference_reader_reads_it(body: bytes) -> None:
    for separated in (body, body.replace(b"|", b" |x ")):
        expected = by_the_book(separated)
        if expected is None:
            with pytest.raises(ProtocolError):
                SWEEP.decode(separated)
        else:
            assert row(SWEEP.decode(separated)) == expected


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert BARE.decode(body).points.tolist() == [int(number) for number in re.findall(rb"[0-9]+", body)]


@given(st.one_of(st.binary(max_size=80), st.text("0123456789.|- ", max_size=80).map(str.encode)))
@example(b"")
@example(b"1|2|3 4")
@example(b"5|" + HUGE[0] + b"|9")
def test_random_bytes_give_a_message_or_a_protocol_error_and_no_warning(body: bytes) -> None:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for codec in (EVERYTHING, PAIR, REALS, SWEEP, BARE):
            with contextlib.suppress(ProtocolError):
                assert isinstance(codec.decode(body), codec.message)
    assert [str(warning.message) for warning in warned] == []
