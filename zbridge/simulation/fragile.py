"""What fragile robots share: a server that serves one connection. And what the command line prints of any judge.

Shares no code with the gateway's transport. Knows no protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import sys
from abc import abstractmethod
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from zbridge.simulation.judge import Ended, Judge
from zbridge.simulation.sockets import bind_tcp, send_at_once

_UNANSWERED = 16
Work = Coroutine[Any, Any, None]


class FragileServer(Judge):
    """A robot that serves one connection per start; it accepts every later one and never answers it.

    A protocol contributes :meth:`_begin`, :meth:`_phase_name` and :meth:`_work`, and ends its tasks by raising Ended.
    """

    def __init__(self, *, keep: int, note: Callable[[str], None] | None) -> None:
        super().__init__(keep=keep, note=note)
        self.ending = ""
        """Why it ended by itself, "" if it did not."""
        self._over = asyncio.Event()
        """Set once the conversation is over."""
        self._tasks: asyncio.TaskGroup | None = None
        self._running: list[asyncio.Task[None]] = []

    async def serve(self, host: str, port: int, ready: Callable[[int], None]) -> None:
        """Serve on ``port`` (0: any; ``ready`` is called with it) until dead, ended or cancelled."""
        try:
            with contextlib.ExitStack() as sockets:
                server = self._bind(host, port, sockets)
                ready(server.getsockname()[1])
                try:
                    async with asyncio.TaskGroup() as self._tasks:
                        for work in (self._accept(server, sockets), *self._work()):
                            self._start(work)
                except* Ended as ended:
                    self.ending = str(ended.exceptions[0])
                    self._event(self.ending)
                finally:
                    self._before_close()
        finally:
            self._over.set()

    # What a protocol contributes

    @abstractmethod
    def _begin(self, conn: socket.socket) -> None:
        """Begin to serve a connection."""

    @abstractmethod
    def _phase_name(self) -> str:
        """Name what the robot does now, for a sentence."""

    def _free(self) -> bool:
        """True if the next connection is to be served."""
        return False

    def _work(self) -> Iterable[Work]:
        """Give what runs besides, whoever is connected."""
        return ()

    def _before_close(self) -> None:
        """Send what is last, while the sockets are open; must not block."""

    # What a protocol calls

    def _bind(self, host: str, port: int, sockets: contextlib.ExitStack) -> socket.socket:
        return sockets.enter_context(bind_tcp(host, port))

    def _start(self, work: Work) -> None:
        """Run a task that ends with the robot."""
        assert self._tasks is not None
        self._running.append(self._tasks.create_task(work))

    def _stop(self) -> None:
        """End all tasks, and so :meth:`serve`."""
        for task in self._running:
            task.cancel()

    async def _accept(self, server: socket.socket, sockets: contextlib.ExitStack) -> None:
        """Serve the first connection, and those that :meth:`_free` admits; accept all others and say nothing."""
        loop, first = asyncio.get_running_loop(), True
        unanswered: list[socket.socket] = []
        while True:
            conn, peer = await loop.sock_accept(server)
            sockets.enter_context(conn)
            if first or self._free():
                send_at_once(conn)
                self._begin(conn)
                first = False
                continue
            self._event(f"second connection, from {peer[0]}:{peer[1]}, while {self._phase_name()}")
            unanswered.append(conn)
            for old in unanswered[:-_UNANSWERED]:
                old.close()
            del unanswered[:-_UNANSWERED]


def log_violations(log: logging.Logger, name: str = "") -> Callable[[str], None]:
    """Make the ``note`` of a judge: it logs each violation, with the judge's name if there are several."""
    return lambda text: log.error("violation%s: %s", name and f", {name}", text)


def print_death(judge: Judge) -> None:
    """Print what a judge died of, if it did."""
    if not judge.alive:
        print_line(f"died: {judge.death}")


def print_line(line: str) -> None:
    """Print a line at once: a program may be waiting for it."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
