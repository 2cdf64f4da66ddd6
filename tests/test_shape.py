"""Files and functions end where their subject ends, a class has a name of its own, and tests use what is public."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILE_LINES, FUNCTION_LINES = 400, 40
"""Most lines of a file, and of a function's body."""
METHODS = 25
"""Most methods of a class."""
MORE_METHODS = {"Session"}
"""Classes with more: what all protocols override."""
PRIVATE = 27
"""Most private attributes of the product that tests touch; make it smaller where you can."""
MIRRORED = {"ControlFeed", "Driver", "Feed", "Fleet", "Robot", "StateFeed"}
"""The blocking form of a class of the client has its name."""
SHARED = {"Device", "Odometry", "Reading", "Session"}
"""Names that two classes still share. ROS's message Odometry and ours are one idea; no new name belongs here."""
WHITE_BOX = ("tests/search/", "tests/simulated/", "tests/e2e/rigs/", "tests/e2e/measured/", "tests/benchmarks/")
"""These copy and name whole states of machines, or have private attributes of their own."""
FILES = sorted(
    path.relative_to(ROOT).as_posix() for top in ("zbridge", "gateways") for path in (ROOT / top).rglob("*.py")
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


def test_no_class_has_too_many_methods() -> None:
    trees = [ast.parse((ROOT / path).read_text()) for path in FILES]
    methods = {
        node.name: sum(isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef) for each in node.body)
        for tree in trees
        for node in tree.body
        if isinstance(node, ast.ClassDef)
    }
    assert {name for name, count in methods.items() if count > METHODS} <= MORE_METHODS


def test_a_class_has_a_name_of_its_own() -> None:
    trees = [ast.parse((ROOT / path).read_text()) for path in FILES]
    names = Counter(node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef))
    assert {name for name, count in names.items() if count > 1 and name[0] != "_"} <= MIRRORED | SHARED


def private_attributes(source: str) -> Iterator[str]:
    """Give the private attributes that code touches of something that is not itself."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr):
            if isinstance(node.value, ast.Name) and node.value.id in ("self", "cls", "os"):
                continue
            if not ast.unparse(node.value).startswith("super()"):
                yield node.attr


def test_tests_touch_few_private_attributes_of_the_product() -> None:
    words = {word for path in FILES for word in re.findall(r"\b_[a-z]\w*", (ROOT / path).read_text())}
    touched = [
        (path.relative_to(ROOT).as_posix(), attribute)
        for path in sorted((ROOT / "tests").rglob("*.py"))
        if not path.relative_to(ROOT).as_posix().startswith(WHITE_BOX)
        for attribute in private_attributes(path.read_text())
        if attribute in words
    ]
    assert len(touched) <= PRIVATE, touched
