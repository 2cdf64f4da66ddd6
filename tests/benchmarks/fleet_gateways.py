"""Gateways in one process, each with a session of its own on the bus: what a process each would declare and say.

``python -m tests.benchmarks.fleet_gateways DIRECTORY FIRST COUNT``: those robot files of a directory.
"""

from __future__ import annotations

import asyncio
import logging
import random
import resource
import sys
from pathlib import Path

from tests.benchmarks.peer import tell
from zbridge.app import Gateway, load
from zbridge.cli import run_loop
from zbridge.host.settings import HostSettings, robot_files

STAGGER_S = HostSettings().stagger_s


async def main() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    first, count = int(sys.argv[2]), int(sys.argv[3])
    files = robot_files(Path(sys.argv[1]))[first : first + count]
    tell(ready=True)

    async def run(number: int, file: Path) -> None:
        await asyncio.sleep((number + random.random()) * STAGGER_S)
        await Gateway(load(file)).run()

    async with asyncio.TaskGroup() as tasks:
        for number, file in enumerate(files):
            tasks.create_task(run(number, file))


if __name__ == "__main__":
    logging.basicConfig(level=logging.ERROR)
    run_loop(main())
