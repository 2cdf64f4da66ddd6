"""Protocols of other packages: one that has no HQ side, the examples of the guide, and one of an earlier release."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from gateways.wc2ec.conformance.fragile_hq import FragileExternalController
from tests.e2e.conftest import HOST, Bench, device, listener
from tests.e2e.measured.hq_judge import LET_GO_S
from tests.e2e.rigs.fragile import charges
from tests.e2e.rigs.hq_scene import playing, ports, soon
from tests.ports import free_port

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
RELEASED = Path(__file__).parents[1] / "vectors" / "author-api-0.2"
"""Khepera as it was when 0.2 was released: what is written against that version keeps passing."""
PACKAGES = {
    **{example: EXAMPLES / example / example for example in ("khepera", "arcos")},
    "toy": Path(__file__).parent / "other_package" / "toyrobot.py",
}


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the packages for every process that is started, as an installer would."""
    install(PACKAGES, tmp_path / "site", monkeypatch)


def install(packages: dict[str, Path], site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, source in packages.items():
        about = site / f"{name}robot-1.0.dist-info"
        about.mkdir(parents=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, site / source.name)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}robot\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[zbridge.protocols]\n{name} = {source.stem}:PROTOCOL\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH")))))


def run(*arguments: str, code: int = 0) -> str:
    ran = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == code, ran.stdout + ran.stderr
    return ran.stdout + ran.stderr


@pytest.mark.long
@pytest.mark.parametrize("package", [EXAMPLES / "khepera", EXAMPLES / "arcos", RELEASED / "khepera"], ids=str)
def test_an_example_passes_its_tests_and_is_driven_by_tcp_and_on_a_serial_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: Path
) -> None:
    install({package.name: package / package.name}, tmp_path / "first", monkeypatch)
    shutil.copytree(package / "tests", tmp_path / "tests")
    shutil.copy(package / "pyproject.toml", tmp_path)
    tests = str(tmp_path / "tests")
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), tests)
    for _ in range(3):  # a busy machine may pause a test for longer than its deadman
        ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        if "NeutralFirst" not in ran.stdout:
            break
    assert ran.returncode == 0, ran.stdout


@pytest.mark.parametrize(
    "protocol", ["khepera", "arcos", "alf", "tcpudp", "wc2ec", pytest.param("ros2", marks=pytest.mark.long)]
)
def test_every_protocol_holds_what_the_conformance_kit_asks(protocol: str) -> None:
    kit = "zbridge.simulation.check" if protocol == "ros2" else "tests.simulation.at_once"  # Zenoh has its own time
    assert " hold, 0 do not, " in run(kit, protocol)


@pytest.mark.long
def test_a_package_of_an_earlier_release_holds_what_the_conformance_kit_asks(tmp_path: Path, monkeypatch) -> None:
    install({"khepera": RELEASED / "khepera" / "khepera"}, tmp_path / "first", monkeypatch)
    assert " hold, 0 do not, " in run("zbridge.simulation.check", "khepera")


@pytest.mark.long
def test_of_a_robot_that_has_no_hq_side_the_demo_says_so_and_a_listener_is_a_clear_error(tmp_path: Path) -> None:
    """A package that cannot be imported, beside it, is one line, of the demo and of the check of its own file only."""
    about = tmp_path / "site" / "torn-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: torn\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[zbridge.protocols]\ntorn = torn:PROTOCOL\n")
    (tmp_path / "site" / "torn.py").write_text("import of_nothing\n")
    why = "torn:PROTOCOL cannot be loaded: ModuleNotFoundError: No module named 'of_nothing' in <module> (torn.py:1)"
    for protocol, code in (("torn", 2), ("alf", 0)):
        file = tmp_path / f"{protocol}.toml"
        file.write_text('[robot]\nname = "r1"\n' + device(free_port(), protocol))
        (line,) = run("zbridge", "check", str(file), code=code).splitlines()
        assert (f"protocol = 'torn': {why}" in line) is bool(code)
    shown = run("zbridge", "demo", "--seconds", "8")
    assert f"zbridge: protocol = 'torn': {why}; the demo continues without it\n" in shown
    assert "  toy1: serves no HQ programs" in shown
    assert "  alf1: zbridge simulate alf --hq tcp://127.0.0.1:" in shown
    row = [line for line in shown.splitlines() if line.startswith("toy1 ")][-1]
    assert "established" in row, row
    file = tmp_path / "r1.toml"
    file.write_text('[robot]\nname = "r1"\n' + listener("hq", "toy", 4001))
    assert "hq[0].protocol = 'toy': serves no HQ programs" in run("zbridge", "run", str(file), code=2)


async def test_programs_of_every_protocol_drive_a_robot_of_a_protocol_that_their_listeners_do_not_know(
    bench: Bench,
) -> None:
    tcp, alf, ec = ports(3)
    parts = [listener("tcp", "tcpudp", tcp), listener("alf", "alf", alf), listener("ec", "wc2ec", ec)]
    process = bench.gateway(*parts, device(bench.simulator("toy"), "toy"), "[control]\nlease_s = 1.2\n")
    program, vehicle, controller = FragileTcpUdpHq(), FragileAlfHq(deployed="driving"), FragileExternalController()
    await soon(lambda: process.listens(3), "listeners")
    await soon(lambda: bench.fleet.state() == "established", "established")

    async def moves(who: str) -> None:
        x = bench.fleet.last("r1/pose")["x"]
        await soon(lambda: bench.fleet.last("r1/pose")["x"] > x + 0.1, f"{who} moves it")
        assert bench.fleet.last("r1/control")["holder"] == who

    async def free() -> None:
        await soon(lambda: bench.fleet.last("r1/control")["state"] == "free", "free")

    async def turn_wheels(velocity: float) -> None:
        for wheel in ("left", "right"):
            await controller.set(wheel, velocity)

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
        await soon(lambda: any("use the joystick" in text for text in program.texts), "told what it cannot do")
        program.idle()
        program.mode(1)
        await free()
        vehicle.drive(255)
        await moves("hq.alf.1")
        vehicle.idle()
        await free()
        await turn_wheels(0.0)
        await turn_wheels(5.0)
        await moves("hq.ec.1")
        await turn_wheels(0.0)
        await free()
    assert "KeyError" not in process.end()
    for one in (program, vehicle, controller):
        assert one.alive
        assert not charges(one.violations)
