"""The registry of metrics, and the text that Prometheus reads."""

from __future__ import annotations

import ast
import math
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from shutil import which

import pytest

from tests.scraped import samples
from zbridge.metrics import FAMILIES, Metrics
from zbridge.metrics.exposition import FamilyLines, InvalidMetrics, checked, text, written
from zbridge.metrics.registry import OTHER, SERIES, UNDOCUMENTED

ROOT = Path(__file__).parents[1]


def test_a_name_and_its_labels_in_any_order_are_one_counter_and_a_total_is_the_sum_over_the_labels() -> None:
    metrics = Metrics()
    first = metrics.count("bus_messages", direction="in", kind="drive")
    first.value += 2
    assert metrics.count("bus_messages", kind="drive", direction="in") is first
    metrics.count("bus_messages", direction="out", kind="pose").value += 3
    metrics.count("drives_slowed").value += 100
    assert [metrics.total(name) for name in ("bus_messages", "drives_slowed", "nothing")] == [5, 100, 0]
    assert metrics.total("bus_messages", direction="out") == 3
    drive, pose = (("direction", "in"), ("kind", "drive")), (("direction", "out"), ("kind", "pose"))
    assert list(metrics) == [("bus_messages", drive, 2), ("bus_messages", pose, 3), ("drives_slowed", (), 100)]


def test_every_metric_stands_once_with_its_help_and_type_and_labels_are_quoted() -> None:
    metrics = Metrics().labelled(robot='say "no"\\\nand go')
    metrics.count("refused", code="held").value = 1
    metrics.count("drives_slowed").value = 7
    metrics.count("refused", code="rate").value = 2
    metrics.add_source(lambda: [("lease_held", {}, 1)])
    robot = r'robot="say \"no\"\\\nand go"'
    assert metrics.exposition().splitlines() == [
        "# HELP zbridge_drives_slowed_total Drives that slew_per_s limited.",
        "# TYPE zbridge_drives_slowed_total counter",
        f"zbridge_drives_slowed_total{{{robot}}} 7",
        "# HELP zbridge_lease_held 1 while a program has the lease.",
        "# TYPE zbridge_lease_held gauge",
        f"zbridge_lease_held{{{robot}}} 1",
        "# HELP zbridge_refused_total Commands and queries that were refused.",
        "# TYPE zbridge_refused_total counter",
        f'zbridge_refused_total{{code="held",{robot}}} 1',
        f'zbridge_refused_total{{code="rate",{robot}}} 2',
    ]
    assert ("zbridge_lease_held", frozenset({("robot", 'say "no"\\\nand go')})) in samples(metrics.exposition())


def test_a_labelled_part_counts_into_the_whole_and_shows_its_own_only() -> None:
    whole = Metrics()
    parts = [whole.labelled(robot=name) for name in ("r1", "r2")]
    parts[0].count("received", help="What was received.").value += 2
    parts[1].count("received").value += 3
    whole.count("received").value += 5
    parts[1].histogram("socket_to_bus_seconds").observe(0.1)
    end = parts[1].add_source(lambda: [("lease_held", {}, 1)])
    assert [each.total("received") for each in (whole, *parts)] == [10, 2, 3]
    assert list(parts[1]) == [("received", (("robot", "r2"),), 3)]
    shown = [{name for name, _ in samples(each.exposition())} for each in (whole, *parts)]
    assert "zbridge_lease_held" in shown[0] & shown[2] - shown[1]
    assert "zbridge_socket_to_bus_seconds_count" in shown[0] & shown[2] - shown[1]
    end()
    assert "zbridge_lease_held" not in whole.exposition()
    assert whole.exposition().count("What was received.") == 1


@pytest.mark.parametrize(
    ("duration_s", "le"),
    [(0.0, "5e-05"), (0.001, "0.001"), (0.0011, "0.0025"), (0.9, "1"), (1.5, "+Inf"), (-1, "5e-05")],
)
def test_a_duration_counts_in_its_bucket_and_all_above_it(duration_s: float, le: str) -> None:
    metrics = Metrics()
    metrics.histogram("event_loop_lateness_seconds").observe(duration_s)
    found = samples(metrics.exposition())
    buckets = {dict(labels)["le"]: value for (name, labels), value in found.items() if name.endswith("_bucket")}
    assert len(buckets) == 14
    for bound, value in buckets.items():
        assert value == (float(bound) >= float(le)), bound
    (total,) = (value for (name, _), value in found.items() if name.endswith("_sum"))
    assert math.isclose(total, duration_s)


def test_a_metric_of_the_table_has_its_kind_and_labels_and_one_of_a_protocol_any() -> None:
    metrics = Metrics()
    for labels in ({}, {"why": "x"}, {"code": "held", "why": "x"}):
        with pytest.raises(ValueError, match="refused is a counter of zbridge itself with the labels code"):
            metrics.count("refused", **labels)
    with pytest.raises(ValueError, match="latches is a gauge of zbridge itself: expected another name"):
        metrics.count("latches")
    with pytest.raises(ValueError, match="refused is a counter"):
        metrics.histogram("refused", code="held")
    metrics.count("own", link="a")
    metrics.count("own").value += 1
    assert f"# HELP zbridge_own_total {UNDOCUMENTED}" in metrics.exposition()
    assert len(samples(metrics.exposition())) == 2


@pytest.mark.parametrize(
    ("name", "label"), [("my-counter", "a"), ("a b", "a"), ("", "a"), ("own", "bad-label"), ("own", "realm")]
)
def test_a_name_that_would_spoil_the_text_is_an_error(name: str, label: str) -> None:
    metrics = Metrics().labelled(realm="fleet")
    with pytest.raises(ValueError, match="expected the name of a metric or label"):
        metrics.count(name, **{label: "x"})
    assert metrics.exposition() == ""


@pytest.mark.parametrize(
    "family",
    [
        FamilyLines("a b", "counter", "Help.", "a b 1\n"),
        FamilyLines("zbridge_a", "number", "Help.", "zbridge_a 1\n"),
        FamilyLines("zbridge_a", "gauge", "Help.", "zbridge_a 1\nnonsense\n"),
        FamilyLines("zbridge_a", "gauge", "Help.", "zbridge_a 1\nzbridge_gateway_up 0\n"),
    ],
)
def test_what_another_process_says_must_not_spoil_the_text_of_all(family: FamilyLines) -> None:
    sound = FamilyLines("zbridge_a", "gauge", "Help\n# TYPE b.", 'zbridge_a{b="\\n"} 1\nzbridge_a 2\n')
    assert checked([sound]) == [sound]
    with pytest.raises(InvalidMetrics):
        checked([sound, family])
    with pytest.raises(InvalidMetrics, match="513 metrics exceed 512"):
        checked([sound] * 513)


def test_names_without_end_in_a_label_take_bounded_memory_and_are_counted_together() -> None:
    metrics = Metrics().labelled(robot="r1")
    for number in range(SERIES + 50):
        metrics.count("seen", help="Names that a peer chose.", part=str(number)).value += 1
    assert len(list(metrics)) == SERIES + 1
    assert metrics.total("seen") == SERIES + 50
    assert metrics.total("seen", part=OTHER) == 50
    metrics.count("seen", part="0").value += 1
    assert metrics.total("seen", part="0") == 2


def test_metrics_of_many_processes_stand_once_each_and_one_of_another_type_is_left_out() -> None:
    processes = []
    for name in ("r1", "r2"):
        metrics = Metrics().labelled(robot=name)
        metrics.count("drives_slowed").value += 1
        processes.append(written(metrics.read()))
    processes.append([FamilyLines("zbridge_drives_slowed_total", "gauge", "Of another version.", "zbridge_x 1\n")])
    found = samples(text(processes))
    assert sorted(dict(labels)["robot"] for _, labels in found) == ["r1", "r2"]


def names_in_use() -> Iterator[tuple[str, str, bool]]:
    """Give each metric that the code names, where, and whether it has a help of its own."""
    for path in (*(ROOT / "zbridge").rglob("*.py"), *(ROOT / "gateways").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name) and node.args:
                called = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
                name = node.args[0]
                if (
                    called in ("count", "histogram")
                    and isinstance(name, ast.Constant)
                    and re.fullmatch(r"[a-z]\w+", str(name.value))
                ):
                    has_help = any(keyword.arg == "help" for keyword in node.keywords)
                    yield str(name.value), str(path.relative_to(ROOT)), has_help


def test_every_metric_of_the_core_is_in_the_table_and_those_of_protocols_say_what_they_count() -> None:
    for name, place, has_help in names_in_use():
        assert (name in FAMILIES) is not place.startswith("gateways"), (name, place)
        assert has_help is place.startswith("gateways"), (name, place)


@pytest.mark.skipif(which("promtool") is None, reason="promtool is not installed: CI installs it")
def test_promtool_has_nothing_to_say_about_any_metric() -> None:
    metrics = Metrics().labelled(realm="fleet", robot="r1")
    readings = []
    for family in FAMILIES.values():
        labels = dict.fromkeys(family.labels, "x")
        if family.kind.value == "histogram":
            metrics.histogram(family.name, **labels).observe(0.01)
        else:
            readings.append((family.name, labels, 1))
    metrics.add_source(lambda: readings)
    checked = subprocess.run(
        ["promtool", "check", "metrics"], input=metrics.exposition(), text=True, capture_output=True, check=False
    )
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")
