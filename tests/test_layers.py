"""Who may import whom: import-linter's contracts in ``pyproject.toml`` hold, and each of them can fail."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
CONTRACTS = [
    contract["name"]
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
]
LINT = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
ROOMS = "Rooms of the core: each imports only those below it"
OFFENCES = {
    ROOMS: ("zbridge/hq/intent.py", "import zbridge.robot.names"),
    "No circle of modules, in no room": ("zbridge/fleet/messages.py", "import zbridge.fleet.view"),
    "The core knows no robot": ("zbridge/cli/probe.py", "import gateways"),
    "Protocols know nothing of each other": ("gateways/alf/translate.py", "import gateways.wc2ec.devices"),
    "A protocol knows no bus, no lease, no listener and no process": (
        "gateways/alf/simulator.py",
        "import zbridge.bus.interface",
    ),
    "The Python client knows keys, messages and leases only": (
        "zbridge/client/feed.py",
        "import zbridge.protocol.session",
    ),
    "What the author of a protocol imports is sans-IO, all the way down": (
        "zbridge/fleet/printable.py",
        "import threading",
    ),
    "A protocol is sans-IO, but for its simulator and its conformance kit": ("gateways/tcpudp/maps.py", "import time"),
    "Machines are sans-IO: time is an argument": ("zbridge/hq/intent.py", "import time"),
    "A conformance kit is imported by its protocol's lazy hook only": (
        "gateways/alf/translate.py",
        "import gateways.alf.conformance.parser",
    ),
    "A conformance kit shares no code with the gateway it judges": (
        "gateways/alf/conformance/parser.py",
        "import gateways.alf.messages",
    ),
    "Only the bus imports zenoh": ("zbridge/client/fleet.py", "import zenoh"),
    "Only the command line imports typer and rich, and top rich's cells": ("zbridge/app/config.py", "import rich"),
    "Only the certificates import cryptography": ("zbridge/security/roles.py", "import cryptography"),
    "Only the views import what viewers and recordings need": ("zbridge/client/fleet.py", "import foxglove"),
    "Only the screens of top import textual": ("zbridge/views/top/board.py", "import textual"),
    "Only the console imports starlette and uvicorn": ("zbridge/views/console/feed.py", "import uvicorn"),
    "Only the format of ROS 2 imports rosbags and xxhash": ("zbridge/client/fleet.py", "import xxhash"),
}


def lint(root: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", LINT, "--no-cache"], cwd=root, capture_output=True, text=True, check=False
    )


def broken(ran: subprocess.CompletedProcess[str]) -> list[str]:
    """Give the names of the contracts that import-linter found broken."""
    assert " broken.\n" in ran.stdout, ran.stdout + ran.stderr
    return re.findall(r"^(.+) BROKEN(?: \(\d+ ignored imports?\))?$", ran.stdout, re.MULTILINE)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the source, to be spoiled."""
    for package in ("zbridge", "gateways"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_every_contract_is_kept() -> None:
    ran = lint(ROOT)
    assert broken(ran) == [], ran.stdout
    assert [name for name in CONTRACTS if f"\n{name} KEPT" not in ran.stdout] == []
    assert ran.returncode == 0


def test_pre_commit_runs_the_lint_of_ci() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    script = (ROOT / ".ci" / "run").read_text()
    assert [hook["name"] for hook in hooks] == ["ruff check", "ruff format --check", "mypy", "lint-imports"]
    assert all(re.search(rf"^ *{hook['name']}\b", script, re.MULTILINE) for hook in hooks)
    assert all(hook["entry"].startswith(hook["name"]) and hook["language"] == "system" for hook in hooks)


def test_every_contract_has_an_offence_that_breaks_it() -> None:
    assert sorted(OFFENCES) == sorted(CONTRACTS)


@pytest.mark.parametrize("name", OFFENCES)
def test_an_offence_breaks_its_contract_and_no_other(tree: Path, name: str) -> None:
    path, statement = OFFENCES[name]
    with (tree / path).open("a") as file:
        file.write(f"\n{statement}\n")
    ran = lint(tree)
    assert broken(ran) == [name], ran.stdout
    assert ran.returncode == 1


def test_a_package_that_stands_in_no_contract_breaks_the_rooms(tree: Path) -> None:
    (tree / "zbridge" / "attic").mkdir()
    (tree / "zbridge" / "attic" / "__init__.py").touch()
    ran = lint(tree)
    assert broken(ran) == [ROOMS], ran.stdout
    assert "- zbridge.attic\n" in ran.stdout


@pytest.mark.parametrize(
    "package", sorted((ROOT / "gateways").glob("*/__init__.py")), ids=lambda path: path.parent.name
)
def test_simulators_and_conformance_kits_are_imported_when_they_are_called(package: Path) -> None:
    """Imports of a module's first level load with every gateway; those within functions do not."""
    lazy = ("conformance", "simulator")
    imported = [
        name
        for statement in ast.parse(package.read_text()).body
        for node in ([] if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef) else ast.walk(statement))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
    ]
    assert [name for name in imported if set(name.split(".")) & set(lazy)] == []


def test_the_judge_of_ros_2_shares_no_code_with_the_gateway() -> None:
    """No command reaches it, so it is no part of the product, and of no contract."""
    judge = ast.parse((ROOT / "tests/gateways/ros2/strict_robot.py").read_text())
    ours = ("gateways", "tests", "zbridge")
    froms = [node.module or "" for node in ast.walk(judge) if isinstance(node, ast.ImportFrom)]
    names = [alias.name for node in ast.walk(judge) if isinstance(node, ast.Import) for alias in node.names]
    assert [name for name in froms + names if name.startswith(ours)] == ["zbridge.simulation.judge"]


@pytest.mark.parametrize("protocol", ["tcpudp", "wc2ec"])
def test_a_gateway_loads_numpy_only_when_an_array_comes(protocol: str) -> None:
    loads = f"import gateways.{protocol}, zbridge.app, zbridge.bus.zenoh, zbridge.robot.device, sys"
    ran = subprocess.run([sys.executable, "-c", f"{loads}; sys.exit('numpy' in sys.modules)"], cwd=ROOT, check=False)
    assert ran.returncode == 0
