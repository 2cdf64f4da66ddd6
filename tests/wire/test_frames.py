"""Frames out of a stream in any cut, in bounded memory."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError
from zbridge.wire.frames import FrameBuffer, FramingFault

LIMIT = 50


def frame_end(data: bytes, start: int) -> int:
    """A header of two bytes, the second the length of the body; a first byte of 255 is impossible."""
    if data[start] == 255:
        raise ProtocolError("255")
    if len(data) - start < 2:
        return start + 2
    return start + 2 + data[start + 1]


def cut_at_once(stream: bytes) -> tuple[list[bytes], bool, int]:
    """The frames of a whole stream, whether it is broken behind them, and how many bytes are left."""
    frames = []
    while len(stream) > 1 and stream[0] != 255 and stream[1] + 2 <= min(LIMIT, len(stream)):
        frames.append(stream[: stream[1] + 2])
        stream = stream[stream[1] + 2 :]
    broken = stream[:1] == b"\xff" or (len(stream) > 1 and stream[1] + 2 > LIMIT)
    return frames, broken, len(stream)


READS = st.one_of(st.sampled_from([b"", b"\x01\x03abc", b"\x02\x00\x03\x01z", b"\x04"]), st.binary(max_size=12))


@given(st.lists(READS, max_size=20))
def test_reads_in_any_cut_give_the_frames_of_the_stream_each_with_its_last_byte(reads: list[bytes]) -> None:
    buffer, frames = FrameBuffer(frame_end, LIMIT), []
    for count, read in enumerate(reads, 1):
        expected, broken, rest = cut_at_once(b"".join(reads[:count]))
        if broken:
            with pytest.raises(ProtocolError):
                frames += buffer.feed(read)
            return
        frames += buffer.feed(read)
        assert frames == expected
        assert all(type(frame) is bytes for frame in frames)
        assert len(buffer) == rest <= LIMIT


def test_frames_before_a_broken_one_are_yielded_first() -> None:
    frames = FrameBuffer(frame_end, LIMIT).feed(b"\x02\x00\xff\x00")
    assert next(frames) == b"\x02\x00"
    with pytest.raises(ProtocolError, match="255"):
        next(frames)


def test_a_frame_of_the_limit_passes_and_a_longer_one_is_refused_by_its_header_alone() -> None:
    buffer = FrameBuffer(frame_end, LIMIT)
    assert len(next(buffer.feed(b"\x01\x30" + bytes(48)))) == 50
    assert list(buffer.feed(b"\x01")) == []
    with pytest.raises(ProtocolError, match="frame of 51 bytes exceeds 50"):
        list(buffer.feed(b"\x31"))


def test_a_long_frame_in_small_reads_is_looked_at_only_when_it_may_be_whole() -> None:
    looks = 0

    def counting(data: bytes, start: int) -> int:
        nonlocal looks
        looks += 1
        return frame_end(data, start)

    buffer = FrameBuffer(counting, 300)
    for byte in b"\x01\xff" + 254 * b"x":
        assert list(buffer.feed(bytes([byte]))) == []
    assert len(next(buffer.feed(b"x"))) == 257
    assert looks == 3


@pytest.mark.parametrize("read", [b"\x01", b"\x01\x02ab"])
@pytest.mark.parametrize("end", [0, -1])
@pytest.mark.parametrize("first", [b"", b"\x07"])
def test_a_framing_function_that_does_not_advance_is_an_error_with_its_name(
    first: bytes, read: bytes, end: int
) -> None:
    def stuck(data: bytes, start: int) -> int:
        return start + (2 if data == b"\x07" else end)

    buffer = FrameBuffer(stuck, LIMIT)
    assert list(buffer.feed(first)) == []
    with pytest.raises(FramingFault, match=rf"tests\.wire\.test_frames\..*stuck returned a frame of {end} bytes"):
        list(buffer.feed(read))
