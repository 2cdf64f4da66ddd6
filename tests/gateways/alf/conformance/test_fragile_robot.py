"""The fragile vehicle against a small HQ written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import math
import random
import re
import socket
import struct
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.alf.conformance import parser
from gateways.alf.conformance.fragile_robot import FragileVehicle, simulate_fragile
from gateways.alf.conformance.machine import Machine
from gateways.alf.conformance.parser import Dialect, Repeats, Scale, Times
from tests.conformance.scene import LONG_S, Peer, Scene, Script, scripts, serving, until

QUICK = Times(
    cycle_s=0.005, scan_s=0.02, info_s=0.05, first_s=5, gap_s=5, window_commands=0, flight_s=0.05, answer_s=0.15,
    close_s=0.15,
)  # fmt: skip
"""As quick as a test, and patient where the rhythm is not what it is about."""
NAMES: dict[str, dict[str, str]] = {
    "text": {"GOOD": b"3|0|0|0|0;".hex(), "FORWARD": b"3|80|0|30|1;".hex(), "END": b"255|1;".hex()},
    "binary": {"GOOD": "03 00 00 5a 00", "FORWARD": "03 50 00 78 01", "END": "ff 01"},
}
SIZES = {1: 1 + 4 + 4 + 769 * 8 + 4 + 4, 2: 1 + 3 * 4 + 3 * 4, 4: 1 + 1 + 6 * 2 + 4, 255: 2}
DIALECTS: tuple[Dialect, ...] = ("text", "binary")
LASER: dict[str, Any] = {"laser": True, "drive": False}
BOTH: dict[str, Any] = {"laser": True}
BINARY: dict[str, Any] = {"dialect": "binary"}


class Hq(Scene):
    """The few habits of an HQ that behaves."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.dialect = "text" if self.judge is None else self.judge.dialect

    def raw(self, text: str) -> bytes:
        return b"".join(bytes.fromhex(NAMES[self.dialect].get(word, word)) for word in text.split())

    async def say(self, text: str) -> None:
        """Send a text as it stands."""
        await self.peer.send_bytes(text.encode("latin-1"))

    async def repeat(self, data: bytes, seconds: float, every: float = 0.02) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            await self.peer.send_bytes(data)
            await asyncio.sleep(every)

    async def send_until_noted(self, text: str) -> None:
        """Send it again and again: nobody knows how late the vehicle's own time is."""
        async with asyncio.timeout(LONG_S):
            while not self.judge.violations:
                await self.send(text)
                await asyncio.sleep(QUICK.cycle_s)

    async def read(self) -> list[str]:
        """Read the fields of a text message, the id first."""
        data = b""
        while not data.endswith(b";"):
            data += await self.peer.read(1)
        return data[:-1].decode("ascii").split("|")

    async def read_binary(self) -> bytes:
        head: bytes = await self.peer.read(1)
        return head + bytes(await self.peer.read(SIZES[head[0]] - 1))

    async def kind(self, kind: str) -> None:
        """Read until a message of this id."""
        while True:
            first = int((await self.read())[0]) if self.dialect == "text" else (await self.read_binary())[0]
            if first == int(kind):
                return

    async def ended(self, _: str) -> None:
        with pytest.raises((EOFError, ConnectionError)):
            await self.kind("255")

    async def begin_end(self, _: str) -> None:
        self.ending = asyncio.create_task(self.judge.end())
        await asyncio.sleep(0)

    async def end_ended(self, _: str) -> None:
        await self.ending

    async def said(self, violations: str) -> None:
        assert self.judge.violations == [violations]

    async def noted(self, count: str) -> None:
        assert len(self.judge.violations) == int(count)
        assert self.judge.alive


@contextlib.asynccontextmanager
async def connected(vehicle: FragileVehicle) -> AsyncIterator[Hq]:
    async with serving(vehicle, Peer, Hq) as hq:
        await hq.connect("")
        yield hq


def quick(dialect: Dialect = "text", **options: Any) -> FragileVehicle:
    return FragileVehicle(dialect, **{"laser": False, "drive": True, "times": QUICK, **options})


CLOSED = "? the HQ closed the connection after END"
STANDARD = "not written as std::to_string prints integers"
NOTED: dict[str, Script] = {
    **{
        text: ({}, ["> GOOD", f"say {text}", "> GOOD", "heard 3", f"!! {words}"])
        for text, words in (
            ("3|101|0|0|0;", "speed 101 instead of 0..100: '3|101|0|0|0;'"),
            ("3|255|0|0|0;", "speed 255 instead of 0..100"),
            ("3|-1|0|0|0;", "speed -1 instead of 0..100"),
            ("3|0|2|0|0;", "direction 2 instead of 0..1"),
            ("3|0|-1|0|0;", "direction -1 instead of 0..1"),
            ("3|0|0|91|0;", "steering angle 91 instead of -90..90"),
            ("3|0|0|-91|0;", "steering angle -91 instead of -90..90"),
            ("3|0|0|0|2;", "light 2 instead of 0..1"),
            ("3|0|0|0;", "3 fields instead of 4"),
            ("3|0|0|0|0|0;", "5 fields instead of 4"),
            ("3;", "0 fields instead of 4"),
            ("3|0.000000|0|0|0;", f"{STANDARD}: '3|0.000000|0|0|0;'"),
            ("\n3|0|0|0|0;", rf"{STANDARD}: '\n3|0|0|0|0;'"),
            ("\xff3|0|0|0|0;", rf"{STANDARD}: '\xff3|"),
            *(
                (text, STANDARD)
                for text in (
                    *("3|+1|0|0|0;", "3|01|0|0|0;", "3|0|0|-0|0;", "3|0|0|0|true;", "3|0|0|0|0|;", "3|0||0|0;"),
                    *("3|1e2|0|0|0;", "3 0 0 0 0;", "3|nan|0|0|0;"),
                )
            ),
            (";", "a message without a number: ';'"),
            ("hello;", "a message without a number: 'hello;'"),
            *(
                (text, f"id {text.rstrip(';').split('|')[0]}, of which this server knows nothing")
                for text in ("1|0|0|1|0|0;", "2|0|0|0|0|0|0;", "4|0|0|0|0|0|0|0|0;", "0;", "-3|0|0|0|0;")
            ),
        )
    },
    **{
        text: (BINARY, [f"> GOOD {text} GOOD", "heard 3", f"said {words}: {text}", "noted 1"])
        for text, words in (
            ("03 00 02 5a 00", "direction 2 instead of 0..1"),
            ("03 00 00 b5 00", "steering angle 181 instead of 0..180"),
            ("03 00 00 5a 02", "light 2 instead of 0..1"),
        )
    },
    **{
        f"the largest integers, {name}": ({}, ["> GOOD", f"say {text}", "heard 2", "noted 1"])
        for name, text in (
            ("positive", "3|2147483647|0|0|0;"),
            ("negative", "3|0|0|-2147483648|0;"),
            ("of 5000 digits", "3|" + "0" * 5000 + "|0|0|0;"),
        )
    },
    "another full scale": (
        {"speed_full": 255},
        ["> GOOD", "say 3|255|0|0|0;3|256|0|0|0;", "!! speed 256 instead of 0..255"],
    ),
    **{
        f"a first command that drives, {dialect}": (
            {"dialect": dialect},
            ["> FORWARD FORWARD", "!! the first command has speed 80: "],
        )
        for dialect in DIALECTS
    },
    "a drive command to a text laser": (LASER, ["> GOOD", "! id 3, of which this server knows nothing: '3|0|0|0|0;'"]),
    **{
        f"a bad end, {name}, which is an end": ({"dialect": dialect}, [f"> {data}", "kind 255", f"!! {words}"])
        for name, dialect, data, words in (
            ("0", "text", b"255|0;".hex(), "end 0 instead of 1: '255|0;'"),
            ("nothing", "text", b"255;".hex(), "0 fields instead of 1: '255;'"),
            ("two fields", "text", b"255|1|1;".hex(), "2 fields instead of 1"),
            ("0 in binary", "binary", "ff 00", "end 0 instead of 1: ff 00"),
        )
    },
    **{
        f"messages after END, {dialect}": (
            {"dialect": dialect},
            ["> END GOOD", f"! a message after END: {good}", "> END", f"! a message after END: {end}", "noted 2"],
        )
        for dialect, good, end in (("text", "'3|0|0|0|0;'", "'255|1;'"), ("binary", "03 00 00 5a 00", "ff 01"))
    },
    "no close after END": ({}, ["> END", "! the HQ did not close within 0.15 s of its END"]),
    "no answer to the vehicle's END": (
        {},
        ["kind 4", "begin_end", "end_ended", "said no END within 0.15 s of the vehicle's"],
    ),
    "a close instead of an answer": (
        {},
        ["kind 4", "begin_end", "kind 255", "close", "end_ended", "said the HQ closed without answering END"],
    ),
    "an answer without a close": (
        {},
        ["kind 4", "begin_end", "kind 255", "> END", "end_ended", "said the HQ did not close within 0.15 s of its END"],
    ),
    "commands long after the vehicle's END": (
        {},
        ["kind 4", "begin_end", "kind 255", "send_until_noted GOOD"]
        + ["! s after the vehicle's END: '3|0|0|0|0;'", "end_ended"],
    ),
    "a close within a text": ({}, ["> GOOD", "say 3|0|0|", "close", "! the connection ended within a message: "]),
    "a close within a binary message": (
        BINARY,
        ["> GOOD 030000", "close", "! the connection ended within a message: "],
    ),
}


@scripts(NOTED)
async def test_what_is_noted_and_survived(options: dict[str, Any], steps: list[str]) -> None:
    async with connected(quick(**options)) as hq:
        await hq.play(steps)
        assert hq.judge.alive


@scripts(
    {
        "speeds above 100 in binary are an event": (
            BINARY,
            ["> GOOD 0365005a00 0365005a00 0365005a00", "heard 4", "ok"] + ["? speed 101 counts as 100"],
        ),
        **{
            f"an END of the HQ is answered and this side closed, {dialect}, laser {laser}": (
                {"dialect": dialect, "laser": laser, "drive": not laser},
                ["> END", "kind 255", "ended", "close", CLOSED, "ok"],
            )
            for dialect in DIALECTS
            for laser in (False, True)
        },
        "an HQ may close right after its END": (BOTH, ["wait 0.05", "> GOOD END", "close", CLOSED, "ok"]),
        **{
            f"an HQ that shuts its side is answered still, {dialect}": (
                {"dialect": dialect},
                ["> END", "shut", "kind 255", "ok"],
            )
            for dialect in DIALECTS
        },
        "an END while driving is an event": (
            {},
            ["say 3|0|0|0|0;3|40|0|0|0;255|1;", "? END while the last command had speed 40"],
        ),
        **{
            f"its own END is answered and followed by the close, {dialect}": (
                {"dialect": dialect},
                # a command is in flight; afterwards there is nothing to end
                ["> GOOD", "heard 1", "begin_end", "> GOOD", "kind 255", "> END", "close", "end_ended", "ok"]
                + ["begin_end", "end_ended"],
            )
            for dialect in DIALECTS
        },
        "a close without END is an event, and the motor stops": (
            {},
            ["> GOOD FORWARD", "close", "? the HQ closed the connection without END: "]
            + ["? the motor stopped by itself, moving", "ok"],
        ),
        "a connection that breaks is an event": (
            BOTH,
            ["> GOOD", "reset", "? the HQ closed the connection without END: ConnectionResetError", "ok"],
        ),
        "many connections are bounded": ({}, ["crowd 20"]),
        "an HQ that reads nothing is an event": (
            {**BINARY, **LASER, "times": Times(cycle_s=0.005, scan_s=0.0, first_s=50, send_s=0.1), "points": 100_000},
            ["? the HQ read nothing for 0.1 s", "ok"],
        ),
        "a laser expects no commands": (
            {**LASER, "times": Times(first_s=0.05, gap_s=0.05, window_s=0.1)},
            ["wait 0.3", "kind 1", "quiet"],
        ),
    }
)
async def test_what_an_hq_may_do(options: dict[str, Any], steps: list[str]) -> None:
    async with connected(quick(**options)) as hq:
        await hq.play(steps)


@scripts(
    {
        **{
            words: ({}, ["> GOOD", f"say {text}", f"died {words}", "ended", "refused"])
            for text, words in (
                ("3|2147483648|0|0|0;", "an integer over 2^31-1, 2147483648"),
                ("3|0|0|-2147483649|0;", "an integer over 2^31-1, -2147483649"),
                ("3|0|0|0|" + "9" * 5000 + ";", "an integer over 2^31-1, 99999999999999999999"),
                ("99999999999|1;", "an integer over 2^31-1"),
                ("3|.5|0|0|0;", "a number without leading digit, .5"),
                ("3|0|0|-.5|0;", "a number without leading digit, -.5"),
                ("3|" * 32769, "a message without end, 65538 bytes"),
            )
        },
        **{
            f"{data}, laser {laser}": ({**BINARY, "laser": laser, "drive": not laser}, [f"> {data}", f"died {words}"])
            for laser, data, words in (
                (False, "00", "id 0, of which this server knows nothing: the framing is lost: 00"),
                (False, "01", "id 1,"),
                (False, "02", "id 2,"),
                (False, "04", "id 4,"),
                (False, "33 7c", "id 51, of which this server knows nothing: the framing is lost: 33 7c"),
                (False, "03 00 00 5a 00 00", "id 0,"),
                (False, "03 00 00 5a 03 00 00 5a 00", "id 0,"),
                (True, "03 00 00 5a 00", "id 3,"),
            )
        },
    }
)
async def test_it_dies_of(options: dict[str, Any], steps: list[str]) -> None:
    async with connected(quick(**options)) as hq:
        await hq.play(steps)


# An HQ that behaves


@pytest.mark.parametrize("laser", [False, True])
@pytest.mark.parametrize("dialect", DIALECTS)
async def test_an_hq_that_behaves_is_not_reproached(dialect: Dialect, laser: bool) -> None:
    vehicle = FragileVehicle(dialect, laser=laser, drive=True, times=Times(window_s=0.4, window_commands=10))
    async with connected(vehicle) as hq:
        await hq.repeat(hq.raw("GOOD"), 0.1)
        await hq.repeat(hq.raw("FORWARD"), 0.4)
        await hq.repeat(hq.raw("GOOD"), 0.1)
        await hq.play(["> END", "kind 255", "close", CLOSED])
    assert vehicle.violations == []
    assert [event for event in vehicle.events if "motor" not in event] == vehicle.events[:1]
    straight, right = ((0, 0, 0, 0), (80, 0, 30, 1)) if dialect == "text" else ((0, 0, 90, 0), (80, 0, 120, 1))
    kinds = [(kind, fields) for _, kind, fields in vehicle.received]
    assert kinds[0] == (3, straight)
    assert kinds.count((3, right)) > 3
    assert kinds[-1] == (255, (1,))
    stamps = [seconds for seconds, _, _ in vehicle.received]
    assert stamps == sorted(stamps)


async def test_the_recorded_hq_is_not_reproached() -> None:
    """Stretches of ``alf-drive.hex``: seconds between segments, and messages in a segment."""
    idle = [(0.0201, 1)] * 14 + [(0.0202, 1), (0.0422, 2), (0.0182, 1)]
    driving = [(0.0201, 1)] * 6 + [(0.0416, 2), (0.0189, 1), (0.0202, 1), (0.0201, 1), (0.0407, 2)]
    driving += [(0.044, 2)] * 5 + [(0.044, 3), (0.0439, 2), (0.0363, 2)]
    vehicle = FragileVehicle("text", laser=False, drive=True)
    async with connected(vehicle) as hq:
        for name, segments in (("GOOD", idle), ("FORWARD", driving)):
            for seconds, count in segments:
                await hq.peer.send_bytes(hq.raw(name) * count)
                await asyncio.sleep(seconds)
        await hq.play(["begin_end", "kind 255", "> END", "close", "end_ended", "ok"])
    assert [kind for _, kind, _ in vehicle.received] == [3] * (18 + 30) + [255]


async def test_a_message_may_be_split_anywhere_and_many_may_share_a_read() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.peer.send_bytes(hq.raw("GOOD") * 100)
        for number in hq.raw("FORWARD"):
            await hq.peer.send_bytes(bytes([number]))
            await asyncio.sleep(0.006)
        await hq.play(["heard 101", "ok"])
    assert [fields for _, _, fields in vehicle.received] == [(0, 0, 0, 0)] * 100 + [(80, 0, 30, 1)]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_cut_does_not_depend_on_the_reads(dialect: Dialect) -> None:
    messages = [bytes.fromhex(NAMES[dialect][name]) for name in ("GOOD", "FORWARD", "END")]
    data = b"".join(messages)
    for size in range(1, len(data)):
        reader = parser.reader(dialect, {3, 255}, 100)
        heard = [one for at in range(0, len(data), size) for one in reader.take(data[at : at + size])]
        assert [one.raw for one in heard] == messages
        assert not any(one.problem for one in heard)
        assert reader.rest == b""


# What it says


async def test_a_laser_says_its_geometry_first_and_then_measures() -> None:
    async with connected(quick(**LASER)) as hq:
        assert await hq.read() == ["2", "-135.000000", "119.882812", "0.351562", "100", "20", "5600"]
        scans = [await hq.read() for _ in range(3)]
    assert {len(scan) for scan in scans} == {1 + 2 + 769 + 2}
    assert [scan[:2] for scan in scans] == [["1", "0"], ["1", "1"], ["1", "2"]]
    stamps = [int(scan[2]) for scan in scans]
    assert stamps == sorted(stamps)
    for scan in scans:
        assert scan[-2:] == ["44", "725"]
        assert all(point.isdigit() and int(point) <= 5600 for point in scan[3:-2])
        assert any(int(point) >= 20 for point in scan[3 + 44 : 3 + 726])


async def test_a_binary_laser_has_the_widths_of_the_document() -> None:
    async with connected(quick("binary", **LASER)) as hq:
        init = await hq.read_binary()
        assert init == b"\x02" + struct.pack("<3f3i", -135.0, -135.0 + 725 * 360 / 1024, 360 / 1024, 100, 20, 5600)
        for sequence in range(2):
            scan = await hq.read_binary()
            assert struct.unpack_from("<BI", scan) == (1, sequence)
            assert struct.unpack_from("<II", scan, len(scan) - 8) == (44, 725)
            assert all(0 <= point <= 5600 for point in struct.unpack_from("<769q", scan, 9))


async def test_a_drive_server_tells_how_it_moves() -> None:
    async with connected(quick()) as hq:
        infos = [await hq.read() for _ in range(2)]
    assert all(re.fullmatch(r"4\|\d+(\|-?\d+\.\d{6}){7}", "|".join(info)) for info in infos)
    assert infos[0][1] == "0"
    assert infos[0][4] == "1.000000"
    async with connected(quick("binary", scale=Scale(counts_per_g=256.0))) as hq:
        assert struct.unpack("<BB6hf", await hq.read_binary())[:8] == (4, 0, 0, 0, 256, 0, 0, 0)


async def test_at_its_own_pace_it_measures_ten_times_a_second() -> None:
    async with connected(FragileVehicle("text", laser=True, drive=False)) as hq:
        assert (await hq.read())[0] == "2"
        start = time.monotonic()
        assert [(await hq.read())[0] for _ in range(5)] == ["1"] * 5
        assert time.monotonic() - start > 0.4


# How it moves


def machine() -> Machine:
    made = Machine(random.Random(1))
    made.place.x = made.place.y = made.place.heading = 0.0
    return made


@pytest.mark.parametrize(
    ("dialect", "command", "side"),
    [
        ("text", (100, 0, -90, 0), 1),
        ("text", (100, 0, 0, 0), 0),
        ("text", (100, 0, 90, 0), -1),
        ("binary", (100, 0, 0, 0), 1),
        ("binary", (100, 0, 90, 0), 0),
        ("binary", (100, 0, 180, 0), -1),
    ],
)
def test_it_steers_as_the_dialect_says(dialect: Dialect, command: tuple[int, ...], side: int) -> None:
    car = machine()
    car.obey(dialect, command)
    for _ in range(25):
        car.step(0.02)
    assert car.place.x > 0.1
    assert (car.place.heading > 0.01) - (car.place.heading < -0.01) == side
    lateral = car.feel("text", Scale())[2]
    assert (lateral > 0.01) - (lateral < -0.01) == -side


def test_direction_1_is_backwards_and_light_1_is_on() -> None:
    car = machine()
    car.obey("text", (50, 1, 0, 1))
    car.step(0.02)
    assert car.light
    assert car.place.x < 0
    assert car.feel("text", Scale())[1] < 0


@pytest.mark.parametrize(("dialect", "times"), [("text", 2.55), ("binary", 1.0)])
def test_speed_255_is_clamped_in_binary_only(dialect: Dialect, times: float) -> None:
    speeds = []
    for speed in (100, 255):
        car = machine()
        car.obey(dialect, (speed, 0, 0 if dialect == "text" else 90, 0))
        car.step(0.02)
        speeds.append(car.place.x)
    assert math.isclose(speeds[1], speeds[0] * times)


async def test_the_motor_stops_after_twenty_cycles_and_any_message_applies_the_stale_command() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.play(["> GOOD FORWARD", "? 20 cycles without a command: the motor stopped by itself, moving"])
        assert not vehicle.machine.moving
        await hq.say("7|1;")
        await until(lambda: vehicle.machine.moving, vehicle)
        await until(lambda: len(vehicle.events) == 2, vehicle.events)
    assert vehicle.violations == ["id 7, of which this server knows nothing: '7|1;'"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_random_bytes_never_make_the_judge_raise(dialect: Dialect) -> None:
    rng = random.Random(5)
    for _ in range(300):
        reader = parser.reader(dialect, {3, 255}, 100)
        for one in reader.take(bytes(rng.choices(b"0123459|;.-\xff\x03", k=60))):
            assert one.raw


# The rhythm of the commands


@pytest.mark.parametrize("each", [1, 2])
def test_a_command_every_20_or_40_ms_is_no_violation(each: int) -> None:
    repeats = Repeats(Times())
    assert [repeats.cycle(0.02, int(cycle % each == 0)) for cycle in range(500)] == [""] * 500


def test_a_gap_is_noted_once_and_the_first_command_has_more_time() -> None:
    repeats = Repeats(Times())
    assert [repeats.cycle(0.02, 1) for _ in range(5)] == [""] * 5
    told = [repeats.cycle(0.02, 0) for _ in range(100)]
    assert [(cycle, text) for cycle, text in enumerate(told) if text] == [(5, "no drive command for 0.12 s")]
    assert [repeats.cycle(0.02, 1) for _ in range(100)] == [""] * 100
    assert round(repeats.longest_s, 2) == 2.02
    repeats = Repeats(Times())
    told = [repeats.cycle(0.02, 0) for _ in range(20)]
    assert [(cycle, text) for cycle, text in enumerate(told) if text] == [(12, "no drive command for 0.26 s")]


def test_a_slow_rhythm_is_noted_every_second() -> None:
    repeats = Repeats(Times(cycle_s=0.03125))
    told = [repeats.cycle(0.03125, int(cycle % 2 == 0)) for cycle in range(64)]
    assert [text for text in told if text] == ["16 drive commands in 1.00 s"] * 2


async def test_an_hq_that_says_nothing_is_noted() -> None:
    async with connected(quick(times=Times(first_s=0.06))) as hq:
        await hq.violated("no drive command for 0.")


async def test_an_hq_that_stops_repeating_is_noted() -> None:
    async with connected(quick(times=Times())) as hq:
        await hq.repeat(hq.raw("GOOD"), 0.1)
        await hq.violated("no drive command for 0.")
        await hq.happened("20 cycles without a command: the motor stopped by itself, at rest")
        assert len(hq.judge.violations) == 1


async def test_an_hq_that_repeats_every_60_ms_is_noted() -> None:
    async with connected(quick(times=Times(gap_s=5, window_s=0.4, window_commands=10))) as hq:
        repeating = asyncio.create_task(hq.repeat(hq.raw("GOOD"), LONG_S, every=0.06))
        await hq.violated("drive commands in 0.4")
        repeating.cancel()


def stall(seconds: float) -> None:
    """Keep the whole process from running."""
    time.sleep(seconds)


async def test_a_process_that_is_late_itself_reproaches_nobody() -> None:
    async with connected(quick(times=Times())) as hq:
        repeating = asyncio.create_task(hq.repeat(hq.raw("GOOD"), LONG_S))
        for _ in range(2):
            stall(0.25)
            await asyncio.sleep(0.08)
        repeating.cancel()
        await hq.ok("")


async def test_a_gap_names_the_lateness_of_the_process() -> None:
    async with connected(quick(times=Times(gap_s=0.05))) as hq:
        await hq.play(["> GOOD", "heard 1"])
        stall(0.2)
        await hq.violated(" s (this process woke ")


# END, and its one connection


async def test_an_end_is_answered_behind_the_measurement_that_is_being_sent() -> None:
    times = Times(cycle_s=0.005, scan_s=0.0, close_s=LONG_S)
    vehicle = FragileVehicle("binary", laser=True, drive=False, times=times, points=1_000_000)
    async with connected(vehicle) as hq:
        await hq.play(["wait 0.3", "> END", "heard 1"])
        assert vehicle.received[0][1:] == (255, (1,))
        stream = await hq.peer.read_to_the_end()
        scans, rest = divmod(len(stream) - SIZES[2] - 2, 1 + 8 + 8 * 1_000_000 + 8)
        assert (scans, rest) == (1, 0)
        assert stream.endswith(struct.pack("<II", 1_000_000 * 44 // 769, 1_000_000 * 725 // 769) + hq.raw("END"))
        await hq.ok("")


async def test_nothing_is_ended_before_anybody_came() -> None:
    await quick().end()


async def test_it_leaves_with_end_when_it_is_cancelled() -> None:
    async with connected(quick()) as hq:
        await hq.read()
        hq.task.cancel()
        await hq.kind("255")
        with pytest.raises(EOFError):
            await hq.read()


async def test_it_leaves_without_a_word_when_it_is_cancelled_within_a_measurement() -> None:
    times = Times(cycle_s=0.005, scan_s=0.0)
    async with connected(FragileVehicle("binary", laser=True, drive=False, times=times, points=1_000_000)) as hq:
        await asyncio.sleep(0.3)
        hq.task.cancel()
        said = await hq.peer.read_to_the_end()
        assert said
        assert not said.endswith(hq.raw("END"))


@pytest.mark.parametrize("after", ["connected", "over"])
async def test_a_second_connection_is_accepted_and_never_answered(after: str) -> None:
    vehicle = quick(laser=True)
    async with connected(vehicle) as hq:
        await hq.read()
        if after == "over":
            await hq.play(["close", "? the HQ closed the connection without END"])
        await hq.play(["again", "> GOOD", f"? while {after}", "nothing", "ok"])
        assert vehicle.events[-1].startswith("second connection, from 127.0.0.1:")
        assert vehicle.received == []


async def test_a_connection_can_be_cut_and_the_other_server_goes_on() -> None:
    drive = quick()
    laser = quick(**LASER, machine=drive.machine)
    async with connected(drive) as hq, connected(laser) as eye:
        await eye.kind("1")
        await laser.cut()
        await eye.play(["ended", "ok", "? the vehicle cut the connection"])
        await hq.play(["> GOOD FORWARD", "heard 2", "quiet"])


async def test_what_is_kept_is_bounded() -> None:
    noted: list[str] = []
    vehicle = quick(keep=2, note=noted.append)
    async with connected(vehicle) as hq:
        await hq.say("7;8;9;3|0|0|0|0;")
        await until(lambda: vehicle.received and vehicle.received[-1][1] == 3, vehicle.received)
        assert len(vehicle.violations) == len(vehicle.received) == 2
        assert len(noted) == 3


# As a process


async def simulating(laser_port: int | None, dialect: Dialect = "text") -> "tuple[Hq, Hq | None]":
    ports: asyncio.Future[tuple[int, int | None]] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(
        simulate_fragile(
            "127.0.0.1",
            0,
            dialect=dialect,
            laser_port=laser_port,
            seed=3,
            ready=lambda drive, laser: ports.set_result((drive, laser)),
            times=QUICK,
        )
    )
    drive, laser = await ports
    scenes = [Hq(None, Peer(port), task) for port in (drive, laser) if port]
    for scene in scenes:
        await scene.connect("")
    return scenes[0], scenes[1] if laser else None


async def test_one_server_does_everything() -> None:
    hq, none = await simulating(None)
    assert none is None
    with contextlib.closing(hq.peer):
        assert (await hq.read())[0] == "2"
        assert {(await hq.read())[0] for _ in range(10)} == {"1", "4"}
        hq.task.cancel()
        await hq.kind("255")
    with pytest.raises(asyncio.CancelledError):
        await hq.task


async def test_two_servers_share_the_work_and_are_one_vehicle(caplog: pytest.LogCaptureFixture) -> None:
    hq, eye = await simulating(0)
    assert eye is not None
    with contextlib.closing(hq.peer), contextlib.closing(eye.peer):
        assert (await eye.read())[0] == "2"
        before = [int(point) for point in (await eye.read())[3 + 44 : 3 + 726]]
        await hq.repeat(b"3|0|0|0|0;", 0.02)
        await hq.repeat(b"3|100|0|0|0;", 0.5)
        assert {(await hq.read())[0] for _ in range(4)} == {"4"}
        while True:
            after = [int(point) for point in (await eye.read())[3 + 44 : 3 + 726]]
            moved = sum(20 <= one <= 5600 and one - other > 50 for one, other in zip(before, after, strict=True))
            if moved > 100:  # nearer by more than 5 cm
                break
        assert not caplog.records
        await eye.say("3|0|0|0|0;")
        await until(lambda: len(caplog.records) == 1, "one violation")
        hq.task.cancel()
        await hq.kind("255")
        await eye.kind("255")
    assert caplog.records[0].getMessage().startswith("violation, laser: id 3, of which")
    with pytest.raises(asyncio.CancelledError):
        await hq.task


async def test_the_simulator_logs_violations_and_says_what_it_died_of(caplog, capsys) -> None:
    hq, _ = await simulating(None, "binary")
    with contextlib.closing(hq.peer):
        await hq.play(["> 48", "over"])
    assert capsys.readouterr().out.startswith("died: id 72, of which this server knows nothing")
    assert [record.levelno for record in caplog.records if "violation" in record.message] == [logging.ERROR]


async def test_a_port_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OSError, match="in use"):
        await quick().serve("127.0.0.1", taken.getsockname()[1], print)


@pytest.mark.parametrize(("dialect", "laser"), [("text", False), ("morse", True)])
def test_a_server_that_cannot_be_is_refused(dialect: Any, laser: bool) -> None:
    with pytest.raises(ValueError, match="no such server"):
        FragileVehicle(dialect, laser=laser, drive=False)


def test_a_seed_gives_the_same_vehicle() -> None:
    one, two = (FragileVehicle("text", laser=True, drive=True, seed=5) for _ in range(2))
    assert repr(one) == repr(two) == "<FragileVehicle text drive+laser LISTENING violations=0 alive=True>"
    assert one.machine.measure() == two.machine.measure()


def test_other_numbers_of_points_keep_their_valid_indices_inside() -> None:
    for points in (1, 10, 726, 1081):
        *ranges, first, last = Machine(random.Random(1), points).measure()
        assert len(ranges) == points
        assert 0 <= first <= last < points
