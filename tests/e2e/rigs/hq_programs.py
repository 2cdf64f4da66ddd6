"""Old HQ programs that drive, each as small as can be: plain sockets, bytes written by hand, a process each.

    python -m tests.e2e.rigs.hq_programs PROGRAM HOST PORT

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
from collections.abc import Callable
from typing import NamedTuple

LET_GO_S = 0.1
"""Seconds between letting go of the stick and pushing it: datagrams may overtake."""
RETRY_S = 0.02
LEFT, RIGHT = b"left", b"right"
Move = Callable[[int], object]
"""Says that the stick is pushed, or let go of: 0. No two numbers in a row look the same."""


def _read(tcp: socket.socket, count: int) -> bytes:
    """Wait for exactly so many bytes."""
    data = tcp.recv(count, socket.MSG_WAITALL)
    if len(data) < count:
        raise ConnectionError("ended")
    return data


def _packet(packet_id: int, body: bytes = b"") -> bytes:
    return struct.pack("<iBB", 2 + len(body), 1, packet_id) + body


def _await_packet(tcp: socket.socket, packet_id: int) -> None:
    while _read(tcp, struct.unpack("<i", _read(tcp, 4))[0])[1] != packet_id:
        pass


def tcpudp(tcp: socket.socket, *, announces_udp: bool = True) -> Move:
    """Be an HQ of version 1.3, by UDP if it announces it."""
    motion = tcp
    _await_packet(tcp, 2)
    features = bytes([announces_udp, 0, 1, 0, 0, 0, 0])
    tcp.sendall(_packet(3, struct.pack("<i", 11) + b"1.1,1.2,1.3" + features))
    if announces_udp:
        _await_packet(tcp, 4)
        motion = socket.socket(type=socket.SOCK_DGRAM)
        motion.connect(tcp.getpeername())
        motion.send(_packet(5))
        if motion.recv(64) != bytes.fromhex("03000000010601"):
            raise ConnectionError("no UDP")
        tcp.sendall(_packet(7, b"\x01"))
    tcp.sendall(_packet(10, struct.pack("<i", 2)))

    def move(number: int) -> None:
        if not number:
            tcp.sendall(_packet(13))
            return
        with contextlib.suppress(OSError if announces_udp else ()):  # a datagram without a network is lost
            motion.send(_packet(11, struct.pack("<fff", 0, 1, 0.1 + number % 9000 / 10_000)))

    return move


def tcpudp_by_tcp(tcp: socket.socket) -> Move:
    """Be the same without UDP."""
    return tcpudp(tcp, announces_udp=False)


def alf(tcp: socket.socket) -> Move:
    """Be an HQ of ALF, dialect text."""
    return lambda number: tcp.sendall(b"3|%d|0|0|0;" % (5 + number % 250 if number else 0))


def wc2ec(tcp: socket.socket) -> Move:
    """Be an external controller that sets velocities."""
    numbers: dict[bytes, int] = {}
    while not {LEFT, RIGHT} <= numbers.keys():
        command, _, number = _read(tcp, 3)
        body = _read(tcp, _read(tcp, 1)[0] if command == 0 else 8)
        if command == 0:
            numbers[body] = number

    def move(number: int) -> None:
        velocity = 1.0 + number % 800 / 100 if number else 0.0
        wheels = (numbers[LEFT], numbers[RIGHT])
        tcp.sendall(b"".join(struct.pack("<BBBd", 130, 53, wheel, velocity) for wheel in wheels))

    return move


class Program(NamedTuple):
    """A program: what it does until it drives, how often it says what the stick says, and its last words."""

    begin: Callable[[socket.socket], Move]
    period_s: float
    end: bytes = b""


PROGRAMS = {
    "tcpudp": Program(tcpudp, 0.5),
    "tcpudp-by-tcp": Program(tcpudp_by_tcp, 0.5),
    "alf": Program(alf, 0.02, b"255|1;"),
    "wc2ec-holds": Program(wc2ec, math.inf),  # it expects velocities to hold
    "wc2ec-repeats": Program(wc2ec, 0.05),
}


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


def run(program: Program, tcp: socket.socket) -> None:
    """Say what the stick says until stdin or the connection ends."""
    move = program.begin(tcp)
    number, pushed, due = 0, False, time.monotonic()
    print("ready", flush=True)
    while True:
        wait_s = max(0.0, due - time.monotonic())
        spoken = select.select([0, tcp], [], [], None if wait_s == math.inf else wait_s)[0]
        if tcp in spoken and not tcp.recv(65536):
            return
        if 0 in spoken:
            if not os.read(0, 65536):
                tcp.sendall(program.end)
                tcp.shutdown(socket.SHUT_RDWR)
                return
            move(0)
            time.sleep(LET_GO_S)
            pushed, due = True, time.monotonic()
        if time.monotonic() >= due:
            due = time.monotonic() + program.period_s
            number += 1
            move(number if pushed else 0)


if __name__ == "__main__":
    name, host, port = sys.argv[1:]
    with contextlib.suppress(ConnectionError, TimeoutError):  # so may a listener end
        run(PROGRAMS[name], _connected(host, int(port)))
