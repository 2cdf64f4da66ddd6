"""Lines of text: a word and numbers, both ways; what is no line of the protocol."""

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
SPACED: Lines[Line] = Lines((Drive,), b" ")
WRONG = rb"|X|d,1,2|D|D,1|D,1,2,3|D,1,|D,1,2x3|D,1,128|D,1,+2|D,1, 2|D,1,0.5|D,1,1_0|ask,|ask,1"


@pytest.mark.parametrize(
    ("lines", "message", "line"),
    [
        (LINES, Drive(100, -100), b"D,100,-100\n"),
        (LINES, Ask(), b"ask\n"),
        (LINES, Warm(21.5), b"w,21.500000\n"),
        (SPACED, Drive(1, 2), b"D 1 2\n"),
    ],
)
def test_lines_both_ways_with_the_separator_of_the_protocol(lines: Lines[Line], message: Line, line: bytes) -> None:
    assert lines.write(message) == line
    assert lines.read(line) == lines.read(line[:-1] + b"\r\n") == message


@pytest.mark.parametrize("line", [*WRONG.split(b"|"), b"\xff"])
def test_what_is_no_line_of_the_protocol(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        LINES.read(line + b"\n")


def test_a_number_out_of_range_is_not_written_and_a_line_ends_at_its_line_feed() -> None:
    with pytest.raises(EncodeError):
        LINES.write(Drive(128, 0))
    assert [Lines.end(b"ask\nD,1,2\n", start) for start in (0, 4)] == [4, 10]
    assert Lines.end(b"ask\nD,1", 4) > 7


@given(st.binary(max_size=40))
def test_random_bytes_are_a_message_or_a_protocol_error(data: bytes) -> None:
    try:
        message = LINES.read(data)
    except ProtocolError:
        return
    assert LINES.read(LINES.write(message)) == message
