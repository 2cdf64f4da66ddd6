"""Frames of MAVLink: the page's vectors, damage, and memory."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from gateways.mavlink.frames import LIMIT_BYTES, MavlinkFrame, checksum, frame_end, read_frame, write_frame
from gateways.mavlink.messages.control import CommandLong, ManualControl, SetPositionTargetLocalNed
from gateways.mavlink.messages.telemetry import Attitude, MavlinkHeartbeat, ObstacleDistance, Statustext
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire.frames import DatagramFrames, FrameBuffer

ROVER = bytes.fromhex("fd0900000001010000000f0000000a03c10403ac7c")
STICK = bytes.fromhex("fd0b000000ffbe450000000006fff401000000000146e7")
HOLD = bytes.fromhex("fd20000000ffbe4c00000000803f000080400000000000000000000000000000000000000000b00001010e93")
VECTORS = {
    ROVER: (MavlinkHeartbeat(15, 10, 3, 0xC1, 4, 3), 0, 1, 1),
    STICK: (ManualControl(y=-250, z=500, target=1), 0, 255, 190),
    HOLD: (CommandLong(param1=1.0, param2=4.0, command=176, target_system=1, target_component=1), 0, 255, 190),
}
HEARTBEAT_1 = bytes.fromhex("fe0907ff be 00 000000000608000403")
"""A heartbeat of version 1, without its checksum."""
UNKNOWN = bytes.fromhex("fd040000070101f11700") + b"\x01\xfd\xfe\x02" + b"\x12\x34"
"""A message that is not declared (6129), with both markers in its payload."""


def cut(data: bytes) -> list[bytes]:
    return list(FrameBuffer(frame_end, LIMIT_BYTES).feed(data))


def read(pieces: Iterator[bytes] | list[bytes]) -> tuple[list[MavlinkFrame], int]:
    """Read what a stream gives: the frames, and how many pieces were noise."""
    buffer, frames, noise = FrameBuffer(frame_end, LIMIT_BYTES), [], 0
    for piece in pieces:
        for frame in buffer.feed(piece):
            try:
                frames.append(read_frame(frame))
            except ProtocolError:
                noise += 1
    return frames, noise


def known(frames: list[MavlinkFrame]) -> list[int]:
    """Return the numbers of the frames whose messages are declared."""
    return [frame.seq for frame in frames if frame.message is not None]


def stream(count: int, seed: int = 1) -> list[bytes]:
    """Make frames of several messages, numbered from 0."""
    rng = random.Random(seed)
    kinds = (
        lambda: MavlinkHeartbeat(rng.getrandbits(32), 10, 3, 0x81, 4, 3),
        lambda: Attitude(rng.getrandbits(32), *(rng.uniform(-3, 3) for _ in range(6))),
        lambda: Statustext(4, rng.randbytes(50), rng.getrandbits(16), 1),
        lambda: ObstacleDistance(rng.getrandbits(63), rng.randbytes(144), 20, 4000, frame=12),
        lambda: SetPositionTargetLocalNed(vx=rng.uniform(-1, 1), yaw_rate=0.2, type_mask=0x5C7, coordinate_frame=8),
    )
    return [write_frame(kinds[number % len(kinds)](), number, 1, 1) for number in range(count)]


@pytest.mark.parametrize("frame", VECTORS, ids=["heartbeat", "stick", "hold"])
def test_the_frames_of_the_page_are_read_and_written(frame: bytes) -> None:
    message, seq, system, component = VECTORS[frame]
    assert cut(frame) == [frame]
    assert read_frame(frame) == MavlinkFrame(message.spec.id, message, system, component, seq)
    assert write_frame(message, seq, system, component) == frame


def test_a_signature_is_a_part_of_the_frame_and_other_flags_make_it_unreadable() -> None:
    signed = bytearray(STICK)
    signed[2] = 1
    crc = checksum(bytes(signed[1:-2]), ManualControl.spec.crc_extra)
    frame = bytes(signed[:-2]) + crc.to_bytes(2, "little") + bytes(13)
    assert cut(frame + ROVER) == [frame, ROVER]
    assert read_frame(frame).message == VECTORS[STICK][0]
    signed[2] = 2
    frames, noise = read([bytes(signed) + ROVER])
    assert (frames[0].message, noise > 0) == (VECTORS[ROVER][0], True)


def test_frames_of_version_1_are_read() -> None:
    frame = HEARTBEAT_1 + checksum(HEARTBEAT_1[1:], MavlinkHeartbeat.spec.crc_extra).to_bytes(2, "little")
    assert cut(frame + ROVER) == [frame, ROVER]
    assert read_frame(frame) == MavlinkFrame(0, MavlinkHeartbeat(0, 6, 8, 0, 4, 3), 255, 190, 7)


def test_a_stream_may_be_cut_anywhere() -> None:
    data = b"".join(stream(25)) + UNKNOWN + ROVER
    whole, _ = read([data])
    assert known(whole) == [*range(25), 0]
    for size in (1, 2, 3, 7, 64):
        assert read([data[at : at + size] for at in range(0, len(data), size)])[0] == whole


def test_a_message_that_is_not_declared_is_counted_and_costs_no_other() -> None:
    frames, noise = read([ROVER + UNKNOWN + STICK])
    assert [(frame.message_id, frame.message is None) for frame in frames] == [(0, False), (6129, True), (69, False)]
    assert noise == 0


def test_one_wrong_byte_costs_no_frame_but_its_own() -> None:
    frames = stream(6)
    data = b"".join(frames)
    ends = [len(b"".join(frames[: number + 1])) for number in range(6)]
    for at in range(len(data)):
        hit = next(number for number, end in enumerate(ends) if at < end)
        for flip in (0x01, 0x80, 0xFF, data[at] ^ 0xFD, data[at] ^ 0xFE):
            if flip:
                damaged = data[:at] + bytes((data[at] ^ flip,)) + data[at + 1 :]
                found = known(read([damaged + data])[0])
                assert found == [*(number for number in range(6) if number != hit), *range(6)], (at, flip)


NOISE = (b"\xfd", b"\xfe", b"\0", b"\xfd\x09\0\0", b"\xfe\x09\0\x01\x01\0", b"\xfd\xff\x01\0\0\x01\x01\x1e\0\0")


def test_noise_between_frames_costs_none_of_them_however_the_stream_is_cut() -> None:
    rng = random.Random(3)
    for _ in range(150):
        frames = stream(12, rng.randrange(1000))
        noises = (
            b"".join(rng.choices(NOISE, k=rng.randrange(4))) + rng.randbytes(rng.choice((0, 9, 40))) for _ in frames
        )
        data = b"".join(noise + frame for noise, frame in zip(noises, frames, strict=True)) + bytes(LIMIT_BYTES)
        size = rng.choice((1, 5, 30, 333, 4096))
        assert known(read([data[at : at + size] for at in range(0, len(data), size)])[0]) == [*range(12)]


def test_a_wrong_length_delays_nothing_beyond_the_next_whole_frame() -> None:
    damaged = bytearray(ROVER)
    damaged[1] = 255
    buffer = FrameBuffer(frame_end, LIMIT_BYTES)
    frames = [*buffer.feed(bytes(damaged)), *buffer.feed(STICK)]
    assert frames[-1] == STICK


def test_bytes_that_are_no_frames_end_nothing_and_are_cut_in_bounded_pieces() -> None:
    rng = random.Random(7)
    for noise in (bytes(5000), b"\xfd" * 5000, b"\xfe" * 5000, rng.randbytes(20_000), b"\xfd\xfe" * 2000):
        pieces = [noise[at : at + 333] for at in range(0, len(noise), 333)]
        frames, _ = read([*pieces, ROVER * 16])
        assert [frame.message for frame in frames].count(VECTORS[ROVER][0]) >= 15


def test_memory_stays_bounded_while_every_read_ends_inside_a_frame() -> None:
    buffer, data = FrameBuffer(frame_end, LIMIT_BYTES), b"".join(stream(500))
    count = 0
    for at in range(0, len(data), 7):
        count += len(list(buffer.feed(data[at : at + 7])))
        assert len(buffer) <= LIMIT_BYTES
    assert count == 500


@pytest.mark.parametrize("frame", [b"", b"\xfd", ROVER[:-1], ROVER + b"\0", b"\x00" * 12, ROVER[:-1] + b"\0"])
def test_what_is_no_frame_is_refused(frame: bytes) -> None:
    with pytest.raises(ProtocolError):
        read_frame(frame)


@pytest.mark.parametrize(
    ("message", "system"),
    [
        (MavlinkHeartbeat(kind=256), 1),
        (MavlinkHeartbeat(custom_mode=-1), 1),
        (Statustext(text=bytes(51)), 1),
        (MavlinkHeartbeat(), 256),
    ],
)
def test_values_that_have_no_room_are_refused(message: MavlinkHeartbeat | Statustext, system: int) -> None:
    with pytest.raises(EncodeError):
        write_frame(message, 0, system, 1)


HIDDEN = bytes.fromhex("fd080000070101f11700") + b"\xfe\xff\0\0\0\0\0\1" + b"\x12\x34"
"""A message that is not declared. In its payload -2, an int16, and zeros: they look like a heartbeat of 255 bytes."""


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_a_stop_does_not_wait_behind_a_message_that_is_not_known(size: int) -> None:
    buffer, seen = FrameBuffer(frame_end, LIMIT_BYTES), []
    data = HIDDEN + HOLD
    for start in range(0, len(data), size):
        seen += buffer.feed(data[start : start + size])
    assert seen == [HIDDEN, HOLD]


@pytest.mark.parametrize("unknown", [HIDDEN, UNKNOWN, UNKNOWN[:-1] + b"\xfd", UNKNOWN[:-1] + b"\xfe"])
def test_nothing_waits_at_the_end_of_a_datagram(unknown: bytes) -> None:
    dropped: list[str] = []
    frames = DatagramFrames(frame_end, LIMIT_BYTES, dropped.append)
    for datagram in (HOLD + unknown, unknown + HOLD, unknown + HOLD[:-1], HOLD):
        pieces = list(frames.feed(datagram))
        assert unknown in (*pieces, unknown if datagram == HOLD else b"")
        assert (HOLD in pieces) is (HOLD in datagram)
    assert len(dropped) == 1
