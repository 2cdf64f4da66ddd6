"""Restarts that no robot notices: strict robots and HQ programs as judges, and successors that fail."""

from __future__ import annotations

import asyncio
import re
import signal
import time

import pytest

from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from gateways.wc2ec.conformance.fragile_hq import FragileExternalController
from tests.e2e.conftest import HOST, Bench, device, listener, start, until
from tests.e2e.measured.restarts import MOST_GAP_S, ROBOTS, Restarted, restart
from tests.e2e.rigs.fragile import Fragile, charges
from tests.e2e.rigs.hq_scene import playing, ports, soon
from tests.e2e.rigs.processes import ROOT
from tests.e2e.rigs.robots import MOVE, STOP, Robot
from tests.ports import free_port
from zbridge.app.handover.channel import VERSION


@pytest.mark.parametrize("protocol", ROBOTS)
def test_five_restarts_under_traffic_lose_and_double_no_packet_and_stop_the_robot(protocol: str) -> None:
    judgement = restart(protocol, 5)
    assert judgement.clean, [str(judgement), *judgement.faults]
    assert len(judgement.gaps_s) == 5


@pytest.mark.parametrize("name", ["tcpudp-1.3-udp", "alf", "wc2ec"])
def test_a_strict_robot_finds_nothing_to_complain_of_in_a_restart_while_it_is_driven(bench: Bench, name: str) -> None:
    patient = {"gap_s": MOST_GAP_S, "window_commands": 1} if name == "alf" else {}
    robot = Fragile(bench.stack, name, times=patient)
    gateway = Restarted(bench, bench.gateway(device(robot.port, robot.kind.protocol, robot.kind.options)))
    until(lambda: bench.fleet.state() == "established", what="established")
    for _ in range(2):
        bench.fleet.hold("r1", deadman_s=1.0)
        for _ in range(10):
            bench.fleet.put("r1/@cmd/drive", forward=0.5, left=0.0, turn=0.0)
            time.sleep(0.05)
        assert gateway.ask() == [{}], gateway.gateway.log
    assert bench.fleet.state() == "established"
    until(lambda: bench.fleet.last("r1/control").get("state") == "free", what="the new authority")
    time.sleep(0.5)  # the stop is on its way to the motors
    report = robot.ended()
    assert charges(report["violations"]) == []
    assert report["alive"]
    assert not report["left"]
    assert not report["moving"]
    gateway.end()


# HQ programs


async def test_old_hq_programs_stay_connected_and_drive_again_after_neutral(bench: Bench) -> None:
    tcp, alf, ec = ports(3)
    parts = [listener("tcp", "tcpudp", tcp), listener("alf", "alf", alf), listener("ec", "wc2ec", ec)]
    gateway = Restarted(bench, bench.gateway(device(bench.simulator()), *parts))
    await soon(lambda: gateway.gateway.listens(3), "listeners")
    await soon(lambda: bench.fleet.state() == "established", "established")
    program, vehicle, controller = FragileTcpUdpHq(), FragileAlfHq(), FragileExternalController()

    async def drives() -> None:
        before = bench.fleet.last("r1/pose")
        program.move(0.0, 1.0, 0.5)
        await soon(lambda: abs(bench.fleet.last("r1/pose")["y"] - before["y"]) > 0.1, "motion")
        assert bench.fleet.last("r1/control")["holder"] == "hq.tcp.2"

    async with playing(program.run(HOST, tcp), vehicle.run(HOST, alf), controller.run(HOST, ec)):
        await soon(lambda: program.position and bench.fleet.last("r1/pose"), "position")
        program.mode(2)
        program.idle()
        await drives()
        assert await asyncio.to_thread(gateway.ask) == [{}]
        received = len(program.received)
        await soon(lambda: bench.fleet.refusal(code="neutral_first", who="hq.tcp.2"), "the stick still pushed")
        await soon(lambda: len(program.received) > received + 3, "telemetry for the program")
        still = bench.fleet.last("r1/pose")
        await soon(lambda: bench.fleet.last("r1/pose")["at"] > still["at"] + 0.5, "a pose")
        assert bench.fleet.last("r1/pose")["y"] == pytest.approx(still["y"])
        program.idle()
        await drives()
        assert not any(each.ending for each in (program, vehicle, controller))
        program.idle()
        await vehicle.end()
        gateway.end()
    for each in (program, vehicle, controller):
        assert each.alive
        assert charges(each.violations) == []
    assert not [text for text in program.texts if "gateway serves" in text or "the robot is there" in text]


# Successors that fail


def served(bench: Bench, robot: Robot, *more: str) -> Restarted:
    return Restarted(bench, bench.serve(robot.port, *more))


def refused(gateway: Restarted, robot: Robot, bench: Bench, reason: str) -> None:
    """The restart is refused for this reason, and the gateway continues: it takes commands, and telemetry flows."""
    (answer,) = gateway.ask()
    assert answer["code"] == "not_ready"
    assert re.search(reason, answer["reason"]), answer
    bench.fleet.hold("r1", deadman_s=1.0)
    drive = {"forward": 0.5, "left": 0.0, "turn": 0.0}
    since = time.monotonic()
    until(lambda: bench.fleet.put("r1/@cmd/drive", **drive) or robot.packets(MOVE, since), what="motion")
    assert robot.connections == 1
    assert bench.fleet.state() == "established"
    assert re.search(reason, gateway.gateway.log)


def test_a_successor_that_finds_a_bad_file_leaves_the_gateway_as_it_was(bench: Bench, robot: Robot) -> None:
    gateway = served(bench, robot)
    file = bench.folder / "r1.toml"
    good = file.read_text()
    file.write_text(good + "nonsense = 1\n")
    refused(gateway, robot, bench, "the other side has ended")
    file.write_text(good.replace(str(robot.port), str(free_port())))
    refused(gateway, robot, bench, "device was changed")
    file.write_text(good)
    assert gateway.ask() == [{}]
    gateway.end()


FAKE = """
import os, socket, sys, time
sys.path.insert(0, {root!r})
from zbridge.app.handover import channel as messages
from zbridge.app.handover.channel import HandoverChannel
descriptor = int(sys.argv[sys.argv.index("--take-over") + 1])
channel = HandoverChannel(socket.socket(fileno=descriptor))
how = {how!r}
if how == "silent":
    time.sleep(60)
channel._send(messages.Hello(9 if how == "newer" else messages.VERSION, os.getpid()), None)
given = channel._receive(messages.HandoverState, 30)
if how == "crash":
    os.kill(os.getpid(), 9)
parcel = channel._receive_parcel(given.descriptors, 5)
time.sleep(60)
"""
"""A successor that fails in one way: it stands for a version that is broken."""


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("silent", "sent nothing"),
        ("newer", f"states of version 9, this gateway has {VERSION}"),
        ("crash", "the other side has ended"),
        ("hangs", "sent nothing for 0.5 s"),
    ],
)
def test_a_broken_successor_is_ended_and_the_gateway_goes_on(
    bench: Bench, robot: Robot, monkeypatch: pytest.MonkeyPatch, how: str, reason: str
) -> None:
    broken = bench.folder / "broken.py"
    broken.write_text(FAKE.format(root=str(ROOT), how=how))
    patched = bench.folder / "patched.py"
    patched.write_text(
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from zbridge.app.handover import processes, sequence\n"
        f"sequence.START_S, sequence.TAKE_OVER_S = {1.0 if how == 'silent' else 20.0}, 0.5\n"
        f"processes.COMMAND = [sys.executable, {str(broken)!r}]\n"
        "from zbridge.cli import main\n"
        "main()\n"
    )
    monkeypatch.setenv("ZBRIDGE_TEST_MAIN", str(patched))
    gateway = served(bench, robot)
    refused(gateway, robot, bench, reason)
    assert len(robot.packets(STOP)) > 0 or how in ("silent", "newer")


def test_the_signal_restarts_too_and_the_old_process_ends_with_0(bench: Bench, robot: Robot) -> None:
    gateway = served(bench, robot)
    gateway.gateway.signal(signal.SIGUSR2)
    assert gateway.gateway.process.wait(20) == 0
    assert gateway.pid != gateway.gateway.process.pid
    assert robot.connections == 1
    gateway.end()
    assert robot.connections == 1


def test_the_command_waits_for_the_answer_and_tells_a_refusal(bench: Bench, robot: Robot) -> None:
    gateway = served(bench, robot)
    done = start("restart", "r1", "--connect", bench.endpoint)
    assert done.communicate(timeout=60)[0].strip() == "r1: restarted"
    assert done.returncode == 0
    (bench.folder / "r1.toml").write_text("nonsense\n")
    done = start("restart", "--all", "--connect", bench.endpoint)
    assert "r1: not restarted" in done.communicate(timeout=60)[0]
    assert done.returncode == 1
    gateway.end()
