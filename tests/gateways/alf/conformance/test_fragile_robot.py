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

QUICK = Times(
    cycle_s=0.005,
    scan_s=0.02,
    info_s=0.05,
    first_s=5,
    gap_s=5,
    window_commands=0,
    flight_s=0.05,
    answer_s=0.15,
    close_s=0.15,
)
"""As quick as a test, and patient where the rhythm is not what it is about."""
LONG_S = 5.0
GOOD: dict[Dialect, bytes] = {"text": b"3|0|0|0|0;", "binary": bytes.fromhex("03 00 00 5a 00")}
FORWARD: dict[Dialect, bytes] = {"text": b"3|80|0|30|1;", "binary": bytes.fromhex("03 50 00 78 01")}
END: dict[Dialect, bytes] = {"text": b"255|1;", "binary": b"\xff\x01"}
SIZES = {1: 1 + 4 + 4 + 769 * 8 + 4 + 4, 2: 1 + 3 * 4 + 3 * 4, 4: 1 + 1 + 6 * 2 + 4, 255: 2}
DIALECTS: tuple[Dialect, ...] = ("text", "binary")


class Hq:
    """A plain socket and the few habits of an HQ that behaves."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.tcp = socket.socket()
        self.tcp.setblocking(False)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.stream = b""

    async def connect(self) -> None:
        await asyncio.get_running_loop().sock_connect(self.tcp, ("127.0.0.1", self.port))

    async def send(self, data: bytes) -> None:
        await asyncio.get_running_loop().sock_sendall(self.tcp, data)

    async def repeat(self, data: bytes, seconds: float, every: float = 0.02) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            await self.send(data)
            await asyncio.sleep(every)

    async def _more(self) -> None:
        async with asyncio.timeout(LONG_S):
            data = await asyncio.get_running_loop().sock_recv(self.tcp, 65536)
        if not data:
            raise EOFError
        self.stream += data

    async def read(self) -> list[str]:
        """Read the fields of a text message, the id first."""
        while b";" not in self.stream:
            await self._more()
        message, _, self.stream = self.stream.partition(b";")
        return message.decode("ascii").split("|")

    async def read_binary(self) -> bytes:
        while not self.stream or len(self.stream) < SIZES[self.stream[0]]:
            await self._more()
        size = SIZES[self.stream[0]]
        message, self.stream = self.stream[:size], self.stream[size:]
        return message

    async def read_until(self, kind: int, dialect: Dialect = "text") -> None:
        while True:
            first = int((await self.read())[0]) if dialect == "text" else (await self.read_binary())[0]
            if first == kind:
                return

    def close(self) -> None:
        self.tcp.close()


@contextlib.asynccontextmanager
async def facing(vehicle: FragileVehicle) -> AsyncIterator[tuple[Hq, "asyncio.Task[None]"]]:
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(vehicle.serve("127.0.0.1", 0, port.set_result))
    hq = Hq(await port)
    try:
        yield hq, task
    finally:
        hq.close()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.asynccontextmanager
async def connected(vehicle: FragileVehicle) -> AsyncIterator[Hq]:
    async with facing(vehicle) as (hq, _):
        await hq.connect()
        yield hq


def quick(dialect: Dialect = "text", **options: Any) -> FragileVehicle:
    return FragileVehicle(dialect, **{"laser": False, "drive": True, "times": QUICK, **options})


async def until(holds: Any, what: object) -> None:
    deadline = time.monotonic() + LONG_S
    while not holds():
        assert time.monotonic() < deadline, what
        await asyncio.sleep(0.005)


async def violated(vehicle: FragileVehicle, words: str) -> None:
    """Wait until a violation with these words was noted."""
    await until(lambda: any(words in violation for violation in vehicle.violations), (words, vehicle.violations))


async def happened(vehicle: FragileVehicle, words: str) -> None:
    await until(lambda: any(words in event for event in vehicle.events), (words, vehicle.events))


async def heard(vehicle: FragileVehicle, count: int) -> None:
    await until(lambda: len(vehicle.received) >= count, vehicle.received)


async def died(vehicle: FragileVehicle, task: "asyncio.Task[None]", words: str) -> None:
    async with asyncio.timeout(LONG_S):
        await task
    assert not vehicle.alive
    assert words in vehicle.death
    assert vehicle.death in vehicle.violations
    assert f"died: {vehicle.death}" in vehicle.events


# An HQ that behaves


@pytest.mark.parametrize("laser", [False, True])
@pytest.mark.parametrize("dialect", DIALECTS)
async def test_an_hq_that_behaves_is_not_reproached(dialect: Dialect, laser: bool) -> None:
    vehicle = FragileVehicle(dialect, laser=laser, drive=True, times=Times(window_s=0.4, window_commands=10))
    async with connected(vehicle) as hq:
        await hq.repeat(GOOD[dialect], 0.1)
        await hq.repeat(FORWARD[dialect], 0.4)
        await hq.repeat(GOOD[dialect], 0.1)
        await hq.send(END[dialect])
        await hq.read_until(255, dialect)
        hq.close()
        await happened(vehicle, "the HQ closed the connection after END")
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
        for message, segments in ((b"3|0|0|0|0;", idle), (b"3|80|0|30|1;", driving)):
            for seconds, count in segments:
                await hq.send(message * count)
                await asyncio.sleep(seconds)
        ending = asyncio.create_task(vehicle.end())
        await hq.read_until(255)
        await hq.send(b"255|1;")
        hq.close()
        await ending
    assert vehicle.violations == []
    assert [kind for _, kind, _ in vehicle.received] == [3] * (18 + 30) + [255]


async def test_a_message_may_be_split_anywhere_and_many_may_share_a_read() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"] * 100)
        for number in FORWARD["text"]:
            await hq.send(bytes([number]))
            await asyncio.sleep(0.006)
        await heard(vehicle, 101)
    assert [fields for _, _, fields in vehicle.received] == [(0, 0, 0, 0)] * 100 + [(80, 0, 30, 1)]
    assert vehicle.violations == []


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_cut_does_not_depend_on_the_reads(dialect: Dialect) -> None:
    data = GOOD[dialect] + FORWARD[dialect] + END[dialect]
    for size in range(1, len(data)):
        reader = parser.reader(dialect, {3, 255}, 100)
        heard = [one for at in range(0, len(data), size) for one in reader.take(data[at : at + size])]
        assert [one.raw for one in heard] == [GOOD[dialect], FORWARD[dialect], END[dialect]]
        assert not any(one.problem for one in heard)
        assert reader.rest == b""


# What it says


async def test_a_laser_says_its_geometry_first_and_then_measures() -> None:
    vehicle = quick(laser=True, drive=False)
    async with connected(vehicle) as hq:
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
    vehicle = quick("binary", laser=True, drive=False)
    async with connected(vehicle) as hq:
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


async def test_a_binary_drive_server_counts_in_its_scale() -> None:
    async with connected(quick("binary", scale=Scale(counts_per_g=256.0))) as hq:
        info = await hq.read_binary()
    assert struct.unpack("<BB6hf", info)[:8] == (4, 0, 0, 0, 256, 0, 0, 0)


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
        await hq.send(GOOD["text"] + FORWARD["text"])
        await happened(vehicle, "20 cycles without a command: the motor stopped by itself, moving")
        assert not vehicle.machine.moving
        await hq.send(b"7|1;")
        await until(lambda: vehicle.machine.moving, vehicle)
        await until(lambda: len(vehicle.events) == 2, vehicle.events)
    assert vehicle.violations == ["id 7, of which this server knows nothing: '7|1;'"]


# What it notes and survives


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"3|101|0|0|0;", "speed 101 instead of 0..100: '3|101|0|0|0;'"),
        (b"3|255|0|0|0;", "speed 255 instead of 0..100"),
        (b"3|-1|0|0|0;", "speed -1 instead of 0..100"),
        (b"3|0|2|0|0;", "direction 2 instead of 0..1"),
        (b"3|0|-1|0|0;", "direction -1 instead of 0..1"),
        (b"3|0|0|91|0;", "steering angle 91 instead of -90..90"),
        (b"3|0|0|-91|0;", "steering angle -91 instead of -90..90"),
        (b"3|0|0|0|2;", "light 2 instead of 0..1"),
        (b"3|0|0|0;", "3 fields instead of 4"),
        (b"3|0|0|0|0|0;", "5 fields instead of 4"),
        (b"3;", "0 fields instead of 4"),
        (b"3|0.000000|0|0|0;", "not written as std::to_string prints integers: '3|0.000000|0|0|0;'"),
        (b"3|+1|0|0|0;", "not written as std::to_string prints integers"),
        (b"3|01|0|0|0;", "not written as std::to_string prints integers"),
        (b"3|0|0|-0|0;", "not written as std::to_string prints integers"),
        (b"3|0|0|0|true;", "not written as std::to_string prints integers"),
        (b"3|0|0|0|0|;", "not written as std::to_string prints integers"),
        (b"3|0||0|0;", "not written as std::to_string prints integers"),
        (b"3|1e2|0|0|0;", "not written as std::to_string prints integers"),
        (b"3 0 0 0 0;", "not written as std::to_string prints integers"),
        (b"\n3|0|0|0|0;", r"not written as std::to_string prints integers: '\n3|0|0|0|0;'"),
        (b"3|nan|0|0|0;", "not written as std::to_string prints integers"),
        (b"\xff3|0|0|0|0;", r"not written as std::to_string prints integers: '\xff3|"),
        (b";", "a message without a number: ';'"),
        (b"hello;", "a message without a number: 'hello;'"),
        (b"1|0|0|1|0|0;", "id 1, of which this server knows nothing"),
        (b"2|0|0|0|0|0|0;", "id 2, of which this server knows nothing"),
        (b"4|0|0|0|0|0|0|0|0;", "id 4, of which this server knows nothing"),
        (b"0;", "id 0, of which this server knows nothing"),
        (b"-3|0|0|0|0;", "id -3, of which this server knows nothing"),
    ],
)
async def test_a_bad_text_message_is_noted_with_its_bytes(text: bytes, words: str) -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"] + text + GOOD["text"])
        await heard(vehicle, 3)
        assert len(vehicle.violations) == 1
        assert words in vehicle.violations[0]
        assert vehicle.alive
        assert [kind for _, kind, _ in vehicle.received][::2] == [3, 3]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("03 00 02 5a 00", "direction 2 instead of 0..1: 03 00 02 5a 00"),
        ("03 00 00 b5 00", "steering angle 181 instead of 0..180"),
        ("03 00 00 5a 02", "light 2 instead of 0..1"),
    ],
)
async def test_a_bad_binary_message_is_noted_with_its_bytes(text: str, words: str) -> None:
    vehicle = quick("binary")
    async with connected(vehicle) as hq:
        await hq.send(GOOD["binary"] + bytes.fromhex(text) + GOOD["binary"])
        await heard(vehicle, 3)
        assert vehicle.violations == [words if ":" in words else f"{words}: {text}"]
        assert vehicle.alive


async def test_a_binary_speed_above_100_is_an_event() -> None:
    vehicle = quick("binary")
    async with connected(vehicle) as hq:
        await hq.send(GOOD["binary"] + bytes.fromhex("03 65 00 5a 00") * 3)
        await heard(vehicle, 4)
        assert vehicle.events == ["speed 101 counts as 100"]
        assert vehicle.violations == []


async def test_another_full_scale_may_be_set() -> None:
    vehicle = quick(speed_full=255)
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"] + b"3|255|0|0|0;3|256|0|0|0;")
        await violated(vehicle, "speed 256 instead of 0..255")
        assert len(vehicle.violations) == 1


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_a_first_command_that_drives_is_noted(dialect: Dialect) -> None:
    vehicle = quick(dialect)
    async with connected(vehicle) as hq:
        await hq.send(FORWARD[dialect] * 2)
        await violated(vehicle, "the first command has speed 80: ")
        assert len(vehicle.violations) == 1


async def test_a_text_laser_notes_a_drive_command() -> None:
    vehicle = quick(laser=True, drive=False)
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"])
        await violated(vehicle, "id 3, of which this server knows nothing: '3|0|0|0|0;'")
        assert vehicle.alive


async def test_a_laser_expects_no_commands() -> None:
    vehicle = FragileVehicle("text", laser=True, drive=False, times=Times(first_s=0.05, gap_s=0.05, window_s=0.1))
    async with connected(vehicle) as hq:
        await asyncio.sleep(0.3)
        await hq.read_until(1)
        assert vehicle.violations == []
        assert vehicle.events == []


# What it dies of


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"3|2147483648|0|0|0;", "an integer over 2^31-1, 2147483648"),
        (b"3|0|0|-2147483649|0;", "an integer over 2^31-1, -2147483649"),
        (b"3|0|0|0|" + b"9" * 5000 + b";", "an integer over 2^31-1, 99999999999999999999"),
        (b"99999999999|1;", "an integer over 2^31-1"),
        (b"3|.5|0|0|0;", "a number without leading digit, .5"),
        (b"3|0|0|-.5|0;", "a number without leading digit, -.5"),
        (b"3|" * 32769, "a message without end, 65538 bytes"),
    ],
)
async def test_a_deadly_text_message_kills(text: bytes, words: str) -> None:
    vehicle = quick()
    async with facing(vehicle) as (hq, task):
        await hq.connect()
        await hq.send(GOOD["text"] + text)
        await died(vehicle, task, words)
        with pytest.raises((EOFError, ConnectionError)):
            await hq.read_until(255)
        again = Hq(hq.port)
        with pytest.raises(ConnectionRefusedError), contextlib.closing(again):
            await again.connect()


@pytest.mark.parametrize("text", [b"3|2147483647|0|0|0;", b"3|0|0|-2147483648|0;", b"3|" + b"0" * 5000 + b"|0|0|0;"])
async def test_the_largest_integers_are_noted_only(text: bytes) -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"] + text)
        await heard(vehicle, 2)
        assert vehicle.alive
        assert len(vehicle.violations) == 1


@pytest.mark.parametrize(
    ("laser", "data", "words"),
    [
        (False, "00", "id 0, of which this server knows nothing: the framing is lost: 00"),
        (False, "01", "id 1,"),
        (False, "02", "id 2,"),
        (False, "04", "id 4,"),
        (False, "33 7c", "id 51, of which this server knows nothing: the framing is lost: 33 7c"),
        (False, "03 00 00 5a 00 00", "id 0,"),
        (False, "03 00 00 5a 03 00 00 5a 00", "id 0,"),
        (True, "03 00 00 5a 00", "id 3,"),
    ],
)
async def test_an_unknown_binary_id_kills(laser: bool, data: str, words: str) -> None:
    vehicle = quick("binary", laser=laser, drive=not laser)
    async with facing(vehicle) as (hq, task):
        await hq.connect()
        await hq.send(bytes.fromhex(data))
        await died(vehicle, task, words)


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


def test_a_gap_is_noted_once() -> None:
    repeats = Repeats(Times())
    assert [repeats.cycle(0.02, 1) for _ in range(5)] == [""] * 5
    told = [repeats.cycle(0.02, 0) for _ in range(100)]
    assert [(cycle, text) for cycle, text in enumerate(told) if text] == [(5, "no drive command for 0.12 s")]
    assert [repeats.cycle(0.02, 1) for _ in range(100)] == [""] * 100
    assert round(repeats.longest_s, 2) == 2.02


def test_the_first_command_has_more_time() -> None:
    repeats = Repeats(Times())
    told = [repeats.cycle(0.02, 0) for _ in range(20)]
    assert [(cycle, text) for cycle, text in enumerate(told) if text] == [(12, "no drive command for 0.26 s")]


def test_a_slow_rhythm_is_noted_every_second() -> None:
    repeats = Repeats(Times(cycle_s=0.03125))
    told = [repeats.cycle(0.03125, int(cycle % 2 == 0)) for cycle in range(64)]
    assert [text for text in told if text] == ["16 drive commands in 1.00 s"] * 2


async def test_an_hq_that_says_nothing_is_noted() -> None:
    vehicle = FragileVehicle("text", laser=False, drive=True, times=Times(first_s=0.06))
    async with connected(vehicle):
        await violated(vehicle, "no drive command for 0.")


async def test_an_hq_that_stops_repeating_is_noted() -> None:
    vehicle = FragileVehicle("text", laser=False, drive=True)
    async with connected(vehicle) as hq:
        await hq.repeat(GOOD["text"], 0.1)
        await violated(vehicle, "no drive command for 0.")
        await happened(vehicle, "20 cycles without a command: the motor stopped by itself, at rest")
        assert len(vehicle.violations) == 1


async def test_an_hq_that_repeats_every_60_ms_is_noted() -> None:
    times = Times(gap_s=5, window_s=0.4, window_commands=10)
    vehicle = FragileVehicle("text", laser=False, drive=True, times=times)
    async with connected(vehicle) as hq:
        repeating = asyncio.create_task(hq.repeat(GOOD["text"], LONG_S, every=0.06))
        await violated(vehicle, "drive commands in 0.4")
        repeating.cancel()


def stall(seconds: float) -> None:
    """Keep the whole process from running."""
    time.sleep(seconds)


async def test_a_process_that_is_late_itself_reproaches_nobody() -> None:
    vehicle = FragileVehicle("text", laser=False, drive=True)
    async with connected(vehicle) as hq:
        repeating = asyncio.create_task(hq.repeat(GOOD["text"], LONG_S))
        for _ in range(2):
            stall(0.25)
            await asyncio.sleep(0.08)
        repeating.cancel()
        assert vehicle.violations == []


async def test_a_gap_names_the_lateness_of_the_process() -> None:
    vehicle = FragileVehicle("text", laser=False, drive=True, times=Times(gap_s=0.05))
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"])
        await heard(vehicle, 1)
        stall(0.2)
        await violated(vehicle, " s (this process woke ")


# END


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("laser", [False, True])
async def test_an_end_is_answered_and_this_side_is_closed(dialect: Dialect, laser: bool) -> None:
    vehicle = quick(dialect, laser=laser, drive=not laser)
    async with connected(vehicle) as hq:
        await hq.send(END[dialect])
        await hq.read_until(255, dialect)
        with pytest.raises(EOFError):
            await hq.read_until(255, dialect)
        hq.close()
        await happened(vehicle, "the HQ closed the connection after END")
    assert vehicle.violations == []


async def test_an_hq_may_close_right_after_its_end() -> None:
    vehicle = quick(laser=True)
    async with connected(vehicle) as hq:
        await asyncio.sleep(0.05)
        await hq.send(b"3|0|0|0|0;255|1;")
        hq.close()
        await happened(vehicle, "the HQ closed the connection after END")
    assert vehicle.violations == []


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_an_hq_that_shuts_its_side_is_answered_still(dialect: Dialect) -> None:
    vehicle = quick(dialect)
    async with connected(vehicle) as hq:
        await hq.send(END[dialect])
        hq.tcp.shutdown(socket.SHUT_WR)
        await hq.read_until(255, dialect)
    assert vehicle.violations == []


async def test_an_end_is_answered_behind_the_measurement_that_is_being_sent() -> None:
    times = Times(cycle_s=0.005, scan_s=0.0, close_s=LONG_S)
    vehicle = FragileVehicle("binary", laser=True, drive=False, times=times, points=1_000_000)
    async with connected(vehicle) as hq:
        await asyncio.sleep(0.3)
        await hq.send(END["binary"])
        await heard(vehicle, 1)
        assert vehicle.received[0][1:] == (255, (1,))
        stream = b""
        while data := await asyncio.get_running_loop().sock_recv(hq.tcp, 1 << 20):
            stream += data
        scans, rest = divmod(len(stream) - SIZES[2] - len(END["binary"]), 1 + 8 + 8 * 1_000_000 + 8)
        assert (scans, rest) == (1, 0)
        assert stream.endswith(struct.pack("<II", 1_000_000 * 44 // 769, 1_000_000 * 725 // 769) + END["binary"])
        assert vehicle.violations == []


async def test_an_end_while_driving_is_an_event() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.send(b"3|0|0|0|0;3|40|0|0|0;255|1;")
        await happened(vehicle, "END while the last command had speed 40")


@pytest.mark.parametrize(
    ("dialect", "data", "words"),
    [
        ("text", b"255|0;", "end 0 instead of 1: '255|0;'"),
        ("text", b"255;", "0 fields instead of 1: '255;'"),
        ("text", b"255|1|1;", "2 fields instead of 1"),
        ("binary", b"\xff\x00", "end 0 instead of 1: ff 00"),
    ],
)
async def test_a_bad_end_is_noted_and_is_an_end(dialect: Dialect, data: bytes, words: str) -> None:
    vehicle = quick(dialect)
    async with connected(vehicle) as hq:
        await hq.send(data)
        await hq.read_until(255, dialect)
        assert len(vehicle.violations) == 1
        assert words in vehicle.violations[0]


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_a_message_after_end_is_noted(dialect: Dialect) -> None:
    vehicle = quick(dialect)
    async with connected(vehicle) as hq:
        await hq.send(END[dialect] + GOOD[dialect])
        await violated(vehicle, "a message after END: " + ("'3|0|0|0|0;'" if dialect == "text" else "03 00 00 5a 00"))
        await hq.send(END[dialect])
        await violated(vehicle, "a message after END: " + ("'255|1;'" if dialect == "text" else "ff 01"))
        assert len(vehicle.violations) == 2


async def test_an_hq_that_does_not_close_after_its_end_is_noted() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.send(b"255|1;")
        await violated(vehicle, "the HQ did not close within 0.15 s of its END")


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_its_own_end_is_to_be_answered_and_followed_by_the_close(dialect: Dialect) -> None:
    vehicle = quick(dialect)
    async with connected(vehicle) as hq:
        await hq.send(GOOD[dialect])
        await heard(vehicle, 1)
        ending = asyncio.create_task(vehicle.end())
        await asyncio.sleep(0)
        await hq.send(GOOD[dialect])  # in flight
        await hq.read_until(255, dialect)
        await hq.send(END[dialect])
        hq.close()
        await ending
        assert vehicle.violations == []
        await vehicle.end()  # there is nothing to end


async def test_an_end_without_an_answer_is_noted() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.read()
        await vehicle.end()
        assert vehicle.violations == ["no END within 0.15 s of the vehicle's"]


async def test_a_close_instead_of_an_answer_is_noted() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.read()
        ending = asyncio.create_task(vehicle.end())
        await hq.read_until(255)
        hq.close()
        await ending
        assert vehicle.violations == ["the HQ closed without answering END"]


async def test_an_answer_without_a_close_is_noted() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.read()
        ending = asyncio.create_task(vehicle.end())
        await hq.read_until(255)
        await hq.send(b"255|1;")
        await ending
        assert vehicle.violations == ["the HQ did not close within 0.15 s of its END"]


async def test_commands_long_after_its_own_end_are_noted() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.read()
        ending = asyncio.create_task(vehicle.end())
        await hq.read_until(255)
        await hq.repeat(GOOD["text"], 0.12, every=0.01)
        await violated(vehicle, "s after the vehicle's END: '3|0|0|0|0;'")
        await ending


async def test_nothing_is_ended_before_anybody_came() -> None:
    await quick().end()


async def test_it_leaves_with_end_when_it_is_cancelled() -> None:
    async with facing(quick()) as (hq, task):
        await hq.connect()
        await hq.read()
        task.cancel()
        await hq.read_until(255)
        with pytest.raises(EOFError):
            await hq.read()


async def test_it_leaves_without_a_word_when_it_is_cancelled_within_a_measurement() -> None:
    times = Times(cycle_s=0.005, scan_s=0.0)
    vehicle = FragileVehicle("binary", laser=True, drive=False, times=times, points=1_000_000)
    async with facing(vehicle) as (hq, task):
        await hq.connect()
        await asyncio.sleep(0.3)
        task.cancel()
        tail = b""
        with contextlib.suppress(ConnectionError):
            while data := await asyncio.get_running_loop().sock_recv(hq.tcp, 1 << 20):
                tail = data
        assert tail
        assert not tail.endswith(END["binary"])


# Its one connection


async def test_a_close_without_end_is_an_event_and_the_motor_stops() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"] + FORWARD["text"])
        hq.close()
        await happened(vehicle, "the HQ closed the connection without END: ")
        await happened(vehicle, "the motor stopped by itself, moving")
        assert vehicle.violations == []


async def test_a_connection_that_breaks_is_an_event() -> None:
    vehicle = quick(laser=True)
    async with connected(vehicle) as hq:
        await hq.send(GOOD["text"])
        hq.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        hq.close()
        await happened(vehicle, "the HQ closed the connection without END: ConnectionResetError")
        assert vehicle.violations == []


@pytest.mark.parametrize(("dialect", "part"), [("text", b"3|0|0|"), ("binary", b"\x03\x00\x00")])
async def test_a_close_within_a_message_is_noted(dialect: Dialect, part: bytes) -> None:
    vehicle = quick(dialect)
    async with connected(vehicle) as hq:
        await hq.send(GOOD[dialect] + part)
        hq.close()
        await violated(vehicle, "the connection ended within a message: ")


@pytest.mark.parametrize("after", ["connected", "over"])
async def test_a_second_connection_is_accepted_and_never_answered(after: str) -> None:
    vehicle = quick(laser=True)
    async with connected(vehicle) as hq:
        await hq.read()
        if after == "over":
            hq.close()
            await happened(vehicle, "the HQ closed the connection without END")
        again = Hq(hq.port)
        with contextlib.closing(again):
            await again.connect()
            await again.send(GOOD["text"])
            await happened(vehicle, f"while {after}")
            with pytest.raises(BlockingIOError):
                again.tcp.recv(1)
        assert vehicle.events[-1].startswith("second connection, from 127.0.0.1:")
        assert vehicle.violations == []
        assert vehicle.received == []


async def test_many_connections_are_bounded() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        others = [Hq(hq.port) for _ in range(20)]
        for other in others:
            await other.connect()
        await until(lambda: len(vehicle.events) == 20, vehicle.events)
        for other in others:
            other.close()


async def test_an_hq_that_reads_nothing_is_an_event() -> None:
    times = Times(cycle_s=0.005, scan_s=0.0, first_s=50, send_s=0.1)
    vehicle = FragileVehicle("binary", laser=True, drive=False, times=times, points=100_000)
    async with connected(vehicle):
        await happened(vehicle, "the HQ read nothing for 0.1 s")
        assert vehicle.violations == []


async def test_a_connection_can_be_cut_and_the_other_server_goes_on() -> None:
    drive = quick()
    laser = quick(laser=True, drive=False, machine=drive.machine)
    async with connected(drive) as hq, connected(laser) as eye:
        await eye.read_until(1)
        await laser.cut()
        with pytest.raises((EOFError, ConnectionError)):
            await eye.read_until(255)
        await hq.send(GOOD["text"] + FORWARD["text"])
        await heard(drive, 2)
        assert laser.events == ["the vehicle cut the connection"]
        assert drive.events == drive.violations == laser.violations == []


async def test_what_is_kept_is_bounded() -> None:
    noted: list[str] = []
    vehicle = quick(keep=2, note=noted.append)
    async with connected(vehicle) as hq:
        await hq.send(b"7;8;9;" + GOOD["text"])
        await until(lambda: vehicle.received and vehicle.received[-1][1] == 3, vehicle.received)
        assert len(vehicle.violations) == len(vehicle.received) == 2
        assert len(noted) == 3


# As a process


async def simulating(laser_port: int | None, dialect: Dialect = "text") -> "tuple[asyncio.Task[None], int, int | None]":
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
    return task, *await ports


async def test_one_server_does_everything() -> None:
    task, port, none = await simulating(None)
    assert none is None
    with contextlib.closing(Hq(port)) as hq:
        await hq.connect()
        assert (await hq.read())[0] == "2"
        assert {(await hq.read())[0] for _ in range(10)} == {"1", "4"}
        task.cancel()
        await hq.read_until(255)
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_two_servers_share_the_work_and_are_one_vehicle(caplog: pytest.LogCaptureFixture) -> None:
    task, drive_port, laser_port = await simulating(0)
    assert laser_port
    with contextlib.closing(Hq(drive_port)) as hq, contextlib.closing(Hq(laser_port)) as eye:
        await hq.connect()
        await eye.connect()
        assert (await eye.read())[0] == "2"
        before = [int(point) for point in (await eye.read())[3 + 44 : 3 + 726]]
        await hq.repeat(GOOD["text"], 0.02)
        await hq.repeat(b"3|100|0|0|0;", 0.5)
        assert {(await hq.read())[0] for _ in range(4)} == {"4"}
        while True:
            after = [int(point) for point in (await eye.read())[3 + 44 : 3 + 726]]
            moved = sum(20 <= one <= 5600 and one - other > 50 for one, other in zip(before, after, strict=True))
            if moved > 100:  # nearer by more than 5 cm
                break
        assert not caplog.records
        await eye.send(GOOD["text"])
        await until(lambda: len(caplog.records) == 1, "one violation")
        task.cancel()
        await hq.read_until(255)
        await eye.read_until(255)
    assert caplog.records[0].getMessage().startswith("violation, laser: id 3, of which")
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_the_simulator_logs_violations_and_says_what_it_died_of(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    task, port, _ = await simulating(None, "binary")
    with contextlib.closing(Hq(port)) as hq:
        await hq.connect()
        await hq.send(b"\x48")
        async with asyncio.timeout(LONG_S):
            await task
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
