"""Maps a device's millisecond counter to the gateway's clock. Sans-IO.

Theory of operation
-------------------
The counter began at an unknown instant and drifts. It is seen only through packets that arrive with a varying delay.
``arrived - counter`` is a slowly bending line plus that delay. The delay is never negative, so the line lies below the
packets.

The lowest packet of each bucket of 2 s is kept, for 32 buckets. The line is the edge over the middle of their lower
convex hull. Of all lines below every packet it is the highest at the middle of the window (the skew estimate of Moon,
Skelly and Towsley). A late packet lies above the hull and moves nothing, however late it is. A packet below the line
lowers the line at once. Buckets at either end of the window that hold late packets only are left out first.

Error: the stamp, less the instant at which the counter became ``device_ms``, less the least delay, which cannot be
seen. Assume a packet every 2 s or more often, at least one packet of any 10 s within ``E`` ms of the least delay
(``E`` up to 40, with the resolution of 1 ms), a drift up to 400 ppm, and a change of the drift up to ``K`` ppm per
second. Then from 80 s after the first packet on, the error is at most, either way,

    2.5 E + 1.5 K  milliseconds

Reason: at the middle of the window the line is not below the truth, and near both ends it is at most ``E`` above it.
So at the end it is wrong by ``E`` times a ratio of lengths. A parabola leaves its chords and tangents by ``K`` times
a length squared. Earlier, and while every packet is late, the line is too high by the least delay so far and 1 ms for
each second since that packet at most, and too low by 1 ms for each second since the first packet at most.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, ClassVar

from zbridge.protocol.kept import Kept

JUMP_S = 10.0
"""Seconds by which the delays of two packets in a row may differ; a greater difference is a jump of a clock."""

LATE_S = 1.0
"""Seconds. If every packet is later than this for ``jump_s``, a clock has jumped."""

LATE_PACKETS = 8
"""Least number of late packets that show a jump."""

SILENCE_S = 300.0
"""Seconds of the counter after which a packet is forgotten."""

BUCKET_S = 2.0
BUCKETS = 32

MAX_DRIFT_PPM = 500.0
"""Greatest drift that is believed: of the counter, or of a gateway whose clock is slewed."""

_TRIM_NS = 150_000_000
"""Buckets at either end of the window that are so far above the lowest hold late packets only."""

_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000
_BUCKET_MS = int(BUCKET_S * 1000)
_SILENCE_MS = int(SILENCE_S * 1000)
_LATE_NS = int(LATE_S * _NS_PER_S)

_Point = tuple[int, int]
"""The counter since the beginning, ms; the time of arrival since the beginning less that counter, ns."""


class DeviceClock(Kept):
    """Tells when one device took its measurements.

    ``wrap_ms``: the value at which the counter starts over (2**32 for a u32); None: it never does.
    ``jump_s``: seconds. A greater step of the counter against the gateway's clock, either way, is a restart of the
    counter or a step of the clock, and no late packet: the estimate starts again with the second packet after it.
    Lesser steps: a step backwards of the gateway's clock is followed at once (under 0.15 s it leaves an error of up
    to 20 ms for 40 s); a step forward, or a restart, is found after ``jump_s`` if it is over ``LATE_S``, else
    forgotten after 64 s.
    """

    kept: ClassVar[dict[str, Any]] = {
        "beginnings": int,
        "_device_ms": int,
        "_now_ms": int,
        "_arrived_ns": int,
        "_stamp_ns": int,
        "_origin_ns": int,
        "_late_packets": int,
        "_late_since_ns": int,
        "_stray": tuple[int, int] | None,
        "_drift_ppm": float,
        "_height_ns": float,
        "_points": list[tuple[int, int]],
        "_lowest": tuple[int, int],
        "_lowest_ns": float,
        "_bucket_end_ms": int,
    }

    def __init__(self, wrap_ms: int | None = None, jump_s: float = JUMP_S) -> None:
        self._wrap_ms = wrap_ms
        self._jump_ns = int(jump_s * _NS_PER_S)
        self.beginnings = 0
        """How often the estimate started: at the first packet, and at each jump."""
        self._device_ms = self._now_ms = self._arrived_ns = self._stamp_ns = self._origin_ns = 0
        self._late_packets = self._late_since_ns = 0
        self._stray: tuple[int, int] | None = None
        self._drift_ppm = 0.0  # nanoseconds per millisecond
        self._height_ns = 0.0
        self._points: deque[_Point] = deque(maxlen=BUCKETS)
        self._lowest: _Point = (0, 0)
        self._lowest_ns = 0.0
        self._bucket_end_ms = 0

    def __repr__(self) -> str:
        return f"<DeviceClock {self._drift_ppm:+.1f} ppm, {len(self._points)} buckets, {self.beginnings} beginnings>"

    @property
    def drift_ppm(self) -> float:
        """How much slower than the gateway's clock the counter runs, parts per million."""
        return self._drift_ppm

    def stamp_ns(self, device_ms: int, arrived_ns: int) -> int:
        """Return the Unix time, ns, at which the counter was ``device_ms``; never after ``arrived_ns``.

        Stamps do not go back while counter and arrivals do not; equal counters get equal stamps. The stamp is
        ``arrived_ns`` for a value that is no counter, for the first packets after a jump, and for a counter that has
        not moved for ``jump_s``. Raises nothing, whatever the integers.
        """
        if device_ms < 0 or (self._wrap_ms is not None and device_ms >= self._wrap_ms):
            return arrived_ns
        if not self.beginnings:
            return self._begin(device_ms, arrived_ns)
        step_ms = self._step_ms(self._device_ms, device_ms)
        if self._far(step_ms, arrived_ns - self._arrived_ns):
            return self._astray(device_ms, arrived_ns, step_ms)
        self._stray = None
        now_ms = self._now_ms + step_ms
        offset_ns = arrived_ns - self._origin_ns - now_ms * _NS_PER_MS
        if self._jumped(offset_ns - self._height_ns - self._drift_ppm * now_ms, arrived_ns):
            return self._begin(device_ms, arrived_ns)
        if step_ms <= 0:
            stamp_ns = self._line_ns(now_ms) if step_ms else self._stamp_ns
            return min(stamp_ns, self._stamp_ns, arrived_ns)
        self._learn(now_ms, offset_ns)
        slow_ns = self._stamp_ns + step_ms * (_NS_PER_MS // 2)  # after the line was lowered, until the stamps meet it
        self._stamp_ns = min(max(self._line_ns(now_ms), slow_ns), arrived_ns)
        self._device_ms, self._now_ms, self._arrived_ns = device_ms, now_ms, arrived_ns
        return self._stamp_ns

    def _begin(self, device_ms: int, arrived_ns: int) -> int:
        """Start again: forget all but the drift, which a restart does not change."""
        self.beginnings += 1
        self._device_ms = device_ms
        self._origin_ns = self._arrived_ns = self._stamp_ns = arrived_ns
        self._now_ms = 0
        self._height_ns = 0.0
        self._late_packets = 0
        self._stray = None
        self._points.clear()
        self._open_bucket(0, 0)
        return arrived_ns

    def _step_ms(self, since_ms: int, device_ms: int) -> int:
        """Return the step from one value of the counter to another, the shorter way round."""
        if self._wrap_ms is None:
            return device_ms - since_ms
        half_ms = self._wrap_ms // 2
        return (device_ms - since_ms + half_ms) % self._wrap_ms - half_ms

    def _far(self, step_ms: int, step_ns: int) -> bool:
        """Return whether a step of the counter contradicts the step of the gateway's clock. Integers only."""
        return abs(step_ns - step_ms * _NS_PER_MS) > self._jump_ns or abs(step_ms) > _SILENCE_MS

    def _astray(self, device_ms: int, arrived_ns: int, step_ms: int) -> int:
        """Start again if two packets in a row fit each other but not the rest; one alone is an absurd value."""
        stray, self._stray = self._stray, (device_ms, arrived_ns)
        if step_ms == 0 or stray is None or self._far(self._step_ms(stray[0], device_ms), arrived_ns - stray[1]):
            return arrived_ns
        return self._begin(device_ms, arrived_ns)

    def _jumped(self, late_ns: float, arrived_ns: int) -> bool:
        """Return whether a clock has jumped: all packets have been late for ``jump_s``."""
        if late_ns <= _LATE_NS:
            self._late_packets = 0
            return False
        if self._late_packets == 0:
            self._late_since_ns = arrived_ns
        self._late_packets += 1
        return self._late_packets >= LATE_PACKETS and arrived_ns - self._late_since_ns > self._jump_ns

    def _line_ns(self, now_ms: int) -> int:
        """Return the gateway's time at ``now_ms`` of the counter, by the line."""
        return self._origin_ns + now_ms * _NS_PER_MS + int(self._height_ns + self._drift_ppm * now_ms)

    def _learn(self, now_ms: int, offset_ns: int) -> None:
        """Enter the newest packet into its bucket, and keep the line below it."""
        if now_ms >= self._bucket_end_ms:
            self._close_bucket(now_ms)
            self._open_bucket(now_ms, offset_ns)
        low_ns = offset_ns - self._drift_ppm * now_ms
        if low_ns < self._lowest_ns:
            self._lowest, self._lowest_ns = (now_ms, offset_ns), low_ns
        self._height_ns = min(self._height_ns, low_ns)

    def _open_bucket(self, now_ms: int, offset_ns: int) -> None:
        self._lowest = (now_ms, offset_ns)
        self._lowest_ns = offset_ns - self._drift_ppm * now_ms
        self._bucket_end_ms = now_ms - now_ms % _BUCKET_MS + _BUCKET_MS

    def _close_bucket(self, now_ms: int) -> None:
        """Draw a new line, below the closed buckets that are not too old."""
        points = self._points
        points.append(self._lowest)
        while len(points) > 1 and points[0][0] < now_ms - _SILENCE_MS:
            points.popleft()
        hull = _lower_hull(points)
        slope_ppm = _slope_at_middle(_trim(hull, self._drift_ppm), self._drift_ppm)
        self._drift_ppm = drift_ppm = max(-MAX_DRIFT_PPM, min(slope_ppm, MAX_DRIFT_PPM))
        self._height_ns = min(offset_ns - drift_ppm * ms for ms, offset_ns in hull)


def _lower_hull(points: Iterable[_Point]) -> list[_Point]:
    """Keep the corners of the lower convex hull of points that are sorted by the counter (Andrew's chain)."""
    hull: list[_Point] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (y1 - y0) * (x - x1) < (y - y1) * (x1 - x0):
                break
            hull.pop()
        hull.append((x, y))
    return hull


def _trim(hull: list[_Point], drift_ppm: float) -> list[_Point]:
    """Cut off the ends of a hull that consist of late packets."""
    lows = [offset_ns - drift_ppm * ms for ms, offset_ns in hull]
    limit = min(lows) + _TRIM_NS
    return [point for point, low in zip(hull, lows, strict=True) if low <= limit]


def _slope_at_middle(hull: list[_Point], guess_ppm: float) -> float:
    """Return the slope of the edge over the middle, ns per ms; ``guess_ppm`` for a single point."""
    middle = (hull[0][0] + hull[-1][0]) / 2
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle:
            return (y1 - y0) / (x1 - x0)
    return guess_ppm
