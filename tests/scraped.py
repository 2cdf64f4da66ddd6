"""Reads what Prometheus would: the metrics of a process, parsed by the library of Prometheus itself."""

from __future__ import annotations

import urllib.request
from collections import Counter

from prometheus_client.parser import text_string_to_metric_families

Series = tuple[str, frozenset[tuple[str, str]]]
"""The name of a sample, and its labels."""


def samples(text: str) -> dict[Series, float]:
    """Parse the text format; every series stands once, and every metric has a help and a type."""
    found: dict[Series, float] = {}
    families = list(text_string_to_metric_families(text))
    assert len({family.name for family in families}) == len(families), "a metric stands twice"
    for family in families:
        assert family.documentation, f"{family.name} has no help"
        assert family.type != "unknown", f"{family.name} has no type"
        for sample in family.samples:
            series = (sample.name, frozenset(sample.labels.items()))
            assert series not in found, f"{series} stands twice"
            found[series] = sample.value
    return found


def totals(text: str) -> Counter[str]:
    """Sum each metric over its labels: ``{"refused": 3}`` for ``zbridge_refused_total``."""
    found = Counter[str]()
    for (name, _), value in samples(text).items():
        found[name.removeprefix("zbridge_").removesuffix("_total")] += int(value)
    return found


def value(text: str, name: str, **labels: str) -> float:
    """Sum the series of a metric that have these labels; KeyError if there is none."""
    matching = [
        number for (own, theirs), number in samples(text).items() if own == name and set(labels.items()) <= theirs
    ]
    if not matching:
        raise KeyError(f"{name} {labels}")
    return sum(matching)


def scrape(port: int, path: str = "/metrics", host: str = "127.0.0.1", timeout_s: float = 5.0) -> str:
    """Fetch a page of a metrics endpoint."""
    with urllib.request.urlopen(f"http://{host}:{port}{path}", timeout=timeout_s) as page:
        return page.read().decode()  # type: ignore[no-any-return]
