"""The fragile robot as a process of its own, so that nothing but the machine makes it late.

``python -m tests.e2e.fragile_robot VERSION UDP SEED [OPTIONS]``: prints its port. The line ``cut`` on stdin breaks its
connection; any other ends it, and it prints what it received and what was violated as one JSON object. OPTIONS: more
arguments of :class:`FragileRobot`, and ``times``, as a JSON object.
"""

import asyncio
import json
import sys

from gateways.tcpudp.conformance.fragile_robot import FragileRobot
from gateways.tcpudp.conformance.parser import Times


async def main() -> None:
    version, udp, seed = sys.argv[1], sys.argv[2] == "1", int(sys.argv[3])
    options = json.loads(sys.argv[4]) if len(sys.argv) > 4 else {}
    times = Times(**{"part_s": 0.2, **options.pop("times", {})})
    robot = FragileRobot(version=version, udp=udp, seed=seed, times=times, **options)
    serving = asyncio.create_task(robot.serve("127.0.0.1", 0, lambda port: print(port, flush=True)))
    while await asyncio.to_thread(sys.stdin.readline) == "cut\n":
        robot.cut()
    serving.cancel()
    await asyncio.wait([serving])
    print(
        json.dumps(
            {
                "violations": robot.violations,
                "events": robot.events,
                "alive": robot.alive,
                "moving": robot.machine.moving,
                "received": [(channel, packet_id, body.hex()) for _, channel, packet_id, body in robot.received],
                "misread": [(channel, packet_id, body.hex()) for _, channel, packet_id, body in robot.misread],
                "piled": [(channel, packet_id, body.hex()) for _, channel, packet_id, body in robot.piled],
            }
        )
    )


if __name__ == "__main__":
    asyncio.run(main())
