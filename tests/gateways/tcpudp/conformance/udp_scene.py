"""What both judges' scenes share: datagrams, packets, and the bytes of the page that both ends say."""

import asyncio
import socket
import struct
from typing import ClassVar

from tests.conformance.scene import LONG_S, Scene

NAMES = {
    "START": "02000000 01 04",
    "PROBE": "02000000 07 05",
    "RECEIVED": "03000000 01 06 01",
    "NOT_RECEIVED": "03000000 01 06 00",
    "CONNECTED": "03000000 07 07 01",
    "NOT_CONNECTED": "03000000 07 07 00",
    "FORWARD": "0e000000 07 0b 00000000 0000803f 0000803f",
    "STOP": "02000000 07 0d",
    "LIST_13": "0b000000 312e312c312e322c312e33",
}


class UdpScene(Scene):
    gap_s: ClassVar[float] = 0.015
    udp: socket.socket
    address: tuple[str, int]
    """Where datagrams go: where the last one came from."""

    async def by_udp(self, text: str) -> None:
        self.udp.sendto(self.raw(text), self.address)
        await asyncio.sleep(self.gap_s)

    async def datagram(self) -> bytes:
        async with asyncio.timeout(LONG_S):
            data, self.address = await asyncio.get_running_loop().sock_recvfrom(self.udp, 65536)
        return bytes(data)

    async def expect_udp(self, text: str) -> None:
        assert await self.datagram() == self.raw(text)

    async def packet(self) -> bytes:
        head: bytes = await self.peer.read(4)
        return head + bytes(await self.peer.read(struct.unpack("<i", head)[0]))

    async def kind(self, kind: str) -> None:
        """Read a packet of this id."""
        assert (await self.packet())[5] == int(kind)
