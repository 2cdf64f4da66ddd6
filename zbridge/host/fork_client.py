"""The supervisor's side of its fork server: starts it, asks it, and replaces it when the installed code has changed."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from zbridge.errors import NotReady
from zbridge.host.fd_channel import FdChannel, Fork, Forked, Message, Ready, Rehearse, close_all, in_memory
from zbridge.host.replacement import ServerState
from zbridge.log import Log
from zbridge.protocol.plugin import GROUP

log = Log("zbridge.host")

HOME = Path(__file__).parents[1]
"""The folder of zbridge's code."""
SETTLED_S = 2.0
"""Seconds for which nothing must have changed: an installer writes file after file."""
READY_S = 60.0
"""Longest time in which a fork server imports everything."""
CHECK_S = 2.0
"""Least time between two checks of the installation, which take 25 ms, for the sake of forks."""
ANSWER_S = 10.0
"""Longest time for one fork, or rehearsal."""
NOT_INHERITED = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Variables of systemd for this process only."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Variables for numpy's libraries, to be set before they are loaded: they must start no threads."""


def installed() -> tuple[bytes, bool]:
    """Return a stamp of the installed code, and whether the code has been unchanged for :data:`SETTLED_S`.

    Two stamps are equal if the same files are installed, each with the same size and time of change.
    """
    digest, newest_ns = hashlib.blake2b(digest_size=16), 0
    for path in _files():
        try:
            state = path.stat()
        except OSError:  # an installer replaces it at this moment
            newest_ns = time.time_ns()
            continue
        digest.update(f"{path}\0{state.st_size}\0{state.st_mtime_ns}\0".encode())
        newest_ns = max(newest_ns, state.st_mtime_ns, state.st_ctime_ns)
    return digest.digest(), abs(time.time_ns() - newest_ns) > SETTLED_S * 1e9


def _files() -> list[Path]:
    """List the code of zbridge and of the protocols, and the names of what is installed beside it."""
    roots = {HOME, *_protocol_packages()}
    sources = [path for root in roots for path in root.rglob("*.py")]
    return sorted({*sources, *(path for folder in sys.path for path in Path(folder).glob("*.dist-info"))})


def _protocol_packages() -> set[Path]:
    """Find the folders of the protocols' packages; loads none of them."""
    from importlib.metadata import entry_points

    specs = [find_spec(point.module.partition(".")[0]) for point in entry_points(group=GROUP)]
    return {Path(spec.origin).parent for spec in specs if spec is not None and spec.has_location and spec.origin}


class _Server:
    """One running fork server, a child of this process. Answers come in the order of the requests."""

    def __init__(self, state: ServerState) -> None:
        self.state = state
        self.alive = True
        self._channel = FdChannel.inherited(state.channel)
        self._answers: asyncio.Queue[Message | None] = asyncio.Queue()
        asyncio.get_running_loop().add_reader(state.channel, self._receive)

    @classmethod
    async def start(cls, command: Sequence[str], stamp: bytes) -> _Server:
        """Start one, and wait until it can fork; raise NotReady with the reason."""
        try:
            server = cls(_spawned(command, stamp))
        except OSError as error:
            raise NotReady(f"the fork server did not start: {error.strerror or error}") from error
        answer = await server._answer(READY_S)
        if not isinstance(answer, Ready) or answer.threads != 1:
            server.kill()
            more = f": it has {answer.threads} threads" if isinstance(answer, Ready) else ""
            raise NotReady(f"the fork server did not start{more}")
        return server

    async def ask(self, request: Fork | Rehearse, descriptors: Sequence[int]) -> int:
        """Let it do something; return the process id that it answers. Raise NotReady with the reason."""
        if not self._channel.send(request, descriptors):
            raise NotReady("the fork server accepts no request")
        answer = await self._answer(ANSWER_S)
        if not isinstance(answer, Forked) or not answer.pid:
            raise NotReady((isinstance(answer, Forked) and answer.reason) or "the fork server is gone")
        return answer.pid

    async def _answer(self, within_s: float) -> Message | None:
        try:
            async with asyncio.timeout(within_s):
                return await self._answers.get()
        except TimeoutError:
            self.close()
            return None

    def _receive(self) -> None:
        try:
            received = self._channel.receive()
        except (BlockingIOError, ValueError):
            return
        if received is None:
            self.close()
            self._answers.put_nowait(None)
            return
        message, descriptors = received
        close_all(descriptors)
        self._answers.put_nowait(message)

    def close(self) -> None:
        """Ask nothing of it any more; idempotent."""
        if self.alive:
            self.alive = False
            asyncio.get_running_loop().remove_reader(self.state.channel)
            self._channel.close()

    def kill(self) -> None:
        """End it, and wait for its end. The gateways that it forked live on."""
        self.close()
        os.kill(self.state.pid, signal.SIGKILL)  # not waited for yet: nobody else has the number
        os.waitpid(self.state.pid, 0)


class ForkClient:
    """Forks gateways by the code that is installed now. One request at a time."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._server: _Server | None = None
        self._refused: bytes | None = None
        """The installation whose fork server did not start."""
        self.unsettled = False
        """Whether the installation was being changed when it was checked last."""
        self._checked_at = -math.inf
        self._turn = asyncio.Lock()

    def __repr__(self) -> str:
        return f"<ForkClient by {self.pid}>"

    @property
    def pid(self) -> int | None:
        return self._server.state.pid if self._server is not None else None

    @property
    def stamp(self) -> bytes | None:
        """The installation that the fork server loaded."""
        return self._server.state.stamp if self._server is not None else None

    @property
    def refused(self) -> bool:
        """Whether the fork server of the installed code did not start."""
        return self._refused is not None

    @property
    def state(self) -> ServerState | None:
        """The fork server, for :meth:`resume`."""
        return self._server.state if self._server is not None and self._server.alive else None

    def resume(self, server: ServerState | None) -> None:
        """Resume the fork server that the code before this one has started."""
        self._server = _Server(server) if server is not None else None

    async def fork(
        self,
        request: Fork,
        channel: socket.socket,
        content: bytes,
        take_over: int | None = None,
        *,
        at_once: bool = False,
    ) -> int:
        """Fork a gateway and return its process id; raise NotReady with the reason.

        channel: the gateway's end. content: of its file. take_over: descriptor of the socket by which it takes over.
        at_once: do not check whether the installation has changed.
        """
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(in_memory("zbridge file", content))
            except OSError as error:
                raise NotReady(f"no memory for a file: {error.strerror or error}") from error
            descriptors = [channel.fileno(), file] if take_over is None else [channel.fileno(), file, take_over]
            async with self._turn:
                checks = not at_once and asyncio.get_running_loop().time() >= self._checked_at + CHECK_S
                return await (await self._running(checks=checks)).ask(request, descriptors)

    async def rehearse(self, state: int) -> None:
        """Let the fork server's code read a supervisor's state as in its place; raise NotReady with the reason."""
        async with self._turn:
            await (await self._running(checks=False)).ask(Rehearse(), [state])

    async def renew(self) -> None:
        """Start the fork server, or another one if the installation has changed; raise NotReady if there is none.

        A new one that does not start is reported, and the old one continues.
        """
        async with self._turn:
            await self._running(checks=True)

    async def _running(self, *, checks: bool) -> _Server:
        """Return the fork server, started where there is none; checks: or where the installation has changed."""
        old = self._server
        if old is not None and old.alive and not checks:
            return old
        self._checked_at = asyncio.get_running_loop().time()
        stamp, settled = await asyncio.to_thread(installed)
        if old is not None and old.alive:
            if stamp == old.state.stamp:
                self._refused = None
            self.unsettled = stamp != old.state.stamp and not settled
            if stamp in (old.state.stamp, self._refused) or not settled:
                return old
            log.info("code_changed", "the installed code has changed: loading it")
        try:
            self._server, self._refused = await _Server.start(self._command, stamp), None
        except NotReady as error:
            if old is None or not old.alive:
                raise
            self._refused = stamp
            log.error("code_not_loaded", "{error}: the old code continues", error=error)
            return old
        if old is not None:
            old.kill()
        return self._server

    def close(self) -> None:
        """End the fork server; idempotent."""
        server, self._server = self._server, None
        if server is not None:
            server.kill()


def _spawned(command: Sequence[str], stamp: bytes) -> ServerState:
    """Start a fork server; raise OSError."""
    environment = {name: value for name, value in os.environ.items() if name not in NOT_INHERITED}
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with near, far:
        process = subprocess.Popen(
            [*command, str(far.fileno())],
            pass_fds=[far.fileno()],
            stdin=subprocess.DEVNULL,
            env={**environment, **ONE_THREAD},
            start_new_session=True,
        )
        process.returncode = 0  # it is waited for by its number
        return ServerState(process.pid, near.detach(), stamp)


def fork_server_command() -> list[str]:
    """Return the command that starts a fork server of the installed code; its last argument is still missing."""
    return module_command("zbridge.cli.fork_server")


def module_command(module: str) -> list[str]:
    """Return the command that runs a module of the installed code."""
    here = Path.cwd() == HOME.parent  # the folder is searched for modules then
    return [sys.executable, *([] if here else ["-P"]), "-m", module]
