"""Drives a robot, runs a command meanwhile, and tells after how long the robot was at rest, by its own account.

Usage: driven.py BUNDLE ROBOT ACCOUNT LIMIT_S COMMAND...; ACCOUNT is that of robot.py, BUNDLE an operator's. The driver
drives on for as long as it may. Exit code 0: at rest within LIMIT_S seconds since the command began, and the command
went well.
"""

import asyncio
import contextlib
import sys
import time
from pathlib import Path

import zbridge
from zbridge.errors import BusError, Refused

MOVES_S = 20.0
"""Longest time until the robot moves."""
REST_S = 1.0
"""Time for which it must stay at rest."""
EVERY_S = 0.04
COMMAND_S = 90.0


async def drive_on(bundle: str, robot: str) -> None:
    """Drive until the lease is lost; then do nothing more."""
    with contextlib.suppress(Refused, BusError):
        async with zbridge.connect(tls=bundle) as fleet, fleet[robot].control() as drive:
            while True:
                await drive(forward=0.4)
                await asyncio.sleep(EVERY_S)


def last(account: Path) -> tuple[float, float]:
    """Give the time of the last change, and the speed since."""
    rows = [line.split() for line in account.read_text().splitlines() if line[:1].isdigit()]
    return (float(rows[-1][0]), float(rows[-1][1])) if rows else (0.0, 0.0)


async def moves(account: Path) -> bool:
    """Wait until the robot moves; whether it does."""
    until = time.monotonic() + MOVES_S
    while time.monotonic() < until:
        if last(account)[1]:
            return True
        await asyncio.sleep(0.05)
    return False


async def rest_s(account: Path, since: float, limit_s: float) -> float | None:
    """Wait until the robot stays at rest; give the seconds until then, None if it does not."""
    while time.monotonic() < since + limit_s + REST_S:
        at, speed = last(account)
        if not speed and time.monotonic() - max(at, since) >= REST_S:
            return max(0.0, at - since)
        await asyncio.sleep(0.05)
    return None


async def main(bundle: str, robot: str, path: str, limit: str, *command: str) -> int:
    """Drive, run the command, judge."""
    account, limit_s = Path(path), float(limit)
    driver = asyncio.create_task(drive_on(bundle, robot))
    try:
        if not await moves(account):
            print(f"{robot} was never driven")
            return 1
        await asyncio.sleep(1.0)  # what the gateway deposits for its successor is a second old at most
        since = time.monotonic()
        process = await asyncio.create_subprocess_exec(*command, stdout=sys.stderr)
        found = await rest_s(account, since, limit_s)
        async with asyncio.timeout(COMMAND_S):
            code = await process.wait()
    finally:
        driver.cancel()
        await asyncio.wait([driver])
    if found is None or found > limit_s:
        print(f"{robot} is not at rest {limit_s:g} s after: {last(account)}")
        return 1
    if code:
        print(f"exit code {code}: {' '.join(command)}")
        return 1
    print(f"{robot} at rest after {found:.2f} s")
    return 0


sys.exit(asyncio.run(main(*sys.argv[1:])))
