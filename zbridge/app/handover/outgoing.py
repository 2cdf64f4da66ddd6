"""The gateway that goes: starts its successor, hands everything over, and is released or resumes. Knows no protocol.

Theory of operation. The order of the steps keeps two promises: two processes never read or write one socket, and
nothing is lost that this gateway cannot take back.

1. The successor is started, reads its configuration and joins the bus. Meanwhile this gateway works as ever.
2. ``prepare``: the robot is stopped, its lease ended, no command taken; every link has taken what was written.
3. ``hold``: nothing is read, written or accepted. ``hand_over`` describes all of it: a value of that moment.
4. The successor holds the same connections, has declared its keys, and reports that it is up.
5. ``withdraw``: this gateway's commands and its claim leave the bus. It sends *go*, and ``release`` closes its copies
   of the sockets. From *go* on the successor reads and writes.

Until *go* every failure leads back: the successor is killed, and only when it has ended this gateway reads again.

Where a supervisor started the successor, the supervisor is notified before *go* (:meth:`Successor.handed_over`). From
then on it treats the successor as the robot's gateway, and nothing leads back.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Sequence
from typing import Protocol, TypeVar

from zbridge.app.handover.channel import VERSION, Failed, Go, HandoverChannel, HandoverState, Hello, Up
from zbridge.app.handover.processes import PROCESSES, OtherProcess, Processes, Successor
from zbridge.errors import BusError, HandoverError, NotReady, Refused
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel
from zbridge.transport.kernel import KERNEL, Kernel

log = logging.getLogger("zbridge.app.handover")

M = TypeVar("M")

RESTARTED = "gateway restarted"
START_S = 30.0
"""Longest time until a successor has read its configuration and joined the bus; the robot is served meanwhile."""
PREPARE_S = 4.0
"""Longest time until the stop is written and all links have taken everything: a late handshake is silent for 2.5 s."""
TAKE_OVER_S = 5.0
"""Longest time until the successor has taken everything over; nothing is read or written meanwhile."""


class HandoverPart(Protocol):
    """What is handed over: the device, a listener, or the claim."""

    async def prepare(self, reason: str, within_s: float) -> None:
        """Stop what moves, and wait until it can be handed over; raise Refused."""

    async def shut(self) -> None:
        """Accept nobody any more."""

    def hold(self) -> None:
        """Read and write nothing."""

    def hand_over(self, parcel: Parcel) -> Exported:
        """Describe the part, with its descriptors in the parcel."""

    async def go_on(self) -> None:
        """Take everything since ``prepare`` back."""

    def withdraw(self) -> None:
        """Take no commands from the bus."""

    async def release(self) -> None:
        """Give up what another process has now."""


Describe = Callable[[Parcel], HandoverState]
"""``describe(parcel)``: what is handed over, once all parts are held."""


class Outgoing:
    """One handover. ``successor``: starts it. ``parts``: gives what is handed over, once the successor is there.

    ``describe``: writes all of it.

    ``drain``: waits until what was published has left: what the successor publishes must not overtake it.
    ``processes``, ``kernel``: of this machine, or simulated ones.
    """

    def __init__(
        self,
        successor: Successor,
        parts: Callable[[], Sequence[HandoverPart]],
        describe: Describe,
        drain: Callable[[], Awaitable[None]],
        processes: Processes = PROCESSES,
        kernel: Kernel = KERNEL,
    ) -> None:
        self._successor = successor
        self._find_parts = parts
        self._parts: Sequence[HandoverPart] = ()
        self._describe = describe
        self._drain = drain
        self._processes = processes
        self._kernel = kernel
        self._process: OtherProcess | None = None
        self._ends = asyncio.Event()
        """Set when the gateway ends."""

    def __repr__(self) -> str:
        return f"<Outgoing to {self._process}>"

    async def run(self) -> int:
        """Hand everything over; return the process that has it. Raise Refused and its reason: all is as before then."""
        try:
            channel, far = self._processes.pair()
        except OSError as error:
            log.error("not restarted: %s", error)
            raise NotReady(f"not restarted: {error}") from error
        changed = looked_after = False
        try:
            with far:
                await self._successor.start_successor(far)
            hello = await self._receive(channel, Hello, START_S)
            self._accept(hello)
            changed, self._parts = True, self._find_parts()
            await self._send_state(channel)
            await self._receive(channel, Up, TAKE_OVER_S)
            for part in self._parts:
                part.withdraw()
            await self._drain()
            self._require_no_end()
            looked_after = self._successor.handed_over()
            if not looked_after:
                await channel.send(Go())
        except (HandoverError, Refused, BusError, OSError) as error:
            await self._take_back(channel, str(error), changed=changed)
            raise error if isinstance(error, Refused) else NotReady(f"not restarted: {error}") from error
        except BaseException:  # the gateway ends meanwhile: it needs its sockets to take leave
            await asyncio.shield(self._take_back(channel, "the gateway ends", changed=changed))
            raise
        released = asyncio.gather(*(part.release() for part in self._parts))
        if looked_after:
            await asyncio.sleep(0)  # the robot's part is released at once: an end of this process must not stop it
            with contextlib.suppress(HandoverError):
                await channel.send(Go())
        await released
        channel.close()
        self._forget()
        return hello.pid

    def give_up(self) -> None:
        """Give the handover up, for the gateway ends: everything is taken back, unless *go* was sent."""
        self._ends.set()

    def _require_no_end(self) -> None:
        if self._ends.is_set():
            raise HandoverError("the gateway ends")

    async def _receive(self, channel: HandoverChannel, kind: type[M], within_s: float) -> M:
        """Wait for a message of the successor; raise HandoverError where the gateway ends meanwhile."""
        message = asyncio.ensure_future(channel.receive(kind, within_s))
        ends = asyncio.ensure_future(self._ends.wait())
        try:
            await asyncio.wait((message, ends), return_when=asyncio.FIRST_COMPLETED)
            self._require_no_end()
            return await message
        finally:
            message.cancel()
            ends.cancel()

    async def _send_state(self, channel: HandoverChannel) -> None:
        """Stop, hold and describe everything; send it."""
        await asyncio.gather(*(part.prepare(RESTARTED, PREPARE_S) for part in self._parts))
        for part in self._parts:
            await part.shut()
        for part in self._parts:
            part.hold()
        parcel = Parcel(kernel=self._kernel)
        try:
            await channel.send(self._describe(parcel), parcel)
        finally:
            parcel.close()

    async def _take_back(self, channel: HandoverChannel, reason: str, *, changed: bool) -> None:
        """End the successor; resume when it has ended."""
        log.error("not restarted: %s", reason)
        channel.send_now(Failed(reason))
        if self._process is not None:
            await self._process.kill()
            self._forget()
        channel.close()
        if changed:
            for part in self._parts:
                await part.go_on()

    # The process of the successor

    def _accept(self, hello: Hello) -> None:
        if hello.version != VERSION:
            raise HandoverError(f"the successor takes states of version {hello.version}, this gateway has {VERSION}")
        self._process = self._processes.process(hello.pid)

    def _forget(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None
