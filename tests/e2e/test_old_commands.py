"""What the network held up moves no robot: with a real gateway, client and router, and a link that is really cut."""

from __future__ import annotations

import subprocess

import pytest

from tests.e2e.processes import NotHereError, apart, module


@pytest.mark.parametrize(("age", "moved"), [("0.4", "moved 0"), ("0", "moved 1")])
def test_a_driver_whose_network_heals_moves_no_robot_with_what_it_said_meanwhile(age: str, moved: str) -> None:
    """With max_age_s = 0 it does: the cut held something up."""
    try:
        apart()
    except NotHereError as error:
        pytest.skip(f"no network namespace for the driver: {error}")
    wishes = ["--cuts", "2.3", "--repetitions", "1", "--age", age]
    ran = subprocess.run(module("old_commands", *wishes), capture_output=True, text=True, timeout=90, check=False)
    assert ran.returncode == 0, f"{ran.stdout}{ran.stderr}"
    assert f"cut of 2.3 s: 1 times, {moved}," in ran.stdout
