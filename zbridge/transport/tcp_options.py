"""The options of TCP sockets, and what the kernel reports about them. Knows no link."""

from __future__ import annotations

import asyncio
import contextlib
import socket

from zbridge.log import Log
from zbridge.transport.backlog import Backlog
from zbridge.transport.kernel import Kernel

log = Log("zbridge.link")

KEEPALIVE_S = 1
"""Seconds of silence after which the kernel sends keep-alives to an accepted peer."""
_RETRY_MOST_S = 1.0
"""Longest time between two retransmissions of the kernel to a robot."""
_TCP_RTO_MAX_MS = 44
"""Linux 6.15 and newer; Python has no name for it yet."""


def tune(sock: socket.socket, give_up_s: float) -> None:
    """Send each write at once; end a connection that acknowledges nothing for ``give_up_s`` seconds."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", 5),
        ("TCP_KEEPINTVL", 2),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", round(give_up_s * 1000)),
    ):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def keep_alive(sock: socket.socket) -> None:
    """Send a silent peer a keep-alive every second; ``tune`` sets when the connection ends."""
    for option, value in (("TCP_KEEPIDLE", KEEPALIVE_S), ("TCP_KEEPINTVL", KEEPALIVE_S), ("TCP_KEEPCNT", 10)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def bound_retries(sock: socket.socket) -> None:
    """Bound the time between retransmissions by :data:`_RETRY_MOST_S`, where the kernel can."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, round(_RETRY_MOST_S * 1000))


_unwatched_warned = False


def new_backlog(sock: socket.socket, kernel: Kernel) -> Backlog | None:
    """Make a backlog if the platform reports what is unacknowledged; else warn once and return None."""
    global _unwatched_warned  # noqa: PLW0603
    try:
        kernel.unacknowledged(sock)
    except OSError:
        if not _unwatched_warned:
            _unwatched_warned = True
            text = "this platform does not report unacknowledged bytes: drives are also written to broken links"
            log.warning("backlog_unknown", text)
        return None
    backlog = Backlog()
    if unsent := kernel.unacknowledged(sock):  # of the process that had the connection before
        backlog.written(unsent, kernel.monotonic())
    return backlog


def outstanding(transport: asyncio.Transport, kernel: Kernel) -> int:
    """Count the unacknowledged bytes: the kernel's and the transport's own."""
    waiting = 0
    with contextlib.suppress(OSError):  # closed meanwhile; connection_lost follows
        waiting = kernel.unacknowledged(transport.get_extra_info("socket"))
    return waiting + transport.get_write_buffer_size()
