"""Counters of one process: what was received, sent, dropped and refused. Every drop has one.

Knows no clock, loop or socket; :mod:`zbridge.app.prometheus` shows the registry to Prometheus.
"""

from __future__ import annotations

from collections.abc import Iterator


class Count:
    """A number that only grows; the hot path adds to ``value`` directly."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value = 0

    def __repr__(self) -> str:
        return f"<Count {self.value}>"


Labels = tuple[tuple[str, str], ...]


class Metrics:
    """The registry: the same name and labels always give the same counter."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, Labels], Count] = {}
        self._own: dict[str, str] = {}

    def labelled(self, **labels: str) -> Metrics:
        """Return a part of this registry: all its counters have these labels too."""
        part = Metrics()
        part._counts, part._own = self._counts, {**self._own, **labels}
        return part

    def count(self, name: str, **labels: str) -> Count:
        """Return the counter of this name and these labels; make it on first use."""
        return self._counts.setdefault((name, tuple(sorted({**self._own, **labels}.items()))), Count())

    def total(self, name: str) -> int:
        """Sum a counter over all its labels."""
        return sum(value for own, _, value in self if own == name)

    def __iter__(self) -> Iterator[tuple[str, Labels, int]]:
        own = set(self._own.items())
        for (name, labels), count in sorted(self._counts.items(), key=lambda item: item[0]):
            if own.issubset(labels):
                yield name, labels, count.value

    def exposition(self) -> str:
        """Write all counters in the Prometheus text format, version 0.0.4."""
        lines: list[str] = []
        previous = ""
        for name, labels, value in self:
            if name != previous:
                lines.append(f"# TYPE zbridge_{name}_total counter")
                previous = name
            text = ",".join(f'{key}="{_quoted(label)}"' for key, label in labels)
            lines.append(f"zbridge_{name}_total{{{text}}} {value}" if text else f"zbridge_{name}_total {value}")
        return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
