"""The programs of README and ``keys.md``, run as they stand (only the router's address is the test's)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from tests.e2e.conftest import Bench, until

ROOT = Path(__file__).parents[2]


def run_program(bench: Bench, page: str) -> list[str]:
    """Run a page's one Python program against a simulated robot, which must drive; give the lines it printed."""
    (program,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    bench.serve(bench.simulator(), robot="tcpudp1")
    program = program.replace("tcp/127.0.0.1:7447", bench.endpoint)
    for _ in range(3):  # a busy machine may pause it for longer than its deadman
        ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
        if "NeutralFirst" not in ran.stderr:
            break
    assert ran.returncode == 0, ran.stderr
    poses = bench.fleet.seen["fleet/tcpudp1/pose"]
    assert abs(poses[-1]["y"] - poses[0]["y"]) > 0.3
    until(lambda: bench.fleet.last("tcpudp1/control")["state"] == "free", what="a robot that was given back")
    return ran.stdout.splitlines()


def test_the_readmes_client_drives(bench: Bench) -> None:
    first, last = run_program(bench, "README.md")
    state, x, *shape = first.split()
    assert (state, " ".join(shape)) == ("established", "(100, 100)")
    assert abs(float(x)) < 5
    assert len(last.split()) == 3


def test_the_plain_program_of_the_keys_page_prints_poses_and_drives(bench: Bench) -> None:
    assert len([eval(line) for line in run_program(bench, "docs/reference/keys.md")]) > 10
