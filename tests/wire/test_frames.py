"""Frames out of a stream in any cut, in bounded memory."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError
from zbridge.wire.frames import DatagramFrames, FrameBuffer, FramingFault, Partial

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


# A frame that somebody else resumes


def counted(data: bytes, start: int) -> int:
    """A header of four bytes, the length of the body; as the packets of the TCP/UDP protocol page."""
    if len(data) - start < 4:
        return start + 4
    return start + 4 + int.from_bytes(data[start : start + 4], "little")


def text(data: bytes, start: int) -> int:
    """Up to the next semicolon, as the text messages of the ALF protocol page."""
    found = data.find(b";", start)
    return found + 1 if found >= 0 else len(data) + 1


LARGE = (10_000).to_bytes(4, "little") + bytes(10_000)
SMALL = (2).to_bytes(4, "little") + b"ab"


@pytest.mark.parametrize("cut", [0, 1, 3, 4, 64, 65, 66, 99, 100, 101, 5_000, 10_003, 10_004])
def test_a_large_frame_is_resumed_by_the_bytes_to_skip_and_the_next_frame_is_whole(cut: int) -> None:
    stream = LARGE + SMALL
    before, after = FrameBuffer(counted, 20_000), FrameBuffer(counted, 20_000)
    heard = len(list(before.feed(stream[:cut])))
    partial = before.partial(most_bytes=100)
    assert partial is not None
    assert partial == (Partial(stream[:cut]) if cut <= 100 else Partial(skip=10_004 - cut))
    after.resume(partial)
    for byte in stream[cut:-1]:
        heard += len(list(after.feed(bytes([byte]))))
    assert list(after.feed(stream[-1:])) == [SMALL]
    assert heard == (cut <= 100 or cut == 10_004), "the large frame is lost where its beginning is"


def test_what_is_still_to_be_skipped_is_skipped_by_a_third_process() -> None:
    first, second, third = (FrameBuffer(counted, 20_000) for _ in range(3))
    assert list(first.feed(LARGE[:1_000])) == []
    second.resume(first.partial(100) or Partial())
    assert list(second.feed(LARGE[1_000:3_000])) == []
    assert second.partial(100) == Partial(skip=7_004)
    third.resume(second.partial(100) or Partial())
    assert list(third.feed(LARGE[3_000:] + SMALL)) == [SMALL]


def test_a_frame_whose_header_does_not_tell_its_end_is_kept_whole_or_not_at_all() -> None:
    buffer = FrameBuffer(text, 20_000)
    assert list(buffer.feed(b"1|" + 100 * b"10|")) == []
    assert buffer.partial(302) == Partial(b"1|" + 100 * b"10|")
    assert buffer.partial(301) is None
    assert buffer.partial() == Partial(b"1|" + 100 * b"10|")


@pytest.mark.parametrize("partial", [Partial(skip=-1), Partial(skip=51), Partial(b"\x01", 3), Partial(b"\x01\x00")])
def test_what_is_no_incomplete_frame_cannot_be_resumed(partial: Partial) -> None:
    with pytest.raises(ProtocolError):
        FrameBuffer(frame_end, LIMIT).resume(partial)


@given(st.lists(READS, max_size=20))
def test_each_datagram_gives_its_whole_frames_whatever_came_before(datagrams: list[bytes]) -> None:
    dropped: list[str] = []
    frames = DatagramFrames(frame_end, LIMIT, dropped.append)
    for datagram in datagrams:
        expected, broken, rest = cut_at_once(datagram)
        before = len(dropped)
        assert list(frames.feed(datagram)) == expected
        assert (len(dropped) - before, len(frames)) == (int(broken or rest > 0), 0)


def test_a_datagram_that_is_left_in_the_middle_leaves_nothing() -> None:
    frames = DatagramFrames(frame_end, LIMIT, lambda why: None)
    assert next(frames.feed(b"\x01\x00\x02\x00\x03")) == b"\x01\x00"
    assert list(frames.feed(b"\x04\x00")) == [b"\x04\x00"]
