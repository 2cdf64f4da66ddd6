"""Packets out of a damaged stream: only what was damaged is lost, in any cut, in bounded memory."""

from __future__ import annotations

import random
import zlib

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer, Packets

MOST = 40


def crc(data: bytes) -> bytes:
    return zlib.crc32(data).to_bytes(4, "big")


PACKETS = Packets(b"\xfa\xfb", "B", uncounted=3, checksum=crc, most=MOST)
BODIES = st.one_of(st.binary(max_size=30), st.just(b"\xfa\xfb\x05\xfa\xfb"), st.just(PACKETS.packet(b"nested")))


def bodies(reads: list[bytes]) -> list[bytes]:
    buffer, found = FrameBuffer(PACKETS.end, MOST), []
    for read in reads:
        for frame in buffer.feed(read):
            try:
                found.append(PACKETS.body(frame))
            except ProtocolError:
                continue
        assert len(buffer) <= MOST
    return found


def cut(stream: bytes, seed: int) -> list[bytes]:
    rng, reads = random.Random(seed), []
    while stream:
        size = rng.randint(1, 25)
        reads.append(stream[:size])
        stream = stream[size:]
    return reads


def test_a_packet_of_the_arcos_manual() -> None:
    """ENABLE 1: the checksum adds words of two bytes, the first the higher one."""

    def arcos(data: bytes) -> bytes:
        body = data[3:]
        words = sum(body[at] << 8 | body[at + 1] for at in range(0, len(body) - 1, 2))
        return ((words & 0xFFFF) ^ (body[-1] if len(body) % 2 else 0)).to_bytes(2, "big")

    packets = Packets(b"\xfa\xfb", "B", uncounted=3, checksum=arcos, most=208)
    assert packets.packet(b"\x04\x3b\x01\x00") == bytes.fromhex("fafb06043b0100053b")
    assert packets.body(bytes.fromhex("fafb03010001")) == b"\x01"


def test_a_count_of_two_bytes_in_either_order_and_a_sum_over_everything() -> None:
    little = Packets(b"\xb5b", "<H", uncounted=5, checksum=lambda data: bytes([sum(data) & 255]), most=300)
    assert little.packet(bytes(256))[2:4] == b"\x00\x01"
    big = Packets(b"\x13", ">H", uncounted=4, checksum=lambda data: bytes([-sum(data) & 255]), most=300)
    assert big.packet(b"ab") == b"\x13\x00\x02ab" + bytes([-(0x13 + 2 + 97 + 98) & 255])


@given(st.lists(BODIES, max_size=12), st.integers(0, 99))
def test_an_undamaged_stream_gives_every_packet_in_any_cut(sent: list[bytes], seed: int) -> None:
    assert bodies(cut(b"".join(map(PACKETS.packet, sent)), seed)) == sent


@given(
    st.lists(BODIES, min_size=1, max_size=8),
    st.integers(0, 10**6),
    st.sampled_from(["changed", "cut short", "lengthened", "left out"]),
    st.binary(max_size=100),
)
def test_only_the_damaged_packet_is_lost(sent: list[bytes], seed: int, damage: str, noise: bytes) -> None:
    rng = random.Random(seed)
    hit = rng.randrange(len(sent))
    damaged = PACKETS.packet(sent[hit])
    place = rng.randrange(1, len(damaged))
    damaged = {
        "changed": damaged[:place] + bytes([damaged[place] ^ rng.randint(1, 255)]) + damaged[place + 1 :],
        "cut short": damaged[:place],
        "lengthened": damaged[:place] + b"\xfa\xfb\xff" + damaged[place:],
        "left out": b"",
    }[damage]
    assume(PACKETS.packet(sent[hit]) not in damaged + noise)  # else the noise has mended it
    tail = [b"the tail"] * 8  # as many bytes as a wrong count can claim
    frames = [PACKETS.packet(body) for body in (*sent[:hit], *sent[hit + 1 :], *tail)]
    stream = b"".join((*frames[:hit], damaged, noise, *frames[hit:]))
    expected = [*sent[:hit], *sent[hit + 1 :], *tail]
    found = bodies(cut(stream, seed))
    inside = PACKETS.packet(b"nested") in damaged  # what was a body is a packet once its own packet is broken
    assert [body for body in found if body != b"nested" or not inside] == [
        body for body in expected if body != b"nested" or not inside
    ]


@given(st.binary(max_size=300), st.integers(0, 99))
def test_noise_alone_gives_nothing_raises_nothing_and_fits_the_limit(noise: bytes, seed: int) -> None:
    assert bodies(cut(noise, seed)) == []


def test_a_head_that_comes_in_parts_is_not_taken_for_noise() -> None:
    packets = Packets(b"\xaa\xbb\xcc", "B", uncounted=5, checksum=lambda data: b"!", most=20)
    buffer = FrameBuffer(packets.end, 20)
    whole = packets.packet(b"xyz")
    assert [frame for byte in b"\xaa\xaa\xbb" + whole for frame in buffer.feed(bytes([byte]))][-1] == whole


def test_what_is_no_packet_is_named_with_its_bytes() -> None:
    with pytest.raises(ProtocolError, match="no packet: 00 01"):
        PACKETS.body(b"\x00\x01")
    whole = PACKETS.packet(b"abc")
    with pytest.raises(ProtocolError, match=f"checksum 00000000, expected {whole[-4:].hex()}: fa fb"):
        PACKETS.body(whole[:-4] + bytes(4))
    with pytest.raises(EncodeError, match="a packet of 41 bytes, expected 40 at most"):
        PACKETS.packet(bytes(34))
    with pytest.raises(EncodeError, match="a packet of 307 bytes"):
        Packets(b"\xfa\xfb", "B", uncounted=3, checksum=crc, most=1000).packet(bytes(300))
    with pytest.raises(ValueError, match="expected a byte or more, and 7 or more"):
        Packets(b"\xfa\xfb", "B", uncounted=3, checksum=crc, most=6)


def test_a_damaged_packet_is_made_whole_for_fuzzing() -> None:
    whole = PACKETS.packet(b"abc")
    assert PACKETS.body(PACKETS.seal(whole[:4] + b"X" + whole[5:])) == b"aXc"


def test_packets_without_a_checksum_are_read_too() -> None:
    packets = Packets(b"\xaa", "B", uncounted=2, checksum=lambda data: b"", most=20)
    assert packets.body(packets.packet(b"abc")) == b"abc"
    assert packets.end(packets.packet(b"abc"), 0) == 5
