"""The reference says what the code declares: generated parts are up to date, and the page of metrics names each one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.generate.__main__ import DOCS, PART, generated, rewritten
from docs.generate.bus import declared
from docs.generate.declared import members
from docs.generate.metrics import of_protocols
from zbridge.control.events import StopCause
from zbridge.metrics.families import FAMILIES

ROOT = DOCS.parent
MARKED = [page for page in sorted(DOCS.rglob("*.md")) if PART.search(page.read_text())]
NAMES = sorted(part[1] for page in MARKED for part in PART.findall(page.read_text()))


@pytest.mark.parametrize("page", MARKED, ids=lambda page: str(page.relative_to(DOCS)))
def test_generated_parts_are_what_the_code_declares(page: Path) -> None:
    text = page.read_text()
    assert rewritten(text, generated()) == text, "python -m docs.generate"


def test_every_generated_part_stands_on_one_page() -> None:
    assert sorted(generated()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_no_field_setting_option_or_key_is_without_a_meaning(name: str) -> None:
    rows = [line for line in generated()[name].splitlines() if line.startswith("| ")][2:]
    assert rows
    assert [row for row in rows if "|  |" in row] == []


def test_every_key_has_its_place_in_the_table_of_its_class() -> None:
    for path, topic, meaning in declared():
        assert meaning, path
        assert f"| `{path}` |" in generated()[f"keys {topic.delivery.value}"]


# Metrics


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: str(page.relative_to(DOCS)))
def test_every_metric_that_a_page_names_exists(page: Path) -> None:
    known = {family.full_name for family in (*FAMILIES.values(), *of_protocols())}
    assert set(re.findall(r"\bzbridge_\w+_(?:total|seconds|bytes)\b", page.read_text())) <= known


def test_every_cause_of_a_stop_is_explained() -> None:
    assert [cause for cause, _ in members(StopCause)] == [cause.value for cause in StopCause]
