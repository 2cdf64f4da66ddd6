"""The events of the log: what each call of a :class:`zbridge.log.Log` says of itself."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from docs.generate.declared import table

ROOT = Path(__file__).parents[2]
LEVELS = ("debug", "info", "warning", "error", "critical")
METHODS = {level: level for level in LEVELS} | {"exception": "error", "log": "", "record": ""}
_NAMES = re.compile(r"_?log")
_CALLED = re.compile(r"\b_?log\s*\.")


@dataclass(frozen=True)
class LogCall:
    """One call: where, the logger, the event's code, level and template, and the names of its fields."""

    place: str
    logger: str
    event: str | None
    level: str
    template: str | None
    fields: frozenset[str]


@cache
def log_calls() -> tuple[LogCall, ...]:
    """Give every call of a logger in the source."""
    paths = (path for top in ("zbridge", "gateways") for path in sorted((ROOT / top).rglob("*.py")))
    sources = ((path.relative_to(ROOT).as_posix(), path.read_text()) for path in paths)
    return tuple(call for path, source in sources if path != "zbridge/log.py" for call in calls_of(path, source))


def calls_of(path: str, source: str) -> Iterator[LogCall]:
    """Give the calls of one module."""
    if _CALLED.search(source) is None:
        return
    tree = ast.parse(source)
    module = path.removesuffix(".py").replace("/", ".")
    logger = next(
        (_logger(node, module) for node in tree.body if _logger(node, module)), "gateways.<protocol>.simulator"
    )
    nodes = list(ast.walk(tree))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and _is_log(node.func):
            around = [each for each in functions if each.lineno <= node.lineno <= (each.end_lineno or 0)]
            yield _call(f"{path}:{node.lineno}", logger, node, node.func.attr, around[-1] if around else None)


def _is_log(function: ast.Attribute) -> bool:
    owner = function.value
    name = owner.id if isinstance(owner, ast.Name) else owner.attr if isinstance(owner, ast.Attribute) else ""
    return function.attr in METHODS and _NAMES.fullmatch(name) is not None


def _logger(node: ast.stmt, module: str) -> str:
    """Return the name of the logger that a statement of a module makes, if it does."""
    if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "Log":
        return ast.unparse(node.value.args[0]).strip("'").replace("__name__", module)
    return ""


def _call(place: str, logger: str, call: ast.Call, method: str, around: ast.AST | None) -> LogCall:
    arguments, level = list(call.args), METHODS[method]
    if not level:
        named = re.findall(r"logging\.([A-Z]+)", _resolved(arguments.pop(0), around))
        level = " or ".join(sorted(map(str.lower, named), key=LEVELS.index)) or "varies"
    event, template = (ast.literal_eval(each) if isinstance(each, ast.Constant) else None for each in arguments[:1] * 2)
    if len(arguments) > 1:
        text = _resolved(arguments[1], around)
        template = ast.literal_eval(text) if text[:1] in "'\"" else None
    fields = frozenset(each.arg or "**" for each in call.keywords) - {"exc_info"}
    return LogCall(place, logger, event, level, template, fields)


def _resolved(value: ast.expr, around: ast.AST | None) -> str:
    """Write an expression; a variable as what was assigned to it last before, in the function around."""
    if isinstance(value, ast.Name) and around is not None:
        before = [
            node
            for node in ast.walk(around)
            if isinstance(node, ast.Assign)
            and node.lineno < value.lineno
            and value.id in map(ast.unparse, node.targets)
        ]
        if before:
            return ast.unparse(max(before, key=lambda node: node.lineno).value)
    return ast.unparse(value)


def sections() -> dict[str, str]:
    """Return the generated part of the page by its name."""
    rows = {(call.event, call.level, call.logger, f"`{call.template}`") for call in log_calls() if call.event}
    ordered = sorted((f"`{event}`", level, f"`{logger}`", text) for event, level, logger, text in rows)
    return {"log events": table(("event", "level", "logger", "sentence"), ordered)}
