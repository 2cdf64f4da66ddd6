"""Counters and how Prometheus reads them."""

from zbridge.metrics import Metrics


def test_the_same_name_and_labels_give_the_same_counter_in_any_order() -> None:
    metrics = Metrics()
    first = metrics.count("dropped", writer="state", side="device")
    first.value += 2
    assert metrics.count("dropped", side="device", writer="state") is first
    assert metrics.count("dropped", side="device", writer="other") is not first
    assert metrics.count("dropped") is not first


def test_a_total_is_the_sum_over_all_labels_of_one_name() -> None:
    metrics = Metrics()
    metrics.count("dropped", writer="a").value += 2
    metrics.count("dropped", writer="b").value += 3
    metrics.count("dropped").value += 1
    metrics.count("dropped_more").value += 100
    assert metrics.total("dropped") == 6
    assert metrics.total("nothing") == 0


def test_counters_are_listed_in_order() -> None:
    metrics = Metrics()
    metrics.count("b").value = 1
    metrics.count("a", z="2").value = 2
    metrics.count("a", z="1").value = 3
    assert list(metrics) == [("a", (("z", "1"),), 3), ("a", (("z", "2"),), 2), ("b", (), 1)]


def test_the_exposition_names_each_type_once() -> None:
    metrics = Metrics()
    metrics.count("published").value = 7
    metrics.count("dropped", writer="state", why="full").value = 1
    metrics.count("dropped", writer="batch", why="full").value = 2
    assert metrics.exposition() == (
        "# TYPE zbridge_dropped_total counter\n"
        'zbridge_dropped_total{why="full",writer="batch"} 2\n'
        'zbridge_dropped_total{why="full",writer="state"} 1\n'
        "# TYPE zbridge_published_total counter\n"
        "zbridge_published_total 7\n"
    )


def test_labels_are_quoted() -> None:
    metrics = Metrics()
    metrics.count("refused", why='say "no"\\\nand go').value = 1
    assert r'why="say \"no\"\\\nand go"' in metrics.exposition()
    assert len(metrics.exposition().splitlines()) == 2


def test_a_counter_prints_its_value() -> None:
    count = Metrics().count("x")
    count.value += 3
    assert repr(count) == "<Count 3>"
