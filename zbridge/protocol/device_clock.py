"""A device's millisecond counter, mapped to the gateway's clock. Sans-IO.

The counter began at an unknown instant, drifts, and is seen only through packets that come late by a varying
delay. ``arrived - counter`` is a slowly bending line plus a delay that is never negative, so the line is looked for
below the packets. Of each bucket of two seconds the lowest packet is kept, 32 buckets at most; the line is the
edge over the middle of their lower convex hull, which is, of all lines below every packet, the highest at the
middle of the window (as Moon, Skelly and Towsley estimate skew). A late packet lies above the hull and moves
nothing, however late; a packet below the line lowers it at once. At both ends of the window buckets that hold late
packets only are left out before the middle is sought.

**The error** is the stamp less the instant at which the counter became ``device_ms``, less the least delay, which
nobody can see. Where packets come every 2 s or more often, one at least of those of any 10 s is within ``E`` ms of
the least delay (``E`` up to 40), and the drift is up to 400 ppm and changes by up to ``K`` ppm per second, it is,
from 80 s after the beginning on, either way within

    2.5 E + 1.5 K  milliseconds

``E`` includes the resolution of the counter, 1 ms. Why: the line is not below the truth at the middle of the window,
nor more than ``E`` above it near both ends, so at the end it is wrong by ``E`` times a ratio of lengths; a parabola
leaves its chords and tangents by ``K`` times a length squared. Earlier, and while nobody is on time, the line is too
high by no more than the least delay so far and 1 ms for every second since that packet, and too low by no more than
1 ms for every second since the beginning.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import pairwise

JUMP_S = 10.0
"""Seconds by which the delays of two packets in a row may differ; more is a jump of one of the clocks."""

LATE_S = 1.0
"""Seconds: where for ``jump_s`` every packet is later than this, not they are late but a clock has jumped."""

LATE_PACKETS = 8
"""How many such packets it takes at least."""

SILENCE_S = 300.0
"""Seconds of the counter after which a packet says nothing about the present."""

BUCKET_S = 2.0
BUCKETS = 32

MAX_DRIFT_PPM = 500.0
"""The drift that is believed: of the counter, and of a gateway whose clock is being slewed."""

_TRIM_NS = 150_000_000
"""At either end of the window, buckets so far above the lowest tell nothing of the drift: all they hold is late."""

_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000
_BUCKET_MS = int(BUCKET_S * 1000)
_SILENCE_MS = int(SILENCE_S * 1000)
_LATE_NS = int(LATE_S * _NS_PER_S)

_Point = tuple[int, int]
"""The counter since the beginning, ms; the time of arrival since the beginning less that counter, ns."""


class DeviceClock:
    """Tells when the measurements of one device were taken.

    ``wrap_ms``: the value at which the counter starts over, 2**32 for a u32; None for one that never does.
    ``jump_s``: a step of the counter against the gateway's clock, either way, that is no late packet but a restart
    of the counter or a step of the clock, seconds: it begins anew with the second packet after it. Of lesser steps,
    one backwards of the gateway's clock is followed at once (under 0.15 s it leaves an error of up to 20 ms for 40 s);
    one forward, or a restart, is noticed after ``jump_s`` if over ``LATE_S``, and else forgotten after 64 s.
    """

    def __init__(self, wrap_ms: int | None = None, jump_s: float = JUMP_S) -> None:
        self._wrap_ms = wrap_ms
        self._jump_ns = int(jump_s * _NS_PER_S)
        self.beginnings = 0
        """How often it began: with the first packet, and anew with every jump."""
        self._device_ms = self._now_ms = self._arrived_ns = self._stamp_ns = self._origin_ns = 0
        self._late_packets = self._late_since_ns = 0
        self._stray: tuple[int, int] | None = None
        self._drift_ppm = 0.0  # which is nanoseconds per millisecond
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
        """Tell when the counter was ``device_ms``, given that it arrived at ``arrived_ns``: Unix ns, not after that.

        While counter and arrivals do not go back, nor do the stamps; equal counters get equal stamps. Whatever fits
        nowhere is stamped with its arrival: a value that is no counter, the first packets after a jump, a counter
        that has stood still for ``jump_s``. No integers raise.
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
        slow_ns = self._stamp_ns + step_ms * (_NS_PER_MS // 2)  # where a new line is lower, until it has caught up
        self._stamp_ns = min(max(self._line_ns(now_ms), slow_ns), arrived_ns)
        self._device_ms, self._now_ms, self._arrived_ns = device_ms, now_ms, arrived_ns
        return self._stamp_ns

    def _begin(self, device_ms: int, arrived_ns: int) -> int:
        """Forget everything but the drift, which outlives a restart."""
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
        """Tell how far it is from one value of the counter to another, the shorter way round."""
        if self._wrap_ms is None:
            return device_ms - since_ms
        half_ms = self._wrap_ms // 2
        return (device_ms - since_ms + half_ms) % self._wrap_ms - half_ms

    def _far(self, step_ms: int, step_ns: int) -> bool:
        """Tell whether a step of the counter does not go with a step of the gateway's clock. Integers only."""
        return abs(step_ns - step_ms * _NS_PER_MS) > self._jump_ns or abs(step_ms) > _SILENCE_MS

    def _astray(self, device_ms: int, arrived_ns: int, step_ms: int) -> int:
        """Begin anew where two packets in a row fit each other and not the rest; one alone is an absurd value."""
        stray, self._stray = self._stray, (device_ms, arrived_ns)
        if step_ms == 0 or stray is None or self._far(self._step_ms(stray[0], device_ms), arrived_ns - stray[1]):
            return arrived_ns
        return self._begin(device_ms, arrived_ns)

    def _jumped(self, late_ns: float, arrived_ns: int) -> bool:
        """Tell whether all packets have been late for so long that a clock must have jumped."""
        if late_ns <= _LATE_NS:
            self._late_packets = 0
            return False
        if self._late_packets == 0:
            self._late_since_ns = arrived_ns
        self._late_packets += 1
        return self._late_packets >= LATE_PACKETS and arrived_ns - self._late_since_ns > self._jump_ns

    def _line_ns(self, now_ms: int) -> int:
        """Tell the gateway's time when the counter was ``now_ms``, by the line."""
        return self._origin_ns + now_ms * _NS_PER_MS + int(self._height_ns + self._drift_ppm * now_ms)

    def _learn(self, now_ms: int, offset_ns: int) -> None:
        """Enter a packet that is newer than all others into its bucket, and draw the line below it."""
        if now_ms >= self._bucket_end_ms:
            self._close_bucket(now_ms)
            self._open_bucket(now_ms, offset_ns)
        low_ns = offset_ns - self._drift_ppm * now_ms
        if low_ns < self._lowest_ns:
            self._lowest, self._lowest_ns = (now_ms, offset_ns), low_ns
        if low_ns < self._height_ns:
            self._height_ns = low_ns

    def _open_bucket(self, now_ms: int, offset_ns: int) -> None:
        self._lowest = (now_ms, offset_ns)
        self._lowest_ns = offset_ns - self._drift_ppm * now_ms
        self._bucket_end_ms = now_ms - now_ms % _BUCKET_MS + _BUCKET_MS

    def _close_bucket(self, now_ms: int) -> None:
        """Draw the line anew, below the closed buckets that are not too old."""
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
    """Cut off the ends of a hull that only late packets hold up."""
    lows = [offset_ns - drift_ppm * ms for ms, offset_ns in hull]
    limit = min(lows) + _TRIM_NS
    return [point for point, low in zip(hull, lows, strict=True) if low <= limit]


def _slope_at_middle(hull: list[_Point], guess_ppm: float) -> float:
    """Tell the slope of the edge over the middle, ns per ms; ``guess_ppm`` where there is one point only."""
    middle = (hull[0][0] + hull[-1][0]) / 2
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle:
            return (y1 - y0) / (x1 - x0)
    return guess_ppm
