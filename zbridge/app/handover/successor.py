"""How a successor is started: by a function that gets the far end of the channel. Here the one without a supervisor."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

from zbridge.errors import HandoverError

COMMAND = [sys.executable, "-m", "zbridge"]
"""The installed version of this program."""
Successor = Callable[[socket.socket], Awaitable[None]]
"""``await start(far_end)``: start a process that owns the far end; raise HandoverError where none can be started.

The caller closes its own copy of the far end afterwards, in any case.
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

    async def __call__(self, far_end: socket.socket) -> None:
        """Start the process; it is waited for where it ends before we do."""
        try:
            self.process = await asyncio.to_thread(self._start, far_end.fileno())
        except OSError as error:
            raise HandoverError(f"no process can be started: {error}") from error

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
