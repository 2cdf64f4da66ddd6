"""A fragile robot of any protocol as a process of its own, so that nothing but the machine makes it late.

``python -m tests.e2e.hq_robot NAME``: prints its port; a line on stdin ends it, and it prints what it received and
what was violated as one JSON object. It says more often than deployed robots where it is: tests are short.
"""

import asyncio
import contextlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

from gateways.alf.conformance import fragile_robot as alf
from gateways.alf.conformance import parser as alf_parser
from gateways.tcpudp.conformance import fragile_robot as tcpudp
from gateways.tcpudp.conformance import parser as tcpudp_parser
from gateways.wc2ec.conformance import fragile_robot as wc2ec

SEED = 1
ROBOTS: dict[str, Callable[[], Any]] = {
    "tcpudp-1.1": lambda: _tcpudp("1.1", udp=False),
    "tcpudp-1.2": lambda: _tcpudp("1.2", udp=False),
    "tcpudp-1.3": lambda: _tcpudp("1.3", udp=True),
    "alf": lambda: alf.FragileVehicle("text", laser=True, drive=True, seed=SEED, times=alf_parser.Times(info_s=0.2)),
    "wc2ec": lambda: wc2ec.FragileController("deployed", seed=SEED),
}


def _tcpudp(version: str, *, udp: bool) -> tcpudp.FragileRobot:
    times = tcpudp_parser.Times(unasked_s=0.05)
    return tcpudp.FragileRobot(version=version, udp=udp, seed=SEED, misnamed=0.0, times=times)


@contextlib.contextmanager
def fragile_robot(name: str) -> Iterator[subprocess.Popen[str]]:
    """Run a fragile robot; its first line is its port."""
    command = [sys.executable, "-m", "tests.e2e.hq_robot", name]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


async def main() -> None:
    robot = ROBOTS[sys.argv[1]]()
    serving = asyncio.create_task(robot.serve("127.0.0.1", 0, lambda port: print(port, flush=True)))
    await asyncio.to_thread(sys.stdin.readline)
    serving.cancel()
    await asyncio.wait([serving])
    report = {
        "violations": robot.violations,
        "events": robot.events,
        "alive": robot.alive and not getattr(robot, "stuck", False),
        "received": [[value.hex() if isinstance(value, bytes) else value for value in row] for row in robot.received],
    }
    print(json.dumps(report))


if __name__ == "__main__":
    asyncio.run(main())
