"""The fragile HQ against a small robot written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq, HqTimes
from gateways.tcpudp.conformance.parser import FeatureFlag
from tests import captures
from tests.conformance.scene import Listening, calling, table, until
from tests.gateways.tcpudp.conformance.udp_scene import NAMES as SHARED
from tests.gateways.tcpudp.conformance.udp_scene import UdpScene

QUICK = HqTimes(probe_s=0.1)
VERSIONS = ("1.1", "1.2", "1.3")
CELLS = "00010200" * 100
NAMES = SHARED | {
    "TEXT": "08000000 01 01 02000000 6869",
    "LIDAR_OFF": "06000000 01 33 02000000",
    "POSITION": "0e000000 01 37 0000c03f 000010c0 0000b442",
    "NO_MAP": "06000000 01 35 00000000",
    "MAP": "96010000 01 35 90010000" + CELLS,
    "GET_SCAN": "02000000 01 3c",
    "TURN": "06000000 07 0c 000040bf",
    "SETTINGS_1.1": "0f000000 01 02 07 03000000 312e31 0001010101",
    "SETTINGS_1.1_UDP": "0f000000 01 02 07 03000000 312e31 0101010101",
    "SETTINGS_1.2": "10000000 01 02 07 03000000 312e32 000101010101",
    "SETTINGS_1.2_UDP": "10000000 01 02 07 03000000 312e32 010101010101",
    "SETTINGS_1.3": "21000000 01 02 07 0b000000 312e312c312e322c312e33 00010101010101 c8000000 0a000000",
    "SETTINGS_1.3_UDP": "21000000 01 02 07 0b000000 312e312c312e322c312e33 01010101010101 c8000000 0a000000",
    "SMALL_MAP": "0a000000 01 35 04000000 00010200",
    "MAP_2200": "94080000 01 35 8e080000" + "00" * 2190,
    "MAP_2126": "4a080000 01 35 44080000" + "01" * 2116,
    "MAP_60K": "06e10000 01 35 00e10000" + "00010200" * 14400,
}


class Sockets(Listening):
    """TCP and UDP of one number."""

    def __init__(self) -> None:
        super().__init__()
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)
        self.udp.bind(("127.0.0.1", self.port))

    def close(self) -> None:
        super().close()
        self.udp.close()


class Robot(UdpScene):
    """The few habits of a robot that behaves."""

    names = NAMES

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.udp = self.peer.udp

    async def accept(self, _: str) -> None:
        await self.peer.accept()

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

    async def says(self, texts: str) -> None:
        await until(lambda: self.judge.texts == texts.split(), self.judge.texts)

    async def alive(self, _: str) -> None:
        assert self.judge.alive

    async def speaks(self, _: str) -> None:
        """Dead men tell no tales."""
        self.judge.say("hi")
        assert self.judge.events[-1] == "lost: packet 1 while ended"

    async def does(self, what: str) -> None:
        """Let the operator do something: ``idle``, ``rotate -0.75``."""
        name, *numbers = what.split()
        getattr(self.judge, name)(*map(float, numbers))

    async def map(self, name: str) -> None:
        cells = self.raw(name)[10:]
        await until(lambda: self.judge.map == cells, "the map")

    async def understands(self, version: str) -> None:
        assert self.judge.settings.understood == version.replace("nothing", "")
        assert bool(self.judge.settings.features) == (version != "nothing")

    async def until(self, text: str) -> None:
        await self.peer.read_until(self.raw(text))

    async def lost_all(self, _: str) -> None:
        assert (self.judge.texts, self.judge.position) == ([], None)


@contextlib.asynccontextmanager
async def facing(hq: FragileTcpUdpHq) -> AsyncIterator[Robot]:
    async with calling(hq, Sockets(), Robot) as robot:
        yield robot


def program(version: str = "1.3", **options: Any) -> FragileTcpUdpHq:
    return FragileTcpUdpHq(version=version, **{"repeat_s": None, "unasked": True, **options})


HQS: dict[str, dict[str, Any]] = {
    **{version: {"version": version} for version in VERSIONS},
    **{f"{version} quick": {"version": version, "times": QUICK} for version in VERSIONS},
    "1.1 in time": {"version": "1.1", "times": HqTimes(gap_s=1000.0)},
    "1.1 late": {"version": "1.1", "times": HqTimes(gap_s=0.0)},
    "1.3 slow": {"times": HqTimes(answer_s=1.0)},
    "1.1 that asks": {"version": "1.1", "unasked": False},
    "1.3 that asks": {"unasked": False},
    "1.2 without UDP": {"version": "1.2", "udp": False, "lidar_sim": True},
    "repeats": {"version": "1.1", "repeat_s": 0.02},
    "skips the map flag": {"skips_map_flag": True},
}


def judged(lines: str) -> pytest.MarkDecorator:
    return table(lines, HQS)


@judged(
    """
    no settings first | 1.3 | accept; > TEXT; ! packet 1 before the settings 2
    a 4 before the answer | 1.3 slow | accept; > SETTINGS_1.3_UDP; > START; ! a 4 before the answer 3
    a text before the answer | 1.3 slow | accept; > SETTINGS_1.3_UDP; > TEXT; ! packet 1 before the session
    a second 4 | 1.3 | probing; > START; ! a second 4
    a text during the probe | 1.3 | probing; > TEXT; ! packet 1 before the session was established
    a 6 by TCP | 1.3 | probing; > RECEIVED; ! packet 6 by TCP instead of UDP
    a second 6 | 1.3 | shake 1.3 udp; by_udp RECEIVED; ! a 6 that is not due
    6(false) makes it believe in UDP | 1.3 | probing; > NOT_RECEIVED; ! 6(false): a listener sends 6(true) or none
        ; < CONNECTED; does move 0 1; expect_udp FORWARD
    a 1.1 falls back to TCP after a lost answer | 1.1 quick | probing 1.1; < NOT_CONNECTED; established; does move 0 1
        ; < FORWARD; > POSITION; count 55 1; ok; by_udp POSITION; ! packet 55 by UDP instead of TCP
    a map by TCP | 1.3 | shake 1.3 udp; > MAP; ! by TCP instead of UDP
    a text by UDP | 1.3 | shake 1.3 udp; by_udp TEXT; ! by UDP instead of TCP
    long settings | 1.3 | greet 22000000 01 02 07 LIST_13 00010101010101 c8000000 0a000000 00; ! 16 bytes of settings
    a client id of robots | 1.3 | greet 21000000 01 02 01 LIST_13 00010101010101 c8000000 0a000000; ! client id 1
    an id byte of nobody | 1.3 | greet 21000000 02 02 07 LIST_13 00010101010101 c8000000 0a000000; ! id byte 2 instead
    a second 2 | 1.3 | shake; > SETTINGS_1.3; ! a second 2; > TEXT; says hi
    a 4 without UDP | 1.3 | shake; > START; ! a 4 before the answer 3, or not both set the UDP flag
    lidar_sim unannounced | 1.2 | shake 1.2; > GET_SCAN; ! LidarSim was not announced
    a wrong id byte | 1.3 | shake; > 06000000 02 35 00000000; ! id byte 2 instead of 1
    a wrong lidar status | 1.3 | shake; > 06000000 01 33 03000000; ! lidar status 3
    a position that is none | 1.3 | shake; > 0e000000 01 37 0000c07f 000010c0 0000b442; ! not finite
    a map too small | 1.3 | shake; > 07000000 01 35 01000000 01; ! 1 cells of a map announced with 20 x 20
    a cell of 3 | 1.1 | shake 1.1; > 0a000000 01 35 04000000 00010203; ! a cell that is neither 0, 1 nor 2
    a map unasked | 1.1 that asks | shake 1.1; > MAP; ! a 53 to an HQ 1.1 that never asked (52)
    a position unasked | 1.1 that asks | shake 1.1; > POSITION; ! a 55 to an HQ 1.1 that never asked (54)
    a split packet, and its rest is none | 1.1 | shake 1.1; > 0e000000 01 37 0000c03f; > 000010c0 0000b442; > POSITION
        ; count 55 1; ! a split packet
    two joined | 1.1 in time | shake 1.1; > TEXT POSITION; ! two packets in one read; lost_all
    a packet and a part | 1.1 in time | shake 1.1; > TEXT 0e000000 01 37; ! 1 packets and a part of one; lost_all
    a part | 1.1 in time | shake 1.1; > 08000000 01 01 02000000; ! a split packet, 10 of 12 bytes in one read; lost_all
    a packet of 2200 bytes | 1.1 in time | shake 1.1; > MAP_2200; ! a packet of 2200 bytes, over 2199; lost_all
    a read under six bytes is taken as a disconnect | 1.3 | shake; > 02000000 01; over; ! taken as a disconnect
        ; ? hung up: took a short read as a disconnect
    """
)
async def test_what_is_noted_and_survived(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(program(**options)) as robot:
        await robot.play([*steps, "alive"])


@judged(
    """
    settings of a map without rows | 1.3 | accept; > 21000000 01 02 07 LIST_13 00010101010101 c8000000 00000000
        ; died division by zero
    settings of 7 bytes | 1.3 | accept; > 19000000 01 02 07 LIST_13 00010101010101; died 7 bytes of settings
    settings without a version | 1.1 | accept; > 03000000 01 02 07; died no version string
    settings whose version is cut off | 1.1 | accept; > 0f000000 01 02 07 ff000000 312e31 0001010101; died no version
    settings whose version is not ASCII | 1.1 | accept; > 0f000000 01 02 07 03000000 312eb1 0001010101; died no version
    a datagram too short | 1.3 | shake 1.3 udp; by_udp 03000000 01 35; died a datagram whose length field is wrong
    two in a datagram | 1.3 | shake 1.3 udp; by_udp POSITION POSITION; died a datagram whose length field is wrong
    56 to a 1.3 | 1.3 | shake; > 02000000 01 38; died unknown packet id 56 for an HQ 1.3; eof; speaks
    60 to a 1.1 | 1.1 | shake 1.1; > GET_SCAN; died unknown packet id 60
    7 | 1.3 | shake; > CONNECTED; died unknown packet id 7
    a long 4 | 1.3 | shake; > 03000000 01 04 00; died a body of 1 bytes instead of 0
    a short 6 | 1.3 | shake; > 02000000 01 06; died a body of 0 bytes instead of 1
    a short 55 | 1.3 | shake; > 0a000000 01 37 0000c03f 000010c0; died a body of 8 bytes instead of 12
    a text cut off | 1.3 | shake; > 08000000 01 01 03000000 6869; died a wrong byte count of the string
    a text that is not ASCII | 1.3 | shake; > 08000000 01 01 02000000 c3a9; died a text that is not ASCII
    an empty text | 1.3 | shake; > 06000000 01 01 00000000; died an empty text
    a map cut off | 1.3 | shake; > 0e000000 01 35 0000c03f 000010c0 0000b442; died bytes of a map
    a map without its size | 1.3 | shake; > 02000000 01 35; died a 53 without its int, on which it throws for good
    a map that is no square | 1.3 | shake; > 08000000 01 35 02000000 0001; died a map of 2 cells, no square
    a wrong length | 1.3 | shake; > 01000000 01 35; died its length field is wrong
    """
)
async def test_it_dies_of(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(program(**options)) as robot:
        await robot.play(steps)


@judged(
    """
    the answer of 1.1 | 1.1 | accept; > SETTINGS_1.1_UDP; < 0e000000 07 03 03000000 312e31 0100000000
    the answer of 1.2 | 1.2 | accept; > SETTINGS_1.2_UDP; < 0f000000 07 03 03000000 312e32 010000000000
    the answer of 1.3 | 1.3 | accept; > SETTINGS_1.3_UDP; < 18000000 07 03 LIST_13 01000000000000
    it announces lidar_sim, and no UDP, if told so | 1.2 without UDP | accept; > SETTINGS_1.2_UDP
        ; < 0f000000 07 03 03000000 312e32 000000000001
    a missing 4 is an event | 1.3 quick | greet SETTINGS_1.3_UDP; ? no 4 within 0.1 s of the 3; ok
    a lost answer is followed by true all the same in 1.3 | 1.3 quick | probing; < CONNECTED
        ; ? no 6 within 0.1 s of the 5; > POSITION; by_udp POSITION; count 55 2; ok
    after a lost probe 1.1 continues by TCP | 1.1 quick | probing 1.1; < NOT_CONNECTED; does move 0 1; < FORWARD
    after a lost probe 1.3 continues by UDP | 1.3 quick | probing; < CONNECTED; does move 0 1; expect_udp FORWARD
    with UDP agreed, the stick goes by UDP and 13 by TCP | 1.1 | shake 1.1 udp; does move 0 1; does rotate -0.75
        ; does idle; expect_udp FORWARD; expect_udp TURN; < STOP
    1.3 loses the stick where no 4 was sent | 1.3 | shake; established; does move 0 1; does idle; < STOP
        ; ? lost: packet 11 by UDP, the robot never sent 4
    a square map needs no announced size | 1.1 | shake 1.1; > SMALL_MAP; map SMALL_MAP; ok
    a map of 60 kB passes by UDP | 1.2 | shake 1.2 udp; by_udp MAP_60K; map MAP_60K; ok
    a map below 2200 bytes passes by TCP | 1.1 | shake 1.1; > MAP_2126; map MAP_2126; ok
    what was asked for comes as it comes | 1.3 that asks | shake; established; does ask_map; does ask_position; > MAP
        ; > POSITION; > MAP; > POSITION; > TEXT; says hi; count 53 2; count 55 2; ok
    a 1.1 understands no list | 1.1 | greet SETTINGS_1.3; understands nothing; ? keeps its old flags; ok
    a 1.2 understands no 1.1 | 1.2 | greet SETTINGS_1.1; understands nothing; ? keeps its old flags; ok
    a 1.3 understands 1.1 | 1.3 | greet SETTINGS_1.1; understands 1.1; ok
    a 1.3 understands a list with 1.4 | 1.3 | greet 25000000 01 02 07 0f000000 312e312c312e322c312e332c312e34
        00010101010101 c8000000 0a000000; understands 1.3; ok
    one that skips the map flag sees a wrong size | skips the map flag | greet SETTINGS_1.3
        ; ? a wrong map size 51201 with the interval 2560; > MAP; ok
    one that skips the map flag sees the size where it is left out | skips the map flag
        | greet 20000000 01 02 07 LIST_13 000101010101 c8000000 0a000000; > MAP; quiet
    the stick is repeated from the moment on that the session is established | repeats | shake 1.1; < STOP STOP STOP
        ; does rotate -0.75; until TURN; < TURN TURN
    a viewer sends nothing | 1.1 | shake 1.1; > POSITION; count 55 1; nothing
    no common version may be said before closing | 1.1 | greet SETTINGS_1.2_UDP; > TEXT; says hi; close; over; ok
    a reset is an event | 1.3 | shake; reset; over; ok; ? the connection broke: ConnectionResetError
    what a late reader joined itself is not held against the robot | 1.1 late | shake 1.1; > TEXT POSITION
        ; ? joined by this process: two packets in one read; says hi; count 55 1; ok
    """
)
async def test_what_a_robot_may_do(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(program(**options)) as robot:
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
        assert (hq.position, hq.texts, hq.lidar_on) == ((1.5, -2.25, 90.0), ["hi"], False)
        assert hq.map == bytes.fromhex(CELLS)
        assert [row[2] for row in hq.received if row[1] == "udp"] == [6, 53, 53, 55] * udp
        assert hq.received[0][1:] == ("tcp", 2, bytes.fromhex(NAMES[f"SETTINGS_{version}{'_UDP' * udp}"])[6:])
        assert (hq.client_id, hq.alive, robot.task.done()) == (7, True, False)
        assert hq.settings is not None
        assert (hq.settings.map_size, hq.settings.map_interval) == ((200, 10) if version == "1.3" else (0, 0))
        assert (FeatureFlag.UDP in hq.settings.features, FeatureFlag.CHAT in hq.settings.features) == (udp, True)


async def test_a_captured_robot_is_reproached_for_what_the_page_forbids_the_gateway_only() -> None:
    """The legacy robot gives its client the id 1, and its maps do not have the size it announced."""
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


async def test_datagrams_from_elsewhere_are_not_heard() -> None:
    hq = program()
    async with facing(hq) as robot:
        await robot.shake("1.3 udp")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(robot.raw("POSITION"), robot.address)
            await robot.happened("not from the robot")
        assert (hq.position, hq.violations) == (None, [])


async def test_it_binds_the_port_of_deployed_programs_if_it_is_free() -> None:
    first, second = program(), program()
    async with facing(first) as robot, facing(second) as other:
        await robot.shake("1.3 udp")
        await other.shake("1.3 udp")
        port = other.address[1]
        assert robot.address[1] == 11000 or any("UDP port 11000 is taken" in event for event in first.events)
        assert any(f"UDP port 11000 is taken, {port} instead" in event for event in second.events)


async def test_every_packet_of_the_operator_is_that_of_the_page() -> None:
    hq = program("1.1")
    async with facing(hq) as robot:
        await robot.shake("1.1")
        for said, packet in (
            (lambda: hq.mode(2), "06000000 07 0a 02000000"),
            (lambda: hq.move(0.0, 1.0), "FORWARD"),
            (lambda: hq.rotate(-0.75), "TURN"),
            (hq.idle, "STOP"),
            (hq.stop, "STOP"),
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


async def test_the_command_logs_violations_and_prints_the_death(caplog, capsys) -> None:
    sockets = Sockets()
    with caplog.at_level(logging.ERROR):
        task = asyncio.create_task(FragileTcpUdpHq(version="1.1", udp=False).simulate("127.0.0.1", sockets.port, None))
        await Robot(None, sockets, task).play(["shake 1.1", "< STOP", "> 02000000 01 3c", "over"])
    sockets.close()
    assert "violation: unknown packet id 60" in caplog.text
    assert "\ndied: unknown packet id 60" in capsys.readouterr().out
