"""A real gateway whose audit log cannot be written: it serves its robot, says so, and ends in its usual time."""

from __future__ import annotations

import os
import re
import time
import urllib.request
from pathlib import Path

import pytest

from tests.e2e.conftest import WAIT_S, Bench, end, free_port, until

END_S = 4.0
"""Longest time a gateway takes to end on a busy machine; it was killed after 5."""


def pipe(path: Path) -> None:
    os.mkfifo(path)


def full(path: Path) -> None:
    path.symlink_to("/dev/full")


@pytest.mark.parametrize(
    ("make", "why"), [(full, "No space left on device"), (pipe, "No such device or address")], ids=["full", "pipe"]
)
def test_a_gateway_that_cannot_write_its_audit_log_says_so_once_serves_the_robot_and_ends(
    bench: Bench, tmp_path: Path, make: object, why: str
) -> None:
    port, metrics, file = free_port(), free_port(), tmp_path / "r1.jsonl"
    assert callable(make)
    make(file)
    bench.simulator(port)
    more = f'[control]\naudit = "{file}"\n[metrics]\nlisten = "127.0.0.1:{metrics}"\n'
    gateway = bench.serve("r1", port, more)
    for _ in range(3):
        bench.fleet.hold("r1", "driver", how="takeover")
    reason = f"the audit log is not written: {why}"
    until(lambda: bench.fleet.last("r1/status").get("reason") == reason, what="status that says so")
    assert bench.fleet.state("r1") == "established"
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=WAIT_S) as page:
        (failed,) = re.findall(r"^zbridge_audit_failed_total (\d+)$", page.read().decode(), re.MULTILINE)
    assert int(failed) >= 1
    began = time.monotonic()
    output = end(gateway)
    assert time.monotonic() - began < END_S
    assert gateway.returncode == 0
    assert "Traceback" not in output
    assert output.count("ERROR") == 1
    assert f"{reason} ({file})" in output
