"""What a gateway tells of itself once a second, and what its process uses."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from pathlib import Path

import pytest

from tests.fake_bus import FakeBus
from zbridge.app.process_usage import APART_S, SLOW_S, ProcessUsage, free_bytes
from zbridge.app.stats import PERIOD_S, GatewayStats, StatsPublisher
from zbridge.fleet.payload import decode
from zbridge.fleet.processes import DiskSpace, ProcessStats, Stats
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics

KEYS = KeySpace("fleet", "r1")


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class FixedUsage(ProcessUsage):
    def read(self) -> ProcessStats:
        return ProcessStats("hub", 7, "0.1.0", robots=self.robots)

    def free(self, robot: str) -> tuple[DiskSpace, ...]:
        return (DiskSpace("audit", f"/log/{robot}", 5),)


def stats(metrics: Metrics, clock: Clock) -> GatewayStats:
    return GatewayStats("r1", metrics, FixedUsage(), (), clock, lambda: 12345)


def test_rates_are_what_was_published_since_the_reading_before_by_the_first_part_of_the_key() -> None:
    metrics, clock = Metrics(), Clock()
    reads = stats(metrics, clock)
    for key, count in (("pose", 10), ("sensor", 40), ("map", 0)):
        metrics.count("bus_messages", direction="out", kind=key).value += count
    metrics.count("camera_published").value += 5
    clock.now += 2.0
    assert reads.read().rates == {"pose": 5.0, "sensor": 20.0, "image": 2.5}
    clock.now += 1.0
    metrics.count("bus_messages", direction="out", kind="pose").value += 1
    assert reads.read().rates == {"pose": 1.0}


def test_gaps_refusals_and_drops_are_summed_over_all_parts_of_the_gateway() -> None:
    metrics, clock = Metrics(), Clock()
    metrics.count("sequence_gaps", link="a").value = 2
    metrics.count("sequence_gaps", link="b").value = 3
    metrics.count("refused", code="held").value = 7
    metrics.count("bus_dropped", queue="bus_in").value = 11
    metrics.count("audit_lines_dropped").value = 13
    read = stats(metrics, clock).read(0.25)
    assert (read.stamp_ns, read.gaps, read.refused, read.dropped) == (12345, 5, 7, 24)
    assert (read.process.late_s, read.disks) == (0.25, (DiskSpace("audit", "/log/r1", 5),))


@pytest.mark.jumping
async def test_it_is_published_at_once_then_every_second_until_it_is_closed() -> None:
    bus = FakeBus()
    reads = stats(Metrics(), Clock())
    publisher = StatsPublisher(bus, KEYS, reads)
    await asyncio.sleep(3.5 * PERIOD_S)
    seen = [decode(Stats, payload) for payload in bus.values("fleet/r1/@gateway/stats")]
    assert [each.process.robots for each in seen] == [1, 1, 1, 1]
    assert bus.values("fleet/r1/**") == []
    publisher.close()
    publisher.close()
    await asyncio.sleep(2 * PERIOD_S)
    assert len(bus.values("fleet/r1/@gateway/stats")) == 4
    assert reads.usage.robots == 0


def test_a_process_reads_its_own_processor_memory_and_descriptors(tmp_path: Path) -> None:
    clock = Clock()
    usage = ProcessUsage(clock)
    usage.disks["r1"] = (("audit", tmp_path / "not" / "there" / "yet.log"),)
    first = usage.read()
    until = time.process_time() + 0.05
    while time.process_time() < until:
        pass
    clock.now += 1.0
    assert usage.read().cpu >= 0.05
    assert first.pid == os.getpid()
    assert first.resident_bytes > 10_000_000
    assert first.uptime_s > 0.0
    join()
    clock.now += SLOW_S
    known = usage.read()
    assert known.proportional_bytes is not None
    assert 0 < known.proportional_bytes <= 2 * known.resident_bytes
    assert 3 <= known.files <= known.most_files
    (disk,) = usage.free("r1")
    assert disk.free_bytes > 0
    assert usage.free("r2") == ()
    join()


def join() -> None:
    for thread in threading.enumerate():
        if thread.name == "zbridge-usage":
            thread.join(5.0)


def test_the_gateways_of_one_process_share_a_reading() -> None:
    clock = Clock()
    usage = ProcessUsage(clock)
    first = usage.read()
    clock.now += APART_S / 2
    assert usage.read() is first
    clock.now += APART_S
    assert usage.read() is not first
    join()


def test_a_disk_that_hangs_costs_one_thread_and_no_reading_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    hang = threading.Event()
    monkeypatch.setattr("zbridge.app.process_usage.free_bytes", lambda path: hang.wait(10.0) and None)
    clock = Clock()
    usage = ProcessUsage(clock)
    usage.disks["r1"] = (("audit", Path("/nfs/r1.log")),)
    for _ in range(3):
        usage.read()
        clock.now += SLOW_S
    assert sum(thread.name == "zbridge-usage" for thread in threading.enumerate()) == 1
    hang.set()
    join()


def test_a_path_whose_folders_are_not_there_yet_has_the_disk_of_the_nearest_one_that_is(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "a" / "b") == pytest.approx(free_bytes(tmp_path), rel=0.01)
