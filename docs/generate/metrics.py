"""The tables of metrics: those of the core from their declaration, those of the protocols from where they count."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from docs.generate.declared import members, table
from zbridge.control.events import StopCause
from zbridge.metrics.families import GROUPS, Family, MetricKind
from zbridge.protocol.plugin import protocol_names

GATEWAYS = Path(__file__).parents[2] / "gateways"


def sections() -> dict[str, str]:
    """Write a table for each group of metrics."""
    parts = {f"metrics: {group}": _rows(families) for group, families in GROUPS.items()}
    causes = table(("cause", "meaning"), [(f"`{cause}`", text.rstrip(".")) for cause, text in members(StopCause)])
    return parts | {"metrics: Protocols": _rows(tuple(of_protocols())), "metrics: causes of stops": causes}


def of_protocols() -> Iterator[Family]:
    """Find the counters of the protocols in their source."""
    for protocol in sorted(protocol_names()):
        for path in sorted((GATEWAYS / protocol).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "count":
                    texts = [keyword.value for keyword in node.keywords if keyword.arg == "help"]
                    labels = tuple(str(keyword.arg) for keyword in node.keywords if keyword.arg != "help")
                    if texts:
                        yield Family(_text(node.args[0]), MetricKind.COUNTER, _text(texts[0]), labels)


def _rows(families: tuple[Family, ...]) -> str:
    rows = [
        (
            f"`{family.full_name}`",
            family.kind.value,
            ", ".join(f"`{label}`" for label in family.labels) or "-",
            family.help.rstrip("."),
        )
        for family in families
    ]
    return table(("metric", "type", "labels", "meaning"), rows)


def _text(node: ast.expr) -> str:
    assert isinstance(node, ast.Constant)
    return str(node.value)
