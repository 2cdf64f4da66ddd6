"""The fragile HQ against a vehicle written by hand: every byte here is read off the protocol page or a capture."""

import asyncio
import contextlib
from typing import Any

import pytest

from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.alf.conformance.parser import Dialect
from gateways.alf.conformance.parser import VehicleReader as Reader
from tests.captures import stream
from tests.conformance.scene import LONG_S, Listening, calling, until
from tests.gateways.alf.conformance.scene import DIALECTS, MESSAGES, AlfScene, conversations

POINTS = 5
"""Of a measurement in most tests."""
INFO = MESSAGES["INFO"]["text"]
SCAN_BYTES, INFO_BYTES = MESSAGES["SCAN"]["binary"], MESSAGES["INFO"]["binary"]
STANDARD = "not written as std::to_string prints numbers"


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
        (b"1|7|5000|0|-1|20.0|5600|3|1|4;", STANDARD),
        (b"2|-135|119.882812|0.351562|100|20|5600;", STANDARD),
        (INFO.replace(b"0.250000", b"0.25"), STANDARD),
        (INFO.replace(b"0.250000", b"2.5e-01"), "9 fields instead of 8"),
        (INFO.replace(b"0.250000", b"inf"), "7 fields instead of 8"),
        (INFO.replace(b"4|10", b"4|010"), STANDARD),
        (b"\n" + INFO, STANDARD),
        (b"3|0|0|0|0;", "id 3, which no vehicle sends"),
        (b"hello;", "a message without an id"),
        (b"255|2;", "end 2 instead of 1"),
        (SCAN_BYTES[:-4] + b"\5\0\0\0", "valid indices 1 and 5 of 5 points"),
        (INFO_BYTES[:-4] + bytes.fromhex("0000807f"), "an infinite number"),
        (b"\xff\x02", "end 2 instead of 1"),
        (b"1|7|5000|0|-1|20|5600|3|3|1|4;", "deadly: 6 points instead of 5"),
        (b"1|2147483648|5000|0|-1|20|5600|3|1|4;", "deadly: an integer over 2^31-1, 2147483648"),
        (b"1|7|5000|0|-1|" + b"9" * 5000 + b"|5600|3|1|4;", "deadly: an integer over 2^31-1, 99999999999999999999"),
        (INFO.replace(b"-0.500000", b"-.500000"), "deadly: a number without leading digit, -.500000"),
        (INFO.replace(b"0.250000", b"-NaN"), "deadly: NaN"),
        (b"1|" * 40_000, "deadly: a message without end, 80000 bytes"),
        (INFO_BYTES[:-4] + bytes.fromhex("0000c07f"), "deadly: NaN"),
        (b"\x01\0\0\0\x80" + SCAN_BYTES[5:], "deadly: an integer over 2^31-1, 2147483648"),
        (SCAN_BYTES[:9] + b"\0\0\0\x80\0\0\0\0" + SCAN_BYTES[17:], "deadly: an integer over 2^31-1, 2147483648"),
        (b"\x03\0\0\x5a\0", "deadly: id 3, which no vehicle sends: the framing is lost"),
    ],
)
def test_what_is_wrong_in_a_message_is_told_and_whether_it_breaks_an_hq(data: bytes, problem: str) -> None:
    (told,) = Reader("text" if data[-1:] in b";|" else "binary", POINTS).take(data)
    assert (told.deadly, told.problem) == (problem.startswith("deadly: "), problem.removeprefix("deadly: "))


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


def viewer(dialect: Dialect = "text", **options: Any) -> FragileAlfHq:
    """An HQ that sends nothing, of 5 points."""
    return FragileAlfHq(dialect=dialect, **{"points": POINTS, "repeat_s": None, "serves": "both", **options})


async def played(hq: FragileAlfHq, *steps: str) -> FragileAlfHq:
    """The HQ after a conversation."""
    peer = Listening()
    async with calling(hq, peer, Vehicle) as scene, asyncio.timeout(LONG_S):
        await peer.accept()
        await hq.connected.wait()
        await scene.play(list(steps))
    return hq


OPTIONS: dict[str, dict[str, Any]] = {
    "binary": {"dialect": "binary"},
    "hurried": {"answer_s": 0.05},
    "driving": {"repeat_s": 0.002},
    **{serves: {"serves": serves} for serves in ("auto", "drive", "laser")},
    "late": {"flight_s": 0.0},
    "early": {"flight_s": 60.0},
    **{f"{deployed}_program": {"deployed": deployed} for deployed in ("driving", "scanning")},
    "one_scan": {"stops_reading_after": 1},
}


@conversations(
    """
a measurement before the scanner init: > SCAN END / close / over / !! a measurement before the scanner init
a close without END: > INIT / close / over / !! the vehicle closed without END: EOF
a close within a message: say 4|10 / close / over / ! the connection ended within a message: '4|10'
    / ! the vehicle closed without END / noted 2
a reset: reset / over / !! the vehicle closed without END: ConnectionResetError
a message after END: > END INFO / close / over / !! a message after END:
no close after END [hurried]: > END / over / !! the vehicle did not close within 0.05 s of both ENDs
no answer to END [hurried]: begin_end / over / rest END / !! no END within 0.05 s of the HQ's
the laser from a drive listener [drive]: > INIT SCAN INFO END / close / over / ! message 2 from a listener
    / ! message 1 from a listener / noted 2
drive info from a laser listener [laser]: > INIT SCAN INFO END / close / over / !! message 4 from a listener
drive info to who does not drive [auto]: > INIT SCAN INFO END / close / over / !! message 4 from a listener
the laser to who drives [driving, auto, late]: reads GOOD / > INFO INIT SCAN INFO / infos 2 / ! message 2 from
    / ! message 1 from / noted 2
the laser to who drives, on its way [driving, auto, early]: reads GOOD / > INIT SCAN INFO / infos 1 / ok
drive info to the scanning program [scanning_program]: > INIT SCAN INFO SCAN END / close / over / scans 1
    / !! message 4 taken as END, it shows nothing more:
the laser to the scanning program, which sends no commands [scanning_program, driving]: > INIT SCAN SCAN / scans 2
    / cancel / rest END / ok
an integer over 2^31-1: > INIT / say 99999999999|1; / died an integer over 2^31-1, 99999999999: '99999999999|1;' / rest
""",
    **OPTIONS,
)
async def test_what_the_judge_says_of(options: dict[str, Any], steps: list[str]) -> None:
    await played(viewer(**options), *steps)


@conversations(
    """
stands at first and repeats its command for ever [driving]: < GOOD GOOD GOOD / drive 80 0 30 1 / reads FORWARD FORWARD
    / idle / reads GOOD GOOD
stands at first and repeats its command for ever [driving, binary]: < GOOD GOOD / drive 80 0 120 1
    / reads FORWARD FORWARD
answers END: > INIT SCAN INFO SCAN END / rest END / close / over / ok / scans 2 / infos 1 / ? END
    / ? the vehicle closed: EOF / told 2
answers END [binary]: > INIT SCAN END / rest END / close / over / ok
ends with END and takes the answer: begin_end / < END / > INFO END / rest / close / over / end_ended / infos 1 / ok
    / begin_end / end_ended
ends with END and takes the answer [binary]: begin_end / < END / > INFO END / rest / close / over / end_ended / ok
leaves with END when cancelled: cancel / rest END / ok
reads no more after ten measurements and continues driving [driving_program, driving]:
    > INIT SCAN SCAN SCAN SCAN SCAN SCAN SCAN SCAN SCAN SCAN / say 1|broken;nan; / > END / scans 10 / reads GOOD GOOD
    / fill / close / over / scans 10 / ok / ? it reads no more, after 10 measurements
ends although it reads no more [one_scan]: > INIT SCAN / scans 1 / begin_end / end_ended / over / rest END / ok
""",
    **OPTIONS,
)
async def test_the_program(options: dict[str, Any], steps: list[str]) -> None:
    await played(viewer(**options), *steps)


@pytest.mark.parametrize(("name", "port", "scans"), [("alf-drive.hex", 16668, 0), ("alf-laser.hex", 16667, 6)])
async def test_the_captures_have_no_violation(name: str, port: int, scans: int) -> None:
    hq = FragileAlfHq(repeat_s=None, serves="laser" if scans else "drive")
    await played(hq, f"> {stream(name, source=port).hex()}", "close", "over", "ok")
    assert (hq.scans, len(hq.infos)) == (scans, 0 if scans else 6)
    assert [kind for _, kind, _ in hq.received] == ([2] + [1] * 6 if scans else [4] * 6) + [255]


def test_it_is_no_other_hq_and_sends_nothing_that_none_sends() -> None:
    for options in ({"dialect": "morse"}, {"serves": "tea"}):
        with pytest.raises(ValueError, match="no such HQ"):
            FragileAlfHq(**options)  # type: ignore[arg-type]
    for hq, *command in ((viewer(), 256), (viewer(), 0, 2), (viewer(), 0, 0, 91), (viewer("binary"), 0, 0, -1)):
        with pytest.raises(ValueError, match="speed"):
            hq.drive(*command)


async def test_lists_are_bounded_and_every_violation_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FragileAlfHq, "KEEP", 3)
    hq, told = viewer(), list[str]()
    hq.note = told.append
    await played(hq, "say " + "3|1;" * 10, "> INFO INFO INFO INFO END", "close", "over")
    assert (len(hq.violations), len(hq.received), len(hq.infos), len(told)) == (3, 3, 3, 10)


async def test_the_program_logs_and_prints_what_it_died_of_and_nobody_listening_is_an_error(capsys, caplog) -> None:
    vehicle = Listening()
    task = asyncio.create_task(
        FragileAlfHq(points=POINTS, serves="both", deployed="driving").simulate("127.0.0.1", vehicle.port, None)
    )
    async with asyncio.timeout(LONG_S):
        await vehicle.accept()
        await vehicle.send_bytes(b"3|1;4|nan;")
        await task
    vehicle.close()
    assert capsys.readouterr().out.endswith("\ndied: NaN: '4|nan;'\n")
    assert [record.message for record in caplog.records] == [
        "violation: id 3, which no vehicle sends: '3|1;'",
        "violation: NaN: '4|nan;'",
    ]
    with pytest.raises(ConnectionRefusedError):
        await viewer().run("127.0.0.1", vehicle.port)
