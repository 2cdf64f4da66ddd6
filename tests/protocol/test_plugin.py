"""How protocols are found, and what every robot has by default."""

import importlib.metadata
import re
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.errors import ConfigError
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import GROUP, Outcome, Protocol, Robot, find_protocol, protocol_names


class ToyRobot(Robot):
    link_names = ("robot",)

    def __init__(self) -> None:
        self.current: Toy | None = None

    def session(self, link: str, peer: str) -> Toy:
        self.current = Toy(LIMITS)
        return self.current

    @property
    def driving(self) -> Toy | None:
        return self.current

    def translator(self, kind: type) -> Any:
        return lambda message, stamp_ns: ()

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        return Outcome()

    def stop(self, now: float, until: float) -> None:
        return None

    def ask(self, topic: Topic) -> None:
        return None


def test_a_robot_is_ready_while_its_driving_session_is_established() -> None:
    robot = ToyRobot()
    assert not robot.ready
    session = robot.session("robot", "")
    assert not robot.ready
    session.open(0.0)
    assert not robot.ready
    session.establish("1", ())
    assert robot.ready
    session.close("enough", 1.0)
    assert not robot.ready


def test_a_robot_is_asked_for_everything_unless_it_says_otherwise_and_an_outcome_reports_nothing() -> None:
    assert ToyRobot().known(topics.MAP) is None
    assert (Outcome().telemetry, Outcome().left_out) == ((), None)


def test_the_installed_protocols_are_found_by_name() -> None:
    assert "tcpudp" in protocol_names()
    found = find_protocol("tcpudp")
    assert isinstance(found, Protocol)
    assert found.name == "tcpudp"


@pytest.mark.parametrize("name", protocol_names())
def test_every_protocol_says_what_it_is_and_makes_robots_with_its_default_options(name: str) -> None:
    found = find_protocol(name)
    assert found.name == name
    assert found.summary
    assert f'protocol = "{name}"' in found.template
    robot = found.robot(found.options(), found.links, Metrics())
    assert len(robot.link_names) == found.links
    assert robot.driving is None


def test_an_unknown_protocol_is_an_error_that_names_those_there_are() -> None:
    with pytest.raises(ConfigError, match=re.escape("protocol = 'nope': expected one of ") + ".*tcpudp"):
        find_protocol("nope")


@pytest.mark.parametrize(
    ("entries", "name", "error"),
    [
        ([EntryPoint("odd", "math:pi", GROUP)], "odd", "math:pi is no zbridge protocol"),
        ([], "tcpudp", "none installed"),
    ],
)
def test_an_entry_that_is_no_protocol_or_none_at_all_is_an_error(monkeypatch, entries, name: str, error: str) -> None:
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: EntryPoints(entries))
    with pytest.raises(ConfigError, match=error):
        find_protocol(name)
