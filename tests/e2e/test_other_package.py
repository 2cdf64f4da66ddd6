"""A protocol of another package that has no HQ side: the demo shows it, and listeners of others serve its robot."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateways.alf.conformance.fragile_hq import FragileHq as AlfHq
from gateways.tcpudp.conformance.fragile_hq import FragileHq as TcpHq
from gateways.wc2ec.conformance.fragile_hq import FragileController
from tests.e2e.conftest import Bench, start
from tests.e2e.hq_judge import LET_GO_S
from tests.e2e.hq_scene import HOST, device, gateway, listener, playing, ports, soon

PACKAGE = Path(__file__).parent / "other_package"
NAMES = "[zbridge.protocols]\ntoy = toyrobot:PROTOCOL\n"


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the package for every process that is started, as an installer would."""
    site = tmp_path / "site"
    about = site / "toyrobot-1.0.dist-info"
    about.mkdir(parents=True)
    shutil.copy(PACKAGE / "toyrobot.py", site)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: toyrobot\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(NAMES)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH")))))


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as started:
        yield started


def test_the_demo_shows_a_robot_that_has_no_hq_side_and_says_so() -> None:
    demo = start("demo", "--seconds", "8")
    shown = end_of(demo)
    assert demo.returncode == 0, shown
    assert "  toy1: serves no HQ programs" in shown
    assert "  alf1: zbridge simulate alf --hq tcp://127.0.0.1:" in shown
    (row,) = [line for line in shown.splitlines() if "toy1" in line and "│" in line][-1:]
    assert "established" in row, row


def end_of(process: subprocess.Popen[str]) -> str:
    """Wait until a process ends by itself; give what it printed."""
    out, _ = process.communicate(timeout=60)
    return out


def test_a_listener_of_a_protocol_without_an_hq_side_is_a_clear_error(tmp_path: Path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text('[robot]\nname = "r1"\n' + listener("hq", "toy", 4001))
    process = start("run", str(file))
    assert "hq[0].protocol = 'toy': serves no HQ programs" in end_of(process)
    assert process.returncode == 2


async def test_programs_of_every_protocol_drive_a_robot_of_a_protocol_that_their_listeners_do_not_know(
    bench: Bench, stack: contextlib.ExitStack
) -> None:
    robot, tcp, alf, ec = ports(4)
    bench.simulator(robot, "toy")
    parts = [listener("tcp", "tcpudp", tcp), listener("alf", "alf", alf), listener("ec", "wc2ec", ec)]
    process = gateway(bench, stack, *parts, device("toy", robot), lease_s=1.2)
    program, vehicle, controller = TcpHq(), AlfHq(deployed="driving"), FragileController()
    await soon(lambda: process.listens(3), "listeners")
    await soon(lambda: bench.fleet.state("r1") == "established", "established")

    async def moves(who: str) -> None:
        x = bench.fleet.last("r1/pose")["x"]
        await soon(lambda: bench.fleet.last("r1/pose")["x"] > x + 0.1, f"{who} moves it")
        assert bench.fleet.last("r1/control")["holder"] == who

    async def free() -> None:
        await soon(lambda: bench.fleet.last("r1/control")["state"] == "free", "free")

    async with playing(program.run(HOST, tcp), vehicle.run(HOST, alf), controller.run(HOST, ec)):
        await soon(lambda: program.position, "a position")
        program.idle()
        program.mode(2)
        await asyncio.sleep(LET_GO_S)
        program.move(0.0, 1.0)
        await moves("hq.tcp.2")
        for ask in (program.ask_map, program.ask_position, lambda: program.lidar(on=True), lambda: program.say("hi")):
            ask()
        program.mode(3)
        await soon(lambda: any("only by the stick" in text for text in program.texts), "told what it cannot do")
        program.idle()
        program.mode(1)
        await free()
        vehicle.drive(255)
        await moves("hq.alf.1")
        vehicle.idle()
        await free()
        for velocity in (0.0, 5.0):
            for wheel in ("left", "right"):
                await controller.set(wheel, velocity)
        await moves("hq.ec.1")
        for wheel in ("left", "right"):
            await controller.set(wheel, 0.0)
        await free()
    process.end()
    assert "KeyError" not in process.log
    assert not [
        text for text in (*program.violations, *vehicle.violations, *controller.violations) if "(this" not in text
    ]
    assert program.alive
    assert vehicle.alive
    assert controller.alive
