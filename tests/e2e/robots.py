"""A scripted robot of the TCP/UDP package protocol for end-to-end tests: plain sockets, bytes written by hand."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time

SETTINGS = bytes.fromhex("210000000102020b000000312e312c312e322c312e3300010101010101e803000064000000")
"""serverSettings: client id 2, "1.1,1.2,1.3", every feature but UDP, a map of 1000 in steps of 100."""


class ScriptedRobot:
    """Accepts one HQ after the other, keeps every read with its time, and sends what it is told."""

    def __init__(self, settings: bytes = SETTINGS) -> None:
        self.reads: list[tuple[float, bytes]] = []
        self.connections = 0
        self._settings = settings
        self._peer: socket.socket | None = None
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            self.connections += 1
            self._peer = peer
            with peer, contextlib.suppress(OSError):
                if self._settings:
                    peer.sendall(self._settings)
                while data := peer.recv(4096):
                    self.reads.append((time.monotonic(), data))

    def send(self, data: bytes) -> None:
        assert self._peer is not None
        self._peer.sendall(data)

    def packets(self, packet_id: int) -> list[tuple[float, bytes]]:
        """The reads that were a packet of this id."""
        return [(at, data) for at, data in self.reads if len(data) >= 6 and data[5] == packet_id]

    def drop(self) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.drop()
        self._thread.join(5)


def position(x: float, y: float, heading_deg: float) -> bytes:
    """Packet 55, written by hand from the page."""
    return bytes.fromhex("0e0000000137") + struct.pack("<fff", x, y, heading_deg)
