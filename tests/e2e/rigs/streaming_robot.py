"""A robot that reports by itself and needs a pulse, in the process of its test: an ARCOS robot that notes what came.

``python -m tests.e2e.rigs.streaming_robot ENDPOINT``: a program that takes the lease of r1 and drives it until it is
killed.
"""

from __future__ import annotations

import asyncio
import itertools
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[3] / "docs" / "examples" / "arcos"))

from arcos.messages import Command, Do, Setting, read_command
from arcos.simulator import Arcos

import zbridge
from tests.ports import HOST, free_port
from zbridge.errors import NeutralFirst
from zbridge.protocol import ProtocolError, Simulation
from zbridge.protocol.address import Address
from zbridge.simulation import serve

FORWARD = 0.2
"""0.1 m/s: the walls of the room are 5 m away."""


@dataclass(frozen=True)
class Packet:
    """What the robot was sent. at: monotonic seconds."""

    at: float
    command: Command | Setting

    @property
    def number(self) -> int:
        return self.command.number

    @property
    def value(self) -> int:
        """The size of its integer, 0 if it has none."""
        return getattr(self.command, "size", 0)

    @property
    def moves(self) -> bool:
        return self.number in (Do.VEL, Do.RVEL) and self.value != 0

    @property
    def stops(self) -> bool:
        return self.number == Do.VEL and self.value == 0


class StreamingRobot(Arcos):
    """A simulated robot on a TCP port, on a thread of its own; it obeys although it is mute."""

    def __init__(self) -> None:
        super().__init__()
        self.port = free_port()
        self.packets: list[Packet] = []
        self.clients = 0
        """Connections so far."""
        self.mute = False
        """Whether what it sends is lost; the connection stays."""
        self._reported_at = 0.0
        self._loop = asyncio.new_event_loop()
        self._serving: asyncio.Task[None]
        listening = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(listening,), daemon=True)
        self._thread.start()
        assert listening.wait(10.0), "it does not listen"

    def _run(self, listening: threading.Event) -> None:
        simulation = Simulation((Address(HOST, self.port),), ready=lambda _: listening.set())
        self._serving = self._loop.create_task(serve(simulation, self))
        try:
            self._loop.run_until_complete(self._serving)
        except asyncio.CancelledError:
            self._loop.run_until_complete(asyncio.sleep(0.05))  # its clients are closed
        self._loop.close()

    def close(self) -> None:
        """End it."""
        self._loop.call_soon_threadsafe(self._serving.cancel)
        self._thread.join()

    # As its author made it, but observed

    def connected(self) -> bytes:
        self.clients += 1
        return super().connected()

    def receive(self, data: bytes) -> bytes:
        answers = super().receive(data)
        return b"" if self.mute else answers

    def step(self, dt: float) -> bytes:
        sent = super().step(dt)
        if sent:
            self._reported_at = time.monotonic()
        return b"" if self.mute else sent

    def _answer(self, packet: bytes) -> bytes:
        try:
            command: Any = read_command(packet)
        except ProtocolError:
            return super()._answer(packet)
        self.packets.append(Packet(time.monotonic(), command))
        return super()._answer(packet)

    # What a test asks

    @property
    def moving(self) -> bool:
        return any(self.truth().wheels_m_s)

    @property
    def between_reports(self) -> bool:
        """Whether what it sent last is read by now, and the next is not sent yet.

        Nobody can take over the connection of a process that dies within a read.
        """
        return 0.03 < time.monotonic() - self._reported_at < 0.06 or self.mute

    def since(self, at: float) -> list[Packet]:
        """Give what it was sent since then."""
        return [packet for packet in self.packets if packet.at >= at]

    def switched(self, since: float = 0.0) -> list[int]:
        """Give how its motors were switched."""
        return [packet.value for packet in self.since(since) if packet.number == Do.ENABLE]

    def count(self, number: int, since: float = 0.0) -> int:
        return sum(packet.number == number for packet in self.since(since))

    def longest_pause_s(self, number: int, since: float) -> float:
        """Give the longest time without this command, up to now."""
        times = [since, *(packet.at for packet in self.since(since) if packet.number == number), time.monotonic()]
        return max(later - earlier for earlier, later in itertools.pairwise(times))


def main() -> None:
    with zbridge.blocking.connect([sys.argv[1]]) as fleet, fleet["r1"].control("driver") as drive:
        print("drives", flush=True)
        while True:
            try:
                drive(forward=FORWARD)
            except NeutralFirst:  # a busy machine paused it, or its gateway
                drive.neutral()
            time.sleep(0.05)


if __name__ == "__main__":
    main()
