"""Packets of the TCP/UDP package protocol against its page and the recorded sessions.

Every expected byte is written out by hand from the protocol page or read off a capture, never computed by the code
under test.
"""

import itertools
import math
import random
import struct
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from gateways.tcpudp.messages import (
    MAX_FRAME,
    PACKETS,
    ChatMessage,
    ClientControllMode,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientMoveAI,
    ClientSettings,
    ClientSimulatedLidarData,
    ClientUDPConnectionStatus,
    DebugMessage,
    OpaquePacket,
    ServerPosition,
    ServerSettings,
    ServerSLAMMap,
    ServerUDPConnection,
    decode_packet,
    encode_packet,
    frame_end,
)
from tests import captures
from tests.gateways.tcpudp.golden import GOLDEN, TABLE, TCP_SESSION_MESSAGES, UDP_SESSION_MESSAGES, server_settings
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer

HEADER = 6


UDP_SESSION = "tcpudp-1.3-udp.hex"
TCP_SESSION = "tcpudp-1.1-tcp.hex"
BYTES_AFTER_SETTINGS_ARE_KEPT = (ServerSettings, ClientSettings)
BODY_IS_OPAQUE = (ClientMoveAI, ChatMessage, OpaquePacket)


def unhex(text: str) -> bytes:
    return bytes.fromhex(text)


def packet(body: bytes, packet_id: int, sender_id: int = 1) -> bytes:
    """A packet with a true length field, built by the page's framing rule and not by the code under test."""
    return struct.pack("<iBB", 2 + len(body), sender_id, packet_id) + body


def assert_same(got: Any, expected: Any) -> None:
    """Equal messages; arrays by value and type."""
    assert type(got) is type(expected)
    if isinstance(expected, ClientSimulatedLidarData):
        assert got.ranges.dtype == np.float32
        np.testing.assert_array_equal(got.ranges, expected.ranges)
    else:
        assert got == expected


def cut(data: bytes, sizes: list[int]) -> list[bytes]:
    """``data`` cut by hand-counted sizes; the whole of it."""
    assert sum(sizes) == len(data)
    ends = np.cumsum(sizes).tolist()
    return [data[end - size : end] for end, size in zip(ends, sizes, strict=True)]


def feed(buffer: FrameBuffer, *chunks: bytes) -> list[bytes]:
    return [bytes(frame) for chunk in chunks for frame in buffer.feed(chunk)]


def golden_id(value: Any) -> str | None:
    return None if isinstance(value, int | str) else type(value).__name__


golden = pytest.mark.parametrize(("message", "sender_id", "text"), GOLDEN, ids=golden_id)


# --- golden bytes


def test_golden_bytes_cover_every_row_of_the_table() -> None:
    assert {unhex(text)[5] for _, _, text in GOLDEN} | {56} == set(TABLE)


# --- recorded sessions


def recorded() -> Iterator[Any]:
    for name, messages in ((UDP_SESSION, UDP_SESSION_MESSAGES), (TCP_SESSION, TCP_SESSION_MESSAGES)):
        packets = captures.payloads(name)
        for number, (record, message) in enumerate(zip(packets, messages, strict=True)):
            yield pytest.param(record.payload, message, id=f"{name}-{number}-{type(message).__name__}")


@pytest.mark.parametrize(("payload", "message"), list(recorded()))
def test_recorded_packet_decodes_to_its_message_and_back_to_its_bytes(payload: bytes, message: Any) -> None:
    decoded = decode_packet(payload)
    assert_same(decoded, message)
    if payload == unhex("02000000 01 35"):  # robots leave the int out, the gateway never does
        payload = unhex("06000000 01 35 00000000")
    assert bytes(encode_packet(decoded, payload[4])) == payload
    assert bytes(encode_packet(message, payload[4])) == payload


# --- framing


def test_frame_ends_four_bytes_and_the_length_after_its_start() -> None:
    data = unhex("ffff 06000000 02 0c 000040bf 02000000 02 0d")
    assert frame_end(data, 2) == 12
    assert frame_end(data, 12) == 18
    assert frame_end(unhex("03020100 02 0d"), 0) == 0x00010203 + 4


@pytest.mark.parametrize("have", range(18))
def test_frame_end_lies_behind_the_data_while_bytes_are_missing(have: int) -> None:
    data = unhex("0e000000 02 0b 0000003f 000080be 00000040")
    for before in (b"", b"\xff\xff\xff\xff"):
        end = frame_end(before + data[:have], len(before))
        assert len(before) + have < end <= len(before) + 18


@pytest.mark.parametrize("text", ["00000000", "01000000", "ffffffff", "feffffff", "00000080", "0000ff80", "020000ff"])
def test_length_below_two_is_refused_with_its_header(text: str) -> None:
    with pytest.raises(ProtocolError):
        frame_end(unhex(text + "02 0d"), 0)
    with pytest.raises(ProtocolError):
        frame_end(unhex("02000000 01 04" + text + "02 0d"), 6)
    with pytest.raises(ProtocolError):
        feed(FrameBuffer(frame_end, MAX_FRAME), unhex(text + "02 0d"))


@pytest.mark.parametrize("text", ["ffffff7f", "00000040", "fbffff7f"])
def test_huge_length_is_refused_without_waiting_for_its_bytes(text: str) -> None:
    buffer = FrameBuffer(frame_end, MAX_FRAME)
    with pytest.raises(ProtocolError):
        feed(buffer, unhex(text) + unhex("01 01"))
    assert len(buffer) <= MAX_FRAME


def test_frame_as_large_as_the_limit_passes_and_one_byte_more_is_refused() -> None:
    fits = packet(bytes(58), 40)
    too_large = packet(bytes(59), 40)
    assert len(fits) == 64
    assert feed(FrameBuffer(frame_end, 64), fits) == [fits]
    assert feed(FrameBuffer(frame_end, 64), *(bytes([value]) for value in fits)) == [fits]
    with pytest.raises(ProtocolError):
        feed(FrameBuffer(frame_end, 64), too_large)
    with pytest.raises(ProtocolError):
        feed(FrameBuffer(frame_end, 64), too_large[:6])


def test_map_of_the_side_a_1_3_robot_announces_fits_a_frame() -> None:
    cells = bytes(2048 * 2048)
    frame = unhex("06004000 01 35 00004000") + cells
    assert feed(FrameBuffer(frame_end, MAX_FRAME), frame) == [frame]


# --- one datagram, one packet


def test_two_packets_in_one_datagram_are_refused() -> None:
    with pytest.raises(ProtocolError):
        decode_packet(unhex("02000000 02 0d 02000000 02 0d"))


# --- bodies too short, too long, lying


@golden
def test_shortened_body_is_refused_or_shortens_the_settings_block(message: Any, sender_id: int, text: str) -> None:
    body, packet_id = unhex(text)[HEADER:], unhex(text)[5]
    for size in range(len(body)):
        short = packet(body[:size], packet_id, sender_id)
        if isinstance(message, ServerSLAMMap) and size == 0:
            assert decode_packet(short) == ServerSLAMMap()
            continue
        if isinstance(message, BODY_IS_OPAQUE):
            assert encode_packet(decode_packet(short), sender_id) == short
            continue
        if isinstance(message, BYTES_AFTER_SETTINGS_ARE_KEPT):
            behind_versions = body.index(message.versions.encode()) + len(message.versions)
            if size >= behind_versions:
                assert encode_packet(decode_packet(short), sender_id) == short
                continue
        with pytest.raises(ProtocolError):
            decode_packet(short)


@golden
def test_byte_too_many_is_refused_unless_it_follows_settings(message: Any, sender_id: int, text: str) -> None:
    frame = unhex(text)
    for extra in (b"\x00", b"\x01", b"\xff\x00"):
        longer = packet(frame[HEADER:] + extra, frame[5], sender_id)
        if isinstance(message, BODY_IS_OPAQUE + BYTES_AFTER_SETTINGS_ARE_KEPT):
            decoded = decode_packet(longer)
            assert type(decoded) is type(message)
            if not isinstance(message, BYTES_AFTER_SETTINGS_ARE_KEPT):
                assert encode_packet(decoded, sender_id) == longer
        else:
            with pytest.raises(ProtocolError):
                decode_packet(longer)


@pytest.mark.parametrize("count", [-(2**31), -1, 1, 3, 4, 2**31 - 1])
def test_string_count_that_is_not_its_length_is_refused(count: int) -> None:
    lie = struct.pack("<i", count)
    with pytest.raises(ProtocolError):
        decode_packet(packet(lie + b"hi", 1))


@pytest.mark.parametrize("count", [-(2**31), -1, 9, 2**31 - 1])
def test_versions_count_that_overruns_the_settings_is_refused(count: int) -> None:
    body = struct.pack("<i", count) + b"1.1" + bytes(5)
    with pytest.raises(ProtocolError):
        decode_packet(packet(b"\x02" + body, 2))
    with pytest.raises(ProtocolError):
        decode_packet(packet(body, 3))


@pytest.mark.parametrize("count", [-(2**31), -1, 0, 4, 6, 2**30, 2**31 - 1])
def test_map_whose_count_is_not_its_cells_is_refused(count: int) -> None:
    with pytest.raises(ProtocolError):
        decode_packet(packet(struct.pack("<i", count) + bytes(5), 53))


@pytest.mark.parametrize("count", [-(2**31), -1, 0, 1, 3, 2**30, 2**30 + 2, 2**31 - 1])
def test_lidar_whose_count_is_not_its_ranges_is_refused(count: int) -> None:
    with pytest.raises(ProtocolError):
        decode_packet(packet(struct.pack("<i", count) + bytes(8), 61))


@pytest.mark.parametrize(
    ("text", "start", "cells"),
    [
        ("0d000000 01 38 03000000 06000000 000102", 3, b"\x00\x01\x02"),
        ("0a000000 01 38 02010000 02010000", 258, b""),
        ("0c000000 01 38 fdffff7f ffffff7f 0102", 2**31 - 3, b"\x01\x02"),
    ],
)
def test_map_part_names_its_first_cell_and_the_cell_behind_its_last(text: str, start: int, cells: bytes) -> None:
    part: Any = decode_packet(unhex(text))
    assert type(part).__name__ == "ServerSLAMMapPart"
    assert (part.start, part.cells) == (start, cells)
    assert encode_packet(part, 1) == unhex(text)


@pytest.mark.parametrize(
    "text",
    [
        "00000000 02000000 000102",
        "00000000 04000000 000102",
        "03000000 00000000 000102",
        "05000000 05000000 000102",
        "fdffffff 00000000 000102",
        "00000080 ffffff7f 000102",
        "ffffff7f 02000080 000102",
        "03000000 060000",
        "",
    ],
)
def test_map_part_whose_range_is_not_its_cells_is_refused(text: str) -> None:
    with pytest.raises(ProtocolError):
        decode_packet(packet(unhex(text), 56))


def test_a_map_without_a_body_is_read_and_never_written() -> None:
    """Robots leave the int out where they have no map yet; HQ programs throw for good on that."""
    assert decode_packet(unhex("02000000 01 35")) == ServerSLAMMap()


def test_three_floats_under_the_id_of_the_map_are_a_position() -> None:
    assert decode_packet(unhex("0e000000 01 35 0000c03f 000010c0 0000b442")) == ServerPosition(1.5, -2.25, 90.0)


def test_map_of_eight_cells_is_no_position() -> None:
    frame = unhex("0e000000 01 35 08000000 0001020001020001")
    assert decode_packet(frame) == ServerSLAMMap(b"\x00\x01\x02\x00\x01\x02\x00\x01")


@pytest.mark.parametrize(
    "frame",
    ["0f000000 01 01 09000000 01 01 03000000 627965", "15000000 01 01 0f000000 01 01 09000000 01 01 03000000 627965"],
    ids=["doubled", "tripled"],
)
def test_more_headers_before_a_broadcast_text_do_not_confuse_the_parser(frame: str) -> None:
    many = unhex(frame)
    position = unhex("0e000000 01 37 0000803f 000000c0 00003443")
    buffer = FrameBuffer(frame_end, MAX_FRAME)
    frames = feed(buffer, many + position)
    assert frames == [many, position]
    assert decode_packet(frames[0]) == DebugMessage("bye")
    assert decode_packet(frames[1]) == ServerPosition(1.0, -2.0, 180.0)


def test_second_header_before_an_empty_text_is_taken_off_too() -> None:
    assert decode_packet(unhex("0c000000 01 01 06000000 01 01 00000000")) == DebugMessage("")


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ("0c000000 01 01 06000000 0102 61626364", "\x01\x02abcd"),
        ("0c000000 01 01 06000000 0201 61626364", "\x02\x01abcd"),
        ("0c000000 01 01 06000000 0501 00000000", "\x05\x01\x00\x00\x00\x00"),
        # the first bytes of a header, but what follows is no counted text
        ("0c000000 01 01 06000000 0101 61626364", "\x01\x01abcd"),
        ("0d000000 01 01 07000000 0101 00000000 61", "\x01\x01\x00\x00\x00\x00a"),
        ("08000000 01 01 02000000 0101", "\x01\x01"),
        ("0b000000 01 01 05000000 0101 000000", "\x01\x01\x00\x00\x00"),
    ],
)
def test_text_that_merely_looks_like_a_second_header_is_kept(frame: str, text: str) -> None:
    assert decode_packet(unhex(frame)) == DebugMessage(text)


@pytest.mark.parametrize(
    "frame",
    ["0f000000 01 01 09000000 01 01 04000000 627965", "0f000000 01 01 08000000 01 01 03000000 627965"],
    ids=["the inner count lies", "the inner length lies"],
)
def test_doubled_header_around_a_lie_gives_no_other_packet(frame: str) -> None:
    try:
        read = decode_packet(unhex(frame))
    except ProtocolError:
        return
    assert read == DebugMessage("\x01\x01" + "\x04\x00\x00\x00bye")


# --- values


def test_floats_may_be_infinite_or_no_number() -> None:
    position = decode_packet(unhex("0e000000 01 37 0000c07f 0000807f 000080ff"))
    assert type(position) is ServerPosition
    assert math.isnan(position.x)
    assert position.y == math.inf
    assert position.heading_deg == -math.inf
    move = decode_packet(unhex("0e000000 02 0b 0000807f 000080ff 0000c07f"))
    assert type(move) is ClientJoystickMove
    assert (move.x, move.y) == (math.inf, -math.inf)
    assert math.isnan(move.speed)
    rotate = decode_packet(unhex("06000000 02 0c 0000c0ff"))
    assert math.isnan(rotate.speed)
    ranges = decode_packet(unhex("12000000 02 3d 03000000 0000c07f 0000807f 000080ff")).ranges
    np.testing.assert_array_equal(ranges, np.array([np.nan, np.inf, -np.inf], dtype=np.float32))
    assert encode_packet(position, 1) == unhex("0e000000 01 37 0000c07f 0000807f 000080ff")


def test_bytes_beyond_ascii_are_read_as_escapes() -> None:
    assert decode_packet(unhex("0b000000 01 01 05000000 68 fc 00 7f ff")) == DebugMessage("h\\xfc\x00\x7f\\xff")
    assert decode_packet(unhex("08000000 01 01 02000000 c3bc")) == DebugMessage("\\xc3\\xbc")
    versions = decode_packet(unhex("0d000000 02 03 02000000 e9 31 0000000000"))
    assert versions.versions == "\\xe91"


@pytest.mark.parametrize("value", [0x01, 0x02, 0x80, 0xFF])
def test_any_byte_but_zero_is_true(value: int) -> None:
    assert decode_packet(packet(bytes([value]), 6)) == ServerUDPConnection(True)
    assert decode_packet(packet(bytes([value]), 7)) == ClientUDPConnectionStatus(True)
    received = decode_packet(packet(bytes([value]), 6))
    assert received.received is True
    assert encode_packet(received, 1) == unhex("03000000 01 06 01")


def test_id_byte_of_the_header_may_be_anything() -> None:
    for sender_id in range(256):
        frame = struct.pack("<iBB", 2, sender_id, 13)
        assert decode_packet(frame) == ClientJoystickStop()
        assert encode_packet(ClientJoystickStop(), sender_id) == frame


@pytest.mark.parametrize(
    "message",
    [
        server_settings(256, "1.1", True, True, True, True, True),
        server_settings(-1, "1.1", True, True, True, True, True),
        ClientControllMode(2**31),
        ClientControllMode(-(2**31) - 1),
        ClientJoystickMove(1e39, 0.0, 0.0),
        ClientJoystickRotate(-1e300),
        DebugMessage("h\xfc"),
    ],
    ids=repr,
)
def test_value_that_does_not_fit_its_field_is_not_sent(message: Any) -> None:
    with pytest.raises(EncodeError):
        encode_packet(message, 1)


@pytest.mark.parametrize("sender_id", [-1, 256])
def test_sender_id_that_does_not_fit_a_byte_is_not_sent(sender_id: int) -> None:
    with pytest.raises(EncodeError):
        encode_packet(ClientJoystickStop(), sender_id)


# --- the table


def test_table_has_the_rows_of_the_page_and_no_other() -> None:
    assert set(PACKETS) == set(TABLE)
    assert len({spec.name for spec in PACKETS.values()}) == len(TABLE)


@pytest.mark.parametrize("packet_id", sorted(TABLE))
def test_row_names_its_sender_and_carrier_as_the_page_does(packet_id: int) -> None:
    spec = PACKETS[packet_id]
    assert spec.id == packet_id
    assert (spec.name, spec.sender, spec.carrier) == TABLE[packet_id]


@pytest.mark.parametrize("packet_id", sorted(set(range(256)) - set(TABLE)))
def test_packet_of_an_undefined_id_keeps_its_bytes(packet_id: int) -> None:
    for body in (b"", b"\x00", b"\xff\x01\x02\x03\x04"):
        frame = packet(body, packet_id, 3)
        decoded = decode_packet(frame)
        assert decoded == OpaquePacket(packet_id, body)
        assert encode_packet(decoded, 3) == frame


# Bodies that reach the inside of each decoder; the loop below also shortens, lengthens and bends them.
PLAUSIBLE = [(unhex(text)[5], unhex(text)[HEADER:]) for _, _, text in GOLDEN]
ANY_ID = [*TABLE, 0, 8, 14, 70, 79, 255]
EDGE_COUNTS = [struct.pack("<i", value) for value in (-(2**31), -1, 0, 1, 2, 8, 2**30, 2**31 - 1)]


def random_packet(rng: random.Random) -> bytes:
    """Bytes that look like a packet and may lie in id, length, count or body."""
    choice = rng.random()
    if choice < 0.15:
        return rng.randbytes(rng.randrange(40))
    if choice < 0.45:
        packet_id, body = rng.choice(ANY_ID), rng.randbytes(rng.randrange(24))
    else:
        packet_id, body = rng.choice(PLAUSIBLE)
    bend = rng.random()
    if bend < 0.15:
        body = rng.choice(EDGE_COUNTS) + body[4:]
    elif bend < 0.25:
        body = body[: rng.randrange(len(body) + 1)]
    elif bend < 0.35:
        body += rng.randbytes(rng.randrange(1, 5))
    elif bend < 0.45 and body:
        place = rng.randrange(len(body))
        body = body[:place] + rng.randbytes(1) + body[place + 1 :]
    length = struct.pack("<i", 2 + len(body)) if rng.random() < 0.95 else rng.choice(EDGE_COUNTS)
    return length + bytes([rng.randrange(256), packet_id]) + body


def random_buffer(rng: random.Random) -> bytes:
    """0 to 64 bytes: one or more such packets, the last one often cut."""
    data = b""
    while len(data) < 64 and (not data or rng.random() < 0.6):
        data += random_packet(rng)
    return data[:64]


def read_all(data: bytes, splits: list[int], limit: int) -> Iterator[Any]:
    """What a receiver makes of ``data`` read in pieces: messages and errors; the stream ends at a framing error."""
    buffer = FrameBuffer(frame_end, limit)
    edges = [0, *splits, len(data)]
    for start, end in itertools.pairwise(edges):
        try:
            for frame in buffer.feed(data[start:end]):
                try:
                    yield decode_packet(frame)
                except ProtocolError as error:
                    yield error
        except ProtocolError as error:
            assert len(buffer) <= limit
            yield error
            return
        assert len(buffer) <= limit


def test_hundred_thousand_random_buffers_give_messages_or_protocol_errors_only() -> None:
    rng = random.Random(20240611)
    seen: Counter[type] = Counter()
    for _ in range(100_000):
        data = random_buffer(rng)
        for result in read_all(data, [rng.randrange(len(data) + 1)], 48):
            seen[type(result)] += 1
    expected = {type(message) for message, _, _ in GOLDEN} | {OpaquePacket, ProtocolError}
    assert set(seen) >= expected
    assert all(issubclass(kind, ProtocolError) or kind in expected for kind in seen)
    assert min(seen[kind] for kind in expected) > 100
