"""Makes a failing scenario smaller, for as long as the same rule is broken."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

from tests.simulated.scenario import run

MOST_RUNS = 150


def shrink(scenario: dict[str, Any], rules: set[str], most_runs: int = MOST_RUNS) -> dict[str, Any]:
    """Return the smallest scenario found that breaks one of these rules."""
    best, runs = copy.deepcopy(scenario), 0
    improved = True
    while improved and runs < most_runs:
        improved = False
        for smaller in _smaller(best):
            runs += 1
            if runs > most_runs:
                break
            if run(smaller).rules & rules:
                best, improved = smaller, True
                break
    return best


def _smaller(scenario: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Give scenarios with fewer steps: halves first, then single ones; then less of everything else."""
    steps = scenario["steps"]
    size = len(steps) // 2
    while size >= 1:
        for start in range(0, len(steps), size):
            rest = steps[:start] + steps[start + size :]
            yield {**scenario, "steps": copy.deepcopy(rest)}
        size //= 2
    for kind in ("programs", "gateways", "drivers"):
        for number in range(len(scenario.get(kind, [])) - 1, 0 if kind != "programs" else -1, -1):
            name = scenario[kind][number]["name"]
            rest = [each for each in scenario[kind] if each["name"] != name]
            yield {**scenario, kind: rest, "steps": [step for step in steps if step.get("target") != name]}
    last = max([step["t"] for step in steps], default=2.0)
    if last + 3.0 < scenario["seconds"] - 1.0:
        yield {**scenario, "seconds": round(last + 3.0, 1)}
