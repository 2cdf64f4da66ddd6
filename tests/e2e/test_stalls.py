"""A robot that stalled, or whose link was cut, while it was driven: it is at rest soon after it goes on."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.loss import NotHereError, apart
from tests.e2e.stalls import LIMIT_S, Case, Outcome, measure

STALLED = ("tcpudp-1.3", "alf", "wc2ec")


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    """One stall of 2.5 s of each robot, all at the same time."""
    cases = [Case(robot, "stall", 2.5) for robot in STALLED]
    return {outcome.case.robot: outcome for outcome in asyncio.run(measure(cases, repetitions=1))}


@pytest.mark.parametrize("robot", STALLED)
def test_a_robot_that_stalls_while_it_is_driven_is_at_rest_after_it(outcomes: dict[str, Outcome], robot: str) -> None:
    outcome = outcomes[robot]
    assert outcome.faults == []
    assert outcome.rest_s is not None, f"the robot drove on; {outcome}"
    assert outcome.rest_s <= LIMIT_S, outcome


def test_a_robot_whose_link_was_cut_while_it_was_driven_is_at_rest_after_it(tmp_path: Path) -> None:
    try:
        apart()
    except NotHereError as error:
        pytest.skip(f"no network namespace for the robot: {error}")
    out = tmp_path / "cut.jsonl"
    wishes = ["--robots", "tcpudp-1.3", "--stalls", "", "--cuts", "2", "--repetitions", "1", "--out", str(out)]
    subprocess.run([sys.executable, "-m", "tests.e2e.stalls", *wishes], capture_output=True, timeout=90, check=False)
    (outcome,) = [json.loads(line) for line in out.read_text().splitlines()]
    assert outcome["faults"] == []
    assert outcome["rest_s"] is not None, f"the robot drove on; {outcome}"
    assert outcome["rest_s"] <= LIMIT_S, outcome
