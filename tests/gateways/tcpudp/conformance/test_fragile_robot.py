"""The fragile robot against a small HQ written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import socket
import struct
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.tcpudp.conformance import parser
from gateways.tcpudp.conformance.fragile_robot import FragileRobot, Loss, simulate_fragile
from gateways.tcpudp.conformance.parser import Feature, Times
from tests import captures
from tests.conformance.scene import LONG_S, Peer, Scene, Script, scripts, serving, until

QUICK = Times(read_s=0.002, probe_s=0.3, silence_s=0.3, part_s=0.08, flight_s=0.1, unasked_s=0)
GAP_S = 0.015
CLIENT = 7
VERSIONS = ("1.1", "1.2", "1.3", "1.4")
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
NAMES = {
    "START": "02000000 01 04",
    "PROBE": "02000000 07 05",
    "RECEIVED": "03000000 01 06 01",
    "LOST": "03000000 01 06 00",
    "CONNECTED": "03000000 07 07 01",
    "NOT_CONNECTED": "03000000 07 07 00",
    "NO_MODE": "06000000 07 0a 01000000",
    "JOYSTICK_MODE": "06000000 07 0a 02000000",
    "AI_MODE": "06000000 07 0a 03000000",
    "FORWARD": "0e000000 07 0b 00000000 0000803f 0000803f",
    "TURN": "06000000 07 0c 0000003f",
    "STOP": "02000000 07 0d",
    "GET_POSITION": "02000000 07 36",
    "GET_MAP": "02000000 07 34",
    "LIDAR_ON": "06000000 07 32 01000000",
    "EMPTY_TEXT": "06000000 07 01 00000000",
    "SCAN": "a6050000 07 3d 68010000" + "0000c842" * 360,
    "HELLO": HELLO["1.3"] + "00" + FLAGS["1.3"],
}


def hello(version: str, udp: bool) -> str:
    return HELLO[version] + ("01" if udp else "00") + FLAGS[version]


class Hq(Scene):
    """Plain sockets and the few habits of an HQ that behaves."""

    names = NAMES
    gap_s = GAP_S

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)

    async def by_udp(self, text: str) -> None:
        self.udp.sendto(self.raw(text), ("127.0.0.1", self.peer.port))
        await asyncio.sleep(GAP_S)

    async def established(self, _: str) -> None:
        await until(lambda: "ESTABLISHED" in repr(self.judge), repr(self.judge))

    async def awake(self, _: str) -> None:
        """Wait until it has slept after its 4."""
        await until(lambda: "ASLEEP" not in repr(self.judge), repr(self.judge))

    async def silence_over(self, _: str) -> None:
        """Wait until more than the 7 may come by TCP."""
        await until(lambda: time.monotonic() > self.judge._quiet_until, "the end of the silence")

    async def send_until_noted(self, text: str) -> None:
        """Send it again and again: nobody knows how late the robot's own time is."""
        async with asyncio.timeout(LONG_S):
            while not self.judge.violations:
                await self.send(text)

    async def by_udp_until_noted(self, text: str) -> None:
        async with asyncio.timeout(LONG_S):
            while not self.judge.violations:
                await self.by_udp(text)

    async def packet(self) -> bytes:
        head: bytes = await self.peer.read(4)
        return head + bytes(await self.peer.read(struct.unpack("<i", head)[0]))

    async def kind(self, kind: str) -> None:
        """Read a packet of this id."""
        assert (await self.packet())[5] == int(kind)

    async def datagram(self) -> bytes:
        async with asyncio.timeout(2):
            while True:
                with contextlib.suppress(BlockingIOError):
                    data, source = self.udp.recvfrom(65536)
                    assert source == ("127.0.0.1", self.peer.port)
                    return data
                await asyncio.sleep(0.005)

    async def expect_udp(self, text: str) -> None:
        assert await self.datagram() == self.raw(text)

    async def meet(self, _: str) -> None:
        """Connect, and take the settings."""
        await self.connect("")
        await self.kind("2")

    async def greet(self, how: str) -> None:
        """Answer the settings too, probe, and keep silent as long as the page demands: ``"1.3"``, ``"1.3 udp"``."""
        version, udp = how[:3] or "1.3", how.endswith("udp")
        await self.meet("")
        await self.send(hello(version, udp))
        if udp:
            await self.play(["< START", "by_udp PROBE", "expect_udp RECEIVED", "> CONNECTED"])
            await self.established("")

    async def probing(self, _: str) -> None:
        """Answer the settings with UDP, and take the 4."""
        await self.meet("")
        await self.send(hello("1.3", udp=True))
        await self.expect("START")

    async def took(self, kinds: str) -> None:
        wanted = [int(kind) for kind in kinds.split()]
        await until(lambda: len(self.judge.received) >= len(wanted), lambda: self.judge.received)
        assert [row[2] for row in self.judge.received] == wanted

    async def silent(self, _: str) -> None:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await self.packet()

    async def moving(self, moves: str) -> None:
        await until(lambda: self.judge.machine.moving is (moves == "yes"), f"moving {moves}")


@contextlib.asynccontextmanager
async def facing(robot: FragileRobot) -> AsyncIterator[Hq]:
    async with serving(robot, Peer, Hq) as hq:
        with contextlib.closing(hq.udp):
            yield hq


def quick(version: str = "1.3", udp: bool = False, **options: Any) -> FragileRobot:
    return FragileRobot(version=version, udp=udp, seed=1, **{"client_id": CLIENT, "times": QUICK, **options})


UDP: dict[str, Any] = {"udp": True}
PARTS: dict[str, Any] = {"version": "1.4", "parts": 4}


@scripts(
    {
        "a lost probe is answered by TCP, and everything goes by TCP": (
            {"udp": True, "loss": Loss.PROBE},
            ["probing", "by_udp PROBE", "< LOST", "> NOT_CONNECTED", "> FORWARD", "> STOP", "ok"],
        ),
        "a lost answer ends with a late status": (
            {"udp": True, "loss": Loss.ANSWER},
            ["probing", "by_udp PROBE", "awake", "> NOT_CONNECTED", "> FORWARD", "ok"],
        ),
        "the answers are those of the page": (
            {"version": "1.1", "misnamed": 0.0},
            ["greet 1.1", "> LIDAR_ON", "< 06000000 01 33 01000000", "> GET_POSITION"]
            + ["< 0e000000 01 37 00000000 00000000 0000b4c2", "> GET_MAP", "< 02000000 01 35", "> GET_MAP"]
            + ["< 16270000 01 35 10270000"],
        ),
        "a position may come as id 53": (
            {"misnamed": 1.0},
            ["greet", "> GET_POSITION", "< 0e000000 01 35 00000000 00000000 0000b4c2"],
        ),
        "a 1.4 reads TCP while it sends its map": (
            PARTS,
            ["greet 1.4", "kind 56", "> FORWARD", "kind 56", "> STOP", "kind 56", "> TURN", "ok", "took 3 11 13 12"],
        ),
        "a 1.4 sends no parts to who did not announce lidar_sim, and does not answer 52": (
            PARTS,
            ["meet", f"> {HELLO['1.4']} 00 00000000 0000", "> GET_MAP", "> LIDAR_ON", "kind 51", "ok"],
        ),
        "52 to a robot that sends parts by itself is noted, but not while it was in flight": (
            PARTS,
            ["greet 1.4", "kind 56", "> GET_MAP", "took 3 52", "ok", "send_until_noted GET_MAP"]
            + ["! packet 52 to a robot that sends its map in parts by itself"],
        ),
        "in mode 3 it drives on after a stop, until the mode ends and another stop comes": (
            {},
            ["greet", "> AI_MODE", "wait 0.05", "moving yes", "> STOP", "wait 0.05", "moving yes", "> NO_MODE"]
            + ["wait 0.05", "moving yes", "> STOP", "wait 0.05", "moving no", "> JOYSTICK_MODE", "moving no", "ok"],
        ),
        "a robot that obeys what it does not announce survives": (
            {"features": {Feature.CAM}, "obeys": {Feature.JOYSTICK}},
            ["greet", "> STOP", "ok"],
        ),
        "id 0 passes before the settings": (
            {},
            ["connect", f"> 18000000 00 {HELLO['1.3'][12:]} 00 {FLAGS['1.3']}", "> STOP", "ok"],
        ),
        "a second connection hears nothing and does no harm": ({}, ["greet", "crowd 20", "> STOP", "ok", "took 3 13"]),
        "a 7 that denies the answer is an event, and all goes by TCP": (
            UDP,
            ["probing", "by_udp PROBE", "> NOT_CONNECTED", "established", "> FORWARD", "ok"]
            + ["? 7(false) though 6(true) was sent by UDP", "told 1"],
        ),
        "a connection that breaks is an event": (
            {"times": Times(unasked_s=0.005)},
            ["greet", "reset", "? the connection broke", "ok"],
        ),
    }
)
async def test_what_an_hq_may_do(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as hq:
        await hq.play(steps)


NOTED: dict[str, Script] = {
    "commands before the settings": ({}, ["connect", "> STOP", "! packet 13 while the robot waits for 1 or 3"]),
    "settings without a string": ({}, ["connect", "> 06000000 07 03 09000000", "! no version string"]),
    "two probes": (UDP, ["probing", "by_udp PROBE", "by_udp PROBE", "! 2 probes 5 by UDP instead of one"]),
    "no probe": (UDP, ["probing", "< LOST", "! no 5 by UDP within 0.3 s of the 4"]),
    "a late probe": (UDP, ["probing", "< LOST", "by_udp PROBE", "! the probe 5 came later than 0.3 s after the 4"]),
    "a missing status": (UDP, ["probing", "by_udp PROBE", "! no 7 within 0.6 s of the 4"]),
    "a status without an answer": (
        {"udp": True, "loss": Loss.ANSWER},
        ["probing", "by_udp PROBE", "> CONNECTED", "! 7(true) though no 6(true) was received"],
    ),
    "a second status": (UDP, ["greet 1.3 udp", "> CONNECTED", "! a second 7"]),
    "a status nobody asked for": (UDP, ["greet", "> CONNECTED", "! a 7 though the robot sent no 4"]),
    "a drive by UDP before the probe": (
        UDP,
        ["probing", "by_udp FORWARD", "! a datagram before the probe 5: 0e 00 00 00 07 0b"],
    ),
    "a drive by UDP while it sleeps": (
        UDP,
        ["probing", "by_udp PROBE", "by_udp FORWARD", "! packet 11 while the robot waits for 5 or 7"],
    ),
    "a drive by UDP without agreement": (
        {"udp": True, "loss": Loss.ANSWER},
        ["probing", "by_udp PROBE", "> NOT_CONNECTED", "established", "by_udp FORWARD"]
        + ["! packet 11 by UDP instead of TCP"],
    ),
    "11 by TCP": (UDP, ["greet 1.3 udp", "> FORWARD", "! packet 11 by TCP instead of UDP"]),
    "12 by TCP": (UDP, ["greet 1.3 udp", "> TURN", "! packet 12 by TCP instead of UDP"]),
    "13 by UDP": (UDP, ["greet 1.3 udp", "by_udp STOP", "! packet 13 by UDP instead of TCP"]),
    "5 by TCP": (UDP, ["greet 1.3 udp", "> PROBE", "! packet 5 by TCP instead of UDP"]),
    "TCP too soon after it slept": (
        {"udp": True, "times": Times(read_s=0.002, probe_s=0.3, silence_s=1.0, unasked_s=0)},
        ["probing", "by_udp PROBE", "> CONNECTED", "established", "> STOP"]
        + ["! packet 13 by TCP within 1 s of the 4", "silence_over", "> STOP", "took 3 5 7 13 13", "!! packet 13"],
    ),
    "packets too near to each other, which are lost": (
        {"times": Times(read_s=0.4, unasked_s=0)},
        ["greet", "> STOP", "> STOP", "> STOP", "! packets in one read: 02 00 00 00 07 0d 02"],
    ),
    "a split packet, once, and the next packet is read": (
        {},
        ["greet", "> 060000", "> 00 07", "> 0a 02000000", "> STOP"]
        + ["!! a split packet, 3 bytes in one read: 06 00 00", "took 3 13"],
    ),
    "a packet over 4096 bytes, which is lost": (
        {},
        ["greet", "> fe0f0000 07 28" + "00" * 4092, "! a packet of 4098 bytes, over 4096"]
        + ["> fc0f0000 07 28" + "00" * 4090, "!! over 4096", "took 3 40"],
    ),
    **{
        f"while it sleeps, {meanwhile}": (
            UDP,
            ["probing", "by_udp PROBE", f"> {meanwhile}", "! TCP other than one 7 within 0.3 s of the 4: 0"],
        )
        for meanwhile in ("CONNECTED STOP", "STOP", "CONNECTED CONNECTED")
    },
    **{
        f"settings with {words}": (
            {},
            ["connect", f"> {17 + len(flags) // 2:02x}000000 07 03 0b000000 312e312c312e322c312e33 {flags}"]
            + [f"! {words} for the versions '1.1,1.2,1.3' instead of 7"],
        )
        for flags, words in (("01000000", "4 flags"), ("0100000000010000", "8 flags"), ("", "0 flags"))
    },
    **{
        words: ({}, ["greet", f"> {text}", f"!! {words}"])
        for text, words in (
            ("STOP STOP", "two packets in one read: 02 00 00 00 07 0d 02 00 00 00 07 0d"),
            ("STOP STOP STOP", "3 packets in one read"),
            ("STOP 0200", "1 packets and a part of one in one read"),
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
            ("HELLO", "a second clientSettings"),
        )
    },
}


@scripts(NOTED)
async def test_what_is_noted_and_survived(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as hq:
        await hq.play(steps)
        assert hq.judge.alive


def deadly_list(version: str, count: int) -> Script:
    versions = ",".join(["1.1", "1.2", "1.3", "1.4", "1.5", "1.6", "1.7", "1.8"][:count]).encode()
    body = struct.pack("<i", len(versions)) + versions + bytes(7)
    packet = (struct.pack("<iBB", 2 + len(body), CLIENT, 3) + body).hex()
    return {"version": version}, ["connect", f"> {packet}", f"died a version list of {count} entries"]


@scripts(
    {
        "UDP before TCP": (UDP, ["by_udp PROBE", "died a datagram before TCP: 02 00 00 00 07 05"]),
        "UDP before it sent 4": (UDP, ["meet", "by_udp PROBE", "died a datagram before the robot sent 4"]),
        "an empty text": ({}, ["greet", "> EMPTY_TEXT", "died a debugMessage with an empty text"]),
        **{
            f"a datagram with a wrong length, {text}": (
                UDP,
                ["greet 1.3 udp", f"by_udp {text}", "died a datagram whose length field is wrong"],
            )
            for text in ("03000000 07 0d", "02000000 07 0d 00", "02000000 07", "ffffffff 07 0d")
        },
        **{
            f"{version} of a list of {count}": deadly_list(version, count)
            for version in ("1.3", "1.4")
            for count in (1, 2, 4, 8)
        },
        **{
            f"{version} of the unregistered id {kind}, without {sorted(map(str, without))}": (
                {"version": version, "features": set(list(Feature)[: parser.FLAGS[version]]) - without},
                [f"greet {version}", f"> {text}", f"died unregistered packet id {kind}"]
                + (["kind 56"] if version == "1.4" else [])
                + ["eof", "refused"],
            )
            for version, without, text, kind in (
                ("1.3", {Feature.LIDAR}, "LIDAR_ON", 50),
                ("1.3", {Feature.JOYSTICK}, "JOYSTICK_MODE", 10),
                ("1.3", {Feature.JOYSTICK}, "FORWARD", 11),
                ("1.3", {Feature.JOYSTICK}, "TURN", 12),
                ("1.3", {Feature.JOYSTICK}, "STOP", 13),
                ("1.3", {Feature.JOYSTICK}, "02000000 07 15", 21),
                ("1.3", {Feature.CHAT}, "02000000 07 28", 40),
                ("1.3", {Feature.LIDAR_SIM}, "06000000 07 3d 68010000", 61),
                ("1.1", set(), "06000000 07 3d 68010000", 61),
                ("1.3", {Feature.SLAM_MAP}, "GET_MAP", 52),
                ("1.4", {Feature.SLAM_MAP}, "GET_POSITION", 54),
                ("1.1", {Feature.LIDAR}, "GET_MAP", 52),
                ("1.2", {Feature.LIDAR}, "GET_POSITION", 54),
                ("1.3", set(), "02000000 07 46", 70),
                ("1.3", set(), "02000000 07 33", 51),
                ("1.3", set(), "CONNECTED", 7),
            )
        },
    }
)
async def test_it_dies_of(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as hq:
        await hq.play(steps)


@pytest.mark.parametrize("udp", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
async def test_an_hq_that_behaves_is_not_reproached(version: str, udp: bool) -> None:
    robot = quick(version, udp, times=Times(probe_s=0.3, silence_s=0.3, part_s=0.02, unasked_s=0.02))
    drive = "by_udp" if udp else ">"
    async with facing(robot) as hq:
        await hq.play([f"greet {version}{' udp' * udp}", "> JOYSTICK_MODE", f"{drive} FORWARD", f"{drive} TURN"])
        for text in ("STOP", "08000000 07 01 02000000 6869", "05000000 07 28 010203", "LIDAR_ON", "GET_POSITION"):
            await hq.send(text)
        await hq.play([f"{drive} SCAN"] * (version != "1.1") + ["> GET_MAP"] * (version != "1.4") + ["ok"])
        assert [row[1] for row in robot.received if row[2] in (11, 12, 61)] == ["udp" if udp else "tcp"] * (
            2 + (version != "1.1")
        )
        assert [row[2] for row in robot.received].count(13) == 1


@pytest.mark.parametrize("version", VERSIONS)
async def test_the_robot_speaks_first_with_the_settings_of_its_version(version: str) -> None:
    async with facing(quick(version, udp=True)) as hq:
        await hq.play(["connect", f"< {SERVER_SETTINGS[version]}"])


async def test_map_parts_cover_the_map_run_past_its_end_and_come_again_and_again_unasked() -> None:
    async with facing(quick("1.4", udp=True, parts=4)) as hq:
        await hq.greet("1.4 udp")
        parts = [await hq.datagram() for _ in range(6)]
        bounds = [struct.unpack_from("<iBBii", part)[1:] for part in parts]
        once = [(1, 56, 0, 2501), (1, 56, 2501, 5002), (1, 56, 5002, 7503), (1, 56, 7503, 10004)]
        assert bounds == [*once, *once[:2]]
        assert parts[:2] == parts[4:]


async def test_it_talks_unasked_and_once_with_two_headers() -> None:
    async with facing(quick("1.3", times=Times(unasked_s=0.01))) as hq:
        await hq.greet("1.3")
        packets = [await hq.packet() for _ in range(18)]
        assert {packet[5] for packet in packets} == {1, 31, 40, 51, 53, 55, 60}
        assert packets.count(hq.raw("17000000 01 01 11000000 01 01 0b000000") + b"two headers") == 1


async def test_it_moves_forward_along_y_and_does_not_stop_by_itself() -> None:
    robot = quick()
    async with facing(robot) as hq:
        await hq.greet("1.3")
        robot.machine.place.heading = 0.0
        await hq.play(["> FORWARD", "wait 1.2"])
        assert 0.4 < robot.machine.place.x < 0.8
        await hq.play(["moving yes", "> STOP", "moving no"])


async def test_what_piled_up_while_the_process_stood_still_is_read_as_one_packet_and_lost() -> None:
    robot = quick()
    async with facing(robot) as hq:
        await hq.play(["greet", "> FORWARD", "moving yes"])
        for _ in range(5):
            hq.peer.tcp.send(hq.raw("STOP"))
            time.sleep(0.05)  # noqa: ASYNC251 - nobody is to run meanwhile
        await hq.violated("5 packets in one read")
        assert "(this process read nothing for" in robot.violations[0]
        assert [row[1:] for row in robot.piled] == [("tcp", 13, b"")] * 5
        await hq.play(["wait 0.1", "moving yes", "took 3 11", "> STOP", "moving no"])


async def test_packets_back_to_back_are_held_against_the_hq() -> None:
    robot = quick(times=Times(read_s=0.002, gap_s=0.01, unasked_s=0))
    async with facing(robot) as hq:
        await hq.greet("1.3")
        for number in range(50):  # a busy machine may excuse some
            await hq.play(["wait 0.1", "> STOP STOP", "! two packets in one read"])
            if "(this process" not in robot.violations[number]:
                break
        assert "(this process" not in robot.violations[-1]
        assert len(robot.piled) == 2 * (len(robot.violations) - 1)


async def test_a_tenth_can_be_misread_in_an_order_that_the_seed_gives_each_packet_id() -> None:
    orders = []
    for others in (0, 3):
        robot = quick("1.1", misread=0.3)
        async with facing(robot) as hq:
            await hq.greet("1.1")
            for number in range(12):
                await hq.play([f"> 06000000 07 32 0{number % 2 + 1}000000"] + ["> STOP"] * others)
            rows = sorted(
                [(at, True) for at, _, kind, _ in robot.received if kind == 50]
                + [(at, False) for at, _, kind, _ in robot.misread if kind == 50]
            )
            orders.append([taken for _, taken in rows])
            await hq.ok("")
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
    async with facing(robot) as hq:
        await hq.meet("")
        for count, record in enumerate(said, 1):
            await (hq.by_udp if record.transport == "UDP" else hq.send)(record.payload.hex())
            await until(lambda count=count: len(robot.received) == count, lambda: robot.violations)  # type: ignore[misc]
        await hq.ok("")
        assert [row[1:] for row in robot.received] == [
            (record.transport.lower(), record.payload[5], record.payload[6:]) for record in said
        ]


@pytest.mark.parametrize(
    ("version", "text"),
    [
        ("1.1", "18000000 07 03 0b000000 312e312c312e322c312e33 01000000000100"),
        ("1.2", "0e000000 07 03 03000000 312e31 0100000000"),
        ("1.3", "18000000 07 03 0b000000 312e312c312e322c312e34 01000000000100"),
    ],
)
async def test_other_version_strings_leave_all_flags_false(version: str, text: str) -> None:
    async with facing(quick(version, udp=True)) as hq:
        await hq.play(["meet", f"> {text}", "! to a robot that understands", "> STOP", "silent"])  # no 4
        assert hq.judge.alive


async def test_a_datagram_from_another_socket_is_noted() -> None:
    async with facing(quick(udp=True)) as hq:
        await hq.greet("1.3 udp")
        with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
            other.sendto(hq.raw("FORWARD"), ("127.0.0.1", hq.peer.port))
        await hq.violated("not from where 5 came from")


async def test_after_a_disconnect_it_accepts_and_says_nothing() -> None:
    robot = quick()
    async with facing(robot) as hq:
        await hq.play(["greet", "close", "wait 0.015"])
        await hq.play(["again", "silent", "by_udp_until_noted FORWARD", "! a datagram after the TCP connection ended"])
        assert [event.split(",")[0] for event in robot.events] == ["the HQ closed the connection", "second connection"]


async def test_a_second_connection_may_work_and_lose_half_and_get_no_telemetry() -> None:
    robot = quick("1.1", again=True, client_id=2, times=Times(read_s=0.002, unasked_s=0.01))
    async with facing(robot) as hq:
        await hq.play(["meet", f"> {hello('1.1', udp=False).replace('07', '02', 1)}"])
        assert (await hq.packet())[5] in (1, 31, 40, 51, 53, 55)
        await hq.play(["close", "wait 0.015"])
        await hq.again("")
        assert (await hq.packet())[4:7] == bytes([1, 2, 3]), "client id 3"
        await hq.send(hello("1.1", udp=False).replace("07", "03", 1))
        for _ in range(60):
            await hq.send(NAMES["LIDAR_ON"].replace("07", "03", 1))
        answers = 0
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.3):
                while (await hq.packet())[5] == 51:
                    answers += 1
        taken = [row[2] for row in robot.received].count(50)
        assert 15 < taken < 45
        assert 4 < answers < taken
        await hq.ok("")


async def test_a_port_in_use_is_an_error() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="in use"):
            await quick().serve("127.0.0.1", taken.getsockname()[1], print)


async def test_what_is_kept_is_bounded() -> None:
    async with facing(quick(keep=2)) as hq:
        await hq.play(["greet", *["> 02000000 08 0d"] * 3, "took 13 13"])
        assert len(hq.judge.violations) == 2


async def test_the_simulator_logs_violations_and_says_what_it_died_of(caplog, capsys) -> None:
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(
        simulate_fragile("127.0.0.1", 0, version="1.3", udp=False, seed=3, ready=port.set_result)
    )
    hq = Hq(None, Peer(await port), task)
    with contextlib.closing(hq.peer), contextlib.closing(hq.udp):
        await hq.connect("")
        client = (await hq.packet())[6]
        await hq.play([f"> 02000000 {client:02x} 48", "over"])
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
