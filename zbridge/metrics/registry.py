"""The metrics of one process. Knows no clock, loop or socket.

Theory of operation. The hot path holds a :class:`Count` or :class:`Histogram` and adds to it; nothing is looked up,
and no label is made, per message. What exists anyway (the state of a session, the length of a queue) is not counted
at all: a *source* reads it when somebody reads the metrics. An endpoint shows the result to Prometheus
(:mod:`zbridge.metrics.exposition`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator

from zbridge.metrics.exposition import text, written
from zbridge.metrics.families import FAMILIES, Family, MetricKind
from zbridge.metrics.values import Count, Histogram, Labels, Value

SERIES = 256
"""Most combinations of labels of one metric; all others share one, whose label values are ``other``."""
OTHER = "other"
_NAME = re.compile(r"[a-zA-Z_][a-zA-Z0-9_]*")
UNDOCUMENTED = "Counted by the protocol."
"""The help of a counter that its protocol gives none."""

Reading = tuple[str, dict[str, str], float]
"""A name, labels, and the value now."""
Source = Callable[[], Iterable[Reading]]


class Metrics:
    """The registry: the same name and labels always give the same counter."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, Labels], Count] = {}
        self._histograms: dict[tuple[str, Labels], Histogram] = {}
        self._sources: dict[Source, dict[str, str]] = {}
        self._families: dict[str, Family] = {}
        """Of protocols: what is not in :data:`FAMILIES`."""
        self._series: dict[str, int] = {}
        self._own: dict[str, str] = {}

    def labelled(self, **labels: str) -> Metrics:
        """Return a part of this registry: all its metrics have these labels too."""
        part = Metrics()
        part.__dict__.update(self.__dict__)
        part._own = {**self._own, **labels}
        return part

    def count(self, name: str, *, help: str = "", **labels: str) -> Count:
        """Return the counter of this name and these labels; make it on first use.

        help: what it counts, for a name that is not in :data:`FAMILIES`. Beyond :data:`SERIES` combinations of labels,
        the counter is shared. Raises ValueError for names that Prometheus does not allow, and for another kind or
        other labels than a metric of the table has.
        """
        key = self._key(name, labels)
        count = self._counts.get(key)
        if count is None:
            self._declare(name, MetricKind.COUNTER, labels, help)
            count = self._counts.setdefault(self._bounded(name, key, labels), Count())
        return count

    def histogram(self, name: str, **labels: str) -> Histogram:
        """Return the histogram of this name and these labels; make it on first use."""
        key = self._key(name, labels)
        histogram = self._histograms.get(key)
        if histogram is None:
            self._declare(name, MetricKind.HISTOGRAM, labels)
            histogram = self._histograms.setdefault(self._bounded(name, key, labels), Histogram())
        return histogram

    def add_source(self, source: Source) -> Callable[[], object]:
        """Read ``source`` whenever the metrics are read; return what ends that.

        A source yields gauges, and counters that something else keeps; where several yield a series, their values are
        added. What a source raises is the caller's error.
        """
        self._sources[source] = self._own
        return lambda: self._sources.pop(source, None)

    def total(self, name: str, **labels: str) -> int:
        """Sum a counter over all its labels but those that are given."""
        given = set(labels.items())
        return sum(value for own, theirs, value in self if own == name and given.issubset(theirs))

    def __iter__(self) -> Iterator[tuple[str, Labels, int]]:
        own = set(self._own.items())
        for (name, labels), count in sorted(self._counts.items(), key=lambda item: item[0]):
            if own.issubset(labels):
                yield name, labels, count.value

    def read(self) -> list[tuple[Family, list[tuple[Labels, Value]]]]:
        """Return every metric with its values, in the order of their full names."""
        found: dict[str, dict[Labels, Value]] = {}
        for name, labels, value in self:
            found.setdefault(name, {})[labels] = value
        own = set(self._own.items())
        for (name, labels), histogram in self._histograms.items():
            if own.issubset(labels):
                found.setdefault(name, {})[labels] = (tuple(histogram.counts), histogram.sum_s)
        for source, theirs in list(self._sources.items()):
            if own <= set(theirs.items()):
                for name, given, number in source():
                    values, labels = found.setdefault(name, {}), _sorted({**theirs, **given})
                    values[labels] = number + _number(values.get(labels, 0))
        families = ((FAMILIES.get(name) or self._families[name], list(each.items())) for name, each in found.items())
        return sorted(families, key=lambda item: item[0].full_name)

    def exposition(self) -> str:
        """Write all metrics in the Prometheus text format, version 0.0.4."""
        return text([written(self.read())])

    def _key(self, name: str, labels: dict[str, str]) -> tuple[str, Labels]:
        return name, _sorted({**self._own, **labels})

    def _declare(self, name: str, kind: MetricKind, labels: dict[str, str], text: str = "") -> None:
        """Check a new series against the table, or enter a metric that is not there."""
        family = FAMILIES.get(name)
        if family is None:
            for word in (name, *labels):
                if not _NAME.fullmatch(word) or word in self._own:
                    raise ValueError(f"{word!r}: expected the name of a metric or label: letters, digits and '_'")
            self._families.setdefault(name, Family(name, kind, text or UNDOCUMENTED, tuple(sorted(labels))))
        elif (kind, set(labels)) != (family.kind, set(family.labels)):
            labelled = f" with the labels {', '.join(family.labels)}" if family.labels else ""
            raise ValueError(f"{name} is a {family.kind.value} of zbridge itself{labelled}: expected another name")

    def _bounded(self, name: str, key: tuple[str, Labels], labels: dict[str, str]) -> tuple[str, Labels]:
        """Return the key of a new series; that of all others if there are too many."""
        if not labels:
            return key
        part = f"{name} {sorted(self._own.items())}"
        self._series[part] = self._series.get(part, 0) + 1
        return key if self._series[part] <= SERIES else self._key(name, dict.fromkeys(labels, OTHER))


def _sorted(labels: dict[str, str]) -> Labels:
    return tuple(sorted(labels.items()))


def _number(value: Value) -> float:
    return value if isinstance(value, int | float) else 0
