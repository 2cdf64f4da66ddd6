"""Replays the raw frames of a recorded robot to a gateway, as the legacy robot itself: byte for byte, in its time.

Theory of operation. Each link of the robot listens at an address. The gateway's connection is played the first
conversation of the recording, and is closed where the robot's was; its next connection is played the next one. In the
handshake a frame waits for what the gateway had sent before it (:mod:`zbridge.views.recording.wire_tape`), at most for
:data:`ANSWER_S`; what comes later moves by that time, so that the pauses between frames stay as they were. A datagram
goes to the port of the gateway that sent one last, else to that of its connection.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from zbridge.errors import LinkError
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.address import Address
from zbridge.views.recording.reader import RecordingReader, open_recording
from zbridge.views.recording.wire_tape import WireStep, steps

ANSWER_S = 2.0
"""Longest time that a frame of the handshake waits for the gateway; then no other one of the conversation waits."""
LINGER_S = 0.5
"""Seconds between the last frame of a conversation and its end."""
_READ = 65_536


class WireLink(asyncio.DatagramProtocol):
    """One link of the robot. report: called with what happens, for people."""

    def __init__(self, path: Path, keys: KeySpace, link: str, speed: float, report: Callable[[str], object]) -> None:
        self.link = link
        self.frames = 0
        self.unanswered = 0
        """Conversations in which the gateway sent less than in the recording."""
        self._path = path
        self._keys = keys
        self._speed = speed
        self._report = report
        self._connections: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
        self._writer: asyncio.StreamWriter | None = None
        """Of the conversation that is played."""
        self._began = 0.0
        self._answered = True
        self._received = 0
        self._news = asyncio.Event()
        self._datagrams: asyncio.DatagramTransport | None = None
        self._source: tuple[str, int] | None = None
        self._peer = ""

    def __repr__(self) -> str:
        return f"<WireLink {self.link}, {self.frames} frames>"

    async def run(self, address: Address, ready: Callable[[Address], object]) -> None:
        """Listen, and play all conversations. Raises LinkError if the address cannot be had."""
        try:
            server = await asyncio.start_server(self._connected, address.host, address.port)
        except OSError as error:
            raise LinkError(f"{address}: {error.strerror or error}") from error
        async with server:
            bound = Address(address.host, server.sockets[0].getsockname()[1])
            await self._open_datagrams(bound)
            try:
                ready(bound)
                await self._play_all()
            finally:
                if self._datagrams is not None:
                    self._datagrams.close()

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        if addr[0] == self._peer:
            self._source = addr
            self._note(len(data))

    async def _open_datagrams(self, address: Address) -> None:
        local = (address.host, address.port)
        with contextlib.suppress(OSError):  # a robot without datagrams needs none
            loop = asyncio.get_running_loop()
            self._datagrams, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=local)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._writer is not None or not self._connections.empty():
            writer.close()
            return
        self._connections.put_nowait((reader, writer))

    async def _play_all(self) -> None:
        with open_recording(self._path) as file:
            reader = RecordingReader(file)
            number = 0
            async with contextlib.AsyncExitStack() as stack:
                for step in steps(reader.messages(), self._keys, self.link):
                    if step.number != number:
                        await stack.aclose()
                        number = step.number
                        writer = await stack.enter_async_context(self._conversation())
                    await self._play(step, writer)
                    self.frames += 1
                await asyncio.sleep(LINGER_S)
            if reader.fault is not None:
                self._report(f"{self.link}: the recording is incomplete: {reader.fault}")

    @contextlib.asynccontextmanager
    async def _conversation(self) -> AsyncIterator[asyncio.StreamWriter]:
        """Wait for the gateway's connection, and hold it."""
        reader, writer = await self._connections.get()
        self._writer, self._received, self._source = writer, 0, None
        self._began, self._answered = asyncio.get_running_loop().time(), True
        self._peer = writer.get_extra_info("peername")[0]
        self._report(f"{self.link}: the gateway connected from {self._peer}")
        listening = asyncio.ensure_future(self._listen(reader))
        try:
            yield writer
        finally:
            self._writer = None
            listening.cancel()
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _listen(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_READ):
                self._note(len(data))

    def _note(self, size: int) -> None:
        self._received += size
        self._news.set()

    async def _wait_received(self, size: int) -> bool:
        """Wait until the gateway has sent so many bytes; False if it did not in time."""
        try:
            async with asyncio.timeout(ANSWER_S):
                while self._received < size:
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            self.unanswered += 1
            return False
        return True

    async def _play(self, step: WireStep, writer: asyncio.StreamWriter) -> None:
        """Send a frame when it is due."""
        loop = asyncio.get_running_loop()
        await asyncio.sleep(max(0.0, self._began + step.at_s / self._speed - loop.time()))
        if step.answers and self._answered:
            due = loop.time()
            self._answered = await self._wait_received(step.received)
            self._began += loop.time() - due
        if step.datagram:
            if self._datagrams is not None:
                self._datagrams.sendto(step.frame, self._source or writer.get_extra_info("peername")[:2])
        elif not writer.is_closing():
            writer.write(step.frame)
            with contextlib.suppress(OSError):
                await writer.drain()
