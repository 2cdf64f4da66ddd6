"""The table of who may do what: the page shows it, and what must hold whatever stands in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.access import COLUMNS, OTHER, OWN, granted_by_the_code, table
from zbridge.security.access import GRANTS, NEEDED, Kind, column, granted
from zbridge.security.roles import OF_ROBOTS, ROLES, Member

PAGE = (Path(__file__).parents[2] / "docs" / "security.md").read_text()


def test_the_page_shows_the_table_and_what_each_command_needs() -> None:
    assert table(granted_by_the_code()) in PAGE
    for commands, role in NEEDED.items():
        assert f"| {commands} | {role} |" in PAGE


def test_every_role_has_its_grants() -> None:
    assert set(GRANTS) == {*ROLES, "gateway with listeners"} == set(COLUMNS)
    assert {column(Member(role)) for role in ROLES} == set(ROLES)


def test_nobody_but_a_router_deletes_and_every_person_may_stop() -> None:
    allowed = granted_by_the_code()
    assert {each.column for each in allowed if each.kind is Kind.DELETE} == {"router"}
    stops = {(each.column, each.robot) for each in allowed if each.path == "@cmd/stop" and each.kind is Kind.PUT}
    for role in ("viewer", "operator", "supervisor"):
        assert {(role, OWN), (role, OTHER)} <= stops
    assert {"gateway", "recorder"} & {role for role, _ in stops} == set()


@pytest.mark.parametrize("role", OF_ROBOTS)
def test_who_names_robots_gets_nothing_of_others_but_a_gateway_asks_them_for_the_fleets_stops(role: str) -> None:
    of_others = {
        (each.path, each.kind) for each in granted_by_the_code() if each.column == role and each.robot == OTHER
    }
    assert of_others == ({("@rpc/latch", Kind.QUERY)} if role == "gateway" else set())


def test_expressions_are_of_the_realm_the_name_and_the_robots() -> None:
    of_hq = granted("h1", Member("hq", ("r1", "r2")), "lab")
    assert of_hq[Kind.TOKEN,] == (
        "lab/r1/@alive/operator.h1.$*",
        "lab/r2/@alive/operator.h1.$*",
        "lab/r1/@alive/hq.h1.$*",
        "lab/r2/@alive/hq.h1.$*",
    )
    assert granted("v1", Member("viewer"), "lab")[Kind.SUBSCRIBE, Kind.QUERY] == ("lab/**",)
