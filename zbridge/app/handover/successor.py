"""How a successor is started, and told that it has the robot: with a supervisor, or, as here, without one."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Protocol

from zbridge.errors import HandoverError

COMMAND = [sys.executable, "-m", "zbridge"]
"""The installed version of this program."""


class Successor(Protocol):
    """Who starts successors of this process."""

    async def start_successor(self, far_end: socket.socket) -> None:
        """Start a process that owns the far end; raise HandoverError where none can be started.

        The caller closes its own copy of the far end afterwards, in any case.
        """

    def handed_over(self) -> bool:
        """Note that the successor has the robot from now on; called before the successor is told.

        True: somebody looks after the robot whatever happens to either process, so there is no way back. False: nobody
        does; this process takes everything back if the successor cannot be told.
        """


class Spawn:
    """Starts ``zbridge run FILE --take-over FD`` as a child, which lives on when this process has ended."""

    def __init__(self, file: Path, *, verbose: bool = False) -> None:
        self._file = file
        self._verbose = verbose
        self.process: subprocess.Popen[bytes] | None = None
        """The process that was started last."""

    def __repr__(self) -> str:
        return f"<Spawn {self._file} {self.process.pid if self.process else ''}>"

    async def start_successor(self, far_end: socket.socket) -> None:
        """Start the process; it is waited for where it ends before we do."""
        try:
            self.process = await asyncio.to_thread(self._start, far_end.fileno())
        except OSError as error:
            raise HandoverError(f"no process can be started: {error}") from error

    def handed_over(self) -> bool:
        """Return False: nobody looks after two processes."""
        return False

    def _start(self, descriptor: int) -> subprocess.Popen[bytes]:
        if self.process is not None:
            self.process.poll()
        command = [*COMMAND, "run", str(self._file), "--take-over", str(descriptor)]
        command += ["--verbose"] if self._verbose else []
        return subprocess.Popen(command, pass_fds=(descriptor,))

    def tell_systemd(self) -> None:
        """Tell systemd, where it started us, which process serves the robot from now on."""
        if self.process is not None:
            notify(f"MAINPID={self.process.pid}")
            self.process.returncode = 0  # it outlives us: Popen must not complain at our end


def notify(state: str) -> None:
    """Tell systemd a state of this service, as ``sd_notify`` does; do nothing where systemd does not listen."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
        try:
            sock.connect(address)
            sock.sendall(state.encode())
        except OSError:
            return
