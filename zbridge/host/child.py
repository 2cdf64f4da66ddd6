"""What a gateway process reports to its supervisor: heartbeats, its links, and what is needed if it dies.

Theory of operation. The reporter observes the robot's device (:class:`zbridge.robot.observer.Observer`). A timer of the
event loop sends a heartbeat: none comes from a loop that hangs. Whatever changes what the supervisor needs (the robot
is driven or not, the state of the link, a link that is up or gone) sends a heartbeat at once. The end of the channel
means that the supervisor has died: then the process ends in order, because nothing monitors its robot.

A heartbeat carries the stop of the robot. The state that a successor would need is deposited in shared memory, at most
every :data:`DEPOSIT_S` unless the state of the robot or its stop is another one; the position in each stream is noted
there with every read (:mod:`zbridge.host.memory`).
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import signal
import socket
from collections.abc import Callable
from functools import partial

import msgspec

from zbridge.app.handover.channel import HandoverState
from zbridge.errors import HandoverError, describe
from zbridge.host.fd_channel import (
    Closed,
    Deposited,
    FdChannel,
    Heartbeat,
    MetricsRead,
    Opened,
    ReadMetrics,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
    close_all,
    in_memory,
)
from zbridge.host.memory import DEPOSIT_BYTES, PARTIAL_BYTES, SLOTS, MemoryWriter, slot_of
from zbridge.log import Log
from zbridge.metrics.exposition import FamilyLines
from zbridge.protocol.kept import Budget
from zbridge.robot.connection import Resume
from zbridge.robot.observer import LastStop, ObservedRobot, Observer
from zbridge.transport import Link, Parcel

log = Log("zbridge.host")

HEARTBEAT_S = 1.0
"""Seconds between two heartbeats."""
DRIVEN_HEARTBEAT_S = 0.2
"""The same while the robot is driven."""
INSPECT_S = 0.05
"""Least time between two inspections of the frames of the stop, while commands come in, and before a deposit."""
ANSWER_S = 10.0
"""Longest wait for the start of a successor."""
DEPOSIT_S = 0.9
"""Least seconds between two deposits of what a successor needs."""
VALUE_BYTES = 128 * 1024
"""Largest single value in a deposit: a map that came in parts, a published message; larger ones are left out."""
LOG_S = 60.0
"""Least seconds between two log lines about what is not in a deposit."""
_LOST = "a crash would end the robot's connection"
_NUMBERS = 16 * SLOTS
"""Links are numbered up to here, then again from the lowest free number."""
_encode = msgspec.msgpack.Encoder().encode
Describe = Callable[[Parcel, Budget], HandoverState | None]
"""``describe(parcel, budget)``: describe what a successor needs; None if none could resume."""


class _Listed(Parcel):
    """Lists descriptors; duplicates none."""

    def put(self, descriptor: int) -> int:
        """Note a descriptor; return its number."""
        self.descriptors.append(descriptor)
        return len(self.descriptors) - 1


class Reporter(Observer):
    """The gateway's end of the channel; an observer of its robot. To be begun on the event loop.

    hands_over: whether the gateway hands over its sockets when it is sent SIGUSR2.
    """

    def __init__(self, channel: FdChannel, *, hands_over: bool = False) -> None:
        self._channel = channel
        self._hands_over = hands_over
        self._device: ObservedRobot | None = None
        self._links: dict[Link, tuple[int, str, tuple[int, ...]]] = {}
        """Number, name and reported descriptors of each link that is up."""
        self._numbers = 0
        self._reported = LastStop()
        self._inspected_at = self._deposited_at = 0.0
        self._announced = Deposited()
        self._deposited = b""
        self._missing_logged = ("", -math.inf)
        """What was logged last as missing in the deposit, and when."""
        self._at: dict[str, int] = {}
        """The number of the link of each name."""
        self._memory: MemoryWriter
        self.describe: Describe = lambda parcel, budget: None
        self.metrics: Callable[[], list[FamilyLines]] = list
        self.missing: Callable[[], tuple[str, ...]] = tuple
        """These three are set by the gateway's process."""
        self._timer: asyncio.TimerHandle | None = None
        self._deposit_timer: asyncio.TimerHandle | None = None
        self._answer: asyncio.Future[Started] | None = None

    def __repr__(self) -> str:
        return f"<Reporter of {len(self._links)} links>"

    def begin(self) -> None:
        """Start the heartbeats, and receive from the supervisor."""
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._channel.fileno(), self._receive)
        self._memory = MemoryWriter()
        self._channel.send(Shared(), [self._memory.descriptor])
        self._memory.close_descriptor()
        self._send_heartbeat()

    def close(self) -> None:
        """Stop reporting; idempotent. The supervisor sees the end of the process."""
        for timer in (self._timer, self._deposit_timer):
            if timer is not None:
                timer.cancel()
        if self._channel.fileno() >= 0:
            self._loop.remove_reader(self._channel.fileno())
            self._channel.close()
            self._memory.close()

    async def start_successor(self, far_end: socket.socket) -> None:
        """Ask for a process that takes over from ``far_end``; raise HandoverError if none is started."""
        self._answer = self._loop.create_future()
        if not self._channel.send(WantSuccessor(), [far_end.fileno()]):
            raise HandoverError("the supervisor does not listen")
        try:
            async with asyncio.timeout(ANSWER_S):
                started = await self._answer
        except TimeoutError:
            raise HandoverError(f"the supervisor started no successor within {ANSWER_S:g} s") from None
        finally:
            self._answer = None
        if started.reason is not None:
            raise HandoverError(started.reason)

    def handed_over(self) -> bool:
        """Report that the successor has the robot from now on; True: the supervisor monitors both, also if one dies.

        Raise HandoverError if the report cannot be sent.
        """
        if not self._channel.send(Succeeded()):
            raise HandoverError("the supervisor does not listen")
        return True

    # The observer

    def began(self, device: ObservedRobot) -> None:
        """Start: the device serves its robot. What this process deposits counts from now on, even if it is nothing."""
        self._device = device
        self._deposit(first=True)
        self._send_heartbeat()

    def ended(self) -> None:
        """End: the device has left its robot."""
        self._device = None
        self._send_heartbeat()

    def linked(self, name: str, link: Link, up: bool) -> None:
        """Send the supervisor duplicates of a link's sockets, or request that it closes them."""
        if up and len(self._links) < SLOTS:
            number = self._numbers = self._next_number()
            self._links[link] = (number, name, ())
            self._at[name] = number
            self._memory.begin(number)
            link.reads = partial(self._memory.reading, number)
            self._report_sockets(link)
        elif link in self._links:
            number, _, _ = self._links.pop(link)
            if self._at.get(name) == number:
                del self._at[name]
            link.reads = lambda: None
            self._channel.send(Closed(number))

    def read(self, name: str, resume: Resume) -> None:
        """Note in the shared memory where a successor would resume the stream of a link."""
        if name in self._at:
            self._memory.cut(self._at[name], resume(PARTIAL_BYTES))

    def changed(self, *, at_once: bool = False) -> None:
        """Send a heartbeat at once if a program has begun to drive the robot, or has ended, or its link is another one.

        at_once: also if the robot is stopped in another way.
        """
        device, reported = self._device, self._reported
        if device is None:
            return
        if device.driven is not reported.driven or device.state != reported.state:
            self._send_heartbeat()
        elif (now := self._loop.time()) >= self._inspected_at + INSPECT_S or at_once:
            self._inspected_at = now
            if device.last_stop() != reported:
                self._send_heartbeat()

    def published(self) -> None:
        """Deposit soon: a robot may say once in a connection what was published."""
        if self._deposit_timer is None:
            self._deposit_timer = self._loop.call_later(INSPECT_S, self._deposit_soon)

    def _deposit_soon(self) -> None:
        self._deposit_timer = None
        self._deposit()

    def _send_heartbeat(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        for link in self._links:
            self._report_sockets(link)
        device = self._device
        streams = {number: device.boundary(name) for number, name, _ in self._links.values()} if device else {}
        if device is not None:
            for name, number in self._at.items():  # the last read may have found nothing
                if (found := device.partial(name, PARTIAL_BYTES)) is not None:
                    self._memory.cut(number, found)
        last = device.last_stop() if device else LastStop()
        if self._loop.time() >= self._deposited_at + DEPOSIT_S or (last.state, last.frames) != (
            self._reported.state,
            self._reported.frames,
        ):
            self._deposit()
        if self._channel.send(Heartbeat(last, streams, self._hands_over, self.missing())):
            self._reported = last
        self._timer = self._loop.call_later(DRIVEN_HEARTBEAT_S if last.driven else HEARTBEAT_S, self._send_heartbeat)

    def _deposit(self, *, first: bool = False) -> None:
        """Deposit what a successor needs if this process dies, unless the last deposit says the same.

        Where nothing can be deposited (no state, or a socket that was not reported yet), an empty announcement takes
        back the deposit before. first: announce also if there is nothing to take back.
        """
        self._deposited_at, parcel = self._loop.time(), _Listed()
        data, missing, why = self._exported(parcel)
        places = {
            descriptor: (number, place)
            for number, _, reported in self._links.values()
            for place, descriptor in enumerate(reported)
        }
        announcement = Deposited()
        sockets = tuple(places[descriptor] for descriptor in parcel.descriptors if descriptor in places)
        if data and sockets and len(sockets) == len(parcel):
            if (data, sockets) == (self._deposited, self._announced.sockets):
                return
            announcement = Deposited(sockets, self._memory.deposit(data), len(data))
        if (first or announcement != self._announced) and self._channel.send(announcement):
            self._announced, self._deposited = announcement, data
            if announcement.sockets:
                self._memory.commit(announcement.area)
        self._log_missing(missing, why, lost=not data)

    def _exported(self, parcel: Parcel) -> tuple[bytes, str, str]:
        """Describe what a successor needs, b"" for nothing; say what is missing, and why.

        An exception of a protocol ends no heartbeat.
        """
        budget = Budget(VALUE_BYTES)
        try:
            state = self.describe(parcel, budget) if self._device is not None else None
            data = _encode(state) if state is not None else b""
        except Exception as error:
            return b"", _LOST, describe(error)
        if len(data) > DEPOSIT_BYTES:
            return b"", _LOST, f"its state has {len(data)} bytes, more than {DEPOSIT_BYTES}"
        names = sorted(budget.left_out)
        missing = f"after a crash the next process would begin without {', '.join(names)}" if names else ""
        sizes = ", ".join(str(budget.left_out[name]) for name in names)
        return data, missing, f"{sizes} bytes, more than {VALUE_BYTES}"

    def _log_missing(self, what: str, why: str, *, lost: bool) -> None:
        now, (logged, at) = self._loop.time(), self._missing_logged
        if what and what != logged and now >= at + LOG_S:
            self._missing_logged = (what, now)
            level = logging.WARNING if lost else logging.INFO
            log.log(level, "deposit_incomplete", "{what}: {reason}", what=what, reason=why)

    def _next_number(self) -> int:
        """Choose the number of a new link: one that was not used lately, with a slot of its own."""
        taken = {slot_of(number) for number, _, _ in self._links.values()}
        after = (self._numbers % _NUMBERS + step for step in range(1, SLOTS + 1))
        return next(number for number in after if slot_of(number) not in taken)

    def _report_sockets(self, link: Link) -> None:
        """Send the sockets of a link that were not sent yet: that of datagrams is opened later."""
        number, name, reported = self._links[link]
        descriptors = link.descriptors
        if descriptors != reported and descriptors:
            first = next(iter(self._links.values()))[1]
            if self._channel.send(Opened(number, name, drives=name == first), descriptors):
                self._links[link] = (number, name, descriptors)

    def _receive(self) -> None:
        try:
            received = self._channel.receive()
        except (BlockingIOError, ValueError):
            return
        if received is None:
            self._loop.remove_reader(self._channel.fileno())
            log.warning("supervisor_gone", "the supervisor is gone: this gateway ends")
            os.kill(os.getpid(), signal.SIGTERM)
            return
        message, descriptors = received
        close_all(descriptors)
        if isinstance(message, Started) and self._answer is not None and not self._answer.done():
            self._answer.set_result(message)
        elif isinstance(message, ReadMetrics):
            self._show_metrics(message.number)

    def _show_metrics(self, number: int) -> None:
        """Answer a question for the metrics; what one of them raises, or no memory, is logged and answers nothing."""
        try:
            with in_memory("zbridge metrics", _encode(self.metrics())) as descriptor:
                self._channel.send(MetricsRead(number), [descriptor])
        except Exception:
            log.exception("metrics_not_answered", "the metrics cannot be read: the supervisor gets none")
