"""Rovers in the fleet, end to end: driven by every kind of program, in crossings, and over each kind of link."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import msgpack

from gateways.mavlink.conformance.machine import AUTO, HOLD, MANUAL
from gateways.mavlink.conformance.rover import RoverQuirks
from gateways.mavlink.simulator import ArduRover
from tests.e2e.conftest import HOST, Bench, Fleet, Gateway, listener, repeated, until
from tests.e2e.measured.hq_judge import DRIVES, LEASE_S, Alf, Ec, Program, Tcp
from tests.e2e.measured.restarts import MOST_GAP_S, Restarted
from tests.e2e.rigs.fragile import ARMS, charges
from tests.e2e.rigs.hq_scene import playing, ports, pushed, soon
from tests.e2e.rigs.ros2_scene import RosScene
from tests.e2e.rigs.ros2_scene import pushed as twisted
from tests.e2e.rigs.rovers import RoverOnThread, ahead_m
from tests.ports import free_port

FORWARD = 0.4
GUID_TIMEOUT_S = 3.0


# Everybody drives


async def test_old_programs_of_every_protocol_and_ros_drive_a_rover_in_turn(tmp_path: Path) -> None:
    ec = Ec()
    programs: list[Program] = [
        *(Tcp("1.1", udp=False), Tcp("1.2", udp=True), Tcp("1.3", udp=True)),
        *(Alf("text"), Alf("binary"), ec),
    ]
    at = dict(zip((program.name for program in programs), ports(len(programs)), strict=True))
    parts = [listener(one.name, one.protocol, at[one.name], one.options) for one in programs]
    with contextlib.ExitStack() as stack:
        scene = RosScene(stack, tmp_path, "[robot.r1]\nspeed_full_mps = 1.0\n")
        rover, fleet = RoverOnThread(stack), Fleet(scene.fleet)
        control = f"[control]\nlease_s = {LEASE_S}\n"
        gateway = Gateway(stack, tmp_path / "r1.toml", scene.fleet_at, rover.device, *parts, control)
        await soon(lambda: gateway.listens(len(programs)), "listeners")
        async with playing(*(program.judge.run(HOST, at[program.name]) for program in programs)):
            await soon(lambda: all(program.ready for program in programs), "all connected")
            await soon(lambda: fleet.last("r1/pose") and fleet.last("r1/scan"), "a pose and a scan")
            async with playing(ec.keep_idle()):
                for program in programs:
                    await drive(program, rover, fleet)
                await asyncio.to_thread(drive_by_ros, scene, rover, fleet)
            for program in programs:
                await program.leave()
        gateway.end()
    assert charges(rover.judge.violations) == []
    for program in programs:
        assert charges(program.judge.violations) == []


async def drive(program: Program, rover: RoverOnThread, fleet: Fleet) -> None:
    """Drive a while; the rover's own pose must show it."""
    forward, before = DRIVES[program.name], fleet.last("r1/pose")

    def moves() -> bool:
        return rover.drives(forward) and ahead_m(before, fleet.last("r1/pose")) * forward > 0.01

    await soon(lambda: fleet.last("r1/control").get("state") == "free", "given back")
    await pushed(program, forward, moves, f"{program.name} drives")
    assert fleet.last("r1/control")["holder"] == f"hq.{program.name}.{program.number}"
    await program.idle()
    await soon(lambda: not rover.judge.moving, "at rest")
    await program.release()


def drive_by_ros(scene: RosScene, rover: RoverOnThread, fleet: Fleet) -> None:
    until(lambda: fleet.last("r1/control").get("state") == "free", what="given back")
    before = fleet.last("r1/pose")
    with scene.publishing("r1") as publisher:
        with twisted(publisher, FORWARD, partial(rover.drives, FORWARD)):
            until(lambda: ahead_m(before, fleet.last("r1/pose")) > 0.01, what="it moves")
            assert fleet.last("r1/control")["holder"] == "ros2.teleop"
        until(lambda: not rover.judge.moving, what="at rest after the last Twist")


# Links


@contextlib.contextmanager
def speaking(port: int) -> Iterator[ArduRover]:
    """Have a rover that speaks first by datagrams, to a port."""
    rover, ended = ArduRover(), threading.Event()

    def live() -> None:
        with socket.socket(type=socket.SOCK_DGRAM) as link:
            link.setblocking(False)
            link.connect((HOST, port))
            while not ended.wait(0.02):
                with contextlib.suppress(OSError):  # nobody is there yet; nothing came
                    link.send(rover.step(0.02))
                    link.send(rover.receive(link.recv(65_536)))

    thread = threading.Thread(target=live)
    thread.start()
    try:
        yield rover
    finally:
        ended.set()
        thread.join()


def test_a_rover_is_driven_by_datagrams_whoever_speaks_first_and_by_a_serial_line(bench: Bench) -> None:
    fleet, port, at = bench.fleet, free_port(), dict[str, str]()
    for robot, where in (("udp", ("--listen", f"udp://{HOST}:{free_port()}")), ("serial", ("--serial",))):
        process = bench.zbridge("simulate", "mavlink", *where)
        assert process.stdout is not None
        at[robot] = process.stdout.readline().split()[-1]
    at["udp-in"] = f"udp-in://{HOST}:{port}"
    assert [address.partition(":")[0] for address in at.values()] == ["udp", "serial", "udp-in"]
    with speaking(port):
        for robot, address in at.items():
            table = f'[device]\nprotocol = "mavlink"\nconnect = ["{address}"]\n[device.options]\n{ARMS}'
            bench.gateway(table, robot=robot)
        for robot in at:
            until(lambda: fleet.state(robot) == "established", what=f"{robot} established")  # noqa: B023
            until(lambda: fleet.last(f"{robot}/pose"), what=f"a pose of {robot}")  # noqa: B023
            fleet.hold(robot)
        before = {robot: fleet.last(f"{robot}/pose") for robot in at}
        for robot in at:
            with repeated(lambda: fleet.put(f"{robot}/@cmd/drive", forward=FORWARD)):  # noqa: B023
                until(lambda: ahead_m(before[robot], fleet.last(f"{robot}/pose")) > 0.05, what=robot)  # noqa: B023
            fleet.put(f"{robot}/@cmd/stop")
            until(lambda: fleet.last(f"{robot}/motion").get("speed") == 0.0, what=f"{robot} at rest")  # noqa: B023


# Crossings


class Crossed:
    """One rover, its gateway, and who drives it, on the bus of all."""

    def __init__(self, bench: Bench, name: str, rover: RoverOnThread) -> None:
        self.bench, self.name, self.rover, self.fleet = bench, name, rover, bench.fleet
        self.gateway = bench.gateway(rover.device, robot=name)
        self.established()
        until(lambda: self.fleet.last(f"{name}/pose"), what="a pose")

    def established(self) -> None:
        until(lambda: self.fleet.state(self.name) == "established", what=f"{self.name} established")

    def push(self) -> None:
        self.fleet.put(f"{self.name}/@cmd/drive", forward=FORWARD)

    @contextlib.contextmanager
    def driven(self) -> Iterator[None]:
        """Drive from when it moves until the block ends; centre first, as people do."""
        self.fleet.hold(self.name, deadman_s=1.0)
        self.fleet.put(f"{self.name}/@cmd/drive")
        with repeated(self.push):
            until(partial(self.rover.drives, FORWARD), what=f"{self.name} drives")
            yield
        with contextlib.suppress(AssertionError):  # a restart ends a lease
            self.fleet.release(self.name)

    def rests(self) -> None:
        until(lambda: not self.rover.judge.moving, what=f"{self.name} at rest")

    def stays(self, mode: int, seconds: float) -> None:
        """Wait a while; the rover keeps its mode."""
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            assert self.rover.machine.mode == mode
            time.sleep(0.02)


def pilot(bench: Bench, stack: contextlib.ExitStack) -> RoverOnThread:
    """An RC pilot takes it, then its mission; both are left alone. Only who orders a stop stops it, and for good."""
    scene = Crossed(bench, "pilot", rover := RoverOnThread(stack, RoverQuirks(hold_at=2, foreign=True)))
    fleet, judge = scene.fleet, rover.judge
    with scene.driven():
        judge.pilot_drives(MANUAL)
        refusal = until(lambda: fleet.refusal("pilot", command="drive", code="not_ready"), what="the refusal")
        assert "mode MANUAL" in refusal["reason"]
        scene.stays(MANUAL, 0.7)
    judge.pilot_drives(AUTO)
    scene.stays(AUTO, 2.5)  # two idle stops
    assert judge.moving
    judge.expect_stop()
    stop = msgpack.packb({"latch": True, "id": bytes(16), "who": "ann", "reason": "a child"})
    fleet.session.put("fleet/pilot/@cmd/stop", stop)
    scene.rests()
    assert rover.machine.mode == HOLD
    until(lambda: fleet.last("pilot/control").get("state") == "latched", what="latched")
    assert "HOLD" not in fleet.reason("pilot")
    scene.gateway.end()  # a latch is repeated each second, whatever the mode
    return rover


def silence(bench: Bench, stack: contextlib.ExitStack) -> RoverOnThread:
    """Its HEARTBEAT is lost and nothing else; its link stalls; it is cut: each time it rests, and is driven again."""
    scene = Crossed(bench, "silence", rover := RoverOnThread(stack))
    with scene.driven():
        rover.machine.heartbeats, since = False, time.monotonic()
        until(lambda: scene.fleet.state("silence") != "established", what="the loss")
        assert 1.8 < time.monotonic() - since < 3.0 + 1.5
    scene.rests()
    assert rover.machine.mode == HOLD, "the last words were a stop"
    rover.machine.heartbeats = True
    scene.established()
    with scene.driven():
        rover.judge.stall(1.0)
        scene.fleet.put("silence/@cmd/stop")
        scene.rests()
    with scene.driven():
        rover.judge.cut()
        until(lambda: scene.fleet.state("silence") != "established", what="the cut")
    scene.established()
    scene.rests()
    scene.gateway.end()
    return rover


def frozen(bench: Bench, stack: contextlib.ExitStack) -> RoverOnThread:
    """Its gateway is frozen, and sends no HEARTBEAT; the rover stops by itself, and rests when the gateway is back."""
    scene = Crossed(bench, "frozen", rover := RoverOnThread(stack, heartbeat_s=6.0, motion_s=6.0))
    with scene.driven():
        scene.gateway.signal(signal.SIGSTOP)
        at = time.monotonic()
        scene.rests()
        assert GUID_TIMEOUT_S - 0.5 < time.monotonic() - at < GUID_TIMEOUT_S + 1.5
        assert [each for each in rover.sent("HEARTBEAT") if each > at + 0.3] == []
        scene.gateway.signal(signal.SIGCONT)
        ends = time.monotonic() + 1.0
        while time.monotonic() < ends:
            assert rover.forward == 0.0
            time.sleep(0.02)
    with scene.driven():
        pass
    scene.fleet.put("frozen/@cmd/stop")
    scene.rests()
    assert rover.connections == 0
    scene.gateway.end()
    return rover


def restarted(bench: Bench, stack: contextlib.ExitStack) -> RoverOnThread:
    """Its gateway is restarted: the rover sees one connection whose numbers go on, is stopped, and is driven again."""
    scene = Crossed(bench, "restarted", rover := RoverOnThread(stack, motion_s=MOST_GAP_S))
    gateway = Restarted(bench, scene.gateway)
    with scene.driven():
        assert gateway.ask("restarted") == [{}], gateway.gateway.log
        scene.rests()
    scene.established()
    with scene.driven():
        pass
    gateway.end()
    scene.rests()
    assert rover.connections == 1
    return rover


STORIES: tuple[Callable[[Bench, contextlib.ExitStack], RoverOnThread], ...] = (pilot, silence, frozen, restarted)


def test_rovers_rest_and_are_left_to_others_whatever_happens_to_them_their_links_and_their_gateways(
    bench: Bench,
) -> None:
    with ThreadPoolExecutor(len(STORIES)) as pool:  # they mostly wait
        told = {story.__name__: pool.submit(story, bench, bench.stack) for story in STORIES}
    for name, rover in told.items():
        assert charges(rover.result().judge.violations) == [], name
