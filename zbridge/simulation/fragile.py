"""The scaffold of judges with a connection: their tasks, what they write and read, and a robot that listens.

Shares no code with the gateway's transport. Knows no protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import socket
import sys
from abc import abstractmethod
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

import msgspec

from zbridge.log import Log
from zbridge.simulation.judge import Ended, Judge, MessageReader
from zbridge.simulation.sockets import bind_tcp, send_at_once

_UNANSWERED = 16
Work = Coroutine[Any, Any, None]
_log = Log(__name__)


class FragilePeer(Judge):
    """A judge at one end of a connection. Its tasks end together: one raises Ended, or somebody cancels them all.

    A protocol contributes :meth:`_work` and :meth:`_before_close`; where it reads a stream of messages, whatever the
    reads, also ``_reader``, :meth:`_receive` and :meth:`_judge_end`.
    """

    _phase: enum.Enum
    _reader: MessageReader[Any]

    def __init__(self) -> None:
        super().__init__()
        self.ending = ""
        """Why it ended by itself, "" if it did not."""
        self._over = asyncio.Event()
        """Set once the conversation is over."""
        self._conn: socket.socket | None = None
        self._broken = ""
        """The error that a write met: the kernel reports it once, and a later read sees a mere end."""
        self._sending, self._midway = asyncio.Lock(), False
        self._tasks: asyncio.TaskGroup | None = None
        self._running: list[asyncio.Task[None]] = []

    def __repr__(self) -> str:
        state = f"{self._phase_name()} violations={len(self.violations)} alive={self.alive}"
        return f"<{type(self).__name__} {state}>"

    def _phase_name(self) -> str:
        return self._phase.name

    def _work(self) -> Iterable[Work]:
        """Return the tasks to start with."""
        return ()

    def _before_close(self) -> None:
        """Send what is last, while the sockets are open; must not block."""

    async def _run(self, *work: Work) -> None:
        """Run these tasks, and those of :meth:`_work`, until they end."""
        try:
            async with asyncio.TaskGroup() as self._tasks:
                for one in (*work, *self._work()):
                    self._start(one)
        except* Ended as ended:
            self.ending = str(ended.exceptions[0])
            if self.ending:
                self._event(self.ending)
        finally:
            self._before_close()

    def _start(self, work: Work) -> None:
        """Run one more task that ends with the others."""
        assert self._tasks is not None
        self._running.append(self._tasks.create_task(work))

    def _stop(self) -> None:
        for task in self._running:
            task.cancel()

    # The connection

    @property
    def _tcp(self) -> socket.socket:
        assert self._conn is not None
        return self._conn

    async def _write(self, data: bytes, most_s: float | None = None) -> None:
        """Write a message whole, unless the connection is broken; raise TimeoutError after ``most_s``."""
        if self._broken:
            return
        self._midway = True
        try:
            async with asyncio.timeout(most_s):
                await asyncio.get_running_loop().sock_sendall(self._tcp, data)
        except TimeoutError:
            raise
        except OSError as error:
            self._broken = repr(error)
        else:
            self._midway = False

    def _write_now(self, data: bytes) -> None:
        """Write a message that is too short to be sent in part, without waiting; between two others."""
        with contextlib.suppress(OSError):
            self._tcp.send(data)

    def _take(self, data: bytes, end: str) -> None:
        """Judge the messages that end in ``data``, and the end of the connection ("" while it is open)."""
        for message in self._reader.take(data):
            self._receive(message)
        if end:
            self._judge_end(self._broken or end)

    def _receive(self, message: Any) -> None:
        """Judge a message of the peer, and obey it."""

    def _judge_end(self, end: str) -> None:
        """Judge how the connection ended, and leave it."""

    def _shut(self, how: int = socket.SHUT_RDWR) -> None:
        """End both directions of the connection, or one; its socket is closed later: a write may be waiting for it."""
        if self._conn is not None:
            with contextlib.suppress(OSError):
                self._conn.shutdown(how)


class FragileServer(FragilePeer):
    """A robot that serves one connection per start; it accepts every later one and never answers it.

    A protocol also contributes :meth:`_begin`, and :meth:`_free` where it serves more.
    """

    async def serve(self, host: str, port: int, ready: Callable[[int], None]) -> None:
        """Serve on ``port`` (0: any; ``ready`` is called with it) until dead, ended or cancelled."""
        try:
            with contextlib.ExitStack() as sockets:
                server = self._bind(host, port, sockets)
                ready(server.getsockname()[1])
                await self._run(self._accept(server, sockets))
        finally:
            self._over.set()

    async def simulate(
        self, addresses: tuple[Any, ...], ready: Callable[[tuple[Any, ...]], None], *others: FragileServer
    ) -> None:
        """Serve the first address, ``others`` the next ones, until cancelled, dead or left.

        ``ready`` is called with the addresses that are bound. Log each violation, and print why each server ended.
        Raise OSError for an address that is taken.
        """
        servers = dict(zip((self, *others), addresses, strict=True))
        ports: dict[FragileServer, int] = {}

        async def serve(server: FragileServer) -> None:
            def bound(port: int) -> None:
                ports[server] = port
                if len(ports) == len(servers):
                    ready(tuple(msgspec.structs.replace(at, port=ports[one]) for one, at in servers.items()))

            server.note = server.note or log_violations()
            await server.serve(servers[server].host, servers[server].port, bound)
            if server.ending:
                print_line(server.ending)

        try:
            async with asyncio.TaskGroup() as tasks:
                for server in servers:
                    tasks.create_task(serve(server))
        except ExceptionGroup as errors:
            raise errors.exceptions[0] from None

    @abstractmethod
    def _begin(self, conn: socket.socket) -> None:
        """Begin to serve a connection."""

    def _free(self) -> bool:
        """Return whether the next connection is to be served."""
        return False

    def _bind(self, host: str, port: int, sockets: contextlib.ExitStack) -> socket.socket:
        return sockets.enter_context(bind_tcp(host, port))

    async def _accept(self, server: socket.socket, sockets: contextlib.ExitStack) -> None:
        """Serve the first connection, and those that :meth:`_free` admits; accept all others and say nothing."""
        loop, first = asyncio.get_running_loop(), True
        unanswered: list[socket.socket] = []
        while True:
            conn, peer = await loop.sock_accept(server)
            sockets.enter_context(conn)
            if first or self._free():
                send_at_once(conn)
                self._conn, first = conn, False
                self._begin(conn)
                continue
            self._event(f"second connection, from {peer[0]}:{peer[1]}, while {self._phase_name().lower()}")
            unanswered.append(conn)
            for old in unanswered[:-_UNANSWERED]:
                old.close()
            del unanswered[:-_UNANSWERED]


def log_violations(name: str = "") -> Callable[[str], None]:
    """Make the ``note`` of a judge: it logs each violation, with the judge's name if there are several."""

    def note(text: str) -> None:
        judge = name and f", {name}"
        _log.error("violation", "violation{judge}: {violation}", judge=judge, violation=text)

    return note


def print_line(line: str) -> None:
    """Print a line at once: a program may be waiting for it."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
