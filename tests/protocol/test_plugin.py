"""How protocols are found, and what every robot has by default."""

import importlib.metadata
import re
from importlib.metadata import EntryPoint, EntryPoints

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.errors import ConfigError
from zbridge.fleet import topics
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import GROUP, Protocol, Robot, find_protocol, protocol_names


class ToyRobot(Robot):
    link_names = ("robot",)
    driving: Toy | None = None
    session = translator = command = stop = ask = None


def test_a_robot_is_ready_while_its_driving_session_is_established_and_knows_no_answers_by_default() -> None:
    robot, session = ToyRobot(), Toy(LIMITS)
    assert (robot.ready, robot.known(topics.MAP)) == (False, None)
    robot.driving = session
    session.open(0.0)
    assert not robot.ready
    session.establish("1", ())
    assert robot.ready
    session.close("enough", 1.0)
    assert not robot.ready


@pytest.mark.parametrize("name", protocol_names())
def test_every_protocol_says_what_it_is_and_makes_robots_with_its_default_options(name: str) -> None:
    found = find_protocol(name)
    assert isinstance(found, Protocol)
    assert found.name == name
    assert found.summary
    assert f'protocol = "{name}"' in found.template
    robot = found.robot(found.options(), found.links, Metrics())
    assert len(robot.link_names) == found.links
    assert robot.driving is None


@pytest.mark.parametrize(
    ("entries", "name", "error"),
    [
        (None, "nope", re.escape("protocol = 'nope': expected one of ") + ".*tcpudp"),
        ([EntryPoint("odd", "math:pi", GROUP)], "odd", "math:pi is no zbridge protocol"),
        ([], "tcpudp", "none installed"),
    ],
)
def test_what_is_no_installed_protocol_is_an_error_that_names_those_there_are(monkeypatch, entries, name, error):
    if entries is not None:
        monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: EntryPoints(entries))
    with pytest.raises(ConfigError, match=error):
        find_protocol(name)
