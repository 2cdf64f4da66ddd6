"""What is peculiar to packets of TCP/UDP. What holds of every message is in tests/conformance and tests/wire.

Every expected byte is written out by hand from the protocol page, never computed by the code under test.
"""

from typing import Any

import pytest

from gateways.tcpudp import messages as m
from tests.gateways.tcpudp.frames import framed
from tests.gateways.tcpudp.golden import GOLDEN, TABLE
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer


def fed(data: bytes) -> list[bytes]:
    return [bytes(frame) for frame in FrameBuffer(m.frame_end, m.MAX_FRAME).feed(data)]


def test_the_table_has_the_rows_of_the_page_and_packets_of_other_ids_keep_their_bytes() -> None:
    assert {bytes.fromhex(text)[5] for _, _, text in GOLDEN} | {56} == set(TABLE)
    rows = {packet_id: (spec.id, spec.name, spec.sender, spec.carrier) for packet_id, spec in m.PACKETS.items()}
    assert rows == {packet_id: (packet_id, *row) for packet_id, row in TABLE.items()}
    for packet_id in set(range(256)) - set(TABLE):
        for body in (b"", b"\xff\x01\x02\x03\x04"):
            frame = framed(3, packet_id, body)
            assert m.decode_packet(frame) == m.OpaquePacket(packet_id, body)
            assert m.encode_packet(m.OpaquePacket(packet_id, body), 3) == frame


# Framing


@pytest.mark.parametrize("length", ["00000000", "01000000", "ffffffff", "00000080", "020000ff", "ffffff7f", "00000040"])
def test_a_length_below_two_or_above_the_largest_map_is_refused_without_waiting_for_its_bytes(length: str) -> None:
    with pytest.raises(ProtocolError):
        fed(bytes.fromhex("02000000 01 04" + length + "01 01"))


def test_the_largest_map_fits_a_frame_and_two_packets_in_one_datagram_are_refused() -> None:
    frame = bytes.fromhex("06004000 01 35 00004000") + bytes(2048 * 2048)
    assert fed(frame) == [frame]
    with pytest.raises(ProtocolError):
        m.decode_packet(bytes.fromhex("02000000 02 0d 02000000 02 0d"))


# Bodies that are not simply their fields


@pytest.mark.parametrize(
    ("body", "start", "cells"),
    [
        ("03000000 06000000 000102", 3, b"\x00\x01\x02"),
        ("02010000 02010000", 258, b""),
        ("fdffff7f ffffff7f 0102", 2**31 - 3, b"\x01\x02"),
        # a range that is not its cells
        *((f"{bounds} 000102", None, b"") for bounds in ("00000000 02000000", "00000000 04000000")),
        *((f"{bounds} 000102", None, b"") for bounds in ("03000000 00000000", "05000000 05000000")),
        *((f"{bounds} 000102", None, b"") for bounds in ("fdffffff 00000000", "ffffff7f 02000080")),
        ("03000000 060000", None, b""),
        ("", None, b""),
    ],
)
def test_a_map_part_names_its_first_cell_and_the_cell_behind_its_last(body: str, start: int | None, cells) -> None:
    frame = framed(1, 56, bytes.fromhex(body))
    if start is None:
        with pytest.raises(ProtocolError):
            m.decode_packet(frame)
    else:
        assert m.decode_packet(frame) == m.ServerSLAMMapPart(start, start + len(cells), cells)
        assert m.encode_packet(m.ServerSLAMMapPart(start, start + len(cells), cells), 1) == frame


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        # Robots leave the int of the map out where they have none yet; HQ programs throw for good on that.
        ("02000000 01 35", m.ServerSLAMMap()),
        ("0e000000 01 35 0000c03f 000010c0 0000b442", m.ServerPosition(1.5, -2.25, 90.0)),  # three floats
        ("0e000000 01 35 08000000 0001020001020001", m.ServerSLAMMap(b"\x00\x01\x02\x00\x01\x02\x00\x01")),
        # second and third headers before a broadcast text
        ("0f000000 01 01 09000000 01 01 03000000 627965", m.DebugMessage("bye")),
        ("15000000 01 01 0f000000 01 01 09000000 01 01 03000000 627965", m.DebugMessage("bye")),
        ("0c000000 01 01 06000000 01 01 00000000", m.DebugMessage("")),
        # what merely looks like a second header
        ("0c000000 01 01 06000000 0102 61626364", m.DebugMessage("\x01\x02abcd")),
        ("0c000000 01 01 06000000 0201 61626364", m.DebugMessage("\x02\x01abcd")),
        ("0c000000 01 01 06000000 0501 00000000", m.DebugMessage("\x05\x01\x00\x00\x00\x00")),
        # the first bytes of a header, but what follows is no counted text
        ("0c000000 01 01 06000000 0101 61626364", m.DebugMessage("\x01\x01abcd")),
        ("0d000000 01 01 07000000 0101 00000000 61", m.DebugMessage("\x01\x01\x00\x00\x00\x00a")),
        ("08000000 01 01 02000000 0101", m.DebugMessage("\x01\x01")),
        ("0f000000 01 01 09000000 01 01 04000000 627965", m.DebugMessage("\x01\x01\x04\x00\x00\x00bye")),
        ("0f000000 01 01 08000000 01 01 03000000 627965", None),
        # bytes beyond ASCII are read as escapes
        ("0b000000 01 01 05000000 68 fc 00 7f ff", m.DebugMessage("h\\xfc\x00\x7f\\xff")),
        ("0d000000 02 03 02000000 e9 31 0000000000", m.ClientSettings("\\xe91", bytes(5))),
        # any byte but zero is true
        ("03000000 01 06 80", m.ServerUDPConnection(True)),
        ("03000000 02 07 02", m.ClientUDPConnectionStatus(True)),
    ],
)
def test_odd_packets_of_deployed_programs_are_read(frame: str, message: Any) -> None:
    next_one = bytes.fromhex("0e000000 01 37 0000803f 000000c0 00003443")
    assert fed(bytes.fromhex(frame) + next_one) == [bytes.fromhex(frame), next_one]
    if message is None:
        with pytest.raises(ProtocolError):
            m.decode_packet(bytes.fromhex(frame))
    else:
        assert m.decode_packet(bytes.fromhex(frame)) == message


def test_an_id_that_is_no_byte_is_not_sent() -> None:
    for sender_id in (-1, 256):
        with pytest.raises(EncodeError):
            m.encode_packet(m.ClientJoystickStop(), sender_id)
