"""Who may import whom: import-linter's contracts in ``pyproject.toml`` hold, and no package stands outside of them."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
CONTRACTS = [contract["name"] for contract in TOOLS["importlinter"]["contracts"]]
LINT = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"


def lint(root: Path) -> tuple[list[str], str]:
    """Give the names of the contracts that import-linter found broken, and all that it said."""
    command = [sys.executable, "-c", LINT, "--no-cache"]
    said = subprocess.run(command, cwd=root, capture_output=True, text=True).stdout
    return re.findall(r"^(.+) BROKEN(?: \(\d+ ignored imports?\))?$", said, re.MULTILINE), said


def test_every_contract_is_kept() -> None:
    broken, said = lint(ROOT)
    assert broken == [name for name in CONTRACTS if f"\n{name} KEPT" not in said] == [], said


def test_a_package_that_stands_in_no_contract_and_an_import_upwards_are_found(tmp_path: Path) -> None:
    for package in ("zbridge", "gateways"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "zbridge" / "attic").mkdir()
    (tmp_path / "zbridge" / "attic" / "__init__.py").touch()
    with (tmp_path / "zbridge" / "hq" / "intent.py").open("a") as file:
        file.write("\nimport time\n")
    broken, said = lint(tmp_path)
    rooms = "Rooms of the core: each imports only those below it"
    assert broken == [rooms, "Machines are sans-IO: time is an argument"], said
    assert "- zbridge.attic\n" in said


@pytest.mark.parametrize(
    "package", sorted((ROOT / "gateways").glob("*/__init__.py")), ids=lambda path: path.parent.name
)
def test_simulators_and_conformance_kits_are_imported_when_they_are_called(package: Path) -> None:
    """Imports of a module's first level load with every gateway; those within functions do not."""
    lazy = {"conformance", "simulator"}
    imported = [
        name
        for statement in ast.parse(package.read_text()).body
        for node in ([] if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef) else ast.walk(statement))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
    ]
    assert [name for name in imported if set(name.split(".")) & lazy] == []
