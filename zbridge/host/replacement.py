"""Replaces the code of the supervisor by that of the installed version, in place.

Theory of operation. The process stays the same one (``exec``): its children stay its children, its descriptors stay
open, and systemd sees its main process continue. First the installed code rehearses, as a process of its own: it reads
the state and ends. So a version that does not start, or takes no such state, changes nothing. Then, at a moment when
nothing is under way, the state goes to memory, and the installed code begins where this one was. What the children
send meanwhile waits in their sockets. Signals wait too: they are blocked until the installed code takes them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NoReturn

import msgspec

from zbridge.errors import HandoverError
from zbridge.host.duplicates import Duplicate
from zbridge.host.fd_channel import Deposited
from zbridge.host.watchdog import Watchdog
from zbridge.robot.observer import LastStop
from zbridge.toml import FILE_BYTES

SIGNALS = (signal.SIGHUP, signal.SIGUSR2, signal.SIGTERM, signal.SIGINT)
"""Signals that a supervisor handles."""
NOT_INHERITED = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""Variables of systemd for this process only."""
THREADS = 64
"""Most threads of a supervisor that wait at a time: for files, and for successors of gateways that died together."""
VERSION = 1
"""The form of :class:`SupervisorState`."""
STATE_BYTES = 64 * 1024 * 1024
"""Largest state that is read."""
CALM_S = 60.0
"""Longest wait for a moment when nothing is under way."""
LOOK_S = 0.05
REHEARSAL_S = 20.0
"""Longest time for the rehearsal."""
TURNS = 10
"""Turns of the event loop in which a signal that came before is answered."""
RESUME, REHEARSE = "--resume", "--resume-check"
"""The last option but one of the command; the last is the state's descriptor."""


class ProcessState(msgspec.Struct, frozen=True):
    """A running gateway process. channel, memory: descriptors. began: when it was forked."""

    pid: int
    channel: int = msgspec.field(name="post")
    began: float
    watchdog: Watchdog = msgspec.field(name="heart")
    last: LastStop
    memory: int | None = msgspec.field(default=None, name="page")
    hands_over: bool = False
    deposited: Deposited | None = msgspec.field(default=None, name="kept")
    links: tuple[Duplicate, ...] = ()

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What must stay open."""
        of_links = (number for link in self.links for number in (link.stream, link.datagrams))
        return tuple(number for number in (self.channel, self.memory, *of_links) if number is not None)


class RunnerState(msgspec.Struct, frozen=True):
    """One robot: the file as it runs, and its process. next_at: when the next one starts, if none runs.

    forms, shares: of the robot's addresses.
    """

    path: str
    content: bytes
    identity: tuple[str, str] | None
    restarts: int = 0
    failures: int = 0
    next_at: float | None = None
    process: ProcessState | None = None
    forms: tuple[str, ...] = ()
    shares: bool = False


class ServerState(msgspec.Struct, frozen=True):
    """The fork server. channel: a descriptor. stamp: of the installation that it loaded."""

    pid: int
    channel: int = msgspec.field(name="post")
    stamp: bytes


class SupervisorState(msgspec.Struct, frozen=True):
    """Everything. at: the time of the handing over. check_at: of the next check of the watchdogs."""

    version: int
    sources: tuple[str, ...]
    at: float
    check_at: float = msgspec.field(name="look_at")
    watch: bool = False
    verbose: bool = False
    stagger_s: float = 0.0
    file_bytes: int = FILE_BYTES
    is_ready: bool = False
    runners: tuple[RunnerState, ...] = ()
    server: ServerState | None = None
    leaving: tuple[int, ...] = ()
    """Fork servers of before, until they have ended."""
    faults: dict[str, str] = {}

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What must stay open."""
        of_server = (self.server.channel,) if self.server is not None else ()
        return (*of_server, *(n for each in self.runners if each.process is not None for n in each.process.descriptors))


class _Head(msgspec.Struct, frozen=True):
    version: int


_encode = msgspec.msgpack.Encoder().encode
_head = msgspec.msgpack.Decoder(_Head).decode
_decode = msgspec.msgpack.Decoder(SupervisorState).decode


def store(state: SupervisorState) -> int:
    """Write a state to memory; return the descriptor, which the caller has to close. Raises OSError."""
    data, descriptor = _encode(state), os.memfd_create("zbridge state")
    try:
        while data:
            data = data[os.write(descriptor, data) :]
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def restore(descriptor: int) -> SupervisorState:
    """Read a state, and leave the descriptor open; raise HandoverError if it cannot be understood."""
    try:
        data = os.pread(descriptor, STATE_BYTES, 0)
        if (version := _head(data).version) != VERSION:
            raise HandoverError(f"the supervisor left state version {version}, this code accepts version {VERSION}")
        return _decode(data)
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise HandoverError(f"no state of a supervisor: {error}") from error


Snapshot = Callable[[], SupervisorState | None]
"""Give the state; None while something is under way that it does not describe."""


def quiet_threads() -> ThreadPoolExecutor:
    """Make threads that take no signals of the process: they would be lost at its exec. Many may wait at a time."""
    return ThreadPoolExecutor(THREADS, "zbridge", lambda: signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS))


async def replace(command: Sequence[str], snapshot: Snapshot) -> NoReturn:
    """Replace this code by the command's, with the state; raise HandoverError if this code has to continue."""
    try:
        await _rehearse(command, await _calm(snapshot))
        while True:
            await _calm(snapshot)
            with _signals_blocked():
                for _ in range(TURNS):
                    await asyncio.sleep(0)
                if (state := snapshot()) is not None:
                    _execute(command, state)
    except (OSError, UnicodeError) as error:
        raise HandoverError(str(error)) from error


async def _calm(snapshot: Snapshot) -> SupervisorState:
    """Wait until nothing is under way."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(CALM_S):
            while True:
                if (state := snapshot()) is not None:
                    return state
                await asyncio.sleep(LOOK_S)
    raise HandoverError(f"a robot's process was being started or ended for {CALM_S:g} s")


async def _rehearse(command: Sequence[str], state: SupervisorState) -> None:
    """Let the installed code read the state."""
    descriptor = store(state)
    try:
        process = await asyncio.create_subprocess_exec(
            *command,
            REHEARSE,
            str(descriptor),
            pass_fds=[descriptor],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={name: value for name, value in os.environ.items() if name not in NOT_INHERITED},
            start_new_session=True,
        )
    finally:
        os.close(descriptor)
    errors = b""
    try:
        async with asyncio.timeout(REHEARSAL_S):
            _, errors = await process.communicate()
    except TimeoutError:
        raise HandoverError(f"the installed code did not start within {REHEARSAL_S:g} s") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.communicate()
    if process.returncode:
        reason = errors.decode(errors="replace").strip().rpartition("\n")[2] or f"exit code {process.returncode}"
        raise HandoverError(f"the installed code does not start: {reason[:300]}")


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        release_signals()


def release_signals() -> None:
    """Take the signals that have waited."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def _execute(command: Sequence[str], state: SupervisorState) -> NoReturn:
    descriptor = store(state)
    inherited = (descriptor, *state.descriptors)
    try:
        for number in inherited:
            os.set_inheritable(number, True)
        os.execv(command[0], [*command, RESUME, str(descriptor)])
    finally:  # it failed
        for number in inherited:
            os.set_inheritable(number, False)
        os.close(descriptor)
