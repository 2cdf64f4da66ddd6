"""What is released: its version in every file that repeats it, its SBOM, what the archives hold, and the workflows."""

from __future__ import annotations

import importlib.util
import json
import re
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from zbridge.version import __version__

ROOT = Path(__file__).parents[2]
RELEASE = ROOT / "deploy" / "release"
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION: str = PROJECT["version"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PINNED = re.compile(r"[\w.-]+/[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+")

each_workflow = pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, RELEASE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def test_every_file_that_repeats_the_version_has_that_of_pyproject() -> None:
    chart = yaml.safe_load((ROOT / "deploy" / "helm" / "zbridge" / "Chart.yaml").read_text())
    image = re.findall(r"ZBRIDGE_IMAGE:-zbridge:([\w.]+)", (ROOT / "deploy" / "container" / "compose.yaml").read_text())
    found = {
        "zbridge/version.py": __version__,
        "Chart.yaml, version": chart["version"],
        "Chart.yaml, appVersion": chart["appVersion"],
        "compose.yaml": image[0],
        "CITATION.cff": yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"],
        "SBOM": json.loads((RELEASE / "zbridge.cdx.json").read_text())["metadata"]["component"]["version"],
        "CHANGELOG.md": headings()[1][0],
    }
    assert found == dict.fromkeys(found, VERSION)


def headings() -> list[tuple[str, str]]:
    return re.findall(r"^## \[([^\]]+)\](?: - (\S+))?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_the_changelog_opens_with_unreleased_and_dates_every_version_as_the_citation_does() -> None:
    first, *dated = headings()
    assert first == ("Unreleased", "")
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d", date) for _, date in dated)
    assert dated[0][1] == str(yaml.safe_load((ROOT / "CITATION.cff").read_text())["date-released"])


def test_the_sbom_says_what_pyproject_declares() -> None:
    told = "python deploy/release/sbom.py writes it"
    assert (RELEASE / "zbridge.cdx.json").read_text() == module("sbom").render(PROJECT), told


def test_the_sbom_lists_each_declared_range_with_its_extra() -> None:
    components = json.loads((RELEASE / "zbridge.cdx.json").read_text())["components"]
    listed = {each["value"] for component in components for each in component["properties"]}
    declared = {
        *PROJECT["dependencies"],
        *(each for extra in PROJECT["optional-dependencies"].values() for each in extra),
    }
    assert declared - listed == {each for each in declared if each.startswith("zbridge[")}
    (websockets,) = (component for component in components if component["name"] == "websockets")
    assert websockets["scope"] == "optional"
    assert {each["name"].rpartition(":")[2] for each in websockets["properties"]} == {"foxglove", "console"}
    required = {component["name"] for component in components if component["scope"] == "required"}
    assert "numpy" in required
    assert len(required) == len(PROJECT["dependencies"])


def test_an_archive_with_a_stray_or_missing_file_is_refused_by_the_build() -> None:
    build = module("build")
    build.require_content("a.whl", ["a.py", "b.py"], ["b.py", "a.py"])
    with pytest.raises(build.Unsound, match=r"(?s)a\.whl: .*\n\+ c\.pyc\n- b\.py"):
        build.require_content("a.whl", ["a.py", "c.pyc"], ["b.py", "a.py"])


def test_two_builds_that_differ_are_refused(tmp_path: Path) -> None:
    build, paths = module("build"), [tmp_path / name for name in "abc"]
    for path in paths:
        path.write_text("same")
    build.require_same(paths)
    paths[2].write_text("other")
    with pytest.raises(build.Unsound, match="not reproducible"):
        build.require_same(paths)


@each_workflow
def test_actions_are_pinned_by_commit_with_their_version(path: Path) -> None:
    used = re.findall(r"uses: (.+)$", path.read_text(), re.MULTILINE)
    assert used
    assert [each for each in used if not PINNED.fullmatch(each)] == []


@each_workflow
def test_workflows_may_only_read_unless_a_job_says_what_it_writes(path: Path) -> None:
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"] in ({}, {"contents": "read"})
    granted = {right for job in workflow["jobs"].values() for right in job.get("permissions", {}).items()}
    writes = {name for name, access in granted if access == "write"}
    assert writes <= ({"id-token", "attestations"} if path.stem == "release" else set())
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    checkouts = [step for step in steps if step.get("uses", "").startswith("actions/checkout@")]
    assert all(step["with"]["persist-credentials"] is False for step in checkouts)


def test_the_matrix_runs_the_readmes_command_on_every_python_that_is_supported() -> None:
    text = next(path for path in WORKFLOWS if path.stem == "ci").read_text()
    supported = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert yaml.safe_load(text)["jobs"]["suite"]["strategy"]["matrix"]["python"] == supported
    assert "run: pip install '.[test]' && pytest" in text
    assert "pip install '.[test]' && pytest" in (ROOT / "README.md").read_text()
