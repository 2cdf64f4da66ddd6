"""Listening sockets whose clients are accepted one by one; the others wait in the kernel's queue."""

from __future__ import annotations

import asyncio
import socket

from zbridge.protocol.address import Address

WAITING = 16
"""Most clients that wait in the kernel's queue; further ones are refused."""


async def waiting_sockets(address: Address) -> list[socket.socket]:
    """Listen at every address of the host; raise OSError if one of them is not available."""
    loop, sockets = asyncio.get_running_loop(), list[socket.socket]()
    try:
        for family, _, _, _, where in await loop.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM):
            sockets.append(listening := socket.create_server(where, family=family, backlog=WAITING))
            listening.setblocking(False)
    except OSError:
        for listening in sockets:
            listening.close()
        raise
    return sockets
