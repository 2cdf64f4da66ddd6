"""The programs of README and ``docs/keys.md``, run as they stand (only the router's address is the test's)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from tests.e2e.conftest import Bench, free_port, until

ROOT = Path(__file__).parents[2]


def run_program(bench: Bench, page: str) -> list[str]:
    """Run a page's one Python program against a simulated robot; give the lines that the program printed."""
    (program,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
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
    first, last = run_program(bench, "README.md")
    state, x, *shape = first.split()
    assert state == "established"
    assert " ".join(shape) == "(100, 100)"
    assert abs(float(x)) < 5
    assert len(last.split()) == 3
    poses = bench.fleet.seen["fleet/tcpudp1/pose"]
    assert abs(poses[-1]["y"] - poses[0]["y"]) > 0.3
    assert bench.fleet.last("tcpudp1/control")["state"] == "free"


def test_the_plain_program_of_the_keys_page_prints_poses_and_drives(bench: Bench) -> None:
    poses = [eval(line) for line in run_program(bench, "docs/keys.md")]
    assert len(poses) > 10
    assert abs(poses[-1]["y"] - poses[0]["y"]) > 0.3
