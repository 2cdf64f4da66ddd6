"""One robot of a supervisor: its process, the successor of that process, restarts, and the stop after a crash.

Theory of operation. :meth:`Runner.run` holds one process after the other. A process ends by itself (it crashed), since
it was told to (the supervisor ends, or its file changed), or as no beat came: then it is killed. Whatever the cause, if
it did not end in order its robot is sent the stop that the process deposited last, over the duplicate of its socket,
and the next process starts after a time that :class:`BackOff` gives. A process that handed over is not started again:
its successor is the process from then on.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
import time
from collections.abc import Callable

from zbridge.app.supervisor.back_off import HEALTHY_S, BackOff
from zbridge.app.supervisor.duplicates import PERIOD_S, TIMES
from zbridge.app.supervisor.files import RobotFile, read
from zbridge.app.supervisor.forks import Forks
from zbridge.app.supervisor.inheritance import bequeath
from zbridge.app.supervisor.messages import Fork, Started
from zbridge.app.supervisor.post import Post
from zbridge.app.supervisor.process import KILLED_S, GatewayProcess
from zbridge.app.supervisor.state import RunnerState
from zbridge.errors import HandoverError, NotReady

log = logging.getLogger("zbridge.app.supervisor")

END_S = 5.0
"""Seconds that a process is given to end in order, with its robot's stop."""
GONE_S = 2.0
"""Longest wait for the end of a process that was killed, before another one has its connections."""
ASK_S = 5.0
"""Longest wait until a process that was told to hand over asks for its successor."""
HAND_OVER_S = 40.0
"""Seconds that a process is given to hand over to a successor."""


class Runner:
    """Keeps one robot's gateway running. changed: called when :attr:`process` or its state is another one."""

    def __init__(self, file: RobotFile, forks: Forks, *, verbose: bool, changed: Callable[[], object]) -> None:
        self.file = file
        self.process: GatewayProcess | None = None
        self.restarts = 0
        self._forks = forks
        self._verbose = verbose
        self._changed = changed
        self._back_off = BackOff()
        self._successor: GatewayProcess | None = None
        self._succession: asyncio.Task[None] | None = None
        self._asked = asyncio.Event()
        """Set when the process asks for a successor."""
        self._settled = asyncio.Event()
        """Set when a successor has taken over, or has not."""
        self._ending = False
        self._now = asyncio.Event()
        """Set to start the next process without waiting."""
        self._next_at: float | None = None
        """When the next process starts, while none runs."""
        self._restarting = 0
        self._waits = False
        """Whether :meth:`run` waits for the end of the process, or for the time of the next."""

    def __repr__(self) -> str:
        return f"<Runner {self.file.robot} {self.process}>"

    @property
    def processes(self) -> tuple[GatewayProcess, ...]:
        """The process, and its successor while it hands over."""
        return tuple(each for each in (self.process, self._successor) if each is not None)

    @property
    def state(self) -> str:
        """The state of the robot, as on ``status``; ``down``: no process runs."""
        return self.process.last.state if self.process is not None else "down"

    @property
    def is_calm(self) -> bool:
        """Whether nothing is under way but a process that runs, or the wait for the next: :attr:`state` is all then."""
        succeeding = self._successor is not None or not (self._succession is None or self._succession.done())
        process = self.process
        over = process.is_over if process is not None else self._now.is_set()
        return self._waits and not (self._ending or self._restarting or succeeding or over)

    @property
    def kept(self) -> RunnerState:
        """What :meth:`resume` needs, of a calm runner."""
        return RunnerState(
            str(self.file.path),
            self.file.content,
            self.file.identity,
            self.restarts,
            self._back_off.failures,
            self._next_at,
            self.process.state if self.process is not None else None,
        )

    def resume(self, state: RunnerState) -> None:
        """Go on where the code before this one was; then call :meth:`run`."""
        self.restarts, self._back_off.failures, self._next_at = state.restarts, state.failures, state.next_at
        if state.process is not None:
            self.process = self._process(state.process.pid, Post.inherited(state.process.post))
            self.process.resume(state.process)

    async def run(self) -> None:
        """Keep a process running until :meth:`end`."""
        if self._next_at is not None:
            await self._wait_until(self._next_at)
        while not self._ending:
            began = time.monotonic() - (self.process.lived_s if self.process is not None else 0.0)
            try:
                self.process = self.process or await self._start()
            except NotReady as error:
                log.error("%s: no process: %s", self.file.robot, error)
            else:
                await self._keep()
            self._changed()
            if not self._ending:
                await self._wait(time.monotonic() - began)

    async def end(self) -> None:
        """End the process in order, within :data:`END_S`; it is not started again."""
        self._ending = True
        self._now.set()
        await asyncio.gather(*(self._end(process) for process in self.processes))

    async def restart(self, file: RobotFile) -> None:
        """Run by a changed file from now on: hand over where the process can, else end it and start another one."""
        self._restarting += 1
        try:
            await self._restart(file)
        finally:
            self._restarting -= 1

    async def _restart(self, file: RobotFile) -> None:
        other = file.identity != self.file.identity
        self.file = file
        self._back_off.forget()
        process = self.process
        if process is None:
            self._now.set()
        elif other or not process.hands_over or not await self._handed_over(process):
            self._now.set()
            await self._end(process)

    # One process

    async def _start(self, take_over: int | None = None, *, at_once: bool = False) -> GatewayProcess:
        """Fork a process; ``at_once``: without a look at the installation."""
        post, far = Post.pair()
        request = Fork(str(self.file.path), self.file.robot, self._verbose)
        try:
            with far:
                pid = await self._forks.fork(request, far, take_over, at_once=at_once)
        except NotReady:
            post.close()
            raise
        log.info("%s: process %d", self.file.robot, pid)
        process = self._process(pid, post)
        if self._ending:
            process.signal(signal.SIGTERM)
        return process

    def _process(self, pid: int, post: Post) -> GatewayProcess:
        return GatewayProcess(pid, post, wants_successor=self._succeed, changed=self._changed)

    async def _keep(self) -> None:
        """Wait for the end of the process, and of its successors; stop the robot if it was no orderly one."""
        while (process := self.process) is not None:
            self._waits = True
            how = await process.ended()
            self._waits = False
            successor, self._successor = self._successor, None
            self.process = successor
            self._settled.set()
            if process.succeeded or (process.told_to_end and not len(process.duplicates)):
                how = None
            if how is not None:
                log.error("%s: process %d %s", self.file.robot, process.pid, how)
                await process.duplicates.stop(process.last, 1)  # before anything that may take time
                stopped = asyncio.ensure_future(self._stop_again(process))
                if successor is None and not self._ending and not process.told_to_end:
                    self.process = await self._inherited(process, stopped)
                await stopped
                if self.process is None:
                    await process.duplicates.leave()
            process.close()
            if self.process is not None and successor is None:
                self.restarts += 1
            elif successor is not None:  # one that has not taken over ends by itself
                log.info("%s: process %d serves it now", self.file.robot, successor.pid)

    async def _inherited(self, process: GatewayProcess, stopped: asyncio.Future[None]) -> GatewayProcess | None:
        """Start a successor of a dead process that keeps its connections; None where that is not possible."""
        if not await process.gone(GONE_S):  # it may still be within a read
            return None
        left = process.inheritance() if self._back_off.failures == 0 or process.lived_s >= HEALTHY_S else None
        if left is None:
            return None
        self._back_off.failed(process.lived_s)
        near, far = socket.socketpair()
        try:
            with far:
                successor = await self._start(far.fileno(), at_once=True)
        except NotReady as error:
            log.error("%s: its connections are lost: %s", self.file.robot, error)
            near.close()
            left[1].close()
            return None
        self._successor = successor
        try:
            await bequeath(near, *left, stopped)
        except HandoverError as error:
            log.error("%s: its connections are lost: %s", self.file.robot, error)
            await self._end(successor)
            successor.close()
            return None
        finally:
            self._successor = None
        log.info("%s: process %d goes on with its connections", self.file.robot, successor.pid)
        return successor

    async def _stop_again(self, process: GatewayProcess) -> None:
        """Write the stop that the process deposited last some times more."""
        await asyncio.sleep(PERIOD_S)
        took = await process.duplicates.stop(process.last, TIMES - 1)
        if took is not None:
            moved = "it was driven" if process.last.driven else "it was not driven"
            what = "the robot was sent its stop" if took else "the robot's link takes no stop"
            log.warning("%s: %s: %s", self.file.robot, what, moved)

    async def _end(self, process: GatewayProcess) -> None:
        process.told_to_end = True
        process.signal(signal.SIGTERM)
        if not await process.gone(END_S):
            log.error("%s: process %d did not end within %g s", self.file.robot, process.pid, END_S)
            process.kill(f"did not end within {END_S:g} s")
            await process.gone(KILLED_S)

    async def _wait(self, lived_s: float) -> None:
        """Wait before the next process; not at all where it was asked for."""
        at = time.monotonic()
        if not self._now.is_set():
            self.restarts += 1
            delay_s = self._back_off.failed(lived_s)
            log.info("%s: next process in %.1f s", self.file.robot, delay_s)
            at += delay_s
        await self._wait_until(at)

    async def _wait_until(self, at: float) -> None:
        self._next_at, self._waits = at, True
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(at - time.monotonic()):
                await self._now.wait()
        self._next_at, self._waits = None, False
        self._now.clear()

    # Handing over

    async def _handed_over(self, process: GatewayProcess) -> bool:
        """Ask a process to hand over to one that runs by the new file; False if that failed."""
        self._asked.clear()
        self._settled.clear()
        process.signal(signal.SIGUSR2)
        for event, within_s in ((self._asked, ASK_S), (self._settled, HAND_OVER_S)):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(within_s):
                    await event.wait()
            if not event.is_set():
                break
        if process.succeeded:
            await process.gone(END_S)
        return process.succeeded

    def _succeed(self, process: GatewayProcess, far_end: socket.socket) -> None:
        """Start the successor of a process; ``far_end``: the socket from which it takes over."""
        self._asked.set()
        self._succession = asyncio.ensure_future(self._start_successor(process, far_end))

    async def _start_successor(self, process: GatewayProcess, far_end: socket.socket) -> None:
        reason = None
        with far_end:
            if self._successor is not None or process is not self.process or self._ending:
                reason = "another process takes over already, or this one ends"
            elif (fault := read(self.file.path).fault) is not None:
                reason = fault
            else:
                try:
                    self._successor = successor = await self._start(far_end.fileno())
                    self._watch(successor)
                except NotReady as error:
                    reason = str(error)
        if reason is not None:
            log.error("%s: no successor: %s", self.file.robot, reason)
            self._settled.set()
        process.post.send(Started(reason))

    def _watch(self, successor: GatewayProcess) -> None:
        """Forget a successor that ends before it has taken over."""

        def ended(_: object) -> None:
            self._settled.set()
            if self._successor is successor:
                self._successor = None
                log.error("%s: process %d has not taken over: %s", self.file.robot, successor.pid, successor.how)
                successor.close()

        successor.over.add_done_callback(ended)
