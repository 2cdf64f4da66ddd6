"""The table of who may do what: the page shows it, what must always hold, and the router's rules made of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zenoh

from tests.access import COLUMNS, LAB, OTHER, OWN, REALM, granted_by_the_code, table
from zbridge.security.access import (
    GRANTS,
    MESSAGE_BYTES,
    STOPS_HZ,
    Keys,
    MessageKind,
    access_control,
    column,
    downsampling,
    expressions,
    granted,
    low_pass_filter,
)
from zbridge.security.roles import OF_ROBOTS, ROLES, Member, Roles

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "roles.md").read_text()
RULES = access_control(LAB, REALM)
INGRESS = [rule for rule in RULES["rules"] if rule["flows"] == ["ingress"]]
EGRESS = [rule for rule in RULES["rules"] if rule["flows"] == ["egress"]]


def test_the_page_shows_the_table() -> None:
    assert table(granted_by_the_code()) in PAGE


def test_every_role_has_its_grants() -> None:
    assert set(GRANTS) == {*ROLES, "gateway with listeners"} == set(COLUMNS)
    assert {column(Member(role)) for role in ROLES} == set(ROLES)


def test_nobody_but_a_router_deletes_and_every_person_may_stop() -> None:
    allowed = granted_by_the_code()
    assert {each.column for each in allowed if each.kind is MessageKind.DELETE} == {"router"}
    stops = {(each.column, each.robot) for each in allowed if each.path == "@cmd/stop" and each.kind is MessageKind.PUT}
    for role in ("viewer", "operator", "supervisor"):
        assert {(role, OWN), (role, OTHER)} <= stops
    assert {"gateway", "recorder"} & {role for role, _ in stops} == set()


@pytest.mark.parametrize("role", OF_ROBOTS)
def test_who_names_robots_gets_nothing_of_others_but_a_gateway_asks_them_for_the_fleets_stops(role: str) -> None:
    of_others = {
        (each.path, each.kind) for each in granted_by_the_code() if each.column == role and each.robot == OTHER
    }
    assert of_others == ({("@rpc/latch", MessageKind.QUERY)} if role == "gateway" else set())


def test_expressions_are_of_the_realm_the_name_and_the_robots() -> None:
    of_hq = granted("h1", Member("hq", ("r1", "r2")), "lab")
    assert of_hq[MessageKind.TOKEN,] == (
        "lab/r1/@alive/operator.h1.$*",
        "lab/r2/@alive/operator.h1.$*",
        "lab/r1/@alive/hq.h1.$*",
        "lab/r2/@alive/hq.h1.$*",
    )
    of_viewer = granted("v1", Member("viewer"), "lab")
    assert of_viewer[MessageKind.SUBSCRIBE, MessageKind.QUERY] == ("lab/**", "lab/*/@gateway/*")


def test_zenoh_takes_the_rules() -> None:
    config = zenoh.Config()
    config.insert_json5("access_control", json.dumps(RULES))
    config.insert_json5("low_pass_filter", json.dumps(low_pass_filter(REALM)))
    config.insert_json5("downsampling", json.dumps(downsampling(LAB, REALM)))


def test_all_is_denied_that_no_rule_allows_and_no_rule_denies() -> None:
    assert RULES["enabled"]
    assert RULES["default_permission"] == "deny"
    assert {rule["permission"] for rule in RULES["rules"]} == {"allow"}
    assert len({rule["id"] for rule in RULES["rules"]}) == len(RULES["rules"])


def test_one_egress_rule_for_all_members_passes_whatever_an_ingress_rule_passes() -> None:
    (egress,) = EGRESS
    assert egress["messages"] == [kind.value for kind in MessageKind]
    wide = [zenoh.KeyExpr(each) for each in egress["key_exprs"]]
    for rule in INGRESS:
        for key_expr in rule["key_exprs"]:
            assert any(each.includes(zenoh.KeyExpr(key_expr)) for each in wide), key_expr
    for policy in RULES["policies"]:
        assert egress["id"] in policy["rules"]


def test_each_member_is_known_by_the_common_name_of_its_certificate_and_has_rules_of_its_own() -> None:
    names = {LAB.common_name(name) for name in LAB.names}
    assert {subject["id"]: subject["cert_common_names"] for subject in RULES["subjects"]} == {
        name: [name] for name in names
    }
    assert [policy["subjects"] for policy in RULES["policies"]] == [[LAB.common_name(name)] for name in LAB.names]
    assert {rule for policy in RULES["policies"] for rule in policy["rules"]} == {rule["id"] for rule in RULES["rules"]}


def test_members_of_a_role_share_what_does_not_name_them() -> None:
    def count(viewers: int) -> int:
        roles = Roles({f"v{number}": Member("viewer") for number in range(viewers)})
        return len(access_control(roles, REALM)["rules"])

    assert count(1) == 1 + 4
    assert count(100) == 1 + 3 + 100  # whoami and what goes with it: one each


def test_rates_are_for_stops_and_for_one_robot_each() -> None:
    (rate,) = downsampling(LAB, REALM)
    assert (rate["flows"], rate["messages"]) == (["ingress"], ["put"])
    assert rate["rules"] == [{"key_expr": "fleet/r1/@cmd/stop", "freq": STOPS_HZ}]
    assert downsampling(Roles(), REALM) == []


def test_every_key_has_a_bound() -> None:
    bounds = {each["size_limit"]: each for each in low_pass_filter(REALM)}
    assert bounds[MESSAGE_BYTES]["key_exprs"] == list(expressions(Keys.EVERYTHING, REALM, "", ()))
    assert bounds[MESSAGE_BYTES]["messages"] == ["put", "delete", "query", "reply"]
    assert "**/@cmd/stop" in bounds[256]["key_exprs"]
    assert "reply" not in bounds[1024]["messages"]  # a map answers a query on a small key
    assert all(each["flows"] == ["ingress"] for each in bounds.values())
