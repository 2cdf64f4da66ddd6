"""What links need of the operating system beside the event loop: sockets by number, their queues, and the time.

A simulation replaces :data:`KERNEL`. Knows no link.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import termios
import time

_OUTSTANDING = struct.Struct("=i")
_SIOCOUTQ = termios.TIOCOUTQ
"""The ioctl for the unacknowledged bytes of a socket; Python names it for terminals only."""


class Kernel:
    """The calls of the operating system that links make, answered by this machine."""

    monotonic = staticmethod(time.monotonic)
    """Return seconds on the time line of event loops."""
    duplicate = staticmethod(os.dup)
    """Return another descriptor of the same socket; raise OSError."""
    close = staticmethod(os.close)
    """Close a descriptor; raise OSError."""

    def adopt(self, descriptor: int) -> socket.socket:
        """Return the socket of a descriptor, which belongs to it from now on."""
        return socket.socket(fileno=descriptor)

    def datagrams(self, host: str, port: int) -> socket.socket:
        """Bind a UDP socket that does not block; raise OSError."""
        sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.bind((host, port))
        except OSError:
            sock.close()
            raise
        return sock

    def unacknowledged(self, sock: socket.socket) -> int:
        """Count the bytes that the peer has not acknowledged; raise OSError if the platform does not report it."""
        waiting: int = _OUTSTANDING.unpack(fcntl.ioctl(sock.fileno(), _SIOCOUTQ, bytes(_OUTSTANDING.size)))[0]
        return waiting


KERNEL = Kernel()
