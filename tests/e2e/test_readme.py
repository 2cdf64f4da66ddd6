"""The README's programs, run as they stand (only the router's address is the test's)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from tests.e2e.conftest import Bench, free_port, until

README = (Path(__file__).parents[2] / "README.md").read_text()


PROGRAMS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def run_program(bench: Bench, program: str) -> list[str]:
    """Run one of the README's programs against a simulated robot; give the lines it printed."""
    port = free_port()
    bench.simulator(port)
    bench.gateway("tcpudp1", port)
    until(lambda: bench.fleet.state("tcpudp1") == "established")
    ran = subprocess.run(
        [sys.executable, "-c", program.replace("tcp/127.0.0.1:7447", bench.endpoint)],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()


def test_the_readmes_client_drives(bench: Bench) -> None:
    first, last = run_program(bench, PROGRAMS[0])
    state, x, *shape = first.split()
    assert state == "established"
    assert " ".join(shape) == "(100, 100)"
    assert abs(float(x)) < 5
    assert len(last.split()) == 3
    poses = bench.fleet.seen["fleet/tcpudp1/pose"]
    assert abs(poses[-1]["y"] - poses[0]["y"]) > 0.3
    assert bench.fleet.last("tcpudp1/control")["state"] == "free"


def test_the_readmes_plain_program_prints_poses_and_drives(bench: Bench) -> None:
    poses = [eval(line) for line in run_program(bench, PROGRAMS[1])]
    assert len(poses) > 10
    assert abs(poses[-1]["y"] - poses[0]["y"]) > 0.3


def test_every_key_of_the_readme_is_known() -> None:
    from zbridge.fleet import topics

    for path in ("pose", "map", "lidar", "camera", "text", "scan", "raw/tcpudp", "status", "control"):
        assert topics.find(path) is not None
        assert path.split("/")[0] in README
