"""A receiver that keeps what a link brings, and links over loopback that end at one."""

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass

from zbridge.protocol.address import Address
from zbridge.transport.link import Link, Receiver
from zbridge.transport.tcp import TcpLink, connect, listen

SOON_S = 5.0
LOCAL = Address("127.0.0.1", 0)


class Recorder(Receiver):
    """A receiver that keeps what a link brings, and claims datagrams that begin with ``mark``, until it is rivalled."""

    def __init__(self, mark: bytes = b"") -> None:
        self.link: Link | None = None
        self.mark = mark
        self.data = bytearray()
        self.datagrams: list[bytes] = []
        self.asked: list[int] = []
        """The ports of what it was asked whether it claims it."""
        self.stray: list[bytes] = []
        self.foreign = 0
        self.reason: str | None = None
        self.calls: list[str] = []

    def attached(self, link: Link) -> None:
        self.link = link
        self.calls.append("attached")

    def received(self, data: bytes) -> None:
        assert type(data) is bytes
        self.data += data
        self.calls.append("received")

    def received_datagram(self, datagram: bytes) -> None:
        assert type(datagram) is bytes
        self.datagrams.append(datagram)
        self.calls.append("datagram")

    def claims(self, datagram: bytes, port: int) -> bool:
        self.asked.append(port)
        return bool(self.mark) and datagram.startswith(self.mark)

    def rivalled(self) -> None:
        self.mark = b""
        self.calls.append("rivalled")

    def stray_datagram(self, datagram: bytes) -> None:
        self.stray.append(datagram)
        self.calls.append("stray")

    def foreign_datagram(self) -> None:
        self.foreign += 1
        self.calls.append("foreign")

    def lost(self, reason: str) -> None:
        self.reason = reason
        self.calls.append("lost")

    def writable(self) -> None:
        self.calls.append("writable")

    async def until(self, call: str, *, received: int = 0, datagrams: int = 0) -> None:
        """Wait until this was called, and so many bytes and datagrams have come."""
        await until(lambda: call in self.calls and len(self.data) >= received and len(self.datagrams) >= datagrams)


@dataclass
class Pair:
    """Both ends of one connection: ``here`` connected, ``there`` was accepted."""

    address: Address
    here: TcpLink
    near: Recorder
    far: Recorder

    @property
    def there(self) -> TcpLink:
        assert isinstance(self.far.link, TcpLink)
        return self.far.link


@contextlib.contextmanager
def socket_of(link: TcpLink) -> Iterator[socket.socket]:
    """Lend a duplicate of a link's socket."""
    with socket.socket(fileno=os.dup(link.descriptors[0])) as sock:
        yield sock


@contextlib.asynccontextmanager
async def connected(near: Recorder | None = None, buffer: bytearray | None = None) -> AsyncIterator[Pair]:
    near, far = near or Recorder(), Recorder()
    async with listen(LOCAL, lambda: far) as address:
        here = await connect(address, near, buffer)
        await far.until("attached")
        pair = Pair(address, here, near, far)
        try:
            yield pair
        finally:
            here.abort()
            pair.there.abort()
            await near.until("lost")
            await far.until("lost")


def udp_socket(address: tuple[str, int]) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    made.bind(address)
    return made


async def heard_by(listening: socket.socket) -> tuple[bytes, tuple[str, int]]:
    async with asyncio.timeout(SOON_S):
        while True:  # uvloop has no sock_recvfrom
            with contextlib.suppress(BlockingIOError):
                data, source = listening.recvfrom(65_536)
                return data, source
            await asyncio.sleep(0.001)


async def until(happened: Callable[[], bool]) -> None:
    """Wait for what nothing tells."""
    async with asyncio.timeout(SOON_S):
        while not happened():  # noqa: ASYNC110
            await asyncio.sleep(0.001)
