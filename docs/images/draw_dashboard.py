"""Draw ``dashboard.svg`` from what a real Prometheus answers to the queries of the Grafana dashboard.

    python -m docs.images.draw_dashboard           # two minutes; writes docs/images/dashboard.svg

Needs zbridge with the extra ``test``, and on Debian ``apt-get install prometheus``. Three simulated robots, a driver
and an HQ program run on this machine. Places, titles and legends are those of ``deploy/prometheus/dashboard.json``;
the look is not Grafana's.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

from docs.diagrams.svg import Picture
from tests.e2e.conftest import Bench
from tests.e2e.rigs.monitored import MonitoredFleet, dashboard

FILE = Path(__file__).with_name("dashboard.svg")
COLUMN, ROW = 41, 20
"""Pixels of a column and of a row of the dashboard."""
COLOURS = ("#2563b0", "#d0752c", "#2d8a4e", "#b8348c", "#2a9aa8", "#8a6d1b")
"""Of the series of a chart, of which the largest are drawn."""
LEGEND, LETTER = 3, 6.2
"""Lines of a legend; pixels of a letter."""
GAP_S = 1.5
UNITS = {"s": "s", "ops": "/s", "Bps": "B/s", "bytes": "B", "short": ""}


def show(fleet: MonitoredFleet) -> float:
    """Let things happen in a fleet; return how long they took, in seconds."""
    bus, began = fleet.bench.fleet, time.monotonic()
    time.sleep(15)
    fleet.show_to_hq_program()
    bus.hold("r1", who="ann")
    fleet.driven |= {"r1", "v1"}  # nobody holds v1, so it refuses
    time.sleep(25)
    bus.put("r1/@cmd/stop")
    fleet.driven.clear()
    time.sleep(10)
    bus.hold("v1", who="bob")
    fleet.driven.add("v1")
    time.sleep(15)
    fleet.driven.clear()  # the deadman stops it
    time.sleep(10)
    os.kill(fleet.supervisor.gateway("v1"), signal.SIGKILL)
    time.sleep(10)
    bus.put("w1/@cmd/stop", latch=True, id=os.urandom(16), who="cy", reason="a cable is loose")
    bus.hold("r1", who="ann")
    fleet.driven.add("r1")
    time.sleep(15)
    return time.monotonic() - began


class Drawing:
    """The picture of the dashboard. seconds: what its charts show."""

    def __init__(self, fleet: MonitoredFleet, seconds: float) -> None:
        self._ask, self._seconds = fleet.prometheus, seconds
        shown = dashboard()
        places = [panel["gridPos"] for panel in shown["panels"]]
        width, height = 24 * COLUMN + 8, max(place["y"] + place["h"] for place in places) * ROW + 8
        about = "Drawn from the answers of a Prometheus that scraped three simulated robots; not a picture of Grafana."
        self.picture = Picture("The dashboard of a fleet", about, width, height)
        for panel in shown["panels"]:
            place = panel["gridPos"]
            at, size = (4 + place["x"] * COLUMN, 4 + place["y"] * ROW), (place["w"] * COLUMN, place["h"] * ROW)
            self.picture.box((at[0] + 3, at[1] + 3), (size[0] - 6, size[1] - 6), "plain")
            self.picture.text(at[0] + 12, at[1] + 21, panel["title"], "bold")
            (self._table if panel["type"] == "table" else self._chart)(panel, at, size)

    def _table(self, panel: dict[str, Any], at: tuple[float, float], size: tuple[float, float]) -> None:
        hidden, names = (panel["transformations"][1]["options"][key] for key in ("excludeByName", "renameByName"))
        rows: dict[str, dict[str, str]] = {}
        for target in panel["targets"]:
            field = f"Value #{target['refId']}" if len(panel["targets"]) > 1 else "Value"
            for series in self._ask.query(target["expr"]):
                row = rows.setdefault(series["metric"].get("robot", ""), {})
                row |= series["metric"] | ({} if field in hidden else {names[field]: series["value"][1]})
        titles = list(dict.fromkeys(title for row in rows.values() for title in row))
        for column, title in enumerate(titles):
            x = at[0] + 12 + column * (size[0] - 20) / len(titles)
            for line, text in enumerate([title, *(rows[robot].get(title, "") for robot in sorted(rows))]):
                self.picture.text(x, at[1] + 46 + line * 20, text, "" if line else "small")

    def _chart(self, panel: dict[str, Any], at: tuple[float, float], size: tuple[float, float]) -> None:
        lines = [
            (legend(target["legendFormat"], series["metric"]), values)
            for target in panel["targets"]
            for series in self._ask.history(target["expr"], self._seconds)
            if (values := [(when, float(value)) for when, value in series["values"] if math.isfinite(float(value))])
        ]
        lines = sorted(lines, key=lambda line: -max(value for _, value in line[1]))[: len(COLOURS)]
        most = max(value for _, values in lines for _, value in values) or 1.0
        until = time.time()
        left, top, right = at[0] + 66, at[1] + 34, at[0] + size[0] - 14
        bottom = at[1] + size[1] - 20 - 14 * min(LEGEND, len(lines))
        unit = panel["fieldConfig"]["defaults"]["unit"]
        for part in (0.0, 0.5, 1.0):
            y = bottom + part * (top - bottom)
            self.picture.line((left, y), (right, y), "grid", width=1)
            self.picture.text(left - 6, y + 4, amount(part * most, unit), "small", "end")
        for number, (_, values) in enumerate(lines):
            points = [
                (right - (until - when) / self._seconds * (right - left), bottom - value / most * (bottom - top), when)
                for when, value in values
            ]
            self.picture.parts.append(curve(points, COLOURS[number]))
        self._legend([name for name, _ in lines], at[0] + 12, bottom + 20, size[0] - 24)

    def _legend(self, names: list[str], x: float, y: float, width: float) -> None:
        columns = math.ceil(len(names) / LEGEND)
        for number, name in enumerate(names):
            across, down = divmod(number, LEGEND)
            at, line = x + across * width / columns, y + 14 * down
            colour = COLOURS[number]
            self.picture.parts.append(f'<rect x="{at:g}" y="{line - 6:g}" width="9" height="3" fill="{colour}"/>\n')
            self.picture.text(at + 13, line, name[: int((width / columns - 15) / LETTER)], "small")


def legend(form: str, labels: dict[str, str]) -> str:
    """Write what a legend says of a series."""
    return re.sub(r"\{\{(\w+)\}\}", lambda label: labels.get(label[1], ""), form).strip()


def amount(value: float, unit: str) -> str:
    """Write a number with its unit: ``12 kB/s``."""
    if unit == "percentunit":
        return f"{100 * value:.3g} %"
    for factor, prefix in ((1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ")):
        if value >= factor and (factor >= 1 or unit == "s"):
            return f"{value / factor:.3g} {prefix}{UNITS[unit]}".replace(" /", "/").strip()
    return f"{value:.2g} {UNITS[unit]}".replace(" /", "/").strip()


def curve(points: list[tuple[float, float, float]], colour: str) -> str:
    """Draw a line through points (x, y, time) that is broken where the series has a gap."""
    path, befores, afters = "", [(0.0, 0.0, -math.inf), *points], [*points[1:], (0.0, 0.0, math.inf)]
    for before, (x, y, when), after in zip(befores, points, afters, strict=False):
        if before[1] == y == after[1] and after[2] - before[2] < 2 * GAP_S:
            continue  # in a straight line
        path += f"{'L' if when - before[2] < GAP_S else 'M'}{x:.0f} {y:.0f}"
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.6"/>\n'


def main() -> None:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        fleet = MonitoredFleet(Bench(folder, stack))
        fleet.prometheus.scraped(10)
        FILE.write_text(Drawing(fleet, show(fleet)).picture.svg())


if __name__ == "__main__":
    main()
