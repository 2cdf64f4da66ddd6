"""Writes the Grafana dashboard: ``python deploy/prometheus/dashboard.py``; ``--check`` only tells if it is out of date.

A panel is a row of :data:`PANELS`. Panels fill the dashboard from left to right, 24 columns wide. In a query, ``S`` in
braces selects the realms and robots that the reader chose. Panels of single robots show the ten with the largest value.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

FILE = Path(__file__).with_name("dashboard.json")
COLUMNS = 24
SELECTED = 'realm=~"$realm",robot=~"$robot"'
DATASOURCE = {"type": "prometheus", "uid": "${datasource}"}

Json = dict[str, Any]


class Panel(NamedTuple):
    """One panel. queries: by what the legend says of each series. width: in columns."""

    title: str
    help: str
    queries: dict[str, str]
    unit: str = "short"
    width: int = 8
    height: int = 8
    table: bool = False

    @property
    def expressions(self) -> list[str]:
        return [query.replace("{S", "{" + SELECTED) for query in self.queries.values()]


def _rate(name: str, *by: str, more: str = "", function: str = "rate") -> str:
    return f"sum by ({', '.join(by)}) ({function}({name}{{S{more}}}[$__rate_interval]))"


def _quantiles(name: str) -> dict[str, str]:
    rate = f"rate({name}_bucket{{S}}[$__rate_interval])"
    return {
        "p50": f"histogram_quantile(0.5, sum by (le) ({rate}))",
        "p99": f"histogram_quantile(0.99, sum by (le) ({rate}))",
        "p99 of {{robot}}": f"topk(3, histogram_quantile(0.99, sum by (realm, robot, le) ({rate})))",
    }


PANELS = (
    Panel(
        "Robots",
        "State, driver and lease of each robot, now. 1 is yes.",
        {
            "protocol": "max by (realm, robot, protocol) (zbridge_robot_info{S})",
            "state": "max by (realm, robot, state) (zbridge_robot_state{S} == 1)",
            "driven": "max by (realm, robot) (zbridge_robot_driven{S})",
            "lease": "max by (realm, robot) (zbridge_lease_held{S})",
            "latched stops": "max by (realm, robot) (zbridge_latches{S})",
            "link stalled": "max by (realm, robot) (zbridge_link_stalled{S})",
        },
        width=16,
        table=True,
    ),
    Panel(
        "Robots by state",
        "Robots in each state, and robots without a gateway that answers.",
        {"{{state}}": "sum by (state) (zbridge_robot_state{S})", "no gateway": "sum(1 - zbridge_gateway_up{S})"},
    ),
    Panel(
        "Gateways",
        "Gateways that answer, and gateways that were started in place of one that died.",
        {
            "up": "sum(zbridge_gateway_up{S})",
            "of": "count(zbridge_gateway_up{S})",
            "restarted": "sum(increase(zbridge_gateway_restarts_total{S}[$__rate_interval]))",
        },
    ),
    Panel(
        "Sessions",
        "Role hq: with robots. Role robot: with HQ programs.",
        {"{{role}} {{state}}": "sum by (role, state) (zbridge_sessions{S})"},
    ),
    Panel(
        "Connections to robots",
        "Connections that were established, failed before that, or were lost.",
        {"{{outcome}}": _rate("zbridge_robot_connections_total", "outcome", function="increase")},
    ),
    Panel(
        "Stops by cause",
        "Causes that stopped a robot in this interval.",
        {"{{robot}} {{cause}}": _rate("zbridge_stops_total", "robot", "cause", function="increase") + " > 0"},
    ),
    Panel(
        "Refusals by code",
        "Commands and queries that were refused, a second.",
        {"{{robot}} {{code}}": _rate("zbridge_refused_total", "robot", "code")},
        "ops",
    ),
    Panel(
        "Changes of the lease",
        "acquired, taken_over, released, ended.",
        {"{{change}}": _rate("zbridge_lease_changes_total", "change", function="increase")},
    ),
    Panel(
        "Messages on the bus",
        "out: published by gateways; in: commands that they received.",
        {"{{direction}} {{kind}}": _rate("zbridge_bus_messages_total", "direction", "kind")},
        "ops",
    ),
    Panel(
        "Bytes on the bus",
        "Payloads of these messages.",
        {"{{direction}} {{kind}}": _rate("zbridge_bus_bytes_total", "direction", "kind")},
        "Bps",
    ),
    Panel(
        "Links",
        "Bytes of robots (role hq) and of HQ programs (role robot).",
        {"{{role}} {{direction}}": _rate("zbridge_link_bytes_total", "role", "direction")},
        "Bps",
    ),
    Panel(
        "Drops and losses",
        "Messages that were dropped from a full queue, lost on the way, or could not be decoded, a second.",
        {
            "{{queue}}": _rate("zbridge_bus_dropped_total", "queue"),
            "to HQ programs": _rate("zbridge_hq_dropped_total"),
            "names": _rate("zbridge_names_dropped_total"),
            "gaps of ALF": _rate("zbridge_sequence_gaps_total"),
            "commands lost": _rate("zbridge_commands_lost_total"),
            "malformed": _rate("zbridge_malformed_frames_total"),
        },
        "ops",
    ),
    Panel(
        "Queues",
        "The longest queues of single robots.",
        {"{{robot}} {{queue}}": "topk(10, max by (realm, robot, queue) (zbridge_queue_length{S}))"},
    ),
    Panel(
        "Event loop: lateness",
        "Delay of timers. A late event loop delays everything, stops too.",
        _quantiles("zbridge_event_loop_lateness_seconds"),
        "s",
    ),
    Panel(
        "From the robot's socket to the bus",
        "Of 20 reads a second of each robot at most.",
        _quantiles("zbridge_socket_to_bus_seconds"),
        "s",
        width=12,
    ),
    Panel(
        "From the bus to the robot's socket",
        "Commands, until they are written to the robot or refused.",
        _quantiles("zbridge_bus_to_socket_seconds"),
        "s",
        width=12,
    ),
    Panel(
        "Processor",
        "Of one core. A process without a robot is a supervisor, or serves several robots.",
        {"{{robot}} at {{instance}}": f"topk(10, {_rate('process_cpu_seconds_total', 'instance', 'realm', 'robot')})"},
        "percentunit",
    ),
    Panel(
        "Memory",
        "Resident memory; processes share some of it.",
        {"{{robot}} at {{instance}}": "topk(10, process_resident_memory_bytes{S})"},
        "bytes",
    ),
    Panel(
        "Versions",
        "Gateways of each version.",
        {"gateways": "count by (version, python, zenoh) (zbridge_build_info{S})"},
        table=True,
    ),
)


def panel(number: int, shown: Panel, place: Json) -> Json:
    """Write a panel. number: its id."""
    targets = [
        {"refId": chr(ord("A") + index), "datasource": DATASOURCE, "expr": expression}
        | ({"format": "table", "instant": True} if shown.table else {"legendFormat": legend, "range": True})
        for index, (legend, expression) in enumerate(zip(shown.queries, shown.expressions, strict=True))
    ]
    return {
        "id": number,
        "type": "table" if shown.table else "timeseries",
        "title": shown.title,
        "description": shown.help,
        "gridPos": place,
        "datasource": DATASOURCE,
        "fieldConfig": {"defaults": {"unit": shown.unit} | ({} if shown.table else {"min": 0}), "overrides": []},
        "targets": targets,
        "transformations": _joined(shown) if shown.table else [],
    }


def _joined(shown: Panel) -> list[Json]:
    """Join the queries of a table to one row a robot; a query that adds a label needs no column for its value."""
    values = {f"Value #{chr(ord('A') + index)}": name for index, name in enumerate(shown.queries)}
    labelled = [value for value, name in values.items() if name in ("protocol", "state")]
    names = {"Value": next(iter(values.values()))} if len(values) == 1 else values
    hidden = dict.fromkeys(["Time", *labelled], True)
    organized = {"excludeByName": hidden, "renameByName": names}
    return [{"id": "merge", "options": {}}, {"id": "organize", "options": organized}]


def variables() -> list[Json]:
    """Write what the reader chooses: the source of the data, realms, robots."""
    several = {"type": "query", "datasource": DATASOURCE, "multi": True, "includeAll": True, "allValue": ".*"}
    chosen = {"refresh": 2, "sort": 1, "current": {"text": "All", "value": "$__all"}}
    queries = {"realm": "zbridge_robot_info, realm", "robot": 'zbridge_robot_info{realm=~"$realm"}, robot'}
    return [
        {"name": "datasource", "type": "datasource", "query": "prometheus"},
        *({"name": name, **several, **chosen, "query": f"label_values({query})"} for name, query in queries.items()),
    ]


def dashboard() -> Json:
    """Write the dashboard."""
    panels, x, y, tallest = [], 0, 0, 0
    for number, shown in enumerate(PANELS, start=1):
        if x + shown.width > COLUMNS:
            x, y, tallest = 0, y + tallest, 0
        panels.append(panel(number, shown, {"x": x, "y": y, "w": shown.width, "h": shown.height}))
        x, tallest = x + shown.width, max(tallest, shown.height)
    return {
        "uid": "zbridge",
        "title": "zbridge fleet",
        "tags": ["zbridge"],
        "schemaVersion": 39,
        "editable": True,
        "refresh": "15s",
        "time": {"from": "now-1h", "to": "now"},
        "graphTooltip": 1,
        "templating": {"list": variables()},
        "panels": panels,
    }


def main() -> None:
    text = json.dumps(dashboard(), indent=1) + "\n"
    if "--check" in sys.argv:
        sys.exit(f"{FILE.name} is out of date: python {__file__}" if FILE.read_text() != text else None)
    FILE.write_text(text)


if __name__ == "__main__":
    main()
