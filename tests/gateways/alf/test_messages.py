"""The five messages and their framing in both dialects. Texts and bytes are written by hand from the protocol page."""

import math

import numpy as np
import pytest

from gateways.alf.messages import (
    AlfDialect,
    AlfMessage,
    DriveCommand,
    DriveInfo,
    Measurement,
    ScannerInit,
    binary_frame_end,
    read_binary,
    read_text,
    text_frame_end,
    text_limit,
    write_binary,
    write_text,
)
from gateways.alf.session import AlfHqRole, AlfSession, VehicleRole
from tests.conformance.side import plain
from tests.gateways.alf.golden import ALL, BINARY, DRIVE, GOLDEN, INFO, INIT, OF_VEHICLE, TEXT, heard, session
from zbridge.errors import EncodeError, ProtocolError
from zbridge.protocol.session import State
from zbridge.wire import FrameBuffer

GOOGOL4 = b"1" + b"0" * 400
LIMIT = text_limit(769)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b";", "without an id"),
        (b"hello;", "without an id"),
        (b"5|1;", "id 5"),
        (b"-1|7;", "id -1"),
        (b"1.5|7;", "id 1.5"),
        (b"9" * 6000 + b"|1;", "id 999"),
        (b"255|1", "without ';'"),
        (b"255|1|1;", "2 fields"),
        (b"255|0;", "expected 1"),
        (b"3|-1|0|30|1;", "speed"),
        (b"3|2147483648|0|30|1;", "speed"),
        (b"3|80|256|30|1;", "direction"),
        (b"3|80|0|91|1;", "steering"),
        (b"3|80|0|-91|1;", "steering"),
        (b"4|1e1|0|0|0|0|0|0|36;", "9 fields"),
        (b"4|10|1" + b"0" * 308 + b"|0|0|0|0|0|36;", "drive info"),
        (b"2|-135|120|0.000000|100|20|5600;", "angles"),
        (b"2|-135|120|0.35|100|20|2147483648;", "range_max"),
        (b"1|0|1|1000|0|-1;", "last_valid"),
        (b"1|0|1|1000|0|4294967296;", "last_valid"),
        (b"1|-1|1|1000|0|0;", "sequence"),
        (b"1|0|1|2147483648|0|0;", "points"),
        (b"1|0|1|10.5|0|0;", "integers"),
        (bytes.fromhex("05 01"), "id 5"),
        (bytes.fromhex("ff 00"), "expected 1"),
        (bytes.fromhex("02 0000c07f 00c4ef42 0000b43e 64000000 14000000 e0150000"), "angles"),
        (bytes.fromhex("02 000007c3 0000807f 0000b43e 64000000 14000000 e0150000"), "angles"),
        (bytes.fromhex("02 000007c3 00c4ef42 00000000 64000000 14000000 e0150000"), "angles"),
        (bytes.fromhex("04 0a fa00 0cfe e803 0f00 e5ff d204 0000c07f"), "temperature"),
        (bytes.fromhex("04 0a fa00 0cfe e803 0f00 e5ff d204 000080ff"), "temperature"),
    ],
)
def test_what_is_no_message_is_a_protocol_error_that_says_why(data: bytes, what: str) -> None:
    read = read_text if data[-1:] in b";1" else read_binary
    with pytest.raises(ProtocolError, match=what) as caught:
        read(data, ALL)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("golden", [golden for _, golden in GOLDEN[TEXT]])
def test_a_text_with_a_field_missing_or_empty_or_no_number_or_one_of_400_digits_is_a_protocol_error(golden) -> None:
    fields = golden[:-1].split(b"|")
    for place in range(len(fields)):
        huge = ([GOOGOL4], [b"-" + GOOGOL4], [GOOGOL4 + b".000000"])
        for instead in (*huge, *(([], [b""], [b"x"], [b"nan"], [b"-"], [b"inf"]) if place else ())):
            broken = b"|".join(fields[:place] + instead + fields[place + 1 :]) + b";"
            assert heard(session(AlfHqRole, TEXT), broken) + heard(session(VehicleRole, TEXT), broken) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"\r\n3, 80, 1, -30, 1;", DriveCommand(80, 1, -30, True)),
        (b"|3||80|1|-30|1|;", DriveCommand(80, 1, -30, True)),
        (b"3 80 1-30 1;", DriveCommand(80, 1, -30, True)),
        (b"03|080|1.0|-30|1;", DriveCommand(80, 1, -30, True)),
        (b"2-135|120|.5|100|20|5600;", ScannerInit(-135.0, 120.0, 0.5, 100, 20, 5600)),
    ],
)
def test_a_text_is_read_as_tolerantly_as_the_readers_of_the_field_do(text: bytes, message: AlfMessage) -> None:
    assert read_text(text, ALL) == message


def test_every_byte_of_light_but_zero_is_on() -> None:
    assert read_binary(bytes.fromhex("03 50 00 78 ff"), ALL) == DriveCommand(80, 0, 120, True)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (write_text, DriveCommand(-1, 0, 0, False)),
        (write_text, DriveCommand(0, 0, -91, False)),
        (write_text, DriveInfo(0, 0, 0, 0, 0, 0, 0, math.inf)),
        (write_text, Measurement(0, 0, np.array([2**31]), 0, 0)),
        (write_binary, DriveCommand(256, 0, 0, False)),
        (write_binary, DriveInfo(0, 0.25, 0, 0, 0, 0, 0, 0)),
        (write_binary, Measurement(2**32, 0, np.zeros(3, np.int64), 0, 0)),
    ],
)
def test_what_a_dialect_cannot_carry_is_an_encode_error(write, message: AlfMessage) -> None:
    with pytest.raises(EncodeError):
        write(message)


# Framing


@pytest.mark.parametrize("dialect", AlfDialect)
def test_a_full_scan_of_the_largest_numbers_comes_whole(dialect: AlfDialect) -> None:
    if dialect is TEXT:
        frame = b"1|2147483647|2147483647|" + b"2147483647|" * 769 + b"44|725;"
    else:
        frame = bytes.fromhex("01 ffffff7f ffffff7f" + "ffffff7f00000000" * 769 + "2c000000 d5020000")
    scan = plain(Measurement(2**31 - 1, 2**31 - 1, np.full(769, 2**31 - 1), 44, 725))
    assert heard(session(AlfHqRole, dialect, points=769), frame * 2) == [scan] * 2


def test_a_text_that_never_ends_is_counted_and_takes_bounded_memory() -> None:
    buffer = FrameBuffer(text_frame_end(LIMIT), LIMIT)
    frames = 0
    for _ in range(2000):
        frames += len(list(buffer.feed(b"7|" * 500)))
        assert len(buffer) <= LIMIT
    assert frames == 2_000_000 // LIMIT


@pytest.mark.parametrize(
    "long",
    [
        *(b"1" + b"|3|80|0|30|1" * (length // 12) + b";" for length in (LIMIT + 100, 500_000)),
        *(b"1|" + b"9" * (LIMIT - 2 - cut) + tail for cut in range(12) for tail in (b"3|80|0|30|1;", b"255|1;")),
    ],
    ids=lambda long: f"{len(long)} bytes, {long[-6:].decode()}",
)
def test_after_a_text_that_is_too_long_the_next_one_is_read_and_nothing_of_the_long_one(long: bytes) -> None:
    """The end of a message that is too long may look like one: cut anywhere, it must not drive a vehicle or end it."""
    for read_bytes in (1 << 20, 4096, 1000):
        by = session(VehicleRole, TEXT, points=769)
        reads = [long[at : at + read_bytes] for at in range(0, len(long), read_bytes)]
        assert heard(by, *reads, b"3|50|1|-90|0;") == [plain(DriveCommand(50, 1, -90, False))]
        assert by.traffic.malformed >= 1
        assert by.state is State.ESTABLISHED


@pytest.mark.parametrize(
    ("kind", "garbage"),
    [
        (AlfHqRole, bytes(5_000)),
        (AlfHqRole, DRIVE[BINARY][:4] + b"\x00"),
        (AlfHqRole, bytes(range(5, 255))),
        (AlfHqRole, b"]^-[\\"),
        (VehicleRole, bytes.fromhex("00 01 02 04 05 fe")),
    ],
)
def test_bytes_that_begin_no_binary_message_are_counted_and_skipped(kind: type[AlfSession], garbage: bytes) -> None:
    golden = INFO[BINARY] if kind is AlfHqRole else DRIVE[BINARY]
    byte_by_byte = [garbage[at : at + 1] for at in range(len(garbage))]
    for reads in ([garbage + golden], [golden + garbage, golden], [*byte_by_byte, golden]):
        by = session(kind, BINARY)
        assert heard(by, *reads) == [plain(read_binary(golden, ALL))] * b"".join(reads).count(golden)
        assert by.traffic.malformed >= 1
        assert "begin no message" in by.last_malformed
        assert by.state is State.ESTABLISHED


def test_endless_binary_garbage_takes_bounded_memory_and_a_measurement_no_more_than_its_length() -> None:
    buffer = FrameBuffer(binary_frame_end(OF_VEHICLE, lambda: 769), 80_017)
    assert sum(len(list(buffer.feed(bytes(65_536)))) for _ in range(100)) <= 6553
    assert len(buffer) == 0
    assert list(buffer.feed(b"\x01" + bytes(6167))) == []
    assert len(buffer) == 6168
    assert [len(frame) for frame in buffer.feed(b"\x00" + INIT[BINARY])] == [6169, 25]
    assert len(buffer) == 0
