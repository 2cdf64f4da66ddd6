"""A robot that stalled, or whose link was cut, while it was driven: it is at rest soon after it continues."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.e2e.measured.stalls import LIMIT_S, Case, measure
from tests.e2e.rigs.processes import NotHereError, apart, module

STALLED = ("alf", "mavlink", "tcpudp-1.3", "wc2ec")


def test_robots_that_stall_while_they_are_driven_are_at_rest_after_it() -> None:
    outcomes = measure([Case(robot, "stall", 2.5) for robot in STALLED], repetitions=1)
    assert sorted(outcome.case.robot for outcome in outcomes) == sorted(STALLED)
    for outcome in outcomes:
        assert outcome.good, outcome


def test_a_robot_whose_link_was_cut_while_it_was_driven_is_at_rest_after_it(tmp_path: Path) -> None:
    try:
        apart()
    except NotHereError as error:
        pytest.skip(f"no network namespace for the robot: {error}")
    out = tmp_path / "cut.jsonl"
    wishes = ["--robots", "tcpudp-1.3", "--stalls", "", "--cuts", "2", "--repetitions", "1", "--out", str(out)]
    ran = subprocess.run(
        module("tests.e2e.measured.stalls", *wishes), capture_output=True, text=True, timeout=90, check=False
    )
    assert ran.returncode == 0, f"{ran.stdout}{ran.stderr}{out.read_text()}"
    assert json.loads(out.read_text())["rest_s"] <= LIMIT_S
