"""What the operator of an HQ program does; the judge decides when and how that is sent ("Versions and dialects")."""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

from gateways.tcpudp.conformance import parser as wire
from zbridge.simulation.hq_program import HqProgram


class OperatorProgram(HqProgram):
    """The sticks and buttons of an HQ program."""

    def __init__(self) -> None:
        super().__init__()
        self._stick, self._joystick = (wire.STOP, b""), False

    @abstractmethod
    def send(self, kind: int, body: bytes = b"") -> None:
        """Send a packet."""

    def mode(self, value: Literal[1, 2, 3]) -> None:
        """Send 10: 1 none, 2 joystick, 3 AI."""
        self.send(wire.MODE, struct.pack("<i", value))

    def move(self, x: float, y: float, speed: float = 1.0) -> None:
        """Hold the stick in a direction: 11, at once and repeated."""
        self._hold(wire.MOVE, struct.pack("<3f", x, y, speed))

    def rotate(self, speed: float) -> None:
        """Hold the turning stick: 12, + right, at once and repeated."""
        self._hold(wire.ROTATE, struct.pack("<f", speed))

    def idle(self) -> None:
        """Let the stick go: 13, at once and repeated."""
        self._hold(wire.STOP, b"")

    stop = idle

    def move_ai(self, body: bytes) -> None:
        """Send 21."""
        self.send(wire.MOVE_AI, body)

    def ask_map(self) -> None:
        """Send 52."""
        self.send(wire.GET_MAP)

    def ask_position(self) -> None:
        """Send 54."""
        self.send(wire.GET_POSITION)

    def lidar(self, on: bool) -> None:
        """Send 50."""
        self.send(wire.LIDAR_MODE, struct.pack("<i", 1 if on else 2))

    def say(self, text: str) -> None:
        """Send 1."""
        self.send(wire.DEBUG, wire.string(text))

    def chat(self, body: bytes) -> None:
        """Send 40."""
        self.send(wire.CHAT, body)

    def feed(self, ranges: Sequence[float]) -> None:
        """Send 61, simulated lidar data."""
        self.send(wire.SCAN, struct.pack(f"<i{len(ranges)}f", len(ranges), *ranges))

    async def neutral(self) -> None:
        if not self._joystick:
            self._joystick = True
            self.mode(2)  # joystick ("Versions and dialects")
        self.idle()

    async def push(self, forward: float, turn: float) -> None:
        """Push one of the two sticks: the one that is pushed further (11, 12)."""
        if abs(forward) >= abs(turn):
            self.move(0.0, 1.0 if forward >= 0 else -1.0, abs(forward))
        else:
            self.rotate(-turn)

    def _hold(self, kind: int, body: bytes) -> None:
        self._stick = (kind, body)
        self.send(kind, body)
