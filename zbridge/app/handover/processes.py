"""What a handover needs of the operating system: the socket between two processes, and the end of the other process.

A simulation injects its own in the place of :data:`PROCESSES`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import socket

from zbridge.app.handover.channel import Channel

END_S = 2.0
"""Longest wait for the end of a process that was killed, seconds."""


class OtherProcess:
    """A process by its number; another one that gets the same number later is not meant."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._descriptor: int | None = None
        with contextlib.suppress(OSError, AttributeError):  # it may have ended; not every kernel has it
            self._descriptor = os.pidfd_open(pid)

    def __repr__(self) -> str:
        return f"<OtherProcess {self._pid}>"

    async def kill(self) -> None:
        """Kill it, and wait :data:`END_S` at most until it has ended."""
        if self._descriptor is not None:
            await asyncio.to_thread(self._kill, self._descriptor)

    def close(self) -> None:
        """Close the descriptor; idempotent."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def _kill(self, descriptor: int) -> None:
        with contextlib.suppress(OSError):
            signal.pidfd_send_signal(descriptor, signal.SIGKILL)
        select.select([descriptor], [], [], END_S)


class Processes:
    """The processes of this machine, as one that hands over, or takes over, sees them."""

    @property
    def own_pid(self) -> int:
        """The number of this process."""
        return os.getpid()

    def pair(self) -> tuple[Channel, socket.socket]:
        """Make a channel, and the far end of its socket for a successor; raise OSError."""
        near, far = socket.socketpair()
        return Channel(near), far

    def channel(self, end: socket.socket) -> Channel:
        """Make a channel of the end that another process made."""
        return Channel(end)

    def process(self, pid: int) -> OtherProcess:
        """Return the process of this number."""
        return OtherProcess(pid)


PROCESSES = Processes()
"""Those of this machine."""
