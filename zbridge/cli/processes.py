"""The processes of a demo: started with this Python, ended together; and ports for them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import IO

END_S = 3.0
"""Longest time processes are given to end by themselves."""


def free_port() -> int:
    """Return a port that is free for TCP and UDP, outside the range from which the system assigns ports."""
    while True:
        port = random.randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
            return port


@contextlib.asynccontextmanager
async def process(
    log: IO[bytes], *arguments: str, read: bool = False, state: Path | None = None
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command of ``zbridge`` while the context lasts.

    read: its standard output is a pipe. state: a folder of its own for what it keeps over a restart.
    """
    own = {"STATE_DIRECTORY": str(state)} if state is not None else {}
    started = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "zbridge", *arguments),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE if read else asyncio.subprocess.DEVNULL,
        stderr=log,
        env={**os.environ, "PYTHONUNBUFFERED": "1", **own},
    )
    try:
        yield started
    finally:
        await end((started,))


async def end(processes: Sequence[asyncio.subprocess.Process]) -> None:
    """End processes together; kill those that still run after :data:`END_S`."""
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
    ended = asyncio.gather(*(process.wait() for process in processes))
    try:
        async with asyncio.timeout(END_S):
            await asyncio.shield(ended)
    except TimeoutError:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        await ended
