"""The reference says what the code declares: generated parts are up to date, and the page of metrics names each one."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs.generate.__main__ import DOCS, PART, generated, rewritten
from docs.generate.bus import declared
from zbridge.hq.context import ListenerCounts
from zbridge.views.ros2 import teleop

ROOT = DOCS.parent
PARTS = generated()
MARKED = [page for page in sorted(DOCS.rglob("*.md")) if PART.search(page.read_text())]


@pytest.mark.parametrize("page", MARKED, ids=lambda page: str(page.relative_to(DOCS)))
def test_generated_parts_are_what_the_code_declares(page: Path) -> None:
    text = page.read_text()
    assert rewritten(text, PARTS) == text, "python -m docs.generate"


def test_every_generated_part_stands_on_one_page() -> None:
    assert sorted(part[1] for page in MARKED for part in PART.findall(page.read_text())) == sorted(PARTS)


@pytest.mark.parametrize("name", PARTS)
def test_no_field_setting_option_or_key_is_without_a_meaning(name: str) -> None:
    rows = [line for line in PARTS[name].splitlines() if line.startswith("| ")][2:]
    assert rows
    assert [row for row in rows if "|  |" in row] == []


def test_every_key_has_its_place_in_the_table_of_its_class() -> None:
    for path, topic, meaning in declared():
        assert meaning, path
        assert f"| `{path}` |" in PARTS[f"keys {topic.delivery.value}"]


# Metrics


def counted() -> Iterator[str]:
    """Give the name of every counter in the source; those that are composed are listed."""
    for path in (*(ROOT / "zbridge").rglob("*.py"), *(ROOT / "gateways").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "count":
                name = node.args[0] if node.args else None
                if isinstance(name, ast.Constant) and re.fullmatch(r"[a-z]\w+", str(name.value)):
                    yield str(name.value)
    yield from (f"hq_{field}" for field in ListenerCounts.__struct_fields__)
    yield from (f"ros2_cmd_vel_{name}" for name in teleop._COUNTS)


def test_the_page_of_metrics_names_every_counter_and_no_other() -> None:
    rows = re.findall(r"^\| (`[^|]+) \|", (DOCS / "reference" / "metrics.md").read_text(), re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(set(counted()))
