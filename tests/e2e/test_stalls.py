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
ATTEMPTS = 3
UNDRIVEN = "RuntimeError: the robot was never driven"


def test_robots_that_stall_while_they_are_driven_are_at_rest_after_it() -> None:
    cases, outcomes = [Case(robot, "stall", 2.5) for robot in STALLED], []
    for attempt in range(1, ATTEMPTS + 1):
        measured = asyncio.run(measure(cases, repetitions=1))
        again = [outcome for outcome in measured if attempt < ATTEMPTS and _lost_its_handshake(outcome)]
        outcomes += [outcome for outcome in measured if outcome not in again]
        cases = [outcome.case for outcome in again]
        if not cases:
            break
    assert sorted(outcome.case.robot for outcome in outcomes) == sorted(STALLED)
    for outcome in outcomes:
        assert outcome.faults == []
        assert outcome.rest_s is not None, f"the robot drove on; {outcome}"
        assert outcome.rest_s <= LIMIT_S, outcome


def _lost_its_handshake(outcome: Outcome) -> bool:
    """Tell whether the robot, before it was ever driven, was late itself, and lost packets that it joined."""
    return any(fault.startswith(UNDRIVEN) for fault in outcome.faults) and bool(outcome.judge.get("piled"))


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
