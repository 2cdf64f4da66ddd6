"""The example of the plug-in guide, as a package of its own: its tests, by TCP and on a serial line, and its check."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "khepera"
NAMES = "[zbridge.protocols]\nkhepera = khepera:PROTOCOL\n"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Install the package, as an installer would; give the environment in which it is found."""
    site = tmp_path / "site"
    about = site / "zbridge_khepera-1.0.dist-info"
    about.mkdir(parents=True)
    shutil.copytree(EXAMPLE / "khepera", site / "khepera")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: zbridge-khepera\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(NAMES)
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH"))))}


def run(environment: dict[str, str], *arguments: str) -> str:
    ran = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def test_the_example_passes_its_tests_and_is_driven_by_tcp_and_on_a_serial_line(environment, tmp_path) -> None:
    shutil.copytree(EXAMPLE / "tests", tmp_path / "tests")
    shutil.copy(EXAMPLE / "pyproject.toml", tmp_path)
    out = run(environment, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(tmp_path))
    assert "passed" in out


def test_the_example_holds_what_the_conformance_kit_asks(environment: dict[str, str]) -> None:
    assert run(environment, "-m", "zbridge.simulation.check", "khepera").endswith("hold, 0 do not\n")


@pytest.mark.parametrize("protocol", ["alf", "tcpudp", "wc2ec"])
def test_every_protocol_holds_what_the_conformance_kit_asks(protocol: str) -> None:
    assert run(dict(os.environ), "-m", "zbridge.simulation.check", protocol).endswith("hold, 0 do not\n")


def test_init_writes_a_configuration_that_the_check_takes(environment: dict[str, str], tmp_path: Path) -> None:
    file = tmp_path / "k1.toml"
    file.write_text(run(environment, "-m", "zbridge", "init", "khepera"))
    run(environment, "-m", "zbridge", "check", str(file))
