"""The supervisor's side of its fork server: starts it, asks it, and replaces it when the installed code has changed."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from zbridge.errors import NotReady
from zbridge.host.fd_channel import FdChannel, Fork, Forked, Message, Ready, close_all
from zbridge.host.replacement import NOT_INHERITED, ServerState
from zbridge.protocol.plugin import GROUP

log = logging.getLogger("zbridge.host")

HOME = Path(__file__).parents[1]
"""The folder of zbridge's code."""
SETTLED_S = 2.0
"""Seconds for which nothing must have changed: an installer writes file after file."""
READY_S = 60.0
"""Longest time in which a fork server imports everything."""
CHECK_S = 2.0
"""Least time between two checks of the installation, which take 25 ms, for the sake of forks."""
FORK_S = 10.0
"""Longest time for one fork."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Variables for numpy's libraries, to be set before they are loaded: they must start no threads."""


class Installation:
    """What is installed now. Two are equal if no file of the code differs in size and time of change."""

    def __init__(self) -> None:
        digest, newest_ns = hashlib.blake2b(digest_size=16), 0
        for path in _files():
            try:
                state = path.stat()
            except OSError:  # an installer replaces it at this moment
                newest_ns = time.time_ns()
                continue
            digest.update(f"{path}\0{state.st_size}\0{state.st_mtime_ns}\0".encode())
            newest_ns = max(newest_ns, state.st_mtime_ns, state.st_ctime_ns)
        self.digest = digest.digest()
        self.settled = abs(time.time_ns() - newest_ns) > SETTLED_S * 1e9
        """Whether nothing changed for :data:`SETTLED_S`."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Installation) and self.digest == other.digest

    @classmethod
    def of(cls, digest: bytes) -> Installation:
        """Make one that was checked before, from its digest."""
        stamp = cls.__new__(cls)
        stamp.digest, stamp.settled = digest, True
        return stamp

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<Installation {self.digest.hex()[:8]}>"


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


class _Adopted:
    """A child that the code before this one has started: as much of a ``Popen`` as is needed here."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._ended = False

    @property
    def ended(self) -> bool:
        return self.poll() is not None

    def poll(self) -> int | None:
        return self._wait(os.WNOHANG)

    def wait(self) -> int | None:
        return self._wait(0)

    def _wait(self, options: int) -> int | None:
        if not self._ended:
            try:
                self._ended = os.waitpid(self.pid, options)[0] != 0
            except ChildProcessError:
                self._ended = True
        return 0 if self._ended else None

    def kill(self) -> None:
        if not self._ended:
            os.kill(self.pid, signal.SIGKILL)


class _Server:
    """One running fork server. Answers come in the order of the requests."""

    def __init__(self, process: subprocess.Popen[bytes] | _Adopted, channel: FdChannel, stamp: Installation) -> None:
        self.stamp = stamp
        self.alive = True
        self._process = process
        self._channel = channel
        self._answers: asyncio.Queue[Message | None] = asyncio.Queue()
        asyncio.get_running_loop().add_reader(channel.fileno(), self._receive)

    @classmethod
    async def start(cls, command: Sequence[str], stamp: Installation) -> _Server:
        """Start one, and wait until it can fork; raise NotReady with the reason."""
        try:
            server = cls(*_spawned(command), stamp)
        except OSError as error:
            raise NotReady(f"the fork server did not start: {error.strerror or error}") from error
        answer = await server._answer(READY_S)
        if not isinstance(answer, Ready) or answer.threads != 1:
            server.kill()
            more = f": it has {answer.threads} threads" if isinstance(answer, Ready) else ""
            raise NotReady(f"the fork server did not start{more}")
        return server

    @classmethod
    def resume(cls, state: ServerState) -> _Server:
        """Resume one that the code before this one has started."""
        return cls(_Adopted(state.pid), FdChannel.inherited(state.channel), Installation.of(state.stamp))

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def state(self) -> ServerState:
        return ServerState(self.pid, self._channel.fileno(), self.stamp.digest)

    async def fork(self, request: Fork, descriptors: Sequence[int]) -> int:
        """Fork a gateway and return its process id; raise NotReady with the reason."""
        if not self._channel.send(request, descriptors):
            raise NotReady("the fork server accepts no request")
        answer = await self._answer(FORK_S)
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
        """Let it end; idempotent. The gateways that it forked live on."""
        if self.alive:
            self.alive = False
            asyncio.get_running_loop().remove_reader(self._channel.fileno())
            self._channel.close()

    def kill(self) -> None:
        self.close()
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        self._process.wait()

    @property
    def ended(self) -> bool:
        """Whether its process has ended; reaps it."""
        return self._process.poll() is not None


class ForkClient:
    """Forks gateways by the code that is installed now. One request at a time."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._server: _Server | None = None
        self._refused: Installation | None = None
        """The installation whose fork server did not start."""
        self._leaving: list[_Server | _Adopted] = []
        self.unsettled = False
        """Whether the installation was being changed when it was checked last."""
        self._checked_at = -math.inf
        self._turn = asyncio.Lock()

    def __repr__(self) -> str:
        return f"<ForkClient by {self._server.pid if self._server is not None else None}>"

    @property
    def pid(self) -> int | None:
        return self._server.pid if self._server is not None else None

    @property
    def stamp(self) -> Installation | None:
        """The installation that the fork server loaded."""
        return self._server.stamp if self._server is not None else None

    @property
    def refused(self) -> bool:
        """Whether the fork server of the installed code did not start."""
        return self._refused is not None

    @property
    def state(self) -> tuple[ServerState | None, tuple[int, ...]]:
        """The fork server, and the process ids of those before it, for :meth:`resume`."""
        leaving = tuple(each.pid for each in self._leaving if not each.ended)
        return self._server.state if self._server is not None and self._server.alive else None, leaving

    def resume(self, server: ServerState | None, leaving: Sequence[int]) -> None:
        """Resume the fork server that the code before this one has started."""
        self._server = _Server.resume(server) if server is not None else None
        self._leaving = [_Adopted(pid) for pid in leaving]

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
        loop = asyncio.get_running_loop()
        with _in_memory(content) as file:
            descriptors = [channel.fileno(), file] if take_over is None else [channel.fileno(), file, take_over]
            async with self._turn:
                checks = not at_once and loop.time() >= self._checked_at + CHECK_S
                if checks or self._server is None or not self._server.alive:
                    await self._renew()
                assert self._server is not None
                return await self._server.fork(request, descriptors)

    async def renew(self) -> None:
        """Start the fork server, or another one if the installation has changed; raise NotReady if there is none.

        A new one that does not start is reported, and the old one continues.
        """
        async with self._turn:
            await self._renew()

    async def _renew(self) -> None:
        self._checked_at = asyncio.get_running_loop().time()
        self._leaving = [each for each in self._leaving if not each.ended]
        old, stamp = self._server, await asyncio.to_thread(Installation)
        if old is not None and old.alive:
            if stamp == old.stamp:
                self._refused = None
            self.unsettled = stamp != old.stamp and not stamp.settled
            if stamp in (old.stamp, self._refused) or not stamp.settled:
                return
            log.info("the installed code has changed: loading it")
        try:
            server = await _Server.start(self._command, stamp)
        except NotReady as error:
            if old is None or not old.alive:
                raise
            self._refused = stamp
            log.error("%s: the old code continues", error)
            return
        self._server, self._refused = server, None
        if old is not None:
            old.close()
            self._leaving.append(old)

    def close(self) -> None:
        for each in (self._server, *self._leaving):
            if each is not None:
                each.kill()


@contextlib.contextmanager
def _in_memory(content: bytes) -> Iterator[int]:
    """Write the content of a file to memory; give its descriptor. Raise NotReady if that is not possible."""
    try:
        descriptor = os.memfd_create("zbridge file")
        try:
            os.pwrite(descriptor, content, 0)  # memory takes all of it, or nothing
        except OSError:
            os.close(descriptor)
            raise
    except OSError as error:
        raise NotReady(f"no memory for a file: {error.strerror or error}") from error
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _spawned(command: Sequence[str]) -> tuple[subprocess.Popen[bytes], FdChannel]:
    """Start a fork server, and give our end of its channel; raise OSError."""
    environment = {name: value for name, value in os.environ.items() if name not in NOT_INHERITED}
    channel, far = FdChannel.pair()
    with far, contextlib.ExitStack() as undo:
        undo.callback(channel.close)
        process = subprocess.Popen(
            [*command, str(far.fileno())],
            pass_fds=[far.fileno()],
            stdin=subprocess.DEVNULL,
            env={**environment, **ONE_THREAD},
            start_new_session=True,
        )
        undo.pop_all()
    return process, channel


def fork_server_command() -> list[str]:
    """Return the command that starts a fork server of the installed code; its last argument is still missing."""
    return module_command("zbridge.cli.fork_server")


def module_command(module: str) -> list[str]:
    """Return the command that runs a module of the installed code."""
    here = Path.cwd() == HOME.parent  # the folder is searched for modules then
    return [sys.executable, *([] if here else ["-P"]), "-m", module]
