"""Waits until robots are established, as a viewer sees it over mutual TLS.

Usage: established.py BUNDLE ROBOT...
"""

import asyncio
import sys

import zbridge
from zbridge.errors import ZbridgeError

WITHIN_S = 40.0


async def all_established(bundle: str, names: list[str]) -> bool:
    """Connect anew, for the router may just have been restarted; whether all robots are established now."""
    async with zbridge.connect(tls=bundle) as fleet:
        found = await fleet.robots()
    return all((status := found.get(name)) is not None and status.state == "established" for name in names)


async def main(bundle: str, *names: str) -> int:
    """Ask until all robots are established, or the time is over."""
    told = ""
    try:
        async with asyncio.timeout(WITHIN_S):
            while True:
                try:
                    if await all_established(bundle, list(names)):
                        return 0
                except ZbridgeError as error:
                    told = str(error)
                await asyncio.sleep(0.5)
    except TimeoutError:
        print(f"not established: {' '.join(names)} {told}", file=sys.stderr)
        return 1


sys.exit(asyncio.run(main(*sys.argv[1:])))
