"""The fragile robot against a small HQ written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from gateways.tcpudp.conformance import parser
from gateways.tcpudp.conformance.fragile_robot import FragileRobot, simulate_fragile
from gateways.tcpudp.conformance.parser import Feature, Loss, Times
from tests import captures

QUICK = Times(read_s=0.002, probe_s=0.1, silence_s=0.1, part_s=0.08, flight_s=0.03, unasked_s=0)
GAP_S = 0.015
CLIENT = 7
HELLO = {
    "1.1": "0e000000 07 03 03000000 312e31",
    "1.2": "0f000000 07 03 03000000 312e32",
    "1.3": "18000000 07 03 0b000000 312e312c312e322c312e33",
    "1.4": "18000000 07 03 0b000000 312e312c312e322c312e33",
}
FLAGS = {"1.1": "00000000", "1.2": "00000000 01", "1.3": "00000000 01 00", "1.4": "00000000 01 00"}
SERVER_SETTINGS = {
    "1.1": "0f000000 01 02 07 03000000 312e31 0101010101",
    "1.2": "10000000 01 02 07 03000000 312e32 010101010101",
    "1.3": "21000000 01 02 07 0b000000 312e312c312e322c312e33 01010101010101 e8030000 0a000000",
    "1.4": "25000000 01 02 07 0f000000 312e312c312e322c312e332c312e34 01010101010101 e8030000 0a000000",
}
PROBE = "02000000 07 05"
CONNECTED, NOT_CONNECTED = "03000000 07 07 01", "03000000 07 07 00"
NO_MODE, JOYSTICK_MODE, AI_MODE = (f"06000000 07 0a 0{mode}000000" for mode in (1, 2, 3))
FORWARD = "0e000000 07 0b 00000000 0000803f 0000803f"
TURN = "06000000 07 0c 0000003f"
STOP = "02000000 07 0d"
GET_POSITION, GET_MAP, LIDAR_ON = "02000000 07 36", "02000000 07 34", "06000000 07 32 01000000"
EMPTY_TEXT = "06000000 07 01 00000000"
VERSIONS = ("1.1", "1.2", "1.3", "1.4")


def raw(text: str) -> bytes:
    return bytes.fromhex(text)


def hello(version: str, udp: bool) -> bytes:
    return raw(HELLO[version] + ("01" if udp else "00") + FLAGS[version])


class Hq:
    """Plain sockets and the few habits of an HQ that behaves."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.tcp = socket.socket()
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.tcp.setblocking(False)
        self.udp.setblocking(False)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.stream = b""

    async def connect(self) -> None:
        await asyncio.get_running_loop().sock_connect(self.tcp, ("127.0.0.1", self.port))

    async def send(self, text: str) -> None:
        await asyncio.get_running_loop().sock_sendall(self.tcp, raw(text))
        await asyncio.sleep(GAP_S)

    async def send_udp(self, text: str) -> None:
        self.udp.sendto(raw(text), ("127.0.0.1", self.port))
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
                    data, source = self.udp.recvfrom(65536)
                    assert source == ("127.0.0.1", self.port)
                    return data
                await asyncio.sleep(0.005)

    async def greet(self, version: str, udp: bool) -> None:
        """Connect, answer the settings, probe, and keep silent as long as the page demands."""
        await self.connect()
        assert (await self.read())[5] == 2
        await self.send(hello(version, udp).hex())
        if udp:
            assert await self.read() == raw("02000000 01 04")
            await self.send_udp(PROBE)
            assert await self.read_udp() == raw("03000000 01 06 01")
            await self.send(CONNECTED)
            await asyncio.sleep(QUICK.probe_s + GAP_S)

    def close(self) -> None:
        self.tcp.close()
        self.udp.close()


@contextlib.asynccontextmanager
async def facing(robot: FragileRobot) -> AsyncIterator[tuple[Hq, "asyncio.Task[None]"]]:
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(robot.serve("127.0.0.1", 0, port.set_result))
    hq = Hq(await port)
    try:
        yield hq, task
    finally:
        hq.close()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def quick(version: str = "1.3", udp: bool = False, **options: Any) -> FragileRobot:
    return FragileRobot(version=version, udp=udp, seed=1, **{"client_id": CLIENT, "times": QUICK, **options})


async def violated(robot: FragileRobot, words: str) -> None:
    """Wait until a violation with these words was noted."""
    for _ in range(400):
        if any(words in violation for violation in robot.violations):
            return
        await asyncio.sleep(0.005)
    raise AssertionError(f"{words!r} is not among {robot.violations}")


async def died(robot: FragileRobot, task: "asyncio.Task[None]", words: str) -> None:
    async with asyncio.timeout(2):
        await task
    assert not robot.alive
    assert words in robot.death
    assert robot.death in robot.violations


# An HQ that behaves


@pytest.mark.parametrize("udp", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
async def test_an_hq_that_behaves_is_not_reproached(version: str, udp: bool) -> None:
    robot = quick(version, udp, times=Times(probe_s=0.1, silence_s=0.1, part_s=0.02, unasked_s=0.02))
    async with facing(robot) as (hq, _):
        await hq.greet(version, udp)
        await hq.send(JOYSTICK_MODE)
        for drive in (FORWARD, TURN):
            await (hq.send_udp(drive) if udp else hq.send(drive))
        for text in (STOP, "08000000 07 01 02000000 6869", "05000000 07 28 010203", LIDAR_ON, GET_POSITION):
            await hq.send(text)
        scan = "a6050000 07 3d 68010000" + "0000c842" * 360
        if version != "1.1":
            await (hq.send_udp(scan) if udp else hq.send(scan))
        if version != "1.4":
            await hq.send(GET_MAP)
        assert robot.violations == []
        assert robot.alive
        by_udp = ["udp"] if udp else ["tcp"]
        assert [row[1] for row in robot.received if row[2] in (11, 12, 61)] == by_udp * (2 + (version != "1.1"))
        assert [row[2] for row in robot.received].count(13) == 1


@pytest.mark.parametrize("version", VERSIONS)
async def test_the_robot_speaks_first_with_the_settings_of_its_version(version: str) -> None:
    async with facing(quick(version, udp=True)) as (hq, _):
        await hq.connect()
        assert await hq.read() == raw(SERVER_SETTINGS[version])


async def test_a_lost_probe_is_answered_by_tcp_and_everything_goes_by_tcp() -> None:
    robot = quick(udp=True, loss=Loss.PROBE)
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        await hq.send(hello("1.3", udp=True).hex())
        await hq.read()
        await hq.send_udp(PROBE)
        assert await hq.read() == raw("03000000 01 06 00")
        for text in (NOT_CONNECTED, FORWARD, STOP):
            await hq.send(text)
        assert robot.violations == []


async def test_a_lost_answer_ends_with_a_late_status() -> None:
    robot = quick(udp=True, loss=Loss.ANSWER)
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        await hq.send(hello("1.3", udp=True).hex())
        await hq.read()
        await hq.send_udp(PROBE)
        await asyncio.sleep(QUICK.probe_s)
        for text in (NOT_CONNECTED, FORWARD):
            await hq.send(text)
        assert robot.violations == []


async def test_answers_are_those_of_the_page() -> None:
    robot = quick("1.1", misnamed=0.0)
    async with facing(robot) as (hq, _):
        await hq.greet("1.1", udp=False)
        await hq.send(LIDAR_ON)
        assert await hq.read() == raw("06000000 01 33 01000000")
        await hq.send(GET_POSITION)
        assert await hq.read() == raw("0e000000 01 37 00000000 00000000 0000b4c2")
        await hq.send(GET_MAP)
        assert await hq.read() == raw("02000000 01 35")
        await hq.send(GET_MAP)
        assert (await hq.read())[:10] == raw("16270000 01 35 10270000")


async def test_a_position_may_come_as_id_53() -> None:
    async with facing(quick(misnamed=1.0)) as (hq, _):
        await hq.greet("1.3", udp=False)
        await hq.send(GET_POSITION)
        assert await hq.read() == raw("0e000000 01 35 00000000 00000000 0000b4c2")


async def test_map_parts_cover_the_map_run_past_its_end_and_come_again_and_again_unasked() -> None:
    robot = quick("1.4", udp=True, parts=4)
    async with facing(robot) as (hq, _):
        await hq.greet("1.4", udp=True)
        parts = [await hq.read_udp() for _ in range(6)]
        bounds = [struct.unpack_from("<iBBii", part)[1:] for part in parts]
        once = [(1, 56, 0, 2501), (1, 56, 2501, 5002), (1, 56, 5002, 7503), (1, 56, 7503, 10004)]
        assert bounds == [*once, *once[:2]]
        assert parts[:2] == parts[4:]


async def test_a_1_4_reads_tcp_while_it_sends_its_map() -> None:
    robot = quick("1.4", parts=4)
    async with facing(robot) as (hq, _):
        await hq.greet("1.4", udp=False)
        for drive in (FORWARD, STOP, TURN):
            assert (await hq.read())[5] == 56
            await hq.send(drive)
        assert robot.violations == []
        assert [row[2] for row in robot.received] == [3, 11, 13, 12]


async def test_a_1_4_sends_no_parts_to_who_did_not_announce_lidar_sim_and_does_not_answer_52() -> None:
    robot = quick("1.4", parts=4)
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        await hq.send(hello("1.4", udp=False).hex()[:-4] + "0000")
        await hq.send(GET_MAP)
        await hq.send(LIDAR_ON)
        assert (await hq.read())[5] == 51
        assert robot.violations == []


async def test_52_to_a_robot_that_sends_parts_by_itself_is_noted() -> None:
    robot = quick("1.4", parts=4)
    async with facing(robot) as (hq, _):
        await hq.greet("1.4", udp=False)
        assert (await hq.read())[5] == 56
        await hq.send(GET_MAP)
        assert robot.violations == [], "it was in flight"
        await asyncio.sleep(QUICK.flight_s)
        await hq.send(GET_MAP)
        await violated(robot, "packet 52 to a robot that sends its map in parts by itself")


async def test_it_talks_unasked_and_once_with_two_headers() -> None:
    robot = quick("1.3", times=Times(unasked_s=0.01))
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        packets = [await hq.read() for _ in range(18)]
        assert {packet[5] for packet in packets} == {1, 31, 40, 51, 53, 55, 60}
        doubled = raw("17000000 01 01 11000000 01 01 0b000000") + b"two headers"
        assert packets.count(doubled) == 1


async def test_it_moves_forward_along_y_and_does_not_stop_by_itself() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        robot.machine.place.heading = 0.0
        await hq.send(FORWARD)
        await asyncio.sleep(1.2)
        reached = robot.machine.place.x
        assert 0.4 < reached < 0.8
        assert robot.machine.moving
        await hq.send(STOP)
        assert not robot.machine.moving


async def test_in_mode_3_it_drives_on_after_a_stop_until_the_mode_ends_and_another_stop_comes() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        for text, moves in ((AI_MODE, True), (STOP, True), (NO_MODE, True), (STOP, False), (JOYSTICK_MODE, False)):
            await hq.send(text)
            await asyncio.sleep(0.05)
            assert robot.machine.moving is moves
        assert robot.violations == []


async def test_what_piled_up_while_the_process_stood_still_is_read_as_one_packet_and_lost() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        await hq.send(FORWARD)
        assert robot.machine.moving
        for _ in range(5):
            hq.tcp.send(raw(STOP))
            time.sleep(0.05)  # noqa: ASYNC251 - nobody is to run meanwhile
        await violated(robot, "5 packets in one read")
        assert "(this process read nothing for" in robot.violations[0]
        assert [row[1:] for row in robot.piled] == [("tcp", 13, b"")] * 5
        await asyncio.sleep(0.1)
        assert robot.machine.moving
        assert [row[2] for row in robot.received] == [3, 11]
        await hq.send(STOP)
        assert not robot.machine.moving


async def test_a_tenth_can_be_misread_in_an_order_that_the_seed_gives_each_packet_id() -> None:
    orders = []
    for others in (0, 3):
        robot = quick("1.1", misread=0.3)
        async with facing(robot) as (hq, _):
            await hq.greet("1.1", udp=False)
            for number in range(12):
                await hq.send(f"06000000 07 32 0{number % 2 + 1}000000")
                for _ in range(others):
                    await hq.send(STOP)
            rows = sorted(
                [(at, True) for at, _, kind, _ in robot.received if kind == 50]
                + [(at, False) for at, _, kind, _ in robot.misread if kind == 50]
            )
            orders.append([taken for _, taken in rows])
            assert robot.violations == []
    assert orders[0] == orders[1]
    assert len(orders[0]) == 12
    assert set(orders[0]) == {True, False}


@pytest.mark.parametrize(
    ("name", "version", "udp", "obeys"),
    [
        ("tcpudp-1.1-tcp.hex", "1.1", False, {Feature.JOYSTICK, Feature.LIDAR}),
        ("tcpudp-1.3-udp.hex", "1.3", True, {Feature.JOYSTICK}),
    ],
)
async def test_the_recorded_hq_is_not_reproached(name: str, version: str, udp: bool, obeys: set[Feature]) -> None:
    features = {Feature.LIDAR_SIM, Feature.SLAM_MAP} if udp else set()
    robot = quick(version, udp, client_id=1, features=features, obeys=obeys)
    said = captures.payloads(name, destination=11001)
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        for record in said:
            await (hq.send_udp if record.transport == "UDP" else hq.send)(record.payload.hex())
            if record.payload[5] == 7:
                await asyncio.sleep(QUICK.probe_s)
        assert robot.violations == []
        assert [row[1:] for row in robot.received] == [
            (record.transport.lower(), record.payload[5], record.payload[6:]) for record in said
        ]


# What it dies of


@pytest.mark.parametrize(
    ("version", "without", "text", "kind"),
    [
        ("1.3", {Feature.LIDAR}, LIDAR_ON, 50),
        ("1.3", {Feature.JOYSTICK}, JOYSTICK_MODE, 10),
        ("1.3", {Feature.JOYSTICK}, FORWARD, 11),
        ("1.3", {Feature.JOYSTICK}, TURN, 12),
        ("1.3", {Feature.JOYSTICK}, STOP, 13),
        ("1.3", {Feature.JOYSTICK}, "02000000 07 15", 21),
        ("1.3", {Feature.CHAT}, "02000000 07 28", 40),
        ("1.3", {Feature.LIDAR_SIM}, "06000000 07 3d 68010000", 61),
        ("1.1", set(), "06000000 07 3d 68010000", 61),
        ("1.3", {Feature.SLAM_MAP}, GET_MAP, 52),
        ("1.4", {Feature.SLAM_MAP}, GET_POSITION, 54),
        ("1.1", {Feature.LIDAR}, GET_MAP, 52),
        ("1.2", {Feature.LIDAR}, GET_POSITION, 54),
        ("1.3", set(), "02000000 07 46", 70),
        ("1.3", set(), "02000000 07 33", 51),
        ("1.3", set(), CONNECTED, 7),
    ],
)
async def test_it_dies_of_an_unregistered_id(version: str, without: set[Feature], text: str, kind: int) -> None:
    features = set(list(Feature)[: parser.FLAGS[version]]) - without
    robot = quick(version, features=features)
    async with facing(robot) as (hq, task):
        await hq.greet(version, udp=False)
        await hq.send(text)
        await died(robot, task, f"unregistered packet id {kind}")
        if version == "1.4" and (await hq.read())[5] != 56:
            raise AssertionError("a map part was sent before it died")
        with pytest.raises((EOFError, ConnectionError)):
            await hq.read()
        again = Hq(hq.port)
        with pytest.raises(ConnectionRefusedError), contextlib.closing(again):
            await again.connect()


async def test_a_robot_that_obeys_what_it_does_not_announce_survives() -> None:
    robot = quick(features={Feature.CAM}, obeys={Feature.JOYSTICK})
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        await hq.send(STOP)
        assert robot.violations == []


@pytest.mark.parametrize("text", ["03000000 07 0d", "02000000 07 0d 00", "02000000 07", "ffffffff 07 0d"])
async def test_it_dies_of_a_datagram_with_a_wrong_length(text: str) -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, task):
        await hq.greet("1.3", udp=True)
        await hq.send_udp(text)
        await died(robot, task, "a datagram whose length field is wrong")


async def test_it_dies_of_udp_before_tcp() -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, task):
        await hq.send_udp(PROBE)
        await died(robot, task, "a datagram before TCP: 02 00 00 00 07 05")


async def test_it_dies_of_udp_before_it_sent_4() -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, task):
        await hq.connect()
        await hq.read()
        await hq.send_udp(PROBE)
        await died(robot, task, "a datagram before the robot sent 4")


async def test_it_dies_of_an_empty_text() -> None:
    robot = quick()
    async with facing(robot) as (hq, task):
        await hq.greet("1.3", udp=False)
        await hq.send(EMPTY_TEXT)
        await died(robot, task, "a debugMessage with an empty text")


@pytest.mark.parametrize("count", [1, 2, 4, 8])
@pytest.mark.parametrize("version", ["1.3", "1.4"])
async def test_a_version_list_of_a_deadly_length_kills(version: str, count: int) -> None:
    robot = quick(version)
    versions = ",".join(["1.1", "1.2", "1.3", "1.4", "1.5", "1.6", "1.7", "1.8"][:count]).encode()
    body = struct.pack("<i", len(versions)) + versions + bytes(7)
    async with facing(robot) as (hq, task):
        await hq.connect()
        await hq.send((struct.pack("<iBB", 2 + len(body), CLIENT, 3) + body).hex())
        await died(robot, task, f"a version list of {count} entries")


# What it notes and survives


@pytest.mark.parametrize(
    ("version", "text"),
    [
        ("1.1", "18000000 07 03 0b000000 312e312c312e322c312e33 01000000000100"),
        ("1.2", "0e000000 07 03 03000000 312e31 0100000000"),
        ("1.3", "18000000 07 03 0b000000 312e312c312e322c312e34 01000000000100"),
    ],
)
async def test_other_version_strings_leave_all_flags_false(version: str, text: str) -> None:
    robot = quick(version, udp=True)
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        await hq.send(text)
        await violated(robot, "to a robot that understands")
        await hq.send(STOP)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await hq.read()  # no 4
        assert robot.alive


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (STOP + STOP, "two packets in one read: 02 00 00 00 07 0d 02 00 00 00 07 0d"),
        (STOP + STOP + STOP, "3 packets in one read"),
        (STOP + "0200", "1 packets and a part of one in one read"),
        ("0600000007", "a split packet, 5 of 10 bytes in one read: 06 00 00 00 07"),
        ("0600", "a split packet, 2 bytes in one read: 06 00"),
        ("00000000 07 0d", "no packet in one read, its length field is wrong: 00 00 00 00 07 0d"),
        ("06000000 08 0a 02000000", "id byte 8 instead of 7"),
        ("06000000 00 0a 02000000", "id byte 0 instead of 7"),
        ("06000000 07 0a 04000000", "control mode 4"),
        ("05000000 07 0a 020000", "a body of 3 bytes instead of 4"),
        ("06000000 07 32 03000000", "lidar mode 3"),
        ("0e000000 07 0b 0000803f 0000803f 0000803f", "a direction of length 1.414"),
        ("0e000000 07 0b 0000c07f 0000803f 0000803f", "numbers that are not finite"),
        ("06000000 07 0c 0000807f", "a number that is not finite"),
        ("0a000000 07 3d 01000000 0000c842", "n = 1 instead of 360"),
        ("0a000000 07 3d 68010000 0000c842", "8 bytes for 360 floats"),
        ("08000000 07 01 03000000 6869", "a wrong byte count of the string"),
        ("07000000 07 01 01000000 ff", "a text that is not ASCII"),
        (HELLO["1.3"] + "00" + FLAGS["1.3"], "a second clientSettings"),
    ],
)
async def test_a_bad_read_or_packet_is_noted_with_its_bytes(text: str, words: str) -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        await hq.send(text)
        await violated(robot, words)
        assert len(robot.violations) == 1
        assert robot.alive


async def test_packets_too_near_to_each_other_are_lost() -> None:
    robot = quick(times=Times(read_s=0.4, unasked_s=0))
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        for _ in range(3):
            await asyncio.get_running_loop().sock_sendall(hq.tcp, raw(STOP))
            await asyncio.sleep(0.001)
        await violated(robot, "packets in one read: 02 00 00 00 07 0d 02")


async def test_packets_back_to_back_are_held_against_the_hq() -> None:
    robot = quick(times=Times(read_s=0.002, gap_s=0.01, unasked_s=0))
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        for number in range(50):  # a busy machine may excuse some
            await asyncio.sleep(0.1)
            await hq.send(STOP + STOP)
            await violated(robot, "two packets in one read")
            if "(this process" not in robot.violations[number]:
                break
        assert "(this process" not in robot.violations[-1]
        assert len(robot.piled) == 2 * (len(robot.violations) - 1)


async def test_a_split_packet_is_one_violation_and_the_next_packet_is_read() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        for text in ("060000", "00 07", "0a 02000000"):
            await hq.send(text)
        await hq.send(STOP)
        assert robot.violations == ["a split packet, 3 bytes in one read: 06 00 00"]
        assert [row[2] for row in robot.received] == [3, 13]


async def test_a_packet_over_4096_bytes_is_lost() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        await hq.send("fe0f0000 07 28" + "00" * 4092)
        await violated(robot, "a packet of 4098 bytes, over 4096")
        await hq.send("fc0f0000 07 28" + "00" * 4090)
        assert len(robot.violations) == 1
        assert [row[2] for row in robot.received] == [3, 40]


async def test_commands_before_the_settings_are_noted() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.send(STOP)
        await violated(robot, "packet 13 while the robot waits for 1 or 3")


async def test_id_zero_passes_before_the_settings() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.send(hello("1.3", udp=False).hex().replace("1800000007", "1800000000"))
        await hq.send(STOP)
        assert robot.violations == []


@pytest.mark.parametrize(
    ("flags", "words"),
    [("01000000", "4 flags"), ("0100000000010000", "8 flags"), ("", "0 flags")],
)
async def test_settings_of_another_length_are_noted(flags: str, words: str) -> None:
    robot = quick()
    versions = "0b000000 312e312c312e322c312e33"
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.send(f"{17 + len(flags) // 2:02x}000000 07 03 {versions} {flags}")
        await violated(robot, f"{words} for the versions '1.1,1.2,1.3' instead of 7")


async def test_settings_without_a_string_are_noted() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.send("06000000 07 03 09000000")
        await violated(robot, "no version string")


# The UDP probe


@contextlib.asynccontextmanager
async def probing(robot: FragileRobot) -> AsyncIterator[Hq]:
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        await hq.send(hello("1.3", udp=True).hex())
        assert await hq.read() == raw("02000000 01 04")
        yield hq


@pytest.mark.parametrize("meanwhile", [CONNECTED + STOP, STOP, CONNECTED + CONNECTED])
async def test_tcp_other_than_one_7_while_it_sleeps_is_noted(meanwhile: str) -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send(meanwhile)
        await violated(robot, "TCP other than one 7 within 0.1 s of the 4: 0")


async def test_tcp_too_soon_after_it_slept_is_noted() -> None:
    robot = quick(udp=True, times=Times(read_s=0.002, probe_s=0.1, silence_s=0.4, unasked_s=0))
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send(CONNECTED)
        await asyncio.sleep(0.15)
        await hq.send(STOP)
        await violated(robot, "packet 13 by TCP within 0.4 s of the 4")
        await asyncio.sleep(0.3)
        await hq.send(STOP)
        assert len(robot.violations) == 1


async def test_two_probes_are_noted() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send_udp(PROBE)
        await violated(robot, "2 probes 5 by UDP instead of one")


async def test_no_probe_is_noted() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        assert await hq.read() == raw("03000000 01 06 00")
        await violated(robot, "no 5 by UDP within 0.1 s of the 4")


async def test_a_late_probe_is_noted() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.read()
        await hq.send_udp(PROBE)
        await violated(robot, "the probe 5 came later than 0.1 s after the 4")


async def test_a_missing_status_is_noted() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await violated(robot, "no 7 within 0.2 s of the 4")


async def test_a_status_without_an_answer_is_noted() -> None:
    robot = quick(udp=True, loss=Loss.ANSWER)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send(CONNECTED)
        await violated(robot, "7(true) though no 6(true) was received")


async def test_a_second_status_is_noted() -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=True)
        await hq.send(CONNECTED)
        await violated(robot, "a second 7")


async def test_a_status_nobody_asked_for_is_noted() -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        await hq.send(CONNECTED)
        await violated(robot, "a 7 though the robot sent no 4")


async def test_drive_by_udp_before_the_probe_is_noted() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.send_udp(FORWARD)
        await violated(robot, "a datagram before the probe 5: 0e 00 00 00 07 0b")


async def test_drive_by_udp_while_it_sleeps_is_noted() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send_udp(FORWARD)
        await violated(robot, "packet 11 while the robot waits for 5 or 7")


@pytest.mark.parametrize(
    ("text", "by_udp", "words"),
    [
        (FORWARD, False, "packet 11 by TCP instead of UDP"),
        (TURN, False, "packet 12 by TCP instead of UDP"),
        (STOP, True, "packet 13 by UDP instead of TCP"),
        (PROBE, False, "packet 5 by TCP instead of UDP"),
    ],
)
async def test_the_wrong_channel_is_noted(text: str, by_udp: bool, words: str) -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=True)
        await (hq.send_udp(text) if by_udp else hq.send(text))
        await violated(robot, words)


async def test_drive_by_udp_without_agreement_is_noted() -> None:
    robot = quick(udp=True, loss=Loss.ANSWER)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send(NOT_CONNECTED)
        await asyncio.sleep(QUICK.probe_s)
        await hq.send_udp(FORWARD)
        await violated(robot, "packet 11 by UDP instead of TCP")


async def test_a_datagram_from_another_socket_is_noted() -> None:
    robot = quick(udp=True)
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=True)
        with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
            other.sendto(raw(FORWARD), ("127.0.0.1", hq.port))
        await violated(robot, "not from where 5 came from")


# Its one connection


async def test_after_a_disconnect_it_accepts_and_says_nothing() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        hq.tcp.close()
        await asyncio.sleep(GAP_S)
        again = Hq(hq.port)
        with contextlib.closing(again):
            await again.connect()
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.1):
                    await again.read()
            await again.send_udp(FORWARD)
            await violated(robot, "a datagram after the TCP connection ended")
        assert [event.split(",")[0] for event in robot.events] == ["the HQ closed the connection", "second connection"]
        assert len(robot.violations) == 1


async def test_a_second_connection_may_work_and_lose_half_and_get_no_telemetry() -> None:
    robot = quick("1.1", again=True, client_id=2, times=Times(read_s=0.002, unasked_s=0.01))
    async with facing(robot) as (hq, _):
        await hq.connect()
        await hq.read()
        await hq.send(hello("1.1", udp=False).hex().replace("07", "02", 1))
        assert (await hq.read())[5] in (1, 31, 40, 51, 53, 55)
        hq.tcp.close()
        await asyncio.sleep(GAP_S)
        again = Hq(hq.port)
        with contextlib.closing(again):
            await again.connect()
            assert (await again.read())[4:7] == bytes([1, 2, 3]), "client id 3"
            await again.send(hello("1.1", udp=False).hex().replace("07", "03", 1))
            for _ in range(60):
                await again.send(LIDAR_ON.replace("07", "03", 1))
            answers = 0
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.3):
                    while (await again.read())[5] == 51:
                        answers += 1
            taken = [row[2] for row in robot.received].count(50)
            assert 15 < taken < 45
            assert 4 < answers < taken
        assert robot.violations == []


async def test_a_connection_that_breaks_is_an_event() -> None:
    robot = quick(times=Times(unasked_s=0.005))
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        hq.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        hq.tcp.close()
        for _ in range(200):
            if robot.events:
                break
            await asyncio.sleep(0.01)
        assert robot.events[0].startswith("the connection broke"), robot.events
        assert robot.violations == []


async def test_a_status_that_denies_the_answer_is_an_event_and_all_goes_by_tcp() -> None:
    robot = quick(udp=True)
    async with probing(robot) as hq:
        await hq.send_udp(PROBE)
        await hq.send(NOT_CONNECTED)
        await asyncio.sleep(QUICK.probe_s)
        await hq.send(FORWARD)
        assert robot.events == ["7(false) though 6(true) was sent by UDP"]
        assert robot.violations == []


async def test_a_port_in_use_is_an_error() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="in use"):
            await quick().serve("127.0.0.1", taken.getsockname()[1], print)


async def test_a_second_connection_hears_nothing_and_does_no_harm() -> None:
    robot = quick()
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        others = [Hq(hq.port) for _ in range(20)]
        for other in others:
            await other.connect()
        await hq.send(STOP)
        for other in others:
            other.close()
        assert len(robot.events) == 20
        assert robot.violations == []
        assert robot.received[-1][2] == 13


async def test_what_is_kept_is_bounded() -> None:
    robot = quick(keep=2)
    async with facing(robot) as (hq, _):
        await hq.greet("1.3", udp=False)
        for _ in range(3):
            await hq.send("02000000 08 0d")
        assert len(robot.violations) == 2
        assert [row[2] for row in robot.received] == [13, 13]


# As a process


async def test_the_simulator_logs_violations_and_says_what_it_died_of(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    ready: Callable[[int], None] = port.set_result
    task = asyncio.create_task(simulate_fragile("127.0.0.1", 0, version="1.3", udp=False, seed=3, ready=ready))
    with contextlib.closing(Hq(await port)) as hq:
        await hq.connect()
        client = (await hq.read())[6]
        await hq.send(f"02000000 {client:02x} 48")
        async with asyncio.timeout(2):
            await task
    assert capsys.readouterr().out.startswith("died: unregistered packet id 72")
    assert [record.levelno for record in caplog.records if "violation" in record.message] == [logging.ERROR]


def test_a_feature_the_version_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="LIDAR_SIM"):
        quick("1.1", features={Feature.LIDAR_SIM})


def test_a_seed_gives_the_same_robot() -> None:
    one, two = (FragileRobot(version="1.3", udp=True, seed=5) for _ in range(2))
    assert repr(one) == repr(two)
    assert one.client_id == two.client_id
    talks = [robot.machine.unasked("1.3", robot.features, ()) for robot in (one, two)]
    assert [next(talks[0]) for _ in range(9)] == [next(talks[1]) for _ in range(9)]
