"""A scripted robot of the TCP/UDP package protocol for end-to-end tests: plain sockets, bytes written by hand."""

import contextlib
import socket
import struct
import threading
import time
from typing import NamedTuple

SETTINGS = bytes.fromhex("210000000102020b000000312e312c312e322c312e3300010101010101e803000064000000")
"""serverSettings: client id 2, "1.1,1.2,1.3", every feature but UDP, a map of 1000 in steps of 100."""
MOVE, ROTATE, STOP = 11, 12, 13
SCALE = 1_000_000
"""A driver's command number n is the speed n / SCALE."""


class Frame(NamedTuple):
    """One packet that the robot got, and when."""

    at: float
    packet_id: int
    body: bytes

    @property
    def moves(self) -> bool:
        """Whether the packet sets the robot moving."""
        return self.packet_id in (MOVE, ROTATE)

    @property
    def number(self) -> int:
        """The driver's number of the command that this packet carries; negative when driving backwards."""
        _, forward, speed = struct.unpack("<fff", self.body)
        return round(forward * speed * SCALE)


class Robot:
    """Takes one HQ after the other, keeps every packet with its time, and sends what it is told."""

    def __init__(self, settings: bytes = SETTINGS) -> None:
        self.frames: list[Frame] = []
        self.connections = 0
        self.ended: list[float] = []
        """When each connection ended."""
        self._settings = settings
        self._peer: socket.socket | None = None
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            self.connections += 1
            self._peer = peer
            with peer, contextlib.suppress(OSError):
                peer.sendall(self._settings)
                self._read(peer)
            self.ended.append(time.monotonic())

    def _read(self, peer: socket.socket) -> None:
        waiting = b""
        while data := peer.recv(65536):
            at = time.monotonic()
            waiting += data
            while len(waiting) >= 4 and len(waiting) >= (end := 4 + int.from_bytes(waiting[:4], "little")):
                self.frames.append(Frame(at, waiting[5], waiting[6:end]))
                waiting = waiting[end:]

    def send(self, data: bytes) -> None:
        assert self._peer is not None
        self._peer.sendall(data)

    def packets(self, packet_id: int, since: float = 0.0) -> list[Frame]:
        """Give the packets of this id after a moment."""
        return [frame for frame in tuple(self.frames) if frame.packet_id == packet_id and frame.at > since]

    def close(self) -> None:
        """End the robot and its connection, without a word."""
        for each in (self._server, self._peer):
            if each is not None:
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)
        self._server.close()


def position(x: float, y: float, heading_deg: float) -> bytes:
    """Packet 55, written by hand from the page."""
    return bytes.fromhex("0e0000000137") + struct.pack("<fff", x, y, heading_deg)
