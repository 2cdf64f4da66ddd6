"""Replaces the code of the supervisor by that of the installed version, in place.

Theory of operation. The process stays the same one (``exec``): its children stay its children, its descriptors stay
open, and systemd sees its main process go on. First the installed code rehearses, as a process of its own: it reads
the state and ends. So a version that does not start, or takes no such state, changes nothing. Then, at a moment when
nothing is under way, the state goes to memory, and the installed code begins where this one was. What the children
tell meanwhile waits in their sockets. Signals wait too: they are blocked until the installed code takes them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from typing import NoReturn

from zbridge.errors import HandoverError
from zbridge.host.forks import NOT_INHERITED, SIGNALS
from zbridge.host.state import SupervisorState, store

CALM_S = 60.0
"""Longest wait for a moment when nothing is under way."""
LOOK_S = 0.05
REHEARSAL_S = 20.0
"""Longest time for the rehearsal."""
TURNS = 10
"""Turns of the event loop in which a signal that came before is answered."""
RESUME, REHEARSE = "--resume", "--resume-check"
"""The last option but one of the command; the last is the state's descriptor."""

Snapshot = Callable[[], SupervisorState | None]
"""Give the state; None while something is under way that it does not describe."""


async def replace(command: Sequence[str], snapshot: Snapshot) -> NoReturn:
    """Replace this code by the command's, with the state; raise HandoverError if this code has to go on."""
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
    said = b""
    try:
        async with asyncio.timeout(REHEARSAL_S):
            _, said = await process.communicate()
    except TimeoutError:
        raise HandoverError(f"the installed code did not start within {REHEARSAL_S:g} s") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.communicate()
    if process.returncode:
        reason = said.decode(errors="replace").strip().rpartition("\n")[2] or f"exit code {process.returncode}"
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
    kept = (descriptor, *state.descriptors)
    try:
        for number in kept:
            os.set_inheritable(number, True)
        os.execv(command[0], [*command, RESUME, str(descriptor)])
    finally:  # it failed
        for number in kept:
            os.set_inheritable(number, False)
        os.close(descriptor)
