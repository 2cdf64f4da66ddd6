"""The clock of a device: stamps within the stated error, whatever the delays, and a new beginning after jumps."""

import math
import random
from collections.abc import Callable, Iterable
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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


def late_ns(before: list[Packet], after: list[Packet]) -> list[int]:
    """Tell how much older than their arrival the stamps of ``after`` are, where ``before`` came first."""
    clock = DeviceClock()
    stamps(clock, before)
    return [one.arrived_ns - stamp for stamp, one in zip(stamps(clock, after), after, strict=True)]


def settled(packet: Packet, start_ms: int = 5000) -> bool:
    return packet.device_ms - start_ms >= SETTLED_S * 1000


def floor_ns(packets: list[Packet]) -> int:
    return min(one.arrived_ns - one.truth_ns for one in packets)


def worst_ms(clock: DeviceClock, packets: list[Packet]) -> float:
    """Tell the greatest error of the settled stamps, less the least delay."""
    floor = floor_ns(packets)
    pairs = zip(stamps(clock, packets), packets, strict=True)
    return max(abs(stamp - one.truth_ns - floor) for stamp, one in pairs if settled(one)) / MS


def spread_ms(packets: list[Packet], count: int = 100) -> float:
    """Tell the ``E`` of the stated error: of any ten seconds the best packet, of these the worst."""
    floor = floor_ns(packets)
    late = [one.arrived_ns - one.truth_ns - floor for one in sorted(packets)]
    return max(min(late[i : i + count]) for i in range(len(late) - count + 1)) / MS


def constant(rng: random.Random, second: float) -> float:
    return 0.005


def exponential(rng: random.Random, second: float) -> float:
    return 0.005 + rng.expovariate(1 / 0.02)


def mobile(rng: random.Random, second: float) -> float:
    return 0.04 + rng.expovariate(1 / 0.1)


def burst(rng: random.Random, second: float) -> float:
    """Six seconds of every 23 are three seconds late."""
    return exponential(rng, second) + (3.0 if second % 23 > 17 else 0.0)


def hold(rng: random.Random, second: float) -> float:
    """For eight seconds of every thirty nothing comes, then all at once."""
    return exponential(rng, second) + (30 - second % 30 if second % 30 > 22 else 0.0)


def batch(rng: random.Random, second: float) -> float:
    """The sender writes once a second what it has measured."""
    return 0.005 + 0.9 - (second + 1e-9) % 1.0 + rng.expovariate(1 / 0.002)


def steady(ppm: float) -> Drift:
    return lambda second: ppm * 1e-6 * second


def warming(second: float) -> float:
    """From nothing to 200 ppm, by up to 0.7 ppm per second."""
    return 200e-6 * (second - 280 * (1 - math.exp(-second / 280)))


def swinging(second: float) -> float:
    """Between 200 ppm fast and slow, by up to 1 ppm per second."""
    return 200e-6 * 200 * (1 - math.cos(second / 200))


DRIFTS = {
    "none": (steady(0), 0.0),
    "fast": (steady(200), 0.0),
    "slow": (steady(-200), 0.0),
    "faster": (steady(400), 0.0),
    "warming": (warming, 0.7),
    "swinging": (swinging, 1.0),
}


def assert_within_what_is_stated(packets: list[Packet], bend: float) -> None:
    assert worst_ms(DeviceClock(), packets) <= 2.5 * spread_ms(packets) + 1.5 * bend + 0.01


@pytest.mark.parametrize("drift", DRIFTS)
@pytest.mark.parametrize(
    ("delay", "most_ms"), [(constant, 1.6), (exponential, 2.5), (mobile, 10), (burst, 3), (hold, 4), (batch, 5)]
)
def test_the_error_stays_within_what_is_stated_and_that_is_so_many_milliseconds(delay, most_ms, drift) -> None:
    ahead, bend = DRIFTS[drift]
    assert_within_what_is_stated(journey(delay, ahead, seed=7), bend)
    for seed in range(3):
        assert worst_ms(DeviceClock(), journey(delay, ahead, seed=seed)) <= most_ms


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("drift", ["fast", "swinging"])
def test_the_error_stays_within_what_is_stated_although_packets_overtake_each_other(drift: str, seed: int) -> None:
    ahead, bend = DRIFTS[drift]
    assert_within_what_is_stated(journey(mobile, ahead, seed=seed, in_order=False), bend)


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
    pairs = zip(stamps(DeviceClock(), packets), packets, strict=True)
    errors_ns = [abs(stamp - one.truth_ns) for stamp, one in pairs if settled(one, 0)]
    assert max(errors_ns) <= 2.5 * spread_us * 1000 + 10


@settings(max_examples=2 * settings().max_examples)
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


@settings(max_examples=2 * settings().max_examples)
@given(
    delays_s=st.lists(st.floats(0, 0.9), max_size=100),
    steps_ms=st.lists(st.integers(0, 3000), min_size=100, max_size=100),
    drift_ppm=st.floats(-400, 400),
)
def test_stamps_never_go_back_and_equal_counters_have_equal_stamps(delays_s, steps_ms, drift_ppm) -> None:
    clock = DeviceClock()
    device_ms, free_at, last, before = 0, 0.0, 0, -1
    for delay_s, step_ms in zip(delays_s, steps_ms, strict=False):
        device_ms += step_ms
        free_at = max(free_at, device_ms / 1000 * (1 + drift_ppm * 1e-6) + delay_s)
        stamp_ns = clock.stamp_ns(device_ms, EPOCH_NS + round(free_at * S))
        assert stamp_ns == last if device_ms == before else stamp_ns >= last
        last, before = stamp_ns, device_ms


# Jumps


@pytest.mark.parametrize("wrap_ms", [None, U32])
@pytest.mark.parametrize(
    ("before", "after"),
    [
        *(
            (series(600, delay_s=0.01, start_ms=10**6), series(100, from_s=65, delay_s=0.01, start_ms=ms - 65_000))
            for ms in (0, 700, 40_000, 3_000_000)
        ),
        *(
            (series(900, delay_s=0.01), series(900, from_s=90, delay_s=0.01 + step_s))
            for step_s in (-86_400, -11, 11, 3600, 10**9)
        ),
        (series(900), series(10, from_s=1000, delay_s=0.02)),
        (
            [Packet(7000, EPOCH_NS + i * 100 * MS, 0) for i in range(300)],
            series(100, from_s=30, start_ms=7000 - 29_900),
        ),
    ],
    ids=[
        *("restart at 0 s", "restart at 0.7 s", "restart at 40 s", "restart at 50 minutes"),
        *("wall clock a day back", "11 s back", "11 s forward", "an hour forward", "30 years forward"),
        *("a long silence", "a counter that has stood still"),
    ],
)
def test_after_a_jump_it_begins_anew_and_stamps_are_arrivals(before, after, wrap_ms: int | None) -> None:
    clock = DeviceClock(wrap_ms)
    stamps(clock, before)
    assert stamps(clock, after) == [one.arrived_ns for one in after]
    assert clock.beginnings == 2


def test_the_bound_of_a_step_is_an_argument() -> None:
    clock = DeviceClock(jump_s=2.0)
    stamps(clock, series(100))
    after = series(10, from_s=10, delay_s=2.5)
    assert stamps(clock, after) == [one.arrived_ns for one in after]


@pytest.mark.parametrize(
    ("before", "after", "true", "arrived"),
    [
        (series(900), series(200, from_s=90, delay_s=3.0), 100, 102),
        (series(900), series(900, from_s=90, delay_s=0.3), 0, 700),
        (series(30, every_s=5.0), series(12, from_s=150, every_s=5.0, delay_s=1.5), 7, 7),
    ],
    ids=["small: after ten seconds", "tiny: after the window", "of rare packets: when there are eight"],
)
def test_a_step_forward_is_noticed(before: list[Packet], after: list[Packet], true: int, arrived: int) -> None:
    """The stamps are true up to one packet, and arrivals from another one on."""
    clock = DeviceClock()
    stamps(clock, before)
    taken = stamps(clock, after)
    assert taken[:true] == [one.truth_ns for one in after[:true]]
    assert taken[arrived:] == [one.arrived_ns for one in after[arrived:]]


def test_a_restart_soon_after_the_beginning_is_noticed_after_ten_seconds() -> None:
    clock = DeviceClock()
    stamps(clock, series(40, start_ms=0))
    after = series(200, from_s=5, start_ms=-5000)
    taken = stamps(clock, after)
    assert taken[0] == after[0].truth_ns - 5 * S
    assert taken[102:] == [one.truth_ns for one in after[102:]]
    assert clock.beginnings == 2


def test_the_first_stamp_is_the_arrival() -> None:
    assert DeviceClock().stamp_ns(123, EPOCH_NS) == EPOCH_NS


def test_a_late_packet_has_the_stamp_of_its_counter() -> None:
    clock = DeviceClock()
    stamps(clock, series(100))
    for second, delay_s in ((10.0, 5.0), (10.1, 4.9), (10.2, 0.3)):
        late = packet(second, delay_s)
        assert clock.stamp_ns(late.device_ms, late.arrived_ns) == late.truth_ns


def test_a_late_first_packet_is_made_good_by_the_first_in_time() -> None:
    packets = [packet(i / 10, 0.4 if i < 3 else 0.0) for i in range(20)]
    pairs = zip(stamps(DeviceClock(), packets), packets, strict=True)
    assert [(stamp - one.truth_ns) / MS for stamp, one in pairs] == [400] * 3 + [0] * 17


def test_stamps_go_on_at_half_the_pace_at_least_although_the_line_falls() -> None:
    packets = journey(mobile, swinging, minutes=5)
    taken = stamps(DeviceClock(), packets)
    for i in range(1, len(packets)):
        least_ns = (packets[i].device_ms - packets[i - 1].device_ms) * MS // 2
        assert taken[i] - taken[i - 1] >= least_ns or taken[i] == packets[i].arrived_ns


def test_a_backlog_at_the_beginning_is_forgotten_with_the_first_packet_in_time() -> None:
    clock = DeviceClock()
    packets = [packet(i / 10, max(0.0, 8.0 - i / 10)) for i in range(300)]
    taken = stamps(clock, packets)
    errors_ns = [abs(stamp - one.truth_ns) for stamp, one in zip(taken, packets, strict=True)]
    assert max(errors_ns[80:]) < 2 * MS
    assert max(errors_ns[200:]) < MS // 10


def test_an_older_packet_is_stamped_by_its_counter_and_moves_nothing() -> None:
    clock = DeviceClock()
    packets = series(50)
    stamps(clock, packets)
    older = packets[20]
    assert clock.stamp_ns(older.device_ms, packets[-1].arrived_ns + 7) == older.truth_ns
    assert clock.stamp_ns(packets[-1].device_ms, packets[-1].arrived_ns + 8) == packets[-1].truth_ns


def test_silence_of_two_minutes_is_bridged_by_the_drift() -> None:
    clock = DeviceClock()
    stamps(clock, [packet(i / 10, 0.0, ahead_s=i / 10 * 1e-4) for i in range(900)])
    late = packet(210.0, 0.5, ahead_s=210.0 * 1e-4)
    assert clock.stamp_ns(late.device_ms, late.arrived_ns) == pytest.approx(late.truth_ns, abs=2 * MS)


def test_few_packets_are_mapped_as_well() -> None:
    clock = DeviceClock()
    packets = [packet(i * 30.0, 0.2 if i % 3 else 0.01, ahead_s=i * 30 * 1e-4) for i in range(100)]
    taken = stamps(clock, packets)
    assert max(abs(stamp - one.truth_ns) for stamp, one in zip(taken[20:], packets[20:], strict=True)) < 12 * MS


@pytest.mark.parametrize("start_ms", [U32 - 5000, U32 - 1, U32 - 100_000])
def test_a_wrap_is_no_restart(start_ms: int) -> None:
    packets = journey(exponential, steady(200), minutes=5)
    clock, wrapped = DeviceClock(), DeviceClock(wrap_ms=U32)
    taken = stamps(clock, packets)
    assert taken == [wrapped.stamp_ns((one.device_ms + start_ms) % U32, one.arrived_ns) for one in packets]
    assert wrapped.beginnings == 1


def test_without_a_wrap_the_counter_is_any_integer() -> None:
    clock = DeviceClock()
    arrivals_ns = [EPOCH_NS + i * 100 * MS for i in range(100)]
    assert [clock.stamp_ns(10**30 + i * 100, arrived_ns) for i, arrived_ns in enumerate(arrivals_ns)] == arrivals_ns


def test_the_drift_outlives_a_restart() -> None:
    clock = DeviceClock()
    stamps(clock, [packet(i / 10, 0.0, ahead_s=i / 10 * 2e-4) for i in range(900)])
    assert clock.drift_ppm == pytest.approx(-200, abs=20)
    stamps(clock, [packet(100.0 + i / 10, 0.0, start_ms=-100_000) for i in range(5)])
    assert clock.beginnings == 2
    assert clock.drift_ppm == pytest.approx(-200, abs=20)


def test_one_absurd_value_is_stamped_with_its_arrival_and_forgotten() -> None:
    clock = DeviceClock()
    packets = series(100)
    stamps(clock, packets)
    arrived_ns = packets[-1].arrived_ns
    for absurd in (0, 10**9, 10**400, U32):
        assert clock.stamp_ns(absurd, arrived_ns + MS) == arrived_ns + MS
    late = packet(10.0, 0.7)
    assert clock.stamp_ns(late.device_ms, late.arrived_ns) == late.truth_ns
    assert clock.beginnings == 1


@pytest.mark.parametrize("step_s", [-0.2, -1.5, -9.0])
def test_a_small_step_backwards_is_followed_at_once(step_s: float) -> None:
    assert max(late_ns(series(900, delay_s=0.01), series(900, from_s=90, delay_s=0.01 + step_s))) < MS


def test_a_tiny_step_backwards_leaves_twenty_milliseconds_for_forty_seconds() -> None:
    errors_ns = late_ns(series(900, delay_s=0.01), series(900, from_s=90, delay_s=-0.09))
    assert max(errors_ns) < 20 * MS
    assert max(errors_ns[400:]) < MS


def test_a_queue_of_less_than_a_second_for_most_of_the_window_moves_little() -> None:
    packets = [packet(i / 10, 0.5 if 1000 <= i < 1500 else 0.0, ahead_s=i / 10 * 2e-4) for i in range(1600)]
    taken = stamps(DeviceClock(), packets)
    assert max(abs(stamp - one.truth_ns) for stamp, one in zip(taken[640:], packets[640:], strict=True)) < 2 * MS


def test_a_duplicate_has_the_same_stamp() -> None:
    clock = DeviceClock()
    stamps(clock, series(50))
    once = packet(5.0, 0.02)
    twice = [clock.stamp_ns(once.device_ms, once.arrived_ns + again * 100 * MS) for again in range(50)]
    assert twice == [once.truth_ns] * 50


def test_a_counter_that_stands_still_is_no_clock_after_ten_seconds() -> None:
    clock = DeviceClock(U32)
    taken = [clock.stamp_ns(0, EPOCH_NS + i * 100 * MS) for i in range(500)]
    assert taken[:101] == [EPOCH_NS] * 101
    assert taken[101:] == [EPOCH_NS + i * 100 * MS for i in range(101, 500)]
    assert clock.beginnings == 1


def test_a_measurement_repeated_for_long_does_not_disturb_the_next() -> None:
    clock = DeviceClock()
    packets = series(100)
    stamps(clock, packets)
    for i in range(300):
        clock.stamp_ns(packets[-1].device_ms, packets[-1].arrived_ns + i * 100 * MS)
    late = packet(40.0, 0.25)
    assert clock.stamp_ns(late.device_ms, late.arrived_ns) == late.truth_ns
    assert clock.beginnings == 1


@pytest.mark.parametrize("wrap_ms", [None, 1000, 1, 0])
def test_what_is_no_counter_is_stamped_with_its_arrival(wrap_ms: int | None) -> None:
    clock = DeviceClock(wrap_ms)
    for device_ms in (-1, -(10**400), -U32):
        assert clock.stamp_ns(device_ms, EPOCH_NS) == EPOCH_NS
    if wrap_ms is not None:
        assert clock.stamp_ns(wrap_ms, EPOCH_NS) == EPOCH_NS
    assert clock.beginnings == 0


absurd = st.one_of(
    st.integers(-5, 5000), st.integers(), st.sampled_from([0, U32 - 1, U32, 2**63, 2**64, 10**400, -(10**400)])
)


@settings(max_examples=3 * settings().max_examples)
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
        assert repr(clock)


def test_memory_is_bounded() -> None:
    clock = DeviceClock()
    stamps(clock, journey(exponential, steady(200), minutes=11))
    assert repr(clock).endswith(f" {BUCKETS} buckets, 1 beginnings>")
    assert len(clock._points) == BUCKETS


def test_a_clock_prints_its_drift() -> None:
    assert repr(DeviceClock()) == "<DeviceClock +0.0 ppm, 0 buckets, 0 beginnings>"
