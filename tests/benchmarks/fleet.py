"""The benchmark of fleets: many gateways on one host, and many more behind several routers.

    python -m tests.benchmarks.fleet --host 30 [--apart] [--quick]
    python -m tests.benchmarks.fleet N [--routers 3] [--processes 20] [--quick]

The first measures one host: all robots in one process (``together``), or each in its own (``--apart``): until all are
established, private memory, threads, idle CPU, and what one robot that floods, hangs or dies costs the others. The
second measures a fleet of ``N`` gateways behind routers: so many in processes of their own, the rest as gateways with
a session each in a few processes. Robots are silent sockets. ``--quick`` takes less time for a first look.
"""

from __future__ import annotations

import argparse

from tests.benchmarks.fleet_host import costs, neighbours
from tests.benchmarks.fleet_routers import fleet


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robots", nargs="?", type=int, default=0)
    parser.add_argument("--host", type=int, default=0, help="so many robots on one host")
    parser.add_argument("--apart", action="store_true", help="a process for each robot of the host")
    parser.add_argument("--routers", type=int, default=3)
    parser.add_argument("--processes", type=int, default=20, help="gateways with a process of their own")
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    if given.host:
        costs(given.host, together=not given.apart, idle_s=5.0 if given.quick else 20.0)
        neighbours(given.host, together=not given.apart, seconds=5.0 if given.quick else 20.0)
    if given.robots:
        fleet(given.robots, routers=given.routers, processes=given.processes)


if __name__ == "__main__":
    main()
