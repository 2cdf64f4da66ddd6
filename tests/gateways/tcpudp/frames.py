"""Packets written by hand after "Versions and dialects" of the protocol page, and a session on a clock of its own.

Nothing here encodes with the code under test.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from gateways.tcpudp.messages import Packet
from gateways.tcpudp.options import TcpUdpOptions
from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.translate import TcpUdpRobot
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.protocol.session import Datagram

LISTED = b"1.1,1.2,1.3"
LISTED_14 = LISTED + b",1.4"
ALL = "01010101010101"
"""UDP, Cam, Joystick, Chat, Lidar, LidarSim, SLAMMap."""
NO_UDP = "00010101010101"
SIZE_100_10 = "e8030000 0a000000"
"""SLAMMapSize 1000, SLAMMapIntervall 10: 100 cells along a side."""

START = bytes.fromhex("02000000 01 04")
PROBE = bytes.fromhex("02000000 05 05")
ANSWER_TRUE = bytes.fromhex("03000000 01 06 01")
ANSWER_FALSE = bytes.fromhex("03000000 01 06 00")
STATUS_TRUE = bytes.fromhex("03000000 05 07 01")
STATUS_FALSE = bytes.fromhex("03000000 05 07 00")
MOVE = bytes.fromhex("0e000000 05 0b 00000000 0000803f 0000003f")
ROTATE = bytes.fromhex("06000000 05 0c 000040bf")
STOP = bytes.fromhex("02000000 05 0d")
POSITION = bytes.fromhex("0e000000 01 37 0000c03f 000010c0 0000b442")


NAMED = {
    "4": START,
    "5": PROBE,
    "6+": ANSWER_TRUE,
    "6-": ANSWER_FALSE,
    "7+": STATUS_TRUE,
    "7-": STATUS_FALSE,
}
"""The packets of the handshake in scripts."""


def framed(sender: int, packet_id: int, body: bytes = b"") -> bytes:
    """``int32 length | u8 id | u8 packet id | body``."""
    return (2 + len(body)).to_bytes(4, "little") + bytes([sender, packet_id]) + body


def counted(text: bytes) -> bytes:
    """``int32 count | bytes``."""
    return len(text).to_bytes(4, "little") + text


def server_settings(versions: bytes = LISTED, block: str = ALL, client_id: int = 5) -> bytes:
    """Packet 2; the size of the map follows the seven flags of 1.3 where the block does not continue by itself."""
    flags = bytes.fromhex(block)
    size = bytes.fromhex(SIZE_100_10) if len(flags) == 7 else b""
    return framed(1, 2, bytes([client_id]) + counted(versions) + flags + size)


def client_settings(versions: bytes = LISTED, block: str = "01000000000100", sender: int = 5) -> bytes:
    """Packet 3; the flags of deployed 1.3 programs are UDP and LidarSim."""
    return framed(sender, 3, counted(versions) + bytes.fromhex(block))


def bearing(frame: bytes, sender: int) -> bytes:
    """The same frame with another id."""
    return frame[:4] + bytes([sender]) + frame[5:]


class Sent(NamedTuple):
    """One frame that left a session."""

    at: float
    by: str
    frame: bytes


class Timed:
    """A session whose timers fire when they are due, and what left it when and by which channel."""

    def __init__(self, session: HqRole | RobotRole, now: float = 0.0) -> None:
        self.session = session
        self.now = now
        self.sent: list[Sent] = []
        session.open(now)
        self._write()

    def until(self, now: float) -> None:
        """Let time pass: every timer fires at its time, and what may be written is."""
        for _ in range(10_000):
            self._write()
            due = self.session.deadline()
            if due is None or due > now:
                self.now = now
                return
            self.now = max(self.now, due)
            self.session.expire(self.now)
        raise AssertionError("a timer fires again and again")

    def stream(self, data: bytes, at: float) -> list[Packet]:
        """Let bytes come by TCP."""
        self.until(at)
        messages = self.session.receive(data, at)
        self._write()
        return messages

    def datagram(self, data: bytes, at: float) -> list[Packet]:
        """Let a datagram come."""
        self.until(at)
        messages = self.session.receive_datagram(data, at)
        self._write()
        return messages

    def come(self, *coming: tuple[float, str, bytes]) -> Timed:
        """Let frames come, each at its time and by its channel."""
        for at, by, data in coming:
            (self.stream if by == "tcp" else self.datagram)(data, at)
        return self

    def hear(self, script: str) -> Timed:
        """Let packets of the handshake come: "0.2 t4 0.3 u6+" is a 4 by TCP at 0.2 s, a 6(true) by UDP at 0.3 s."""
        words = script.split()
        for at, what in zip(words[::2], words[1::2], strict=True):
            self.come((float(at), "tcp" if what[0] == "t" else "udp", NAMED[what[1:]]))
        return self

    def told(self) -> str:
        """What left, as such a script."""
        names = {frame: name for name, frame in NAMED.items()}
        return " ".join(f"{sent.at:.1f} {sent.by[0]}{names.get(sent.frame, sent.frame[5])}" for sent in self.sent)

    def frames(self, by: str, start: float = -1.0, end: float = 1e9) -> list[bytes]:
        """What left by one channel from ``start`` up to but not at ``end``."""
        return [sent.frame for sent in self.sent if sent.by == by and start <= sent.at < end]

    def _write(self) -> None:
        while (frame := self.session.outgoing(self.now)) is not None:
            by = "udp" if type(frame) is Datagram else "tcp"
            self.sent.append(Sent(self.now, by, bytes(frame)))


class Stage:
    """A robot seen from its HQ, with a session that was established a second ago, and what leaves it."""

    def __init__(self, settings: bytes, options: TcpUdpOptions | None = None) -> None:
        self.robot = TcpUdpRobot(options or TcpUdpOptions())
        self.timed = self._connected(settings, 0.0)

    def connect(self, settings: bytes) -> None:
        """Lose the connection and connect again."""
        self.session.fail("closed by peer")
        self.timed = self._connected(settings, self.now)

    def hand_over(self) -> None:
        """Let another process take the robot over, with what this one describes."""
        session_state, robot_state = msgspec.msgpack.decode(
            msgspec.msgpack.encode([self.session.export(), self.robot.export()])
        )
        self.robot = TcpUdpRobot(self.robot.options)
        self.timed.session = session = self.robot.session("robot", "tcp://robot.test:1")
        session.restore(session_state)
        self.robot.restore(robot_state)

    def _connected(self, settings: bytes, now: float) -> Timed:
        timed = Timed(self.robot.session("robot", "tcp://robot.test:1"), now)
        timed.stream(settings, now)
        timed.until(now + 1.0)
        return timed

    @property
    def session(self) -> HqRole:
        assert isinstance(self.timed.session, HqRole)
        return self.timed.session

    def command(self, topic: Topic, command: FleetMessage) -> str | None:
        """Command the robot; give what was left out."""
        return self.robot.command(topic, command, self.now).left_out

    def after(self, seconds: float) -> list[bytes]:
        """Let time pass; give what left meanwhile."""
        before = len(self.timed.sent)
        self.timed.until(self.timed.now + seconds)
        return [sent.frame for sent in self.timed.sent[before:]]

    def told(self, *frames: bytes, stamp_ns: int = 7) -> list[tuple[Topic, FleetMessage]]:
        """What the translation makes of the last of what the robot sends."""
        telemetry: list[tuple[Topic, FleetMessage]] = []
        for frame in frames:
            (message,) = self.session.receive(frame, self.now)
            telemetry = list(self.robot.telemetry(message, stamp_ns))
        return telemetry

    @property
    def now(self) -> float:
        return self.timed.now
