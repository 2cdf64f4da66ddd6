"""The fragile HQ against a small robot written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import socket
import struct
import threading
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from gateways.tcpudp.conformance.fragile_hq import FragileHq, simulate_fragile_hq
from gateways.tcpudp.conformance.parser import Feature, HqTimes
from tests import captures

GAP_S = 0.015
QUICK = HqTimes(probe_s=0.1)
UNEXCUSED = HqTimes(gap_s=1000.0)
"""With such a gap this process is never to blame for what it reads joined."""
SETTINGS = {
    ("1.1", True): "0f000000 01 02 07 03000000 312e31 0101010101",
    ("1.1", False): "0f000000 01 02 07 03000000 312e31 0001010101",
    ("1.2", True): "10000000 01 02 07 03000000 312e32 010101010101",
    ("1.2", False): "10000000 01 02 07 03000000 312e32 000101010101",
    ("1.3", True): "21000000 01 02 07 0b000000 312e312c312e322c312e33 01010101010101 c8000000 0a000000",
    ("1.3", False): "21000000 01 02 07 0b000000 312e312c312e322c312e33 00010101010101 c8000000 0a000000",
}
ANSWERS = {
    "1.1": "0e000000 07 03 03000000 312e31 0100000000",
    "1.2": "0f000000 07 03 03000000 312e32 010000000000",
    "1.3": "18000000 07 03 0b000000 312e312c312e322c312e33 01000000000000",
}
VERSIONS = ("1.1", "1.2", "1.3")
START, RECEIVED, NOT_RECEIVED = "02000000 01 04", "03000000 01 06 01", "03000000 01 06 00"
PROBE, CONNECTED, NOT_CONNECTED = "02000000 07 05", "03000000 07 07 01", "03000000 07 07 00"
TEXT = "08000000 01 01 02000000 6869"
LIDAR_OFF = "06000000 01 33 02000000"
POSITION = "0e000000 01 37 0000c03f 000010c0 0000b442"
NO_MAP = "06000000 01 35 00000000"
CELLS = "00010200" * 100
MAP = "96010000 01 35 90010000" + CELLS
GET_SCAN = "02000000 01 3c"
IDLE = "02000000 07 0d"
FORWARD = "0e000000 07 0b 00000000 0000803f 0000803f"
TURN = "06000000 07 0c 000040bf"


def raw(text: str) -> bytes:
    return bytes.fromhex(text)


class Robot:
    """Plain sockets of one number, and the few habits of a robot that behaves."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.port: int = self.listener.getsockname()[1]
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)
        self.udp.bind(("127.0.0.1", self.port))
        self.tcp = socket.socket()
        self.stream = b""
        self.source = ("127.0.0.1", 9)

    async def accept(self) -> None:
        self.tcp.close()
        self.tcp, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(self.listener), 2)
        self.tcp.setblocking(False)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    async def send(self, text: str) -> None:
        await asyncio.get_running_loop().sock_sendall(self.tcp, raw(text))
        await asyncio.sleep(GAP_S)

    async def send_udp(self, text: str) -> None:
        self.udp.sendto(raw(text), self.source)
        await asyncio.sleep(GAP_S)

    async def read(self) -> bytes:
        async with asyncio.timeout(2):
            while len(self.stream) < 4 or len(self.stream) < 4 + struct.unpack_from("<i", self.stream)[0]:
                data = await asyncio.get_running_loop().sock_recv(self.tcp, 65536)
                if not data:
                    raise EOFError
                self.stream += data
        size = 4 + struct.unpack_from("<i", self.stream)[0]
        packet, self.stream = self.stream[:size], self.stream[size:]
        return packet

    async def read_udp(self) -> bytes:
        async with asyncio.timeout(2):
            while True:
                with contextlib.suppress(BlockingIOError):
                    data, self.source = self.udp.recvfrom(65536)
                    return data
                await asyncio.sleep(0.002)

    async def greet(self, settings: str) -> None:
        """Speak first, and take the answer 3."""
        await self.accept()
        await self.send(settings)
        assert (await self.read())[5] == 3

    async def start_udp(self) -> None:
        """Offer UDP and take the probe."""
        await self.send(START)
        assert await self.read_udp() == raw(PROBE)

    async def shake(self, version: str = "1.3", *, udp: bool = False) -> None:
        """Do the whole handshake."""
        await self.greet(SETTINGS[version, udp])
        if udp:
            await self.start_udp()
            await self.send_udp(RECEIVED)
            assert await self.read() == raw(CONNECTED)

    def close(self) -> None:
        for sock in (self.listener, self.udp, self.tcp):
            sock.close()


@contextlib.asynccontextmanager
async def facing(hq: FragileHq) -> AsyncIterator[tuple[Robot, "asyncio.Task[None]"]]:
    robot = Robot()
    task = asyncio.create_task(hq.run("127.0.0.1", robot.port))
    try:
        yield robot, task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        robot.close()


def program(version: str = "1.3", **options: Any) -> FragileHq:
    return FragileHq(version=version, **{"repeat_s": None, "unasked": True, **options})


async def until(condition: Callable[[], object], what: object) -> None:
    for _ in range(400):
        if condition():
            return
        await asyncio.sleep(0.005)
    raise AssertionError(what() if callable(what) else what)


async def violated(hq: FragileHq, words: str) -> None:
    """Wait until the only violation is one with these words."""
    await until(lambda: hq.violations, "no violation")
    assert len(hq.violations) == 1
    assert words in hq.violations[0]


async def told(hq: FragileHq, words: str) -> None:
    """Wait until an event with these words was noted."""
    await until(lambda: any(words in event for event in hq.events), lambda: f"{words!r} is not among {hq.events}")


async def died(hq: FragileHq, task: "asyncio.Task[None]", words: str) -> None:
    await asyncio.wait_for(task, 2)
    assert not hq.alive
    assert words in hq.death
    assert hq.violations[-1] == hq.death
    assert hq.events[-1] == f"died: {hq.death}"


# A robot that behaves


@pytest.mark.parametrize("udp", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
async def test_a_robot_that_behaves_is_not_reproached(version: str, udp: bool) -> None:
    hq = program(version, lidar_sim=version != "1.1")
    async with facing(hq) as (robot, task):
        await robot.shake(version, udp=udp)
        send = robot.send_udp if udp else robot.send
        for text in (NO_MAP, MAP, POSITION):
            await send(text)
        for text in (TEXT, LIDAR_OFF) + (GET_SCAN,) * (version != "1.1"):
            await robot.send(text)
        await until(lambda: hq.counts[60 if version != "1.1" else 51], "the last packet")
        assert hq.violations == []
        assert hq.established.is_set()
        assert (hq.position, hq.map, hq.texts, hq.lidar_on) == ((1.5, -2.25, 90.0), raw(CELLS), ["hi"], False)
        assert [row[2] for row in hq.received if row[1] == "udp"] == [6, 53, 53, 55] * udp
        assert hq.received[0][1:] == ("tcp", 2, raw(SETTINGS[version, udp])[6:])
        assert (hq.client_id, hq.alive, task.done()) == (7, True, False)
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == ((200, 10) if version == "1.3" else (0, 0))
        assert (Feature.UDP in hq.settings.features, Feature.CHAT in hq.settings.features) == (udp, True)


async def test_a_captured_robot_is_reproached_for_what_the_page_forbids_the_gateway_only() -> None:
    """The deployed robot gives its client the id 1, and its maps do not have the size it announced."""
    hq = program(lidar_sim=True)
    async with facing(hq) as (robot, _):
        await robot.accept()
        for record in captures.payloads("tcpudp-1.3-udp.hex", source=11001):
            if record.payload[5] == 4:
                await robot.read()
            if record.payload[5] == 6:
                await robot.read_udp()
            await (robot.send if record.transport == "TCP" else robot.send_udp)(record.payload.hex())
        await until(lambda: hq.texts, "the last packet")
        assert [violation.partition(":")[0] for violation in hq.violations] == [
            "client id 1",
            *["400 cells of a map announced with 2048 x 2048"] * 2,
        ]
        assert (hq.texts, hq.alive) == (["bye"], True)


@pytest.mark.parametrize("version", VERSIONS)
async def test_it_answers_with_the_settings_of_its_version(version: str) -> None:
    async with facing(program(version)) as (robot, _):
        await robot.accept()
        await robot.send(SETTINGS[version, True])
        assert await robot.read() == raw(ANSWERS[version])


async def test_it_announces_lidar_sim_and_no_udp_if_told_so() -> None:
    async with facing(program("1.2", udp=False, lidar_sim=True)) as (robot, _):
        await robot.accept()
        await robot.send(SETTINGS["1.2", True])
        assert await robot.read() == raw("0f000000 07 03 03000000 312e32 000000000001")


@pytest.mark.parametrize("wrong", [{"version": "1.4"}, {"version": "1.1", "lidar_sim": True}])
def test_an_hq_that_does_not_exist_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="no HQ of version"):
        FragileHq(**wrong)


async def test_a_lost_answer_is_followed_by_true_all_the_same_in_1_3() -> None:
    hq = program("1.3", times=QUICK)
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS["1.3", True])
        await robot.start_udp()
        assert not hq.established.is_set()
        assert await robot.read() == raw(CONNECTED)
        await told(hq, "no 6 within 0.1 s of the 5")
        for send in (robot.send, robot.send_udp):
            await send(POSITION)
        await until(lambda: hq.counts[55] == 2, "two positions")
        assert hq.violations == []


@pytest.mark.parametrize("version", ["1.1", "1.2"])
async def test_a_lost_answer_makes_the_older_ones_fall_back_to_tcp(version: str) -> None:
    hq = program(version, times=QUICK)
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS[version, True])
        await robot.start_udp()
        assert await robot.read() == raw(NOT_CONNECTED)
        await until(hq.established.is_set, "established")
        hq.move(0.0, 1.0)
        assert await robot.read() == raw(FORWARD)
        await robot.send(POSITION)
        await until(lambda: hq.position, "the position by TCP")
        assert hq.violations == []
        await robot.send_udp(POSITION)
        await violated(hq, "packet 55 by UDP instead of TCP")


async def test_it_reports_once() -> None:
    hq = program(times=QUICK)
    async with facing(hq) as (robot, _):
        await robot.shake(udp=True)
        await asyncio.sleep(1.5 * QUICK.probe_s)
        with pytest.raises(BlockingIOError):
            robot.tcp.recv(1)


async def test_a_missing_4_is_an_event() -> None:
    hq = program(times=QUICK)
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS["1.3", True])
        await told(hq, "no 4 within 0.1 s of the 3")
        assert (hq.violations, hq.established.is_set()) == ([], False)


async def test_no_common_version_may_be_said_before_closing() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, task):
        await robot.greet("10000000 01 02 07 03000000 312e32 010101010101")
        await robot.send(TEXT)
        robot.tcp.close()
        await asyncio.wait_for(task, 2)
        assert (hq.texts, hq.violations, hq.alive) == (["hi"], [], True)
        assert hq.events[1:] == ["the robot closed the connection", "ended"]


# What version it understands


@pytest.mark.parametrize(
    ("version", "versions", "understood"),
    [
        ("1.1", b"1.1", "1.1"),
        ("1.1", b"1.1,1.2,1.3", ""),
        ("1.2", b"1.1", ""),
        ("1.3", b"1.1,1.2,1.3,1.4", "1.3"),
        ("1.3", b"1.1,1.2", "1.2"),
        ("1.3", b"1.1", "1.1"),
        ("1.3", b"1.4", ""),
    ],
)
async def test_each_version_understands_other_lists(version: str, versions: bytes, understood: str) -> None:
    newest = versions[-3:]
    block = {b"1.1": "0001010101", b"1.2": "000101010101"}.get(newest, "00010101010101 c8000000 0a000000")
    body = b"\x07" + struct.pack("<i", len(versions)) + versions + raw(block)
    hq = program(version)
    async with facing(hq) as (robot, _):
        await robot.greet((struct.pack("<iBB", 2 + len(body), 1, 2) + body).hex())
        assert hq.settings is not None
        assert hq.settings.understood == understood
        assert bool(hq.settings.features) == bool(understood)
        assert any("keeps its old flags" in event for event in hq.events) == (not understood)
        assert hq.violations == []


async def test_one_that_skips_the_map_flag_sees_a_wrong_size_unless_it_is_left_out() -> None:
    hq = program(skips_map_flag=True)
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS["1.3", False])
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == (0xC801, 0x0A00)
        await told(hq, "a wrong map size 51201 with the interval 2560")
        await robot.send(MAP)
        assert hq.violations == []
    hq = program(skips_map_flag=True)
    async with facing(hq) as (robot, _):
        await robot.greet("20000000 01 02 07 0b000000 312e312c312e322c312e33 000101010101 c8000000 0a000000")
        await robot.send(MAP)
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == (200, 10)
        assert (hq.violations, hq.events) == ([], [])


# Settings that violate or kill


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            "22000000 01 02 07 0b000000 312e312c312e322c312e33 00010101010101 c8000000 0a000000 00",
            "16 bytes of settings",
        ),
        ("21000000 01 02 01 0b000000 312e312c312e322c312e33 00010101010101 c8000000 0a000000", "client id 1"),
        ("21000000 02 02 07 0b000000 312e312c312e322c312e33 00010101010101 c8000000 0a000000", "id byte 2 instead"),
    ],
)
async def test_settings_that_are_wrong(settings: str, words: str) -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.greet(settings)
        await violated(hq, words)
        assert hq.alive


@pytest.mark.parametrize(
    ("version", "settings", "words"),
    [
        (
            "1.3",
            "21000000 01 02 07 0b000000 312e312c312e322c312e33 00010101010101 c8000000 00000000",
            "division by zero",
        ),
        ("1.3", "19000000 01 02 07 0b000000 312e312c312e322c312e33 00010101010101", "7 bytes of settings"),
        ("1.3", "20000000 01 02 07 0b000000 312e312c312e322c312e33 000101010101 c8000000 0a000000", "14 bytes"),
        ("1.1", "0d000000 01 02 07 03000000 312e31 000000", "3 bytes of settings"),
        ("1.1", "0f000000 01 02 07 ff000000 312e31 0001010101", "no version string"),
        ("1.1", "0f000000 01 02 07 03000000 312eb1 0001010101", "no version string"),
        ("1.1", "03000000 01 02 07", "no version string"),
    ],
)
async def test_settings_that_kill(version: str, settings: str, words: str) -> None:
    hq = program(version)
    async with facing(hq) as (robot, task):
        await robot.accept()
        await robot.send(settings)
        await died(hq, task, words)


# Packets that violate or kill


@pytest.mark.parametrize(
    ("version", "text", "words"),
    [
        ("1.3", SETTINGS["1.3", False], "a second 2"),
        ("1.3", START, "a 4 before the answer 3, or not both set the UDP flag"),
        ("1.3", NOT_RECEIVED, "a 6 that is not due"),
        ("1.2", GET_SCAN, "LidarSim was not announced"),
        ("1.3", "06000000 02 35 00000000", "id byte 2 instead of 1"),
        ("1.3", "06000000 01 33 03000000", "lidar status 3"),
        ("1.3", "0e000000 01 37 0000c07f 000010c0 0000b442", "not finite"),
        ("1.3", "07000000 01 35 01000000 01", "1 cells of a map announced with 20 x 20"),
        ("1.1", "0a000000 01 35 04000000 00010203", "a cell that is neither 0, 1 nor 2"),
    ],
)
async def test_packets_that_are_wrong(version: str, text: str, words: str) -> None:
    hq = program(version)
    async with facing(hq) as (robot, _):
        await robot.shake(version)
        await robot.send(text)
        await violated(hq, words)
        await robot.send(TEXT)
        await until(lambda: hq.texts, "it lives on")
        assert hq.alive


@pytest.mark.parametrize(
    ("text", "words"),
    [(MAP, "a 53 to an HQ 1.1 that never asked (52)"), (POSITION, "a 55 to an HQ 1.1 that never asked (54)")],
)
async def test_the_first_programs_of_1_1_have_no_handlers_for_what_nobody_asked_for(text: str, words: str) -> None:
    hq = program("1.1", unasked=False)
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        await robot.send(text)
        await violated(hq, words)


@pytest.mark.parametrize("version", VERSIONS)
async def test_what_was_asked_for_comes_as_it_comes(version: str) -> None:
    hq = program(version, unasked=False)
    async with facing(hq) as (robot, _):
        await robot.shake(version)
        await until(hq.established.is_set, "established")
        hq.ask_map()
        hq.ask_position()
        for text in (MAP, POSITION, MAP, POSITION, TEXT):
            await robot.send(text)
        await until(lambda: hq.texts, "the last packet")
        assert (hq.violations, hq.counts[53], hq.counts[55]) == ([], 2, 2)


@pytest.mark.parametrize("version", ["1.1", "1.2"])
async def test_a_square_map_needs_no_announced_size(version: str) -> None:
    hq = program(version)
    async with facing(hq) as (robot, _):
        await robot.shake(version)
        await robot.send("0a000000 01 35 04000000 00010200")
        await until(lambda: hq.map == raw("00010200"), "the map")
        assert hq.violations == []


@pytest.mark.parametrize(
    ("version", "text", "words"),
    [
        *[(version, "02000000 01 38", f"unknown packet id 56 for an HQ {version}") for version in VERSIONS],
        ("1.1", GET_SCAN, "unknown packet id 60"),
        ("1.3", "06000000 01 1f 01000000", "unknown packet id 31"),
        ("1.3", "03000000 01 28 00", "unknown packet id 40"),
        ("1.3", CONNECTED, "unknown packet id 7"),
        ("1.3", "03000000 01 04 00", "a body of 1 bytes instead of 0"),
        ("1.3", "02000000 01 06", "a body of 0 bytes instead of 1"),
        ("1.3", "03000000 01 33 01", "a body of 1 bytes instead of 4"),
        ("1.3", "0a000000 01 37 0000c03f 000010c0", "a body of 8 bytes instead of 12"),
        ("1.3", "03000000 01 3c 00", "a body of 1 bytes instead of 0"),
        ("1.3", "08000000 01 01 03000000 6869", "a wrong byte count of the string"),
        ("1.3", "04000000 01 01 0000", "a wrong byte count of the string"),
        ("1.3", "08000000 01 01 02000000 c3a9", "a text that is not ASCII"),
        ("1.3", "06000000 01 01 00000000", "an empty text"),
        ("1.3", "0e000000 01 35 0000c03f 000010c0 0000b442", "bytes of a map"),
        ("1.3", "04000000 01 35 0100", "n = -1 and 0 bytes of a map"),
        *[(version, "02000000 01 35", "a 53 without its int, on which it throws for good") for version in VERSIONS],
        ("1.3", "08000000 01 35 02000000 0001", "a map of 2 cells, no square"),
        ("1.3", "01000000 01 35", "its length field is wrong"),
    ],
)
async def test_packets_that_kill(version: str, text: str, words: str) -> None:
    hq = program(version, lidar_sim=version != "1.1")
    async with facing(hq) as (robot, task):
        await robot.shake(version)
        await robot.send(text)
        await died(hq, task, words)
        with pytest.raises((EOFError, ConnectionError)):
            await robot.read()
        hq.say("dead men tell no tales")
        assert hq.events[-1] == "lost: packet 1 while ended"


# Packets out of turn


async def test_the_robot_speaks_first_and_with_its_settings() -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.accept()
        await robot.send(TEXT)
        await violated(hq, "packet 1 before the settings 2")


@pytest.mark.parametrize(("text", "words"), [(START, "a 4 before the answer 3"), (TEXT, "packet 1 before the session")])
async def test_nothing_comes_before_the_answer(text: str, words: str) -> None:
    hq = program(times=HqTimes(answer_s=1.0))
    async with facing(hq) as (robot, _):
        await robot.accept()
        await robot.send(SETTINGS["1.3", True])
        await robot.send(text)
        await violated(hq, words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (START, "a second 4"),
        (TEXT, "packet 1 before the session was established"),
        (LIDAR_OFF, "packet 51 before the session was established"),
        (RECEIVED, "packet 6 by TCP instead of UDP"),
    ],
)
async def test_nothing_but_the_answer_comes_during_the_probe(text: str, words: str) -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS["1.3", True])
        await robot.start_udp()
        await robot.send(text)
        await violated(hq, words)


async def test_a_second_answer_is_not_due() -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.shake(udp=True)
        await robot.send_udp(RECEIVED)
        await violated(hq, "a 6 that is not due")


# Channels


@pytest.mark.parametrize("text", [MAP, POSITION])
async def test_what_was_agreed_for_udp_may_not_come_by_tcp(text: str) -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.shake(udp=True)
        await robot.send(text)
        await violated(hq, "by TCP instead of UDP")


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_6_that_says_no_is_reproached_and_makes_the_older_ones_believe_in_udp(version: str) -> None:
    hq = program(version)
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS[version, True])
        await robot.start_udp()
        await robot.send(NOT_RECEIVED)
        await violated(hq, "6(false): a listener sends 6(true) or none")
        assert await robot.read() == raw(CONNECTED)
        hq.move(0.0, 1.0)
        assert await robot.read_udp() == raw(FORWARD)


@pytest.mark.parametrize("text", [TEXT, LIDAR_OFF])
async def test_what_belongs_to_tcp_may_not_come_by_udp(text: str) -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.shake(udp=True)
        await robot.send_udp(text)
        await violated(hq, "by UDP instead of TCP")


@pytest.mark.parametrize("text", ["03000000 01 35", "00", POSITION + POSITION])
async def test_a_datagram_with_a_wrong_length_field_kills(text: str) -> None:
    hq = program()
    async with facing(hq) as (robot, task):
        await robot.shake(udp=True)
        await robot.send_udp(text)
        await died(hq, task, "a datagram whose length field is wrong")


async def test_datagrams_from_elsewhere_are_not_heard() -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.shake(udp=True)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(raw(POSITION), robot.source)
            await told(hq, "not from the robot")
        assert (hq.position, hq.violations) == (None, [])


async def test_a_map_of_60_kb_passes_by_udp() -> None:
    hq = program("1.2")
    async with facing(hq) as (robot, _):
        await robot.shake("1.2", udp=True)
        await robot.send_udp("06e10000 01 35 00e10000" + "00010200" * 14400)  # 240 x 240 cells
        await until(lambda: hq.map == raw("00010200" * 14400), "the map")
        assert hq.violations == []


async def test_it_binds_the_port_it_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    async with facing(program(udp_port=port)) as (robot, _):
        await robot.shake(udp=True)
        assert robot.source == ("127.0.0.1", port)


async def test_it_binds_the_port_of_deployed_programs_if_it_is_free() -> None:
    first, second = program(), program()
    async with facing(first) as (robot, _), facing(second) as (other, _):
        await robot.shake(udp=True)
        await other.shake(udp=True)
        assert robot.source[1] == 11000 or any("UDP port 11000 is taken" in event for event in first.events)
        assert any(f"UDP port 11000 is taken, {other.source[1]} instead" in event for event in second.events)


# One read is one packet


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TEXT + POSITION, "two packets in one read"),
        (TEXT + TEXT + TEXT, "3 packets in one read"),
        (TEXT + "0e000000 01 37", "1 packets and a part of one in one read"),
        ("08000000 01 01 02000000", "a split packet, 10 of 12 bytes in one read"),
        ("94080000 01 35 8e080000" + "00" * 2190, "a packet of 2200 bytes, over 2199"),
    ],
)
async def test_a_read_that_is_not_one_packet_is_lost(text: str, words: str) -> None:
    hq = program("1.1", times=UNEXCUSED)
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        await robot.send(text)
        await violated(hq, words)
        assert (hq.texts, hq.position, hq.alive) == ([], None, True)


async def test_a_map_below_2200_bytes_passes_by_tcp() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        await robot.send("4a080000 01 35 44080000" + "01" * 2116)  # 46 x 46 cells
        await until(lambda: hq.map == b"\x01" * 2116, "the map")
        assert hq.violations == []


async def test_the_rest_of_a_split_packet_is_no_second_violation() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        for text in ("0e000000 01 37 0000c03f", "000010c0 0000b442", POSITION):
            await robot.send(text)
        await until(lambda: hq.position, "the whole one")
        await violated(hq, "a split packet")


@pytest.mark.parametrize("text", ["02", "02000000 01"])
async def test_a_read_under_six_bytes_is_taken_as_a_disconnect(text: str) -> None:
    hq = program()
    async with facing(hq) as (robot, task):
        await robot.shake()
        await robot.send(text)
        await asyncio.wait_for(task, 2)
        await violated(hq, "taken as a disconnect")
        assert hq.alive
        assert hq.events[-2:] == ["hung up: took a short read as a disconnect", "ended"]


async def test_a_reader_in_time_holds_it_against_the_robot() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        for _ in range(50):  # a busy machine may excuse some
            await robot.send(TEXT + POSITION)
            if hq.violations:
                break
        await violated(hq, "two packets in one read")


async def test_what_a_late_reader_joined_itself_is_not_held_against_the_robot() -> None:
    hq = program("1.1", times=HqTimes(gap_s=0.0))
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        await robot.send(TEXT + POSITION)
        await told(hq, "joined by this process: two packets in one read")
        assert (hq.texts, hq.position, hq.violations) == (["hi"], (1.5, -2.25, 90.0), [])


async def test_it_reads_though_the_event_loop_is_busy() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        await asyncio.sleep(GAP_S)

        def send_spaced() -> None:
            for _ in range(5):
                robot.tcp.send(raw(TEXT))
                time.sleep(GAP_S)

        thread = threading.Thread(target=send_spaced)
        thread.start()
        thread.join()  # the loop does nothing meanwhile
        await until(lambda: len(hq.texts) == 5, "five texts")
        assert hq.violations == []


# What the operator does


async def test_every_packet_of_the_operator_is_that_of_the_page() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        hq.mode(2)
        hq.move(0.0, 1.0)
        hq.rotate(-0.75)
        hq.idle()
        hq.stop()
        hq.move_ai(b"\x09")
        hq.chat(b"\x01\x02")
        hq.lidar(on=False)
        hq.ask_map()
        hq.ask_position()
        hq.say("hi")
        hq.feed([100.0, 101.0])
        for text in (
            "06000000 07 0a 02000000",
            FORWARD,
            TURN,
            IDLE,
            IDLE,
            "03000000 07 15 09",
            "04000000 07 28 0102",
            "06000000 07 32 02000000",
            "02000000 07 34",
            "02000000 07 36",
            "08000000 07 01 02000000 6869",
            "0e000000 07 3d 02000000 0000c842 0000ca42",
        ):
            assert await robot.read() == raw(text)


@pytest.mark.parametrize("version", VERSIONS)
async def test_with_udp_agreed_the_stick_goes_by_udp_and_13_by_tcp(version: str) -> None:
    hq = program(version)
    async with facing(hq) as (robot, _):
        await robot.shake(version, udp=True)
        hq.move(0.0, 1.0)
        hq.rotate(-0.75)
        hq.idle()
        assert [await robot.read_udp(), await robot.read_udp()] == [raw(FORWARD), raw(TURN)]
        assert await robot.read() == raw(IDLE)


@pytest.mark.parametrize("version", VERSIONS)
async def test_after_a_lost_probe_only_1_3_goes_on_by_udp(version: str) -> None:
    hq = program(version, times=QUICK)
    async with facing(hq) as (robot, _):
        await robot.greet(SETTINGS[version, True])
        await robot.start_udp()
        assert await robot.read() == raw(CONNECTED if version == "1.3" else NOT_CONNECTED)
        hq.move(0.0, 1.0)
        assert await (robot.read_udp() if version == "1.3" else robot.read()) == raw(FORWARD)


async def test_1_3_loses_the_stick_where_no_4_was_sent() -> None:
    hq = program()
    async with facing(hq) as (robot, _):
        await robot.shake()
        await until(hq.established.is_set, "established")
        hq.move(0.0, 1.0)
        hq.idle()
        assert await robot.read() == raw(IDLE)
        assert hq.events == ["lost: packet 11 by UDP, the robot never sent 4"]


async def test_the_stick_is_repeated_from_the_moment_the_session_is_established() -> None:
    hq = program("1.1", repeat_s=0.02)
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        assert [await robot.read() for _ in range(3)] == [raw(IDLE)] * 3
        hq.rotate(-0.75)
        while (packet := await robot.read()) == raw(IDLE):
            pass
        assert [packet, await robot.read(), await robot.read()] == [raw(TURN)] * 3


async def test_a_viewer_sends_nothing() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        await robot.send(POSITION)
        await until(lambda: hq.position, "the position")
        with pytest.raises(BlockingIOError):
            robot.tcp.recv(1)


async def test_before_the_session_is_established_everything_is_lost() -> None:
    hq = program()
    hq.say("hi")
    assert hq.events == ["lost: packet 1 while connected"]


# Ends and bounds


async def test_a_robot_that_resets_the_connection_is_an_event() -> None:
    hq = program()
    async with facing(hq) as (robot, task):
        await robot.shake()
        robot.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        robot.tcp.close()
        await asyncio.wait_for(task, 2)
        assert hq.alive
        assert "the connection broke: ConnectionResetError" in hq.events[-2]


async def test_a_robot_that_reads_nothing_is_hung_up_on() -> None:
    hq = program("1.1")
    async with facing(hq) as (robot, task):
        await robot.shake("1.1")
        await until(hq.established.is_set, "established")
        while not any("hung up" in event for event in hq.events):
            hq.chat(bytes(60000))
        await asyncio.wait_for(task, 2)
        assert (hq.alive, hq.violations) == (True, [])


async def test_a_cancelled_program_hangs_up() -> None:
    hq = program()
    async with facing(hq) as (robot, task):
        await robot.shake()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        with pytest.raises((EOFError, ConnectionError)):
            await robot.read()
    assert (hq.events, hq.alive) == (["cancelled"], True)


async def test_nobody_to_connect_to_is_an_error() -> None:
    robot = Robot()
    robot.close()
    with pytest.raises(ConnectionRefusedError):
        await program().run("127.0.0.1", robot.port)


async def test_every_list_is_bounded_and_each_violation_is_told() -> None:
    told_of: list[str] = []
    hq = program("1.1", keep=2, note=told_of.append)
    async with facing(hq) as (robot, _):
        await robot.shake("1.1")
        for _ in range(4):
            await robot.send("08000000 09 01 02000000 6869")
        await until(lambda: hq.counts[1] == 4, "four texts")
        assert [len(kept) for kept in (hq.violations, hq.received, hq.texts)] == [2, 2, 2]
        assert len(told_of) == 4
    assert repr(hq) == "<FragileHq 1.1 ENDED violations=2 alive=True>"


async def test_the_command_logs_violations_and_prints_the_death(caplog, capsys) -> None:
    robot = Robot()
    with caplog.at_level(logging.ERROR):
        task = asyncio.create_task(simulate_fragile_hq("127.0.0.1", robot.port, version="1.1", udp=False))
        await robot.shake("1.1")
        assert await robot.read() == raw(IDLE)
        await robot.send("02000000 01 3c")
        await asyncio.wait_for(task, 2)
    robot.close()
    assert "violation: unknown packet id 60" in caplog.text
    assert capsys.readouterr().out.startswith("died: unknown packet id 60")
