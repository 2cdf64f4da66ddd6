"""The clock of a device: stamps within the stated error, whatever the delays, and a new beginning after jumps."""

import math
import random
from collections.abc import Callable, Iterable
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bounds import most_kept
from zbridge.protocol.device_clock import BUCKETS, DeviceClock

EPOCH_NS = 1_700_000_000_000_000_000
MS = 1_000_000
S = 1_000_000_000
U32 = 2**32
SETTLED_S = 80.0


class Packet(NamedTuple):
    """One measurement: its counter, its arrival, and the instant at which the counter became so."""

    device_ms: int
    arrived_ns: int
    truth_ns: int


Delay = Callable[[random.Random, float], float]
"""Tells the delay of the packet of a second, seconds."""

Drift = Callable[[float], float]
"""Tells how far the counter is ahead at a second, seconds."""


def packet(second: float, delay_s: float, *, ahead_s: float = 0.0, start_ms: int = 5000) -> Packet:
    counter_ms = start_ms + (second + ahead_s) * 1000
    device_ms = math.floor(counter_ms + 1e-6)
    truth_s = second - (counter_ms - device_ms) / 1000
    return Packet(device_ms, EPOCH_NS + round((second + delay_s) * S), EPOCH_NS + round(truth_s * S))


def journey(delay: Delay, drift: Drift, *, seed: int = 0, minutes: float = 11, in_order: bool = True) -> list[Packet]:
    """Simulate ten packets a second, in the order of arrival; ``in_order``: none overtakes another (TCP)."""
    rng = random.Random(seed)
    packets = []
    free_at = 0.0
    for second in (i / 10 for i in range(int(minutes * 600))):
        arrival = second + delay(rng, second)
        free_at = max(free_at, arrival) if in_order else arrival
        packets.append(packet(second, free_at - second, ahead_s=drift(second)))
    return sorted(packets, key=lambda one: one.arrived_ns)


def series(count: int, *, from_s: float = 0.0, every_s: float = 0.1, delay_s: float = 0.0, **kind: int) -> list[Packet]:
    """So many measurements, all of them as late."""
    return [packet(from_s + i * every_s, delay_s, **kind) for i in range(count)]


def stamps(clock: DeviceClock, packets: Iterable[Packet]) -> list[int]:
    """Stamp all, none of them later than its arrival."""
    taken = []
    for device_ms, arrived_ns, _ in packets:
        taken.append(clock.stamp_ns(device_ms, arrived_ns))
        assert taken[-1] <= arrived_ns
    return taken


def errors_ns(clock: DeviceClock, packets: list[Packet], from_s: float = 0.0) -> list[int]:
    """Tell how wrong the stamps are, from so many seconds of the counter after the first packet on."""
    pairs = zip(stamps(clock, packets), packets, strict=True)
    first_ms = min(one.device_ms for one in packets)
    return [abs(stamp - one.truth_ns) for stamp, one in pairs if one.device_ms - first_ms >= from_s * 1000]


def exponential(rng: random.Random, second: float) -> float:
    return 0.005 + rng.expovariate(1 / 0.02)


def mobile(rng: random.Random, second: float) -> float:
    return 0.04 + rng.expovariate(1 / 0.1)


def steady(ppm: float) -> Drift:
    return lambda second: ppm * 1e-6 * second


DRIFTS: dict[str, tuple[Drift, float]] = {
    "none": (steady(0), 0.0),
    "fast": (steady(200), 0.0),
    "slow": (steady(-200), 0.0),
    "faster": (steady(400), 0.0),
    "warming": (lambda second: 200e-6 * (second - 280 * (1 - math.exp(-second / 280))), 0.7),
    "swinging": (lambda second: 200e-6 * 200 * (1 - math.cos(second / 200)), 1.0),
}
"""How far the counter is ahead, and the greatest change of the drift, ppm per second."""


@pytest.mark.parametrize(("ahead", "bend"), DRIFTS.values(), ids=DRIFTS)
@pytest.mark.parametrize(
    ("delay", "in_order", "most_ms"),
    [
        (lambda rng, second: 0.005, True, 1.6),
        (exponential, True, 2.5),
        (mobile, True, 10),
        (mobile, False, 10),
        (lambda rng, second: exponential(rng, second) + (3.0 if second % 23 > 17 else 0.0), True, 3),
        (lambda rng, second: exponential(rng, second) + (30 - second % 30 if second % 30 > 22 else 0.0), True, 4),
        (lambda rng, second: 0.905 - (second + 1e-9) % 1.0 + rng.expovariate(1 / 0.002), True, 5),
    ],
    ids=["constant", "exponential", "mobile", "overtaking", "often late", "held, then all at once", "once a second"],
)
def test_the_error_stays_within_what_is_stated_and_that_is_so_many_milliseconds(delay, in_order, most_ms, ahead, bend):
    packets = journey(delay, ahead, seed=7, in_order=in_order)
    least_ns = min(one.arrived_ns - one.truth_ns for one in packets)
    late_ns = [one.arrived_ns - one.truth_ns - least_ns for one in sorted(packets)]
    spread_ms = max(min(late_ns[i : i + 100]) for i in range(len(late_ns) - 99)) / MS
    measured = [one._replace(truth_ns=one.truth_ns + least_ns) for one in packets]
    worst_ms = max(errors_ns(DeviceClock(), measured, SETTLED_S)) / MS
    assert worst_ms <= 2.5 * spread_ms + 1.5 * bend + 0.01
    assert worst_ms <= most_ms


@given(
    spread_us=st.integers(0, 40_000),
    drift_ppm=st.floats(-400, 400),
    good=st.lists(st.floats(0, 1), min_size=16, max_size=16),
    gap=st.integers(1, 10),
    late_s=st.lists(st.floats(0, 9), min_size=16, max_size=16),
)
def test_the_stated_error_holds_for_any_delays(spread_us, drift_ppm, good, gap, late_s) -> None:
    """A packet a second; one of ``gap`` is anywhere within ``spread_us`` of the least delay, the others are later."""
    packets = []
    for second in range(200):
        delay_s = spread_us / 1e6 + late_s[second % 16]
        if second % gap == 0:
            delay_s = good[second // gap % 16] * spread_us / 1e6
        truth_ns = EPOCH_NS + round(second * S * (1 + drift_ppm * 1e-6))
        packets.append(Packet(second * 1000, truth_ns + round(delay_s * S), truth_ns))
    end_ns = max(one.truth_ns for one in packets[::gap])
    packets = sorted((one for one in packets if one.arrived_ns <= end_ns), key=lambda one: one.arrived_ns)
    assert max(errors_ns(DeviceClock(), packets, SETTLED_S)) <= 2.5 * spread_us * 1000 + 10


@given(
    drift_ppm=st.floats(-400, 400),
    delays_s=st.lists(st.one_of(st.floats(0, 0.05), st.floats(0, 0.9)), min_size=1, max_size=200),
    period_ms=st.integers(1, 500),
)
def test_early_stamps_are_as_good_as_the_best_packet_so_far(drift_ppm, delays_s, period_ms) -> None:
    clock = DeviceClock()
    best_s = math.inf
    for i, delay_s in enumerate(delays_s):
        second = i * period_ms / 1000
        best_s = min(best_s + period_ms * 1e-6, delay_s)
        truth_ns = EPOCH_NS + round(second * S * (1 + drift_ppm * 1e-6))
        error_s = (clock.stamp_ns(i * period_ms, truth_ns + round(delay_s * S)) - truth_ns) / S
        assert error_s >= -second * 1e-3 - 1e-6
        assert error_s <= best_s + 1e-6


@given(
    delays_s=st.lists(st.floats(0, 0.9), max_size=100),
    steps_ms=st.lists(st.integers(0, 3000), min_size=100, max_size=100),
    drift_ppm=st.floats(-400, 400),
)
def test_stamps_go_on_at_half_the_pace_at_least_and_equal_counters_have_equal_stamps(delays_s, steps_ms, drift_ppm):
    clock = DeviceClock()
    device_ms, free_at, last_ns = 0, 0.0, 0
    for delay_s, step_ms in zip(delays_s, steps_ms, strict=False):
        device_ms += step_ms
        free_at = max(free_at, device_ms / 1000 * (1 + drift_ppm * 1e-6) + delay_s)
        arrived_ns = EPOCH_NS + round(free_at * S)
        stamp_ns = clock.stamp_ns(device_ms, arrived_ns)
        if step_ms == 0 and last_ns:
            assert stamp_ns == last_ns
        else:
            assert stamp_ns >= min(last_ns + step_ms * MS // 2, arrived_ns)
        assert most_kept(clock) <= BUCKETS
        last_ns = stamp_ns


# Jumps, and lesser steps

STOOD_STILL = [Packet(7000, EPOCH_NS + i * 100 * MS, 0) for i in range(300)]


@pytest.mark.parametrize("wrap_ms", [None, U32])
@pytest.mark.parametrize(
    ("jump_s", "before", "after", "true", "arrived"),
    [
        *(
            (10, series(600, delay_s=0.01, start_ms=10**6), series(100, from_s=65, delay_s=0.01, start_ms=ms), 0, 0)
            for ms in (-65_000, -25_000, 2_935_000)
        ),
        *(
            (10, series(900, delay_s=0.01), series(900, from_s=90, delay_s=0.01 + step_s), 0, 0)
            for step_s in (-86_400, -11, 11, 10**9)
        ),
        (10, series(900), series(10, from_s=1000, delay_s=0.02), 0, 0),
        (10, STOOD_STILL, series(9, from_s=30, start_ms=-22_900), 0, 0),
        (2, series(100), series(10, from_s=10, delay_s=2.5), 0, 0),
        (10, series(900), series(200, from_s=90, delay_s=3.0), 100, 102),
        (10, series(900), series(900, from_s=90, delay_s=0.3), 0, 700),
        (10, series(30, every_s=5.0), series(12, from_s=150, every_s=5.0, delay_s=1.5), 7, 7),
        (10, series(40, start_ms=0), series(200, from_s=5, start_ms=-5000), 0, 102),
    ],
    ids=[
        *("restart at 0 s", "restart at 40 s", "restart at 50 minutes"),
        *("wall clock a day back", "11 s back", "11 s forward", "30 years forward"),
        *("a long silence", "a counter that has stood still", "a step over a bound of two seconds"),
        *("a small step: after ten seconds", "a tiny one: after the window", "of rare packets: when there are eight"),
        "a restart soon after the beginning: after ten seconds",
    ],
)
def test_a_jump_is_noticed_and_what_is_known_begins_anew(wrap_ms, jump_s, before, after, true, arrived) -> None:
    """The stamps are true up to one packet, and arrivals from another one on."""
    clock = DeviceClock(wrap_ms, jump_s)
    stamps(clock, before)
    taken = stamps(clock, after)
    assert taken[:true] == [one.truth_ns for one in after[:true]]
    assert taken[arrived:] == [one.arrived_ns for one in after[arrived:]]
    assert clock.beginnings == (1 if arrived == 700 else 2)


def stepped_back(step_s: float) -> list[Packet]:
    """What comes after the gateway's clock was set back: the least delay cannot be told from its step."""
    after = series(900, from_s=90, delay_s=0.01 + step_s)
    return series(900, delay_s=0.01) + [one._replace(truth_ns=one.arrived_ns) for one in after]


@pytest.mark.parametrize(
    ("packets", "start", "most_ms"),
    [
        *((stepped_back(step_s), 900, 1) for step_s in (-0.2, -1.5, -9.0)),
        (stepped_back(-0.1), 900, 20),
        (stepped_back(-0.1), 1300, 1),
        ([packet(i / 10, 0.4 if i < 3 else 0.0) for i in range(20)], 3, 1e-6),
        ([packet(i / 10, max(0.0, 8.0 - i / 10)) for i in range(300)], 80, 2),
        ([packet(i / 10, max(0.0, 8.0 - i / 10)) for i in range(300)], 200, 0.1),
        ([packet(i / 10, 0.5 if 1000 <= i < 1500 else 0, ahead_s=i * 2e-5) for i in range(1600)], 640, 2),
        ([packet(i * 30.0, 0.2 if i % 3 else 0.01, ahead_s=i * 30e-4) for i in range(100)], 20, 12),
        ([*(packet(i / 10, 0, ahead_s=i * 1e-5) for i in range(900)), packet(210.0, 0.5, ahead_s=0.021)], 900, 2),
    ],
    ids=[
        *("0.2 s back is followed at once", "1.5 s back", "9 s back"),
        *("0.1 s back leaves 20 ms", "0.1 s back is forgotten after 40 s", "late first packets"),
        *("a backlog at the beginning", "the same, later", "a queue for most of the window", "few packets"),
        "a silence of two minutes, bridged by the drift",
    ],
)
def test_what_disturbs_the_line_leaves_no_greater_error(packets: list[Packet], start: int, most_ms: float) -> None:
    assert max(errors_ns(DeviceClock(), packets)[start:]) < most_ms * MS


ABSURD = [(counter_ms, 9901, 9901) for counter_ms in (-5000, 10**9, 10**400, U32 - 5000)]


@pytest.mark.parametrize(
    "calls",
    [
        [(10_000, 15_000, 10_000), (10_100, 15_000, 10_100), (10_200, 10_500, 10_200)],
        [(2000, 9907, 2000), (9900, 9908, 9900)],
        [(10_000, 10_020 + again * 100, 10_000) for again in range(50)],
        [*((9900, 9900 + again * 100, None) for again in range(300)), (40_000, 40_250, 40_000)],
        [*((9900, 9900 + again * 100, 9900 if again < 101 else 9900 + again * 100) for again in range(300))],
        [*ABSURD, (10_000, 10_700, 10_000)],
    ],
    ids=["late", "older", "a duplicate", "repeated for long, and the next", "stands still", "absurd, and a right one"],
)
def test_a_measurement_has_the_stamp_of_its_counter_or_of_its_arrival(calls: list[tuple[int, int, int | None]]) -> None:
    """After ten seconds without delay; a call is a counter, an arrival and the stamp, in milliseconds since then."""
    clock = DeviceClock()
    stamps(clock, series(100))
    for counter_ms, arrived_ms, stamp_ms in calls:
        stamp_ns = clock.stamp_ns(5000 + counter_ms, EPOCH_NS + arrived_ms * MS)
        assert stamp_ms is None or stamp_ns == EPOCH_NS + stamp_ms * MS
    assert clock.beginnings == 1


@pytest.mark.parametrize("start_ms", [U32 - 5000, U32 - 1, U32 - 100_000])
def test_a_wrap_is_no_restart(start_ms: int) -> None:
    packets, wrapped = journey(exponential, steady(200), minutes=5), DeviceClock(wrap_ms=U32)
    taken = stamps(DeviceClock(), packets)
    assert taken == [wrapped.stamp_ns((one.device_ms + start_ms) % U32, one.arrived_ns) for one in packets]
    assert wrapped.beginnings == 1


def test_the_drift_outlives_a_restart() -> None:
    clock = DeviceClock()
    stamps(clock, [packet(i / 10, 0.0, ahead_s=i / 10 * 2e-4) for i in range(900)])
    assert clock.drift_ppm == pytest.approx(-200, abs=20)
    stamps(clock, series(5, from_s=100.0, start_ms=-100_000))
    assert clock.beginnings == 2
    assert clock.drift_ppm == pytest.approx(-200, abs=20)


@pytest.mark.parametrize("wrap_ms", [None, 1000, 1, 0])
def test_what_is_no_counter_is_stamped_with_its_arrival(wrap_ms: int | None) -> None:
    clock = DeviceClock(wrap_ms)
    for device_ms in (-1, -(10**400), -U32 if wrap_ms is None else wrap_ms):
        assert clock.stamp_ns(device_ms, EPOCH_NS) == EPOCH_NS
    assert clock.beginnings == 0


absurd = st.one_of(
    st.integers(-5, 5000), st.integers(), st.sampled_from([0, U32 - 1, U32, 2**63, 2**64, 10**400, -(10**400)])
)


@given(
    wrap_ms=st.sampled_from([None, U32, 1000, 3]),
    calls=st.lists(st.tuples(absurd, st.one_of(absurd, st.integers(EPOCH_NS, EPOCH_NS + 400 * S))), max_size=60),
)
def test_no_value_raises_or_is_stamped_after_its_arrival(wrap_ms: int | None, calls: list[tuple[int, int]]) -> None:
    clock = DeviceClock(wrap_ms)
    for device_ms, arrived_ns in calls:
        stamp_ns = clock.stamp_ns(device_ms, arrived_ns)
        assert type(stamp_ns) is int
        assert stamp_ns <= arrived_ns
