"""The tables of the handshake in the documentation are those that are executed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gateways.tcpudp.session import hq_role, robot_role

PAGE = (Path(__file__).parents[3] / "docs/reference/protocols/tcpudp.md").read_text()


def rendered(table: Mapping[Any, Mapping[Any, tuple[Any, Any]]]) -> str:
    """The table in Markdown: the texts of steps and events, the first line of each action's docstring."""
    lines = ["| step | when | the gateway | next |", "|---|---|---|---|"]
    for step, row in table.items():
        for event, (action, following) in row.items():
            does = action.__doc__.splitlines()[0]
            lines.append(f"| {step.name}: {step.value} | {event.value} | {does} | {following.name} |")
    lines += [f"| {step.name}: {step.value} | | | |" for step, row in table.items() if not row]
    return "\n".join(lines)


@pytest.mark.parametrize("module", [hq_role, robot_role])
def test_the_page_shows_the_table_that_is_executed(module: Any) -> None:
    assert rendered(module.TABLE) in PAGE, rendered(module.TABLE)
