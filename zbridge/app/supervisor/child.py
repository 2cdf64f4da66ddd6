"""What a gateway process tells its supervisor: beats, its links, and the stop that its robot needs if it dies.

Theory of operation. The reporter observes the robot's device (:class:`zbridge.robot.observer.Observer`). A timer of the
event loop sends a beat: no beat comes from a loop that hangs. Whatever changes what the supervisor needs (the robot is
driven or not, the state of the link, a link that is up or gone) sends a beat at once. The end of the post means that
the supervisor is gone: then the process ends in order, as nobody looks after its robot.
"""

from __future__ import annotations

import asyncio
import logging
import mmap
import os
import signal
import socket
from collections.abc import Callable
from functools import partial

import msgspec

from zbridge.app.handover.messages import Given
from zbridge.app.supervisor.messages import (
    PAGE_BYTES,
    Beat,
    Closed,
    Kept,
    Opened,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
)
from zbridge.app.supervisor.post import Post, close_all
from zbridge.errors import HandoverError
from zbridge.robot.observer import LastStop, Observed
from zbridge.transport import Link, Parcel

log = logging.getLogger("zbridge.app.supervisor")

BEAT_S = 1.0
"""Seconds between two beats."""
DRIVEN_BEAT_S = 0.2
"""The same while the robot is driven."""
LOOK_S = 0.05
"""Least time between two looks at the frames of the stop, while commands come in."""
ANSWER_S = 10.0
"""Longest wait for the start of a successor."""
KEEP_S = 0.9
"""Least seconds between two deposits of what a successor needs."""
KEPT_BYTES = 48 * 1024
"""Largest such deposit."""
_encode = msgspec.msgpack.Encoder().encode


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
        self._at: dict[str, int] = {}
        self._page: mmap.mmap
        self.keep: Callable[[Parcel], Given | None] = lambda parcel: None
        """Describes what a successor needs; set by the gateway's process."""
        self._timer: asyncio.TimerHandle | None = None
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
        if self._timer is not None:
            self._timer.cancel()
        if self._post.fileno() >= 0:
            self._loop.remove_reader(self._post.fileno())
            self._post.close()
            self._page.close()

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

    def succeeded(self) -> None:
        """Tell that the successor has taken over: this process is not to be started again."""
        self._post.send(Succeeded())

    # The observer

    def began(self, device: Observed) -> None:
        """Start: the device serves its robot."""
        self._device = device
        self._beat()

    def ended(self) -> None:
        """End: the device has left its robot."""
        self._device = None
        self._beat()

    def linked(self, name: str, link: Link, up: bool) -> None:
        """Give the supervisor duplicates of a link's sockets, or tell it to close them."""
        if up:
            self._numbers = self._numbers % (PAGE_BYTES - 1) + 1
            self._links[link] = (self._numbers, name, ())
            self._at[name] = self._numbers
            link.reads = partial(self._page.__setitem__, self._numbers, 0)
            self._show(link)
        elif link in self._links:
            number, _, _ = self._links.pop(link)
            self._page[number] = 0
            self._post.send(Closed(number))

    def read(self, name: str) -> None:
        """Note in the shared page whether a successor could go on reading here."""
        if self._device is not None and name in self._at:
            self._page[self._at[name]] = self._device.boundary(name).incoming

    def changed(self) -> None:
        """Beat at once if a program has begun to drive the robot, or has ended, or its link is another one."""
        device, told = self._device, self._told
        if device is None:
            return
        if device.driven is not told.driven or device.state != told.state:
            self._beat()
        elif (now := self._loop.time()) >= self._looked_at + LOOK_S:
            self._looked_at = now
            if device.last_stop() != told:
                self._beat()

    def _beat(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        for link in self._links:
            self._show(link)
        device = self._device
        streams = {number: device.boundary(name) for number, name, _ in self._links.values()} if device else {}
        for _, name, _ in self._links.values():
            self.read(name)
        last = device.last_stop() if device else LastStop()
        if self._loop.time() >= self._kept_at + KEEP_S or last.state != self._told.state:
            self._keep()
        if self._post.send(Beat(last, streams, self._hands_over)):
            self._told = last
        self._timer = self._loop.call_later(DRIVEN_BEAT_S if last.driven else BEAT_S, self._beat)

    def _keep(self) -> None:
        """Deposit what a successor needs if this process dies."""
        self._kept_at, parcel = self._loop.time(), _Listed()
        given = self.keep(parcel) if self._device is not None else None
        known = {told: (number, at) for number, _, all_told in self._links.values() for at, told in enumerate(all_told)}
        kept = Kept()
        if given is not None and all(descriptor in known for descriptor in parcel.descriptors):
            data = _encode(given)
            if len(data) <= KEPT_BYTES:
                kept = Kept(data, tuple(known[descriptor] for descriptor in parcel.descriptors))
        if kept != self._kept and self._post.send(kept):
            self._kept = kept

    def _share(self) -> None:
        descriptor = os.memfd_create("zbridge")
        os.ftruncate(descriptor, PAGE_BYTES)
        self._page = mmap.mmap(descriptor, PAGE_BYTES)
        self._post.send(Shared(), [descriptor])
        os.close(descriptor)

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
