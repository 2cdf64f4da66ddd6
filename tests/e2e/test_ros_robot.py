"""A ROS 2 robot in the fleet, end to end: a strict robot over plain Zenoh, real gateways, old HQ programs."""

from __future__ import annotations

import contextlib
import random
import struct
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.e2e.conftest import HOST, Bench, device, listener, until
from tests.e2e.measured.hq_judge import DRIVES, LEASE_S, Alf, Ec, Program, Tcp
from tests.e2e.measured.ros_robot import KEY, WAYS, Scene, measure
from tests.e2e.rigs.fragile import charges
from tests.e2e.rigs.hq_scene import playing, ports, pushed, soon
from tests.gateways.ros2.strict_robot import HASHES, config
from tests.ports import free_port

SCAN_KEY = f"0/scan/sensor_msgs::msg::dds_::LaserScan_/{HASHES['LaserScan']}"


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as opened:
        yield opened


async def test_old_programs_of_every_protocol_see_a_ros_robot_and_drive_it_in_turn(
    tmp_path: Path, stack: contextlib.ExitStack
) -> None:
    ec = Ec()
    programs: list[Program] = [
        *(Tcp("1.1", udp=False), Tcp("1.2", udp=True), Tcp("1.3", udp=True)),
        *(Alf("text"), Alf("binary"), Alf("text", scans=True), ec),
    ]
    at = dict(zip((program.name for program in programs), ports(len(programs)), strict=True))
    parts = [listener(one.name, one.protocol, at[one.name], one.options) for one in programs]
    scene = Scene(tmp_path, stack, *parts, f"[control]\nlease_s = {LEASE_S}\n")
    fleet, robot = scene.bench.fleet, scene.robot
    await soon(lambda: scene.gateway.listens(len(programs)), "listeners")
    async with playing(*(program.judge.run(HOST, at[program.name]) for program in programs)):
        await soon(lambda: all(program.ready for program in programs), "all connected")
        await programs[0].ask()  # type: ignore[attr-defined]
        async with playing(ec.keep_idle()):
            await soon(lambda: all(one.sees("tcpudp" if isinstance(one, Tcp) else "ros2") for one in programs), "seen")
            for program in programs:
                if program.name == "alf-scans":
                    continue
                await soon(lambda: fleet.last("r1/control").get("state") == "free", "given back")
                forward = DRIVES[program.name]
                await pushed(program, forward, partial(scene.moves, forward), f"{program.name} drives")
                holder = f"hq.{program.name}.{program.number}"
                await soon(lambda holder=holder: fleet.last("r1/control")["holder"] == holder, holder)
                await program.idle()
                await soon(lambda: not any(robot.velocity), "at rest")
                await program.release()
            for program in programs:
                await program.leave()
        scene.gateway.end()
    assert robot.violations == []
    for program in programs:
        assert charges(program.judge.violations) == []


@pytest.mark.parametrize("way", WAYS)
def test_a_ros_robot_is_at_rest_after_a_stop_a_loss_and_beside_another_driver(way: str) -> None:
    result = measure(way, repetitions=1)
    assert len(result.took_s) == 1, result.faults
    assert result.clean, result.faults


def test_a_robot_in_a_namespace_that_takes_stamped_twists_on_a_clock_of_its_own(
    tmp_path: Path, stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.e2e.measured.ros_robot.OPTIONS", 'namespace = "/robots/r1"\nspeed_full_mps = 1.0')
    scene = Scene(tmp_path, stack, namespace="/robots/r1", stamped=True)
    robot, fleet, began = scene.robot, scene.bench.fleet, time.monotonic_ns()
    robot.clock_ns = lambda: time.monotonic_ns() - began  # a simulation, begun anew
    until(lambda: fleet.last("r1/scan").get("device_ms", 10**12) < 10**9, what="scans on the new clock")
    scan = fleet.last("r1/scan")
    assert abs(scan["stamp_ns"] - time.time_ns()) < 60e9
    time.sleep(0.2)  # commands from before the change are on their way
    robot.violations.clear()
    with scene.driven():
        until(lambda: len([one for one in robot.commands if one.moves]) > 5, what="repeated commands")
    assert robot.violations == []


def test_strangers_are_counted_and_move_nothing(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    scene = Scene(tmp_path, stack)
    rng = random.Random(1)
    stranger: Any = stack.enter_context(zenoh.open(config(scene.router_at)))
    kinds = f"sensor_msgs::msg::dds_::LaserScan_/{HASHES['Odometry']}/2::,5:,:,:,,"
    lying = f"@ros2_lv/0/{stranger.zid()}/0/%d/MP/%%/%%/liar/%%scan/%s"
    tokens = [stranger.liveliness().declare_token(lying % (number, kinds)) for number in range(30)]
    tokens.append(stranger.liveliness().declare_token("@ros2_lv/0/x/y/z/MP/%/%/liar/%scan/a/b/c"))
    attachments = [None, b"", rng.randbytes(33), struct.pack("<qqB16s", 1, 1, 16, rng.randbytes(16)), bytes(10_000)]
    lossless = zenoh.CongestionControl.BLOCK
    scans = stranger.declare_publisher(SCAN_KEY, congestion_control=lossless)
    commands = stranger.declare_publisher(KEY, congestion_control=lossless)
    for _ in range(2000):
        scans.put(rng.randbytes(rng.randrange(200)), attachment=rng.choice(attachments))
        commands.put(rng.randbytes(52), attachment=rng.choice(attachments[:3]))
    fleet = scene.bench.fleet

    def counted() -> int:
        (table,) = fleet.get("fleet/r1/@rpc/sessions/gateway")
        counters = table["sessions"][0]["counters"]
        return int(counters["malformed"] + counters["dropped"])

    until(lambda: counted() >= 2000, 40.0, what="counted")
    assert fleet.state() == "established"
    with scene.driven():
        pass
    scene.rest_since(time.monotonic())


def test_a_simulated_robot_is_seen_and_driven(bench: Bench) -> None:
    port = free_port()
    bench.simulator("ros2", "--dialect", "stamped", port=port)
    bench.gateway(device(port, "ros2", "speed_full_mps = 1.0"))
    fleet = bench.fleet
    until(lambda: fleet.state() == "established" and not fleet.reason(), 30, "established")
    until(lambda: {"fleet/r1/scan", "fleet/r1/map", "fleet/r1/battery", "fleet/r1/motion"} <= fleet.seen.keys(), 30)
    before = until(lambda: fleet.last("r1/pose"), what="a pose")
    fleet.hold("r1")
    fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: abs(fleet.last("r1/pose")["x"] - before["x"]) > 0.05, what="it moves")
    fleet.put("r1/@cmd/stop")
    until(lambda: fleet.last("r1/motion").get("speed") == 0.0, what="at rest")
