"""The API that packages of other authors import: what 0.2 had is still there, and takes the same arguments.

``python -m tests.protocol.test_author_api`` writes the names of this version, when it is released.
"""

from __future__ import annotations

import importlib
import inspect
import json
import sys
from enum import Enum
from pathlib import Path
from typing import Any

import pytest

from zbridge.version import __version__

VECTORS = Path(__file__).parents[1] / "vectors"
MODULES = (
    "zbridge.errors",
    "zbridge.fleet.messages",
    "zbridge.fleet.topics",
    "zbridge.protocol",
    "zbridge.simulation",
    "zbridge.simulation.world",
    "zbridge.wire",
)
"""What ``docs/reference/protocol-api.md`` calls stable."""


def described() -> dict[str, list[str]]:
    """Name everything public of the modules, with the arguments that callers may give."""
    return {module: sorted(_names(importlib.import_module(module))) for module in MODULES}


def _names(module: Any) -> list[str]:
    public = getattr(module, "__all__", None) or [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", module.__name__) == module.__name__
    ]
    return [line for name in public for line in _lines(name, getattr(module, name))]


def _lines(name: str, value: Any) -> list[str]:
    lines = [name]
    if inspect.isclass(value):
        lines += [f"{name}.{member}" for member in dir(value) if not member.startswith("_")]
        lines += [f"{name}({argument})" for argument in _arguments(value) if not issubclass(value, Enum)]
    elif inspect.isfunction(value):
        lines += [f"{name}({argument})" for argument in _arguments(value)]
    return lines


def _arguments(value: Any) -> list[str]:
    try:
        parameters = inspect.signature(value).parameters
    except (TypeError, ValueError):
        return []
    return [name for name in parameters if not name.startswith("_") and name not in ("args", "kwargs")]


@pytest.mark.parametrize("file", sorted(VECTORS.glob("author-api-*.json")), ids=lambda file: file.stem)
def test_every_name_and_argument_that_a_released_version_had_is_still_there(file: Path) -> None:
    now = described()
    released = json.loads(file.read_text())
    assert {module: [line for line in lines if line not in now[module]] for module, lines in released.items()} == {
        module: [] for module in released
    }


def test_a_released_version_is_recorded() -> None:
    assert (VECTORS / f"author-api-{__version__.rpartition('.')[0]}.json").exists()


if __name__ == "__main__":
    target = VECTORS / f"author-api-{__version__.rpartition('.')[0]}.json"
    target.write_text(json.dumps(described(), indent=1) + "\n")
    sys.stdout.write(f"{target}\n")
