"""Starts gateway processes of one robot: forks them, each with the content of the robot's file as it was checked."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from pathlib import Path

from zbridge.errors import NotReady
from zbridge.host.fd_channel import Post
from zbridge.host.files import RobotFile
from zbridge.host.forks import Forks
from zbridge.host.messages import Fork
from zbridge.host.process import GatewayProcess

log = logging.getLogger("zbridge.host")

STAT_S = 1.0
"""Longest wait for the disk to tell whether a robot file is still there."""

Make = Callable[[int, Post, RobotFile], GatewayProcess]
"""``make(pid, post, file)``: the process as its runner knows it."""


class Launcher:
    """Starts processes; ``make`` makes of each what its runner knows."""

    def __init__(self, forks: Forks, make: Make, *, verbose: bool) -> None:
        self._forks = forks
        self._make = make
        self._verbose = verbose

    def __repr__(self) -> str:
        return f"<Launcher by {self._forks!r}>"

    async def start(self, file: RobotFile, take_over: int | None = None, *, at_once: bool = False) -> GatewayProcess:
        """Fork a process; raise NotReady with the reason: also that the file is gone, whatever stood in it.

        take_over: descriptor of the socket by which it takes over. at_once: without a look at the installation.
        """
        if not await _is_there(file.path):
            raise NotReady(f"{file.path} is gone")
        try:
            post, far = Post.pair()
        except OSError as error:
            raise NotReady(error.strerror or str(error)) from error
        request = Fork(str(file.path), file.robot, self._verbose)
        try:
            with far:
                pid = await self._forks.fork(request, far, file.content, take_over, at_once=at_once)
        except NotReady:
            post.close()
            raise
        log.info("%s: process %d", file.robot, pid)
        return self._make(pid, post, file)


async def _is_there(path: Path) -> bool:
    """Whether a file is there, as far as the disk tells in time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(STAT_S):
            return await asyncio.to_thread(path.exists)
    return True
