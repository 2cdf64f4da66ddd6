"""The Prometheus text format, version 0.0.4: of one process, or of all processes of a host.

Each process writes the lines of its own metrics. A supervisor only puts those of many processes together, so that each
metric stands once, with its help and type.
Source: https://prometheus.io/docs/instrumenting/exposition_formats/
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import msgspec

from zbridge.metrics.families import Family, MetricKind
from zbridge.metrics.values import BOUNDS_S, Labels, Value

FAMILIES_MOST = 512
"""Most metrics of one process."""
_NAME = re.compile(r"[a-zA-Z_][a-zA-Z0-9_]*")
_KINDS = {kind.value for kind in MetricKind}
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class FamilyLines(msgspec.Struct, frozen=True, array_like=True):
    """One metric of one process. name: the full one. lines: one a series, or several of a histogram."""

    name: str
    kind: str
    help: str
    lines: str


class InvalidMetrics(ValueError):
    """What another process says of its metrics is none of the text format."""


def checked(families: list[FamilyLines]) -> list[FamilyLines]:
    """Return the metrics of another process; raise InvalidMetrics if they would spoil those of all others."""
    if len(families) > FAMILIES_MOST:
        raise InvalidMetrics(f"{len(families)} metrics exceed {FAMILIES_MOST}")
    for family in families:
        named = _NAME.fullmatch(family.name) and family.kind in _KINDS
        if not named or not all(line.startswith(family.name) for line in family.lines.splitlines()):
            raise InvalidMetrics(f"{family.name[:80]!r} is not in the text format")
    return families


def written(metrics: Iterable[tuple[Family, list[tuple[Labels, Value]]]]) -> list[FamilyLines]:
    """Write what :meth:`Metrics.read` returns."""
    return [
        FamilyLines(family.full_name, family.kind.value, family.help, _lines(family, values))
        for family, values in metrics
    ]


def text(processes: Iterable[Iterable[FamilyLines]]) -> str:
    """Put the metrics of processes together, each metric once. A metric of another type than the first is left out."""
    first: dict[str, FamilyLines] = {}
    lines: dict[str, list[str]] = {}
    for families in processes:
        for family in families:
            if first.setdefault(family.name, family).kind == family.kind:
                lines.setdefault(family.name, []).append(family.lines)
    return "".join(
        f"# HELP {name} {_escaped(first[name].help)}\n# TYPE {name} {first[name].kind}\n{''.join(lines[name])}"
        for name in sorted(lines)
    )


def _lines(family: Family, values: list[tuple[Labels, Value]]) -> str:
    name = family.full_name
    if family.kind is MetricKind.HISTOGRAM:
        return "".join(_buckets(name, labels, value) for labels, value in values if isinstance(value, tuple))
    return "".join(f"{name}{_shown(labels)} {value}\n" for labels, value in values)


_LE = (*(f"{bound:g}" for bound in BOUNDS_S), "+Inf")


def _buckets(name: str, labels: Labels, value: tuple[tuple[int, ...], float]) -> str:
    counts, sum_s = value
    inner = _inner(labels)
    begin = f'{name}_bucket{{{inner}{"," if inner else ""}le="'
    lines, so_far = [], 0
    for bound, count in zip(_LE, counts, strict=True):
        so_far += count
        lines.append(f'{begin}{bound}"}} {so_far}\n')
    shown = f"{{{inner}}}" if inner else ""
    return "".join([*lines, f"{name}_sum{shown} {sum_s}\n", f"{name}_count{shown} {so_far}\n"])


def _shown(labels: Labels) -> str:
    return f"{{{_inner(labels)}}}" if labels else ""


def _inner(labels: Labels) -> str:
    return ",".join(f'{key}="{_quoted(value)}"' for key, value in labels)


def _quoted(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _escaped(help_text: str) -> str:
    return help_text.replace("\\", r"\\").replace("\n", r"\n")
