"""Restarts with handover: the socket between two processes of a host, and who starts and ends them.

:mod:`tests.simulated.gateway_member` has the processes; the product's own channel runs over :class:`UnixEnd`.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, TypeVar

from tests.simulated.engine import THREAD_S, Process
from zbridge.app.handover.channel import Go, HandoverChannel, Message
from zbridge.app.handover.processes import Processes
from zbridge.errors import HandoverError
from zbridge.transport import Parcel

if TYPE_CHECKING:
    from tests.simulated.gateway_member import GatewayMember

M = TypeVar("M")


class UnixEnd:
    """One end of a Unix stream socket, as far as :class:`HandoverChannel` uses it."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.peer: UnixEnd
        self.buffer = bytearray()
        self.descriptors: deque[list[Any]] = deque()
        """What lies behind the descriptors that came, group by group."""
        self.closed = False
        self._waiting: asyncio.Future[None] | None = None
        self._number = process.descriptor(self)

    @classmethod
    def pair(cls, process: Process) -> tuple[UnixEnd, UnixEnd]:
        """Make both ends."""
        near, far = cls(process), cls(process)
        near.peer, far.peer = far, near
        return near, far

    def inherit(self, process: Process) -> None:
        """Belong to a process that was started with it."""
        self.process.descriptors.pop(self._number, None)
        self.process, self._number = process, process.descriptor(self)

    # What a socket has

    def __enter__(self) -> UnixEnd:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the copy of the process that made it, if no other process has it."""
        if self.process is self.peer.process:
            self.close()

    def fileno(self) -> int:
        return self._number

    def setblocking(self, flag: bool) -> None:
        pass

    def settimeout(self, seconds: float | None) -> None:
        pass

    def sendall(self, data: bytes) -> None:
        if self.peer.closed:
            raise BrokenPipeError(32, "Broken pipe")
        self.peer.buffer += data
        self.peer.wake()

    def sendmsg(self, buffers: Any, ancillary: Any) -> None:
        ((_, _, numbers),) = ancillary
        if self.peer.closed:
            raise BrokenPipeError(32, "Broken pipe")
        things = [self.process.descriptors[number] for number in numbers]
        for thing in things:
            thing.holders.append(None)
        self.peer.descriptors.append(things)
        self.peer.wake()

    def recv(self, size: int) -> bytes:
        if not self.buffer and not self.peer.closed:
            raise TimeoutError
        data = bytes(self.buffer[:size])
        del self.buffer[:size]
        return data

    def shutdown(self, how: int) -> None:
        pass

    def close(self) -> None:
        self.process.descriptors.pop(self._number, None)
        self.left(self.process)

    def left(self, process: Process, *, died: bool = True) -> None:
        """Close: the other end learns of it, once it has read what came before."""
        if self.closed:
            return
        self.closed = True
        for thing in (thing for group in self.descriptors for thing in group):
            thing.left(None)
        self.descriptors.clear()
        self.peer.wake()
        self.wake()

    # Waiting

    @property
    def ready(self) -> bool:
        """Whether a read would not block."""
        return bool(self.buffer or self.descriptors or self.peer.closed or self.closed)

    def wake(self) -> None:
        """Let who waits here look again, a moment later."""

        def look() -> None:
            waiting, self._waiting = self._waiting, None
            if waiting is not None and not waiting.done() and self.process.loop is not None:
                self.process.loop.call_soon(lambda: waiting.done() or waiting.set_result(None))

        self.process.after(self.process.rng.random() * THREAD_S, look)

    async def wait(self, timeout_s: float | None) -> None:
        """Wait until there is something to read, at most so long."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(timeout_s):
                while not self.ready:
                    self._waiting = loop.create_future()
                    await self._waiting
        except TimeoutError:
            return


class SimChannel(HandoverChannel):
    """The product's channel, whose threads never wait: the event loop does."""

    _socket: UnixEnd  # type: ignore[assignment]

    async def send(self, message: Message, parcel: Parcel | None = None) -> None:
        loop, kind = asyncio.get_running_loop(), type(message).__name__
        self._note("unsent", kind)

        def work() -> None:
            self._send(message, parcel)
            self._note("sent", kind)
            if isinstance(message, Go):
                self._gone()

        await loop.run_in_executor(None, work)

    async def receive(self, kind: type[M], timeout_s: float | None = None) -> M:
        await self._socket.wait(timeout_s)
        message = self._receive(kind, timeout_s)
        self._note("got", kind.__name__)
        return message

    async def receive_parcel(self, descriptors: int, timeout_s: float) -> Parcel:
        from tests.simulated.sockets import SimKernel, SimSocket

        end, loop = self._socket, asyncio.get_running_loop()
        ends_at, sockets = loop.time() + timeout_s, list[int]()
        while len(sockets) < descriptors:
            if not end.descriptors:
                if loop.time() >= ends_at or end.peer.closed or end.closed:
                    Parcel(sockets, SimKernel(end.process, loop.network)).close()
                    raise HandoverError(f"{len(sockets)} of {descriptors} descriptors were received")
                await end.wait(ends_at - loop.time())
                continue
            for thing in end.descriptors.popleft():
                sockets.append(SimSocket(end.process, thing).fileno())
                thing.holders.remove(None)
        self._note("got", "descriptors")
        return Parcel(sockets, SimKernel(end.process, loop.network))

    def _note(self, what: str, kind: str) -> None:
        process = self._socket.process
        process.world.note(process.name, f"handover {what}", kind)

    def _gone(self) -> None:
        """Note that the other process has the robot."""
        for tell in self._socket.peer.process.on_go:
            tell()


class SimProcesses(Processes):
    """The processes of a member, as one of them sees them."""

    def __init__(self, process: Process) -> None:
        self._process = process

    @property
    def own_pid(self) -> int:
        return self._process.pid

    def pair(self) -> tuple[HandoverChannel, Any]:
        near, far = UnixEnd.pair(self._process)
        return SimChannel(near), far  # type: ignore[arg-type]

    def channel(self, end: Any) -> HandoverChannel:
        return SimChannel(end)

    def process(self, pid: int) -> Any:
        return SimOtherProcess(self._process, pid)


class SimOtherProcess:
    """A process that can be killed."""

    def __init__(self, process: Process, pid: int) -> None:
        self._process = process
        self._pid = pid

    async def kill(self) -> None:
        await asyncio.sleep(self._process.rng.random() * THREAD_S)
        other = self._process.world.by_pid.get(self._pid)
        if other is not None:
            other.kill()

    def close(self) -> None:
        pass


class Spawner:
    """Starts successors of one process of a member (:class:`zbridge.app.handover.Successor`)."""

    def __init__(self, member: GatewayMember, process: Process) -> None:
        self._member = member
        self._process = process

    async def start_successor(self, far_end: Any) -> None:
        await asyncio.sleep(self._process.rng.random() * THREAD_S)
        if self._member.process is not self._process or not self._process.alive:
            raise HandoverError("this process serves nothing")
        self._member.spawn(far_end)

    def handed_over(self) -> bool:
        return False
