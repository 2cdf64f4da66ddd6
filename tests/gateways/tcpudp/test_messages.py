"""Packets of the TCP/UDP package protocol against its page and the recorded sessions.

Every expected byte is written out by hand from the protocol page or read off a capture, never computed by the code
under test. What holds of every message of every protocol is in tests/conformance.
"""

import math
import struct
from typing import Any

import numpy as np
import pytest

from gateways.tcpudp.messages import (
    MAX_FRAME,
    PACKETS,
    ClientControllMode,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientSettings,
    ClientUDPConnectionStatus,
    DebugMessage,
    OpaquePacket,
    ServerPosition,
    ServerSettings,
    ServerSLAMMap,
    ServerSLAMMapPart,
    ServerUDPConnection,
    decode_packet,
    encode_packet,
    frame_end,
)
from tests.captures import payloads
from tests.conformance.side import plain
from tests.gateways.tcpudp.golden import GOLDEN, TABLE, TCP_SESSION_MESSAGES, UDP_SESSION_MESSAGES, server_settings
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer

HEADER = 6
RECORDED = [
    pytest.param(record.payload, message, id=f"{name}-{number}-{type(message).__name__}")
    for name, messages in (
        ("tcpudp-1.3-udp.hex", UDP_SESSION_MESSAGES),
        ("tcpudp-1.1-tcp.hex", TCP_SESSION_MESSAGES),
    )
    for number, (record, message) in enumerate(zip(payloads(name), messages, strict=True))
]


def unhex(text: str) -> bytes:
    return bytes.fromhex(text)


def packet(body: bytes, packet_id: int, sender_id: int = 1) -> bytes:
    """A packet with a true length field, built by the page's framing rule and not by the code under test."""
    return struct.pack("<iBB", 2 + len(body), sender_id, packet_id) + body


def feed(buffer: FrameBuffer, *chunks: bytes) -> list[bytes]:
    return [bytes(frame) for chunk in chunks for frame in buffer.feed(chunk)]


@pytest.mark.parametrize(("payload", "message"), RECORDED)
def test_recorded_packet_decodes_to_its_message_and_back_to_its_bytes(payload: bytes, message: Any) -> None:
    decoded = decode_packet(payload)
    assert plain(decoded) == plain(message)
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
    for before in ("", "02000000 01 04"):
        with pytest.raises(ProtocolError):
            frame_end(unhex(before + text + "02 0d"), len(unhex(before)))


@pytest.mark.parametrize("text", ["ffffff7f", "00000040", "fbffff7f"])
def test_huge_length_is_refused_without_waiting_for_its_bytes(text: str) -> None:
    buffer = FrameBuffer(frame_end, MAX_FRAME)
    with pytest.raises(ProtocolError):
        feed(buffer, unhex(text) + unhex("01 01"))
    assert len(buffer) <= MAX_FRAME


def test_map_of_the_side_a_1_3_robot_announces_fits_a_frame() -> None:
    frame = unhex("06004000 01 35 00004000") + bytes(2048 * 2048)
    assert feed(FrameBuffer(frame_end, MAX_FRAME), frame) == [frame]


def test_two_packets_in_one_datagram_are_refused() -> None:
    with pytest.raises(ProtocolError):
        decode_packet(unhex("02000000 02 0d 02000000 02 0d"))


# --- bodies too short, too long, lying

OPAQUE = {21, 40}
"""Packets whose body means nothing here."""


@pytest.mark.parametrize(("message", "sender_id", "text"), GOLDEN, ids=lambda value: type(value).__name__)
def test_body_of_another_length_is_refused_unless_it_is_opaque_or_follows_settings(message, sender_id, text) -> None:
    body, packet_id = unhex(text)[HEADER:], unhex(text)[5]
    for other in [body[:size] for size in range(len(body))] + [body + extra for extra in (b"\0", b"\1", b"\xff\0")]:
        frame = packet(other, packet_id, sender_id)
        settings = isinstance(message, ServerSettings | ClientSettings)
        if packet_id == 53 and other == b"":
            assert decode_packet(frame) == ServerSLAMMap()
        elif packet_id in OPAQUE:
            assert encode_packet(decode_packet(frame), sender_id) == frame
        elif settings and len(other) >= body.index(message.versions.encode()) + len(message.versions):
            decoded = decode_packet(frame)
            assert type(decoded) is type(message)
            if len(other) < len(body):
                assert encode_packet(decoded, sender_id) == frame
        else:
            with pytest.raises(ProtocolError):
                decode_packet(frame)


INT32 = (-(2**31), -1, 2**31 - 1)


@pytest.mark.parametrize(
    ("packet_id", "before", "counts", "after"),
    [
        pytest.param(1, b"", (*INT32, 1, 3, 4), b"hi", id="text"),
        pytest.param(2, b"\x02", (*INT32, 9), b"1.1" + bytes(5), id="versions of a robot"),
        pytest.param(3, b"", (*INT32, 9), b"1.1" + bytes(5), id="versions of an HQ"),
        pytest.param(53, b"", (*INT32, 0, 4, 6, 2**30), bytes(5), id="map"),
        pytest.param(61, b"", (*INT32, 0, 1, 3, 2**30, 2**30 + 2), bytes(8), id="simulated lidar data"),
    ],
)
def test_count_that_is_not_its_length_is_refused(packet_id, before, counts, after) -> None:
    for count in counts:
        with pytest.raises(ProtocolError):
            decode_packet(packet(before + struct.pack("<i", count) + after, packet_id))


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
    assert type(part) is ServerSLAMMapPart
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


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        # Robots leave the int of the map out where they have none yet; HQ programs throw for good on that.
        ("02000000 01 35", ServerSLAMMap()),
        ("0e000000 01 35 0000c03f 000010c0 0000b442", ServerPosition(1.5, -2.25, 90.0)),  # three floats
        ("0e000000 01 35 08000000 0001020001020001", ServerSLAMMap(b"\x00\x01\x02\x00\x01\x02\x00\x01")),
        # second and third headers before a broadcast text
        ("0f000000 01 01 09000000 01 01 03000000 627965", DebugMessage("bye")),
        ("15000000 01 01 0f000000 01 01 09000000 01 01 03000000 627965", DebugMessage("bye")),
        ("0c000000 01 01 06000000 01 01 00000000", DebugMessage("")),
        # what merely looks like a second header
        ("0c000000 01 01 06000000 0102 61626364", DebugMessage("\x01\x02abcd")),
        ("0c000000 01 01 06000000 0201 61626364", DebugMessage("\x02\x01abcd")),
        ("0c000000 01 01 06000000 0501 00000000", DebugMessage("\x05\x01\x00\x00\x00\x00")),
        # the first bytes of a header, but what follows is no counted text
        ("0c000000 01 01 06000000 0101 61626364", DebugMessage("\x01\x01abcd")),
        ("0d000000 01 01 07000000 0101 00000000 61", DebugMessage("\x01\x01\x00\x00\x00\x00a")),
        ("08000000 01 01 02000000 0101", DebugMessage("\x01\x01")),
        ("0b000000 01 01 05000000 0101 000000", DebugMessage("\x01\x01\x00\x00\x00")),
        ("0f000000 01 01 09000000 01 01 04000000 627965", DebugMessage("\x01\x01\x04\x00\x00\x00bye")),
        # bytes beyond ASCII are read as escapes
        ("0b000000 01 01 05000000 68 fc 00 7f ff", DebugMessage("h\\xfc\x00\x7f\\xff")),
        ("08000000 01 01 02000000 c3bc", DebugMessage("\\xc3\\xbc")),
        ("0d000000 02 03 02000000 e9 31 0000000000", ClientSettings("\\xe91", bytes(5))),
    ],
)
def test_odd_packets_of_deployed_programs_are_read(frame: str, message: Any) -> None:
    next_one = unhex("0e000000 01 37 0000803f 000000c0 00003443")
    frames = feed(FrameBuffer(frame_end, MAX_FRAME), unhex(frame) + next_one)
    assert frames == [unhex(frame), next_one]
    assert decode_packet(frames[0]) == message


def test_doubled_header_around_a_length_that_lies_is_refused() -> None:
    with pytest.raises(ProtocolError):
        decode_packet(unhex("0f000000 01 01 08000000 01 01 03000000 627965"))


# --- values


@pytest.mark.parametrize(
    ("frame", "values"),
    [
        ("0e000000 01 37 0000c07f 0000807f 000080ff", [math.nan, math.inf, -math.inf]),
        ("0e000000 02 0b 0000807f 000080ff 0000c07f", [math.inf, -math.inf, math.nan]),
        ("06000000 02 0c 0000c0ff", [math.nan]),
        ("12000000 02 3d 03000000 0000c07f 0000807f 000080ff", [math.nan, math.inf, -math.inf]),
    ],
)
def test_floats_may_be_infinite_or_no_number(frame: str, values: list[float]) -> None:
    message = decode_packet(unhex(frame))
    (_, *got) = plain(message)
    np.testing.assert_array_equal(np.array(got, np.float32).ravel(), np.array(values, np.float32))
    assert bytes(encode_packet(message, unhex(frame)[4])) == unhex(frame)


@pytest.mark.parametrize("value", [0x01, 0x02, 0x80, 0xFF])
def test_any_byte_but_zero_is_true(value: int) -> None:
    received = decode_packet(packet(bytes([value]), 6))
    assert received == ServerUDPConnection(True)
    assert received.received is True
    assert encode_packet(received, 1) == unhex("03000000 01 06 01")
    assert decode_packet(packet(bytes([value]), 7)) == ClientUDPConnectionStatus(True)


def test_id_byte_of_the_header_may_be_anything() -> None:
    for sender_id in range(256):
        frame = struct.pack("<iBB", 2, sender_id, 13)
        assert decode_packet(frame) == ClientJoystickStop()
        assert encode_packet(ClientJoystickStop(), sender_id) == frame


@pytest.mark.parametrize(
    ("message", "sender_id"),
    [
        (server_settings(256, "1.1", True, True, True, True, True), 1),
        (server_settings(-1, "1.1", True, True, True, True, True), 1),
        (ClientControllMode(2**31), 1),
        (ClientControllMode(-(2**31) - 1), 1),
        (ClientJoystickMove(1e39, 0.0, 0.0), 1),
        (ClientJoystickRotate(-1e300), 1),
        (DebugMessage("h\xfc"), 1),
        (ClientJoystickStop(), -1),
        (ClientJoystickStop(), 256),
    ],
    ids=repr,
)
def test_value_that_does_not_fit_its_field_is_not_sent(message: Any, sender_id: int) -> None:
    with pytest.raises(EncodeError):
        encode_packet(message, sender_id)


# --- the table


def test_table_has_the_rows_of_the_page_and_no_other() -> None:
    assert {unhex(text)[5] for _, _, text in GOLDEN} | {56} == set(TABLE)
    rows = {packet_id: (spec.id, spec.name, spec.sender, spec.carrier) for packet_id, spec in PACKETS.items()}
    assert rows == {packet_id: (packet_id, *row) for packet_id, row in TABLE.items()}


def test_packet_of_an_undefined_id_keeps_its_bytes() -> None:
    for packet_id in set(range(256)) - set(TABLE):
        for body in (b"", b"\x00", b"\xff\x01\x02\x03\x04"):
            frame = packet(body, packet_id, 3)
            assert decode_packet(frame) == OpaquePacket(packet_id, body)
            assert encode_packet(OpaquePacket(packet_id, body), 3) == frame
