"""Drives a robot, runs a command meanwhile, and reports when the robot had stopped, by the robot's own record.

Usage: driven.py BUNDLE ROBOT ACCOUNT LIMIT_S COMMAND...; ACCOUNT is the file that robot.py writes, BUNDLE an
operator's. The driver drives until it loses the lease. Exit code 0: the robot stopped within LIMIT_S seconds of the
command's start, and the command succeeded.
"""

import asyncio
import contextlib
import sys
import time
from pathlib import Path

import zbridge
from zbridge.errors import BusError, Refused

MOVES_S = 20.0
"""Longest wait until the robot moves."""
REST_S = 1.0
"""Time for which it must stay stopped."""
EVERY_S = 0.04
COMMAND_S = 90.0


async def drive_on(bundle: str, robot: str) -> None:
    """Drive until the lease is lost, then return."""
    with contextlib.suppress(Refused, BusError):
        async with zbridge.connect(tls=bundle) as fleet, fleet[robot].control() as drive:
            while True:
                await drive(forward=0.4)
                await asyncio.sleep(EVERY_S)


def last(account: Path) -> tuple[float, float]:
    """Return the time of the last change, and the speed since."""
    rows = [line.split() for line in account.read_text().splitlines() if line[:1].isdigit()]
    return (float(rows[-1][0]), float(rows[-1][1])) if rows else (0.0, 0.0)


async def moves(account: Path) -> bool:
    """Wait until the robot moves; return whether it does."""
    until = time.monotonic() + MOVES_S
    while time.monotonic() < until:
        if last(account)[1]:
            return True
        await asyncio.sleep(0.05)
    return False


async def rest_s(account: Path, since: float, limit_s: float) -> float | None:
    """Wait until the robot stays stopped; return the seconds until it stopped, None if it did not."""
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
            print(f"{robot} did not move within {MOVES_S:g} s")
            return 1
        await asyncio.sleep(1.0)  # the deposit for the gateway's successor is at most a second old
        since = time.monotonic()
        process = await asyncio.create_subprocess_exec(*command, stdout=sys.stderr)
        found = await rest_s(account, since, limit_s)
        async with asyncio.timeout(COMMAND_S):
            code = await process.wait()
    finally:
        driver.cancel()
        await asyncio.wait([driver])
    if found is None or found > limit_s:
        print(f"{robot} did not stop within {limit_s:g} s; last change (time, speed): {last(account)}")
        return 1
    if code:
        print(f"exit code {code}: {' '.join(command)}")
        return 1
    print(f"{robot} stopped after {found:.2f} s")
    return 0


sys.exit(asyncio.run(main(*sys.argv[1:])))
