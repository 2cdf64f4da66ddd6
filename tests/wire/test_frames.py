"""Frames out of a stream in any cut, in bounded memory."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError
from zbridge.wire.frames import FrameBuffer


def frame_end(data: bytes, start: int) -> int:
    """A header of two bytes, the second the length of the body; a first byte of 255 is impossible."""
    if data[start] == 255:
        raise ProtocolError("255")
    if len(data) - start < 2:
        return start + 2
    return start + 2 + data[start + 1]


STREAM = b"\x01\x03abc" + b"\x02\x00" + b"\x03\x01z" + b"\x04\x02xy"
FRAMES = [b"\x01\x03abc", b"\x02\x00", b"\x03\x01z", b"\x04\x02xy"]


@pytest.fixture
def buffer() -> FrameBuffer:
    return FrameBuffer(frame_end, 50)


def test_a_whole_stream_is_cut_into_its_frames(buffer: FrameBuffer) -> None:
    assert list(buffer.feed(STREAM)) == FRAMES
    assert len(buffer) == 0


def test_nothing_comes_of_nothing(buffer: FrameBuffer) -> None:
    assert list(buffer.feed(b"")) == []


@pytest.mark.parametrize("first", range(len(STREAM) + 1))
@pytest.mark.parametrize("second", range(0, len(STREAM) + 1, 3))
def test_a_stream_may_be_cut_anywhere(buffer: FrameBuffer, first: int, second: int) -> None:
    first, second = sorted((first, second))
    frames = [frame for part in (STREAM[:first], STREAM[first:second], STREAM[second:]) for frame in buffer.feed(part)]
    assert frames == FRAMES


def test_a_stream_may_come_byte_by_byte_and_a_frame_comes_with_its_last_byte(buffer: FrameBuffer) -> None:
    came = [len(list(buffer.feed(STREAM[at : at + 1]))) for at in range(len(STREAM))]
    assert came == [0, 0, 0, 0, 1, 0, 1, 0, 0, 1, 0, 0, 0, 1]


def test_frames_are_bytes_of_their_own(buffer: FrameBuffer) -> None:
    assert all(type(frame) is bytes for part in (STREAM[:3], STREAM[3:]) for frame in buffer.feed(part))


def test_an_incomplete_frame_is_kept_and_counted(buffer: FrameBuffer) -> None:
    assert list(buffer.feed(b"\x01\x03a")) == []
    assert len(buffer) == 3
    assert repr(buffer) == "<FrameBuffer 3 of 5 bytes, limit 50>"
    assert list(buffer.feed(b"bc\x02")) == [b"\x01\x03abc"]
    assert len(buffer) == 1


def test_a_frame_of_the_limit_passes_and_one_byte_more_does_not(buffer: FrameBuffer) -> None:
    assert len(next(buffer.feed(b"\x01\x30" + bytes(48)))) == 50
    with pytest.raises(ProtocolError, match="frame of 51 bytes exceeds 50"):
        list(buffer.feed(b"\x01\x31"))


def test_a_frame_that_is_too_long_is_refused_by_its_header_alone_even_in_two_reads(buffer: FrameBuffer) -> None:
    assert list(buffer.feed(b"\x01")) == []
    with pytest.raises(ProtocolError):
        list(buffer.feed(b"\x31"))


def test_frames_before_a_broken_one_are_yielded_first(buffer: FrameBuffer) -> None:
    frames = buffer.feed(b"\x02\x00\xff\x00")
    assert next(frames) == b"\x02\x00"
    with pytest.raises(ProtocolError, match="255"):
        next(frames)


def test_a_long_frame_in_small_reads_is_looked_at_only_when_it_may_be_whole() -> None:
    looks = 0

    def counting(data: bytes, start: int) -> int:
        nonlocal looks
        looks += 1
        return frame_end(data, start)

    buffer = FrameBuffer(counting, 300)
    assert list(buffer.feed(b"\x01\xff")) == []
    for _ in range(254):
        assert list(buffer.feed(b"x")) == []
    assert len(next(buffer.feed(b"x"))) == 257
    assert looks == 2


@given(st.lists(st.binary(max_size=12), max_size=20))
def test_random_reads_give_frames_of_the_stream_or_a_protocol_error(reads: list[bytes]) -> None:
    buffer = FrameBuffer(frame_end, 40)
    stream, joined = b"".join(reads), b""
    try:
        for read in reads:
            for frame in buffer.feed(read):
                joined += frame
                assert len(frame) <= 40
            assert len(buffer) <= 40
    except ProtocolError:
        assert stream.startswith(joined)
    else:
        assert joined + stream[len(joined) :] == stream
        assert len(buffer) == len(stream) - len(joined)
