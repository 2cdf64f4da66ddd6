"""The fragile HQ against a vehicle written by hand: every byte here is read off the protocol page or a capture."""

import asyncio
import contextlib
import time
from typing import Any

import pytest

from gateways.alf.conformance.fragile_hq import FragileHq, Reader, simulate_fragile_hq
from gateways.alf.conformance.parser import Dialect
from tests.captures import stream
from tests.conformance.scene import LONG_S, Listening, calling, scripts, until
from tests.gateways.alf.conformance.scene import DIALECTS, MESSAGES, AlfScene

POINTS = 5
"""Of a measurement in most tests."""
INIT, SCAN, INFO = (MESSAGES[name]["text"] for name in ("INIT", "SCAN", "INFO"))
INIT_BYTES, SCAN_BYTES, INFO_BYTES = (MESSAGES[name]["binary"] for name in ("INIT", "SCAN", "INFO"))


# Messages


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_cut_does_not_depend_on_the_reads(dialect: Dialect) -> None:
    data = b"".join(MESSAGES[name][dialect] for name in ("INIT", "SCAN", "INFO", "END"))
    infos = {
        "text": (10, 0.25, -0.5, 0.987654, 1.5, -2.75, 123.456001, 36.529999),
        "binary": (10, 250, -500, 1000, 15, -27, 1234, 36.5),
    }
    for size in (1, 2, 3, 10, 1000):
        reader = Reader(dialect, POINTS)
        told = [one for at in range(0, len(data), size) for one in reader.take(data[at : at + size])]
        assert [(one.kind, one.problem) for one in told] == [(2, ""), (1, ""), (4, ""), (255, "")]
        assert told[0].fields == pytest.approx((-135.0, 119.88, 0.351562, 100, 20, 5600), rel=1e-4)
        assert [one.fields for one in told[1:]] == [(7, 5000, 0, -1, 20, 5600, 3, 1, 4), infos[dialect], (1,)]
        assert reader.rest == b""


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"1|2147483647|2147483647|2147483647|0|0|0|0|0|0;", ""),
        (b"4|0|-0.000000|3000000000.000000|0.000000|0.000000|0.000000|0.000000|0.000000;", ""),
        (b"1|7|5000|0|-1|20|5600|1|4;", "8 fields instead of 9"),
        (b"1|7|5000|0|-1|20|5600|3|1|5;", "valid indices 1 and 5 of 5 points"),
        (b"1|7|5000|0|-1|20|5600|3|-1|4;", "valid indices -1 and 4 of 5 points"),
        (b"1|-7|5000|0|-1|20|5600|3|1|4;", "sequence -7, timestamp 5000: below 0"),
        (b"1|7|5000|0|-1|20.0|5600|3|1|4;", "not written as std::to_string"),
        (INIT[:-1] + b"|1;", "7 fields instead of 6"),
        (b"2|-135|119.882812|0.351562|100|20|5600;", "not written as std::to_string"),
        (INFO.replace(b"0.250000", b"0.25"), "not written as std::to_string"),
        (INFO.replace(b"0.250000", b"2.5e-01"), "9 fields instead of 8"),
        (INFO.replace(b"0.250000", b"inf"), "7 fields instead of 8"),
        (INFO.replace(b"4|10", b"4|10.000000"), "not written as std::to_string"),
        (INFO.replace(b"4|10", b"4|010"), "not written as std::to_string"),
        (b"\n" + INFO, "not written as std::to_string"),
        (b"3|0|0|0|0;", "id 3, which no vehicle sends"),
        (b"hello;", "a message without an id"),
        (b"255|2;", "end 2 instead of 1"),
        (SCAN_BYTES[:-4] + b"\5\0\0\0", "valid indices 1 and 5 of 5 points"),
        (INFO_BYTES[:-4] + bytes.fromhex("0000807f"), "an infinite number"),
        (b"\xff\x02", "end 2 instead of 1"),
    ],
)
def test_what_the_page_forbids_is_told(data: bytes, problem: str) -> None:
    (told,) = Reader("text" if data.endswith(b";") else "binary", POINTS).take(data)
    assert told.problem.startswith(problem)
    assert bool(told.problem) is bool(problem)
    assert not told.deadly


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"1|7|5000|0|-1|20|5600|3|3|1|4;", "6 points instead of 5"),
        (b"1|2147483648|5000|0|-1|20|5600|3|1|4;", "an integer over 2^31-1, 2147483648"),
        (b"1|7|4294967295|0|-1|20|5600|3|1|4;", "an integer over 2^31-1, 4294967295"),
        (b"1|7|5000|0|-1|" + b"9" * 5000 + b"|5600|3|1|4;", "an integer over 2^31-1, 99999"),
        (b"99999999999|1;", "an integer over 2^31-1, 99999999999"),
        (INFO.replace(b"0.250000", b".250000"), "a number without leading digit, .250000"),
        (INFO.replace(b"-0.500000", b"-.500000"), "a number without leading digit, -.500000"),
        (INFO.replace(b"0.250000", b"-NaN"), "NaN"),
        (b"1|" * 40_000, "a message without end, 80000 bytes"),
        (INFO_BYTES[:-4] + bytes.fromhex("0000c07f"), "NaN"),
        (b"\x02" + bytes.fromhex("0000c07f") + INIT_BYTES[5:], "NaN"),
        (b"\x01\0\0\0\x80" + SCAN_BYTES[5:], "an integer over 2^31-1, 2147483648"),
        (SCAN_BYTES[:9] + b"\0\0\0\x80\0\0\0\0" + SCAN_BYTES[17:], "an integer over 2^31-1"),
        (b"\x03\0\0\x5a\0", "id 3, which no vehicle sends: the framing is lost"),
    ],
)
def test_what_an_hq_breaks_on_is_told(data: bytes, problem: str) -> None:
    (told,) = Reader("text" if data[-1:] in b";|" else "binary", POINTS).take(data)
    assert told.problem.startswith(problem)
    assert told.deadly


# Conversations


class Vehicle(AlfScene):
    """A vehicle: what it sends and what it reads."""

    async def reads(self, text: str) -> None:
        await self.peer.read_until(self.raw(text))

    async def scans(self, count: str) -> None:
        await until(lambda: self.judge.scans >= int(count), self.judge.events)
        assert self.judge.scans == int(count)

    async def infos(self, count: str) -> None:
        await until(lambda: len(self.judge.infos) >= int(count), self.judge.events)
        assert len(self.judge.infos) == int(count)

    async def drive(self, command: str) -> None:
        self.judge.drive(*map(int, command.split()))

    async def idle(self, _: str) -> None:
        self.judge.idle()

    async def fill(self, _: str) -> None:
        """Send until the window of the HQ closes."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self.peer.tcp.send(bytes(65536))


def viewer(dialect: Dialect = "text", **options: Any) -> FragileHq:
    """An HQ that sends nothing, of 5 points."""
    return FragileHq(dialect=dialect, **{"points": POINTS, "repeat_s": None, "serves": "both", **options})


async def played(hq: FragileHq, *steps: str) -> FragileHq:
    """The HQ after a conversation."""
    peer = Listening()
    async with calling(hq, peer, Vehicle) as scene, asyncio.timeout(LONG_S):
        await peer.accept()
        await hq.connected.wait()
        await scene.play(list(steps))
    return hq


BINARY: dict[str, Any] = {"dialect": "binary"}
HURRIED: dict[str, Any] = {"answer_s": 0.05}
DRIVES: dict[str, Any] = {"repeat_s": 0.002}
CLOSES = ["close", "over"]
TEN_SCANS = "> INIT" + " SCAN" * 10


@scripts(
    {
        "a measurement before the scanner init": ({}, ["> SCAN END", *CLOSES, "!! a measurement before the scanner"]),
        "a close without END": ({}, ["> INIT", *CLOSES, "!! the vehicle closed without END: EOF"]),
        "the same in binary": (BINARY, ["> INIT", *CLOSES, "!! the vehicle closed without END: EOF"]),
        "a close within a message": (
            {},
            ["say 4|10", *CLOSES, "! the connection ended within a message: '4|10'", "! closed without END", "noted 2"],
        ),
        "a reset": ({}, ["reset", "over", "!! the vehicle closed without END: ConnectionResetError"]),
        "a message after END": ({}, ["> END INFO", *CLOSES, "!! a message after END: "]),
        "no close after END": (HURRIED, ["> END", "over", "!! the vehicle did not close within 0.05 s of both ENDs"]),
        "no answer to END": (HURRIED, ["begin_end", "over", "rest END", "!! no END within 0.05 s of the HQ's"]),
        "laser from a drive listener": (
            {"serves": "drive"},
            ["> INIT SCAN INFO END", *CLOSES, "! message 2 from a listener", "! message 1 from", "noted 2"],
        ),
        **{
            f"drive info from a listener of {serves}, to who does not drive": (
                {"serves": serves},
                ["> INIT SCAN INFO END", *CLOSES, "!! message 4 from a listener that does not serve it"],
            )
            for serves in ("laser", "auto")
        },
        "laser to who drives": (
            {**DRIVES, "serves": "auto", "flight_s": 0.0},
            ["reads GOOD", "> INFO INIT SCAN INFO", "infos 2", "! message 2 from", "! message 1 from", "noted 2"],
        ),
        "laser to who drives, that was on its way": (
            {**DRIVES, "serves": "auto", "flight_s": 60.0},
            ["reads GOOD", "> INIT SCAN INFO", "infos 1", "ok"],
        ),
        "drive info to the scanning program": (
            {"deployed": "scanning"},
            ["> INIT SCAN INFO SCAN END", *CLOSES, "!! message 4 taken as END, it shows nothing more: ", "scans 1"],
        ),
        "the laser to the scanning program, which sends no commands": (
            {**DRIVES, "deployed": "scanning"},
            ["> INIT SCAN SCAN", "scans 2", "cancel", "rest END", "ok"],
        ),
        "an integer over 2^31-1": (
            {},
            ["> INIT", "say 99999999999|1;", "died an integer over 2^31-1, 99999999999: '99999999999|1;'", "rest"],
        ),
    }
)
async def test_what_the_judge_says_of(options: dict[str, Any], steps: list[str]) -> None:
    await played(viewer(**options), *steps)


@scripts(
    {
        **{
            f"it stands at first and repeats its command for ever, {dialect}": (
                {**DRIVES, "dialect": dialect},
                ["< GOOD GOOD GOOD", f"drive 80 0 {angle} 1", "reads FORWARD FORWARD", "idle", "reads GOOD GOOD"],
            )
            for dialect, angle in (("text", 30), ("binary", 120))
        },
        **{
            f"it answers END, {dialect}": (
                {"dialect": dialect},
                ["> INIT SCAN INFO SCAN END", "rest END", *CLOSES, "ok", "scans 2", "infos 1"]
                + ["? END", "? the vehicle closed: EOF", "told 2"],
            )
            for dialect in DIALECTS
        },
        **{
            f"it ends with END and takes the answer, {dialect}": (
                {"dialect": dialect},
                ["begin_end", "< END", "> INFO END", "rest", *CLOSES, "end_ended", "begin_end", "end_ended", "infos 1"]
                + ["ok"],
            )
            for dialect in DIALECTS
        },
        "it leaves with END when cancelled": ({}, ["cancel", "rest END", "ok"]),
        "the driving program reads no more after ten measurements and goes on driving": (
            {**DRIVES, "deployed": "driving"},
            [TEN_SCANS, "say 1|broken;nan;", "> END", "scans 10", "reads GOOD GOOD", "fill", *CLOSES, "scans 10", "ok"]
            + ["? it reads no more, after 10 measurements"],
        ),
        "it ends although it reads no more": (
            {"stops_reading_after": 1},
            ["> INIT SCAN", "scans 1", "begin_end", "end_ended", "over", "rest END", "ok"],
        ),
    }
)
async def test_what_the_program_does(options: dict[str, Any], steps: list[str]) -> None:
    await played(viewer(**options), *steps)


@pytest.mark.parametrize(("name", "port", "scans"), [("alf-drive.hex", 16668, 0), ("alf-laser.hex", 16667, 6)])
async def test_the_captures_have_no_violation(name: str, port: int, scans: int) -> None:
    hq = FragileHq(repeat_s=None, serves="laser" if scans else "drive")
    await played(hq, f"> {stream(name, source=port).hex()}", *CLOSES, "ok")
    assert (hq.scans, len(hq.infos)) == (scans, 0 if scans else 6)
    assert [kind for _, kind, _ in hq.received] == ([2] + [1] * 6 if scans else [4] * 6) + [255]


async def test_it_repeats_every_20_ms() -> None:
    began = time.monotonic()
    await played(FragileHq(), "<" + " GOOD" * 11)
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


async def test_lists_are_bounded_and_every_violation_is_told() -> None:
    told: list[str] = []
    hq = await played(viewer(keep=3, note=told.append), "say " + "3|1;" * 10, "> INFO INFO INFO INFO END", *CLOSES)
    assert (len(hq.violations), len(hq.received), len(hq.infos), len(told)) == (3, 3, 3, 10)


async def test_the_program_logs_and_prints_what_it_died_of_and_nobody_listening_is_an_error(capsys, caplog) -> None:
    vehicle = Listening()
    task = asyncio.create_task(simulate_fragile_hq("127.0.0.1", vehicle.port, dialect="text", points=POINTS))
    async with asyncio.timeout(LONG_S):
        await vehicle.accept()
        await vehicle.send_bytes(b"3|1;4|nan;")
        await task
    vehicle.close()
    assert capsys.readouterr().out == "died: NaN: '4|nan;'\n"
    assert [record.message for record in caplog.records] == [
        "violation: id 3, which no vehicle sends: '3|1;'",
        "violation: NaN: '4|nan;'",
    ]
    with pytest.raises(ConnectionRefusedError):
        await viewer().run("127.0.0.1", vehicle.port)
