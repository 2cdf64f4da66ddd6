"""Break statements of the source at random, one at a time, and count how many the unit tests catch.

    python -m tests.mutation --count 60 --seed 13 --out before.json
    python -m tests.mutation --again before.json --out after.json

A mutation is recorded as path, function and statement text, not as a line number, so that `--again` finds the same
mutation after files were moved. The sampler works on a copy of the tree. Conformance kits and texts of the command
line are not mutated. End-to-end tests are not run.
"""

import argparse
import ast
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
SOURCES = ("zbridge", "gateways")
SKIPPED = re.compile(r"/conformance/|zbridge/cli/|__main__|/__init__\.py$")
QUIET_CALLS = re.compile(r"(self\.)?_?(log|logger)\.|super\(\)")
LIMIT_S = 240.0

FLIPPED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
SWAPPED_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Add,
    ast.FloorDiv: ast.Mult,
    ast.Div: ast.Mult,
}


def statements(tree: ast.AST, qualname: str = "") -> Iterator[tuple[str, ast.stmt]]:
    """Yield every statement inside a function with the function's qualified name."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            name = f"{qualname}.{child.name}".lstrip(".")
            if child.name != "__repr__":
                yield from statements(child, name)
        else:
            if isinstance(child, ast.stmt) and qualname:
                yield qualname, child
            yield from statements(child, qualname)


def expressions(statement: ast.stmt) -> Iterator[ast.AST]:
    """Yield the expressions of a statement itself, not those of the statements nested in its body."""
    for child in ast.iter_child_nodes(statement):
        if not isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield from ast.walk(child)


def mutations(statement: ast.stmt) -> list[tuple[str, Callable[[], ast.stmt | None]]]:
    """Return (kind, action) of every mutation of one statement.

    An action returns what replaces the statement, or None if it changed the statement in place.
    """
    found: list[tuple[str, Callable[[], ast.stmt | None]]] = []
    text = ast.unparse(statement)
    if isinstance(statement, ast.Expr):
        if isinstance(statement.value, ast.Constant) or QUIET_CALLS.match(text):
            return []
        found.append(("drop", lambda: ast.Pass()))
    if isinstance(statement, ast.Assign | ast.AugAssign) and "self." in text.split("=")[0]:
        found.append(("drop", lambda: ast.Pass()))
    if isinstance(statement, ast.Return) and statement.value is not None:
        found.append(("return None", lambda: ast.Return(value=ast.Constant(None))))
    if isinstance(statement, ast.Raise):
        return [("drop", lambda: ast.Pass())]
    if isinstance(statement, ast.If | ast.While):
        found.append(("negate", lambda: setattr(statement, "test", ast.UnaryOp(ast.Not(), statement.test))))
    return found + [one for node in expressions(statement) for one in _of_expression(node)]


def _of_expression(node: ast.AST) -> list[tuple[str, Callable[[], None]]]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in FLIPPED:
        return [("flip", lambda: node.ops.__setitem__(0, FLIPPED[type(node.ops[0])]()))]
    if isinstance(node, ast.BinOp) and type(node.op) in SWAPPED_OPERATORS:
        return [("operator", lambda: setattr(node, "op", SWAPPED_OPERATORS[type(node.op)]()))]
    if isinstance(node, ast.BoolOp):
        other = ast.Or if isinstance(node.op, ast.And) else ast.And
        return [("and/or", lambda: setattr(node, "op", other()))]
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        return [("constant", lambda: setattr(node, "value", not node.value))]
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return [("constant", lambda: setattr(node, "value", node.value + 1))]  # type: ignore[operator]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return [("no not", lambda: setattr(node, "operand", ast.UnaryOp(ast.Not(), node.operand)))]
    if isinstance(node, ast.Call) and len(node.args) > 1 and ast.dump(node.args[0]) != ast.dump(node.args[1]):
        return [("swap", lambda: node.args.__setitem__(slice(0, 2), node.args[1::-1]))]
    return []


def candidates(paths: list[str]) -> list[dict[str, Any]]:
    """List every (path, function, statement) that has a mutation, each named by what it says and its occurrence."""
    found = []
    for path in sorted(p for source in SOURCES for p in (ROOT / source).rglob("*.py")):
        name = str(path.relative_to(ROOT))
        if SKIPPED.search(name) or (paths and not any(name.startswith(p) for p in paths)):
            continue
        seen: Counter[tuple[str, str]] = Counter()
        for qualname, statement in statements(ast.parse(path.read_text())):
            text = ast.unparse(statement).splitlines()[0]
            occurrence = seen[qualname, text]
            seen[qualname, text] += 1
            if mutations(statement):
                found.append({"path": name, "function": qualname, "statement": text, "occurrence": occurrence})
    return found


def sample(count: int, seed: int, paths: list[str]) -> list[dict[str, Any]]:
    chance = random.Random(seed)
    chosen = chance.sample(candidates(paths), count)
    return [{**one, "choice": chance.random()} for one in chosen]


def locate(wanted: dict[str, Any], known: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Find a recorded mutation in the present tree: same text, and the more of function and path agree the better."""

    def likeness(one: dict[str, Any]) -> tuple[bool, ...]:
        last = one["function"].split(".")[-1] == wanted["function"].split(".")[-1]
        same = tuple(one[key] == wanted[key] for key in ("path", "function", "occurrence"))
        return (all(same), last, *same)

    alike = [one for one in known if one["statement"] == wanted["statement"]]
    return max(alike, key=likeness, default=None)


def mutated(source: str, where: dict[str, Any]) -> tuple[str, str, str]:
    """Return the mutated module, the kind of mutation and the first line of the statement as it became."""
    tree = ast.parse(source)
    seen = 0
    for qualname, statement in statements(tree):
        if (qualname, ast.unparse(statement).splitlines()[0]) != (where["function"], where["statement"]):
            continue
        if seen == where["occurrence"]:
            break
        seen += 1
    else:
        raise LookupError(where)
    choices = mutations(statement)
    kind, act = choices[int(where["choice"] * len(choices))]
    new = act()
    if new is not None:
        for parent in ast.walk(tree):
            for _, field in ast.iter_fields(parent):
                if isinstance(field, list) and statement in field:
                    field[field.index(statement)] = ast.copy_location(new, statement)
    text = ast.unparse(ast.fix_missing_locations(tree))
    return text, kind, ast.unparse(new or statement).splitlines()[0]


def tests_for(path: str, tree: Path) -> list[str]:
    """List the tests that concern a source file: its own first, then its folder's, then those that import it."""
    parts = Path(path).with_suffix("").parts
    folder = Path("tests", *(parts[1:-1] if parts[0] == "zbridge" else parts[:-1]))
    while not (tree / folder).is_dir():  # a module that became a package is tested where it was
        folder = folder.parent
    own = folder / f"test_{parts[-1]}.py"
    dotted = re.compile(
        rf"{re.escape('.'.join(parts))}\b|from {re.escape('.'.join(parts[:-1]))} import .*\b{parts[-1]}\b"
    )
    importers = [
        test.relative_to(tree)
        for test in sorted((tree / "tests").rglob("test_*.py"))
        if not {"e2e", "benchmarks"} & set(test.parts) and dotted.search(test.read_text())
    ]
    beside = sorted(test.relative_to(tree) for test in (tree / folder).rglob("test_*.py")) if len(parts) > 2 else []
    shared = [Path("tests/conformance")] if parts[0] == "gateways" or parts[1] == "wire" else []
    ordered = dict.fromkeys(str(test) for test in [own, *shared, *beside, *importers])
    return [test for test in ordered if (tree / test).exists()]


def run(tree: Path, tests: list[str]) -> tuple[str, str]:
    """Run the tests in a copy of the tree; return ("caught" | "survived", the failing test)."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        command, cwd=tree, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "caught", f"no end within {LIMIT_S:.0f} s"
    if process.returncode == 0:
        return "survived", ""
    if process.returncode > 2:  # neither failed nor broken on import
        raise RuntimeError(output)
    failing = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return "caught", failing[1] if failing else output[-300:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--paths", nargs="*", default=[], help="only source files whose path begins so")
    parser.add_argument("--again", type=Path, help="repeat the mutations of this result")
    parser.add_argument("--out", type=Path, default=Path("mutation.json"))
    options = parser.parse_args()
    wanted = (
        json.loads(options.again.read_text()) if options.again else sample(options.count, options.seed, options.paths)
    )
    known, results = candidates([]), []
    with tempfile.TemporaryDirectory() as place:
        tree = Path(place, "tree")
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git", "__pycache__", ".*_cache", ".venv", "*.json"))
        for number, one in enumerate(wanted):
            found = locate(one, known)
            result = {key: one[key] for key in ("path", "function", "statement", "occurrence", "choice")}
            started = time.monotonic()
            if found is None:
                result |= {"result": "gone"}
            else:
                target = tree / found["path"]
                source = target.read_text()
                text, kind, now = mutated(source, {**found, "choice": one["choice"]})
                target.write_text(text)
                outcome, by = run(tree, tests_for(found["path"], tree))
                target.write_text(source)
                result |= {"now_in": found["path"], "kind": kind, "mutated": now, "result": outcome, "by": by}
            results.append(result | {"seconds": round(time.monotonic() - started, 1)})
            options.out.write_text(json.dumps(results, indent=1))
            print(number + 1, result["result"], result["path"], result["function"], result.get("mutated"), flush=True)
    print(Counter(one["result"] for one in results))
    for one in results:
        if one["result"] == "survived":
            print(f"  {one['path']} {one['function']}: {one['statement']}  ->  {one['mutated']} ({one['kind']})")


if __name__ == "__main__":
    main()
