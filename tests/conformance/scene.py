"""Conversations with a judge, as scripts: the other end is a plain socket, and every byte is in the script.

A script is a list of steps, a verb and what it is done with: ``"> 02000000 07 0d"``. Words in capitals are names of
bytes (``Scene.names``). The verbs that all judges share are methods here; those of a protocol are in a subclass.
"""

import asyncio
import contextlib
import re
import socket
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any, ClassVar, TypeVar

import pytest

from tests.machine import Patience

J = TypeVar("J")
LONG_S = 30.0
VERBS = {">": "send", "<": "expect", "!": "violated", "!!": "violated_once", "?": "happened"}
Script = tuple[dict[str, Any], list[str]]
"""The options of the judge, and the steps."""


def scripts(table: dict[str, Script]) -> pytest.MarkDecorator:
    """Parametrise a test over ``options`` and ``steps``; the keys are sentences."""
    return pytest.mark.parametrize(("options", "steps"), list(table.values()), ids=list(table))


def table(lines: str, judges: dict[str, dict[str, Any]]) -> pytest.MarkDecorator:
    """Parametrise a test over ``options`` and ``steps``; a line is a sentence, the judge it is about, and a script.

    ``"a late probe | udp | probing; by_udp PROBE; ! too late"``; ``judges`` are the options by name. What is
    indented more continues the line before.
    """
    found = {}
    for line in re.sub(r"\n {8,}", " ", lines).strip().splitlines():
        name, judge, script = (part.strip() for part in line.split(" | "))
        assert name not in found, name
        found[name] = (judges[judge], re.split(r"\s*;\s*", script))
    return scripts(found)


def bounded(judge: Callable[..., J], options: dict[str, Any]) -> J:
    """Make a judge; ``keep`` among the options: most entries of each of its lists."""
    options = dict(options)
    own = {"KEEP": options.pop("keep")} if "keep" in options else {}
    return type(judge.__name__, (judge,), own)(**options)


class Peer:
    """One plain TCP connection, and what was read of it but not taken."""

    def __init__(self, port: int = 0) -> None:
        self.port = port
        self.tcp = socket.socket()
        self.tcp.setblocking(False)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.stream = b""

    async def connect(self) -> None:
        await asyncio.get_running_loop().sock_connect(self.tcp, ("127.0.0.1", self.port))

    async def send_bytes(self, data: bytes) -> None:
        await asyncio.get_running_loop().sock_sendall(self.tcp, data)

    async def recv(self, most: int = 65536) -> bytes:
        async with asyncio.timeout(LONG_S):
            return await asyncio.get_running_loop().sock_recv(self.tcp, most)

    async def read(self, size: int) -> bytes:
        """Take so many bytes; raise EOFError where the stream ends before."""
        while len(self.stream) < size:
            data = await self.recv()
            if not data:
                raise EOFError(self.stream)
            self.stream += data
        data, self.stream = self.stream[:size], self.stream[size:]
        return data

    async def read_until(self, words: bytes) -> None:
        data = b""
        while words not in data:
            data += await self.read(1)

    async def read_to_the_end(self) -> bytes:
        data, self.stream = self.stream, b""
        with contextlib.suppress(ConnectionError):
            while part := await self.recv(1 << 20):
                data += part
        return data

    def reset(self) -> None:
        """Close with a reset."""
        self.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.tcp.close()

    def close(self) -> None:
        self.tcp.close()


class Listening(Peer):
    """The same on the listening side: one connection at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.server = socket.create_server(("127.0.0.1", 0))
        self.server.setblocking(False)
        self.port = self.server.getsockname()[1]

    async def accept(self) -> None:
        self.tcp.close()
        async with asyncio.timeout(LONG_S):
            self.tcp, _ = await asyncio.get_running_loop().sock_accept(self.server)
        self.tcp.setblocking(False)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self) -> None:
        super().close()
        self.server.close()


async def until(holds: Callable[[], Any], what: object = "") -> None:
    patience = Patience(LONG_S)
    while not holds():
        assert not patience.over, what() if callable(what) else what
        await asyncio.sleep(0.003)


class Scene:
    """A judge, its task, and the plain socket it talks to."""

    names: ClassVar[dict[str, str]] = {}
    gap_s: ClassVar[float] = 0.0
    """After each message sent."""

    def __init__(self, judge: Any, peer: Any, task: asyncio.Task[None]) -> None:
        self.judge, self.peer, self.task = judge, peer, task
        self._former: list[Peer] = []

    async def play(self, steps: list[str]) -> None:
        for step in steps:
            verb, _, rest = step.partition(" ")
            await getattr(self, VERBS.get(verb, verb))(rest)

    def raw(self, text: str) -> bytes:
        """Bytes of hex and of names."""
        return b"".join(bytes.fromhex(self.names.get(word, word)) for word in text.split())

    async def send(self, text: str) -> None:
        await self.peer.send_bytes(self.raw(text))
        await asyncio.sleep(self.gap_s)

    async def expect(self, text: str) -> None:
        wanted = self.raw(text)
        assert await self.peer.read(len(wanted)) == wanted

    async def violated(self, words: str) -> None:
        noted = self.judge.violations
        await until(lambda: any(words in one for one in noted), lambda: f"{words!r} is not among {noted}")

    async def violated_once(self, words: str) -> None:
        await self.violated(words)
        assert len(self.judge.violations) == 1, self.judge.violations
        assert self.judge.alive

    async def happened(self, words: str) -> None:
        events = self.judge.events
        await until(lambda: any(words in event for event in events), lambda: f"{words!r} is not among {events}")

    async def told(self, events: str) -> None:
        assert len(self.judge.events) == int(events), self.judge.events

    async def ok(self, _: str) -> None:
        assert self.judge.violations == []
        assert self.judge.alive

    async def quiet(self, _: str) -> None:
        """Nothing happened, and nothing was violated."""
        assert self.judge.events == self.judge.violations == []

    async def heard(self, count: str) -> None:
        await until(lambda: len(self.judge.received) >= int(count), self.judge.received)

    async def over(self, _: str) -> None:
        async with asyncio.timeout(LONG_S):
            await self.task

    async def died(self, words: str) -> None:
        await self.over("")
        assert not self.judge.alive
        assert words in self.judge.death
        assert self.judge.death in self.judge.violations
        assert f"died: {self.judge.death}" in self.judge.events

    async def eof(self, _: str) -> None:
        await self.peer.read_to_the_end()

    async def refused(self, _: str) -> None:
        again = Peer(self.peer.port)
        with pytest.raises(ConnectionRefusedError), contextlib.closing(again):
            await again.connect()

    async def nothing(self, _: str) -> None:
        """Nothing is to be read."""
        with pytest.raises(BlockingIOError):
            self.peer.tcp.recv(1)

    async def connect(self, _: str) -> None:
        await self.peer.connect()

    async def again(self, _: str) -> None:
        """Continue with a second connection; the first one stays as it is."""
        self._former.append(self.peer)
        self.peer = Peer(self.peer.port)
        await self.peer.connect()

    async def back(self, _: str) -> None:
        """Continue with the connection before."""
        self._former.append(self.peer)
        self.peer = self._former[0]

    async def close(self, _: str) -> None:
        self.peer.close()

    async def aclose(self) -> None:
        """End the judge and all connections."""
        for peer in (*self._former, self.peer):
            peer.close()
        self.task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self.task

    async def reset(self, _: str) -> None:
        self.peer.reset()

    async def shut(self, _: str) -> None:
        self.peer.tcp.shutdown(socket.SHUT_WR)

    async def wait(self, seconds: str) -> None:
        await asyncio.sleep(float(seconds))

    async def crowd(self, count: str) -> None:
        """Open so many more connections: each is one event."""
        others = [Peer(self.peer.port) for _ in range(int(count))]
        for other in others:
            await other.connect()
        await until(lambda: len(self.judge.events) == int(count), self.judge.events)
        for other in others:
            other.close()


@contextlib.asynccontextmanager
async def serving(judge: Any, peer: Callable[[int], Any], scene: Callable[..., Any]) -> AsyncIterator[Any]:
    """Run a judge that listens; its peer is not connected yet."""
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(judge.serve("127.0.0.1", 0, port.set_result))
    async with contextlib.aclosing(scene(judge, peer(await port), task)) as made:
        yield made


@contextlib.asynccontextmanager
async def calling(judge: Any, peer: Any, scene: Callable[..., Any]) -> AsyncIterator[Any]:
    """Run a judge that connects."""
    task = asyncio.create_task(judge.run("127.0.0.1", peer.port))
    async with contextlib.aclosing(scene(judge, peer, task)) as made:
        yield made
