"""The sequence of a handover, from both ends: the predecessor and its successor. Knows no protocol.

Theory of operation. The order of the steps guarantees that two processes never read or write one socket, and that
every step before *go* can be undone. :class:`~zbridge.transport.transferable.Transferable` has the steps of each part.

1. The successor is started, reads its configuration and joins the bus. Meanwhile this gateway continues to work.
2. ``prepare``, ``shut``, ``suspend``, ``export``; the state is sent.
3. The successor calls ``restore``, declares its keys, and reports that it is up.
4. ``withdraw``: this gateway's commands and its claim leave the bus. It sends *go*, and calls ``detach``. From *go* on
   the successor reads and writes: it calls ``resume``.

Until *go* every failure is undone: the successor is killed, and only when it has ended, ``resume`` lets this gateway
read again. The successor reads from no socket and writes to none before *go*: a failure ends it. If this gateway dies
after it handed everything over, the successor resumes, because nobody else has the sockets.

If a supervisor started the successor, it is notified before *go* (:meth:`Successor.handed_over`). From then on it
treats the successor as the robot's gateway, and the handover cannot be undone. If this gateway dies before that, the
successor ends: the supervisor has the sockets too, stops the robot over them, and starts another one.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Sequence
from typing import TypeVar

from zbridge.app.handover.channel import VERSION, EndError, Failed, Go, HandoverChannel, HandoverState, Hello, Up
from zbridge.app.handover.processes import PROCESSES, OtherProcess, Processes, Successor
from zbridge.errors import BusError, HandoverError, NotReady, Refused
from zbridge.log import Log
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel, Transferable
from zbridge.transport.kernel import KERNEL, Kernel

log = Log("zbridge.app.handover")

M = TypeVar("M")

RESTARTED = "gateway restarted"
START_S = 30.0
"""Longest time until a successor has read its configuration and joined the bus; the robot is served meanwhile."""
PREPARE_S = 4.0
"""Longest time until the stop is written and all links accepted everything: a late handshake is silent for 2.5 s."""
TAKE_OVER_S = 5.0
"""Longest time until the successor has taken everything over; nothing is read or written meanwhile."""
STATE_S = 60.0
"""Longest wait of a successor for the state, while the predecessor stops its robot."""
PARCEL_S = 5.0
GO_S = 30.0
"""Longest wait of a successor for :class:`Go`; the predecessor needs milliseconds, or gives up."""


class Outgoing:
    """The predecessor's end. ``successor``: starts the other process.

    ``parts``: returns what there is to hand over now. ``describe``: exports all of it to a parcel.
    ``processes``, ``kernel``: of this machine, or simulated ones.
    """

    def __init__(
        self,
        successor: Successor,
        parts: Callable[[], Sequence[Transferable]],
        describe: Callable[[Parcel], HandoverState],
        processes: Processes = PROCESSES,
        kernel: Kernel = KERNEL,
    ) -> None:
        self._successor = successor
        self._find_parts = parts
        self._parts: Sequence[Transferable] = ()
        self._describe = describe
        self._processes = processes
        self._kernel = kernel
        self._process: OtherProcess | None = None
        self._ends = asyncio.Event()
        """Set when the gateway ends."""

    def __repr__(self) -> str:
        return f"<Outgoing to {self._process}>"

    async def run(self) -> int:
        """Hand everything over; return the process that has it. Raise Refused with the reason, and undo everything."""
        try:
            channel, far = self._processes.pair()
        except OSError as error:
            log.error("not_restarted", "not restarted: {reason}", reason=error)
            raise NotReady(f"not restarted: {error}") from error
        changed = supervised = False
        try:
            with far:
                await self._successor.start_successor(far)
            hello = await self._receive(channel, Hello, START_S)
            self._accept(hello)
            changed, self._parts = True, self._find_parts()
            await self._send_state(channel)
            await self._receive(channel, Up, TAKE_OVER_S)
            self._require_same_parts()
            for part in self._parts:
                await part.withdraw()
            self._require_no_end()
            supervised = self._successor.handed_over()
            if not supervised:
                await channel.send(Go())
        except (HandoverError, Refused, BusError, OSError) as error:
            await self._take_back(channel, str(error), changed=changed)
            raise error if isinstance(error, Refused) else NotReady(f"not restarted: {error}") from error
        except BaseException:  # the gateway ends meanwhile: it needs its sockets to say goodbye
            await asyncio.shield(self._take_back(channel, "the gateway ends", changed=changed))
            raise
        detached = asyncio.gather(*(part.detach() for part in self._parts))
        if supervised:
            await asyncio.sleep(0)  # detach the robot at once: the end of this process must not stop it
            with contextlib.suppress(HandoverError):
                await channel.send(Go())
        await detached
        channel.close()
        self._forget()
        return hello.pid

    def give_up(self) -> None:
        """Abort the handover, because the gateway ends: everything is taken back, unless *go* was sent."""
        self._ends.set()

    def _require_no_end(self) -> None:
        if self._ends.is_set():
            raise HandoverError("the gateway ends")

    def _require_same_parts(self) -> None:
        """Raise NotReady if the robot was acquired, or left, since the parts were stopped."""
        if list(self._find_parts()) != list(self._parts):
            raise NotReady("the robot was acquired or left to another gateway meanwhile: try again")

    async def _receive(self, channel: HandoverChannel, kind: type[M], within_s: float) -> M:
        """Wait for a message of the successor; raise HandoverError if the gateway ends meanwhile."""
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
        """Stop, suspend and describe everything; send it."""
        await asyncio.gather(*(part.prepare(RESTARTED, PREPARE_S) for part in self._parts))
        for part in self._parts:
            await part.shut()
        for part in self._parts:
            part.suspend()
        self._require_same_parts()
        parcel = Parcel(kernel=self._kernel)
        try:
            await channel.send(self._describe(parcel), parcel)
        finally:
            parcel.close()

    async def _take_back(self, channel: HandoverChannel, reason: str, *, changed: bool) -> None:
        """End the successor; resume when it has ended."""
        log.error("not_restarted", "not restarted: {reason}", reason=reason)
        channel.send_now(Failed(reason))
        if self._process is not None:
            await self._process.kill()
            self._forget()
        channel.close()
        if changed:
            for part in self._parts:
                await part.resume()

    # The process of the successor

    def _accept(self, hello: Hello) -> None:
        if hello.version != VERSION:
            raise HandoverError(f"the successor accepts states of version {hello.version}, this gateway has {VERSION}")
        self._process = self._processes.process(hello.pid)

    def _forget(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None


class Incoming:
    """What a successor is handed. ``setup``: what must be the same in both configurations, by key.

    ``supervised``: a supervisor stops the robot if the other process dies. ``processes``: of this machine, or
    simulated ones.
    """

    def __init__(
        self, end: socket.socket, setup: Exported, *, supervised: bool = False, processes: Processes = PROCESSES
    ) -> None:
        self.state: HandoverState
        self.parcel = Parcel()
        self.begun = asyncio.Event()
        """Set when this process may read and write: the predecessor has detached."""
        self._channel = processes.channel(end)
        self._own_pid = processes.own_pid
        self._setup = setup
        self._supervised = supervised
        self._missing = 0

    def __repr__(self) -> str:
        return f"<Incoming {'begun' if self.begun.is_set() else f'waits for {self._missing} parts'}>"

    async def receive(self) -> None:
        """Send hello, wait for the state and its descriptors; raise HandoverError."""
        await self._channel.send(Hello(VERSION, self._own_pid))
        state = await self._channel.receive(HandoverState, STATE_S)
        if state.version != VERSION:
            raise HandoverError(f"a state of version {state.version}: this zbridge accepts {VERSION}")
        for key in sorted({*self._setup, *state.setup}):
            if state.setup.get(key) != self._setup.get(key):
                raise HandoverError(f"{key} was changed: stop and start the gateway instead")
        self.parcel = await self._channel.receive_parcel(state.descriptors, PARCEL_S)
        self.state = state
        self._missing = (state.device is not None) + len(state.listeners)

    async def part_restored(self) -> None:
        """Note that one part was restored; wait until all are, and the predecessor has detached."""
        self._missing -= 1
        if self._missing <= 0:
            await self.finish()
        await self.begun.wait()

    async def finish(self) -> None:
        """Report that everything is up, and wait for :class:`Go`."""
        await self._channel.send(Up())
        try:
            await self._channel.receive(Go, GO_S)
        except EndError as error:
            if self._supervised:
                raise HandoverError("the previous gateway died: the supervisor stops its robot") from error
            log.warning("predecessor_died", "the previous gateway died: continuing in its place")
        self._channel.close()
        self.begun.set()

    def fail(self, reason: str) -> None:
        """Report to the predecessor why this process ends."""
        self._channel.send_now(Failed(reason))
        self._channel.close()


class ColdStart(Incoming):
    """Nothing is handed over: this gateway has no predecessor, and begins at once."""

    def __init__(self) -> None:
        self.state, self.parcel, self.begun = HandoverState(VERSION, {}, 0), Parcel(), asyncio.Event()
        self.begun.set()

    async def receive(self) -> None:
        """Return at once."""

    async def finish(self) -> None:
        """Return at once."""
