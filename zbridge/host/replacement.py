"""Replaces the code of the supervisor by that of the installed version, in place.

Theory of operation. The process stays the same one (``exec``): its children stay its children, its descriptors stay
open, and systemd sees its main process continue. Of a gateway process it leaves the messages by which that process
would report the same again (:mod:`zbridge.host.fd_channel`); the installed code receives them as if they had just come.

First the fork server, which has the installed code, rehearses: it imports the supervisor, and reads the state. So a
version that does not start, or takes no such state, changes nothing. Then, at a moment when nothing is under way, the
state goes to memory, and the installed code begins where this one was. What the children send meanwhile waits in their
sockets. Signals wait too: they are blocked until the installed code takes them.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NoReturn

import msgspec

from zbridge.blackbox import BlackBoxSettings
from zbridge.errors import HandoverError
from zbridge.host.fd_channel import FromGateway, in_memory
from zbridge.host.settings import HostSettings
from zbridge.host.watchdog import Watchdog

SIGNALS = (signal.SIGHUP, signal.SIGUSR2, signal.SIGTERM, signal.SIGINT)
"""Signals that a supervisor handles."""
THREADS = 64
"""Most threads of a supervisor that wait at a time: for files, and for successors of gateways that died together."""
VERSION = 2
"""The form of :class:`SupervisorState`. Raise it with every change that the code before cannot read."""
CALM_S = 60.0
"""Longest wait for a moment when nothing is under way."""
LOOK_S = 0.05
TURNS = 10
"""Turns of the event loop in which a signal that came before is answered."""


class ProcessState(msgspec.Struct, frozen=True):
    """A running gateway process. channel: a descriptor. reports: its messages that still count, with descriptors."""

    pid: int
    channel: int
    began: float
    watchdog: Watchdog
    reports: tuple[tuple[FromGateway, tuple[int, ...]], ...] = ()


class RunnerState(msgspec.Struct, frozen=True):
    """One robot: its file as it runs, and its process. next_at: when the next process starts, if none runs."""

    path: str
    content: bytes
    identity: tuple[str, str] | None
    forms: frozenset[str] = frozenset()
    shares: bool = False
    restarts: int = 0
    failures: int = 0
    next_at: float | None = None
    process: ProcessState | None = None


class ServerState(msgspec.Struct, frozen=True):
    """A fork server. channel: a descriptor. stamp: of the installation that it loaded."""

    pid: int
    channel: int
    stamp: bytes


class SupervisorState(msgspec.Struct, frozen=True, tag_field="version", tag=VERSION):
    """What a supervisor runs; in place of other code also what that code knew.

    log_format, log_level, blackbox: as in :class:`~zbridge.host.fd_channel.Fork`. listen: host:port of the metrics;
    empty: they are not served. sockets: descriptors that listen there. at: the time of the replacement, None: this
    supervisor was just started. reload: whether SIGHUP came and is not yet answered. is_ready: whether systemd knows
    that every gateway has begun.
    """

    sources: tuple[str, ...]
    watch: bool = False
    verbose: bool = False
    host: HostSettings = HostSettings()
    log_format: str = ""
    log_level: str = ""
    listen: str = ""
    blackbox: BlackBoxSettings | None = None
    sockets: tuple[int, ...] = ()
    at: float | None = None
    reload: bool = False
    is_ready: bool = False
    runners: tuple[RunnerState, ...] = ()
    server: ServerState | None = None
    faults: dict[str, str] = {}

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What must stay open."""
        processes = [each.process for each in self.runners if each.process is not None]
        servers = (self.server,) if self.server is not None else ()
        reported = (number for each in processes for _, numbers in each.reports for number in numbers)
        return (*(each.channel for each in (*servers, *processes)), *reported, *self.sockets)


encode = msgspec.msgpack.Encoder().encode
"""``encode(state)``: raises UnicodeError for a path that is no text."""
_decode = msgspec.msgpack.Decoder(SupervisorState).decode


def restore(descriptor: int) -> SupervisorState:
    """Read a state, and leave the descriptor open; raise HandoverError if it cannot be understood."""
    try:
        return _decode(os.pread(descriptor, os.fstat(descriptor).st_size, 0))
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise HandoverError(f"no state of a supervisor of version {VERSION}: {error}") from error


def quiet_threads() -> ThreadPoolExecutor:
    """Make threads that take no signals of the process: they would be lost at its exec. Many may wait at a time."""
    return ThreadPoolExecutor(THREADS, "zbridge", lambda: signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS))


async def replace(
    command: Sequence[str], snapshot: Callable[[], SupervisorState | None], rehearse: Callable[[int], Awaitable[None]]
) -> NoReturn:
    """Replace this code by the command's; raise HandoverError, NotReady or OSError if this code has to continue.

    snapshot: gives the state; None while something is under way that it does not describe. rehearse: lets the installed
    code read the state behind a descriptor; raises NotReady.
    """
    loop, rehearsed = asyncio.get_running_loop(), False
    until = loop.time() + CALM_S
    while loop.time() < until:
        if (state := snapshot()) is None:
            await asyncio.sleep(LOOK_S)
        elif not rehearsed:
            with in_memory("zbridge state", encode(state)) as descriptor:
                await rehearse(descriptor)
            rehearsed = True
        else:
            signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                for _ in range(TURNS):
                    await asyncio.sleep(0)
                if (state := snapshot()) is not None:
                    _execute(command, state)
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    raise HandoverError(f"a robot's process was being started or ended for {CALM_S:g} s")


def _execute(command: Sequence[str], state: SupervisorState) -> NoReturn:
    with in_memory("zbridge state", encode(state)) as descriptor:
        for number in (descriptor, *state.descriptors):
            os.set_inheritable(number, True)  # for this exec: every other program is started without them
        logging.shutdown()  # what is still counted of repeated warnings is written
        os.execv(command[0], [*command, "--resume", str(descriptor)])
