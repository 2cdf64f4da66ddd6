"""One gateway process as its supervisor sees it: its heartbeats, its deposit, its end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import time
from collections.abc import Callable

import msgspec

from zbridge.host.deposit import Deposit
from zbridge.host.fd_channel import (
    Closed,
    Deposited,
    FdChannel,
    FromGateway,
    Heartbeat,
    MetricsRead,
    Opened,
    ReadMetrics,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
    close_all,
)
from zbridge.host.files import RobotFile
from zbridge.host.replacement import ProcessState
from zbridge.host.watchdog import Watchdog
from zbridge.log import Log
from zbridge.metrics.exposition import FamilyLines, InvalidMetrics, checked
from zbridge.robot.observer import LastStop

log = Log("zbridge.host")

KILLED_S = 0.05
"""Longest wait for the end of a process that was killed, before its robot is stopped."""
_MESSAGES = 64
"""Most messages that are taken from one process before others are served."""
_DRAINED = 64
"""The same, times :data:`_MESSAGES`, of a process that has ended: more than its socket holds."""
METRICS_BYTES = 256 * 1024
"""Most bytes of the metrics of one process."""
_decode_metrics = msgspec.msgpack.Decoder(list[FamilyLines]).decode


class Death(msgspec.Struct, frozen=True):
    """How a process ended that did not end in order. hung: it was killed because it sent no heartbeat."""

    how: str
    hung: bool = False


class GatewayProcess:
    """A forked gateway, a child of this process. Holds what it deposited until :meth:`close`.

    file: as the process runs by it. wants_successor: called with this process and the far end of the socket from which
    the successor takes over; the callee closes it. changed: called when the state of the robot is another one.
    """

    def __init__(
        self,
        pid: int,
        channel: FdChannel,
        file: RobotFile,
        *,
        wants_successor: Callable[[GatewayProcess, socket.socket], object],
        changed: Callable[[], object] = lambda: None,
    ) -> None:
        self.pid = pid
        self.channel = channel
        self.file = file
        self.deposit = Deposit()
        self.hands_over = False
        self.missing: tuple[str, ...] = ("starting",)
        """Why the gateway is of no use now, as it reported last."""
        self.succeeded = False
        """Whether a successor has the robot."""
        self.asked_to_end = False
        self.hung = False
        """Whether it was killed because it sent no heartbeat."""
        self.watchdog = Watchdog(time.monotonic())
        self.over: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        """Done when the process has ended; its wait status."""
        self._killed: str | None = None
        self._left = asyncio.Event()
        """Set when the process has hung, or handed over."""
        self._began = time.monotonic()
        self._wants_successor = wants_successor
        self._changed = changed
        self._question = 0
        self._metrics: asyncio.Future[list[FamilyLines]] | None = None
        """The answer to the last question for the metrics."""
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(channel.fileno(), self.receive)

    def __repr__(self) -> str:
        return f"<GatewayProcess {self.pid} {self.last.state}>"

    async def ended(self) -> str | None:
        """Wait until the process has ended, or handed over; how it ended, None: in order."""
        left = asyncio.ensure_future(self._left.wait())
        await asyncio.wait((self.over, left), return_when=asyncio.FIRST_COMPLETED)
        left.cancel()
        if not self.over.done() and not self.succeeded:
            await self.gone(KILLED_S)
        for _ in range(_DRAINED):  # all that it sent before it died counts
            if not self.receive():
                break
        return self._killed or self.how

    @property
    def lived_s(self) -> float:
        """Seconds since the process was forked."""
        return time.monotonic() - self._began

    async def gone(self, within_s: float) -> bool:
        """Wait so long for the end of the process; whether it has ended."""
        await asyncio.wait([self.over], timeout=within_s)
        return self.over.done()

    @property
    def how(self) -> str | None:
        """How the process has ended; None: in order, or not yet."""
        if not self.over.done():
            return None
        code = os.waitstatus_to_exitcode(self.over.result())
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}" if code else None

    def reap(self) -> None:
        """Take the exit status, if the process has ended."""
        if not self.over.done():
            with contextlib.suppress(ChildProcessError):
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                if pid:
                    self.over.set_result(status)

    def kill(self, why: str, *, hung: bool = False) -> None:
        """End the process now: it counts as one that crashed. hung: because it sent no heartbeat."""
        self.hung = hung or self.hung
        self._killed = self._killed or why
        self.signal(signal.SIGKILL)
        self._left.set()

    def signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if not self.over.done():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def receive(self) -> bool:
        """Receive what the process sent, some messages at a time; whether there may be more."""
        for _ in range(_MESSAGES):
            try:
                received = self.channel.receive()
            except BlockingIOError:
                return False
            except ValueError as error:
                template = "process {pid} sent an invalid message: {error}"
                log.error("invalid_report", template, pid=self.pid, error=error, robot=self.file.robot)
                continue
            except OSError:  # closed
                return False
            if received is None:
                self._loop.remove_reader(self.channel.fileno())
                return False
            message, descriptors = received
            self._handle(message, descriptors)  # type: ignore[arg-type]
        return True

    def _handle(self, message: FromGateway, descriptors: list[int]) -> None:
        match message:
            case _ if self.succeeded:  # its actions at its end no longer concern its successor
                pass
            case Heartbeat():
                state, self.deposit.last, self.hands_over = self.last.state, message.last, message.hands_over
                self.missing = message.missing
                self.watchdog.heartbeat(time.monotonic(), driven=message.last.driven)
                self.deposit.duplicates.set_boundaries(message.streams)
                if message.last.state != state or self.watchdog.heartbeats == 1:
                    self._changed()
            case Opened():
                self.deposit.duplicates.opened(message.link, message.name, descriptors, drives=message.drives)
                return
            case Closed():
                self.deposit.closed(message.link)
            case Deposited():
                self.deposit.note(message)
            case Shared() if descriptors and self.deposit.memory is None:
                self.deposit.share(descriptors.pop(0))
            case MetricsRead() if descriptors:
                self._take_metrics(message.number, descriptors[0])
            case WantSuccessor() if descriptors:
                self._wants_successor(self, socket.socket(fileno=descriptors.pop(0)))
            case WantSuccessor():
                self.channel.send(Started("the supervisor has no free descriptor"))
            case Succeeded():
                self.succeeded = True
                self._left.set()
        close_all(descriptors)

    def ask_metrics(self) -> asyncio.Future[list[FamilyLines]]:
        """Ask the process for its metrics; the answer may never come. The question before is answered no more."""
        self._question += 1
        self._metrics = self._loop.create_future()
        self.channel.send(ReadMetrics(self._question))
        return self._metrics

    def _take_metrics(self, number: int, descriptor: int) -> None:
        asked = self._metrics
        if asked is None or asked.done() or number != self._question:
            return
        try:
            asked.set_result(checked(_decode_metrics(os.pread(descriptor, METRICS_BYTES, 0))))
        except (OSError, msgspec.MsgspecError, InvalidMetrics, UnicodeError, RecursionError) as error:
            log.error("metrics_invalid", "process {pid} sent invalid metrics: {error}", pid=self.pid, error=error)

    @property
    def last(self) -> LastStop:
        """What the process reported last of its robot's stop, motion and state."""
        return self.deposit.last

    @property
    def is_over(self) -> bool:
        """Whether the process has ended, is being ended, or has handed over."""
        return self.over.done() or self._left.is_set() or self.asked_to_end

    @property
    def state(self) -> ProcessState:
        """What :meth:`resume` needs, while the process is not over, and its deposit is its own."""
        deposit, links = self.deposit, tuple(self.deposit.duplicates)
        reports: list[tuple[FromGateway, tuple[int, ...]]] = []
        if deposit.memory is not None:
            reports.append((Shared(), (deposit.memory.descriptor,)))
        reports += [(Opened(each.link, each.name, each.drives), each.descriptors) for each in links]
        heartbeat = Heartbeat(deposit.last, {each.link: each.boundary for each in links}, self.hands_over, self.missing)
        reports += [(deposit.deposited or Deposited(), ()), (heartbeat, ())]
        return ProcessState(self.pid, self.channel.fileno(), self._began, self.watchdog, tuple(reports))

    def resume(self, state: ProcessState) -> None:
        """Receive again what the process had reported to the code before this one."""
        for message, descriptors in state.reports:
            self._handle(message, list(descriptors))
        self._began, self.watchdog = state.began, state.watchdog

    def hand_deposit_to(self, successor: GatewayProcess) -> None:
        """Return a successor what this process deposited: it counts until the successor has made its own deposit."""
        deposit, self.deposit = self.deposit, Deposit()
        if successor.deposit.deposited is None:
            successor.deposit.predecessor = deposit
        else:  # its deposit came before the message of the handover
            deposit.close()

    def close(self) -> None:
        """Close the channel and the deposit; idempotent."""
        if self.channel.fileno() >= 0:
            self._loop.remove_reader(self.channel.fileno())
            self.channel.close()
        self.deposit.close()
