"""The runners of all robot files, the watchdogs of their processes, and what systemd is notified of."""

from __future__ import annotations

import asyncio
import math
import random
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from zbridge.app.handover.processes import Systemd
from zbridge.host.files import Changes, RobotFile
from zbridge.host.process import GatewayProcess
from zbridge.host.replacement import RunnerState
from zbridge.host.runner import Runner
from zbridge.log import Log
from zbridge.tasks import Tasks

log = Log("zbridge.host")

LATE_S = 0.05
"""A check that comes so much later was delayed by the machine."""
STATUS_S = 1.0
"""Least time between two status lines."""
READY_S = 0.2
"""The same until the service is ready."""
JITTER = 0.5
"""Part of the time between two starts that is left to chance."""


class Runners:
    """Runs a gateway for each robot file.

    make: makes the runner of a file. changed: called when the number of robots or faults has changed. stagger_s: mean
    time between two starts.
    """

    def __init__(
        self, make: Callable[[RobotFile], Runner], changed: Callable[[], None], *, stagger_s: float = 0.0
    ) -> None:
        self._make = make
        self._changed = changed
        self._stagger_s = stagger_s
        self.by_path: dict[Path, Runner] = {}
        self.faults: dict[Path, str] = {}
        """What is wrong with the files that are faulty."""
        self.check_at = math.inf
        """When the watchdogs are to be checked next."""
        self.all_started = False
        self._leaving: set[Runner] = set()
        """Those whose file is gone, until their process has ended."""
        self._running = Tasks()
        self._ends = False

    def __repr__(self) -> str:
        return f"<Runners of {len(self.by_path)} robots>"

    @property
    def is_idle(self) -> bool:
        """Whether all have started, and nothing is being started, restarted or ended."""
        if self._ends or self._leaving or not self.all_started:
            return False
        return all(runner.is_idle for runner in self.by_path.values())

    @property
    def processes(self) -> tuple[GatewayProcess, ...]:
        """All processes of all robots, also of those whose file is gone."""
        return tuple(process for runner in (*self.by_path.values(), *self._leaving) for process in runner.processes)

    @property
    def have_beaten(self) -> bool:
        """Whether all have started and each robot's process has sent a heartbeat."""
        processes = (runner.process for runner in self.by_path.values())
        return self.all_started and all(process is not None and process.watchdog.heartbeats for process in processes)

    @property
    def status(self) -> str:
        """One line on the gateways: how many robots are in which state, and how many files are faulty."""
        states = Counter(runner.state for runner in self.by_path.values())
        parts = [f"{len(self.by_path)} robots", *(f"{count} {state}" for state, count in sorted(states.items()))]
        restarts = sum(runner.restarts for runner in self.by_path.values())
        parts += [f"{restarts} restarts"] * bool(restarts) + [f"{len(self.faults)} faulty files"] * bool(self.faults)
        return ", ".join(parts)

    async def apply(self, changes: Changes, *, first: bool = False) -> None:
        """Start, restart and end what the files ask for; report the faulty ones. first: at the start of all."""
        for path, file in changes.moved:
            self.by_path[file.path] = runner = self.by_path.pop(path)
            runner.file = file
        for file in changes.faulty:
            runs = "its robot continues as before" if file.path in self.by_path else "no gateway uses it"
            log.error("file_faulty", "{reason}: {effect}", reason=file.fault, effect=runs, file=file.path)
            self.faults[file.path] = str(file.fault)
        for path in changes.gone:
            log.info("file_removed", "{file}: was removed: its robot's gateway ends", file=path)
            self._running.start(self._leave(self.by_path.pop(path)))
        for file in changes.changed:
            log.info("file_changed", "{file}: has changed", file=file.path)
            self.by_path[file.path].restart(file)
        for path in [*changes.gone, *(file.path for file in (*changes.came, *changes.changed))]:
            self.faults.pop(path, None)
        for number, file in enumerate(changes.came):
            if number and self._stagger_s:
                await asyncio.sleep(self._stagger_s * random.uniform(1 - JITTER, 1 + JITTER))
            if not first:
                log.info("file_new", "{file}: is new", file=file.path)
            self._run(file)
        self.all_started = self.all_started or first
        self._changed()

    def resume(self, states: Iterable[RunnerState]) -> None:
        """Resume the robots of the code before this one."""
        for state in states:
            file = RobotFile(Path(state.path), state.content, state.identity, forms=state.forms, shares=state.shares)
            self._run(file).resume(state)

    def reap(self) -> None:
        """Note which processes have ended."""
        for process in self.processes:
            process.reap()

    def check(self, now: float) -> None:
        """Kill every process that has been silent for too long, and set when to check again."""
        late_s = now - self.check_at
        deadlines = [now + 1.0]
        for process in self.processes:
            process.receive()
            process.reap()
            if late_s > LATE_S:
                process.watchdog.extend()
            if not process.over.done() and now >= process.watchdog.deadline:
                process.kill(f"sent no heartbeat for {process.watchdog.silent_s(now):.1f} s", hung=True)
            elif not process.over.done():
                deadlines.append(process.watchdog.deadline)
        self.check_at = max(now + 0.01, min(deadlines))

    async def end(self) -> None:
        """End all gateways, each with its robot's stop."""
        self._ends = True
        await asyncio.gather(*(runner.end() for runner in (*self.by_path.values(), *self._leaving)))
        await self._running.end()

    def _run(self, file: RobotFile) -> Runner:
        self.by_path[file.path] = runner = self._make(file)
        self._running.start(runner.run())
        return runner

    async def _leave(self, runner: Runner) -> None:
        self._leaving.add(runner)
        await runner.end()
        self._leaving.discard(runner)


class Reports:
    """Notifies systemd: of the status line, once that the service is ready, and of life where its watchdog wants it."""

    def __init__(self, systemd: Systemd, runners: Runners, *, is_ready: bool = False) -> None:
        self._systemd = systemd
        self._runners = runners
        self.is_ready = is_ready
        """Whether systemd knows that every gateway has begun."""
        self._timer: asyncio.TimerHandle | None = None

    def changed(self) -> None:
        """Report the status soon."""
        if self._timer is None:
            delay_s = STATUS_S if self.is_ready else READY_S
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._report)

    async def live(self) -> None:
        """Notify systemd's watchdog, where it wants that."""
        while self._systemd.watchdog_s:
            self._systemd.notify("WATCHDOG=1")
            await asyncio.sleep(self._systemd.watchdog_s)

    def close(self) -> None:
        """Report nothing any more."""
        if self._timer is not None:
            self._timer.cancel()

    def _report(self) -> None:
        self._timer = None
        ready = ("READY=1",) if not self.is_ready and self._runners.have_beaten else ()
        if not self._systemd.notify(*ready, f"STATUS={self._runners.status}"):
            self.changed()  # again, later
        elif ready:
            self.is_ready = True
            log.info("supervisor_ready", "ready: {status}", status=self._runners.status)
