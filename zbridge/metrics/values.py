"""What a metric holds: a number that grows, or durations by buckets. The hot path knows these only."""

from __future__ import annotations

from bisect import bisect_left

BOUNDS_S = (
    0.000_05, 0.000_1, 0.000_25, 0.000_5, 0.001, 0.002_5, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0,
)  # fmt: skip
"""Upper bounds of the buckets of every histogram, seconds."""
Labels = tuple[tuple[str, str], ...]
Value = int | float | tuple[tuple[int, ...], float]
"""A number; of a histogram its counts and the sum."""


class Count:
    """A number that only grows; the hot path adds to ``value`` directly."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value = 0

    def __repr__(self) -> str:
        return f"<Count {self.value}>"


class Histogram:
    """Durations, seconds, by buckets of :data:`BOUNDS_S`. counts: of each bucket alone; the last has no bound."""

    __slots__ = ("counts", "sum_s")

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS_S) + 1)
        self.sum_s = 0.0

    def __repr__(self) -> str:
        return f"<Histogram of {sum(self.counts)}>"

    def observe(self, duration_s: float) -> None:
        """Add one duration; takes less than 100 ns."""
        self.counts[bisect_left(BOUNDS_S, duration_s)] += 1
        self.sum_s += duration_s
