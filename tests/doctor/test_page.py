"""The page of doctor names every code, and no other; every documented failure is in its table."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from zbridge.errors import Code
from zbridge.protocol.plugin import find_protocol, protocol_names

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "doctor.md").read_text()
MAKERS = {"error", "note", "warning", "ok", "Finding"}
STATES = ("offline", "connecting", "handshaking", "closing")


def declared() -> Iterator[str]:
    """Give every code that the source can report; what it composes is listed."""
    for path in (ROOT / "zbridge" / "doctor").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and _name(node.func) in MAKERS:
                yield from _codes(node)
    for name in protocol_names():
        yield from (advice.code for advice in find_protocol(name).advice)
    yield from (f"robot_{state}" for state in STATES)


def _name(node: ast.expr) -> str:
    return node.id if isinstance(node, ast.Name) else ""


def _codes(call: ast.Call) -> Iterator[str]:
    at = {"ok": 2, "Finding": 2}.get(_name(call.func), 1)
    for argument in call.args[at : at + 1]:
        if isinstance(argument, ast.Constant):
            yield str(argument.value)


def documented() -> set[str]:
    findings, _, _ = PAGE.partition("## Documented failures")
    codes = {code for row in re.findall(r"^\| \w+ \| (`[^|]+) \|", findings, re.MULTILINE) for code in spans(row)}
    return codes | set(spans(findings.rpartition("\n\n`open_bus`")[2].partition(" are codes")[0])) | {"open_bus"}


def spans(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


def test_the_page_names_every_code_and_no_other() -> None:
    assert documented() - {"refused_<code>"} == set(declared())


def test_the_failures_name_codes_that_there_are() -> None:
    _, _, failures = PAGE.partition("## Documented failures")
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \| (\w+) \|$", failures, re.MULTILINE)[1:]
    known = documented() | {f"refused_{code}" for code in Code} | {"ok", "hq", "release"}
    assert len(rows) > 15
    for failure, shown, found in rows:
        assert set(spans(shown)) <= known, failure
        assert found in ("anywhere", "host", "silence"), failure


@pytest.mark.parametrize(
    "failure", ["client is killed", "client is frozen", "bus is cut", "gateway is frozen", "wall clock", "takes over"]
)
def test_the_failures_of_the_first_table_of_what_happens_are_on_the_page(failure: str) -> None:
    assert failure in PAGE
    assert failure in (ROOT / "docs" / "explanation" / "failures.md").read_text()
