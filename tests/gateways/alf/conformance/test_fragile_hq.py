"""The fragile HQ against a vehicle written by hand: every byte here is read off the protocol page or a capture."""

import asyncio
import contextlib
import struct
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.alf.conformance.fragile_hq import FragileHq, simulate_fragile_hq
from gateways.alf.conformance.parser import Dialect
from tests.captures import stream
from tests.conformance.scene import LONG_S, Listening, Scene, calling, until

DIALECTS: tuple[Dialect, ...] = ("text", "binary")
POINTS = 5
"""Of a measurement in most tests."""
NAN, INFINITY = bytes.fromhex("00 00 c0 7f"), bytes.fromhex("00 00 80 7f")
INIT: dict[Dialect, bytes] = {
    "text": b"2|-135.000000|119.882812|0.351562|100|20|5600;",
    "binary": bytes.fromhex("02 00 00 07 c3 00 c4 ef 42 00 00 b4 3e 64 00 00 00 14 00 00 00 e0 15 00 00"),
}
SCAN: dict[Dialect, bytes] = {
    "text": b"1|7|5000|0|-1|20|5600|3|1|4;",
    "binary": bytes.fromhex("01 07 00 00 00 88 13 00 00")
    + struct.pack("<5q", 0, -1, 20, 5600, 3)
    + bytes.fromhex("01 00 00 00 04 00 00 00"),
}
INFO: dict[Dialect, bytes] = {
    "text": b"4|10|0.250000|-0.500000|0.987654|1.500000|-2.750000|123.456001|36.529999;",
    "binary": bytes.fromhex("04 0a fa 00 0c fe e8 03 0f 00 e5 ff d2 04 00 00 12 42"),
}
END: dict[Dialect, bytes] = {"text": b"255|1;", "binary": b"\xff\x01"}
NEUTRAL: dict[Dialect, bytes] = {"text": b"3|0|0|0|0;", "binary": bytes.fromhex("03 00 00 5a 00")}


class Vehicle(Listening):
    send = Listening.send_bytes


@contextlib.asynccontextmanager
async def facing(hq: FragileHq) -> AsyncIterator[tuple[Vehicle, "asyncio.Task[None]"]]:
    async with calling(hq, Vehicle(), Scene) as scene:
        await scene.peer.accept()
        await hq.connected.wait()
        yield scene.peer, scene.task


def viewer(dialect: Dialect = "text", **options: Any) -> FragileHq:
    """An HQ that sends nothing, of 5 points."""
    return FragileHq(dialect=dialect, **{"points": POINTS, "repeat_s": None, "serves": "both", **options})


async def after(data: bytes, hq: FragileHq) -> FragileHq:
    """Send this, close, and give the HQ as it is then."""
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        await vehicle.send(data)
        vehicle.close()
        await task
    return hq


# A vehicle that behaves


@pytest.mark.parametrize("size", [1, 10, 1000])
@pytest.mark.parametrize("dialect", DIALECTS)
async def test_messages_may_come_split_or_joined(dialect: Dialect, size: int) -> None:
    hq = viewer(dialect)
    sent = INIT[dialect] + SCAN[dialect] + INFO[dialect] + SCAN[dialect] + END[dialect]
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        for start in range(0, len(sent), size):
            await vehicle.send(sent[start : start + size])
            await asyncio.sleep(0)
        assert await vehicle.read_to_the_end() == END[dialect]
        vehicle.close()
        await task
    assert hq.violations == []
    assert hq.events == ["END", "the vehicle closed: EOF"]
    assert hq.alive
    assert hq.scans == 2
    assert hq.last_scan == (7, 5000, (0, -1, 20, 5600, 3), 1, 4)
    assert hq.scanner == pytest.approx((-135.0, 119.88, 0.351562, 100, 20, 5600), rel=1e-4)
    assert [one[0] for one in hq.infos] == [10]
    assert [one[1] for one in hq.received] == [2, 1, 4, 1, 255]
    assert hq.received[1][2] == (7, 5000, 1, 4)


async def test_the_fields_of_an_info() -> None:
    text = await after(INFO["text"], viewer())
    assert text.infos == [(10, 0.25, -0.5, 0.987654, 1.5, -2.75, 123.456001, 36.529999)]
    binary = await after(INFO["binary"], viewer("binary"))
    assert binary.infos == [(10, 250, -500, 1000, 15, -27, 1234, 36.5)]


@pytest.mark.parametrize(("name", "port", "scans"), [("alf-drive.hex", 16668, 0), ("alf-laser.hex", 16667, 6)])
async def test_the_captures_have_no_violation(name: str, port: int, scans: int) -> None:
    hq = await after(stream(name, source=port), FragileHq(repeat_s=None, serves="laser" if scans else "drive"))
    assert hq.violations == []
    assert hq.scans == scans
    assert len(hq.infos) == (0 if scans else 6)


async def test_the_largest_numbers_break_nothing() -> None:
    scan = b"1|2147483647|2147483647|2147483647|0|0|0|0|0|0;"
    info = b"4|0|-0.000000|3000000000.000000|0.000000|0.000000|0.000000|0.000000|0.000000;"
    hq = await after(INIT["text"] + scan + info + END["text"], viewer())
    assert hq.violations == []
    assert hq.infos[0][2] == 3e9


# A vehicle that does not


@pytest.mark.parametrize(
    ("dialect", "data", "words"),
    [
        ("text", SCAN["text"], "a measurement before the scanner init"),
        ("text", INIT["text"] + b"1|7|5000|0|-1|20|5600|1|4;", "8 fields instead of 9: "),
        ("text", INIT["text"] + b"1|7|5000|0|-1|20|5600|3|1|5;", "valid indices 1 and 5 of 5 points"),
        ("text", INIT["text"] + b"1|7|5000|0|-1|20|5600|3|5|4;", "valid indices 5 and 4 of 5 points"),
        ("text", INIT["text"] + b"1|7|5000|0|-1|20|5600|3|-1|4;", "valid indices -1 and 4 of 5 points"),
        ("text", INIT["text"] + b"1|-7|5000|0|-1|20|5600|3|1|4;", "sequence -7, timestamp 5000: below 0"),
        ("text", INIT["text"] + b"1|7|5000|0|-1|20.0|5600|3|1|4;", "not written as std::to_string"),
        ("text", INIT["text"][:-1] + b"|1;", "7 fields instead of 6"),
        ("text", b"2|-135|119.882812|0.351562|100|20|5600;", "not written as std::to_string"),
        ("text", INFO["text"].replace(b"0.250000", b"0.25"), "not written as std::to_string"),
        ("text", INFO["text"].replace(b"0.250000", b"2.5e-01"), "9 fields instead of 8"),
        ("text", INFO["text"].replace(b"0.250000", b"inf"), "7 fields instead of 8"),
        ("text", INFO["text"].replace(b"4|10", b"4|10.000000"), "not written as std::to_string"),
        ("text", INFO["text"].replace(b"4|10", b"4|010"), "not written as std::to_string"),
        ("text", b"\n" + INFO["text"], "not written as std::to_string"),
        ("text", b"3|0|0|0|0;", "id 3, which no vehicle sends"),
        ("text", b"hello;", "a message without an id"),
        ("text", b"255|2;", "end 2 instead of 1"),
        ("binary", SCAN["binary"], "a measurement before the scanner init"),
        ("binary", INIT["binary"] + SCAN["binary"][:-4] + b"\5\0\0\0", "valid indices 1 and 5 of 5 points"),
        ("binary", INFO["binary"][:-4] + INFINITY, "an infinite number"),
        ("binary", b"\xff\x02", "end 2 instead of 1"),
    ],
)
async def test_what_the_page_forbids_is_a_violation(dialect: Dialect, data: bytes, words: str) -> None:
    told: list[str] = []
    end = b"" if words.startswith("end") else END[dialect]
    hq = await after(data + end, viewer(dialect, note=told.append))
    assert len(hq.violations) == 1, hq.violations
    assert hq.violations[0].startswith(words)
    assert told == hq.violations
    assert hq.alive


@pytest.mark.parametrize(
    ("dialect", "data", "words"),
    [
        ("text", b"1|7|5000|0|-1|20|5600|3|3|1|4;", "6 points instead of 5"),
        ("text", b"1|2147483648|5000|0|-1|20|5600|3|1|4;", "an integer over 2^31-1, 2147483648"),
        ("text", b"1|7|4294967295|0|-1|20|5600|3|1|4;", "an integer over 2^31-1, 4294967295"),
        ("text", b"1|7|5000|0|-1|" + b"9" * 5000 + b"|5600|3|1|4;", "an integer over 2^31-1, 99999"),
        ("text", b"99999999999|1;", "an integer over 2^31-1, 99999999999"),
        ("text", INFO["text"].replace(b"0.250000", b".250000"), "a number without leading digit, .250000"),
        ("text", INFO["text"].replace(b"-0.500000", b"-.500000"), "a number without leading digit, -.500000"),
        ("text", INFO["text"].replace(b"0.250000", b"nan"), "NaN"),
        ("text", INFO["text"].replace(b"0.250000", b"-NaN"), "NaN"),
        ("text", b"1|" * 40_000, "a message without end, 80000 bytes"),
        ("binary", INFO["binary"][:-4] + NAN, "NaN"),
        ("binary", b"\x02" + NAN + INIT["binary"][5:], "NaN"),
        ("binary", b"\x01\0\0\0\x80" + SCAN["binary"][5:], "an integer over 2^31-1, 2147483648"),
        ("binary", SCAN["binary"][:9] + b"\0\0\0\x80\0\0\0\0" + SCAN["binary"][17:], "an integer over 2^31-1"),
        ("binary", b"\x03\0\0\x5a\0", "id 3, which no vehicle sends: the framing is lost"),
        ("binary", SCAN["binary"] + b"\0" * 8, "id 0, which no vehicle sends: the framing is lost"),
    ],
)
async def test_what_an_hq_breaks_on_kills_it(dialect: Dialect, data: bytes, words: str) -> None:
    hq = viewer(dialect)
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        await vehicle.send(INIT[dialect] + data)
        await task
        assert await vehicle.read_to_the_end() == b""
    assert not hq.alive
    assert hq.death.startswith(words)
    assert hq.violations[-1] == hq.death
    assert hq.events[-1] == f"died: {hq.death}"


async def test_the_deployed_hq_has_room_for_769_points_and_no_more() -> None:
    scan = b"1|0|0|" + b"1000|" * 769 + b"44|725;"
    hq = await after(INIT["text"] + scan + END["text"], FragileHq(repeat_s=None))
    assert (hq.violations, hq.scans) == ([], 1)
    hq = await after(INIT["text"] + scan.replace(b"|44|", b"|1000|44|"), FragileHq(repeat_s=None))
    assert hq.death.startswith("770 points instead of 769")


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_an_end_of_the_connection_without_end_is_a_violation(dialect: Dialect) -> None:
    hq = await after(INIT[dialect], viewer(dialect))
    assert hq.violations == ["the vehicle closed without END: EOF"]
    assert hq.alive


async def test_an_end_of_the_connection_within_a_message_is_a_violation_more() -> None:
    hq = await after(INIT["text"] + b"4|10", viewer())
    assert hq.violations == ["the connection ended within a message: '4|10'", "the vehicle closed without END: EOF"]


async def test_a_reset_without_end_is_a_violation() -> None:
    hq = viewer()
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        vehicle.reset()
        await task
    assert len(hq.violations) == 1
    assert hq.violations[0].startswith("the vehicle closed without END: ConnectionResetError")


async def test_a_message_after_end_is_a_violation() -> None:
    hq = await after(END["text"] + INFO["text"], viewer())
    assert len(hq.violations) == 1
    assert hq.violations[0].startswith("a message after END: ")


async def test_a_vehicle_has_to_close_after_both_ends() -> None:
    hq = viewer(answer_s=0.05)
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        await vehicle.send(END["text"])
        await task
    assert hq.violations == ["the vehicle did not close within 0.05 s of both ENDs"]


@pytest.mark.parametrize(("serves", "kinds"), [("drive", [2, 1]), ("laser", [4]), ("both", []), ("auto", [4])])
async def test_a_listener_sends_only_what_it_serves(serves: str, kinds: list[int]) -> None:
    hq = await after(INIT["text"] + SCAN["text"] + INFO["text"] + END["text"], viewer(serves=serves))
    assert [one[:40] for one in hq.violations] == [
        f"message {kind} from a listener that does not serve it"[:40] for kind in kinds
    ]


async def test_with_auto_4_comes_after_the_first_command_and_1_and_2_before_it() -> None:
    hq = FragileHq(points=POINTS, repeat_s=0.002, flight_s=0.0)
    async with facing(hq) as (vehicle, _):
        await vehicle.read_until(NEUTRAL["text"])
        await vehicle.send(INFO["text"] + INIT["text"] + SCAN["text"] + INFO["text"])
        await until(lambda: len(hq.infos) == 2, hq)
    assert [one[:10] for one in hq.violations] == ["message 2 ", "message 1 "]


async def test_what_was_on_its_way_when_the_first_command_was_sent_is_excused() -> None:
    hq = FragileHq(points=POINTS, repeat_s=0.002, flight_s=60.0)
    async with facing(hq) as (vehicle, _):
        await vehicle.read_until(NEUTRAL["text"])
        await vehicle.send(INIT["text"] + SCAN["text"] + INFO["text"])
        await until(lambda: hq.infos, hq)
    assert hq.violations == []


# The deployed programs


@pytest.mark.parametrize("serves", ["auto", "laser", "both"])
async def test_the_scanning_program_takes_whatever_is_not_1_or_2_as_end_and_shows_nothing_more(serves: str) -> None:
    sent = INIT["text"] + SCAN["text"] + INFO["text"] + SCAN["text"]
    hq = await after(sent + END["text"], viewer(deployed="scanning", serves=serves))
    assert (hq.scans, hq.infos) == (1, [])
    assert hq.violations[-1].startswith("message 4 taken as END, it shows nothing more: ")
    quiet = await after(sent.replace(INFO["text"], b"") + END["text"], viewer(deployed="scanning", serves=serves))
    assert (quiet.scans, quiet.violations) == (2, [])


async def test_the_scanning_program_sends_no_commands() -> None:
    hq = FragileHq(deployed="scanning", repeat_s=0.002)
    async with facing(hq) as (vehicle, task):
        task.cancel()
        assert await vehicle.read_to_the_end() == END["text"]


async def test_the_driving_program_stops_reading_after_ten_measurements() -> None:
    hq = FragileHq(points=POINTS, repeat_s=0.002, deployed="driving", serves="both")
    async with facing(hq) as (vehicle, _), asyncio.timeout(LONG_S):
        await vehicle.send(INIT["text"] + SCAN["text"] * 10 + INFO["text"])
        await until(lambda: hq.scans == 10, hq)
        await vehicle.read(100)
    assert hq.infos == []
    assert hq.events[0] == "it reads no more, after 10 measurements"


# Commands


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_it_stands_at_first_and_repeats_its_command_for_ever(dialect: Dialect) -> None:
    hq = FragileHq(dialect=dialect, repeat_s=0.002)
    async with facing(hq) as (vehicle, _):
        size = len(NEUTRAL[dialect])
        assert await vehicle.read(5 * size) >= 5 * NEUTRAL[dialect]


@pytest.mark.parametrize(
    ("dialect", "told"), [("text", b"3|255|1|-90|1;"), ("binary", bytes.fromhex("03 64 01 00 01"))]
)
async def test_drive_and_idle_change_what_is_repeated(dialect: Dialect, told: bytes) -> None:
    hq = FragileHq(dialect=dialect, repeat_s=0.002)
    async with facing(hq) as (vehicle, _), asyncio.timeout(LONG_S):
        hq.drive(255 if dialect == "text" else 100, 1, -90 if dialect == "text" else 0, True)
        await vehicle.read_until(told + told)
        hq.idle()
        await vehicle.read_until(2 * NEUTRAL[dialect])


async def test_it_repeats_every_20_ms() -> None:
    hq = FragileHq()
    async with facing(hq) as (vehicle, _):
        began = time.monotonic()
        await vehicle.read(11 * len(NEUTRAL["text"]))
        assert 0.15 < time.monotonic() - began < 2


@pytest.mark.parametrize(
    ("dialect", "command"),
    [("text", (256,)), ("text", (0, 2)), ("text", (0, 0, 91)), ("binary", (101,)), ("binary", (0, 0, -1))],
)
def test_it_sends_nothing_that_no_hq_sends(dialect: Dialect, command: Any) -> None:
    with pytest.raises(ValueError, match="speed"):
        FragileHq(dialect=dialect).drive(*command)


@pytest.mark.parametrize("options", [{"dialect": "morse"}, {"serves": "tea"}])
def test_there_are_no_other_hqs(options: Any) -> None:
    with pytest.raises(ValueError, match="no such HQ"):
        FragileHq(**options)


# Its end


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_it_ends_with_end_and_takes_the_answer(dialect: Dialect) -> None:
    hq = viewer(dialect)
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        ending = asyncio.create_task(hq.end())
        assert await vehicle.read(len(END[dialect])) == END[dialect]
        await vehicle.send(INFO[dialect] + END[dialect])
        assert await vehicle.recv() == b""
        vehicle.close()
        await ending
        await task
        await hq.end()
    assert hq.violations == []
    assert len(hq.infos) == 1


async def test_an_end_that_is_not_answered_is_a_violation() -> None:
    hq = viewer(answer_s=0.05)
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        await hq.end()
        await task
        assert await vehicle.read_to_the_end() == END["text"]
    assert hq.violations == ["no END within 0.05 s of the HQ's"]


async def test_it_leaves_with_end_when_cancelled() -> None:
    hq = viewer()
    async with facing(hq) as (vehicle, task):
        task.cancel()
        assert await vehicle.read_to_the_end() == END["text"]
    assert hq.violations == []


async def test_it_can_stop_reading_for_good_and_goes_on_driving() -> None:
    hq = FragileHq(points=POINTS, repeat_s=0.002, stops_reading_after=10, serves="both")
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        await vehicle.send(INIT["text"] + SCAN["text"] * 10 + b"1|broken;nan;" + END["text"])
        await until(lambda: hq.scans == 10, hq)
        await vehicle.read(100)
        assert not task.done()
        with contextlib.suppress(BlockingIOError):  # until its window closes
            while True:
                vehicle.tcp.send(bytes(65536))
        vehicle.close()
        await task
    assert hq.scans == 10
    assert hq.violations == []
    assert hq.events[0] == "it reads no more, after 10 measurements"


async def test_it_ends_although_it_reads_no_more() -> None:
    hq = viewer(stops_reading_after=1)
    async with facing(hq) as (vehicle, task), asyncio.timeout(LONG_S):
        await vehicle.send(INIT["text"] + SCAN["text"])
        await until(lambda: hq.scans == 1, hq)
        await hq.end()
        await task
        assert await vehicle.read_to_the_end() == END["text"]
    assert hq.violations == []


async def test_lists_are_bounded() -> None:
    hq = await after(b"3|1;" * 10 + INFO["text"] * 10 + END["text"], viewer(keep=3))
    assert (len(hq.violations), len(hq.received), len(hq.infos)) == (3, 3, 3)


async def test_nobody_listening_is_an_error() -> None:
    vehicle = Vehicle()
    vehicle.close()
    with pytest.raises(ConnectionRefusedError):
        await viewer().run("127.0.0.1", vehicle.port)


async def test_the_program_logs_and_prints_what_it_died_of(capsys, caplog) -> None:
    vehicle = Vehicle()
    task = asyncio.create_task(simulate_fragile_hq("127.0.0.1", vehicle.port, dialect="text", points=POINTS))
    async with asyncio.timeout(LONG_S):
        await vehicle.accept()
        await vehicle.send(b"3|1;4|nan;")
        await task
    vehicle.close()
    assert capsys.readouterr().out == "died: NaN: '4|nan;'\n"
    assert [record.message for record in caplog.records] == [
        "violation: id 3, which no vehicle sends: '3|1;'",
        "violation: NaN: '4|nan;'",
    ]
