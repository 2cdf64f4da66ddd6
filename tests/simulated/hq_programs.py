"""Simulated HQ programs of the three protocols: they connect to a gateway's listener as if it were the robot."""

from __future__ import annotations

import struct
from typing import Any

from tests.simulated.engine import Host, Process
from tests.simulated.net import End, Network

_PACKET = struct.Struct("<iBB")
WHEEL_FULL = 10.0
"""rad/s of a wheel at full scale."""


class HqProgram(Process):
    """A program at a stick: repeats what it says every ``every_s``. ``gives`` notes each motion, 0 for neutral."""

    every_s = 0.5
    protocol = ""

    def __init__(
        self, host: Host, name: str, network: Network, address: tuple[str, int], number: int, options: dict[str, Any]
    ) -> None:
        super().__init__(host, name)
        self.network = network
        self.address = address
        self.number = number
        self.options = options
        self.end: End | None = None
        self.ready = False
        self.value_now = 0.0
        self._count = 0
        self._connection = 0
        self._buffer = b""
        self.after(0.5 + self.rng.random(), self.connect)

    def connect(self) -> None:
        """Connect, and again whenever that fails."""
        if self.end is not None:
            return
        self._connection += 1
        number = self._connection

        def done(end: End | None, reason: str) -> None:
            if end is None or number != self._connection:
                self.after(1.0, self.connect)
                return
            self.end, self.ready, self._buffer = end, False, b""
            end.on_data = lambda: self.after(2e-5, lambda: self.read(end))
            end.on_close = lambda error: self.after(0.0, lambda: self.lost(end))
            self.world.note(self.name, "connected to listener")
            self.greet(end)
            end.on_data()  # the listener may have spoken first

        def given_up() -> None:
            if self.end is None and number == self._connection:
                self.connect()

        self.network.open(self, *self.address, done)
        self.after(3.0, given_up)

    def lost(self, end: End) -> None:
        """Follow the end of the connection."""
        if self.end is end:
            end.close()
            self.end, self.ready, self.value_now = None, False, 0.0
            self.world.note(self.name, "lost listener")
            self.after(1.0, self.connect)

    def disconnect(self) -> None:
        """Close the connection."""
        if self.end is not None:
            self.world.note(self.name, "leaves listener")
            self.lost(self.end)

    def greet(self, end: End) -> None:
        """Say what is said first."""

    def read(self, end: End) -> None:
        """Read what came."""

    def established(self) -> None:
        """Begin to repeat."""
        if not self.ready:
            self.ready = True
            self.world.note(self.name, "established")
            self.repeat(self._connection)

    def repeat(self, connection: int) -> None:
        """Say it again."""
        if self.end is not None and self.ready and connection == self._connection:
            if self.value_now and not self.options.get("once"):
                self.value_now = self.value()
            if not self.options.get("once"):
                self.say(self.value_now)
            self.after(self.every_s, lambda: self.repeat(connection))

    def value(self) -> float:
        """Return the next value, a fraction of full scale."""
        self._count += 1
        return (10 + (4 * self._count + self.number) % 88) / 100

    def say(self, value: float) -> None:
        """Send motion or neutral."""
        self.world.note(self.name, "gives", value)
        self.send_motion(value)

    def send_motion(self, value: float) -> None:
        """Write motion or neutral."""

    def mode(self, number: int) -> None:
        """Choose who moves the robot, where the protocol has that."""

    def do(self, step: dict[str, Any]) -> None:
        """Begin a step: push the stick for a while, choose a mode, or leave."""
        if not self.alive or self.end is None or not self.ready:
            return
        if step["do"] == "drive":

            def begin() -> None:
                self.value_now = self.value()
                if self.end is not None:
                    self.say(self.value_now)

            def end() -> None:
                self.value_now = 0.0
                if self.end is not None:
                    self.say(0.0)

            if self.rng.random() < 0.8:
                self.mode(2)
            self.after(0.05, begin)
            self.after(step.get("for", 2.0), end)
        elif step["do"] == "mode":
            self.mode({"autonomous": 3, "manual": 2}.get(step["mode"], 1))
        elif step["do"] == "leave":
            self.disconnect()


class TcpUdpHq(HqProgram):
    """An HQ client of the package protocol."""

    protocol = "tcpudp"

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.udp = bool(self.options.get("udp"))
        self._id = 0
        if self.udp:
            self.network.datagram_sockets[self.host.name, 11000] = lambda data, source: self.after(
                0.0, lambda: self.datagram(data)
            )

    def send(self, kind: int, body: bytes = b"") -> None:
        """Write a packet."""
        if self.end is not None and not self.end.closed:
            self.end.send(_PACKET.pack(2 + len(body), self._id, kind) + body)

    def read(self, end: End) -> None:
        if end is not self.end:
            return
        self._buffer += end.read(65536)
        while len(self._buffer) >= 6:
            size = 4 + int.from_bytes(self._buffer[:4], "little", signed=True)
            if len(self._buffer) < size:
                return
            kind, body = self._buffer[5], self._buffer[6:size]
            self._buffer = self._buffer[size:]
            self.take(kind, body)

    def take(self, kind: int, body: bytes) -> None:
        """Follow the handshake."""
        if kind == 2:
            self._id = body[0]
            versions = b"1.1,1.2,1.3"
            flags = bytes([self.udp, 0, 1, 0, 0, 0, 0])
            self.send(3, struct.pack("<i", len(versions)) + versions + flags)
            if not self.udp:
                connection = self._connection
                self.after(0.2, lambda: self.established() if connection == self._connection else None)
        elif kind == 4 and self.udp:
            source = (self.host.name, 11000)
            self.network.datagram(source, self.address, _PACKET.pack(2, self._id, 5))
            connection = self._connection
            self.after(2.0, lambda: self.confirm() if connection == self._connection else None)

    def datagram(self, data: bytes) -> None:
        """Take a datagram."""
        if len(data) >= 7 and data[5] == 6:
            self.confirm()

    def confirm(self) -> None:
        """End the handshake."""
        if not self.ready:
            self.send(7, b"\1")
            self.established()

    def send_motion(self, value: float) -> None:
        if not value:
            self.send(13)
            return
        body = struct.pack("<fff", 0.0, 1.0, value)
        if self.udp:
            data = _PACKET.pack(2 + len(body), self._id, 11) + body
            self.network.datagram((self.host.name, 11000), self.address, data)
        else:
            self.send(11, body)

    def mode(self, number: int) -> None:
        self.world.note(self.name, "gives mode", number)
        self.send(10, struct.pack("<i", number))


class AlfHq(HqProgram):
    """An HQ program of ALF, text: repeats its command every 20 ms while it drives."""

    protocol = "alf"

    @property
    def every_s(self) -> float:  # type: ignore[override]
        return 0.04 if self.value_now else 0.1

    def greet(self, end: End) -> None:
        self.after(0.1, self.established)

    def read(self, end: End) -> None:
        data = end.read(65536)
        if b"255|1;" in data:
            self.lost(end)

    def send_motion(self, value: float) -> None:
        if self.end is not None:
            self.end.send(b"3|%d|0|%d|0;" % (round(value * 255), 0 if value else self.options.get("deflected", 0)))


class WebotsHq(HqProgram):
    """An external controller (WC2EC): sets two wheels."""

    every_s = 0.2
    protocol = "wc2ec"

    def greet(self, end: End) -> None:
        self._wheels: dict[bytes, bytes] = {}
        self.after(0.3, self.established)

    def read(self, end: End) -> None:
        """Read registrations and values."""
        self._buffer += end.read(65536)
        while len(self._buffer) >= 4:
            size = 4 + self._buffer[3] if self._buffer[0] == 0 else 11
            if len(self._buffer) < size:
                return
            if self._buffer[0] == 0 and self._buffer[4:size] in (b"left", b"right"):
                self._wheels[self._buffer[4:size]] = self._buffer[1:3]
            self._buffer = self._buffer[size:]

    def send_motion(self, value: float) -> None:
        if self.end is not None:
            for name, wheel in tuple(self._wheels.items()):
                rests = name == b"left" and self.options.get("one")
                self.end.send(b"\x82" + wheel + struct.pack("<d", 0.0 if rests else value * WHEEL_FULL))


HQ_PROGRAMS = {"tcpudp": TcpUdpHq, "alf": AlfHq, "wc2ec": WebotsHq}
