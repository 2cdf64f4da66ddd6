"""The scene for authors' tests: what a gateway does with a session, it does too."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "examples" / "arcos"))

from arcos import PROTOCOL
from arcos.simulator import Arcos

from zbridge.errors import NeutralFirst, NotReady
from zbridge.simulation import Scene


@pytest.fixture
def scene() -> Scene:
    scene = Scene(PROTOCOL, Arcos())
    scene.establish()
    scene.lease(True)
    return scene


def simulated(scene: Scene) -> Any:
    return scene.simulated


def test_a_robot_that_is_not_ready_takes_no_command_and_is_stopped(scene: Scene) -> None:
    scene.drive(0.4)
    scene.run(0.5)
    scene.session.busy = "on a cliff"
    scene.run(0.2)
    assert simulated(scene).truth().neutral
    with pytest.raises(NotReady, match="on a cliff"):
        scene.drive(0.4)
    scene.session.busy = None
    scene.run(0.1)
    with pytest.raises(NeutralFirst):
        scene.drive(0.4)
    scene.drive()
    scene.drive(0.4)
    scene.run(0.3)
    assert not simulated(scene).truth().neutral


def test_a_robot_that_returns_to_its_driver_is_told_of_the_lease_and_needs_neutral(scene: Scene) -> None:
    scene.connect()
    scene.establish()
    assert simulated(scene).motors
    with pytest.raises(NeutralFirst):
        scene.drive(0.4)


def test_a_robot_that_never_answers_is_a_clear_error() -> None:
    scene = Scene(PROTOCOL, Arcos())
    scene.answers = False
    with pytest.raises(TimeoutError, match="ArcosSession"):
        scene.establish(2.0)
