"""``zbridge simulate`` for a protocol of another package: its robot on a serial line, its robot side as a program."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from tests.e2e.conftest import Bench, end, repeated, until

KHEPERA = Path(__file__).parents[2] / "docs" / "examples" / "khepera" / "khepera"


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the example for every process that is started."""
    site = tmp_path / "site"
    about = site / "khepera-1.0.dist-info"
    about.mkdir(parents=True)
    shutil.copytree(KHEPERA, site / "khepera")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: khepera\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[zbridge.protocols]\nkhepera = khepera:PROTOCOL\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH")))))


def simulated(bench: Bench, *where: str) -> tuple[subprocess.Popen[str], str]:
    """Start a simulated Khepera; give its process and address."""
    process = bench.zbridge("simulate", "khepera", *where)
    return process, line(process).removeprefix("listening on ")


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    read = process.stdout.readline()
    assert read, "it has ended"
    return read.rstrip("\n")


def lines_until(process: subprocess.Popen[str], pattern: str) -> list[str]:
    """Give the lines that a process prints, up to the first that matches; few lines come a second."""
    lines = [line(process)]
    while not re.match(pattern, lines[-1]):
        assert len(lines) < 100, lines
        lines.append(line(process))
    return lines


def test_one_gateway_after_the_other_drives_a_simulated_robot_on_a_serial_line(bench: Bench) -> None:
    process, address = simulated(bench, "--serial")
    assert re.fullmatch(r"serial:///dev/pts/\d+\?baud=57600", address)
    device = f'[device]\nprotocol = "khepera"\nconnect = ["{address}"]\n'
    for _ in range(2):
        bench.fleet.seen.clear()
        gateway = bench.gateway(device)
        until(lambda: bench.fleet.state() == "established", what="established")
        assert bench.fleet.last("r1/status")["version"] == "5.1"
        bench.fleet.hold()
        bench.fleet.put("r1/@cmd/drive")
        with repeated(lambda: bench.fleet.put("r1/@cmd/drive", forward=0.4)):
            until(lambda: bench.fleet.last("r1/pose").get("x", 0.0) > 0.05, what="it moves")
        bench.fleet.release()
        until(lambda: bench.fleet.last("r1/motion").get("speed") == 0.0, what="it stands")
        gateway.end()
    assert end(process) == ""
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("where", "number"), [(("--listen", "tcp://127.0.0.1:0"), signal.SIGINT), (("--serial",), signal.SIGTERM)]
)
def test_the_robot_side_drives_a_robot_and_leaves_it_standing(
    bench: Bench, where: tuple[str, ...], number: int
) -> None:
    _, address = simulated(bench, *where)
    driver = bench.zbridge("simulate", "khepera", "--hq", address, "--drive", "0.4")
    lines = lines_until(driver, r"pose x=0\.(0[5-9]|[1-9])")
    assert lines[:2] == [f"connected to {address}", "established, version 5.1"]
    assert lines[2].startswith("pose x=0.00 ")
    assert lines.index("sends neutral") < lines.index("drives: forward 0.4, turn 0")
    rest = end(driver, number).splitlines()
    assert driver.returncode == 0
    assert "stops the robot" in rest
    assert rest[-1].startswith("session ended: this program ends; ")
    assert [each for each in rest if each.startswith("motion ")][-1] == "motion speed=0.00"

    watcher = bench.zbridge("simulate", "khepera", "--hq", address)
    seen = lines_until(watcher, "scan ") + [line(watcher) for _ in range(3)]
    assert end(watcher, number)
    assert watcher.returncode == 0
    assert {each for each in seen if each.startswith("motion ")} == {"motion speed=0.00"}
    assert len({each for each in seen if each.startswith("pose ")}) == 1


def test_a_robot_that_ends_is_an_error_of_the_robot_side(bench: Bench) -> None:
    robot, address = simulated(bench, "--listen", "tcp://127.0.0.1:0")
    watcher = bench.zbridge("simulate", "khepera", "--hq", address)
    lines_until(watcher, "pose ")
    end(robot)
    assert "session ended: " in watcher.communicate(timeout=10.0)[0]
    assert watcher.returncode == 1
