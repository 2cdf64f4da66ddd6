"""One gateway process as its supervisor sees it: its beats, what it deposited, its end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import mmap
import os
import signal
import socket
import time
from collections.abc import Callable

import msgspec

from zbridge.app.handover.messages import Given
from zbridge.app.supervisor.duplicates import Duplicates
from zbridge.app.supervisor.heart import Heart
from zbridge.app.supervisor.messages import (
    PAGE_BYTES,
    Beat,
    Closed,
    FromGateway,
    Kept,
    Opened,
    Shared,
    Succeeded,
    WantSuccessor,
)
from zbridge.app.supervisor.post import Post, close_all
from zbridge.app.supervisor.state import ProcessState
from zbridge.robot.observer import LastStop
from zbridge.transport import Parcel

log = logging.getLogger("zbridge.app.supervisor")

KILLED_S = 0.05
"""Longest wait for the end of a process that was killed, before its robot is stopped."""
_MESSAGES = 64
"""Most messages that are taken from one process before others have their turn."""


class GatewayProcess:
    """A forked gateway, a child of this process. Holds duplicates of its sockets until :meth:`close`.

    wants_successor: called with this process and the far end of the socket from which the successor takes over; the
    callee closes it. changed: called when the state of the robot is another one.
    """

    def __init__(
        self,
        pid: int,
        post: Post,
        *,
        wants_successor: Callable[[GatewayProcess, socket.socket], object],
        changed: Callable[[], object] = lambda: None,
    ) -> None:
        self.pid = pid
        self.post = post
        self.duplicates = Duplicates()
        self.last = LastStop()
        """What the process deposited last."""
        self.hands_over = False
        self.succeeded = False
        """Whether a successor has taken over."""
        self.told_to_end = False
        self.heart = Heart(time.monotonic())
        self.over: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        """Done when the process has ended; its wait status."""
        self.kept = Kept()
        """What a successor needs if the process dies."""
        self._page: mmap.mmap | None = None
        self._page_descriptor: int | None = None
        self._killed: str | None = None
        self._hung = asyncio.Event()
        self._began = time.monotonic()
        self._wants_successor = wants_successor
        self._changed = changed
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(post.fileno(), self.hear)

    def __repr__(self) -> str:
        return f"<GatewayProcess {self.pid} {self.last.state}>"

    async def ended(self) -> str | None:
        """Wait for the end of the process; how it ended, None: in order."""
        hung = asyncio.ensure_future(self._hung.wait())
        await asyncio.wait((self.over, hung), return_when=asyncio.FIRST_COMPLETED)
        hung.cancel()
        if not self.over.done():
            await self.gone(KILLED_S)
        self.hear()
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

    def kill(self, why: str) -> None:
        """End the process now: it counts as one that crashed."""
        self._killed = self._killed or why
        self.signal(signal.SIGKILL)
        self._hung.set()

    def signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if not self.over.done():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def hear(self) -> None:
        """Take what the process told."""
        for _ in range(_MESSAGES):
            try:
                received = self.post.receive()
            except BlockingIOError:
                return
            except ValueError as error:
                log.error("process %d: not understood: %s", self.pid, error)
                continue
            except OSError:  # closed
                return
            if received is None:
                self._loop.remove_reader(self.post.fileno())
                return
            message, descriptors = received
            self._take(message, descriptors)  # type: ignore[arg-type]

    def _take(self, message: FromGateway, descriptors: list[int]) -> None:
        match message:
            case Beat():
                state, self.last, self.hands_over = self.last.state, message.last, message.hands_over
                self.heart.beat(time.monotonic(), driven=message.last.driven)
                self.duplicates.stands(message.streams)
                if message.last.state != state or self.heart.beats == 1:
                    self._changed()
            case Opened():
                self.duplicates.opened(message.link, message.name, descriptors, drives=message.drives)
                return
            case Closed():
                self.duplicates.closed(message.link)
            case Kept():
                self.kept = message
            case Shared() if descriptors and self._page is None:
                self._share(descriptors.pop(0))
            case WantSuccessor() if descriptors:
                self._wants_successor(self, socket.socket(fileno=descriptors.pop(0)))
            case Succeeded():
                self.succeeded = True
                self.duplicates.close()
        close_all(descriptors)

    def _share(self, descriptor: int) -> None:
        try:
            self._page = mmap.mmap(descriptor, PAGE_BYTES, prot=mmap.PROT_READ)
        except (OSError, ValueError):
            os.close(descriptor)
            return
        self._page_descriptor = descriptor

    @property
    def is_over(self) -> bool:
        """Whether the process has ended, is being ended, or has handed over."""
        return self.over.done() or self._hung.is_set() or self.told_to_end or self.succeeded

    @property
    def state(self) -> ProcessState:
        """What the code that takes the supervisor's place needs to go on, while the process is not over."""
        return ProcessState(
            self.pid,
            self.post.fileno(),
            self._began,
            self.heart.state,
            self.last,
            self._page_descriptor,
            self.hands_over,
            self.kept,
            self.duplicates.state,
        )

    def resume(self, state: ProcessState) -> None:
        """Go on with a process as the code before this one knew it."""
        self._began, self.heart, self.last = state.began, Heart.of(state.heart), state.last
        self.hands_over, self.kept = state.hands_over, state.kept
        self.duplicates.resume(state.links)
        if state.page is not None:
            self._share(state.page)

    def inheritance(self) -> tuple[Given, Parcel] | None:
        """Give what a successor of this dead process can take over; None where it would read or write half a frame."""
        links = {link for link, _ in self.kept.sockets}
        if not links or self._page is None or not all(self._page[link] for link in links):
            return None
        descriptors = [self.duplicates.descriptor(link, at) for link, at in self.kept.sockets]
        if None in descriptors:
            return None
        try:
            given = msgspec.msgpack.decode(self.kept.given, type=Given)
        except msgspec.MsgspecError:
            return None
        return given, Parcel([os.dup(number) for number in descriptors if number is not None])

    def close(self) -> None:
        """Close the post and all duplicates; idempotent."""
        if self.post.fileno() >= 0:
            self._loop.remove_reader(self.post.fileno())
            self.post.close()
        self.duplicates.close()
        if self._page is not None:
            self._page.close()
            self._page = None
        if self._page_descriptor is not None:
            os.close(self._page_descriptor)
            self._page_descriptor = None
