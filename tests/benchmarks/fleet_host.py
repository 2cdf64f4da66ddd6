"""Robots on one host: until all are established, what each costs, and what one that misbehaves costs the others."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import zenoh

from tests.benchmarks.fleet_robots import SENSOR
from tests.benchmarks.fleet_scene import (
    Command,
    Cost,
    Routers,
    command,
    ports,
    robot_file,
    share_of_a_core,
    when_established,
)
from tests.benchmarks.harness import Process, process
from tests.benchmarks.peer import open_session

PACE_HZ = 20.0
SETTLE_S = 3.0
BAD = "r000"
MODES = ("pace 20", "flood", "pace 20", "hang", "pace 20", "die", "pace 20")
"""What one robot does while the others send at their pace."""


class Gaps:
    """When readings came of each robot."""

    def __init__(self, endpoint: str) -> None:
        self.came_ns: dict[str, list[int]] = defaultdict(list)
        self._session = open_session(connect=endpoint)
        self._session.declare_subscriber(f"fleet/*/{SENSOR}", self._take)

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def measured(self, seconds: float) -> tuple[np.ndarray, int]:
        """Wait; return all gaps of all robots but the bad one, ms, and what came of the bad one."""
        self.came_ns.clear()
        time.sleep(seconds)
        came, bad = dict(self.came_ns), 0
        bad = len(came.pop(BAD, ()))
        return np.concatenate([np.diff(each) / 1e6 for each in came.values()]), bad

    def _take(self, sample: zenoh.Sample) -> None:
        self.came_ns[str(sample.key_expr).split("/")[1]].append(time.perf_counter_ns())


@contextmanager
def host(count: int, *, together: bool) -> Iterator[tuple[Process, Process, str, list[Command], float]]:
    """Run one bad robot, the others, a router and their gateways."""
    with ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="zbridge-fleet-")))
        bad = stack.enter_context(process("tests.benchmarks.fleet_robots", 1))
        good = stack.enter_context(process("tests.benchmarks.fleet_robots", count - 1))
        routers = Routers(1)
        stack.callback(routers.end)
        files = [
            robot_file(directory, f"r{number:03}", port, routers.endpoints[0])
            for number, port in enumerate([*ports(bad), *ports(good)])
        ]
        begun = time.monotonic()
        if together:
            (directory / "host.toml").write_text("[host]\ntogether = true\n")
            gateways = [stack.enter_context(command("run", directory))]
        else:
            gateways = [stack.enter_context(command("run", file)) for file in files]
        yield bad, good, routers.endpoints[0], gateways, begun


def costs(count: int, *, together: bool, idle_s: float) -> None:
    """Print what the gateways of a host cost."""
    with host(1, together=together) as (_, _, endpoint, gateways, begun):
        when_established(endpoint, 1, begun)
        time.sleep(3.0)
        one = Cost.of([each.pid for each in gateways])
    with host(count, together=together) as (_, _, endpoint, gateways, begun):
        established_s = when_established(endpoint, count, begun)
        time.sleep(3.0)
        pids = [each.pid for each in gateways]
        idle = share_of_a_core(pids, idle_s) / count
        cost = Cost.of(pids)
    more_mb = (cost.private_mb - one.private_mb) / (count - 1)
    print(f"{count} robots {'together' if together else 'apart'}")
    print(f"  all established after          {established_s:.1f} s")
    print(f"  private memory                 {one.private_mb:.1f} MB the first, {more_mb:.2f} MB each further")
    print(f"  threads                        {cost.threads}: {cost.threads / count:.1f} a robot")
    print(f"  idle                           {idle:.2f} % of a core a robot", flush=True)


def neighbours(count: int, *, together: bool, seconds: float) -> None:
    """Print the gaps between readings of the good robots while one robot floods, hangs and dies."""
    with host(count, together=together) as (bad, good, endpoint, gateways, begun):
        when_established(endpoint, count, begun)
        gaps = Gaps(endpoint)
        for robots in (bad, good):
            robots.say(f"pace {PACE_HZ:g}")
            robots.hear()
        time.sleep(3.0)
        where, pids = "together" if together else "apart", [each.pid for each in gateways]
        print(f"{count} robots {where}, a reading each {1000 / PACE_HZ:g} ms; gaps of the others, ms")
        print(f"  {'the one':<12}{'p50':>8}{'p99':>8}{'p99.9':>8}{'most':>8}{'CPU %':>8}{'its readings/s':>16}")
        for mode in MODES:
            bad.say(mode)
            bad.hear()
            time.sleep(SETTLE_S)
            before, at = Cost.of(pids).cpu_s, time.monotonic()
            measured, of_the_bad = gaps.measured(seconds)
            cpu = 100 * (Cost.of(pids).cpu_s - before) / (time.monotonic() - at)
            spread = "".join(f"{gap:>8.1f}" for gap in (*np.percentile(measured, (50, 99, 99.9)), measured.max()))
            print(f"  {mode:<12}{spread}{cpu:>8.1f}{of_the_bad / seconds:>16,.0f}", flush=True)
        gaps.close()
