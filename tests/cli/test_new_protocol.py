"""``zbridge new-protocol``: what it writes is checked, installed as an installer would, and driven; wrong arguments."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.cli.test_usage import Typed
from tests.cli.test_usage import zbridge as zbridge
from zbridge.cli.new_protocol.package import SUFFIX, TEMPLATES, write_package

ROOT = Path(__file__).parents[2]
STYLES = {"lines": "zeppelin_x9", "packets": "aye"}
"""Names that sort behind zbridge and before it, so that no order of imports depends on the name."""
HEADS = re.compile(r"(# Next: .+\n)(# .+\n){0,2}(?!#)")
PACKAGE = {"__init__", "messages", "session", "simulated_wheels", "simulator", "translate"}
MOST_LINES = 180
"""Of code and docstrings without the simulator: few enough to be read before they are changed."""


def made(style: str, folder: Path) -> tuple[str, Path]:
    """Write a package beside what an installer writes of it; return its name and its directory."""
    name = STYLES[style]
    write_package(name, style, folder)
    about = folder / f"zbridge_{name}-0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: zbridge-{name}\nVersion: 0.1\n")
    (point,) = tomllib.loads((folder / "pyproject.toml").read_text())["project"]["entry-points"].items()
    (about / "entry_points.txt").write_text(f"[{point[0]}]\n{name} = {point[1][name]}\n")
    return name, folder


def started(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start a module of Python in the directory of a package that is installed."""
    path = os.pathsep.join(filter(None, (str(folder), str(ROOT), os.environ.get("PYTHONPATH"))))
    command = (sys.executable, "-m", *arguments)
    environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=-1, stderr=subprocess.STDOUT, text=True)


def output(process: subprocess.Popen[str]) -> str:
    """Wait until a process has ended well, and return what it printed."""
    shown, _ = process.communicate(timeout=120.0)
    assert process.returncode == 0, shown
    return shown


@pytest.mark.e2e
@pytest.mark.parametrize("style", STYLES)
def test_a_new_package_passes_its_tests_and_the_conformance_kit_and_is_clean(style: str, tmp_path: Path) -> None:
    name, folder = made(style, tmp_path)
    kit = started(folder, "tests.simulation.at_once", name)
    mypy = started(folder, "mypy", "--strict", "--cache-dir", str(tmp_path / ".mypy"), name, "tests")
    try:
        assert "passed" in output(started(folder, "pytest", "-q", "-p", "no:cacheprovider", "-W", "error"))
        for chosen in ((), ("--config", str(ROOT / "pyproject.toml"))):
            output(started(folder, "ruff", "check", "--no-cache", *chosen, "."))
            output(started(folder, "ruff", "format", "--check", "--no-cache", *chosen, "."))
        output(mypy)
        said = output(kit)
    finally:
        for process in (kit, mypy):
            process.kill()
            process.communicate()
    assert re.search(rf"^{name}: [4-9]\d hold, 0 do not(, \d not checked)?$", said.splitlines()[-1]), said
    assert "example 1, invented: Status" in said


@pytest.mark.parametrize("style", STYLES)
def test_every_file_says_first_what_to_change_and_nothing_of_the_template_is_left(style: str, tmp_path: Path) -> None:
    name = STYLES[style]
    files = write_package(name, style, tmp_path)
    assert sorted(files) == sorted(path for path in tmp_path.rglob("*") if path.is_file())
    package = {f"{name}/{module}.py" for module in PACKAGE}
    found = {path.relative_to(tmp_path).as_posix() for path in files}
    assert found == {"pyproject.toml", f"tests/test_{name}.py", *package}
    for path in files:
        assert HEADS.match(path.read_text()), path
        assert "newrobot" not in path.read_text().lower()
    code = [path.read_text() for path in files if path.parent.name == name and "simulat" not in path.name]
    assert sum(len(re.findall(r"^ *[^\s#]", text, re.MULTILINE)) for text in code) <= MOST_LINES


def test_a_name_that_contains_the_placeholder_is_no_trap(tmp_path: Path) -> None:
    write_package("anewrobot_2", "lines", tmp_path)
    session = (tmp_path / "anewrobot_2" / "session.py").read_text()
    assert "class Anewrobot2Session(" in session
    assert "from anewrobot_2.messages import" in session


def test_no_template_is_a_module_for_tools_and_none_is_without_the_suffix() -> None:
    files = [path for path in TEMPLATES.rglob("*") if path.is_file()]
    assert len(files) == 11
    assert [path for path in files if path.suffix != SUFFIX] == []


def test_it_prints_what_to_do_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zbridge: Typed) -> None:
    monkeypatch.chdir(tmp_path)
    ran = zbridge("new-protocol", "rover")
    assert (ran.code, ran.err) == (0, "")
    head, _, commands = ran.out.partition("\n\n")
    assert head == "zbridge-rover: 8 files written; each says in its first lines what to change. Next:"
    assert commands.splitlines() == [
        "cd zbridge-rover",
        "pip install -e '.[test]'",
        "python -m pytest",
        "python -m zbridge.simulation.check rover",
        "zbridge simulate rover &",
        "zbridge init rover --name r1 > r1.toml",
        "zbridge run r1.toml &",
        "zbridge drive r1",
    ]
    (tmp_path / "my robots").mkdir()
    ran = zbridge("new-protocol", "rover", "--style", "packets", "--dir", "my robots")
    assert ran.out.splitlines()[2] == "cd 'my robots'"
    assert "Packets(" in (tmp_path / "my robots" / "rover" / "messages.py").read_text()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("Rover", "expected lower-case letters, digits and '_', a letter first and no '_' last"),
        ("my-rover", "expected lower-case letters"),
        ("2wheels", "expected lower-case letters"),
        ("_rover", "expected lower-case letters"),
        ("rover_", "expected lower-case letters"),
        ("r\u00f6ver", "expected lower-case letters"),
        ("../rover", "expected lower-case letters"),
        ("class", "it is a keyword of Python"),
        ("alf", "a protocol of this name is installed"),
        ("json", "a module of this name is installed"),
        ("winreg", "a module of this name is installed"),
        ("msgspec", "a module of this name is installed"),
        ("zbridge", "a module of this name is installed"),
        ("tests", "the tests have this directory"),
        ("rover --dir full", "--dir full: the directory is not empty"),
        ("rover --dir file", "--dir file: file is no directory"),
        ("rover --dir file/below", "--dir file/below: file is no directory"),
        ("rover --style waves", "'waves' is not one of 'lines', 'packets'"),
    ],
)
def test_a_wrong_name_or_directory_is_one_line_and_writes_nothing(
    words: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zbridge: Typed
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    ran = zbridge("new-protocol", *words.split())
    assert (ran.code, ran.out) == (2, "")
    assert why in ran.err
    assert ran.err.count("\n") == 1 or ran.err.startswith("Usage: ")
    assert sorted(tmp_path.rglob("*")) == before
