"""Fragile robots, each a process of its own, so that nothing but the machine makes it late.

``python -m tests.e2e.fragile NAME [OPTIONS]``: prints its port. The line ``cut`` on stdin breaks its connection; any
other ends it, and it prints what it received and what was violated as one JSON object, bytes as hex. NAME is one of
:data:`ROBOTS`; OPTIONS: more arguments of the robot's class, and ``times``, as a JSON object.
"""

import asyncio
import contextlib
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from gateways.alf.conformance import parser as alf_wire
from gateways.alf.conformance.fragile_robot import FragileVehicle
from gateways.tcpudp.conformance import parser as tcpudp_wire
from gateways.tcpudp.conformance.fragile_robot import FragileRobot
from gateways.wc2ec.conformance.fragile_robot import FragileController

ROBOTS: dict[str, Callable[..., Any]] = {
    **{
        f"tcpudp-{version}{'-udp' * udp}": lambda version=version, udp=udp, times=(), **options: FragileRobot(
            version=version, udp=udp, times=tcpudp_wire.Times(**{"part_s": 0.2, **dict(times)}), **options
        )
        for version in ("1.1", "1.2", "1.3", "1.4")
        for udp in (False, True)
    },
    "alf": lambda **options: FragileVehicle(
        "text", laser=True, drive=True, times=alf_wire.Times(info_s=0.2), **options
    ),
    "wc2ec-deployed": lambda **options: FragileController("deployed", **options),
    "wc2ec-draft": lambda **options: FragileController("draft", **options),
}


DISTURBED = 5
"""Most runs against one robot that is disturbed each time."""
_HANDSHAKE = {3, 7}
_RARE, _RARE_S = re.compile(r"no drive command for |\d+ drive commands in "), 0.08
"""What a vehicle says of commands that are too rare, and for how long nobody may be late: 0.1 s less one period."""


def charges(violations: Iterable[str], late_s: float = 0.0) -> list[str]:
    """Give the violations that are not put down to the judge's own lateness.

    ``late_s``: the time that the machine withheld from the gateway, which excuses commands that are too rare.
    """
    mine = [text for text in violations if "(this process" not in text]
    return [text for text in mine if late_s < _RARE_S or not _RARE.search(text)]


def disturbed(report: dict[str, Any]) -> bool:
    """Tell whether a robot lost a packet of the handshake, being late itself: it understands nothing after that."""
    return any(packet_id in _HANDSHAKE for _, _, packet_id, _ in report["piled"])


@contextlib.contextmanager
def fragile_robot(name: str, *, seed: int = 1, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a fragile robot; its first line is its port."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.e2e.fragile", name, json.dumps({"seed": seed, **options})],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(robot: subprocess.Popen[str]) -> dict[str, Any]:
    """End a fragile robot; give what it has to say."""
    report: dict[str, Any] = json.loads(robot.communicate("end\n", timeout=20)[0])
    return report


async def main() -> None:
    robot = ROBOTS[sys.argv[1]](**json.loads(sys.argv[2]) if len(sys.argv) > 2 else {})
    serving = asyncio.create_task(robot.serve("127.0.0.1", 0, lambda port: print(port, flush=True)))
    while await asyncio.to_thread(sys.stdin.readline) == "cut\n":
        robot.cut()
    left = serving.done()
    serving.cancel()
    await asyncio.wait([serving])
    report = {
        "violations": robot.violations,
        "events": robot.events,
        "alive": robot.alive and not getattr(robot, "stuck", False),
        "left": left,
        "moving": robot.machine.moving if hasattr(robot, "machine") else robot.robot.moving,
        **{name: [*map(shown, getattr(robot, name, ()))] for name in ("received", "misread", "piled")},
    }
    print(json.dumps(report))


def shown(row: Any) -> list[Any]:
    return [value.hex() if isinstance(value, bytes) else value for value in row]


if __name__ == "__main__":
    asyncio.run(main())
