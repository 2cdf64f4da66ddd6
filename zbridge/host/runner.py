"""One robot of a supervisor: its process, the successor of that process, restarts, and the stop after a crash.

Theory of operation. :meth:`Runner.run` holds one process after the other. A process ends by itself (it crashed), since
it was signalled to (the supervisor ends, or its file changed), or sent no heartbeat: then it is killed. Whatever the
cause, if it did not end in order its robot is sent the stop that the process deposited last, over the duplicate of its
socket.

**A crash.** The stop is written before anything else. Then a process is forked that takes over what the dead one
deposited, and so keeps the robot's connection; it may read and write when the stop was written often enough. Where that
is not possible, or the fourth in a row has crashed, the connection is closed, and the next process starts after a time
that :class:`RestartDelay` gives.

**A restart.** The process asks for a successor, and hands everything over to it. It reports this
(:class:`~zbridge.host.fd_channel.Succeeded`) before it notifies the successor. That message decides:

=========================  =========================================================================================
who dies, when             what happens
=========================  =========================================================================================
the successor, before it   the process continues
the process, before it     the successor is killed: it has touched nothing. Then as after a crash
either, after it           the successor is the robot's process. Until it makes a deposit, that of the process before
                           it counts: if the successor dies, it crashed, and the robot is stopped
=========================  =========================================================================================

A process runs by the content of its file that was checked, never by what the file may hold meanwhile.
"""

from __future__ import annotations

import asyncio
import signal
import socket
import time
from collections.abc import Callable

import msgspec

from zbridge.errors import HandoverError, NotReady
from zbridge.host.duplicates import PERIOD_S, TIMES
from zbridge.host.fd_channel import FdChannel, Fork
from zbridge.host.files import RobotFile
from zbridge.host.fork_client import ForkClient
from zbridge.host.process import KILLED_S, Death, GatewayProcess
from zbridge.host.replacement import RunnerState
from zbridge.host.succession import GONE_S, Launcher, Succession
from zbridge.host.watchdog import HEALTHY_S, RestartDelay
from zbridge.log import Log
from zbridge.tasks import Tasks, occurs
from zbridge.toml import FILE_BYTES

log = Log("zbridge.host")

END_S, ASK_S = 5.0, 5.0
"""Seconds that a process is given to end in order, with its robot's stop, and to ask for its successor."""
HAND_OVER_S = 40.0
"""Seconds that a process is given to hand over to a successor."""
RESUMED_CRASHES = 3
"""Crashes in a row over which a connection is kept: what was deposited may be what kills each of them."""
OFFERS = 2
"""How often what a dead process left is offered to another successor, if one does not take it over."""


class Runner:
    """Keeps one robot's gateway running. request: as of :class:`Launcher`. most_bytes: of the robot's file.

    changed: called when :attr:`process` or its state is another one.
    """

    def __init__(
        self,
        file: RobotFile,
        forks: ForkClient,
        request: Fork,
        *,
        changed: Callable[[], object],
        most_bytes: int = FILE_BYTES,
    ) -> None:
        self.file = file
        self.process: GatewayProcess | None = None
        self.restarts = 0
        self._launcher = Launcher(forks, self._process, request)
        self._changed = changed
        self._most_bytes = most_bytes
        self._restart_delay = RestartDelay()
        self._former: set[GatewayProcess] = set()
        """Those that have handed over or crashed, until they have ended."""
        self._tasks = Tasks()
        self._restarting = Tasks()
        self._asked = asyncio.Event()
        """Set when the process asks for a successor."""
        self._settled = asyncio.Event()
        """Set when a successor has taken over, or has not."""
        self._succession = Succession(file.robot, self._launcher, self._settled)
        self._attended = asyncio.Event()
        """Cleared while the robot of a process that died is stopped."""
        self._attended.set()
        self._ending = False
        self._died: Death | None = None
        """How the last process died, until another one is started."""
        self._now = asyncio.Event()
        """Set to start the next process without waiting."""
        self._next_at: float | None = None
        """When the next process starts, while none runs."""

    def __repr__(self) -> str:
        return f"<Runner {self.file.robot} {self.process}>"

    @property
    def processes(self) -> tuple[GatewayProcess, ...]:
        """The process, its successor while it hands over, and all others that have not ended."""
        return (*(() if self.process is None else (self.process,)), *self._succession.processes, *self._former)

    @property
    def state(self) -> str:
        """The state of the robot, as on ``status``; ``down``: no process runs."""
        return self.process.last.state if self.process is not None else "down"

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way but a process that runs, or the wait for the next: :attr:`state` is all then."""
        if self._succession.processes or self._former or self._tasks or self._restarting or self._ending:
            return False
        if self.process is None:
            return self._next_at is not None and not self._now.is_set()
        return not self.process.is_over and self.process.deposit.predecessor is None

    @property
    def snapshot(self) -> RunnerState:
        """What :meth:`resume` needs, of a calm runner."""
        file, process = self.file, self.process.state if self.process is not None else None
        of_file = (str(file.path), file.content, file.identity, file.forms, file.shares)
        return RunnerState(*of_file, self.restarts, self._restart_delay.failures, self._next_at, process)

    def resume(self, state: RunnerState) -> None:
        """Continue where the code before this one stopped; then call :meth:`run`."""
        self.restarts, self._restart_delay.failures, self._next_at = state.restarts, state.failures, state.next_at
        if state.process is not None:
            self.process = self._process(state.process.pid, FdChannel.inherited(state.process.channel), self.file)
            self.process.resume(state.process)

    async def run(self) -> None:
        """Keep a process running until :meth:`end`."""
        if self._next_at is not None:
            await self._wait_until(self._next_at)
        while not self._ending:
            began = time.monotonic() - (self.process.lived_s if self.process is not None else 0.0)
            try:
                self.process = self.process or await self._launcher.start(self.file, died=self._died)
            except NotReady as error:
                log.error("no_process", "{robot}: no process: {error}", robot=self.file.robot, error=error)
            else:
                self._died = None
                await self._supervise()
            self._changed()
            if not self._ending:
                await self._wait(time.monotonic() - began)

    async def end(self) -> None:
        """End the process in order, within :data:`END_S`; it is not started again."""
        self._ending = True
        self._now.set()
        await asyncio.gather(self._attended.wait(), *(self._end(process) for process in self.processes))
        await self._restarting.end()

    def restart(self, file: RobotFile) -> None:
        """Run by a changed file from now on: hand over where the process can, else end it and start another one."""
        self._restarting.start(self._restart(file))

    async def _restart(self, file: RobotFile) -> None:
        other = file.identity != self.file.identity
        self.file = file
        self._restart_delay.reset()
        process = self.process
        if process is None:
            self._now.set()
        elif other or not process.hands_over or not await self._handed_over(process):
            self._now.set()
            await self._end(process)

    # One process

    def _process(self, pid: int, channel: FdChannel, file: RobotFile) -> GatewayProcess:
        process = GatewayProcess(pid, channel, file, wants_successor=self._succeed, changed=self._changed)
        if self._ending:
            process.signal(signal.SIGTERM)
        return process

    async def _supervise(self) -> None:
        """Wait for the end of the process, and of those that follow it; stop the robot if it was no orderly one."""
        while (process := self.process) is not None:
            how = await process.ended()
            if process.succeeded:
                if self._promote_successor(process):
                    continue
                how = "it was not handed over"
            self.process = None
            self._former.add(process)  # it may still have to be waited for
            if not (how is None or (process.asked_to_end and not process.deposit.has_links)):
                self.process = await self._crashed(process, how)
            await self._succession.give_up()
            self._former.discard(process)
            process.close()
            self.restarts += self.process is not None
            self._settled.set()

    async def _crashed(self, process: GatewayProcess, how: str) -> GatewayProcess | None:
        """Stop the robot of a process that died; give the process that has its connections, None if none has."""
        self._attended.clear()
        self._died = died = Death(f"process {process.pid} {how}", process.hung)
        log.error("process_died", "{robot}: process {pid} {how}", robot=self.file.robot, pid=process.pid, how=how)
        await process.deposit.stop(1)  # before anything that may take time
        stopped = asyncio.ensure_future(self._repeat_stop(process))
        await self._succession.give_up()
        successor = None
        if not self._ending and not process.asked_to_end and process.deposit.has_links:
            successor = await self._inherited(process, stopped, died)
        await stopped
        if successor is None:
            await process.deposit.drain()
        elif successor.file.content != self.file.content:  # the file changed while the process died
            self.restart(self.file)
        self._attended.set()
        return successor

    async def _inherited(
        self, process: GatewayProcess, stopped: asyncio.Future[None], died: Death
    ) -> GatewayProcess | None:
        """Start a successor of a dead process that keeps its connections; None if that is not possible."""
        reason = ""
        if not await process.gone(GONE_S):
            reason = "it may still be reading"
        elif self._restart_delay.failures >= RESUMED_CRASHES and process.lived_s < HEALTHY_S:
            reason = f"{RESUMED_CRASHES} processes that took it over have crashed"
        for _ in range(0 if reason else OFFERS):
            if self._ending:
                return None
            try:
                successor = await self._succession.offer(process, self.file.path, stopped, died)
            except (HandoverError, NotReady, OSError) as error:
                reason = str(error)
            else:
                self._restart_delay.failed(process.lived_s)
                self._died = None  # it was told
                template = "{robot}: process {pid} continues with its connections"
                log.info("connections_inherited", template, robot=self.file.robot, pid=successor.pid)
                return successor
        template = "{robot}: its connections are lost: {reason}"
        log.error("connections_lost", template, robot=self.file.robot, reason=reason)
        return None

    def _promote_successor(self, process: GatewayProcess) -> bool:
        """Let the successor be the robot's process; False if there is none."""
        successor = self._succession.take()
        self._settled.set()
        if successor is None:
            process.signal(signal.SIGKILL)
            return False
        process.hand_deposit_to(successor)
        self.process = successor
        self.file = msgspec.structs.replace(successor.file, path=self.file.path)  # it may have been renamed meanwhile
        log.info("process_took_over", "{robot}: process {pid} serves it now", robot=self.file.robot, pid=successor.pid)
        self._former.add(process)
        self._tasks.start(self._await_end(process))
        return True

    async def _await_end(self, process: GatewayProcess) -> None:
        """Wait for the end of a process that has handed over."""
        await self._gone(process)
        process.close()
        self._former.discard(process)

    async def _repeat_stop(self, process: GatewayProcess) -> None:
        """Write the stop that the process deposited last some times more."""
        await asyncio.sleep(PERIOD_S)
        took = await process.deposit.stop(TIMES - 1)
        if took is not None:
            moved = "it was driven" if process.last.driven else "it was not driven"
            what = "the robot was sent its stop" if took else "the robot's link is stalled: no stop was written"
            log.warning("robot_stopped", "{robot}: {what}: {driven}", robot=self.file.robot, what=what, driven=moved)

    async def _end(self, process: GatewayProcess) -> None:
        process.asked_to_end = True
        process.signal(signal.SIGTERM)
        await self._gone(process)

    async def _gone(self, process: GatewayProcess) -> None:
        """Wait for the end of a process that ends by itself."""
        if not await process.gone(END_S):
            template = "{robot}: process {pid} did not end within {within_s:g} s"
            log.error("process_hangs", template, robot=self.file.robot, pid=process.pid, within_s=END_S)
            process.kill(f"did not end within {END_S:g} s")
            await process.gone(KILLED_S)

    async def _wait(self, lived_s: float) -> None:
        """Wait before the next process; not at all where it was asked for."""
        at = time.monotonic()
        if not self._now.is_set():
            self.restarts += 1
            delay_s = self._restart_delay.failed(lived_s)
            template = "{robot}: next process in {delay_s:.1f} s"
            log.info("next_process", template, robot=self.file.robot, delay_s=delay_s)
            at += delay_s
        await self._wait_until(at)

    async def _wait_until(self, at: float) -> None:
        self._next_at = at
        await occurs(self._now, at - time.monotonic())
        self._next_at = None
        self._now.clear()

    # Handing over

    async def _handed_over(self, process: GatewayProcess) -> bool:
        """Ask a process to hand over to one that runs by the new file; False if that failed."""
        self._asked.clear()
        self._settled.clear()
        process.signal(signal.SIGUSR2)
        for event, within_s in ((self._asked, ASK_S), (self._settled, HAND_OVER_S)):
            if not await occurs(event, within_s):
                break
        if process.succeeded:
            await process.gone(END_S)
        return process.succeeded

    def _succeed(self, process: GatewayProcess, far_end: socket.socket) -> None:
        """Start the successor of a process; ``far_end``: the socket from which it takes over."""
        self._asked.set()

        def alone() -> bool:
            return process is self.process and self._succession.successor is None and not self._ending

        self._tasks.start(self._succession.begin(process, far_end, self.file.path, self._most_bytes, alone))
