"""Files and functions of the product end where their subject ends: 400 lines, and 40 of a function's body."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILE_LINES, FUNCTION_LINES = 400, 40
LONGER = {
    "zbridge/control/authority.py",  # one state machine and its table
    "zbridge/robot/device.py",
    "zbridge/robot/ownership.py",
    "zbridge/transport/conversation.py",
}
"""Files that are longer, or have a longer function."""
FILES = sorted(
    name
    for top in ("zbridge", "gateways")
    for path in (ROOT / top).rglob("*.py")
    if (name := path.relative_to(ROOT).as_posix()) not in LONGER
)


def functions(source: str) -> Iterator[tuple[str, int]]:
    """Give the name of each function, and the lines of its body."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
            yield node.name, node.end_lineno - node.body[0].lineno + 1


def test_no_file_is_too_long() -> None:
    assert [path for path in FILES if len((ROOT / path).read_text().splitlines()) > FILE_LINES] == []


def test_no_function_is_too_long() -> None:
    found = {path: [*functions((ROOT / path).read_text())] for path in FILES}
    assert [(path, *each) for path, all_ in found.items() for each in all_ if each[1] > FUNCTION_LINES] == []
