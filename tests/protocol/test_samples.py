"""Frames of links that are Zenoh sessions: written by hand, cut anywhere, broken."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.protocol.samples import (
    KeyedSample,
    SampleKind,
    dropped,
    read_sample,
    sample_end,
    subscription,
    write_sample,
)
from zbridge.wire.frames import FrameBuffer

SAMPLES = st.builds(
    KeyedSample,
    st.sampled_from(SampleKind),
    st.text(max_size=20),
    st.binary(max_size=50),
    st.none() | st.binary(max_size=40),
    st.integers(-(2**63), 2**63 - 1),
)


def test_a_frame_has_its_size_kind_sizes_time_key_attachment_and_payload() -> None:
    sample = KeyedSample(SampleKind.SAMPLE, "k", b"pay", b"at", 1)
    by_hand = "17000000 11 0100 0200 0100000000000000 6b 6174 706179"
    assert write_sample(sample) == bytes.fromhex(by_hand)
    assert read_sample(bytes.fromhex(by_hand)) == sample
    no_attachment = bytes.fromhex("14000000 02 0300 ffff 0000000000000000 612f62")
    assert read_sample(no_attachment) == KeyedSample(SampleKind.WATCH, "a/b")


@given(st.lists(SAMPLES, max_size=5), st.integers(1, 40))
def test_frames_are_read_as_they_were_written_however_they_are_cut(samples: list[KeyedSample], size: int) -> None:
    data, buffer = b"".join(map(write_sample, samples)), FrameBuffer(sample_end, 65536)
    frames = [frame for start in range(0, len(data), size) for frame in buffer.feed(data[start : start + size])]
    assert list(map(read_sample, frames)) == samples


@given(st.binary(max_size=60))
def test_random_bytes_are_a_sample_or_a_protocol_error(data: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        assert write_sample(read_sample(data)) == data


def test_what_is_too_long_is_not_written() -> None:
    for sample in (
        KeyedSample(SampleKind.PUT, "k" * 70_000),
        KeyedSample(SampleKind.PUT, "k", attachment=bytes(65535)),
    ):
        with pytest.raises(EncodeError, match="bytes"):
            write_sample(sample)


def test_subscriptions_and_counts() -> None:
    assert (subscription("k").payload, subscription("k", kept=True).payload) == (b"", b"kept")
    assert read_sample(write_sample(dropped(7))).count == 7


def test_a_number_of_dropped_samples_that_is_none_is_a_protocol_error() -> None:
    with pytest.raises(ProtocolError, match="DROPPED of 3 bytes"):
        assert read_sample(write_sample(KeyedSample(SampleKind.DROPPED, payload=b"\1\0\0"))).count
