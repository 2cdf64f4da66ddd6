"""Lines of text: a word and numbers, both ways; what is no line of the protocol."""

from __future__ import annotations

from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import F32
from zbridge.wire.fields import Scalar, Whole
from zbridge.wire.lines import Line, Lines

Speed = Annotated[int, Scalar("h"), Whole(-127, 127)]


class Drive(Line, frozen=True):
    word = b"D"
    left: Speed
    right: Speed


class Ask(Line, frozen=True):
    word = b"ask"


class Warm(Line, frozen=True):
    word = b"w"
    celsius: F32


LINES: Lines[Line] = Lines((Drive, Ask, Warm))


@pytest.mark.parametrize(
    ("message", "line"), [(Drive(100, -100), b"D,100,-100\n"), (Ask(), b"ask\n"), (Warm(21.5), b"w,21.500000\n")]
)
def test_lines_both_ways(message: Line, line: bytes) -> None:
    assert LINES.write(message) == line
    assert LINES.read(line) == message
    assert LINES.read(line[:-1] + b"\r\n") == message


def test_the_separator_is_the_protocols() -> None:
    lines: Lines[Line] = Lines((Drive,), b" ")
    assert lines.write(Drive(1, 2)) == b"D 1 2\n"
    assert lines.read(b"D 1 2\n") == Drive(1, 2)


@pytest.mark.parametrize(
    "line",
    [
        b"\n", b"X\n", b"d,1,2\n", b"D\n", b"D,1\n", b"D,1,2,3\n", b"D,1,\n", b"D,1,2x3\n", b"D,1,128\n",
        b"D,1,+2\n", b"ask,\n",
    ]
    + [b"D,1, 2\n", b"D,1,0.5\n", b"D,1,1_0\n", b"ask,1\n", b"\xff\n"],
)  # fmt: skip
def test_what_is_no_line_of_the_protocol(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        LINES.read(line)


def test_a_number_out_of_range_is_not_written() -> None:
    with pytest.raises(EncodeError):
        LINES.write(Drive(128, 0))


def test_a_line_ends_at_its_line_feed() -> None:
    assert Lines.end(b"ask\nD,1,2\n", 0) == 4
    assert Lines.end(b"ask\nD,1,2\n", 4) == 10
    assert Lines.end(b"ask\nD,1", 4) > 7


@given(st.binary(max_size=40))
def test_random_bytes_are_a_message_or_a_protocol_error(data: bytes) -> None:
    try:
        message = LINES.read(data)
    except ProtocolError:
        return
    assert LINES.read(LINES.write(message)) == message
