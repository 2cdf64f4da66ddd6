"""Counters and how Prometheus reads them."""

from zbridge.metrics import Metrics


def test_a_name_and_its_labels_in_any_order_are_one_counter_and_a_total_is_the_sum_over_the_labels() -> None:
    metrics = Metrics()
    first = metrics.count("dropped", writer="state", side="device")
    first.value += 2
    assert metrics.count("dropped", side="device", writer="state") is first
    metrics.count("dropped", side="device", writer="other").value += 3
    metrics.count("dropped").value += 1
    metrics.count("dropped_more").value += 100
    assert (metrics.total("dropped"), metrics.total("nothing")) == (6, 0)
    state, other = (("side", "device"), ("writer", "state")), (("side", "device"), ("writer", "other"))
    listed = [("dropped", (), 1), ("dropped", other, 3), ("dropped", state, 2), ("dropped_more", (), 100)]
    assert list(metrics) == listed


def test_the_exposition_names_each_type_once_and_quotes_labels() -> None:
    metrics = Metrics()
    metrics.count("published").value = 7
    metrics.count("dropped", writer="state", why="full").value = 1
    metrics.count("dropped", writer="batch", why='say "no"\\\nand go').value = 2
    assert metrics.exposition().splitlines() == [
        "# TYPE zbridge_dropped_total counter",
        'zbridge_dropped_total{why="full",writer="state"} 1',
        r'zbridge_dropped_total{why="say \"no\"\\\nand go",writer="batch"} 2',
        "# TYPE zbridge_published_total counter",
        "zbridge_published_total 7",
    ]


def test_a_labelled_part_counts_into_the_whole_and_shows_its_own_only() -> None:
    whole = Metrics()
    parts = [whole.labelled(robot=name) for name in ("r1", "r2")]
    parts[0].count("received").value += 2
    parts[1].count("received", link="laser").value += 3
    whole.count("received").value += 5
    assert [each.total("received") for each in (whole, *parts)] == [10, 2, 3]
    assert parts[0].count("received") is whole.count("received", robot="r1")
    assert list(parts[1]) == [("received", (("link", "laser"), ("robot", "r2")), 3)]
