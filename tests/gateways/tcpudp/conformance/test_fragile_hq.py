"""The fragile HQ against a small robot written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import socket
import struct
import threading
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.tcpudp.conformance.fragile_hq import FragileHq, HqTimes, simulate_fragile_hq
from gateways.tcpudp.conformance.parser import Feature
from tests import captures
from tests.conformance.scene import Listening, Scene, Script, calling, scripts, until

GAP_S = 0.015
QUICK = HqTimes(probe_s=0.1)
UNEXCUSED = HqTimes(gap_s=1000.0)
"""With such a gap this process is never to blame for what it reads joined."""
VERSIONS = ("1.1", "1.2", "1.3")
LIST_13 = "0b000000 312e312c312e322c312e33"
SETTINGS = {
    ("1.1", True): "0f000000 01 02 07 03000000 312e31 0101010101",
    ("1.1", False): "0f000000 01 02 07 03000000 312e31 0001010101",
    ("1.2", True): "10000000 01 02 07 03000000 312e32 010101010101",
    ("1.2", False): "10000000 01 02 07 03000000 312e32 000101010101",
    ("1.3", True): f"21000000 01 02 07 {LIST_13} 01010101010101 c8000000 0a000000",
    ("1.3", False): f"21000000 01 02 07 {LIST_13} 00010101010101 c8000000 0a000000",
}
ANSWERS = {
    "1.1": "0e000000 07 03 03000000 312e31 0100000000",
    "1.2": "0f000000 07 03 03000000 312e32 010000000000",
    "1.3": f"18000000 07 03 {LIST_13} 01000000000000",
}
CELLS = "00010200" * 100
NAMES = {
    "START": "02000000 01 04",
    "RECEIVED": "03000000 01 06 01",
    "NOT_RECEIVED": "03000000 01 06 00",
    "PROBE": "02000000 07 05",
    "CONNECTED": "03000000 07 07 01",
    "NOT_CONNECTED": "03000000 07 07 00",
    "TEXT": "08000000 01 01 02000000 6869",
    "LIDAR_OFF": "06000000 01 33 02000000",
    "POSITION": "0e000000 01 37 0000c03f 000010c0 0000b442",
    "NO_MAP": "06000000 01 35 00000000",
    "MAP": "96010000 01 35 90010000" + CELLS,
    "GET_SCAN": "02000000 01 3c",
    "IDLE": "02000000 07 0d",
    "FORWARD": "0e000000 07 0b 00000000 0000803f 0000803f",
    "TURN": "06000000 07 0c 000040bf",
}
NAMES |= {f"SETTINGS_{version}{'_UDP' * udp}": text for (version, udp), text in SETTINGS.items()}


class Sockets(Listening):
    """TCP and UDP of one number."""

    def __init__(self) -> None:
        super().__init__()
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)
        self.udp.bind(("127.0.0.1", self.port))
        self.source = ("127.0.0.1", 9)

    def close(self) -> None:
        super().close()
        self.udp.close()


class Robot(Scene):
    """The few habits of a robot that behaves."""

    names = NAMES
    gap_s = GAP_S

    async def accept(self, _: str) -> None:
        await self.peer.accept()

    async def by_udp(self, text: str) -> None:
        self.peer.udp.sendto(self.raw(text), self.peer.source)
        await asyncio.sleep(GAP_S)

    async def kind(self, kind: str) -> None:
        head = await self.peer.read(4)
        assert (await self.peer.read(struct.unpack("<i", head)[0]))[1] == int(kind)

    async def datagram(self) -> bytes:
        async with asyncio.timeout(2):
            while True:
                with contextlib.suppress(BlockingIOError):
                    data, self.peer.source = self.peer.udp.recvfrom(65536)
                    return bytes(data)
                await asyncio.sleep(0.002)

    async def expect_udp(self, text: str) -> None:
        assert await self.datagram() == self.raw(text)

    async def greet(self, settings: str) -> None:
        """Speak first, and take the answer 3."""
        await self.play(["accept", f"> {settings or 'SETTINGS_1.3'}", "kind 3"])

    async def probing(self, version: str) -> None:
        """Offer UDP too, and take the probe."""
        await self.play([f"greet SETTINGS_{version or '1.3'}_UDP", "> START", "expect_udp PROBE"])

    async def shake(self, how: str) -> None:
        """Do the whole handshake: ``"1.1"``, ``"1.3 udp"``."""
        version, udp = how[:3] or "1.3", how.endswith("udp")
        if udp:
            await self.play([f"probing {version}", "by_udp RECEIVED", "< CONNECTED"])
        else:
            await self.greet(f"SETTINGS_{version}")

    async def violated(self, words: str) -> None:
        """Wait until the only violation is one with these words."""
        await until(lambda: self.judge.violations, "no violation")
        assert len(self.judge.violations) == 1
        assert words in self.judge.violations[0]

    async def count(self, kind_and_count: str) -> None:
        """Wait until so many packets of an id came."""
        kind, count = map(int, kind_and_count.split())
        await until(lambda: self.judge.counts[kind] >= count, f"{count} of {kind}")

    async def established(self, _: str) -> None:
        await until(self.judge.established.is_set, "established")

    async def moves(self, _: str) -> None:
        self.judge.move(0.0, 1.0)

    async def says(self, texts: str) -> None:
        await until(lambda: self.judge.texts == texts.split(), self.judge.texts)

    async def alive(self, _: str) -> None:
        assert self.judge.alive

    async def speaks(self, _: str) -> None:
        """Dead men tell no tales."""
        self.judge.say("hi")
        assert self.judge.events[-1] == "lost: packet 1 while ended"

    async def turns(self, _: str) -> None:
        self.judge.rotate(-0.75)

    async def idles(self, _: str) -> None:
        self.judge.idle()

    async def asks(self, _: str) -> None:
        self.judge.ask_map()
        self.judge.ask_position()

    async def map(self, cells: str) -> None:
        await until(lambda: self.judge.map == bytes.fromhex(cells), "the map")

    async def lost_all(self, _: str) -> None:
        assert (self.judge.texts, self.judge.position) == ([], None)


@contextlib.asynccontextmanager
async def facing(hq: FragileHq) -> AsyncIterator[Robot]:
    async with calling(hq, Sockets(), Robot) as robot:
        yield robot


def program(version: str = "1.3", **options: Any) -> FragileHq:
    return FragileHq(version=version, **{"repeat_s": None, "unasked": True, **options})


def of(version: str, **options: Any) -> dict[str, Any]:
    return {"version": version, **options}


NOTED: dict[str, Script] = {
    "the robot speaks first, and with its settings": ({}, ["accept", "> TEXT", "! packet 1 before the settings 2"]),
    "a second answer": ({}, ["shake 1.3 udp", "by_udp RECEIVED", "! a 6 that is not due"]),
    **{
        f"before the answer, {text}": (
            {"times": HqTimes(answer_s=1.0)},
            ["accept", "> SETTINGS_1.3_UDP", f"> {text}", f"! {words}"],
        )
        for text, words in (("START", "a 4 before the answer 3"), ("TEXT", "packet 1 before the session"))
    },
    **{
        f"during the probe, {text}": ({}, ["probing", f"> {text}", f"! {words}"])
        for text, words in (
            ("START", "a second 4"),
            ("TEXT", "packet 1 before the session was established"),
            ("LIDAR_OFF", "packet 51 before the session was established"),
            ("RECEIVED", "packet 6 by TCP instead of UDP"),
        )
    },
    **{
        f"by TCP what was agreed for UDP, {text}": ({}, ["shake 1.3 udp", f"> {text}", "! by TCP instead of UDP"])
        for text in ("MAP", "POSITION")
    },
    **{
        f"by UDP what belongs to TCP, {text}": ({}, ["shake 1.3 udp", f"by_udp {text}", "! by UDP instead of TCP"])
        for text in ("TEXT", "LIDAR_OFF")
    },
    **{
        f"settings, {words}": ({}, [f"greet {text}", f"! {words}"])
        for text, words in (
            (f"22000000 01 02 07 {LIST_13} 00010101010101 c8000000 0a000000 00", "16 bytes of settings"),
            (f"21000000 01 02 01 {LIST_13} 00010101010101 c8000000 0a000000", "client id 1"),
            (f"21000000 02 02 07 {LIST_13} 00010101010101 c8000000 0a000000", "id byte 2 instead"),
        )
    },
    **{
        words: (of(version), [f"shake {version}", f"> {text}", f"! {words}", "> TEXT", "says hi"])
        for version, text, words in (
            ("1.3", "SETTINGS_1.3", "a second 2"),
            ("1.3", "START", "a 4 before the answer 3, or not both set the UDP flag"),
            ("1.3", "NOT_RECEIVED", "a 6 that is not due"),
            ("1.2", "GET_SCAN", "LidarSim was not announced"),
            ("1.3", "06000000 02 35 00000000", "id byte 2 instead of 1"),
            ("1.3", "06000000 01 33 03000000", "lidar status 3"),
            ("1.3", "0e000000 01 37 0000c07f 000010c0 0000b442", "not finite"),
            ("1.3", "07000000 01 35 01000000 01", "1 cells of a map announced with 20 x 20"),
            ("1.1", "0a000000 01 35 04000000 00010203", "a cell that is neither 0, 1 nor 2"),
        )
    },
    **{
        words: (of("1.1", unasked=False), ["shake 1.1", f"> {text}", f"! {words}"])
        for text, words in (
            ("MAP", "a 53 to an HQ 1.1 that never asked (52)"),
            ("POSITION", "a 55 to an HQ 1.1 that never asked (54)"),
        )
    },
    "the rest of a split packet is no second violation": (
        of("1.1"),
        ["shake 1.1", "> 0e000000 01 37 0000c03f", "> 000010c0 0000b442", "> POSITION", "count 55 1"]
        + ["! a split packet"],
    ),
    **{
        f"a read of {words}": (of("1.1", times=UNEXCUSED), ["shake 1.1", f"> {text}", f"! {words}", "lost_all"])
        for text, words in (
            ("TEXT POSITION", "two packets in one read"),
            ("TEXT TEXT TEXT", "3 packets in one read"),
            ("TEXT 0e000000 01 37", "1 packets and a part of one in one read"),
            ("08000000 01 01 02000000", "a split packet, 10 of 12 bytes in one read"),
            ("94080000 01 35 8e080000" + "00" * 2190, "a packet of 2200 bytes, over 2199"),
        )
    },
    **{
        f"6(false), which makes {version} believe in UDP": (
            of(version),
            [f"probing {version}", "> NOT_RECEIVED", "! 6(false): a listener sends 6(true) or none", "< CONNECTED"]
            + ["moves", "expect_udp FORWARD"],
        )
        for version in VERSIONS
    },
    **{
        f"after a lost answer, {version} falls back to TCP": (
            of(version, times=QUICK),
            [f"probing {version}", "< NOT_CONNECTED", "established", "moves", "< FORWARD", "> POSITION", "count 55 1"]
            + ["ok", "by_udp POSITION", "! packet 55 by UDP instead of TCP"],
        )
        for version in ("1.1", "1.2")
    },
}


@scripts(NOTED)
async def test_what_is_noted_and_survived(options: dict[str, Any], steps: list[str]) -> None:
    async with calling(program(**options), Sockets(), Robot) as robot:
        await robot.play([*steps, "alive"])


@scripts(
    {
        "a lost answer is followed by true all the same in 1.3": (
            of("1.3", times=QUICK),
            ["probing", "< CONNECTED", "? no 6 within 0.1 s of the 5", "> POSITION", "by_udp POSITION", "count 55 2"]
            + ["ok"],
        ),
        "a missing 4 is an event": (
            {"times": QUICK},
            ["greet SETTINGS_1.3_UDP", "? no 4 within 0.1 s of the 3", "ok"],
        ),
        "it announces lidar_sim, and no UDP, if told so": (
            of("1.2", udp=False, lidar_sim=True),
            ["accept", "> SETTINGS_1.2_UDP", "< 0f000000 07 03 03000000 312e32 000000000001"],
        ),
        **{
            f"it answers with the settings of {version}": (
                of(version),
                ["accept", f"> SETTINGS_{version}_UDP", f"< {ANSWERS[version]}"],
            )
            for version in VERSIONS
        },
        **{
            f"a square map needs no announced size in {version}": (
                of(version),
                [f"shake {version}", "> 0a000000 01 35 04000000 00010200", "map 00010200", "ok"],
            )
            for version in ("1.1", "1.2")
        },
        "a map of 60 kB passes by UDP": (
            of("1.2"),
            ["shake 1.2 udp", "by_udp 06e10000 01 35 00e10000" + "00010200" * 14400, "map " + "00010200" * 14400, "ok"],
        ),
        "a map below 2200 bytes passes by TCP": (
            of("1.1"),
            ["shake 1.1", "> 4a080000 01 35 44080000" + "01" * 2116, "map " + "01" * 2116, "ok"],
        ),
        **{
            f"with UDP agreed, the stick of {version} goes by UDP and 13 by TCP": (
                of(version),
                [f"shake {version} udp", "moves", "turns", "idles", "expect_udp FORWARD", "expect_udp TURN", "< IDLE"],
            )
            for version in VERSIONS
        },
        **{
            f"after a lost probe {version} goes on {'by UDP' if version == '1.3' else 'by TCP'}": (
                of(version, times=QUICK),
                [f"probing {version}", f"< {'' if version == '1.3' else 'NOT_'}CONNECTED", "moves"]
                + ["expect_udp FORWARD" if version == "1.3" else "< FORWARD"],
            )
            for version in VERSIONS
        },
        "1.3 loses the stick where no 4 was sent": (
            {},
            ["shake", "established", "moves", "idles", "< IDLE", "? lost: packet 11 by UDP, the robot never sent 4"],
        ),
        "a viewer sends nothing": (of("1.1"), ["shake 1.1", "> POSITION", "count 55 1", "nothing"]),
        "it reports once": ({"times": QUICK}, ["shake 1.3 udp", "wait 0.15", "nothing"]),
        "a robot that resets the connection is an event": (
            {},
            ["shake", "reset", "over", "alive", "? the connection broke: ConnectionResetError"],
        ),
        "what a late reader joined itself is not held against the robot": (
            of("1.1", times=HqTimes(gap_s=0.0)),
            ["shake 1.1", "> TEXT POSITION", "? joined by this process: two packets in one read", "says hi"]
            + ["count 55 1", "ok"],
        ),
        **{
            f"what was asked for comes as it comes, {version}": (
                of(version, unasked=False),
                [f"shake {version}", "established", "asks", "> MAP", "> POSITION", "> MAP", "> POSITION", "> TEXT"]
                + ["says hi", "count 53 2", "count 55 2", "ok"],
            )
            for version in VERSIONS
        },
    }
)
async def test_what_a_robot_may_do(options: dict[str, Any], steps: list[str]) -> None:
    async with calling(program(**options), Sockets(), Robot) as robot:
        await robot.play(steps)


@scripts(
    {
        **{
            f"settings, {words}": (of(version), ["accept", f"> {text}", f"died {words}"])
            for version, text, words in (
                ("1.3", f"21000000 01 02 07 {LIST_13} 00010101010101 c8000000 00000000", "division by zero"),
                ("1.3", f"19000000 01 02 07 {LIST_13} 00010101010101", "7 bytes of settings"),
                ("1.3", f"20000000 01 02 07 {LIST_13} 000101010101 c8000000 0a000000", "14 bytes"),
                ("1.1", "0d000000 01 02 07 03000000 312e31 000000", "3 bytes of settings"),
                ("1.1", "0f000000 01 02 07 ff000000 312e31 0001010101", "no version string"),
                ("1.1", "0f000000 01 02 07 03000000 312eb1 0001010101", "no version string"),
                ("1.1", "03000000 01 02 07", "no version string"),
            )
        },
        **{
            f"a datagram with a wrong length field, {text}": (
                {},
                ["shake 1.3 udp", f"by_udp {text}", "died a datagram whose length field is wrong"],
            )
            for text in ("03000000 01 35", "00", "POSITION POSITION")
        },
        **{
            f"{version}, {text}": (
                of(version, lidar_sim=version != "1.1"),
                [f"shake {version}", f"> {text}", f"died {words}", "eof", "speaks"],
            )
            for version, text, words in (
                *((version, "02000000 01 38", f"unknown packet id 56 for an HQ {version}") for version in VERSIONS),
                ("1.1", "GET_SCAN", "unknown packet id 60"),
                ("1.3", "06000000 01 1f 01000000", "unknown packet id 31"),
                ("1.3", "03000000 01 28 00", "unknown packet id 40"),
                ("1.3", "CONNECTED", "unknown packet id 7"),
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
                *(
                    (version, "02000000 01 35", "a 53 without its int, on which it throws for good")
                    for version in VERSIONS
                ),
                ("1.3", "08000000 01 35 02000000 0001", "a map of 2 cells, no square"),
                ("1.3", "01000000 01 35", "its length field is wrong"),
            )
        },
    }
)
async def test_it_dies_of(options: dict[str, Any], steps: list[str]) -> None:
    async with calling(program(**options), Sockets(), Robot) as robot:
        await robot.play(steps)


@pytest.mark.parametrize("udp", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
async def test_a_robot_that_behaves_is_not_reproached(version: str, udp: bool) -> None:
    hq = program(version, lidar_sim=version != "1.1")
    async with facing(hq) as robot:
        await robot.shake(f"{version}{' udp' * udp}")
        await robot.play([f"{'by_udp' if udp else '>'} {name}" for name in ("NO_MAP", "MAP", "POSITION")])
        await robot.play(["> TEXT", "> LIDAR_OFF"] + ["> GET_SCAN"] * (version != "1.1"))
        await robot.count("60 1" if version != "1.1" else "51 1")
        assert hq.violations == []
        assert hq.established.is_set()
        assert (hq.position, hq.map, hq.texts, hq.lidar_on) == (
            (1.5, -2.25, 90.0),
            bytes.fromhex(CELLS),
            ["hi"],
            False,
        )
        assert [row[2] for row in hq.received if row[1] == "udp"] == [6, 53, 53, 55] * udp
        assert hq.received[0][1:] == ("tcp", 2, bytes.fromhex(SETTINGS[version, udp])[6:])
        assert (hq.client_id, hq.alive, robot.task.done()) == (7, True, False)
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == ((200, 10) if version == "1.3" else (0, 0))
        assert (Feature.UDP in hq.settings.features, Feature.CHAT in hq.settings.features) == (udp, True)


async def test_a_captured_robot_is_reproached_for_what_the_page_forbids_the_gateway_only() -> None:
    """The deployed robot gives its client the id 1, and its maps do not have the size it announced."""
    hq = program(lidar_sim=True)
    async with facing(hq) as robot:
        await robot.accept("")
        for record in captures.payloads("tcpudp-1.3-udp.hex", source=11001):
            if record.payload[5] == 4:
                await robot.kind("3")
            if record.payload[5] == 6:
                await robot.datagram()
            await (robot.send if record.transport == "TCP" else robot.by_udp)(record.payload.hex())
        await robot.says("bye")
        assert [violation.partition(":")[0] for violation in hq.violations] == [
            "client id 1",
            *["400 cells of a map announced with 2048 x 2048"] * 2,
        ]
        assert hq.alive


@pytest.mark.parametrize("wrong", [{"version": "1.4"}, {"version": "1.1", "lidar_sim": True}])
def test_an_hq_that_does_not_exist_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="no HQ of version"):
        FragileHq(**wrong)


async def test_no_common_version_may_be_said_before_closing() -> None:
    hq = program("1.1")
    async with facing(hq) as robot:
        await robot.play(["greet SETTINGS_1.2_UDP", "> TEXT"])
        robot.peer.tcp.close()
        await robot.over("")
        assert (hq.texts, hq.violations, hq.alive) == (["hi"], [], True)
        assert hq.events[1:] == ["the robot closed the connection", "ended"]


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
    block = {b"1.1": "0001010101", b"1.2": "000101010101"}.get(versions[-3:], "00010101010101 c8000000 0a000000")
    body = b"\x07" + struct.pack("<i", len(versions)) + versions + bytes.fromhex(block)
    hq = program(version)
    async with facing(hq) as robot:
        await robot.greet((struct.pack("<iBB", 2 + len(body), 1, 2) + body).hex())
        assert hq.settings is not None
        assert hq.settings.understood == understood
        assert bool(hq.settings.features) == bool(understood)
        assert any("keeps its old flags" in event for event in hq.events) == (not understood)
        assert hq.violations == []


async def test_one_that_skips_the_map_flag_sees_a_wrong_size_unless_it_is_left_out() -> None:
    hq = program(skips_map_flag=True)
    async with facing(hq) as robot:
        await robot.greet("SETTINGS_1.3")
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == (0xC801, 0x0A00)
        await robot.play(["? a wrong map size 51201 with the interval 2560", "> MAP", "ok"])
    hq = program(skips_map_flag=True)
    async with facing(hq) as robot:
        await robot.play([f"greet 20000000 01 02 07 {LIST_13} 000101010101 c8000000 0a000000", "> MAP", "quiet"])
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == (200, 10)


async def test_datagrams_from_elsewhere_are_not_heard() -> None:
    hq = program()
    async with facing(hq) as robot:
        await robot.shake("1.3 udp")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(robot.raw("POSITION"), robot.peer.source)
            await robot.happened("not from the robot")
        assert (hq.position, hq.violations) == (None, [])


async def test_it_binds_the_port_it_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    async with facing(program(udp_port=port)) as robot:
        await robot.shake("1.3 udp")
        assert robot.peer.source == ("127.0.0.1", port)


async def test_it_binds_the_port_of_deployed_programs_if_it_is_free() -> None:
    first, second = program(), program()
    async with facing(first) as robot, facing(second) as other:
        await robot.shake("1.3 udp")
        await other.shake("1.3 udp")
        port = other.peer.source[1]
        assert robot.peer.source[1] == 11000 or any("UDP port 11000 is taken" in event for event in first.events)
        assert any(f"UDP port 11000 is taken, {port} instead" in event for event in second.events)


@pytest.mark.parametrize("text", ["02", "02000000 01"])
async def test_a_read_under_six_bytes_is_taken_as_a_disconnect(text: str) -> None:
    async with facing(program()) as robot:
        await robot.play(["shake", f"> {text}", "over", "! taken as a disconnect", "alive"])
        assert robot.judge.events[-2:] == ["hung up: took a short read as a disconnect", "ended"]


async def test_a_reader_in_time_holds_it_against_the_robot() -> None:
    async with facing(program("1.1")) as robot:
        await robot.shake("1.1")
        for _ in range(50):  # a busy machine may excuse some
            await robot.send("TEXT POSITION")
            if robot.judge.violations:
                break
        await robot.violated("two packets in one read")


async def test_it_reads_though_the_event_loop_is_busy() -> None:
    async with facing(program("1.1")) as robot:
        await robot.play(["shake 1.1", "wait 0.015"])

        def send_spaced() -> None:
            for _ in range(5):
                robot.peer.tcp.send(robot.raw("TEXT"))
                time.sleep(GAP_S)

        thread = threading.Thread(target=send_spaced)
        thread.start()
        thread.join()  # the loop does nothing meanwhile
        await robot.play(["says hi hi hi hi hi", "ok"])


async def test_every_packet_of_the_operator_is_that_of_the_page() -> None:
    hq = program("1.1")
    async with facing(hq) as robot:
        await robot.shake("1.1")
        for said, packet in (
            (lambda: hq.mode(2), "06000000 07 0a 02000000"),
            (lambda: hq.move(0.0, 1.0), "FORWARD"),
            (lambda: hq.rotate(-0.75), "TURN"),
            (hq.idle, "IDLE"),
            (hq.stop, "IDLE"),
            (lambda: hq.move_ai(b"\x09"), "03000000 07 15 09"),
            (lambda: hq.chat(b"\x01\x02"), "04000000 07 28 0102"),
            (lambda: hq.lidar(on=False), "06000000 07 32 02000000"),
            (hq.ask_map, "02000000 07 34"),
            (hq.ask_position, "02000000 07 36"),
            (lambda: hq.say("hi"), "08000000 07 01 02000000 6869"),
            (lambda: hq.feed([100.0, 101.0]), "0e000000 07 3d 02000000 0000c842 0000ca42"),
        ):
            said()
            await robot.expect(packet)


async def test_the_stick_is_repeated_from_the_moment_the_session_is_established() -> None:
    hq = program("1.1", repeat_s=0.02)
    async with facing(hq) as robot:
        await robot.play(["shake 1.1", "< IDLE IDLE IDLE"])
        hq.rotate(-0.75)
        await robot.peer.read_until(robot.raw("TURN"))
        await robot.expect("TURN TURN")


def test_before_the_session_is_established_everything_is_lost() -> None:
    hq = program()
    hq.say("hi")
    assert hq.events == ["lost: packet 1 while connected"]


async def test_a_robot_that_reads_nothing_is_hung_up_on() -> None:
    hq = program("1.1")
    async with facing(hq) as robot:
        await robot.play(["shake 1.1", "established"])
        while not any("hung up" in event for event in hq.events):
            hq.chat(bytes(60000))
        await robot.play(["over", "ok"])


async def test_a_cancelled_program_hangs_up() -> None:
    hq = program()
    async with facing(hq) as robot:
        await robot.shake("")
        robot.task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await robot.task
        await robot.eof("")
    assert (hq.events, hq.alive) == (["cancelled"], True)


async def test_nobody_to_connect_to_is_an_error() -> None:
    gone = Sockets()
    gone.close()
    with pytest.raises(ConnectionRefusedError):
        await program().run("127.0.0.1", gone.port)


async def test_every_list_is_bounded_and_each_violation_is_told() -> None:
    told_of: list[str] = []
    hq = program("1.1", keep=2, note=told_of.append)
    async with facing(hq) as robot:
        await robot.play(["shake 1.1", *["> 08000000 09 01 02000000 6869"] * 4, "count 1 4"])
        assert [len(kept) for kept in (hq.violations, hq.received, hq.texts)] == [2, 2, 2]
        assert len(told_of) == 4
    assert repr(hq) == "<FragileHq 1.1 ENDED violations=2 alive=True>"


async def test_the_command_logs_violations_and_prints_the_death(caplog, capsys) -> None:
    sockets = Sockets()
    with caplog.at_level(logging.ERROR):
        task = asyncio.create_task(simulate_fragile_hq("127.0.0.1", sockets.port, version="1.1", udp=False))
        await Robot(None, sockets, task).play(["shake 1.1", "< IDLE", "> 02000000 01 3c", "over"])
    sockets.close()
    assert "violation: unknown packet id 60" in caplog.text
    assert capsys.readouterr().out.startswith("died: unknown packet id 60")
