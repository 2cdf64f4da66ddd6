"""A simulated Webots robot, written from the protocol page alone; see :mod:`tests.simulated.robots`."""

from __future__ import annotations

import struct
from typing import Any

from tests.simulated.engine import Host
from tests.simulated.net import End, Network
from tests.simulated.robots import SimRobot


class WebotsRobot(SimRobot):
    """A Webots controller (WC2EC, deployed): two wheels, a distance sensor. It exits with its client, and restarts."""

    telemetry_s = 0.25

    def __init__(self, host: Host, name: str, network: Network, port: int, options: dict[str, Any]) -> None:
        super().__init__(host, name, network, port, options)
        self.lossless = True
        self._free_at = 0.0
        self._bytes = b""
        self._motors = {0: b"left", 1: b"right"} | ({3: b"arm"} if options.get("arm") else {})
        self._wheels = dict.fromkeys(self._motors, 0.0)

    def may_accept(self) -> bool:
        return super().may_accept() and not self.ends and self.world.now >= self._free_at

    def left(self, end: End) -> None:
        self._free_at = self.world.now + self.rng.uniform(1.0, 3.0)
        self._bytes, self._wheels = b"", dict.fromkeys(self._motors, 0.0)
        self.drive(0.0)  # the controller is gone, and the simulation with it

    def greet(self, end: End) -> None:
        for number, name in sorted({**self._motors, 2: b"ds0"}.items()):
            end.send(bytes([0, 37 if number == 2 else 53, number, len(name)]) + name)

    def tell(self, end: End) -> None:
        self.put(end, bytes([1, 37, 2]) + struct.pack("<d", self.told + 1))

    def read(self, end: End) -> None:
        if end not in self.ends:
            return
        self._bytes += end.read(65536)
        while len(self._bytes) >= 11:
            command, _, number = self._bytes[:3]
            if command != 130 or number not in self._wheels:
                self.crash(f"command {command} to device {number}")
                return
            self._wheels[number] = struct.unpack("<d", self._bytes[3:11])[0]
            self._bytes = self._bytes[11:]
            value = max(map(abs, self._wheels.values()))
            self.heard("motion" if value else "stop", value, "tcp", end)
            self.drive(value)
