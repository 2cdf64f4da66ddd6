"""Simulated TCP and UDP between hosts: delays, stalls, cuts, resets, half-open ends, bounded buffers, lost datagrams.

Theory of operation. A write is one segment. It arrives after the delay of the path, in order. A path that is cut keeps
what TCP sends again: it arrives when the path is back, after a retransmission timer of at most one second. The peer's
kernel acknowledges what has room in its buffer, whether or not its process runs. Datagrams get lost, late and doubled.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections import deque
from collections.abc import Callable
from typing import Any

from tests.simulated.engine import Process, SimLoop, World

WINDOW = 64 * 1024
"""Bytes that a kernel keeps for a process that does not read."""
RETRY_S = 1.0
"""Longest time until what was lost is sent again once the path is back."""
_INFO = struct.Struct("=24xI28xI")


class Paths:
    """The ways between hosts: their delay, and which are cut. A cut has a direction."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.rng = world.rng("paths")
        self.delay_s = 0.0005
        self.jitter_s = 0.0005
        self.loss = 0.0
        self.duplicates = 0.0
        self.slow: dict[frozenset[str], float] = {}
        self._cut: set[tuple[str, str]] = set()
        self.healed: list[Callable[[str, str], None]] = []

    def up(self, here: str, there: str) -> bool:
        """Whether something sent here arrives there."""
        return (here, there) not in self._cut

    def cut(self, here: str, there: str, *, both: bool = True) -> None:
        """Let nothing through."""
        self.world.note("paths", "cut", here, there, both)
        self._cut.add((here, there))
        if both:
            self._cut.add((there, here))

    def heal(self, here: str, there: str) -> None:
        """Let everything through again, both ways."""
        ways = [way for way in ((here, there), (there, here)) if way in self._cut]
        if ways:
            self.world.note("paths", "healed", here, there)
        for way in ways:
            self._cut.discard(way)
            for tell in tuple(self.healed):
                tell(*way)

    @property
    def cuts(self) -> list[tuple[str, str]]:
        """All that is cut."""
        return sorted(self._cut)

    def delay(self, here: str, there: str) -> float:
        """Return for how long a message travels."""
        if here == there:
            return self.rng.random() * 1e-4
        return self.delay_s + self.slow.get(frozenset((here, there)), 0.0) + self.rng.random() * self.jitter_s


class End:
    """One end of a connection. ``on_data``, ``on_close``: of who uses it; ``process`` may be paused or dead."""

    def __init__(self, network: Network, process: Process, address: tuple[str, int]) -> None:
        self.network = network
        self.process = process
        self.address = address
        self.peer: End
        self.on_data: Callable[[], None] = lambda: None
        self.on_close: Callable[[Exception | None], None] = lambda error: None
        self.received = bytearray()
        self.finished = False
        """Whether the peer's end of stream was reached."""
        self.broken: Exception | None = None
        self.closed = False
        self.described = False
        """Whether processes have descriptors of it; else it is its process's own."""
        self.unacknowledged = 0
        self.user_timeout_s = 60.0
        self.heard_at = 0.0
        self._oldest: deque[float] = deque()
        self._arrives = 0.0
        self._waiting: deque[tuple[bytes | None, Exception | None]] = deque()
        """What the path or the peer's window does not take now: segments, and the end."""
        self._lost: deque[tuple[bytes | None, Exception | None]] = deque()
        """What was under way when the path was cut: sent again, before all else, when the path is back."""
        self._acks = 0
        self._checks = False

    def send(self, data: bytes | None, error: Exception | None = None) -> None:
        """Send a segment; None: the end of the stream, or a reset."""
        if self.broken is not None:
            return
        if data is not None:
            self.unacknowledged += len(data)
            self._oldest.append(self.process.world.now)
            self._check()
        self._waiting.append((data, error))
        if len(self._waiting) == 1 and not self._lost:
            self._transmit()

    def _transmit(self) -> None:
        world, paths = self.process.world, self.network.paths
        here, there = self.address[0], self.peer.address[0]
        while self._waiting and paths.up(here, there):
            data, error = self._waiting[0]
            if data is not None and len(self.peer.received) + len(data) > WINDOW and not self.peer.closed:
                return
            self._waiting.popleft()
            self._arrives = max(self._arrives, world.now + paths.delay(here, there))
            world.at(self._arrives, lambda data=data, error=error: self._arrive(data, error))

    def _arrive(self, data: bytes | None, error: Exception | None) -> None:
        paths, peer = self.network.paths, self.peer
        if self._lost or not paths.up(self.address[0], peer.address[0]):
            self._lost.append((data, error))
            return
        if data is None:
            peer.ended(error)
            return
        if peer.closed:
            if peer.broken is None or not peer.process.alive:
                self.network.world.after(paths.delay_s, lambda: self.ended(ConnectionResetError("reset by peer")))
            return
        peer.received += data
        peer.heard_at = self.network.world.now
        self._acks += len(data)
        self.network.world.after(paths.delay_s, self.acknowledge)
        peer.on_data()

    def acknowledge(self) -> None:
        """Take the peer's acknowledgement, where its path is up."""
        if not self._acks or not self.network.paths.up(self.peer.address[0], self.address[0]):
            return
        self.unacknowledged = max(0, self.unacknowledged - self._acks)
        self._acks, self.heard_at = 0, self.network.world.now
        self._oldest.clear()
        if self.unacknowledged:
            self._oldest.append(self.heard_at)
        self.on_ack()

    on_ack: Callable[[], None] = staticmethod(lambda: None)

    def healed(self) -> None:
        """Send again what was lost: the path is back."""
        self._waiting.extendleft(reversed(self._lost))
        self._lost.clear()
        self._transmit()
        self.peer.acknowledge()

    def read(self, most: int) -> bytes:
        """Take what came."""
        data = bytes(self.received[:most])
        del self.received[:most]
        if self.peer._waiting:
            self.network.world.after(0.0, self.peer._transmit)
        return data

    def ended(self, error: Exception | None) -> None:
        """Take the end of the stream, or a reset."""
        if self.broken is not None or self.finished:
            return
        self.finished = True
        if error is not None:
            self.broken = error
        if not self.closed:
            self.on_close(error)

    def close(self, error: Exception | None = None) -> None:
        """End the stream; error: reset the connection."""
        if self.closed:
            return
        self.closed = True
        self.network.world.note(self.process.name, "closes", self.address, self.peer.address, error is not None)
        self.send(None, error)
        if error is not None:
            self.broken = error
        self.network.forget(self)

    def _check(self) -> None:
        """Give up a connection that acknowledges nothing for too long."""
        if self._checks:
            return
        self._checks = True

        def look() -> None:
            self._checks = False
            if not self._oldest or self.broken is not None or (self.closed and not self._waiting):
                return
            left_s = self._oldest[0] + self.user_timeout_s - self.network.world.now
            if left_s > 0:
                self._checks = True
                self.network.world.after(left_s + 0.001, look)
            else:
                self.ended(TimeoutError(110, "Connection timed out"))

        self.network.world.after(self.user_timeout_s + 0.001, look)


class Network:
    """All sockets of the world."""

    def __init__(self, world: World, paths: Paths) -> None:
        self.world = world
        self.paths = paths
        self.rng = world.rng("network")
        self.ends: list[End] = []
        self.listeners: dict[tuple[str, int], Any] = {}
        self.datagram_sockets: dict[tuple[str, int], Any] = {}
        self._port = 40000
        paths.healed.append(self._healed)

    def _healed(self, here: str, there: str) -> None:
        for end in self.ends:
            if (end.address[0], end.peer.address[0]) == (here, there):
                self.world.after(self.rng.uniform(0.2, RETRY_S), end.healed)

    def port(self) -> int:
        """Return a free port."""
        self._port += 1
        return self._port

    def forget(self, end: End) -> None:
        """Drop a connection of which both ends are closed."""
        if end.peer.closed:
            self.ends = [each for each in self.ends if each is not end and each is not end.peer]

    def listen(self, process: Process, port: int, accept: Callable[[End], bool]) -> None:
        """Let a process without sockets of its own accept connections; ``accept`` returns whether it does."""
        self.listeners[process.host.name, port] = (process, accept)

    def open(self, process: Process, host: str, port: int, done: Callable[[End | None, str], None]) -> None:
        """Connect; ``done`` is called with the own end, or None and the reason."""
        here = process.host.name
        if not (self.paths.up(here, host) and self.paths.up(host, here)):
            return  # the attempt times out
        found = self.listeners.get((host, port))
        if found is None or not found[0].alive:
            process.after(2 * self.paths.delay(here, host), lambda: done(None, "Connection refused"))
            return
        owner = found[0]
        near, far = End(self, process, (here, self.port())), End(self, getattr(owner, "process", owner), (host, port))
        near.peer, far.peer = far, near
        near.heard_at = far.heard_at = self.world.now
        self.ends += [near, far]
        process.on_death.append(lambda: _die(near))
        far.process.on_death.append(lambda: _die(far))

        def arrive() -> None:
            found = self.listeners.get((host, port))
            if found is None or not found[0].alive or not found[1](far):
                near.closed = far.closed = True
                self.forget(near)
                process.after(self.paths.delay(host, here), lambda: done(None, "Connection refused"))
            else:
                process.after(self.paths.delay(host, here), lambda: done(near, ""))

        self.world.after(self.paths.delay(here, host), arrive)

    # What event loops ask for

    async def connect(self, loop: SimLoop, factory: Any, host: Any, port: Any, sock: Any) -> tuple[Any, Any]:
        """Connect a protocol, or attach it to a socket that exists."""
        from tests.simulated.sockets import SimTransport, StreamSocket

        if sock is not None:
            return SimTransport.attach(loop, factory(), sock)
        made = loop.create_future()

        def done(end: End | None, reason: str) -> None:
            if made.done():
                if end is not None:
                    end.close(ConnectionResetError())
            else:
                loop.call_soon(_finish, made, end, reason)

        self.open(loop.process, host, port, done)
        try:
            end = await made
        except asyncio.CancelledError:  # it may just have connected
            if made.done() and not made.cancelled() and made.exception() is None:
                made.result().close(None)
            made.cancel()
            raise
        return SimTransport.attach(loop, factory(), StreamSocket(loop.process, end))

    def serve(self, loop: SimLoop, factory: Any, host: Any, port: Any, sock: Any) -> Any:
        """Accept connections with a protocol each."""
        from tests.simulated.sockets import ListeningSocket, SimServer

        if sock is None:
            port = port or self.port()
            if (host, port) in self.listeners and self.listeners[host, port][0].alive:
                raise OSError(98, "Address already in use")
            sock = ListeningSocket(loop.process, self, (host, port))
        return SimServer(loop, factory, sock)

    def datagram(self, source: tuple[str, int], target: tuple[str, int], data: bytes) -> None:
        """Carry a datagram: it may be lost, late or doubled."""
        paths = self.paths
        self.world.note("udp", "sends", source, target, data[:40].hex())
        if self.rng.random() < paths.loss:
            return
        copies = 2 if self.rng.random() < paths.duplicates else 1

        def arrive() -> None:
            found = self.datagram_sockets.get(target)
            if found is not None and paths.up(source[0], target[0]):
                found(data, source)

        for _ in range(copies):
            if paths.up(source[0], target[0]):
                late = self.rng.random() * 0.05 if paths.loss and self.rng.random() < 0.1 else 0.0
                self.world.after(paths.delay(source[0], target[0]) + late, arrive)


def _die(end: End) -> None:
    if end.described:
        return
    end.close(ConnectionResetError("reset by peer") if end.received else None)
    end.broken = end.broken or ConnectionResetError()


def _finish(made: asyncio.Future[End], end: End | None, reason: str) -> None:
    if made.done():
        if end is not None:
            end.close(ConnectionResetError())
    elif end is None:
        made.set_exception(OSError(111, reason))
    else:
        made.set_result(end)


def tcp_info(end: End) -> bytes:
    """Return what Linux tells of a connection: unacknowledged segments, milliseconds since the last sign of life."""
    now = end.network.world.now
    reachable = end.network.paths.up(end.address[0], end.peer.address[0]) and end.network.paths.up(
        end.peer.address[0], end.address[0]
    )
    if reachable:
        end.heard_at = now - 1.0 if not end.unacknowledged else max(end.heard_at, now - 0.1)
    return _INFO.pack(1 if end.unacknowledged else 0, int((now - end.heard_at) * 1000))


SOL_TCP = socket.IPPROTO_TCP
