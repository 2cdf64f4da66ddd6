"""The publishers of one robot: made on first use, bounded where the robot chooses the names."""

from __future__ import annotations

import pytest

from tests.fake_bus import FakeBus
from zbridge.control.faults import OpenFaults
from zbridge.fleet import topics
from zbridge.fleet.messages import Reading, Switch
from zbridge.fleet.topics import KeySpace
from zbridge.robot import names
from zbridge.robot.publishers import RobotPublishers


class Rig:
    def __init__(self) -> None:
        self.bus = FakeBus()
        self.open_faults = OpenFaults()
        self.now = 0.0
        self.publishers = RobotPublishers(self.bus, KeySpace("fleet", "r1"), self.open_faults, lambda: self.now)

    def read(self, name: str) -> None:
        self.publishers.publish(topics.SENSOR(name), Reading(1.0))

    def shown(self, path: str) -> int:
        return len(self.bus.values(f"fleet/r1/{path}"))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setattr(names, "NAMES", 2)
    return Rig()


def test_names_above_the_bound_are_dropped_and_shown_until_the_hour_since_the_first_is_over(rig: Rig) -> None:
    for rig.now, name in ((10.0, "a"), (20.0, "b"), (20.0, "c"), (30.0, "a")):
        rig.read(name)
    assert [rig.shown(f"sensor/{name}") for name in "abc"] == [2, 1, 0]
    assert len(rig.publishers) == 2, "one for each topic"
    for rig.now, over in ((names.HOUR_S + 9.9, True), (names.HOUR_S + 10.0, False)):
        rig.publishers.expire()
        assert bool(rig.open_faults.texts) is over, "status says so"
    rig.read("c")
    assert rig.shown("sensor/c") == 1


def test_a_new_connection_gives_up_the_names_of_the_old_one_and_keeps_the_states(rig: Rig) -> None:
    rig.read("front")
    rig.publishers.publish(topics.LIDAR, Switch(on=True))
    rig.publishers.forget_names()
    assert list(rig.publishers.known) == ["lidar"]
