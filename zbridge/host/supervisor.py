"""``zbridge run DIR``: keeps the gateways of many robot files running, one process each.

Theory of operation. The supervisor opens no bus and serves no robot. Its processes are forked by a fork server
(:mod:`zbridge.host.fork_server`) and are its children, since it is the reaper of its descendants. One timer checks the
watchdogs of all processes: it fires at the earliest deadline, first receives what the processes sent meanwhile, and
kills those that are silent. Each robot has a :class:`Runner`, a task of its own. When the installation has changed, the
supervisor gives its place to the installed code (:mod:`zbridge.host.replacement`).
"""

from __future__ import annotations

import asyncio
import ctypes
import signal
import socket
import time
from pathlib import Path

import msgspec

from zbridge.app.config import MetricsSettings
from zbridge.app.endpoint import serve_metrics
from zbridge.app.handover.processes import Systemd
from zbridge.errors import ConfigError, HandoverError, NotReady
from zbridge.host.fd_channel import Fork
from zbridge.host.files import Follower, RobotFile, compare, read_all
from zbridge.host.fork_client import ForkClient, module_command
from zbridge.host.metrics import HostMetrics
from zbridge.host.replacement import SIGNALS, SupervisorState, quiet_threads, replace
from zbridge.host.runner import Runner
from zbridge.host.runners import Reports, Runners
from zbridge.log import Log
from zbridge.tasks import Tasks, occurs

log = Log("zbridge.host")

WATCH_S = 2.0
"""Seconds between two polls of the files, with ``--watch``."""
FORKED_S = 5.0
"""Seconds between two attempts to start a fork server."""
_PR_SET_CHILD_SUBREAPER = 36


class Supervisor:
    """Runs the gateways of robot files.

    state: what it runs, and, in place of other code, what that code knew. forks: starts the processes.
    """

    def __init__(self, state: SupervisorState, forks: ForkClient) -> None:
        self._state = state
        self._forks = forks
        self._code = forks.stamp
        """The installation that this code is from."""
        self._refused: bytes | None = None
        """The installation whose code has not taken over."""
        self._forced = False
        """Set to replace this code though the installation is the same."""
        self.runners = Runners(self._runner, self._changed, stagger_s=state.host.stagger_s)
        self.runners.faults.update((Path(path), fault) for path, fault in state.faults.items())
        self._systemd = Systemd()
        self._reports = Reports(self._systemd, self.runners, is_ready=state.is_ready)
        self._sources = tuple(map(Path, state.sources))
        self._follower = Follower(self._sources, self.runners.faults, state.host.file_bytes)
        self._running = Tasks()
        self._timer: asyncio.TimerHandle | None = None
        self._reload = asyncio.Event()
        self._sockets: list[socket.socket] = []
        """Those at which the metrics are served."""

    def __repr__(self) -> str:
        return f"<Supervisor of {len(self.runners.by_path)} robots>"

    async def run(self) -> None:
        """Keep the gateways running until cancelled; then end all of them, each with its robot's stop.

        Raise ConfigError if two files name one robot, or no file is sound.
        """
        loop = asyncio.get_running_loop()
        loop.set_default_executor(quiet_threads())
        files: list[RobotFile] = []
        if self._state.at is None:
            files = await asyncio.to_thread(read_all, self._sources, self._state.host.file_bytes)
        become_reaper()
        loop.add_signal_handler(signal.SIGCHLD, self.runners.reap)
        loop.add_signal_handler(signal.SIGHUP, self.reload)
        loop.add_signal_handler(signal.SIGUSR2, self.renew)
        try:
            if self._state.at is not None:
                self._resume(self._state.at)
            else:
                await self._start_forks()
            self._code = self._forks.stamp
            for task in (self.follow(), self._reports.live(), self._serve_metrics()):
                self._running.start(task)
            self._check_watchdogs()
            await self.runners.apply(compare({}, files), first=True)
            await asyncio.Event().wait()
        finally:
            await asyncio.shield(self._end())
            for number in (signal.SIGCHLD, signal.SIGHUP, signal.SIGUSR2):
                loop.remove_signal_handler(number)

    async def _serve_metrics(self) -> None:
        if not self._state.listen:
            return
        adopted = [socket.socket(fileno=number) for number in self._state.sockets]
        metrics, address = HostMetrics(self.runners), MetricsSettings(self._state.listen).address
        async with serve_metrics(address, metrics.read, metrics.missing, adopted) as self._sockets:
            await asyncio.Event().wait()

    async def _start_forks(self) -> None:
        while True:
            try:
                return await self._forks.renew()
            except NotReady as error:
                log.error("no_fork_server", "{error}; next attempt in {delay_s:g} s", error=error, delay_s=FORKED_S)
                await asyncio.sleep(FORKED_S)

    async def _end(self) -> None:
        self._systemd.notify("STOPPING=1", f"STATUS=ending {len(self.runners.by_path)} gateways")
        await self.runners.end()
        await self._running.end()
        if self._timer is not None:
            self._timer.cancel()
        self._reports.close()
        self._forks.close()

    # Files

    def reload(self) -> None:
        """Read the files again, as SIGHUP asks for."""
        self._reload.set()

    async def follow(self) -> None:
        """Follow the files and the installation: at :meth:`reload`, and with ``watch`` every WATCH_S."""
        while True:
            asked = await occurs(self._reload, WATCH_S if self._state.watch or self._forks.unsettled else None)
            self._reload.clear()
            if asked:
                self._systemd.notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
            try:
                if asked or self._state.watch:
                    running = {path: runner.file for path, runner in self.runners.by_path.items()}
                    await self.runners.apply(await asyncio.to_thread(self._follower.poll, running, twice=not asked))
                await self._forks.renew()
            except (ConfigError, NotReady) as error:
                log.error("reload_failed", "{error}", error=error)
            if asked:
                self._systemd.notify("READY=1")
            await self.follow_code(asked=asked)

    # Its own code

    def renew(self) -> None:
        """Replace this code by the installed code, though it may be the same: as SIGUSR2 asks for."""
        self._forced = True
        self._reload.set()

    async def follow_code(self, *, asked: bool) -> None:
        """Replace this code if the fork server's is of another installation; log why where that is not possible.

        asked: whether somebody asks, and an installation that has not taken over is tried again.
        """
        stamp = self._forks.stamp
        wanted = self._forced or (stamp != self._code and (asked or stamp != self._refused))
        if not wanted or self._forks.unsettled:
            return
        self._forced = False
        try:
            if self._forks.refused:
                raise HandoverError("the installed code's fork server does not start")
            options = ["--watch"] * self._state.watch + ["--verbose"] * self._state.verbose  # for those who look
            command = [*module_command("zbridge"), "run", *options, *self._state.sources]
            await replace(command, self.snapshot, self._forks.rehearse)
        except (HandoverError, NotReady, OSError, UnicodeError) as error:
            self._refused = stamp
            log.error("supervisor_not_replaced", "the supervisor continues with the old code: {error}", error=error)

    def snapshot(self) -> SupervisorState | None:
        """Return all that the code in place of this one needs; None while something is under way."""
        if not self.runners.is_idle:
            return None
        return msgspec.structs.replace(
            self._state,
            at=time.monotonic(),
            reload=self._reload.is_set(),
            is_ready=self._reports.is_ready,
            sockets=tuple(each.fileno() for each in self._sockets),
            runners=tuple(runner.snapshot for runner in self.runners.by_path.values()),
            server=self._forks.state,
            faults={str(path): fault for path, fault in self.runners.faults.items() if str(path).isprintable()},
        )

    def _resume(self, at: float) -> None:
        """Resume where the code before this one was at this time."""
        self._forks.resume(self._state.server)
        self.runners.check_at = at  # this process has checked no watchdog since
        self.runners.resume(self._state.runners)
        if self._state.reload:
            self._reload.set()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        taken_ms = (time.monotonic() - at) * 1000
        template = "the installed code has taken over in {took_ms:.0f} ms: {status}"
        log.info("supervisor_replaced", template, took_ms=taken_ms, status=self.runners.status)

    # Processes

    def _runner(self, file: RobotFile) -> Runner:
        state = self._state
        request = Fork("", "", state.verbose, state.log_format, state.log_level, state.blackbox)
        return Runner(file, self._forks, request, changed=self._changed, most_bytes=state.host.file_bytes)

    def _changed(self) -> None:
        self._reports.changed()

    def _check_watchdogs(self) -> None:
        loop, now = asyncio.get_running_loop(), time.monotonic()
        self.runners.check(now)
        self._timer = loop.call_at(self.runners.check_at, self._check_watchdogs)


def become_reaper() -> None:
    """Become the parent of what a descendant leaves behind: forked gateways are waited for here."""
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")
