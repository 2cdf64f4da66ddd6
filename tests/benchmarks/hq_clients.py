"""The HQ programs of the benchmark: many sockets on one epoll that store when which message came, and nothing else.

``python -m tests.benchmarks.hq_clients KIND PORT COUNT [talk]``. TCP/UDP clients are of version 1.3 and shake hands,
``udp`` with datagrams; ALF clients speak text. ``talk``: repeat neutral as legacy programs do, packet 13 every half
second or a drive command every 20 ms. Told ``await TOTAL QUIET_S TIMEOUT_S``, it reports what came of each client.
"""

from __future__ import annotations

import contextlib
import select
import socket
import sys
import time
from array import array
from collections.abc import Callable
from functools import partial

from tests.benchmarks import hq_wire, wire
from tests.benchmarks.hq_wire import Kind
from tests.benchmarks.peer import hear, tell

HOST = "127.0.0.1"
CONNECT_S = 15.0
"""Longest time until the listener listens, and until every client has seen a probe."""
HANDSHAKE_S = 5.0
READ_BYTES = 65_536
_MOST_EVENTS = 1024
_JOYSTICK_STOP = 13
_NEUTRAL = b"3|0|0|0|0;"
_TALK_S = {"tcp": 0.5, "udp": 0.5, "alf": 0.02}


class Client:
    """One HQ program: its sockets, and the bytes of a message that has not come whole."""

    def __init__(self, place: int, link: socket.socket, datagrams: socket.socket | None, number: int) -> None:
        self.place = place
        self.link = link
        self.datagrams = datagrams
        self.number = number
        self.rest = b""


class Clients:
    """All clients, and what they got: for each kind of message the running numbers and when they came."""

    def __init__(self, kind: Kind, port: int, count: int) -> None:
        self._kind = kind
        self._poll = select.epoll()
        self._poll.register(sys.stdin.fileno(), select.EPOLLIN)
        self._readers: dict[int, Callable[[], None]] = {}
        self.counts = [0] * count
        self._probed: set[int] = set()
        self._small = array("q"), array("q")
        self._scans = array("q"), array("q")
        self.clients = [self._connect(place, port) for place in range(count)]

    @property
    def total(self) -> int:
        """The messages that all clients got, probes apart."""
        return len(self._small[0]) + len(self._scans[0])

    @property
    def probed(self) -> bool:
        """Whether every client has seen a probe."""
        return len(self._probed) == len(self.counts)

    def work(self, timeout_s: float) -> bool:
        """Read what has come; give whether the harness has said something."""
        told, readers, stdin = False, self._readers, sys.stdin.fileno()
        for fd, _ in self._poll.poll(timeout_s, _MOST_EVENTS):
            if fd == stdin:
                told = True
            else:
                readers[fd]()
        return told

    def report(self) -> None:
        """Tell everything to the harness."""
        small, scans = ([column.tolist() for column in table] for table in (self._small, self._scans))
        tell(counts=self.counts, small=small, scans=scans)

    def talk(self) -> None:
        """Let every client repeat its neutral command."""
        for client in self.clients:
            neutral = _NEUTRAL if self._kind == "alf" else hq_wire.packet(client.number, _JOYSTICK_STOP)
            with contextlib.suppress(BlockingIOError):
                client.link.send(neutral)

    # Connecting

    def _connect(self, place: int, port: int) -> Client:
        link = _connected(port)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        number, datagrams = 0, None
        if self._kind != "alf":
            number, datagrams = _shake_hands(link, port, udp=self._kind == "udp")
        client = Client(place, link, datagrams, number)
        self._read_from(link, partial(_read_stream, client, self._text if self._kind == "alf" else self._packets))
        if datagrams is not None:
            self._read_from(datagrams, partial(self._datagram, client, datagrams))
        return client

    def _read_from(self, source: socket.socket, read: Callable[[], None]) -> None:
        source.setblocking(False)
        self._readers[source.fileno()] = read
        self._poll.register(source.fileno(), select.EPOLLIN)

    # Reading

    def _datagram(self, client: Client, datagrams: socket.socket) -> None:
        data = datagrams.recv(READ_BYTES)
        if data[5] == hq_wire.POSITION:
            self._note(client.place, int(wire.POSITION.unpack(data)[3]), self._small)

    def _packets(self, client: Client, data: bytes) -> bytes:
        start, end = 0, len(data)
        while end - start >= wire.HEADER.size:
            length, _, packet_id = wire.HEADER.unpack_from(data, start)
            if end - start < 4 + length:
                break
            if packet_id == hq_wire.POSITION:
                self._note(client.place, int(wire.POSITION.unpack_from(data, start)[3]), self._small)
            start += 4 + length
        return data[start:]

    def _text(self, client: Client, data: bytes) -> bytes:
        *messages, rest = data.split(b";")
        for message in messages:
            if message.startswith(b"4|"):
                self._note(client.place, int(float(message[message.rfind(b"|") + 1 :])), self._small)
            elif message.startswith(b"1|"):
                self._note(client.place, int(message[2 : message.find(b"|", 2)]), self._scans)
        return rest

    def _note(self, place: int, number: int, table: tuple[array[int], array[int]]) -> None:
        if number:
            table[0].append(number)
            table[1].append(time.perf_counter_ns())
            self.counts[place] += 1
        else:
            self._probed.add(place)


def _read_stream(client: Client, take: Callable[[Client, bytes], bytes]) -> None:
    data = client.link.recv(READ_BYTES)
    if not data:
        raise SystemExit(f"client {client.place} was disconnected")
    client.rest = take(client, client.rest + data if client.rest else data)


def _connected(port: int) -> socket.socket:
    end = time.monotonic() + CONNECT_S
    while True:
        try:
            return socket.create_connection((HOST, port), timeout=HANDSHAKE_S)
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


def _shake_hands(link: socket.socket, port: int, *, udp: bool) -> tuple[int, socket.socket | None]:
    number = _expect(link, hq_wire.SETTINGS)[wire.HEADER.size]
    link.sendall(hq_wire.answer(number, udp=udp))
    if not udp:
        return number, None
    _expect(link, hq_wire.START_UDP)
    datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    datagrams.settimeout(HANDSHAKE_S)
    datagrams.connect((HOST, port))
    datagrams.send(hq_wire.packet(number, hq_wire.HELLO))
    heard = datagrams.recv(READ_BYTES)
    if heard != hq_wire.HEARD_YOU:
        raise SystemExit(f"expected packet 6 by UDP, got {heard.hex()}")
    link.sendall(hq_wire.packet(number, hq_wire.REPORT, b"\x01"))
    return number, datagrams


def _expect(link: socket.socket, packet_id: int) -> bytes:
    """Read the next packet, and not a byte more."""
    data = b""
    while len(data) < wire.HEADER.size or len(data) < 4 + wire.HEADER.unpack_from(data)[0]:
        size = 4 + wire.HEADER.unpack_from(data)[0] if len(data) >= wire.HEADER.size else wire.HEADER.size
        more = link.recv(size - len(data))
        if not more:
            raise SystemExit(f"disconnected before packet {packet_id}")
        data += more
    if data[5] != packet_id:
        raise SystemExit(f"expected packet {packet_id}, got {data.hex()}")
    return data


def main() -> None:
    """Connect all clients, and read until the harness is gone."""
    kind: Kind = next(kind for kind in hq_wire.KINDS if kind == sys.argv[1])
    clients = Clients(kind, int(sys.argv[2]), int(sys.argv[3]))
    talk_s = _TALK_S[kind] if sys.argv[4:] == ["talk"] else float("inf")
    end = time.monotonic() + CONNECT_S
    while not clients.probed:
        clients.work(0.1)
        if time.monotonic() > end:
            raise SystemExit("not every client was sent a probe")
    tell(ready=True)
    awaited, quiet_s, total, talk_at = 0, 0.0, 0, time.monotonic() + talk_s
    changed = end = float("inf")
    while True:
        now = time.monotonic()
        if now >= talk_at:
            clients.talk()
            talk_at += talk_s
        if clients.work(min(0.1, max(0.0, talk_at - now))):
            _, count, quiet, timeout = (hear() or "").split()
            awaited, quiet_s, end = int(count), float(quiet), now + float(timeout)
        if clients.total != total:
            total, changed = clients.total, now
        if awaited and (total >= awaited or now > end or now - changed > quiet_s):
            clients.report()
            awaited = 0


if __name__ == "__main__":
    main()
