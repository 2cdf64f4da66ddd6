"""What the network held up moves no robot: with a real gateway, client and router, and a link that is really cut."""

from __future__ import annotations

import subprocess

import pytest

from tests.e2e.rigs.processes import NotHereError, apart, module

TRIES = 4
"""Cuts of which one at least must hold something up that moves a robot which looks at no age."""


def cut(age: str) -> str:
    """Cut the driver's network once for 2.3 s; tell what came of it."""
    wishes = ["--cuts", "2.3", "--repetitions", "1", "--age", age]
    ran = subprocess.run(
        module("tests.e2e.measured.old_commands", *wishes), capture_output=True, text=True, timeout=90, check=False
    )
    assert ran.returncode == 0, f"{ran.stdout}{ran.stderr}"
    return ran.stdout


@pytest.mark.long
def test_a_driver_whose_network_heals_moves_no_robot_with_what_it_said_meanwhile() -> None:
    """With max_age_s = 0 it does: the cut held something up."""
    try:
        apart()
    except NotHereError as error:
        pytest.skip(f"no network namespace for the driver: {error}")
    assert "cut of 2.3 s: 1 times, moved 0," in cut("0.4")
    assert any("moved 1," in cut("0") for _ in range(TRIES))
