"""Sockets and transports of simulated processes: what :class:`zbridge.transport.tcp.TcpLink` and others see."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from typing import Any

from tests.simulated.engine import Process, SimLoop
from tests.simulated.net import End, Network, tcp_info

SEND_BUFFER = 64 * 1024


class Described:
    """Something with descriptors, of several processes perhaps; it closes with the last one."""

    def __init__(self) -> None:
        self.holders: list[Process | None] = []
        """The process of each descriptor; None for one that is on its way to another process."""
        self._watchers: dict[SimLoop, Callable[[], None]] = {}

    @property
    def process(self) -> Process:
        """The process that has had a descriptor for the shortest time."""
        return next(holder for holder in reversed(self.holders) if holder is not None)

    def watch(self, loop: SimLoop, callback: Callable[[], None] | None) -> None:
        """Call back when there is something to read; None: no more."""
        self._watchers.pop(loop, None)
        if callback is not None:
            self._watchers[loop] = callback
            if self.readable:
                self.ready()

    def ready(self) -> None:
        """Tell the watching loops."""
        for loop in self._watchers:
            loop.io.append(lambda loop=loop: self._watchers[loop]() if loop in self._watchers else None)
            loop.poke()

    @property
    def readable(self) -> bool:
        return False

    def left(self, process: Process | None, *, died: bool = True) -> None:
        """Close one descriptor of a process."""
        self.holders.remove(process)
        if process is not None and process not in self.holders and process.loop is not None:
            self._watchers.pop(process.loop, None)
        if not self.holders:
            self.shut(died=died)

    def shut(self, *, died: bool) -> None:
        """Close: no descriptor is left. died: with the process."""


class SimSocket:
    """One descriptor of something."""

    def __init__(self, process: Process, thing: Described) -> None:
        self.process = process
        self.thing = thing
        thing.holders.append(process)
        self._number = process.descriptor(thing)

    @classmethod
    def adopted(cls, process: Process, number: int) -> SimSocket:
        """Return the socket of a number, which belongs to it from now on."""
        self = cls.__new__(cls)
        self.process, self.thing, self._number = process, process.descriptors[number], number
        return self

    def fileno(self) -> int:
        return self._number

    def setblocking(self, flag: bool) -> None:
        pass

    def setsockopt(self, level: int, option: int, value: int) -> None:
        end = getattr(self.thing, "end", None)
        if end is not None and option == getattr(socket, "TCP_USER_TIMEOUT", -1):
            end.user_timeout_s = value / 1000

    def getsockopt(self, level: int, option: int, size: int = 0) -> Any:
        return tcp_info(self.thing.end)

    def getsockname(self) -> tuple[str, int]:
        return self.thing.address

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        return self.thing.take()

    def sendto(self, data: bytes, target: tuple[str, int]) -> None:
        self.thing.network.datagram(self.thing.address, target, bytes(data))

    def close(self) -> None:
        """Close the descriptor; the last one closes the thing."""
        if self.process.descriptors.pop(self._number, None) is not None:
            self.thing.left(self.process, died=False)


class Stream(Described):
    """A connection."""

    def __init__(self, end: End) -> None:
        super().__init__()
        self.end = end
        self.address = end.address
        self.abortive = False
        end.described = True

    def shut(self, *, died: bool) -> None:
        self.end.close(ConnectionResetError("reset by peer") if self.abortive or self.end.received else None)
        if died:
            self.end.broken = self.end.broken or ConnectionResetError()


def StreamSocket(process: Process, end: End) -> SimSocket:  # noqa: N802 - makes one
    """Give a connection a descriptor."""
    return SimSocket(process, Stream(end))


class Listening(Described):
    """A port where connections are accepted, or wait."""

    def __init__(self, network: Network, address: tuple[str, int]) -> None:
        super().__init__()
        self.network = network
        self.address = address
        self.waiting: deque[End] = deque()
        network.listeners[address] = (self, self.arrive)

    @property
    def alive(self) -> bool:
        """Whether a process has the port."""
        return any(holder is not None for holder in self.holders)

    def arrive(self, end: End) -> bool:
        end.process, end.described = self.process, True
        self.waiting.append(end)
        self.ready()
        return True

    @property
    def readable(self) -> bool:
        return bool(self.waiting)

    def shut(self, *, died: bool) -> None:
        self.network.listeners.pop(self.address, None)
        for end in self.waiting:
            end.close(ConnectionResetError("reset by peer"))


def ListeningSocket(process: Process, network: Network, address: tuple[str, int]) -> SimSocket:  # noqa: N802
    """Give a port a descriptor."""
    return SimSocket(process, Listening(network, address))


class Datagrams(Described):
    """A UDP port."""

    def __init__(self, network: Network, address: tuple[str, int]) -> None:
        super().__init__()
        self.network = network
        self.address = address
        self.waiting: deque[tuple[bytes, tuple[str, int]]] = deque(maxlen=256)
        network.datagram_sockets[address] = self.arrive

    def arrive(self, data: bytes, source: tuple[str, int]) -> None:
        self.waiting.append((data, source))
        self.ready()

    def take(self) -> tuple[bytes, tuple[str, int]]:
        if not self.waiting:
            raise BlockingIOError(11, "nothing waits")
        return self.waiting.popleft()

    @property
    def readable(self) -> bool:
        return bool(self.waiting)

    def shut(self, *, died: bool) -> None:
        self.network.datagram_sockets.pop(self.address, None)


class SimKernel:
    """The kernel below one process (:class:`zbridge.transport.kernel.Kernel`)."""

    def __init__(self, process: Process, network: Network) -> None:
        self._process = process
        self._network = network
        self.monotonic = process.host.monotonic

    def adopt(self, descriptor: int) -> Any:
        return SimSocket.adopted(self._process, descriptor)

    def duplicate(self, descriptor: int) -> int:
        return SimSocket(self._process, self._process.descriptors[descriptor]).fileno()

    def close(self, descriptor: int) -> None:
        self.adopt(descriptor).close()

    def datagrams(self, host: str, port: int) -> Any:
        port = port or self._network.port()
        if (host, port) in self._network.datagram_sockets:
            raise OSError(98, "Address already in use")
        return SimSocket(self._process, Datagrams(self._network, (host, port)))

    def unacknowledged(self, sock: Any) -> int:
        return min(sock.thing.end.unacknowledged, SEND_BUFFER)


class SimServer:
    """Accepts the connections of a listening socket, each with a protocol of its own."""

    def __init__(self, loop: SimLoop, factory: Callable[[], Any], sock: SimSocket) -> None:
        self.sockets = [sock]
        self._loop = loop
        self._factory = factory
        sock.thing.watch(loop, self._accept)

    def _accept(self) -> None:
        sock = self.sockets[0]
        while sock.thing.waiting:
            end = sock.thing.waiting.popleft()
            if end.broken is None:
                SimTransport.attach(self._loop, self._factory(), StreamSocket(self._loop.process, end))

    def close(self) -> None:
        for sock in self.sockets:
            sock.thing.watch(self._loop, None)
            sock.close()
        self.sockets = []


class SimTransport:
    """A stream transport as asyncio's, for protocols with buffers."""

    def __init__(self, loop: SimLoop, protocol: Any, sock: SimSocket) -> None:
        self._loop = loop
        self._protocol = protocol
        self._sock = sock
        self._end: End = sock.thing.end
        self._closing = False
        self._lost = False
        self._reading = True
        self._queued = False
        self._over: list[Exception | None] = []
        self._writing_paused = False
        end = self._end
        end.process = loop.process
        end.on_data, end.on_close, end.on_ack = self._readable, self._ended, self._acknowledged

    @classmethod
    def attach(cls, loop: SimLoop, protocol: Any, sock: SimSocket) -> tuple[SimTransport, Any]:
        """Connect a protocol and a socket."""
        self = cls(loop, protocol, sock)
        loop.call_soon(self._begin)
        return self, protocol

    def _begin(self) -> None:
        self._protocol.connection_made(self)
        if self._end.received:
            self._readable()
        if self._end.finished and not self._lost:
            self._ended(self._end.broken)

    # What the protocol calls

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return {"peername": self._end.peer.address, "sockname": self._end.address, "socket": self._sock}.get(name)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def get_write_buffer_size(self) -> int:
        return max(0, self._end.unacknowledged - SEND_BUFFER)

    def write(self, data: bytes) -> None:
        if self._closing or self._lost:
            return
        self._loop.world.note(self._loop.process.name, "writes", self._end.peer.address, bytes(data)[:40].hex())
        self._end.send(bytes(data))
        if self.get_write_buffer_size() and not self._writing_paused:
            self._writing_paused = True
            self._protocol.pause_writing()

    def is_reading(self) -> bool:
        return self._reading

    def pause_reading(self) -> None:
        self._reading = False

    def resume_reading(self) -> None:
        self._reading = True
        self._readable()

    def is_closing(self) -> bool:
        return self._closing

    def close(self) -> None:
        if not self._closing:
            self._closing = True
            self._loop.call_soon(self._lose, None)

    def abort(self) -> None:
        if not self._lost:
            self._closing = True
            self._loop.call_soon(self._lose, None)

    # What the kernel tells

    def _readable(self) -> None:
        if not self._queued and self._reading:
            self._queued = True
            self._loop.io.append(self._read)
            self._loop.poke()

    def _read(self) -> None:
        self._queued = False
        if not self._reading or self._lost or self._closing:
            return
        end = self._end
        if end.received:
            buffer = self._protocol.get_buffer(-1)
            data = end.read(len(buffer))
            buffer[: len(data)] = data
            self._protocol.buffer_updated(len(data))
            if end.received or end.finished:
                self._readable()
        elif self._over:
            error = self._over[0]
            if error is None:
                self._protocol.eof_received()
            self._closing = True
            self._lose(error)

    def _ended(self, error: Exception | None) -> None:
        self._over.append(error)
        if error is not None:
            self._end.received.clear()
        self._readable()

    def _acknowledged(self) -> None:
        if self._writing_paused and not self.get_write_buffer_size():
            self._writing_paused = False
            self._loop.call_soon(self._protocol.resume_writing)

    def _lose(self, error: Exception | None) -> None:
        if self._lost:
            return
        self._lost = True
        if self._end.on_data == self._readable:  # else another process has it
            self._end.on_data = lambda: None
            self._end.on_close = lambda error: None
            self._end.on_ack = lambda: None
        self._sock.close()
        self._protocol.connection_lost(error)
