"""A scripted robot of the TCP/UDP package protocol for end-to-end tests: plain sockets, bytes written by hand."""

import contextlib
import socket
import struct
import threading
import time

SETTINGS = bytes.fromhex("210000000102020b000000312e312c312e322c312e3300010101010101e803000064000000")
"""serverSettings: client id 2, "1.1,1.2,1.3", every feature but UDP, a map of 1000 in steps of 100."""


_STAMPS = 35
"""Linux's SO_TIMESTAMPNS; Python does not name it."""
_STAMP = struct.Struct("=qq")


class ScriptedRobot:
    """Accepts one HQ after the other, keeps every packet with its time, and sends what it is told."""

    def __init__(self, settings: bytes = SETTINGS) -> None:
        self.reads: list[tuple[float, bytes]] = []
        """The packets, and when each was read. What the kernel joined while this process was late is cut again."""
        self.arrivals: list[tuple[float, int]] = []
        """When the last byte of each read arrived (time of day, by the kernel), and how many packets it was."""
        self.connections = 0
        self._settings = settings
        self._peer: socket.socket | None = None
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.setsockopt(socket.SOL_SOCKET, _STAMPS, 1)  # of its connections too
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
                self._read(peer)

    def _read(self, peer: socket.socket) -> None:
        while True:
            data, stamps, _, _ = peer.recvmsg(4096, 64)
            at, packets = time.monotonic(), 0
            if not data:
                return
            while data:
                end = 4 + int.from_bytes(data[:4], "little")
                self.reads.append((at, data[:end]))
                data, packets = data[end:], packets + 1
            seconds, nanoseconds = _STAMP.unpack(stamps[0][2]) if stamps else (time.time(), 0)
            self.arrivals.append((seconds + nanoseconds / 1e9, packets))

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
