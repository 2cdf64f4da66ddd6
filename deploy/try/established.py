"""Waits until robots are established, as seen by a viewer over mutual TLS.

Usage: established.py BUNDLE ROBOT...
"""

import asyncio
import sys

import zbridge
from zbridge.errors import ZbridgeError

WITHIN_S = 40.0


async def all_established(bundle: str, names: list[str]) -> bool:
    """Return whether all robots are established. Reconnects, because the router may just have been restarted."""
    async with zbridge.connect(tls=bundle) as fleet:
        found = await fleet.robots()
    return all((status := found.get(name)) is not None and status.state == "established" for name in names)


async def main(bundle: str, *names: str) -> int:
    """Poll until all robots are established, for WITHIN_S seconds at most; return the exit code."""
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
