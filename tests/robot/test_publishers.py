"""The publishers of one robot: made on first use, bounded where the robot chooses the names."""

from __future__ import annotations

import pytest

from zbridge.bus.fake import FakeBus
from zbridge.control.conditions import Conditions
from zbridge.fleet import topics
from zbridge.fleet.messages import Reading, Switch
from zbridge.fleet.topics import KeySpace
from zbridge.robot import names
from zbridge.robot.publishers import RobotPublishers


class Rig:
    def __init__(self) -> None:
        self.bus = FakeBus()
        self.conditions = Conditions()
        self.now = 0.0
        self.publishers = RobotPublishers(self.bus, KeySpace("fleet", "r1"), self.conditions, lambda: self.now)

    def read(self, name: str) -> None:
        self.publishers.publish(topics.SENSOR(name), Reading(1.0))

    def shown(self, path: str) -> int:
        return len(self.bus.values(f"fleet/r1/{path}"))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setattr(names, "NAMES", 2)
    return Rig()


def test_names_above_the_bound_are_dropped_and_shown_until_the_hour_is_over(rig: Rig) -> None:
    for name in ("a", "b", "c", "a"):
        rig.read(name)
    assert [rig.shown(f"sensor/{name}") for name in "abc"] == [2, 1, 0]
    assert len(rig.publishers) == 2, "one for each topic"
    assert rig.conditions.texts, "status says so"
    rig.now = names.HOUR_S
    rig.publishers.expire()
    assert not rig.conditions.texts
    rig.read("c")
    assert rig.shown("sensor/c") == 1


def test_a_new_connection_gives_up_the_names_of_the_old_one_and_keeps_the_states(rig: Rig) -> None:
    rig.read("front")
    rig.publishers.publish(topics.LIDAR, Switch(on=True))
    rig.publishers.forget_names()
    assert list(rig.publishers.known) == ["lidar"]
