"""HQ programs at a gateway, end to end: fragile judges and programs written by hand, real processes and sockets."""

from __future__ import annotations

import asyncio
import contextlib
import random
import struct
import threading
import time

import pytest

from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from gateways.wc2ec.conformance.fragile_hq import FragileExternalController
from tests.e2e.conftest import HOST, Bench, device, listener
from tests.e2e.measured.hq_churn import churn
from tests.e2e.measured.hq_judge import judge
from tests.e2e.rigs.fragile import charges
from tests.e2e.rigs.hq_scene import NEUTRAL, ByHand, playing, ports, sessions, soon
from tests.e2e.rigs.robots import SETTINGS, Robot, position

# Every protocol and version at once


@pytest.mark.parametrize(
    ("kind", "drivers"),
    [
        ("tcpudp-1.1", ["tcp1.3", "alf-binary", "ec"]),
        ("tcpudp-1.2", ["tcp1.2"]),
        ("tcpudp-1.3", ["tcp1.1", "alf-text", "ec"]),
        ("alf", ["tcp1.2", "alf-text", "ec"]),
        ("wc2ec", ["tcp1.3", "alf-binary", "ec"]),
    ],
)
async def test_programs_of_every_protocol_see_one_robot_and_drive_it_in_turn_and_nobody_complains(
    kind: str, drivers: list[str]
) -> None:
    judgement = await judge(kind, drivers)
    assert judgement.clean, [judgement, *judgement.faults, *judgement.excused]


async def test_programs_that_come_and_go_leave_nothing_behind_and_room_for_254_and_no_more() -> None:
    came = await churn(300, warm_up=100)
    assert came.ways.total() == 300
    assert not came.faults, f"{came}\n{came.faults}"


# A process of its own

_GONE = {"robot offline: gateway stopped", "no gateway serves the robot"}
"""Its last status may be overtaken by the news that it is gone, which goes before all else, as stops do."""


async def test_a_process_without_a_robot_tells_its_programs_when_the_robot_comes_and_goes(bench: Bench) -> None:
    tcp, alf, ec = ports(3)
    parts = [listener("tcp", "tcpudp", tcp), listener("alf", "alf", alf), listener("ec", "wc2ec", ec)]
    hq, simulated = bench.gateway(*parts, name="hq"), device(bench.simulator())
    await soon(lambda: hq.listens(3), "listeners")
    program, vehicle, controller = FragileTcpUdpHq(), FragileAlfHq(), FragileExternalController()

    async def told(what: str) -> None:
        await soon(lambda: any(what in text for text in program.texts), f"told: {what}")

    async def drives() -> None:
        """Drive until the robot moves; the stick stays pushed."""
        before = bench.fleet.last("r1/pose")
        program.mode(2)
        program.move(0.0, 1.0, 0.5)
        await soon(lambda: abs(bench.fleet.last("r1/pose")["y"] - before["y"]) > 0.1, "motion")
        assert bench.fleet.last("r1/control")["holder"] == "hq.tcp.2"

    async with playing(program.run(HOST, tcp), vehicle.run(HOST, alf), controller.run(HOST, ec)):
        await told("no gateway serves the robot")
        gateway = bench.gateway(simulated)
        await told("the robot is there")
        await soon(lambda: program.position, "position")
        program.move(0.0, 1.0, 0.5)
        refused = await soon(lambda: bench.fleet.refusal(code="no_lease"), "motion without a control mode refused")
        assert (refused["who"], refused["by"], refused["reason"]) == ("hq.tcp.2", "hq.tcp", "control mode is none")
        await soon(lambda: bench.fleet.refusal(code="neutral_first", who="hq.tcp.2"), "the stick still pushed")
        program.idle()
        await drives()
        program.texts.clear()
        await asyncio.to_thread(gateway.end)  # the programs continue meanwhile
        await soon(lambda: _GONE.intersection(program.texts), "told that it went")
        bench.gateway(simulated)
        await told("the robot is there")
        gone = [text for text in program.texts if text in _GONE]
        assert len(gone) == 1 or bench.withheld_s > 0.5, gone  # a late listener sees its end and its status apart
        before = bench.fleet.last("r1/pose")
        await told("release the stick first")
        await soon(lambda: bench.fleet.last("r1/pose")["at"] > before["at"] + 0.5, "a pose")
        after = bench.fleet.last("r1/pose")
        assert (after["x"], after["y"]) == pytest.approx((before["x"], before["y"]))
        program.idle()
        await drives()
        assert len({entry["name"] for entry in sessions(bench) if entry["role"] == "robot"}) == 3
        await vehicle.end()
        hq.end()
    for one in (program, vehicle, controller):
        assert one.alive
        assert not charges(one.violations)


# Programs that behave badly


class _Feed(threading.Thread):
    """A scripted robot that says fifty times a second where it is, and shows a map a quarter as often."""

    MAP = struct.pack("<iBBi", 2 + 4 + 44 * 44, 1, 53, 44 * 44) + bytes(44 * 44)

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.sent: list[float] = []
        self.ends = threading.Event()
        size_440_in_steps_of_10 = struct.pack("<ii", 440, 10)
        self.robot = Robot(SETTINGS[:-8] + size_440_in_steps_of_10)

    def run(self) -> None:
        due = time.monotonic()
        while not self.ends.wait(max(0.0, due - time.monotonic())):
            due += 0.02
            with contextlib.suppress(AssertionError, OSError):
                self.robot.send(position(len(self.sent), 0.0, 0.0))
                self.sent.append(time.monotonic())
                if len(self.sent) % 4 == 0:
                    self.robot.send(self.MAP)


async def test_programs_that_behave_badly_cost_a_good_one_nothing_and_are_closed_with_a_reason(bench: Bench) -> None:
    feed, (port,) = _Feed(), ports(1)
    limits = "options = { udp = false }\nrate_hz = 200"
    process = bench.gateway(listener("hq", "tcpudp", port, limits), device(feed.robot.port))
    await soon(lambda: process.listens(1) and bench.fleet.state() == "established", "established")
    feed.start()
    good = FragileTcpUdpHq(udp=False)
    async with playing(good.run(HOST, port)):
        await soon(lambda: good.position, "position")
        began, withheld_s = time.monotonic(), bench.withheld_s
        async with asyncio.timeout(60):
            numbers = await asyncio.gather(*(_misbehave(way, port) for way in _WAYS))
        ended, late_s = time.monotonic(), bench.withheld_s - withheld_s
        table = {entry["name"]: entry for entry in sessions(bench)}
    feed.ends.set()
    sent = sum(began < at < ended for at in feed.sent)
    got = sum(began < at < ended for at, _, kind, _ in good.received if kind == 55)
    told = f"{got} of {sent} positions in {ended - began:.1f} s, in which the machine was late for {late_s:.1f} s"
    assert got >= max(1, 0.9 * (sent - 50 * late_s)), told
    assert sent >= 0.5 * 50 * (ended - began - late_s), "the robot itself was late"
    assert good.alive
    assert not charges(good.violations)
    for reason, number in zip(_WAYS.values(), numbers, strict=True):
        assert table[f"hq.{number}"]["state"] == "closed"
        assert reason in table[f"hq.{number}"]["reason"]
    process.end()
    feed.robot.close()


_WAYS = {
    "stops reading": "took nothing for 5 s",
    "floods": "flood: more than 200 messages a second",
    "sends rubbish": "broken stream",
}


async def _misbehave(way: str, port: int) -> int:
    """Behave badly until the gateway closes the connection; give the client id."""
    program = await ByHand.connect(port, receive_bytes=4096 if way == "stops reading" else 0)
    number = await program.shake()
    if way == "floods":
        program.writer.write(NEUTRAL * 5000)
    elif way == "sends rubbish":
        program.writer.write(random.Random(1).randbytes(10_000))
    else:
        program.writer.transport.pause_reading()  # type: ignore[attr-defined]
        with contextlib.suppress(OSError):
            while True:  # it sends, and so hears of the end
                program.writer.write(NEUTRAL)
                await program.writer.drain()
                await asyncio.sleep(0.2)
    assert await program.closed()
    return number
