"""What a gateway process tells its supervisor: beats, its links, and what is needed if it dies.

Theory of operation. The reporter observes the robot's device (:class:`zbridge.robot.observer.Observer`). A timer of the
event loop sends a beat: no beat comes from a loop that hangs. Whatever changes what the supervisor needs (the robot is
driven or not, the state of the link, a link that is up or gone) sends a beat at once. The end of the post means that
the supervisor is gone: then the process ends in order, as nobody looks after its robot.

A beat has the stop of the robot. The state that a successor would need is deposited in shared memory, at most every
:data:`KEEP_S` unless the state of the robot or its stop is another one; where each stream stands is noted there with
every read (:mod:`zbridge.host.memory`).
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

from zbridge.app.handover.channel import Given
from zbridge.errors import HandoverError, describe
from zbridge.host.fd_channel import (
    Beat,
    Closed,
    Kept,
    Opened,
    Post,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
    close_all,
)
from zbridge.host.memory import DEPOSIT_BYTES, PARTIAL_BYTES, SLOTS, MemoryWriter, slot_of
from zbridge.protocol.kept import Budget
from zbridge.robot.observer import LastStop, Observed, Resume
from zbridge.transport import Link, Parcel

log = logging.getLogger("zbridge.host")

BEAT_S = 1.0
"""Seconds between two beats."""
DRIVEN_BEAT_S = 0.2
"""The same while the robot is driven."""
LOOK_S = 0.05
"""Least time between two looks at the frames of the stop, while commands come in, and before a deposit."""
ANSWER_S = 10.0
"""Longest wait for the start of a successor."""
KEEP_S = 0.9
"""Least seconds between two deposits of what a successor needs."""
VALUE_BYTES = 128 * 1024
"""Largest single value in a deposit: a map that came in parts, a published message; larger ones are left out."""
TELL_S = 60.0
"""Least seconds between two log lines about what is not in a deposit."""
_LOST = "a crash would end the robot's connection"
_NUMBERS = 16 * SLOTS
"""Links are numbered up to here, then again from the lowest free number."""
_encode = msgspec.msgpack.Encoder().encode
Keep = Callable[[Parcel, Budget], Given | None]
"""``keep(parcel, budget)``: describe what a successor needs; None where none could resume."""


class _Listed(Parcel):
    """Lists descriptors; duplicates none."""

    def put(self, descriptor: int) -> int:
        """Note a descriptor; return its number."""
        self.descriptors.append(descriptor)
        return len(self.descriptors) - 1


class Reporter:
    """The gateway's end of the post; an observer of its robot. To be begun on the event loop.

    hands_over: whether the gateway hands over its sockets when it is sent SIGUSR2.
    """

    def __init__(self, post: Post, *, hands_over: bool = False) -> None:
        self._post = post
        self._hands_over = hands_over
        self._device: Observed | None = None
        self._links: dict[Link, tuple[int, str, tuple[int, ...]]] = {}
        """The number, the name and the descriptors that were told, for each link that is up."""
        self._numbers = 0
        self._told = LastStop()
        self._looked_at = self._kept_at = 0.0
        self._kept = Kept()
        self._deposited = b""
        self._missing_told = ("", -math.inf)
        """What the log said last of what is not in the deposit, and when."""
        self._at: dict[str, int] = {}
        """The number of the link of each name."""
        self._memory: MemoryWriter
        self.keep: Keep = lambda parcel, budget: None
        """Set by the gateway's process."""
        self._timer: asyncio.TimerHandle | None = None
        self._keep_timer: asyncio.TimerHandle | None = None
        self._answer: asyncio.Future[Started] | None = None

    def __repr__(self) -> str:
        return f"<Reporter of {len(self._links)} links>"

    def begin(self) -> None:
        """Beat from now on, and hear the supervisor."""
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._post.fileno(), self._hear)
        self._share()
        self._beat()

    def close(self) -> None:
        """Tell nothing more; idempotent. The supervisor sees the end of the process."""
        for timer in (self._timer, self._keep_timer):
            if timer is not None:
                timer.cancel()
        if self._post.fileno() >= 0:
            self._loop.remove_reader(self._post.fileno())
            self._post.close()
            self._memory.close()

    async def start_successor(self, far_end: socket.socket) -> None:
        """Ask for a process that takes over from ``far_end``; raise HandoverError if none is started."""
        self._answer = self._loop.create_future()
        if not self._post.send(WantSuccessor(), [far_end.fileno()]):
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
        """Tell that the successor has the robot from now on; True: the supervisor looks after both, also if one dies.

        Raise HandoverError if the supervisor cannot be told.
        """
        if not self._post.send(Succeeded()):
            raise HandoverError("the supervisor does not listen")
        return True

    # The observer

    def began(self, device: Observed) -> None:
        """Start: the device serves its robot. What this process deposits counts from now on, even if it is nothing."""
        self._device = device
        self._keep(first=True)
        self._beat()

    def ended(self) -> None:
        """End: the device has left its robot."""
        self._device = None
        self._beat()

    def linked(self, name: str, link: Link, up: bool) -> None:
        """Give the supervisor duplicates of a link's sockets, or tell it to close them."""
        if up and len(self._links) < SLOTS:
            number = self._numbers = self._next_number()
            self._links[link] = (number, name, ())
            self._at[name] = number
            self._memory.begin(number)
            link.reads = partial(self._memory.reading, number)
            self._show(link)
        elif link in self._links:
            number, _, _ = self._links.pop(link)
            if self._at.get(name) == number:
                del self._at[name]
            link.reads = lambda: None
            self._post.send(Closed(number))

    def read(self, name: str, resume: Resume) -> None:
        """Note in the shared memory where a successor would resume the stream of a link."""
        if name in self._at:
            self._memory.cut(self._at[name], resume(PARTIAL_BYTES))

    def changed(self, *, at_once: bool = False) -> None:
        """Beat at once if a program has begun to drive the robot, or has ended, or its link is another one.

        at_once: also if the robot is stopped in another way.
        """
        device, told = self._device, self._told
        if device is None:
            return
        if device.driven is not told.driven or device.state != told.state:
            self._beat()
        elif (now := self._loop.time()) >= self._looked_at + LOOK_S or at_once:
            self._looked_at = now
            if device.last_stop() != told:
                self._beat()

    def published(self) -> None:
        """Deposit soon: a robot may say once in a connection what was published."""
        if self._keep_timer is None:
            self._keep_timer = self._loop.call_later(LOOK_S, self._keep_soon)

    def _keep_soon(self) -> None:
        self._keep_timer = None
        self._keep()

    def _beat(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        for link in self._links:
            self._show(link)
        device = self._device
        streams = {number: device.boundary(name) for number, name, _ in self._links.values()} if device else {}
        if device is not None:
            for name, number in self._at.items():  # the last read may have found nothing
                if (found := device.partial(name, PARTIAL_BYTES)) is not None:
                    self._memory.cut(number, found)
        last = device.last_stop() if device else LastStop()
        if self._loop.time() >= self._kept_at + KEEP_S or (last.state, last.frames) != (
            self._told.state,
            self._told.frames,
        ):
            self._keep()
        if self._post.send(Beat(last, streams, self._hands_over)):
            self._told = last
        self._timer = self._loop.call_later(DRIVEN_BEAT_S if last.driven else BEAT_S, self._beat)

    def _keep(self, *, first: bool = False) -> None:
        """Deposit what a successor needs if this process dies. first: also that there is nothing."""
        self._kept_at, parcel = self._loop.time(), _Listed()
        data, missing, why = self._exported(parcel)
        known = {told: (number, at) for number, _, all_told in self._links.values() for at, told in enumerate(all_told)}
        kept = Kept()
        sockets = tuple(known[descriptor] for descriptor in parcel.descriptors if descriptor in known)
        if data and sockets and len(sockets) == len(parcel):
            if (data, sockets) == (self._deposited, self._kept.sockets):
                return
            kept = Kept(sockets, self._memory.deposit(data), len(data))
        if (first or kept != self._kept) and self._post.send(kept):
            self._kept, self._deposited = kept, data
            if kept.sockets:
                self._memory.told(kept.area)
        self._tell_missing(missing, why, logging.INFO if data else logging.WARNING)

    def _exported(self, parcel: Parcel) -> tuple[bytes, str, str]:
        """Describe what a successor needs, b"" for nothing; say what is missing, and why.

        What a protocol raises here ends no beat.
        """
        budget = Budget(VALUE_BYTES)
        try:
            given = self.keep(parcel, budget) if self._device is not None else None
            data = _encode(given) if given is not None else b""
        except Exception as error:
            return b"", _LOST, describe(error)
        if len(data) > DEPOSIT_BYTES:
            return b"", _LOST, f"its state has {len(data)} bytes, more than {DEPOSIT_BYTES}"
        names = sorted(budget.left_out)
        missing = f"after a crash the next process would begin without {', '.join(names)}" if names else ""
        sizes = ", ".join(str(budget.left_out[name]) for name in names)
        return data, missing, f"{sizes} bytes, more than {VALUE_BYTES}"

    def _tell_missing(self, what: str, why: str, level: int) -> None:
        now, (told, at) = self._loop.time(), self._missing_told
        if what and what != told and now >= at + TELL_S:
            self._missing_told = (what, now)
            log.log(level, "%s: %s", what, why)

    def _next_number(self) -> int:
        """Choose the number of a new link: one that was not given lately, with a slot of its own."""
        taken = {slot_of(number) for number, _, _ in self._links.values()}
        after = (self._numbers % _NUMBERS + step for step in range(1, SLOTS + 1))
        return next(number for number in after if slot_of(number) not in taken)

    def _share(self) -> None:
        self._memory = MemoryWriter()
        self._post.send(Shared(), [self._memory.descriptor])
        self._memory.sent()

    def _show(self, link: Link) -> None:
        """Give the sockets of a link that were not given yet: that of datagrams is opened later."""
        number, name, told = self._links[link]
        descriptors = link.descriptors
        if descriptors != told and descriptors:
            first = next(iter(self._links.values()))[1]
            if self._post.send(Opened(number, name, drives=name == first), descriptors):
                self._links[link] = (number, name, descriptors)

    def _hear(self) -> None:
        try:
            received = self._post.receive()
        except (BlockingIOError, ValueError):
            return
        if received is None:
            self._loop.remove_reader(self._post.fileno())
            log.warning("the supervisor is gone: this gateway ends")
            os.kill(os.getpid(), signal.SIGTERM)
            return
        message, descriptors = received
        close_all(descriptors)
        if isinstance(message, Started) and self._answer is not None and not self._answer.done():
            self._answer.set_result(message)
