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

from gateways.tcpudp.conformance.fragile_robot import FragileRobot
from gateways.tcpudp.conformance.machine import Loss, Quirks
from gateways.tcpudp.conformance.parser import FeatureFlag, RobotTimes
from tests import captures
from tests.conformance.scene import LONG_S, Peer, bounded, serving, table, until
from tests.gateways.tcpudp.conformance.udp_scene import NAMES as SHARED
from tests.gateways.tcpudp.conformance.udp_scene import UdpScene
from zbridge.protocol import Address, Simulation

QUICK = RobotTimes(read_s=0.002, probe_s=0.3, silence_s=0.3, part_s=0.08, flight_s=0.1, unasked_s=0)
CLIENT = 7
VERSIONS = ("1.1", "1.2", "1.3", "1.4")
HELLO = {
    "1.1": "0e000000 07 03 03000000 312e31",
    "1.2": "0f000000 07 03 03000000 312e32",
    "1.3": "18000000 07 03 0b000000 312e312c312e322c312e33",
    "1.4": "18000000 07 03 0b000000 312e312c312e322c312e33",
}
FLAGS = {"1.1": "00000000", "1.2": "00000000 01", "1.3": "00000000 01 00", "1.4": "00000000 01 00"}
NAMES = SHARED | {
    "NO_MODE": "06000000 07 0a 01000000",
    "JOYSTICK_MODE": "06000000 07 0a 02000000",
    "AI_MODE": "06000000 07 0a 03000000",
    "TURN": "06000000 07 0c 0000003f",
    "GET_POSITION": "02000000 07 36",
    "GET_MAP": "02000000 07 34",
    "LIDAR_ON": "06000000 07 32 01000000",
    "SCAN": "a6050000 07 3d 68010000" + "0000c842" * 360,
    "HELLO": HELLO["1.3"] + "00" + FLAGS["1.3"],
    "LONG_4096": "fc0f0000 07 28" + "00" * 4090,
    "LONG_4098": "fe0f0000 07 28" + "00" * 4092,
}


def hello(version: str, udp: bool) -> str:
    return HELLO[version] + ("01" if udp else "00") + FLAGS[version]


class Hq(UdpScene):
    """Plain sockets and the few habits of an HQ that behaves."""

    names = NAMES

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)
        self.address = ("127.0.0.1", self.peer.port)

    async def established(self, _: str) -> None:
        await until(lambda: "ESTABLISHED" in repr(self.judge), repr(self.judge))

    async def awake(self, _: str) -> None:
        """Wait until it has slept after its 4."""
        await until(lambda: "ASLEEP" not in repr(self.judge), repr(self.judge))

    async def until_noted(self, step: str) -> None:
        """Do it again and again: nobody knows how late the robot's own time is."""
        async with asyncio.timeout(LONG_S):
            while not self.judge.violations:
                await self.play([step])

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

    async def probed(self, _: str) -> None:
        await self.play(["probing", "by_udp PROBE"])

    async def took(self, kinds: str) -> None:
        wanted = [int(kind) for kind in kinds.split()]
        await until(lambda: len(self.judge.received) >= len(wanted), lambda: self.judge.received)
        assert [row[2] for row in self.judge.received] == wanted

    async def kept(self, count: str) -> None:
        assert len(self.judge.violations) == int(count)

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
    options = {"client_id": CLIENT, "times": QUICK, **options}
    quirks = Quirks(**{name: options.pop(name) for name in Quirks.__struct_fields__ if name in options})
    return bounded(FragileRobot, {"version": version, "udp": udp, "seed": 1, "quirks": quirks, **options})


ROBOTS: dict[str, dict[str, Any]] = {
    "1.1": {"version": "1.1", "misnamed": 0.0},
    "1.2": {"version": "1.2"},
    "1.3": {},
    "1.4": {"version": "1.4", "parts": 4},
    **{f"{version} udp": {"version": version, "udp": True} for version in VERSIONS},
    "no probe": {"udp": True, "loss": Loss.PROBE},
    "no answer": {"udp": True, "loss": Loss.ANSWER},
    "long silence": {"udp": True, "times": RobotTimes(read_s=0.002, probe_s=0.3, silence_s=1.0, unasked_s=0)},
    "slow": {"times": RobotTimes(read_s=0.4, unasked_s=0)},
    "talks": {"times": RobotTimes(unasked_s=0.005)},
    "keeps 2": {"keep": 2},
    "misnames": {"misnamed": 1.0},
    "obeys": {"features": {FeatureFlag.CAM}, "obeys": {FeatureFlag.JOYSTICK}},
    "no features": {"features": set()},
}


def judged(lines: str) -> pytest.MarkDecorator:
    return table(lines, ROBOTS)


@judged(
    """
    commands before the settings | 1.3 | connect; > STOP; ! packet 13 while the robot waits for 1 or 3
    settings without a string | 1.3 | connect; > 06000000 07 03 09000000; ! no version string
    settings with 4 flags | 1.3 | connect; > 15000000 07 03 LIST_13 01000000; ! 4 flags for the versions '1.1,1.2,1.3'
    a second clientSettings | 1.3 | greet; > HELLO; !! a second clientSettings
    a list of 1.4 to a 1.3 | 1.3 udp | meet; > 18000000 07 03 0b000000 312e312c312e322c312e34 01000000000100
        ; ! to a robot that understands; silent
    two packets joined | 1.3 | greet; > STOP STOP; !! two packets in one read: 02 00 00 00 07 0d 02 00 00 00 07 0d
    a packet and a part | 1.3 | greet; > STOP 0200; !! 1 packets and a part of one in one read
    a part of a packet | 1.3 | greet; > 0600000007; !! a split packet, 5 of 10 bytes in one read: 06 00 00 00 07
    a split packet, once, and the next packet is read | 1.3 | greet; > 060000; > 00 07; > 0a 02000000; > STOP
        ; !! a split packet, 3 bytes in one read: 06 00 00; took 3 13
    packets too near to each other | slow | greet; > STOP; > STOP; > STOP; ! packets in one read: 02 00 00 00 07 0d 02
    packets over 4096 bytes, which are lost | 1.3 | greet; > LONG_4098; ! a packet of 4098 bytes, over 4096; > LONG_4096
        ; !! over 4096; took 3 40
    a length of 0 | 1.3 | greet; > 00000000 07 0d; !! no packet in one read, its length field is wrong: 00 00 00 00 07
    a wrong id byte | 1.3 | greet; > 06000000 08 0a 02000000; !! id byte 8 instead of 7
    a wrong mode | 1.3 | greet; > 06000000 07 0a 04000000; !! control mode 4
    a short body | 1.3 | greet; > 05000000 07 0a 020000; !! a body of 3 bytes instead of 4
    a wrong lidar mode | 1.3 | greet; > 06000000 07 32 03000000; !! lidar mode 3
    a long direction | 1.3 | greet; > 0e000000 07 0b 0000803f 0000803f 0000803f; !! a direction of length 1.414
    no number to drive | 1.3 | greet; > 0e000000 07 0b 0000c07f 0000803f 0000803f; !! numbers that are not finite
    no number to turn | 1.3 | greet; > 06000000 07 0c 0000807f; !! a number that is not finite
    a small scan | 1.3 | greet; > 0a000000 07 3d 01000000 0000c842; !! n = 1 instead of 360
    a scan cut off | 1.3 | greet; > 0a000000 07 3d 68010000 0000c842; !! 8 bytes for 360 floats
    a text cut off | 1.3 | greet; > 08000000 07 01 03000000 6869; !! a wrong byte count of the string
    a text that is not ASCII | 1.3 | greet; > 07000000 07 01 01000000 ff; !! a text that is not ASCII
    two probes | 1.3 udp | probed; by_udp PROBE; ! 2 probes 5 by UDP instead of one
    no probe | 1.3 udp | probing; < NOT_RECEIVED; ! no 5 by UDP within 0.3 s of the 4
    a late probe | 1.3 udp | probing; < NOT_RECEIVED; by_udp PROBE; ! the probe 5 came later than 0.3 s after the 4
    a missing status | 1.3 udp | probed; ! no 7 within 0.6 s of the 4
    a second status | 1.3 udp | greet 1.3 udp; > CONNECTED; ! a second 7
    a status nobody asked for | 1.3 udp | greet; > CONNECTED; ! a 7 though the robot sent no 4
    a status without an answer | no answer | probed; > CONNECTED; ! 7(true) though no 6(true) was received
    UDP before the probe | 1.3 udp | probing; by_udp FORWARD; ! a datagram before the probe 5: 0e 00 00 00 07 0b
    UDP while it sleeps | 1.3 udp | probed; by_udp FORWARD; ! packet 11 while the robot waits for 5 or 7
    UDP without agreement | no answer | probed; > NOT_CONNECTED; established; by_udp FORWARD
        ; ! packet 11 by UDP instead of TCP
    UDP after the end | 1.3 | greet; close; wait 0.015; again; silent; until_noted by_udp FORWARD
        ; ! a datagram after the TCP connection ended; ? second connection; told 2
    TCP while it sleeps | 1.3 udp | probed; > CONNECTED STOP; ! TCP other than one 7 within 0.3 s of the 4: 0
    TCP too soon after it slept | long silence | probed; > CONNECTED; established; > STOP
        ; ! packet 13 by TCP within 1 s of the 4
    11 by TCP | 1.3 udp | greet 1.3 udp; > FORWARD; ! packet 11 by TCP instead of UDP
    13 by UDP | 1.3 udp | greet 1.3 udp; by_udp STOP; ! packet 13 by UDP instead of TCP
    5 by TCP | 1.3 udp | greet 1.3 udp; > PROBE; ! packet 5 by TCP instead of UDP
    a map asked of one who sends it by itself, unless that was in flight | 1.4 | greet 1.4; kind 56; > GET_MAP
        ; took 3 52; ok; until_noted > GET_MAP; ! packet 52 to a robot that sends its map in parts by itself
    no more than is kept | keeps 2 | greet; > 02000000 08 0d; > 02000000 08 0d; > 02000000 08 0d; took 13 13; kept 2
    """
)
async def test_what_is_noted_and_survived(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as hq:
        await hq.play(steps)
        assert hq.judge.alive


@judged(
    """
    an empty text | 1.3 | greet; > 06000000 07 01 00000000; died a debugMessage with an empty text
    a list of 2 versions | 1.3 | connect; > 14000000 07 03 07000000 312e312c312e32 00000000000000
        ; died a version list of 2 entries
    UDP before TCP | 1.3 udp | by_udp PROBE; died a datagram before TCP: 02 00 00 00 07 05
    UDP before it sent 4 | 1.3 udp | meet; by_udp PROBE; died a datagram before the robot sent 4
    a datagram too long | 1.3 udp | greet 1.3 udp; by_udp 02000000 07 0d 00; died a datagram whose length field is wrong
    a datagram too short | 1.3 udp | greet 1.3 udp; by_udp 02000000 07; died a datagram whose length field is wrong
    50 without lidar | no features | greet; > LIDAR_ON; died unregistered packet id 50; eof; refused
    13 without joystick | no features | greet; > STOP; died unregistered packet id 13; eof; refused
    40 without chat | no features | greet; > 02000000 07 28; died unregistered packet id 40; eof; refused
    61 of a 1.1 | 1.1 | greet 1.1; > 06000000 07 3d 68010000; died unregistered packet id 61; eof; refused
    52 without slam_map | no features | greet; > GET_MAP; died unregistered packet id 52; eof; refused
    7 unasked | 1.3 | greet; > CONNECTED; died unregistered packet id 7; eof; refused
    """
)
async def test_it_dies_of(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as hq:
        await hq.play(steps)


@judged(
    """
    it speaks first, as a 1.1 | 1.1 udp | connect; < 0f000000 01 02 07 03000000 312e31 0101010101
    it speaks first, as a 1.2 | 1.2 udp | connect; < 10000000 01 02 07 03000000 312e32 010101010101
    it speaks first, as a 1.3 | 1.3 udp | connect; < 21000000 01 02 07 LIST_13 01010101010101 e8030000 0a000000
    it speaks first, as a 1.4 | 1.4 udp | connect; < 25000000 01 02 07 0f000000 312e312c312e322c312e332c312e34
        ; < 01010101010101 e8030000 0a000000
    it moves until it is stopped | 1.3 | greet; > FORWARD; wait 0.4; moving yes; > STOP; moving no; ok
    in mode 3 it drives on after a stop, until the mode ends and another stop comes | 1.3 | greet; > AI_MODE; wait 0.05
        ; moving yes; > STOP; wait 0.05; moving yes; > NO_MODE; wait 0.05; moving yes; > STOP; wait 0.05; moving no; ok
    id 0 passes before the settings | 1.3 | connect; > 18000000 00 03 LIST_13 00 00000000 01 00; > STOP; ok
    a second connection hears nothing and does no harm | 1.3 | greet; crowd 20; > STOP; ok; took 3 13
    a 7 that denies the answer is an event, and all goes by TCP | 1.3 udp | probed; > NOT_CONNECTED; established
        ; > FORWARD; ok; ? 7(false) though 6(true) was sent by UDP; told 1
    a lost probe is answered by TCP, as all is | no probe | probed; < NOT_RECEIVED; > NOT_CONNECTED; > FORWARD; > STOP
        ; ok
    a lost answer ends with a late status | no answer | probed; awake; > NOT_CONNECTED; > FORWARD; ok
    the answers are those of the page | 1.1 | greet 1.1; > LIDAR_ON; < 06000000 01 33 01000000; > GET_POSITION
        ; < 0e000000 01 37 00000000 00000000 0000b4c2; > GET_MAP; < 02000000 01 35; > GET_MAP; < 16270000 01 35 10270000
    a position may come as id 53 | misnames | greet; > GET_POSITION; < 0e000000 01 35 00000000 00000000 0000b4c2
    a 1.4 reads TCP while it sends its map | 1.4 | greet 1.4; kind 56; > FORWARD; kind 56; > STOP; kind 56; > TURN; ok
        ; took 3 11 13 12
    a 1.4 sends no parts to who did not announce lidar_sim, and does not answer 52 | 1.4 | meet
        ; > 18000000 07 03 LIST_13 00 00000000 0000; > GET_MAP; > LIDAR_ON; kind 51; ok
    it may obey what it does not announce | obeys | greet; > STOP; ok
    a connection that breaks is an event | talks | greet; reset; ? the connection broke; ok
    """
)
async def test_what_an_hq_may_do(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as hq:
        await hq.play(steps)


@pytest.mark.parametrize("udp", [False, True])
@pytest.mark.parametrize("version", VERSIONS)
async def test_an_hq_that_behaves_is_not_reproached(version: str, udp: bool) -> None:
    robot = quick(version, udp, times=RobotTimes(probe_s=0.3, silence_s=0.3, part_s=0.02, unasked_s=0.02))
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


async def test_map_parts_cover_the_map_run_past_its_end_and_come_again_and_again_unasked() -> None:
    async with facing(quick("1.4", udp=True, parts=4)) as hq:
        await hq.greet("1.4 udp")
        parts = [await hq.datagram() for _ in range(6)]
        bounds = [struct.unpack_from("<iBBii", part)[1:] for part in parts]
        once = [(1, 56, 0, 2501), (1, 56, 2501, 5002), (1, 56, 5002, 7503), (1, 56, 7503, 10004)]
        assert bounds == [*once, *once[:2]]
        assert parts[:2] == parts[4:]


async def test_it_talks_unasked_and_once_with_two_headers() -> None:
    async with facing(quick("1.3", times=RobotTimes(unasked_s=0.01))) as hq:
        await hq.greet("1.3")
        packets = [await hq.packet() for _ in range(18)]
        assert {packet[5] for packet in packets} == {1, 31, 40, 51, 53, 55, 60}
        assert packets.count(hq.raw("17000000 01 01 11000000 01 01 0b000000") + b"two headers") == 1


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


@pytest.mark.parametrize("version", ["1.1", "1.2"])
async def test_robots_of_1_1_and_1_2_ignore_the_first_packet_that_they_read_alone_after_that(version: str) -> None:
    robot = quick(version)
    async with facing(robot) as hq:
        await hq.play([f"greet {version}", "> FORWARD", "moving yes"])
        for _ in range(5):
            hq.peer.tcp.send(hq.raw("STOP"))
            time.sleep(0.05)  # noqa: ASYNC251 - nobody is to run meanwhile
        await hq.violated("5 packets in one read")
        await hq.play(["> STOP", "wait 0.1", "moving yes", "> STOP", "moving no"])
        assert [row[1:] for row in robot.ignored] == [("tcp", 13, b"")]


async def test_packets_back_to_back_are_held_against_the_hq() -> None:
    robot = quick(times=RobotTimes(read_s=0.002, gap_s=0.01, unasked_s=0))
    async with facing(robot) as hq:
        await hq.greet("1.3")
        for _ in range(50):  # a busy machine may excuse some
            await hq.play(["wait 0.1", "> STOP STOP", "! two packets in one read"])
            if "(this process" not in robot.violations[-1]:
                return
    raise AssertionError(robot.violations)


async def test_what_is_misread_follows_from_the_seed_and_is_shown() -> None:
    orders = []
    for _ in range(2):
        robot = quick("1.1", misread=0.3)
        async with facing(robot) as hq:
            await hq.play(["greet 1.1", *["> LIDAR_ON"] * 12, "ok"])
            rows = [(row[0], row in robot.misread) for row in [*robot.received, *robot.misread] if row[2] == 50]
            orders.append([misread for _, misread in sorted(rows)])
    assert orders[0] == orders[1]
    assert (len(orders[0]), set(orders[0])) == (12, {True, False})


@pytest.mark.parametrize(
    ("name", "version", "udp", "obeys"),
    [
        ("tcpudp-1.1-tcp.hex", "1.1", False, {FeatureFlag.JOYSTICK, FeatureFlag.LIDAR}),
        ("tcpudp-1.3-udp.hex", "1.3", True, {FeatureFlag.JOYSTICK}),
    ],
)
async def test_the_recorded_hq_is_not_reproached(name: str, version: str, udp: bool, obeys: set[FeatureFlag]) -> None:
    features = {FeatureFlag.LIDAR_SIM, FeatureFlag.SLAM_MAP} if udp else set()
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


async def test_a_datagram_from_another_socket_is_noted() -> None:
    async with facing(quick(udp=True)) as hq:
        await hq.greet("1.3 udp")
        with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
            other.sendto(hq.raw("FORWARD"), ("127.0.0.1", hq.peer.port))
        await hq.violated("not from where 5 came from")


async def test_the_simulator_logs_violations_and_says_what_it_died_of(caplog, capsys) -> None:
    bound: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    simulation = Simulation((Address("127.0.0.1", 0),), ready=bound.set_result)
    task = asyncio.create_task(
        FragileRobot(version="1.3", udp=False, seed=3).simulate(simulation.addresses, simulation.ready)
    )
    hq = Hq(None, Peer((await bound)[0].port), task)
    with contextlib.closing(hq.peer), contextlib.closing(hq.udp):
        await hq.connect("")
        client = (await hq.packet())[6]
        await hq.play([f"> 02000000 {client:02x} 48", "over"])
    assert capsys.readouterr().out.startswith("died: unregistered packet id 72")
    assert [record.levelno for record in caplog.records if "violation" in record.message] == [logging.ERROR]
