"""HQ programs at a gateway, end to end: fragile judges and programs written by hand, real processes and sockets."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from gateways.alf.conformance.fragile_hq import FragileHq as AlfHq
from gateways.tcpudp.conformance.fragile_hq import FragileHq as TcpHq
from gateways.wc2ec.conformance.fragile_hq import FragileController
from tests.captures import Record, payloads
from tests.e2e.conftest import Bench
from tests.e2e.fragile import charges, fragile_robot
from tests.e2e.hq_churn import CLIENTS, Churn, churn, crowd
from tests.e2e.hq_judge import RANGES, judge, stage
from tests.e2e.hq_scene import HOST, NEUTRAL, ByHand, device, gateway, listener, playing, ports, sessions, soon
from tests.e2e.robots import SETTINGS, ScriptedRobot, position


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    """What a test has started beside its bench."""
    with contextlib.ExitStack() as started:
        yield started


# Every protocol and version at once


@pytest.mark.parametrize(
    ("robot", "drivers"),
    [
        ("tcpudp-1.1", ["tcp1.3", "alf-binary", "ec"]),
        ("tcpudp-1.3", ["tcp1.1", "alf-text", "ec"]),
        ("alf", ["tcp1.2", "alf-text", "ec"]),
        ("wc2ec", ["tcp1.3", "alf-binary", "ec"]),
    ],
)
async def test_programs_of_every_protocol_see_one_robot_and_drive_it_in_turn_and_nobody_complains(
    robot: str, drivers: list[str]
) -> None:
    judgement = await judge(robot, drivers)
    assert judgement.clean, [*judgement.faults, *judgement.excused]


async def test_a_robot_that_asks_for_lidar_data_gets_that_of_a_program_and_the_bus_sees_it() -> None:
    with fragile_robot("tcpudp-1.2", misnamed=0.0, times={"unasked_s": 0.05}) as process:
        async with stage("tcpudp-1.2", process) as on:
            await on.all_see()
            asked = {program.name: program.judge for program in on.programs if isinstance(program.judge, TcpHq)}
            assert asked["tcp1.1"].counts[60] == 0, "a program that has no flag for it is not asked"
            scan = on.bench.fleet.last("r1/scan")
            ranges_m = np.frombuffer(scan["ranges"], "<f4")
            assert ranges_m == pytest.approx(np.array(RANGES) / 100)
            assert (scan["angle_min"], scan["angle_increment"]) == pytest.approx((0.0, np.radians(1.0)))
            vehicle = on.program("alf-scans").judge
            assert isinstance(vehicle, AlfHq)
            assert vehicle.last_scan is not None
            assert (vehicle.last_scan.points[0], vehicle.last_scan.points[-1]) == (1200, 2995), "millimetres"
        out, _ = await asyncio.to_thread(process.communicate, "end\n", 20)
    fed = [bytes.fromhex(body) for _, _, kind, body in json.loads(out)["received"] if kind == 61]
    assert fed, "the robot is fed"
    assert struct.unpack("<i", fed[0][:4]) == (360,)
    assert np.frombuffer(fed[0][4:], "<f4") == pytest.approx(np.array(RANGES))


# A process of its own


async def test_a_process_without_a_robot_tells_its_programs_when_the_robot_comes_and_goes(bench, stack) -> None:
    robot, tcp, alf, ec = ports(4)
    hq = gateway(
        bench,
        stack,
        *(listener("tcp", "tcpudp", tcp), listener("alf", "alf", alf), listener("ec", "wc2ec", ec)),
        name="hq",
    )
    bench.simulator(robot)
    await soon(lambda: hq.listens(3), "listeners")
    program, vehicle, controller = TcpHq(), AlfHq(), FragileController()
    async with playing(program.run(HOST, tcp), vehicle.run(HOST, alf), controller.run(HOST, ec)):
        await soon(lambda: "no gateway serves the robot" in program.texts, "told that there is none")
        first = gateway(bench, stack, device("tcpudp", robot))
        await soon(lambda: "the robot is there" in program.texts, "told that it came")
        await soon(lambda: program.position, "position")
        await _drives(bench, program, "hq.tcp.2")
        told = len(program.texts)
        first.end()
        await soon(lambda: _GONE.intersection(program.texts[told:]), "told that it went")
        gateway(bench, stack, device("tcpudp", robot))
        await soon(lambda: "the robot is there" in program.texts[told:], "told that it came again")
        gone = [text for text in program.texts[told:] if text in _GONE]
        assert len(gone) == 1 or bench.withheld_s > 0.5, gone  # a late listener sees its end and its status apart
        before = bench.fleet.last("r1/pose")
        await soon(lambda: _mentions(program.texts[told:], "release the stick first"), "told why it does not move")
        after = await soon(lambda: _newer(bench, before), "a pose")
        assert (after["x"], after["y"]) == pytest.approx((before["x"], before["y"]))
        program.idle()
        await _drives(bench, program, "hq.tcp.2")
        assert len({entry["name"] for entry in sessions(bench) if entry["role"] == "robot"}) == 3
        await vehicle.end()
        hq.end()
    for one in (program, vehicle, controller):
        assert one.alive
        assert not charges(one.violations)


async def test_what_a_listener_refuses_shows_on_control_of_the_robot_whose_process_is_another(bench, stack) -> None:
    robot, tcp = ports(2)
    bench.simulator(robot)
    hq = gateway(bench, stack, listener("tcp", "tcpudp", tcp), name="hq")
    gateway(bench, stack, device("tcpudp", robot))
    await soon(lambda: bench.fleet.state("r1") == "established", "the robot")
    await soon(lambda: hq.listens(1), "the listener")
    program = TcpHq()
    async with playing(program.run(HOST, tcp)):
        await soon(lambda: program.position, "position")
        program.move(0.0, 1.0, 0.5)
        no_mode = await soon(lambda: _refusal(bench, "no_lease"), "motion without a control mode refused")
        assert (no_mode["who"], no_mode["command"], no_mode["by"]) == ("hq.tcp.2", "drive", "hq.tcp")
        assert no_mode["reason"] == "control mode is none"
        stuck = await soon(lambda: _refusal(bench, "neutral_first"), "the stick that was pushed all the time refused")
        assert (stuck["who"], stuck["reason"]) == ("hq.tcp.2", "control mode is none: release the stick first")
        await soon(lambda: (_refusal(bench, "neutral_first") or stuck)["count"] > 2, "and counted")
        assert bench.fleet.last("r1/control")["state"] == "free"


_GONE = {"robot offline: gateway stopped", "no gateway serves the robot"}
"""Its last status may be overtaken by the news that it is gone, which goes before all else, as stops do."""


def _refusal(bench: Bench, code: str) -> dict[str, Any] | None:
    refusals = bench.fleet.last("r1/control").get("refusals", [])
    return next((entry for entry in refusals if entry["code"] == code), None)


async def _drives(bench: Bench, program: TcpHq, who: str) -> None:
    """Drive until the robot moves; the stick stays pushed."""
    before = bench.fleet.last("r1/pose")
    program.mode(2)
    program.move(0.0, 1.0, 0.5)
    await soon(lambda: abs(bench.fleet.last("r1/pose")["y"] - before["y"]) > 0.1, "motion")
    assert bench.fleet.last("r1/control")["holder"] == who


def _mentions(texts: list[str], what: str) -> bool:
    return any(what in text for text in texts)


def _newer(bench: Bench, than: dict[str, Any]) -> dict[str, Any]:
    """The last pose, if it is half a second younger than that one."""
    pose = bench.fleet.last("r1/pose")
    return pose if pose["at"] > than["at"] + 0.5 else {}


# Programs that behave badly


class _Feed(threading.Thread):
    """A scripted robot that says fifty times a second where it is, and shows a map a quarter as often."""

    MAP = struct.pack("<iBBi", 2 + 4 + 44 * 44, 1, 53, 44 * 44) + bytes(44 * 44)

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.sent: list[float] = []
        self._ends = threading.Event()
        size_440_in_steps_of_10 = struct.pack("<ii", 440, 10)
        self._robot = ScriptedRobot(SETTINGS[:-8] + size_440_in_steps_of_10)
        self.port = self._robot.port

    def run(self) -> None:
        due = time.monotonic()
        while not self._ends.wait(max(0.0, due - time.monotonic())):
            due += 0.02
            with contextlib.suppress(AssertionError, OSError):
                self._robot.send(position(len(self.sent), 0.0, 0.0))
                self.sent.append(time.monotonic())
                if len(self.sent) % 4 == 0:
                    self._robot.send(self.MAP)

    def close(self) -> None:
        self._ends.set()
        self.join()
        self._robot.close()


async def test_programs_that_behave_badly_cost_a_good_one_nothing_and_are_closed_with_a_reason(bench, stack) -> None:
    feed, (port,) = _Feed(), ports(1)
    stack.callback(feed.close)
    limits = 'options = { udp = false }\nallow = ["127.0.0.1/32"]\nhandshake_s = 1.0\nrate_hz = 200'
    process = gateway(bench, stack, listener("hq", "tcpudp", port, limits), device("tcpudp", feed.port))
    await soon(lambda: process.listens(1) and bench.fleet.state("r1") == "established", "established")
    feed.start()
    good = TcpHq(udp=False)
    async with playing(good.run(HOST, port)):
        await soon(lambda: good.position, "position")
        began, withheld_s = time.monotonic(), bench.withheld_s
        bad = _Bad(port)
        async with asyncio.timeout(60):
            await bad.misbehave()
        ended, late_s = time.monotonic(), bench.withheld_s - withheld_s
        table = {entry["name"]: entry for entry in sessions(bench)}
    sent = sum(began < at < ended for at in feed.sent)
    got = sum(began < at < ended for at, _, kind, _ in good.received if kind == 55)
    told = f"{got} of {sent} positions in {ended - began:.1f} s, in which the machine was late for {late_s:.1f} s"
    assert got >= 0.9 * (sent - 50 * late_s), told
    assert got > 0, told
    assert sent >= 0.5 * 50 * (ended - began - late_s), "the robot itself was late"
    assert good.alive
    assert not charges(good.violations)
    reasons = {way: table[f"hq.{number}"]["reason"] for way, number in bad.numbers.items()}
    assert reasons == {
        "stops reading": "took nothing for 5 s",
        "reads a byte a second": "took nothing for 5 s",
        "floods": "flood: more than 200 messages a second",
        "sends rubbish": reasons["sends rubbish"],
        "says nothing": "no handshake within 1 s",
    }
    assert "broken stream" in reasons["sends rubbish"]
    assert {table[f"hq.{number}"]["state"] for number in bad.numbers.values()} == {"closed"}
    assert "its network is not allowed" in process.log
    process.end()


class _Bad:
    """Six programs that behave badly, each until it is closed; ``numbers``: their client ids."""

    def __init__(self, port: int) -> None:
        self.numbers: dict[str, int] = {}
        self._port = port

    async def misbehave(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for program in (self.stop_reading(), self.read_slowly(), self.flood(), self.rubbish(), self.silent()):
                tasks.create_task(program)
            tasks.create_task(self.stranger())

    async def _enter(self, way: str, receive_bytes: int = 0) -> ByHand:
        program = await ByHand.connect(self._port, receive_bytes=receive_bytes)
        self.numbers[way] = await program.shake()
        return program

    async def stop_reading(self) -> None:
        program = await self._enter("stops reading", 4096)
        program.writer.transport.pause_reading()  # type: ignore[attr-defined]
        while True:  # it goes on sending, and so hears of its end
            program.writer.write(NEUTRAL)
            try:
                await program.writer.drain()
            except OSError:
                break
            await asyncio.sleep(0.2)
        await program.leave()

    async def read_slowly(self) -> None:
        program = await self._enter("reads a byte a second", 4096)
        conn = program.writer.get_extra_info("socket")
        program.writer.transport.pause_reading()  # type: ignore[attr-defined]
        while True:
            program.writer.write(NEUTRAL)
            try:
                await program.writer.drain()
                await asyncio.sleep(1.0)
                os.read(conn.fileno(), 1)
            except OSError:
                break
        await program.leave()

    async def flood(self) -> None:
        program = await self._enter("floods")
        program.writer.write(NEUTRAL * 5000)
        assert await program.closed()

    async def rubbish(self) -> None:
        program = await self._enter("sends rubbish")
        program.writer.write(random.Random(1).randbytes(10_000))
        assert await program.closed()

    async def silent(self) -> None:
        program = await ByHand.connect(self._port)
        _, body = await program.packet()
        self.numbers["says nothing"] = body[0]
        assert await program.closed()

    async def stranger(self) -> None:
        program = await ByHand.connect(self._port, "127.0.0.2")
        assert await program.closed()


# Many programs


async def test_254_programs_connect_the_next_is_closed_and_when_they_have_left_there_is_room_again(
    bench: Bench, stack: contextlib.ExitStack
) -> None:
    (port,) = ports(1)
    hq = gateway(bench, stack, listener("hq", "tcpudp", port, "accept_hz = 1000\noptions = { quiet_s = 0.5 }"))
    await soon(lambda: hq.listens(1), "the listener")
    programs, refused = await crowd(port)
    assert refused
    assert "as many clients as there can be" in hq.log
    assert sum(entry["state"] == "established" for entry in sessions(bench)) == CLIENTS
    for program in programs:
        await program.leave()
    await soon(lambda: not [entry for entry in sessions(bench) if entry["state"] != "closed"], "all have left")
    early = await ByHand.connect(port)
    assert await early.reader.read(1) == b"", "their ids are not given again at once"
    await early.leave()
    await asyncio.sleep(0.6)
    for program in (await crowd(port))[0]:
        await program.leave()
    hq.end()


async def test_programs_that_come_and_go_leave_nothing_behind() -> None:
    came: Churn = await churn(300, warm_up=100)
    assert came.ways.total() == 300
    assert not came.faults, f"{came}\n{came.faults}"


# The HQ half of every capture

Command = tuple[str, dict[str, Any]]
HI = ("text", {"text": "hi there", "kind": "debug"})
MANUAL = ("mode", {"mode": "manual"})
MOVE = ("drive", {"forward": pytest.approx(0.8), "left": pytest.approx(-0.6), "turn": 0.0})
"""11 with x 0.6, y 0.8 at speed 1.5: clipped to full scale."""
TURN = ("drive", {"forward": 0.0, "left": 0.0, "turn": 0.75})
"""12 at -0.75: to the left."""
STOP = ("drive", {"forward": 0.0, "left": 0.0, "turn": 0.0})
DEGREE = 2 * np.pi / 360
CAPTURES = {"v11": "tcpudp-1.1-tcp.hex", "v13": "tcpudp-1.3-udp.hex"}


class Replaying:
    """A simulated robot with listeners of every protocol, and what is commanded."""

    def __init__(self, bench: Bench, ports: dict[str, int]) -> None:
        self.bench, self.ports = bench, ports
        self._commands: list[Command] = []

    def take(self, sample: zenoh.Sample) -> None:
        fields = msgpack.unpackb(sample.payload.to_bytes())
        self._commands.append((str(sample.key_expr).partition("@cmd/")[2], fields))

    def commands(self) -> list[Command]:
        """Take what was commanded, each repetition once; without stamps, senders and what is not said."""
        told: list[Command] = []
        commands, self._commands = self._commands, []
        for key, fields in commands:
            said = {name: value for name, value in fields.items() if value is not None}
            said.pop("stamp_ns", None)
            said.pop("sender", None)
            if not told or told[-1] != (key, said):
                told.append((key, said))
        return told

    async def replay(
        self, where: str, records: list[Record], first: bytes = b"", awaited: tuple[bytes, ...] = ()
    ) -> bytes:
        """Send what a program sent, with pauses of 0.15 s at most; give what came, of either channel.

        ``first``: sent after the handshake, before all else. ``awaited``: what must come before it leaves.
        """
        port, came = self.ports[where], bytearray()
        program = await ByHand.connect(port)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams:
            datagrams.setblocking(False)
            datagrams.bind((HOST, 0))
            async with playing(_read(program, came), _hear(datagrams, came)):
                last_s = 0.0
                for record in records:
                    await asyncio.sleep(min(0.15, record.seconds - last_s))
                    if first and record.seconds - last_s > 1.0:  # deployed programs wait here: they have shaken hands
                        program.writer.write(first)
                        await asyncio.sleep(0.15)
                    last_s = record.seconds
                    if record.transport == "UDP":
                        await asyncio.get_running_loop().sock_sendto(datagrams, record.payload, (HOST, port))
                    else:
                        program.writer.write(record.payload)
                await asyncio.sleep(0.3)
                await soon(lambda: all(one in came for one in awaited), f"{awaited}")
            await program.leave()
        await soon(lambda: self.bench.fleet.last("r1/control")["state"] == "free", "free")
        return bytes(came)


async def _read(program: ByHand, came: bytearray) -> None:
    while data := await program.reader.read(65536):
        came += data


async def _hear(datagrams: socket.socket, came: bytearray) -> None:
    while True:
        came += await asyncio.get_running_loop().sock_recv(datagrams, 65536)


@pytest.fixture
async def replaying(bench: Bench, stack: contextlib.ExitStack) -> Replaying:
    robot, *free = ports(5)
    at = dict(zip(("v11", "v13", "alf", "ec"), free, strict=True))
    bench.simulator(robot)
    parts = [
        listener("v11", "tcpudp", at["v11"], 'options = { versions = ["1.1"], udp = false }'),
        *(listener("v13", "tcpudp", at["v13"]), listener("alf", "alf", at["alf"]), listener("ec", "wc2ec", at["ec"])),
    ]
    process = gateway(bench, stack, *parts, device("tcpudp", robot))
    await soon(lambda: process.listens(4) and bench.fleet.last("r1/map"), "the robot and its listeners")
    replay = Replaying(bench, at)
    session: Any = bench.fleet.session
    watching = session.declare_subscriber("fleet/r1/@cmd/**", replay.take)
    stack.callback(watching.undeclare)
    return replay


def _hq_half(where: str) -> list[Record]:
    return payloads(CAPTURES[where], destination=11001)


@pytest.mark.parametrize("where", CAPTURES)
async def test_a_captured_program_that_drives_at_once_is_told_to_let_go_first_and_drives_after_that(
    replaying: Replaying, where: str
) -> None:
    answers = bytes.fromhex("0e000000 01 37"), bytes.fromhex("01 35")
    came = await replaying.replay(where, _hq_half(where), awaited=answers)
    hi, *lidar = replaying.commands()
    assert hi == HI
    assert [key for key, _ in lidar] == ["scan"] * (where == "v13")
    assert b"connected: release the stick first" in came
    came = await replaying.replay(where, _hq_half(where), first=NEUTRAL)
    assert replaying.commands() == [HI, MANUAL, MOVE, TURN, STOP, *lidar]
    assert b"let go" not in came
    for _, scan in lidar:
        assert (scan["angle_min"], scan["angle_increment"]) == pytest.approx((0.0, DEGREE))
        ranges_cm = np.frombuffer(scan["ranges"], "<f4") * 100
        assert ranges_cm[:4] == pytest.approx([100.0, 100.5, 101.0, 101.5])
        assert len(ranges_cm) == 360


async def test_captured_programs_of_the_other_protocols_command_what_they_say_or_nothing(replaying: Replaying) -> None:
    await replaying.replay("alf", payloads("alf-drive.hex", destination=16668))
    lit, driven = replaying.commands()
    assert driven == ("drive", {"forward": pytest.approx(80 / 255), "left": 0.0, "turn": pytest.approx(-30 / 90)})
    assert lit == ("drive", {**driven[1], "light": True})
    came = await replaying.replay("alf", payloads("alf-laser.hex", destination=16667))
    assert came == b"255|1;", "END is answered"
    came = await replaying.replay("ec", payloads("wc2ec-deployed.hex", destination=27515))
    sectors = range(2, 10)
    named = b"".join(bytes([0, 37, number, 7]) + b"sector%d" % (number - 2) for number in sectors)
    faults = b"".join(bytes([1, 37, number]) + bytes.fromhex("000000000000f0bf") for number in sectors)
    wheels = bytes.fromhex("00 35 00 04") + b"left" + bytes.fromhex("00 35 01 05") + b"right"
    assert came == wheels + named + faults, "no scan has come, and it is ready all the same"
    assert replaying.commands() == []
