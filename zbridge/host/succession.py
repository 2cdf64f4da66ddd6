"""The process that takes over from another one: forked, offered what a dead process left, or given up.

Theory of operation. At most one successor at a time. It begins at the request of the process before it, which hands
over by itself (:meth:`Succession.begin`), or after a crash (:meth:`Succession.offer`): then what the dead process
deposited is offered over the same channel, in its place. The successor holds everything, and neither reads nor writes,
until the word to go; it may be killed until then, and nothing has happened. The word comes when the robot's stop is
written: two processes never write to one socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec

from zbridge.app.handover.channel import Go, HandoverChannel, HandoverState, Hello, Up
from zbridge.errors import HandoverError, NotReady
from zbridge.host.duplicates import PERIOD_S
from zbridge.host.fd_channel import FdChannel, Fork, Started
from zbridge.host.files import RobotFile, read
from zbridge.host.fork_client import ForkClient
from zbridge.host.process import Death, GatewayProcess
from zbridge.log import Log
from zbridge.transport import Parcel

log = Log("zbridge.host")


STAT_S = 1.0
"""Longest wait for the disk to tell whether a robot file is still there."""

Make = Callable[[int, FdChannel, RobotFile], GatewayProcess]
"""``make(pid, channel, file)``: the process as its runner knows it."""

START_S = 10.0
"""Longest time until a successor has joined the bus."""
TAKE_OVER_S = 5.0
"""Longest time until it has taken over what was offered."""
GONE_S = 2.0
"""Longest wait for the end of a process that was killed."""


class Launcher:
    """Starts processes; ``make`` makes of each what its runner knows.

    request: what all have in common; file and robot are put in.
    """

    def __init__(self, forks: ForkClient, make: Make, request: Fork) -> None:
        self._forks = forks
        self._make = make
        self._request = request

    def __repr__(self) -> str:
        return f"<Launcher by {self._forks!r}>"

    async def start(
        self, file: RobotFile, take_over: int | None = None, *, at_once: bool = False, died: Death | None = None
    ) -> GatewayProcess:
        """Fork a process; raise NotReady with the reason: also that the file is gone, whatever stood in it.

        take_over: descriptor of the socket by which it takes over. at_once: without a check of the installation. died:
        how the process before it died.
        """
        if not await _is_there(file.path):
            raise NotReady(f"{file.path} is gone")
        try:
            channel, far = FdChannel.pair()
        except OSError as error:
            raise NotReady(error.strerror or str(error)) from error
        how, hung = (died.how, died.hung) if died is not None else ("", False)
        request = msgspec.structs.replace(self._request, file=str(file.path), robot=file.robot, died=how, hung=hung)
        try:
            with far:
                pid = await self._forks.fork(request, far, file.content, take_over, at_once=at_once)
        except NotReady:
            channel.close()
            raise
        log.info("process_started", "{robot}: process {pid}", robot=file.robot, pid=pid)
        return self._make(pid, channel, file)


async def _is_there(path: Path) -> bool:
    """Whether a file is there, as far as the disk tells in time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(STAT_S):
            return await asyncio.to_thread(path.exists)
    return True


class Succession:
    """The successor of one robot's process. settled: set when a successor that was begun has the robot, or has not."""

    def __init__(self, robot: str, launcher: Launcher, settled: asyncio.Event) -> None:
        self.successor: GatewayProcess | None = None
        """The process that takes over, until it has the robot."""
        self._killed: set[GatewayProcess] = set()
        """Successors that were given up, until they have ended."""
        self._robot = robot
        self._launcher = launcher
        self._settled = settled

    def __repr__(self) -> str:
        return f"<Succession of {self._robot} by {self.successor}>"

    @property
    def processes(self) -> tuple[GatewayProcess, ...]:
        """All processes that have not the robot."""
        return (*self._killed, *(() if self.successor is None else (self.successor,)))

    # At the request of the process

    async def begin(
        self,
        process: GatewayProcess,
        far_end: socket.socket,
        path: Path,
        most_bytes: int,
        alone: Callable[[], bool],
    ) -> None:
        """Start the successor of a process, and answer the process. The file is read anew.

        far_end: the socket from which the successor takes over; closed here. alone: whether the process serves the
        robot, and nobody takes over.
        """
        reason: str | None = "another process takes over already, or this one ends"
        with far_end:
            if alone():
                file = await asyncio.to_thread(read, path, most_bytes)
                reason = file.fault or await self._forked(process, file, far_end, alone)
        if reason is not None:
            log.error("no_successor", "{robot}: no successor: {reason}", robot=self._robot, reason=reason)
            self._settled.set()
        process.channel.send(Started(reason))

    async def _forked(
        self, process: GatewayProcess, file: RobotFile, far_end: socket.socket, alone: Callable[[], bool]
    ) -> str | None:
        """Fork the successor of a process; return why there is none."""
        try:
            successor = await self._launcher.start(file, far_end.fileno())
        except NotReady as error:
            return str(error)
        if not alone():  # it died meanwhile
            await self._kill(successor)
            return "this process ends"
        self.successor = successor
        successor.over.add_done_callback(lambda _: self._forget(process, successor))
        return None

    def _forget(self, process: GatewayProcess, successor: GatewayProcess) -> None:
        """Forget a successor that ended before it had the robot."""
        process.receive()  # it may have handed over
        if self.successor is successor and not process.succeeded:
            self.successor = None
            self._settled.set()
            template = "{robot}: process {pid} did not take over: {how}"
            log.error("successor_died", template, robot=self._robot, pid=successor.pid, how=successor.how)
            successor.close()

    def take(self) -> GatewayProcess | None:
        """Return the successor, which has the robot now; None: there is none."""
        successor, self.successor = self.successor, None
        return successor

    async def give_up(self) -> None:
        """Kill a successor that has not got the robot."""
        if (successor := self.take()) is not None:
            await self._kill(successor)

    async def _kill(self, successor: GatewayProcess) -> None:
        self._killed.add(successor)
        successor.over.add_done_callback(lambda _: self._killed.discard(successor))
        successor.kill("the process before it has ended")
        await successor.gone(GONE_S)
        successor.close()

    # After a crash

    async def offer(
        self, process: GatewayProcess, path: Path, stopped: Awaitable[object], died: Death
    ) -> GatewayProcess:
        """Offer what a dead process left to a new one, which runs by the same content; return it when it has the robot.

        path: of the file now. stopped: done when the robot's stop is written. died: how the process died. Raise
        HandoverError, NotReady or OSError.
        """
        given, parcel = process.deposit.inheritance()
        file = msgspec.structs.replace(process.file, path=path)
        with contextlib.closing(parcel):
            near, far = socket.socketpair()
            with contextlib.closing(HandoverChannel(near)) as channel:
                with far:
                    self.successor = successor = await self._launcher.start(file, far.fileno(), at_once=True, died=died)
                try:
                    await _give(channel, given, parcel)
                    await stopped
                    await asyncio.sleep(PERIOD_S)  # it begins with a stop: the robot must not read both as one packet
                except HandoverError:
                    await self.give_up()
                    raise
                self.successor = None
                process.hand_deposit_to(successor)
                with contextlib.suppress(HandoverError):  # it has ended: that is a crash like any other
                    await channel.send(Go())
        return successor


async def _give(channel: HandoverChannel, given: HandoverState, parcel: Parcel) -> None:
    """Return a successor what a dead process left, until it waits for the word to go; raise HandoverError."""
    hello = await channel.receive(Hello, START_S)
    if hello.version != given.version:
        raise HandoverError(f"it accepts states of version {hello.version}, the dead process left {given.version}")
    await channel.send(given, parcel)
    await channel.receive(Up, TAKE_OVER_S)
