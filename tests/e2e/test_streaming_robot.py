"""A robot that reports by itself, needs a pulse, and has motors that are on with the lease, meets what else goes wrong.

The robot is the ARCOS example's, in this process: what it was sent and how it really moves are known.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

import zbridge
from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from tests.e2e.conftest import HOST, Bench, device, end, listener, repeated, start, until
from tests.e2e.measured.hq_judge import LET_GO_S
from tests.e2e.rigs.hq_scene import PUSHES, playing, ports, soon
from tests.e2e.rigs.processes import Part, module
from tests.e2e.rigs.streaming_robot import FORWARD, Do, StreamingRobot
from tests.e2e.rigs.supervised import Supervised
from tests.e2e.test_other_package import EXAMPLES, install
from tests.machine import contended_s
from zbridge.client import Driver
from zbridge.errors import NeutralFirst, Refused

ON, OFF = 1, 0
WATCHDOG_S = 2.0
OPENED = 2
"""Packets of a connection that is opened once: SYNC1 has the number of OPEN."""
SILENT, LOST = "nothing came for 0.5 s", "nothing came for 3 s"
REPORT_M = 0.15
"""More than the robot moves between two poses, also where it was mute until it stopped."""


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install({"arcos": EXAMPLES / "arcos" / "arcos"}, tmp_path / "site", monkeypatch)


@pytest.fixture
def pioneer() -> Iterator[StreamingRobot]:
    with contextlib.closing(StreamingRobot()) as robot:
        yield robot


class Program:
    """A program of the Python client that heeds no refusal: its stick is deflected until it is centred."""

    def __init__(self, drive: Driver) -> None:
        self.refusals: list[Refused] = []
        self.centred = False
        self._drive = drive

    async def run(self) -> None:
        while True:
            try:
                await (self._drive.neutral() if self.centred else self._drive(forward=FORWARD))
            except Refused as refusal:
                self.refusals.append(refusal)
            await asyncio.sleep(0.05)

    async def recovers(self, pioneer: StreamingRobot) -> None:
        """Check that the deflected stick moves nothing, and drive again after neutral."""
        await soon(lambda: self.refusals and isinstance(self.refusals[-1], NeutralFirst), "neutral is needed")
        await asyncio.sleep(0.5)
        assert not pioneer.moving
        before = pioneer.truth().x
        for _ in range(PUSHES):  # a busy machine may pause the gateway once more
            self.centred = True
            await asyncio.sleep(0.5)
            self.centred = False
            with contextlib.suppress(AssertionError):
                await soon(lambda: pioneer.truth().x > before + 0.05, "it drives again", 3.0)
                return
        raise AssertionError(f"it does not drive again: {self.refusals[-1]}")


@contextlib.asynccontextmanager
async def driven(bench: Bench, pioneer: StreamingRobot) -> AsyncIterator[Program]:
    """Drive the robot by a program until the block ends."""
    await soon(lambda: bench.fleet.state() == "established", "established")
    x = pioneer.truth().x
    async with zbridge.connect([bench.endpoint]) as fleet, fleet["r1"].control("ann") as drive:
        program = Program(drive)
        async with playing(program.run()):
            await soon(lambda: pioneer.truth().x > x + 0.05, "it drives")
            yield program
            assert pioneer.motors or drive.loss


def no_jump(bench: Bench, pioneer: StreamingRobot) -> None:
    """Check that the pose on the bus went on evenly, and is where the robot is."""
    xs = [pose["x"] for pose in bench.fleet.seen["fleet/r1/pose"]]
    assert max(abs(later - earlier) for earlier, later in itertools.pairwise(xs)) < REPORT_M, xs
    assert abs(xs[-1] - pioneer.truth().x) < REPORT_M


def stopped_then_off(pioneer: StreamingRobot, since: float) -> bool:
    """Return whether the motors were switched off since then; check that the stop went first, and nothing moved it."""
    numbers = [(packet.number, packet.value) for packet in pioneer.since(since)]
    if (Do.ENABLE, OFF) not in numbers:
        return False
    off = numbers.index((Do.ENABLE, OFF))
    assert (Do.VEL, 0) in numbers[:off], numbers
    assert (Do.RVEL, 0) in numbers[:off], numbers
    assert not any(packet.moves for packet in pioneer.since(since)[off:])
    return not pioneer.motors and not pioneer.moving


# Silence


@pytest.mark.long
async def test_a_silent_robot_is_stopped_needs_neutral_and_is_found_again_where_it_was_after_longer(
    bench: Bench, pioneer: StreamingRobot
) -> None:
    gateway = bench.gateway(device(pioneer.port, "arcos"))
    async with driven(bench, pioneer) as program:
        muted, pioneer.mute = time.monotonic(), True
        await soon(lambda: bench.fleet.reason() == SILENT, "the silence is shown", 2.0)
        await soon(lambda: not pioneer.moving, "it is stopped", 0.5)
        assert bench.fleet.last("r1/status")["commands"] == []
        await soon(lambda: any(SILENT in str(each) for each in program.refusals), "drives are refused")
        await soon(lambda: sum(packet.stops for packet in pioneer.since(muted)) > 1, "stops again and again")
        pioneer.mute = False
        await soon(lambda: bench.fleet.reason() == "", "it is heard")
        await program.recovers(pioneer)
        assert pioneer.clients == 1

        pioneer.mute = True
        await soon(lambda: LOST in bench.fleet.reason(), "it is lost")
        assert not pioneer.moving
        await soon(lambda: pioneer.clients > 1, "another connection")
        pulses = time.monotonic()
        pioneer.mute = False
        await soon(lambda: bench.fleet.state() == "established", "it is found again")
        await soon(lambda: pioneer.motors, "the motors are on, for the driver is still there")
        await program.recovers(pioneer)
        assert pioneer.count(Do.PULSE, pulses) > 0
        no_jump(bench, pioneer)
    gateway.end()


@pytest.mark.long
async def test_a_gateway_that_was_paused_blames_no_silence_on_the_robot_and_stops_it_before_anything_else(
    bench: Bench, pioneer: StreamingRobot
) -> None:
    gateway = bench.gateway(device(pioneer.port, "arcos"))

    async def pause(seconds: float) -> float:
        gateway.signal(signal.SIGSTOP)
        await asyncio.sleep(seconds)
        resumed = time.monotonic()
        gateway.signal(signal.SIGCONT)
        await soon(lambda: any(packet.number == Do.VEL for packet in pioneer.since(resumed)), "the stop")
        first = next(packet for packet in pioneer.since(resumed) if packet.number == Do.VEL)
        assert first.stops, "motion before the stop"
        await soon(lambda: pioneer.count(Do.PULSE, resumed) > 2, "the pulse again")
        return resumed

    async with driven(bench, pioneer) as program:
        resumed = await pause(1.5)
        await program.recovers(pioneer)
        assert pioneer.switched(resumed) == []
        resumed = await pause(3.5)  # longer than silence would be tolerated, and than its lease
        await soon(lambda: stopped_then_off(pioneer, resumed), "the motors are off")
    async with driven(bench, pioneer):
        assert pioneer.switched(resumed) == [OFF, ON]
    shown = {status.get("reason") or "" for status in bench.fleet.seen["fleet/r1/status"]}
    assert not any("nothing came" in reason for reason in shown), shown
    assert (pioneer.clients, pioneer.count(Do.OPEN)) == (1, OPENED)
    no_jump(bench, pioneer)
    assert "nothing came" not in gateway.end()


# The lease


def test_the_motors_are_on_with_the_lease_and_off_after_the_stop_however_it_ends(
    bench: Bench, pioneer: StreamingRobot
) -> None:
    gateway = bench.gateway(device(pioneer.port, "arcos"))
    until(lambda: bench.fleet.state() == "established", what="established")
    until(lambda: OFF in pioneer.switched(), what="the motors are off before anybody drives")

    def ends(how: str, since: float) -> None:
        until(lambda: stopped_then_off(pioneer, since), what=f"{how}: the motors are off")
        until(lambda: bench.fleet.last("r1/control").get("state") != "held", what="free")

    def begins(since: float) -> None:
        until(lambda: pioneer.moving, what="it moves")
        packets = [packet for packet in pioneer.since(since) if packet.number == Do.ENABLE or packet.moves]
        assert (packets[0].number, packets[0].value) == (Do.ENABLE, ON), packets[:3]
        assert pioneer.switched(since) == [ON]

    def drive() -> None:
        bench.fleet.put("r1/@cmd/drive", forward=FORWARD)

    for how in ("released", "expired", "latched", "unlatched"):
        since = time.monotonic()
        bench.fleet.hold(deadman_s=2.0, **({"lease_s": 1.0} if how == "expired" else {}))
        with repeated(drive):
            begins(since)
            since = time.monotonic()
            if how == "latched":
                said = end(start("stop", "r1", "--latch", "--connect", bench.endpoint), 0, 20.0)
                assert said.startswith("r1: latched"), said
                ends(how, since)
        if how == "expired":
            bench.fleet.close()
        elif how != "latched":
            bench.fleet.release()
        ends(how, since)
        if how == "latched":
            said = end(start("unlatch", "r1", "--connect", bench.endpoint), 0, 20.0)
            assert pioneer.switched(since) == [OFF], said

    since = time.monotonic()
    program = Part(bench.stack, *module("tests.e2e.rigs.streaming_robot", bench.endpoint))
    assert program.line() == "drives"
    begins(since)
    since = time.monotonic()
    program.kill()
    ends("killed", since)
    gateway.end()


async def test_old_hq_programs_of_other_protocols_switch_the_motors_by_moving_and_by_leaving(
    bench: Bench, pioneer: StreamingRobot
) -> None:
    tcp, alf = ports(2)
    parts = [listener("tcp", "tcpudp", tcp), listener("alf", "alf", alf), "[control]\nlease_s = 1.2\n"]
    gateway = bench.gateway(*parts, device(pioneer.port, "arcos"))
    program, vehicle = FragileTcpUdpHq(), FragileAlfHq(deployed="driving")
    await soon(lambda: gateway.listens(2), "listeners")
    await soon(lambda: bench.fleet.state() == "established", "established")

    async def moves(who: str, since: float) -> None:
        x = pioneer.truth().x
        await soon(lambda: pioneer.truth().x > x + 0.1, f"{who} moves it")
        assert bench.fleet.last("r1/control")["holder"] == who
        first = next(packet for packet in pioneer.since(since) if packet.number == Do.ENABLE or packet.moves)
        assert (first.number, first.value) == (Do.ENABLE, ON)

    async with playing(vehicle.run(HOST, alf)):
        since = time.monotonic()
        async with playing(program.run(HOST, tcp)):
            await soon(lambda: program.position, "a position")
            program.idle()
            program.mode(2)
            await asyncio.sleep(LET_GO_S)
            assert ON not in pioneer.switched(since), "nobody moves yet"
            program.move(0.0, 1.0)
            await moves("hq.tcp.2", since)
            since = time.monotonic()
        await soon(lambda: stopped_then_off(pioneer, since), "its connection is closed: the motors are off")
        await soon(lambda: bench.fleet.last("r1/control")["state"] == "free", "free")
        since = time.monotonic()
        vehicle.drive(255)
        await moves("hq.alf.1", since)
        since = time.monotonic()
        vehicle.idle()
        await vehicle.end()
        await soon(lambda: stopped_then_off(pioneer, since), "it has left: the motors are off")
    gateway.end()


# Another process


class Host:
    """A supervisor of the robot's gateway."""

    def __init__(self, bench: Bench, pioneer: StreamingRobot) -> None:
        folder = bench.folder / "robots"
        folder.mkdir()
        bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
        (folder / "r1.toml").write_text(f'[robot]\nname = "r1"\n{device(pioneer.port, "arcos")}{bus}')
        self._bench, self._pioneer = bench, pioneer
        self.supervisor = Supervised(bench.stack, folder)
        until(lambda: bench.fleet.state() == "established", 20, "established")
        self.pid = self.supervisor.gateway("r1")

    @contextlib.contextmanager
    def driving(self) -> Iterator[None]:
        """Drive the robot with a new lease until the block ends."""
        since, x = time.monotonic(), self._pioneer.truth().x
        self._bench.fleet.hold(deadman_s=2.0)
        with repeated(lambda: self._bench.fleet.put("r1/@cmd/drive", forward=FORWARD)):
            until(lambda: self._pioneer.truth().x > x + 0.1, what="it drives")
            assert self._pioneer.switched(since)[-1] == ON  # an off may come before it, with the establishment
            yield

    def signal(self, number: int) -> None:
        """Signal the gateway while it reads nothing."""
        until(lambda: self._pioneer.between_reports, what="a moment between two reports")
        os.kill(self.pid, number)

    def replaced(self) -> None:
        """Wait for the process that takes the gateway's place."""
        self.pid = self.supervisor.gateway("r1", not_pid=self.pid)

    def end(self) -> None:
        """End all; an exit that is not clean is an error."""
        self.supervisor.process.send_signal(signal.SIGTERM)
        self._bench.ended_within(self.supervisor.process, 10.0)
        assert "Traceback" not in self.supervisor.log, self.supervisor.log


@pytest.mark.long
def test_a_driven_robot_whose_gateway_is_restarted_killed_or_frozen_stands_and_keeps_its_connection_and_its_pulse(
    bench: Bench, pioneer: StreamingRobot
) -> None:
    host = Host(bench, pioneer)
    opened, contended = time.monotonic(), contended_s()
    for number in (signal.SIGUSR2, signal.SIGKILL, signal.SIGSTOP):
        with host.driving():
            since = time.monotonic()
            host.signal(number)
            until(lambda: not pioneer.moving, 1.5, "it stands")
            host.replaced()
            until(lambda since=since: stopped_then_off(pioneer, since), 20, "the motors are off")  # type: ignore[misc]
            time.sleep(0.5)
            assert not pioneer.moving, "a stick still deflected"
    with host.driving():
        pause_s = pioneer.longest_pause_s(Do.PULSE, opened)
    assert pause_s < WATCHDOG_S + contended_s() - contended
    assert (pioneer.clients, pioneer.count(Do.OPEN)) == (1, OPENED), "one connection, opened once"
    no_jump(bench, pioneer)
    host.end()
    assert host.supervisor.log.count("continues with its connections") == 2
    assert not pioneer.moving


def test_a_robot_that_is_silent_during_a_restart_is_not_driven_by_the_next_process_and_lost_in_time(
    bench: Bench, pioneer: StreamingRobot
) -> None:
    host = Host(bench, pioneer)
    with host.driving():
        pioneer.mute = True
        until(lambda: bench.fleet.reason() == SILENT, what="the silence is shown")
        host.signal(signal.SIGUSR2)
        host.replaced()
        until(lambda: "serves it now" in host.supervisor.log, 20, "the next process")
        assert (pioneer.clients, pioneer.count(Do.OPEN)) == (1, OPENED)
        until(lambda: LOST in host.supervisor.log, what="it is lost, to a process that never heard it")
        assert not pioneer.moving
    pioneer.mute = False
    until(lambda: bench.fleet.state() == "established" and pioneer.clients == 2, 20, "found again")
    with host.driving():
        no_jump(bench, pioneer)
    host.end()
    assert not pioneer.moving


@pytest.mark.parametrize("moving", [True, False])
def test_the_motors_are_off_when_the_gateway_has_ended(bench: Bench, pioneer: StreamingRobot, moving: bool) -> None:
    gateway = bench.gateway(device(pioneer.port, "arcos"))
    until(lambda: bench.fleet.state() == "established", what="established")
    bench.fleet.hold(deadman_s=2.0)
    if moving:
        bench.fleet.put("r1/@cmd/drive", forward=FORWARD)
        until(lambda: pioneer.moving, what="it moves")
    until(lambda: pioneer.motors, what="motors on")
    end(gateway.process)
    until(lambda: not pioneer.motors, what="motors off")
