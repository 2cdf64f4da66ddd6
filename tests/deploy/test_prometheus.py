"""The files for Prometheus and Grafana: promtool accepts them, each alert has a test, each metric and label exists."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from docs.generate.metrics import of_protocols
from zbridge.metrics.families import FAMILIES, Family

SHIPPED = Path(__file__).parents[2] / "deploy" / "prometheus"
ALERTS: list[dict[str, Any]] = yaml.safe_load((SHIPPED / "alerts.yml").read_text())["groups"][0]["rules"]
ALERT_QUERIES: list[str] = [alert["expr"] for alert in ALERTS]
DASHBOARD: dict[str, Any] = json.loads((SHIPPED / "dashboard.json").read_text())
PANEL_QUERIES: list[str] = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
KNOWN: dict[str, Family] = {family.full_name: family for family in (*FAMILIES.values(), *of_protocols())}
OF_PROMETHEUS = {"realm", "robot", "le", "job", "instance"}


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed: Debian's package prometheus")
@pytest.mark.parametrize(
    "command", ["check rules alerts.yml", "check config prometheus.yml", "test rules alerts_test.yml"]
)
def test_promtool_accepts_the_configuration_and_the_alerts_and_each_of_them_fires(command: str) -> None:
    ran = subprocess.run(["promtool", *command.split()], cwd=SHIPPED, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_each_alert_has_a_test_in_which_it_fires_and_says_what_to_do() -> None:
    fired = set(re.findall(r'\{alertname="(\w+)"', (SHIPPED / "alerts_test.yml").read_text()))
    assert fired == {alert["alert"] for alert in ALERTS}
    for alert in ALERTS:
        assert set(alert["annotations"]) == {"summary", "description"}
        assert alert["labels"]["severity"] in ("critical", "warning")


def test_the_dashboard_is_what_its_program_writes() -> None:
    command = [sys.executable, str(SHIPPED / "dashboard.py"), "--check"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("query", [*ALERT_QUERIES, *PANEL_QUERIES])
def test_each_metric_and_label_of_a_query_exists(query: str) -> None:
    assert list(unknown(query)) == []


def unknown(query: str) -> Iterator[str]:
    """Give the metrics of a query that zbridge does not have, and the labels that they do not have."""
    found = set(re.findall(r"\b(?:zbridge|process)_\w+", query))
    names = {name.removesuffix("_bucket") for name in found}
    yield from names - set(KNOWN)
    labels = OF_PROMETHEUS.union(*(KNOWN[name].labels for name in names & set(KNOWN)))
    used = {label.strip() for listed in re.findall(r"\bby \(([^)]+)\)", query) for label in listed.split(",")}
    used |= {label for braces in re.findall(r"\{([^}]+)\}", query) for label in re.findall(r"(\w+)(?==~?\")", braces)}
    yield from used - labels


def test_a_metric_or_label_that_does_not_exist_is_found() -> None:
    assert list(unknown('sum by (realm, cause) (rate(zbridge_stops_total{robot="r1"}[5m]))')) == []
    assert list(unknown("zbridge_stop_total")) == ["zbridge_stop_total"]
    assert list(unknown('zbridge_stops_total{kind="x"}')) == ["kind"]
    assert list(unknown("sum by (code) (zbridge_stops_total)")) == ["code"]


def test_panels_have_a_place_of_their_own_and_a_help() -> None:
    taken = set()
    for panel in DASHBOARD["panels"]:
        assert panel["description"], panel["title"]
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert not cells & taken, panel["title"]
        assert all(x < 24 for x, _ in cells)
        taken |= cells
