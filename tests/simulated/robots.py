"""Simulated robots, written from the protocol pages alone: each keeps an account of what it read and whether it moves.

They read like the legacy programs. A TCP/UDP robot takes all that one read gives as one packet; one of 1.1 or 1.2
ignores the first packet that it reads alone after a stall. Mode 3 drives by itself. Some never stop by themselves.
Each notes ``reads`` (what, value, how) and ``moving`` (whether, why).
"""

from __future__ import annotations

import re
import struct
from typing import Any

from tests.simulated.engine import Host, Process
from tests.simulated.net import End, Network

MOST_READ = 4096
_PACKET = struct.Struct("<iBB")
_SIZES = {5: 0, 7: 1, 10: 4, 11: 12, 12: 4, 13: 0, 50: 4, 52: 0, 54: 0}
"""Bodies of what an HQ may send, bytes."""


class SimRobot(Process):
    """A robot: ``moving`` as its wheels do. self_stop_s: it stops after so long without a command; None: never."""

    telemetry_s = 0.8

    def __init__(self, host: Host, name: str, network: Network, port: int, options: dict[str, Any]) -> None:
        super().__init__(host, name)
        self.network = network
        self.port = port
        self.options = options
        self.self_stop_s: float | None = options.get("self_stop_s")
        self.single = bool(options.get("single"))
        self.used_up = False
        """Whether the connection is not the one usable one of this start."""
        self.moving = False
        self.by_itself = False
        self.crashed: str | None = None
        self.ends: list[End] = []
        self.lossless = False
        self.splits_s: float = options.get("splits_s", 0.0)
        """Seconds between the two parts in which telemetry leaves; 0: it leaves whole."""
        self.mute_to: set[str] = set()
        """Hosts that it sends nothing more to."""
        self._rests: dict[End, bytes] = {}
        self.told = 0
        """Telemetry messages that were sent, each with its number."""
        self._commanded = 0
        self._value = 0.0
        network.listen(self, port, self.accept)

    def accept(self, end: End) -> bool:
        """Take a connection."""
        if not self.may_accept():
            return False
        self.ends.append(end)
        end.on_data = lambda: self.after(self.read_delay(end), lambda: self.read(end))
        end.on_close = lambda error: self.after(0.0, lambda: self.lost(end))
        self.world.note(self.name, "connected", end.peer.address)
        self.after(0.001, lambda: self.greet(end))
        self.after(self.telemetry_s, lambda: self.report(end))
        return True

    def may_accept(self) -> bool:
        """Whether another connection is accepted."""
        return self.alive and self.crashed is None

    def read_delay(self, end: End) -> float:
        """Return the time until what came is read."""
        return 2e-5

    def greet(self, end: End) -> None:
        """Send what is sent first."""

    def report(self, end: End) -> None:
        """Send telemetry, again and again."""
        if end in self.ends and not end.closed:
            if end.peer.address[0] not in self.mute_to:
                self.tell(end)
            self.after(self.telemetry_s, lambda: self.report(end))

    def tell(self, end: End) -> None:
        """Send telemetry once."""

    def put(self, end: End, data: bytes) -> None:
        """Write a telemetry message, in two parts perhaps."""
        self.told += 1
        self.world.note(self.name, "tells", self.told)
        if not self.splits_s or end in self._rests:
            self.write(end, data)
            return
        cut = self.rng.randrange(1, len(data))
        end.send(data[:cut])
        self._rests[end] = data[cut:]

        def rest() -> None:
            data = self._rests.pop(end)
            if not end.closed:
                end.send(data)

        self.after(self.splits_s, rest)

    def write(self, end: End, data: bytes) -> None:
        """Write a message, after the rest of the one before."""
        if end in self._rests:
            self._rests[end] += data
        else:
            end.send(data)

    def read(self, end: End) -> None:
        """Read what came."""

    def lost(self, end: End) -> None:
        """End a connection; a robot that holds its last command moves on."""
        if end in self.ends:
            self.ends.remove(end)
            end.close()
            self.world.note(self.name, "disconnected", end.peer.address)
            self.left(end)

    def left(self, end: End) -> None:
        """Follow the end of a connection."""

    def heard(self, what: str, value: float = 0.0, how: str = "tcp", end: End | None = None) -> None:
        """Enter into the account what was read and is obeyed."""
        self.world.note(self.name, "reads", what, round(value, 9), how, end.peer.process.name if end else "")

    def drive(self, value: float) -> None:
        """Move, or stand for 0; the robot's own failsafe counts from here."""
        self._commanded += 1
        self._value = value
        self.judge("commanded")
        if self.self_stop_s is not None and value:
            number = self._commanded

            def fail_safe() -> None:
                if self._commanded == number:
                    self._value = 0.0
                    self.judge("failsafe")

            self.after(self.self_stop_s, fail_safe)

    def judge(self, why: str) -> None:
        """Note when it begins or ends to move."""
        moving = self.by_itself or bool(self._value)
        if moving != self.moving:
            self.moving = moving
            self.world.note(self.name, "moving", moving, why)

    def crash(self, why: str) -> None:
        """End as the legacy program does when it is sent what it cannot bear."""
        if self.crashed is None:
            self.crashed = why
            self.world.note(self.name, "crashed", why)

    def reboot(self, after_s: float) -> None:
        """Accept again after a while."""


class TcpUdpRobot(SimRobot):
    """A robot of the package protocol, version 1.1 to 1.4."""

    def __init__(self, host: Host, name: str, network: Network, port: int, options: dict[str, Any]) -> None:
        super().__init__(host, name, network, port, options)
        self.version = options.get("version", "1.3")
        self.udp = bool(options.get("udp"))
        self.lossless = bool(options.get("lossless"))
        """Whether it cuts packets by their length, as the document says."""
        self.polls = self.version in ("1.1", "1.2") and not self.lossless
        self.mode = 1
        self._asleep_until = 0.0
        self._ignores = False
        self._queued: set[int] = set()
        self._sources: dict[tuple[str, int], End] = {}
        self._used = False
        self._clients = 1
        self._stalled_at = -1.0
        if self.udp:
            network.datagram_sockets[host.name, port] = lambda data, source: self.after(
                0.0, lambda: self.datagram(data, source)
            )

    def may_accept(self) -> bool:
        return super().may_accept() and not (self.single and self._used)

    def greet(self, end: End) -> None:
        self.used_up = self._used and bool(self.options.get("poor_again"))
        self._used = True
        self._clients += 1
        versions = {"1.3": "1.1,1.2,1.3", "1.4": "1.1,1.2,1.3,1.4"}.get(self.version, self.version).encode()
        flags = bytes([self.udp, 0, 1, 0, 0])
        if self.version != "1.1":
            flags += b"\0"
        if self.version in ("1.3", "1.4"):
            flags += b"\0" + struct.pack("<ii", 100, 10)
        body = bytes([min(self._clients, 255)]) + struct.pack("<i", len(versions)) + versions + flags
        self.send(end, 2, body)

    def send(self, end: End, kind: int, body: bytes = b"") -> None:
        """Write a packet."""
        if not end.closed:
            self.write(end, _PACKET.pack(2 + len(body), 1, kind) + body)

    def tell(self, end: End) -> None:
        if self.world.now >= self._asleep_until and not self.used_up:
            self.put(end, _PACKET.pack(14, 1, 55) + struct.pack("<fff", self.told + 1, 2.0, 3.0))

    def read_delay(self, end: End) -> float:
        asleep_s = max(0.0, self._asleep_until - self.world.now)
        return asleep_s + (self.rng.uniform(0.0, 0.15) if self.polls else 2e-5)

    def read(self, end: End) -> None:
        if end not in self.ends or not end.received or self.crashed is not None:
            return
        if self.world.now < self._asleep_until:
            self.after(self._asleep_until - self.world.now + 1e-3, lambda: self.read(end))
            return
        if self.lossless:
            self.cut_packets(end)
            return
        data = end.read(MOST_READ)
        if len(data) < _PACKET.size:
            return
        length = int.from_bytes(data[:4], "little", signed=True)
        stalled = self.resumed_at > self._stalled_at
        if self.used_up and self.rng.random() < 0.5:
            return
        if length + 4 != len(data):
            self.world.note(self.name, "drops", len(data))
            if stalled and self.version in ("1.1", "1.2"):
                self._ignores = True
            return
        if stalled and self._ignores:
            self._ignores, self._stalled_at = False, self.world.now
            self.world.note(self.name, "ignores", data.hex())
            return
        self._stalled_at = self.world.now
        self.take(end, data[5], data[6:] if len(data) > 6 else b"", "tcp")

    def cut_packets(self, end: End) -> None:
        """Read packet by packet."""
        while len(end.received) >= _PACKET.size:
            size = 4 + int.from_bytes(end.received[:4], "little", signed=True)
            if len(end.received) < size or self.world.now < self._asleep_until:
                return
            data = end.read(size)
            self.take(end, data[5], data[6:], "tcp")

    def datagram(self, data: bytes, source: tuple[str, int]) -> None:
        """Take a datagram; 1.1 and 1.2 misread a tenth of them."""
        if self.crashed is not None or len(data) < _PACKET.size:
            return
        if 4 + int.from_bytes(data[:4], "little", signed=True) != len(data):
            self.crash("a datagram whose length field is wrong")
            return
        end = next((each for each in reversed(self.ends) if each.peer.address[0] == source[0]), None)
        if end is None:
            return
        if data[5] == 5:
            self._sources[source] = end
            answer = _PACKET.pack(3, 1, 6) + b"\1"
            self.network.datagram((self.host.name, self.port), source, answer)
            return
        if self.version in ("1.1", "1.2") and not self.lossless and self.rng.random() < 0.1:
            return
        if source in self._sources:
            self.take(self._sources[source], data[5], data[6:], "udp")

    def take(self, end: End, kind: int, body: bytes, how: str) -> None:
        """Obey a packet."""
        if kind == 3:
            self.settled(end, body)
        elif kind not in _SIZES:
            self.crash(f"packet {kind}, which is not registered")
        elif len(body) != _SIZES[kind]:
            self.crash(f"packet {kind} with {len(body)} bytes")
        elif kind == 10:
            self.mode = int.from_bytes(body, "little", signed=True)
            self.heard("mode", self.mode, how, end)
            self.by_itself = self.mode == 3
            self.judge(f"mode {self.mode}")
        elif kind in (11, 12):
            value = struct.unpack("<fff", body)[2] if kind == 11 else struct.unpack("<f", body)[0]
            if kind == 11 and body[:8] == bytes(8):
                value = 0.0
            self.heard("motion" if value else "neutral", abs(value), how, end)
            self.drive(value)
        elif kind == 13:
            self.heard("stop", 0.0, how, end)
            self.drive(0.0)
        elif kind == 54:
            self.send(end, 55, struct.pack("<fff", 1.0, 2.0, 3.0))
        elif kind == 52:
            self.send(end, 53, struct.pack("<i", 0))

    def settled(self, end: End, body: bytes) -> None:
        """Read the client's settings: with UDP on both sides, ask for it and sleep."""
        size = int.from_bytes(body[:4], "little")
        if self.udp and len(body) > 4 + size and body[4 + size]:
            starts_s = self.options.get("starts_s")
            if starts_s is None:
                self.start(end)
            else:
                self.after(starts_s, lambda: self.start(end))

    def start(self, end: End) -> None:
        """Ask for datagrams, and sleep."""
        self.world.note(self.name, "starts datagrams", end.peer.address)
        self.send(end, 4)
        self._asleep_until = self.world.now + 2.0

    def left(self, end: End) -> None:
        self._sources = {source: each for source, each in self._sources.items() if each is not end}


class AlfRobot(SimRobot):
    """A vehicle of ALF, text or binary; it serves one client per start, and starts again."""

    def __init__(self, host: Host, name: str, network: Network, port: int, options: dict[str, Any]) -> None:
        super().__init__(host, name, network, port, options)
        self.lossless = True
        self.binary = options.get("dialect") == "binary"
        self._free_at = 0.0
        self._text = b""

    def may_accept(self) -> bool:
        return super().may_accept() and not self.ends and self.world.now >= self._free_at

    def left(self, end: End) -> None:
        self._free_at = self.world.now + self.rng.uniform(1.0, 4.0)
        self._text = b""

    def greet(self, end: End) -> None:
        if self.binary:
            end.send(struct.pack("<B3f3i", 2, -120.0, 120.0, 0.35, 100, 20, 5600))
        else:
            end.send(b"2|-120.000000|120.000000|0.350000|100|20|5600;")

    def tell(self, end: End) -> None:
        if self.binary:
            self.put(end, struct.pack("<BB6hf", 4, int(abs(self._value)), 0, 0, 1, 0, 0, 0, self.told + 1))
        else:
            rest = b"|".join([b"0.000000"] * 6)
            self.put(end, b"4|%d|%s|%d.000000;" % (int(abs(self._value)), rest, self.told + 1))

    def read(self, end: End) -> None:
        if end not in self.ends:
            return
        self._text += end.read(65536)
        while True:
            fields = self.cut()
            if fields is None:
                return
            if fields[0] == 3 and len(fields) == 5:
                speed = float(fields[1])
                self.heard("motion" if speed else "stop", speed, "tcp", end)
                self.drive(speed)
            elif fields[0] == 255:
                self.write(end, b"\xff\x01" if self.binary else b"255|1;")
                self.after(0.05, lambda: self.lost(end))

    def cut(self) -> list[float] | None:
        """Cut the next message."""
        if not self.binary:
            text, separator, rest = self._text.partition(b";")
            if not separator:
                return None
            self._text = rest
            return [float(each) for each in re.findall(rb"-?[0-9]*\.?[0-9]+", text)]
        if not self._text:
            return None
        size = {3: 5, 255: 2}.get(self._text[0])
        if size is None:
            self.crash(f"message {self._text[0]}")
            return None
        if len(self._text) < size:
            return None
        fields, self._text = list(self._text[:size]), self._text[size:]
        return fields
