"""``zbridge run DIR``: keeps the gateways of many robot files running, one process each.

Theory of operation. The supervisor opens no bus and serves no robot. Its processes are forked by a fork server
(:mod:`zbridge.host.fork_server`) and are its children, since it is the reaper of its descendants. One timer checks the
watchdogs of all processes: it fires at the earliest deadline, first receives what the processes sent meanwhile, and
kills those that are silent. Each robot has a :class:`Runner`, a task of its own. When the installation has changed, the
supervisor gives its place to the installed code (:mod:`zbridge.host.replacement`).
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import logging
import math
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from zbridge.app.handover.processes import Systemd
from zbridge.errors import ConfigError, HandoverError, NotReady
from zbridge.host.files import Changes, Follower, RobotFile, compare, read_all
from zbridge.host.fork_client import ForkClient, Stamp
from zbridge.host.process import GatewayProcess
from zbridge.host.replacement import VERSION, SupervisorState, quiet_threads, release_signals, replace
from zbridge.host.runner import Runner
from zbridge.host.settings import HostSettings
from zbridge.tasks import Tasks

log = logging.getLogger("zbridge.host")

WATCH_S = 2.0
"""Seconds between two polls of the files, with ``--watch``."""
LATE_S = 0.05
"""A timer that fires so much later was delayed by the machine."""
STATUS_S = 1.0
"""Least time between two status lines."""
READY_S = 0.2
"""The same until the service is ready."""
FORKED_S = 5.0
"""Seconds between two attempts to start a fork server."""
JITTER = 0.5
"""Part of the time between two starts that is left to chance."""
_PR_SET_CHILD_SUBREAPER = 36


class Supervisor:
    """Runs the gateways of robot files.

    host: how gateways run on this host. command: of the fork server. itself: the command that continues in place of
    this code. resumed: what the code before this one left.
    """

    def __init__(
        self,
        sources: tuple[Path, ...],
        host: HostSettings,
        command: Sequence[str],
        *,
        watch: bool,
        verbose: bool,
        itself: Sequence[str] = (),
        resumed: SupervisorState | None = None,
    ) -> None:
        self._sources = sources
        self._host = host
        self._watch = watch
        self._verbose = verbose
        self._itself = itself
        self._resumed = resumed
        self._forks = ForkClient(command)
        self._code: Stamp | None = None
        """The installation that this code is from."""
        self._refused: Stamp | None = None
        """The installation whose code has not taken over."""
        self._forced = False
        """Set to replace this code though the installation is the same."""
        self._faults = {Path(path): fault for path, fault in resumed.faults.items()} if resumed is not None else {}
        self._follower = Follower(sources, self._faults, host.file_bytes)
        self._systemd = Systemd()
        self._runners: dict[Path, Runner] = {}
        self._leaving: set[Runner] = set()
        """Those whose file is gone, until their process has ended."""
        self._running = Tasks()
        self._timer: asyncio.TimerHandle | None = None
        self._check_at = math.inf
        """When the watchdogs are checked next."""
        self._status_timer: asyncio.TimerHandle | None = None
        self._reload = asyncio.Event()
        self._all_started = self._ends = False
        self._is_ready = False

    def __repr__(self) -> str:
        return f"<Supervisor of {len(self._runners)} robots>"

    async def run(self) -> None:
        """Keep the gateways running until cancelled; then end all of them, each with its robot's stop.

        Raise ConfigError where two files name one robot, or no file is sound.
        """
        loop = asyncio.get_running_loop()
        loop.set_default_executor(quiet_threads())
        files: list[RobotFile] = []
        if self._resumed is None:
            files = await asyncio.to_thread(read_all, self._sources, self._host.file_bytes)
        _become_reaper()
        loop.add_signal_handler(signal.SIGCHLD, self._reap)
        loop.add_signal_handler(signal.SIGHUP, self._reload.set)
        loop.add_signal_handler(signal.SIGUSR2, self._renew)
        try:
            if self._resumed is not None:
                self._resume(self._resumed)
            else:
                await self._start_forks()
            self._code = self._forks.stamp
            for task in (self._follow(), self._live()):
                self._running.start(task)
            self._check_watchdogs()
            await self._apply(compare({}, files), first=True)
            self._all_started = True
            self._state_changed()
            await asyncio.Event().wait()
        finally:
            await asyncio.shield(self._end())
            for number in (signal.SIGCHLD, signal.SIGHUP, signal.SIGUSR2):
                loop.remove_signal_handler(number)

    async def _start_forks(self) -> None:
        while True:
            try:
                return await self._forks.renew()
            except NotReady as error:
                log.error("%s; next attempt in %g s", error, FORKED_S)
                await asyncio.sleep(FORKED_S)

    async def _end(self) -> None:
        self._ends = True
        self._systemd.notify("STOPPING=1", f"STATUS=ending {len(self._runners)} gateways")
        await asyncio.gather(*(runner.end() for runner in (*self._runners.values(), *self._leaving)))
        await self._running.end()
        for timer in (self._timer, self._status_timer):
            if timer is not None:
                timer.cancel()
        self._forks.close()

    # Files

    async def _follow(self) -> None:
        """Follow the files and the installation: at SIGHUP, and with ``watch`` every WATCH_S."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(WATCH_S if self._watch or self._forks.unsettled else None):
                    await self._reload.wait()
            asked = self._reload.is_set()
            self._reload.clear()
            if asked:
                self._systemd.notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
            try:
                if asked or self._watch:
                    running = {path: runner.file for path, runner in self._runners.items()}
                    await self._apply(await asyncio.to_thread(self._follower.poll, running, twice=not asked))
                await self._forks.renew()
            except (ConfigError, NotReady) as error:
                log.error("%s", error)
            if asked:
                self._systemd.notify("READY=1")
            await self._follow_code(asked=asked)

    async def _apply(self, changes: Changes, *, first: bool = False) -> None:
        """Start, restart and end what the files ask for; report the faulty ones."""
        for path, file in changes.moved:
            self._runners[file.path] = runner = self._runners.pop(path)
            runner.file = file
        for file in changes.faulty:
            runs = "its robot continues as before" if file.path in self._runners else "no robot runs by it"
            log.error("%s: %s", file.fault, runs)
            self._faults[file.path] = str(file.fault)
        for path in changes.gone:
            log.info("%s: is gone: its robot's gateway ends", path)
            self._running.start(self._leave(self._runners.pop(path)))
        for file in changes.changed:
            log.info("%s: has changed", file.path)
            self._running.start(self._runners[file.path].restart(file))
        for path in [*changes.gone, *(file.path for file in (*changes.came, *changes.changed))]:
            self._faults.pop(path, None)
        for number, file in enumerate(changes.came):
            if number and self._host.stagger_s:
                await asyncio.sleep(self._host.stagger_s * random.uniform(1 - JITTER, 1 + JITTER))
            if not first:
                log.info("%s: is new", file.path)
            self._runners[file.path] = runner = self._runner(file)
            self._running.start(runner.run())
        self._state_changed()

    async def _leave(self, runner: Runner) -> None:
        self._leaving.add(runner)
        await runner.end()
        self._leaving.discard(runner)

    # Its own code

    def _renew(self) -> None:
        """Do what SIGUSR2 asks for."""
        self._forced = True
        self._reload.set()

    async def _follow_code(self, *, asked: bool) -> None:
        """Replace this code if the fork server's is of another installation; log why where that is not possible."""
        stamp, forced, self._forced = self._forks.stamp, self._forced, False
        if not forced and (stamp == self._code or (stamp == self._refused and not asked)):
            return
        try:
            if self._forks.refused:
                raise HandoverError("the installed code's fork server does not start")
            await replace(self._itself, self._snapshot)
        except HandoverError as error:
            self._refused = stamp
            log.error("the supervisor continues with the old code: %s", error)

    def _snapshot(self) -> SupervisorState | None:
        """Give all that the code in place of this one needs; None while something is under way."""
        runners = self._runners.values()
        if self._ends or self._leaving or not self._all_started or not all(runner.is_idle for runner in runners):
            return None
        server, leaving = self._forks.state
        return SupervisorState(
            VERSION,
            tuple(map(str, self._sources)),
            at=time.monotonic(),
            check_at=self._check_at,
            watch=self._watch,
            verbose=self._verbose,
            stagger_s=self._host.stagger_s,
            file_bytes=self._host.file_bytes,
            is_ready=self._is_ready,
            runners=tuple(runner.snapshot for runner in runners),
            server=server,
            leaving=leaving,
            faults={str(path): fault for path, fault in self._faults.items() if str(path).isprintable()},
        )

    def _resume(self, state: SupervisorState) -> None:
        """Resume where the code before this one was."""
        for number in state.descriptors:
            os.set_inheritable(number, False)
        self._forks.resume(state.server, state.leaving)
        self._is_ready, self._check_at = state.is_ready, state.check_at
        for each in state.runners:
            forms = frozenset(each.forms)
            file = RobotFile(Path(each.path), each.content, each.identity, forms=forms, shares=each.shares)
            self._runners[file.path] = runner = self._runner(file)
            runner.resume(each)
            self._running.start(runner.run())
        release_signals()
        taken_ms = (time.monotonic() - state.at) * 1000
        log.info("the installed code has taken over in %.0f ms: %s", taken_ms, self.status)

    # Processes

    def _runner(self, file: RobotFile) -> Runner:
        most_bytes = self._host.file_bytes
        return Runner(file, self._forks, verbose=self._verbose, changed=self._state_changed, most_bytes=most_bytes)

    def _processes(self) -> Iterator[GatewayProcess]:
        for runner in (*self._runners.values(), *self._leaving):
            yield from runner.processes

    def _reap(self) -> None:
        for process in tuple(self._processes()):
            process.reap()

    def _check_watchdogs(self) -> None:
        """Kill every process that has been silent for too long; check again at the next deadline."""
        loop, now = asyncio.get_running_loop(), time.monotonic()
        late_s = now - self._check_at
        deadlines = [now + 1.0]
        for process in tuple(self._processes()):
            process.receive()
            process.reap()
            if late_s > LATE_S:
                process.watchdog.extend()
            if not process.over.done() and now >= process.watchdog.deadline:
                process.kill(f"gave no sign of life for {process.watchdog.silent_s(now):.1f} s")
            elif not process.over.done():
                deadlines.append(process.watchdog.deadline)
        self._check_at = max(now + 0.01, min(deadlines))
        self._timer = loop.call_at(self._check_at, self._check_watchdogs)

    # systemd

    async def _live(self) -> None:
        """Notify systemd's watchdog, where it wants that."""
        while self._systemd.watchdog_s:
            self._systemd.notify("WATCHDOG=1")
            await asyncio.sleep(self._systemd.watchdog_s)

    def _state_changed(self) -> None:
        if self._status_timer is None:
            delay_s = STATUS_S if self._is_ready else READY_S
            self._status_timer = asyncio.get_running_loop().call_later(delay_s, self._notify_status)

    def _notify_status(self) -> None:
        self._status_timer = None
        beaten = all(
            runner.process is not None and runner.process.watchdog.heartbeats for runner in self._runners.values()
        )
        ready = ("READY=1",) if beaten and self._all_started and not self._is_ready else ()
        if not self._systemd.notify(*ready, f"STATUS={self.status}"):
            self._state_changed()  # again, later
        elif ready:
            self._is_ready = True
            log.info("ready: %s", self.status)

    @property
    def status(self) -> str:
        """One line on the gateways: how many robots are in which state, and how many files are faulty."""
        states = Counter(runner.state for runner in self._runners.values())
        parts = [f"{len(self._runners)} robots", *(f"{count} {state}" for state, count in sorted(states.items()))]
        restarts = sum(runner.restarts for runner in self._runners.values())
        parts += [f"{restarts} restarts"] * bool(restarts) + [f"{len(self._faults)} faulty files"] * bool(self._faults)
        return ", ".join(parts)


def _become_reaper() -> None:
    """Become the parent of what a descendant leaves behind: forked gateways are waited for here."""
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")
