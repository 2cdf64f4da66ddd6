"""Old HQ programs that drive, each as small as can be: plain sockets, bytes written by hand, a process each.

    python -m tests.e2e.hq_programs PROGRAM HOST PORT

Each line on stdin is a push of the stick, after letting go of it; the end of stdin is an orderly end. Every motion has
a value of its own. Only the standard library: such a process must be there at once.
"""

import contextlib
import math
import os
import select
import socket
import struct
import sys
import time
from abc import ABC, abstractmethod
from typing import Any

LET_GO_S = 0.1
"""Seconds between letting go of the stick and pushing it: datagrams may overtake."""
RETRY_S = 0.02
LEFT, RIGHT = b"left", b"right"


class Program(ABC):
    """One program, connected. period_s: how often it says what the stick says."""

    period_s: float

    def __init__(self, host: str, port: int) -> None:
        self.tcp = _connected(host, port)
        self.begin()

    def begin(self) -> None:  # noqa: B027
        """Do what comes before driving."""

    @abstractmethod
    def neutral(self) -> None:
        """Say that the stick is let go of."""

    @abstractmethod
    def move(self, number: int) -> None:
        """Say that the stick is pushed; no two numbers in a row may look the same."""

    def end(self) -> None:
        """Take leave."""
        self.tcp.shutdown(socket.SHUT_RDWR)

    def read(self, count: int) -> bytes:
        """Wait for exactly so many bytes."""
        data = self.tcp.recv(count, socket.MSG_WAITALL)
        if len(data) < count:
            raise ConnectionError("ended")
        return data


class TcpUdp(Program):
    """An HQ of version 1.3, by UDP if it announces it."""

    period_s = 0.5
    announces_udp = True

    def begin(self) -> None:
        self.motion = self.tcp
        self._until(2)
        features = bytes([self.announces_udp, 0, 1, 0, 0, 0, 0])
        self.tcp.sendall(_packet(3, struct.pack("<i", 11) + b"1.1,1.2,1.3" + features))
        if self.announces_udp:
            self._until(4)
            self.motion = socket.socket(type=socket.SOCK_DGRAM)
            self.motion.connect(self.tcp.getpeername())
            self.motion.send(_packet(5))
            if self.motion.recv(64) != bytes.fromhex("03000000010601"):
                raise ConnectionError("no UDP")
            self.tcp.sendall(_packet(7, b"\x01"))
        self.tcp.sendall(_packet(10, struct.pack("<i", 2)))

    def _until(self, packet_id: int) -> None:
        while True:
            (length,) = struct.unpack("<i", self.read(4))
            if self.read(length)[1] == packet_id:
                return

    def neutral(self) -> None:
        self.tcp.sendall(_packet(13))

    def move(self, number: int) -> None:
        with contextlib.suppress(OSError if self.announces_udp else ()):  # a datagram without a network is lost
            self.motion.send(_packet(11, struct.pack("<fff", 0, 1, 0.1 + number % 9000 / 10_000)))


class TcpUdpByTcp(TcpUdp):
    """The same without UDP."""

    announces_udp = False


class Alf(Program):
    """An HQ of ALF, dialect text."""

    period_s = 0.02

    def neutral(self) -> None:
        self.tcp.sendall(b"3|0|0|0|0;")

    def move(self, number: int) -> None:
        self.tcp.sendall(b"3|%d|0|0|0;" % (5 + number % 250))

    def end(self) -> None:
        self.tcp.sendall(b"255|1;")
        super().end()


class Wc2Ec(Program):
    """An external controller that sets velocities once, and expects them to hold."""

    period_s = math.inf

    def begin(self) -> None:
        numbers: dict[bytes, int] = {}
        while not {LEFT, RIGHT} <= numbers.keys():
            command, _, number = self.read(3)
            body = self.read(self.read(1)[0] if command == 0 else 8)
            if command == 0:
                numbers[body] = number
        self._wheels = numbers[LEFT], numbers[RIGHT]

    def _set(self, velocity: float) -> None:
        self.tcp.sendall(b"".join(struct.pack("<BBBd", 130, 53, wheel, velocity) for wheel in self._wheels))

    def neutral(self) -> None:
        self._set(0.0)

    def move(self, number: int) -> None:
        self._set(1.0 + number % 800 / 100)


class Wc2EcThatRepeats(Wc2Ec):
    """One that sets new velocities in every step of its own."""

    period_s = 0.05


PROGRAMS: dict[str, type[Program]] = {
    "tcpudp": TcpUdp,
    "tcpudp-by-tcp": TcpUdpByTcp,
    "alf": Alf,
    "wc2ec-holds": Wc2Ec,
    "wc2ec-repeats": Wc2EcThatRepeats,
}


def _packet(packet_id: int, body: bytes = b"") -> bytes:
    return struct.pack("<iBB", 2 + len(body), 1, packet_id) + body


def _connected(host: str, port: int) -> socket.socket:
    """Connect as soon as somebody listens, until stdin says anything."""
    while True:
        try:
            connection = socket.create_connection((host, port))
        except ConnectionRefusedError:
            if select.select([0], [], [], RETRY_S)[0]:
                raise
        else:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return connection


def run(program: Program) -> None:
    """Say what the stick says until stdin or the connection ends."""
    number, pushed, due = 0, False, time.monotonic()
    print("ready", flush=True)
    while True:
        wait_s = max(0.0, due - time.monotonic())
        spoken: list[Any] = select.select([0, program.tcp], [], [], None if wait_s == math.inf else wait_s)[0]
        if program.tcp in spoken and not program.tcp.recv(65536):
            return
        if 0 in spoken:
            if not os.read(0, 65536):
                program.end()
                return
            program.neutral()
            time.sleep(LET_GO_S)
            pushed, due = True, time.monotonic()
        if time.monotonic() >= due:
            due = time.monotonic() + program.period_s
            number += 1
            if pushed:
                program.move(number)
            else:
                program.neutral()


if __name__ == "__main__":
    name, host, port = sys.argv[1:]
    program = PROGRAMS[name](host, int(port))
    with contextlib.suppress(ConnectionError, TimeoutError):  # so may a listener end
        run(program)
