"""A receiver that keeps what a link brings."""

import asyncio

from zbridge.transport.link import Link, Receiver

SOON_S = 5.0


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
        self._changed = asyncio.Event()

    def attached(self, link: Link) -> None:
        self.link = link
        self._note("attached")

    def received(self, data: bytes) -> None:
        assert type(data) is bytes
        self.data += data
        self._note("received")

    def received_datagram(self, datagram: bytes) -> None:
        assert type(datagram) is bytes
        self.datagrams.append(datagram)
        self._note("datagram")

    def claims(self, datagram: bytes, port: int) -> bool:
        self.asked.append(port)
        return bool(self.mark) and datagram.startswith(self.mark)

    def rivalled(self) -> None:
        self.mark = b""
        self._note("rivalled")

    def stray_datagram(self, datagram: bytes) -> None:
        self.stray.append(datagram)
        self._note("stray")

    def foreign_datagram(self) -> None:
        self.foreign += 1
        self._note("foreign")

    def lost(self, reason: str) -> None:
        self.reason = reason
        self._note("lost")

    def writable(self) -> None:
        self._note("writable")

    def _note(self, call: str) -> None:
        self.calls.append(call)
        self._changed.set()

    async def until(self, call: str, *, received: int = 0, datagrams: int = 0) -> None:
        async with asyncio.timeout(SOON_S):
            while call not in self.calls or len(self.data) < received or len(self.datagrams) < datagrams:
                self._changed.clear()
                await self._changed.wait()
