"""Waits until robots are established, as a viewer sees it over mutual TLS."""

import argparse
import asyncio
import sys

import zbridge
from zbridge.bus import Tls
from zbridge.errors import ZbridgeError

WITHIN_S = 30.0
ENDPOINT = "tls/127.0.0.1:7447"


async def all_established(folder: str, names: list[str]) -> bool:
    """Connect anew, for the router may just have been restarted; whether all robots are established now."""
    tls = Tls(f"{folder}/ca.pem", f"{folder}/wall/certificate.pem", f"{folder}/wall/key.pem")
    async with zbridge.connect(endpoints=[ENDPOINT], tls=tls) as fleet:
        found = await fleet.robots()
    return all((status := found.get(name)) is not None and status.state == "established" for name in names)


async def main(folder: str, names: list[str]) -> int:
    """Ask until all robots are established, or the time is over."""
    try:
        async with asyncio.timeout(WITHIN_S):
            while True:
                try:
                    if await all_established(folder, names):
                        return 0
                except ZbridgeError as error:
                    print(error, file=sys.stderr)
                await asyncio.sleep(0.5)
    except TimeoutError:
        return 1


parser = argparse.ArgumentParser()
parser.add_argument("--folder", default="/root/certs")
parser.add_argument("robots", nargs="+")
given = parser.parse_args()
sys.exit(asyncio.run(main(given.folder, given.robots)))
