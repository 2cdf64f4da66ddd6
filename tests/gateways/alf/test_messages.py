"""The five messages and their framing in both dialects. Texts and bytes are written by hand from the protocol page."""

import math

import numpy as np
import pytest

from gateways.alf.messages import (
    MESSAGES,
    AlfMessage,
    Dialect,
    DriveCommand,
    DriveInfo,
    Measurement,
    ScannerInit,
    Sender,
    binary_frame_end,
    binary_size,
    read_binary,
    read_text,
    sent_by,
    text_frame_end,
    text_limit,
    write_binary,
    write_text,
)
from gateways.alf.session import AlfSession, HqRole, VehicleRole
from tests.conformance.side import plain
from tests.gateways.alf.golden import (
    ALL,
    BINARY,
    DRIVE_BYTES,
    GOLDEN_TEXT,
    INFO_BYTES,
    INIT_BYTES,
    MEASUREMENT_BYTES,
    OF_HQ,
    OF_VEHICLE,
    TEXT,
    heard,
    session,
)
from zbridge.errors import EncodeError, ProtocolError
from zbridge.protocol.session import State
from zbridge.wire import FrameBuffer

GOOGOL4 = b"1" + b"0" * 400

# The table


def test_the_message_table_is_that_of_the_page() -> None:
    assert {(spec.id, spec.name, spec.sender.value) for spec in MESSAGES.values()} == {
        (1, "measurement", "vehicle"),
        (2, "scanner init", "vehicle"),
        (3, "drive command", "hq"),
        (4, "drive info", "vehicle"),
        (255, "end", "both"),
    }
    assert sent_by(Sender.VEHICLE) == OF_VEHICLE
    assert sent_by(Sender.HQ) == OF_HQ


@pytest.mark.parametrize(
    ("message_id", "points", "size"),
    [(1, 769, 6169), (1, 726, 5825), (1, 0, 17), (2, 769, 25), (3, 769, 5), (4, 769, 18), (255, 769, 2)],
)
def test_the_id_and_the_number_of_points_give_the_length_of_a_binary_message(message_id, points, size) -> None:
    assert binary_size(message_id, points) == size


def test_a_text_scan_of_a_deployed_vehicle_is_about_4_kb_and_far_below_the_limit() -> None:
    longest = write_text(Measurement(2**31 - 1, 2**31 - 1, np.full(769, 2**31 - 1), 0, 768))
    assert len(longest) <= text_limit(769)
    assert len(write_text(Measurement(0, 5000, np.arange(1000, 1769), 44, 725))) == 3861


# Messages that are none


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (b";", "without an id"),
        (b"|||;", "without an id"),
        (b"hello;", "without an id"),
        (b"0|1;", "id 0"),
        (b"5|1;", "id 5"),
        (b"256|1;", "id 256"),
        (b"-1|7;", "id -1"),
        (b"1.5|7;", "id 1.5"),
        (b"9" * 6000 + b"|1;", "id 999"),
        (b"255|1", "without ';'"),
        (b"255;", "0 fields"),
        (b"255|1|1;", "2 fields"),
        (b"255|0;", "expected 1"),
        (b"3|80|0|30;", "3 fields"),
        (b"3|80||30|1;", "3 fields"),
        (b"3|80|0|30|1|0;", "5 fields"),
        (b"3|fast|0|30|1;", "3 fields"),
        (b"3|-1|0|30|1;", "speed"),
        (b"3|80|256|30|1;", "direction"),
        (b"3|80|0|91|1;", "steering"),
        (b"3|80|0|-91|1;", "steering"),
        (b"3|2147483648|0|30|1;", "speed"),
        (b"4|1e1|0|0|0|0|0|0|36;", "9 fields"),
        (b"4|10|nan|0|0|0|0|0|36;", "7 fields"),
        (b"2|-135|120|0.000000|100|20|5600;", "angles"),
        (b"2|-135|120|0.35|100|20|2147483648;", "range_max"),
        (b"1|0|1|1000|0|-1;", "last_valid"),
        (b"1|0|1|1000|0|4294967296;", "last_valid"),
        (b"1|-1|1|1000|0|0;", "sequence"),
        (b"1|0|1|2147483648|0|0;", "points"),
        (b"1|0|1|10.5|0|0;", "integers"),
        (b"1|0|1|0;", "fields"),
    ],
)
def test_a_text_that_is_no_message_is_a_protocol_error_that_says_why(text: bytes, what: str) -> None:
    with pytest.raises(ProtocolError, match=what) as caught:
        read_text(text, ALL)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("golden", [golden for _, golden in GOLDEN_TEXT])
def test_a_text_with_a_field_missing_or_empty_or_no_number_or_one_of_400_digits_is_a_protocol_error(golden) -> None:
    fields = golden[:-1].split(b"|")
    for place in range(len(fields)):
        huge = ([GOOGOL4], [b"-" + GOOGOL4], [GOOGOL4 + b".000000"])
        for instead in (*huge, *(([], [b""], [b"x"], [b"nan"], [b"-"], [b"inf"]) if place else ())):
            broken = b"|".join(fields[:place] + instead + fields[place + 1 :]) + b";"
            assert heard(session(HqRole, TEXT), broken) + heard(session(VehicleRole, TEXT), broken) == []


def test_tolerance_goes_no_further_than_the_readers_of_the_field_and_as_far() -> None:
    command = plain(DriveCommand(80, 1, -30, True))
    for text in (
        b"3|80|1|-30|1;",
        b"\r\n3, 80, 1, -30, 1;",
        b"|3||80|1|-30|1|;",
        b"3 80 1-30 1;",
        b"03|080|1.0|-30|1;",
    ):
        assert plain(read_text(text, ALL)) == command
    init = plain(ScannerInit(-135.0, 120.0, 0.5, 100, 20, 5600))
    for text in (b"2|-135|120|.5|100|20|5600;", b"2-135|120|.5|100|20|5600;"):
        assert plain(read_text(text, ALL)) == init


@pytest.mark.parametrize(
    ("golden", "what"),
    [
        ("00", "id 0"),
        ("05 01", "id 5"),
        ("fe 01", "id 254"),
        ("ff 00", "expected 1"),
        ("ff 02", "expected 1"),
        ("02 0000c07f 00c4ef42 0000b43e 64000000 14000000 e0150000", "angles"),
        ("02 000007c3 0000807f 0000b43e 64000000 14000000 e0150000", "angles"),
        ("02 000007c3 00c4ef42 0000c07f 64000000 14000000 e0150000", "angles"),
        ("02 000007c3 00c4ef42 00000000 64000000 14000000 e0150000", "angles"),
        ("04 0a fa00 0cfe e803 0f00 e5ff d204 0000c07f", "temperature"),
        ("04 0a fa00 0cfe e803 0f00 e5ff d204 000080ff", "temperature"),
    ],
)
def test_bytes_that_are_no_message_are_a_protocol_error_that_says_why(golden: str, what: str) -> None:
    with pytest.raises(ProtocolError, match=what):
        read_binary(bytes.fromhex(golden), ALL)


def test_every_byte_of_light_but_zero_is_on() -> None:
    assert plain(read_binary(bytes.fromhex("03 50 00 78 ff"), ALL)) == plain(DriveCommand(80, 0, 120, True))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (write_text, DriveCommand(-1, 0, 0, False)),
        (write_text, DriveCommand(2**31, 0, 0, False)),
        (write_text, DriveCommand(0, 0, -91, False)),
        (write_text, DriveCommand(0, 0, 91, False)),
        (write_text, DriveInfo(0, math.nan, 0, 0, 0, 0, 0, 0)),
        (write_text, DriveInfo(0, 0, 0, 0, 0, 0, 0, math.inf)),
        (write_text, ScannerInit(math.nan, 0, 1, 0, 0, 0)),
        (write_text, ScannerInit(0, 0, 1, 2**31, 0, 0)),
        (write_text, Measurement(0, 0, np.array([2**31]), 0, 0)),
        (write_binary, DriveCommand(256, 0, 0, False)),
        (write_binary, DriveCommand(0, 0, -1, False)),
        (write_binary, DriveInfo(0, 32768, 0, 0, 0, 0, 0, 0)),
        (write_binary, DriveInfo(0, 0.25, 0, 0, 0, 0, 0, 0)),
        (write_binary, Measurement(2**32, 0, np.zeros(3, np.int64), 0, 0)),
        (write_binary, Measurement(0, 0, np.zeros(3, np.int64), -1, 0)),
    ],
)
def test_what_a_dialect_cannot_carry_is_an_encode_error(write, message: AlfMessage) -> None:
    with pytest.raises(EncodeError):
        write(message)


# Framing


@pytest.mark.parametrize("dialect", Dialect)
def test_a_full_scan_comes_whole_also_a_thousand_in_one_read(dialect: Dialect) -> None:
    if dialect is TEXT:
        frame = b"1|7|5000|" + b"".join(b"%d|" % mm for mm in range(1000, 1769)) + b"44|725;"
    else:
        points = b"".join(mm.to_bytes(8, "little") for mm in range(1000, 1769))
        frame = bytes.fromhex("01 07000000 88130000") + points + bytes.fromhex("2c000000 d5020000")
    scan = plain(Measurement(7, 5000, np.arange(1000, 1769), 44, 725))
    assert heard(session(HqRole, dialect, 769), frame * 1000) == [scan] * 1000


@pytest.mark.parametrize("read_bytes", [1000, 65_536])
def test_a_text_that_never_ends_is_counted_and_takes_bounded_memory(read_bytes: int) -> None:
    limit = text_limit(769)
    buffer = FrameBuffer(text_frame_end(limit), limit)
    held = frames = 0
    reads = 2_000_000 // read_bytes
    for _ in range(reads):
        for frame in buffer.feed((b"7|" * read_bytes)[:read_bytes]):
            assert len(frame) <= limit
            frames += 1
        held = max(held, len(buffer))
    assert held <= limit
    assert frames == reads * read_bytes // limit
    by = session(HqRole, TEXT, 769)
    assert heard(by, *[b"1|7|" + b"7|" * 30_000] * 20) == []
    assert by.state is State.ESTABLISHED
    assert by.traffic.malformed >= 1


LIMIT = text_limit(769)
LONG = [
    *(b"1" + b"|3|80|0|30|1" * (length // 12) + b";" for length in (LIMIT + 100, 3 * LIMIT, 500_000)),
    *(b"1|" + b"9" * (LIMIT - 2 - cut) + tail for cut in range(12) for tail in (b"3|80|0|30|1;", b"255|1;")),
]


@pytest.mark.parametrize("read_bytes", [1 << 20, 4096, 1000])
@pytest.mark.parametrize("long", LONG, ids=range(len(LONG)))
def test_after_a_text_that_is_too_long_the_next_one_is_read_and_nothing_of_the_long_one(long, read_bytes) -> None:
    """The end of a message that is too long may look like one: cut anywhere, it must not drive a vehicle or end it."""
    by = session(VehicleRole, TEXT, 769)
    reads = [long[at : at + read_bytes] for at in range(0, len(long), read_bytes)]
    assert heard(by, *reads, b"3|50|1|-90|0;") == [plain(DriveCommand(50, 1, -90, False))]
    assert by.traffic.malformed >= 1
    assert by.state is State.ESTABLISHED


@pytest.mark.parametrize(
    ("kind", "garbage"),
    [
        (HqRole, b"\x00"),
        (HqRole, bytes(5_000)),
        (HqRole, bytes.fromhex("03 50 00 78 00")),
        (HqRole, b"hello, vehicle"),
        (HqRole, bytes(range(5, 255))),
        (HqRole, b"]^-[\\"),
        (VehicleRole, bytes.fromhex("00 01 02 04 05 fe")),
        (VehicleRole, b"hello, hq"),
    ],
)
def test_bytes_that_begin_no_binary_message_are_counted_and_skipped(kind: type[AlfSession], garbage: bytes) -> None:
    golden = INFO_BYTES if kind is HqRole else DRIVE_BYTES
    message = plain(read_binary(golden, ALL))
    byte_by_byte = [garbage[at : at + 1] for at in range(len(garbage))]
    for reads in ([garbage + golden], [golden + garbage, golden], [garbage, golden], [*byte_by_byte, golden]):
        by = session(kind, BINARY)
        assert heard(by, *reads) == [message] * b"".join(reads).count(golden)
        assert by.traffic.malformed >= 1
        assert "begin no message" in (by.last_malformed or "")
        assert by.state is State.ESTABLISHED


def test_endless_binary_garbage_takes_bounded_memory_and_a_measurement_no_more_than_its_length() -> None:
    buffer = FrameBuffer(binary_frame_end(OF_VEHICLE, lambda: 769), 80_017)
    frames = sum(len(list(buffer.feed(bytes(65_536)))) for _ in range(100))
    assert len(buffer) == 0
    assert frames <= 100 * 65_536 // 1000
    assert list(buffer.feed(b"\x01" + bytes(6167))) == []
    assert len(buffer) == 6168
    assert [len(frame) for frame in buffer.feed(b"\x00" + INIT_BYTES)] == [6169, 25]
    assert len(buffer) == 0


def test_the_length_of_a_binary_measurement_may_change_while_the_link_stands() -> None:
    by = session(HqRole, BINARY, 3)
    assert len(heard(by, MEASUREMENT_BYTES)) == 1
    by.points = 2
    shorter = bytes.fromhex("01 07000000 88130000 e803000000000000 0000000000000000 01000000 02000000")
    assert heard(by, shorter) == [plain(Measurement(7, 5000, np.array([1000, 0]), 1, 2))]
    assert by.traffic.malformed == 0


def test_a_message_of_the_wrong_side_is_no_message() -> None:
    for ids, texts in ((OF_HQ, (b"4|1;", b"1|1;", b"2|1;")), (OF_VEHICLE, (b"3|80|0|30|1;",))):
        for text in texts:
            with pytest.raises(ProtocolError, match=r"message id \d, expected one of"):
                read_text(text, ids)
    with pytest.raises(ProtocolError, match="begin no message"):
        read_binary(DRIVE_BYTES, OF_VEHICLE)


# Anything at all
