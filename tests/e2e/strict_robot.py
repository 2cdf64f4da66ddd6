"""The strict robot as a process of its own, so that nothing but the machine makes it late.

``python -m tests.e2e.strict_robot VERSION UDP SEED``: prints its port; a line on stdin ends it, and it prints what
it received and what was violated as one JSON object.
"""

from __future__ import annotations

import asyncio
import json
import sys

from gateways.tcpudp.strict import StrictRobot
from gateways.tcpudp.strict_parser import Times


async def main() -> None:
    version, udp, seed = sys.argv[1], sys.argv[2] == "1", int(sys.argv[3])
    robot = StrictRobot(version=version, udp=udp, seed=seed, times=Times(part_s=0.2))
    serving = asyncio.create_task(robot.serve("127.0.0.1", 0, lambda port: print(port, flush=True)))
    await asyncio.to_thread(sys.stdin.readline)
    serving.cancel()
    await asyncio.wait([serving])
    print(
        json.dumps(
            {
                "violations": robot.violations,
                "events": robot.events,
                "alive": robot.alive,
                "received": [(channel, packet_id, body.hex()) for _, channel, packet_id, body in robot.received],
            }
        )
    )


if __name__ == "__main__":
    asyncio.run(main())
