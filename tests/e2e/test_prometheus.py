"""The dashboard and the alerts, with a real Prometheus that scrapes a real fleet: every query has an answer."""

from __future__ import annotations

import math
import re
import time
from typing import Any

import pytest

from tests.e2e.conftest import Bench
from tests.e2e.rigs.monitored import PROMETHEUS, MonitoredFleet, Prometheus, dashboard

pytestmark = [
    pytest.mark.pages,  # ten seconds, of which Prometheus takes five to begin
    pytest.mark.skipif(PROMETHEUS is None, reason="prometheus is not installed: Debian's package"),
]
DRIVEN_S, STOPPED_S = 3.0, 2.0


def test_every_query_of_the_dashboard_has_an_answer_and_every_alert_can_be_computed(bench: Bench) -> None:
    began, fleet = time.monotonic(), MonitoredFleet(bench)
    fleet.prometheus.scraped(1)  # before anything happens: only from then on an increase is seen
    fleet.show_to_hq_program()
    fleet.bench.fleet.hold("r1")
    fleet.driven |= {"r1", "v1"}  # the second one refuses: nobody holds it
    time.sleep(DRIVEN_S)
    fleet.bench.fleet.put("r1/@cmd/stop")
    time.sleep(STOPPED_S)
    shown, seconds = dashboard(), time.monotonic() - began
    for panel in shown["panels"]:
        for target in panel["targets"]:
            assert answered(fleet.prometheus, target, seconds), (panel["title"], target["expr"])
    for variable in shown["templating"]["list"][1:]:
        metric, label = re.fullmatch(r"label_values\((.+), (\w+)\)", variable["query"]).groups()
        assert fleet.prometheus.query(f"count by ({label}) ({metric})"), variable["name"]
    (group,) = fleet.prometheus.ask("rules")["groups"]
    assert [rule["name"] for rule in group["rules"] if rule["health"] != "ok" or rule["state"] == "firing"] == []


def answered(prometheus: Prometheus, target: dict[str, Any], seconds: float) -> bool:
    """Whether a query gives a number: now for a table, else in the last seconds."""
    if target.get("instant"):
        return bool(prometheus.query(target["expr"]))
    found = prometheus.history(target["expr"], seconds)
    return any(math.isfinite(float(value)) for series in found for _, value in series["values"])
