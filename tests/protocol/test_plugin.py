"""How protocols are found, and what every robot has by default."""

import importlib.metadata
import re
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.errors import ConfigError
from zbridge.fleet import topics
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import GROUP, Protocol, RobotSide, find_protocol, protocol_names


class ToyRobot(RobotSide):
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


def installed(folder: Path, text: str) -> None:
    """Write the entry points of a distribution."""
    (folder / "other-1.0.dist-info").mkdir()
    (folder / "other-1.0.dist-info" / "entry_points.txt").write_text(text)


def test_a_protocol_is_found_beside_others_of_its_distribution(tmp_path: Path, monkeypatch) -> None:
    text = "[console_scripts]\nalso = a:b\n\n[zbridge.protocols]\nnone = math:pi\nalso=gateways.alf:PROTOCOL\n\n[z]\n"
    installed(tmp_path, text + "last = gateways.alf:PROTOCOL\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert find_protocol("also").name == "alf"
    for name, error in (("none", "math:pi is no zbridge protocol"), ("last", "expected one of .*tcpudp")):
        with pytest.raises(ConfigError, match=error):
            find_protocol(name)


BROKEN = {
    "absent": ("absent_module:PROTOCOL", r"ModuleNotFoundError: No module named 'absent_module'"),
    "torn": ("broken_torn:PROTOCOL", r"SyntaxError: .*broken_torn\.py"),
    "raises": ("broken_raises:PROTOCOL", r"ZeroDivisionError: division by zero in <module> \(broken_raises\.py:1\)$"),
    "leaves": ("broken_leaves:PROTOCOL", r"SystemExit: 3 in <module> \(broken_leaves\.py:2\)$"),
    "lacks": ("broken_lacks:PROTOCOL", r"AttributeError: module 'broken_lacks' has no attribute 'PROTOCOL'"),
}
SOURCES = {"torn": "def", "raises": "1 / 0", "leaves": "import sys\nsys.exit(3)", "lacks": "x = 1"}


@pytest.mark.parametrize("name", BROKEN)
def test_a_protocol_that_cannot_be_loaded_is_one_error_that_says_why(tmp_path: Path, monkeypatch, name: str) -> None:
    where, why = BROKEN[name]
    installed(tmp_path, f"[zbridge.protocols]\n{name} = {where}\n")
    if name in SOURCES:
        (tmp_path / f"broken_{name}.py").write_text(SOURCES[name])
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError) as error:
        find_protocol(name)
    assert re.match(f"protocol = '{name}': {where} cannot be loaded: {why}", str(error.value)), str(error.value)
    assert "tcpudp" in protocol_names()


@pytest.mark.parametrize("text", [b"\xff[zbridge.protocols]\n", b"[zbridge.protocols]\nno equals sign\n", b"[[\n="])
def test_a_package_whose_entry_points_cannot_be_read_hides_no_protocol(
    tmp_path: Path, monkeypatch, text: bytes
) -> None:
    installed(tmp_path, "")
    (tmp_path / "other-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (tmp_path / "other-1.0.dist-info" / "entry_points.txt").write_bytes(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert {"alf", "tcpudp", "wc2ec"} <= set(protocol_names())
    assert find_protocol("alf").name == "alf"
    with pytest.raises(ConfigError, match="'no equals sign': expected one of"):
        find_protocol("no equals sign")


def test_a_protocol_that_only_python_finds_is_found_too(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = EntryPoints([EntryPoint("zipped", "gateways.alf:PROTOCOL", GROUP)])
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: entries)
    assert find_protocol("zipped").name == "alf"


def test_without_any_protocol_the_error_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: EntryPoints([]))
    monkeypatch.setattr("sys.path", [str(tmp_path)])
    with pytest.raises(ConfigError, match="none installed"):
        find_protocol("tcpudp")
