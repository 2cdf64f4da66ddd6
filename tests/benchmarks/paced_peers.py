"""The processes of :mod:`tests.benchmarks.paced`: sources, sinks, and what lies between them.

``python -m tests.benchmarks.paced_peers ROLE KIND ...``. Each source obeys ``send FIRST COUNT RATE_HZ`` and tells when
it sent each; each sink obeys ``report`` and tells when which came. All read the same monotonic clock. A message bears
its number: a position in ``x``, a scan as its sequence, a reading as its value.
"""

from __future__ import annotations

import asyncio
import gc
import json
import math
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgpack
import uvloop
import zenoh

from tests.benchmarks import alf_wire, wire
from tests.benchmarks.peer import ROBOT, hear, open_session, tell
from tests.benchmarks.robot import ACCEPT_S, shake_hands
from zbridge.bus import BusSettings
from zbridge.bus.tls.files import folder_tls
from zbridge.bus.zenoh import zenoh_config

Kind = Literal["position", "scan", "reading"]
KEYS = {"position": f"fleet/{ROBOT}/pose", "scan": alf_wire.SCAN_KEY, "reading": f"fleet/{ROBOT}/sensor/ds"}
PROTOCOLS = {"position": "tcpudp", "scan": "alf", "reading": "wc2ec"}
_DISTANCE_SENSOR = 37
_READING = struct.Struct("<BBBd")
_PROBE_S = 0.02
_WAIT_S = 120.0


# Bytes, by the protocol pages


def _frame(kind: Kind, number: int) -> bytes:
    """Write one message of the robot."""
    if kind == "position":
        return wire.position(number)
    if kind == "scan":
        return alf_wire.scan("text", number, int(time.monotonic() * 1000) % 2**31)
    return _READING.pack(1, _DISTANCE_SENSOR, 0, float(number))


def _published(kind: Kind, number: int) -> bytes:
    """Write what a gateway publishes for it."""
    now_ns = time.time_ns()
    if kind == "position":
        return wire.payload("pose", number, now_ns)
    if kind == "scan":
        return alf_wire.payload(number, 0, now_ns)
    values = {"value": float(number), "kind": "distance", "device": 0, "stamp_ns": now_ns}
    packed: bytes = msgpack.packb(values)
    return packed


def _number_published(kind: Kind, payload: bytes) -> int:
    """Read the number from MessagePack or JSON."""
    if kind == "position":
        return wire.sequence_of(payload)
    values = json.loads(payload) if payload[:1] == b"{" else msgpack.unpackb(payload)
    return int(values["seq" if kind == "scan" else "value"])


def _cut(kind: Kind, data: bytes) -> list[tuple[int, bytes]]:
    """Cut bytes into the numbers of whole messages and these messages; what is not counted is left out."""
    if kind == "scan":
        return [(int(part.split(b"|", 2)[1]), part) for part in data.split(b";")[:-1] if part.startswith(b"1|")]
    shape, place = (wire.POSITION, 3) if kind == "position" else (_READING, 3)
    whole = len(data) - len(data) % shape.size
    return [(int(fields[place]), b"") for fields in shape.iter_unpack(data[:whole])]


# Sources


def _obey(send: Callable[[int], object]) -> None:
    """Probe until the first word; then send as told, on an absolute schedule, until the harness is gone."""
    now_ns = time.perf_counter_ns
    while (word := hear(_PROBE_S)) is None:
        send(0)
    gc.disable()
    while True:
        if word and word.startswith("send"):
            first, count, rate_hz = (float(part) for part in word.split()[1:])
            begun_ns, period_ns, sent_ns = now_ns(), 1e9 / rate_hz, []
            for number in range(int(first), int(first + count)):
                wait_ns = begun_ns + (number - first + 1) * period_ns - now_ns()
                if wait_ns > 0:
                    time.sleep(wait_ns / 1e9)
                sent_ns.append(now_ns())
                send(number)
            tell(sent_ns=sent_ns)
        elif word:
            tell(held=True)
        word = hear(_WAIT_S)


def robot(kind: Kind) -> None:
    """Be the robot: serve one connection."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(ACCEPT_S)
        tell(port=server.getsockname()[1])
        link, _ = server.accept()
    link.settimeout(ACCEPT_S)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if kind == "position":
        shake_hands(link)
    elif kind == "scan":
        link.sendall(alf_wire.geometry("text"))
    else:
        link.sendall(bytes((0, _DISTANCE_SENSOR, 0, 2)) + b"ds")
    link.settimeout(None)
    threading.Thread(target=_drain, args=(link,), daemon=True).start()
    _obey(lambda number: link.sendall(_frame(kind, number)))


def _drain(link: socket.socket) -> None:
    while select.select([link], [], []) and link.recv(4096):
        pass


def bare(kind: Kind, endpoint: str) -> None:
    """Be the bare Zenoh hop: put what a gateway publishes."""
    with open_session(listen=endpoint, shared_memory=False) as session:
        publisher = _publisher(session, kind)
        _obey(lambda number: publisher.put(_published(kind, number)))


def _publisher(session: zenoh.Session, kind: Kind) -> zenoh.Publisher:
    return session.declare_publisher(KEYS[kind], congestion_control=zenoh.CongestionControl.DROP, express=True)


# Sinks


class _Sink:
    """What came, with its time; the numbers are read when the harness asks."""

    def __init__(self, numbers: Callable[[Any], list[int]]) -> None:
        self.came: list[tuple[int, Any]] = []
        self._numbers = numbers

    def take(self, item: Any) -> None:
        self.came.append((time.perf_counter_ns(), item))

    def obey(self) -> None:
        """Tell when the first came, and afterwards what came since the last report."""
        while not self.came:
            time.sleep(0.0005)
        tell(first_ns=self.came[0][0])
        while True:
            if hear(_WAIT_S) == "report":
                came, self.came = self.came, []
                tell(arrivals=[(number, at_ns) for at_ns, item in came for number in self._numbers(item)])


def subscriber(kind: Kind, endpoint: str) -> None:
    """Be the consumer on the bus."""
    sink = _Sink(lambda sample: [_number_published(kind, sample.payload.to_bytes())])
    with open_session(connect=endpoint, shared_memory=False) as session:
        session.declare_subscriber(KEYS[kind], sink.take)
        tell(ready=True)
        sink.obey()


def client(kind: Kind, endpoint: str, folder: str = "") -> None:
    """Be the consumer behind a router; ``folder``: with these certificates."""
    tls = folder_tls(Path(folder)) if folder else None
    sink = _Sink(lambda sample: [_number_published(kind, sample.payload.to_bytes())])
    settings = BusSettings(mode="client", connect=(endpoint,), multicast=False, tls=tls)
    with zenoh.open(zenoh_config(settings)) as session:
        session.declare_subscriber(KEYS[kind], sink.take)
        tell(ready=True)
        sink.obey()


class _Receiver(asyncio.Protocol):
    """Greets a robot of the kind, then hands every read on."""

    def __init__(self, kind: Kind, take: Callable[[bytes], object]) -> None:
        self._take = take
        self._greeting = wire.client_settings() if kind == "position" else b""
        self._transport: Any = None
        self._greeted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        if not self._greeted:  # the robot begins: settings, geometry or a registration
            self._greeted = True
            if self._greeting:
                self._transport.write(self._greeting)
            return
        self._take(data)


async def _receive(kind: Kind, port: int, take: Callable[[bytes], object]) -> None:
    await asyncio.get_running_loop().create_connection(lambda: _Receiver(kind, take), "127.0.0.1", port)
    await asyncio.Event().wait()


def tcp(kind: Kind, port: str) -> None:
    """Be the bare TCP hop's receiving end, on the gateway's kind of loop."""
    sink = _Sink(lambda data: [number for number, _ in _cut(kind, data)])
    threading.Thread(target=lambda: uvloop.run(_receive(kind, int(port), sink.take)), daemon=True).start()
    sink.obey()


# Between


def minimal(kind: Kind, port: str, endpoint: str) -> None:
    """Be the least program between a robot and the bus: uvloop reads, and the loop's thread puts."""
    if kind != "position":
        raise SystemExit("the least program is written for positions")
    gc.disable()
    with open_session(listen=endpoint, shared_memory=False) as session:
        publisher, unpack, pack = _publisher(session, kind), wire.POSITION.iter_unpack, msgpack.packb

        def take(data: bytes) -> None:
            for _, _, _, x, y, heading_deg in unpack(data):
                heading = math.radians(heading_deg) + math.pi / 2
                publisher.put(pack({"x": x * 0.01, "y": y * 0.01, "heading": heading, "stamp_ns": time.time_ns()}))

        uvloop.run(_receive(kind, int(port), take))


def main() -> None:
    """Be what the arguments say."""
    roles: dict[str, Callable[..., None]] = {
        "robot": robot,
        "bare": bare,
        "subscriber": subscriber,
        "client": client,
        "tcp": tcp,
        "minimal": minimal,
    }
    roles[sys.argv[1]](*sys.argv[2:])


if __name__ == "__main__":
    main()
