"""A fleet behind several routers: until all are there, until ``ls`` sees all, and a router's restart."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from tests.benchmarks.fleet_scene import (
    Cost,
    Routers,
    command,
    listed,
    ports,
    robot_file,
    share_of_a_core,
    when_established,
)
from tests.benchmarks.harness import process

GROUP = 250
"""Gateways with a session each in one process."""
SETTLE_S = 10.0


def fleet(count: int, *, routers: int, processes: int) -> None:
    """Measure a fleet of ``count`` gateways and print what came of it."""
    processes = min(processes, count)
    with ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="zbridge-fleet-")))
        robots = stack.enter_context(process("tests.benchmarks.fleet_robots", count))
        linked = Routers(routers)
        stack.callback(linked.end)
        at = linked.endpoints
        files = [
            robot_file(directory, f"r{number:05}", port, at[number % routers])
            for number, port in enumerate(ports(robots))
        ]
        begun = time.monotonic()
        own = [stack.enter_context(command("run", file)) for file in files[:processes]]
        groups = [
            stack.enter_context(process("tests.benchmarks.fleet_gateways", directory, first, min(GROUP, count - first)))
            for first in range(processes, count, GROUP)
        ]
        print(
            f"{count} gateways ({processes} in processes of their own, {len(groups)} for the rest), {routers} routers"
        )
        print(f"  all established after          {when_established(at[0], count, begun):.1f} s", flush=True)
        time.sleep(SETTLE_S)
        for number, endpoint in enumerate(at):
            there, seconds = listed(endpoint)
            print(f"  ls at router {number}                 {there} robots in {seconds:.1f} s", flush=True)
        _costs([each.pid for each in linked.running], "a router", len(linked.running))
        if own:
            _costs([each.pid for each in own], "a gateway of its own process", len(own))
        if groups:
            _costs([each.pid for each in groups], "a gateway with a session of its own", count - processes)
        begun = time.monotonic()
        linked.restart(routers - 1)
        print(f"  router {routers - 1} killed and restarted")
        for number in (routers - 1, 0):
            print(
                f"    all seen again at router {number}    after {when_established(at[number], count, begun):.1f} s",
                flush=True,
            )
        there, seconds = listed(at[routers - 1])
        print(f"    ls there                     {there} robots in {seconds:.1f} s")


def _costs(pids: list[int], what: str, count: int) -> None:
    cpu, cost = share_of_a_core(pids, SETTLE_S), Cost.of(pids)
    print(
        f"  {what:<30} {cost.private_mb / count:.2f} MB private, {cost.threads / count:.1f} threads,"
        f" {cpu / count:.2f} % of a core",
        flush=True,
    )
