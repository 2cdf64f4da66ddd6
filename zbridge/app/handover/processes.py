"""What a handover needs of the operating system, with a supervisor or, as here, without one.

That is: the socket between two processes, killing the other process, and starting a successor. A simulation injects its
own processes in place of :data:`PROCESSES`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from zbridge.app.handover.channel import HandoverChannel
from zbridge.errors import HandoverError

END_S = 2.0
"""Longest wait for the end of a process that was killed, seconds."""
COMMAND = [sys.executable, "-m", "zbridge"]
"""The installed version of this program."""


class OtherProcess:
    """A process by its number; never a later process with the same number."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._descriptor: int | None = None
        with contextlib.suppress(OSError, AttributeError):  # it may have ended; not every kernel has it
            self._descriptor = os.pidfd_open(pid)

    def __repr__(self) -> str:
        return f"<OtherProcess {self._pid}>"

    async def kill(self) -> None:
        """Kill it, and wait at most :data:`END_S` for its end."""
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
    """The processes of this machine, as both ends of a handover use them."""

    @property
    def own_pid(self) -> int:
        """The number of this process."""
        return os.getpid()

    def pair(self) -> tuple[HandoverChannel, socket.socket]:
        """Make a channel, and the far end of its socket for the successor; raise OSError."""
        near, far = socket.socketpair()
        return HandoverChannel(near), far

    def channel(self, end: socket.socket) -> HandoverChannel:
        """Make a channel of the end that another process made."""
        return HandoverChannel(end)

    def process(self, pid: int) -> OtherProcess:
        """Return the process of this number."""
        return OtherProcess(pid)


PROCESSES = Processes()
"""The processes of this machine."""


class Successor(Protocol):
    """Starts successors of this process."""

    async def start_successor(self, far_end: socket.socket) -> None:
        """Start a process that owns the far end; raise HandoverError if none can be started.

        The caller closes its own copy of the far end afterwards, in any case.
        """

    def handed_over(self) -> bool:
        """Record that the successor has the robot from now on; called before *go* is sent to it.

        True: a supervisor stops the robot whatever happens to either process, so the handover cannot be undone. False:
        there is none; this process takes everything back if *go* cannot be sent.
        """


class Spawn:
    """Starts ``zbridge run FILE --take-over FD`` as a child, which outlives this process."""

    def __init__(self, file: Path, *, verbose: bool = False) -> None:
        self._file = file
        self._verbose = verbose
        self.process: subprocess.Popen[bytes] | None = None
        """The process that was started last."""

    def __repr__(self) -> str:
        return f"<Spawn {self._file} {self.process.pid if self.process else ''}>"

    async def start_successor(self, far_end: socket.socket) -> None:
        """Start the process, and reap it if it ends before this one."""
        try:
            self.process = await asyncio.to_thread(self._start, far_end.fileno())
        except OSError as error:
            raise HandoverError(f"no process can be started: {error}") from error

    def handed_over(self) -> bool:
        """Return False: no supervisor monitors the two processes."""
        return False

    def _start(self, descriptor: int) -> subprocess.Popen[bytes]:
        if self.process is not None:
            self.process.poll()
        command = [*COMMAND, "run", str(self._file), "--take-over", str(descriptor)]
        command += ["--verbose"] if self._verbose else []
        return subprocess.Popen(command, pass_fds=(descriptor,))

    def notify_systemd(self) -> None:
        """Notify systemd, if it started this process, which process serves the robot from now on."""
        if self.process is not None:
            Systemd().notify(f"MAINPID={self.process.pid}", waits=True)
            self.process.returncode = 0  # it outlives this process: Popen must not warn


class Systemd:
    """The notification socket of systemd (``sd_notify``); does nothing if the environment names none.

    watchdog_s: seconds between two notifications of the watchdog; 0: none is wanted.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        mine = environment.get("WATCHDOG_PID") in (None, str(pid or os.getpid()))
        wanted = environment.get("WATCHDOG_USEC", "")
        self.watchdog_s = int(wanted) / 2_000_000 if mine and self._address and wanted.isdecimal() else 0.0

    def __repr__(self) -> str:
        return f"<Systemd {self._address or 'absent'}>"

    def notify(self, *lines: str, waits: bool = False) -> bool:
        """Send lines such as ``READY=1`` and ``STATUS=8 robots``; False if they found no room. waits: for room."""
        if self._address:
            try:
                with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
                    end.setblocking(waits)
                    end.sendto("\n".join(lines).encode(), self._address)
            except OSError:
                return False
        return True
