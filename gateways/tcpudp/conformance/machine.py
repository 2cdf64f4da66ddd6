"""The simulated robot of the judge: it moves, sees and talks ("Versions and dialects", "Translation from the robot").

Sans-IO: no clock.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Collection, Iterator
from random import Random

import msgspec
import numpy as np

from gateways.tcpudp.conformance import parser as wire
from gateways.tcpudp.conformance.parser import CELL_CM, SIDE, FeatureFlag, packet, string
from zbridge.simulation.world import Body, Grid, cast

_SPEED_M_S, _TURN_RAD_S = 0.5, 1.0
_RANGE_M = 8.0
_PROGRAM = (0.2, 0.0, 0.3)
"""How the robot's own program drives: m/s forward and left, rad/s."""


class Loss(enum.Enum):
    """Which datagram of the UDP probe gets lost."""

    NOTHING = enum.auto()
    PROBE = enum.auto()
    ANSWER = enum.auto()


class Quirks(msgspec.Struct, frozen=True, kw_only=True):
    """What one robot does otherwise than the others of its version."""

    client_id: int | None = None
    """The id that it gives its first HQ; None: seeded."""
    obeys: Collection[FeatureFlag] = ()
    """Features whose packets it has registered without announcing them (``options.force``)."""
    loss: Loss = Loss.NOTHING
    parts: int = 4096
    """Parts of a "1.4" map."""
    side: int = SIDE
    """Cells along a side of the map."""
    misnamed: float = 0.25
    """The fraction of positions sent as id 53."""
    misread: float = 0.0
    """The fraction of packets dropped after the handshake, chosen for each packet id by itself."""
    again: bool = False
    """It serves a connection after the first, which loses half of all packets in both directions and gets no telemetry
    ("Signs of a poor connection")."""


class JudgedRobot:
    """One robot; ``random`` seeds what it sends. ``side``: cells along a side of its map."""

    def __init__(self, random: Random, side: int = SIDE) -> None:
        self.place = Body()
        self.lidar_on = self.camera_on = False
        self._random = random
        self._drive = (0.0, 0.0, 0.0)
        self._on_its_own = False
        grid, angles = Grid(side, CELL_CM / 100), np.radians(np.arange(360.0))
        grid.see(0.0, 0.0, angles, cast(0.0, 0.0, angles, _RANGE_M), _RANGE_M)
        self._map = grid.cells.tobytes()

    def steer(self, body: bytes) -> None:
        """Take a body of 11 (12 bytes), 12 (4), 13 (none): y forward, x right, + right ("Translation of commands")."""
        if self._on_its_own:
            return
        x, y, speed = struct.unpack("<3f", body) if len(body) == 12 else (0.0, 0.0, 0.0)
        turn = struct.unpack("<f", body)[0] if len(body) == 4 else 0.0
        speed, turn = (min(max(value, -1.0), 1.0) for value in (speed, turn))
        self._drive = (y * speed * _SPEED_M_S, -x * speed * _SPEED_M_S, -turn * _TURN_RAD_S)

    def choose(self, body: bytes) -> None:
        """Take the body of 10: in mode 3 the robot's own program drives, despite any 13.

        When it ends, the motors keep running: only a 13 after it stops them.
        Source: "Stops are repeated" in ``fragile-robots.md``.
        """
        self._on_its_own = body[0] == 3
        if self._on_its_own:
            self._drive = _PROGRAM

    @property
    def moving(self) -> bool:
        """Whether the robot moves: it never stops by itself."""
        return any(self._drive)

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds as steered, in mode 3 as the robot's own program wants."""
        if self._on_its_own:
            self._drive = _PROGRAM
        self.place.step(*self._drive, dt)

    def body(self, kind: int) -> bytes:
        """Return a packet's body for the robot as it is ("Versions and dialects", "Translation from the robot")."""
        if kind == wire.DEBUG:
            return string(f"battery {self._random.randint(0, 100)} %")
        if kind == wire.CHAT:
            return self._random.randbytes(self._random.randint(1, 40))
        if kind == wire.CAMERA:
            self.camera_on = not self.camera_on
            return struct.pack("<i", 1 if self.camera_on else 2)
        if kind == wire.LIDAR_STATUS:
            return struct.pack("<i", 1 if self.lidar_on else 2)
        if kind == wire.POSITION:  # centimetres; heading = radians(h) + pi/2
            degrees = math.degrees(self.place.heading - math.pi / 2)
            return struct.pack("<3f", self.place.x * 100, self.place.y * 100, degrees)
        return struct.pack("<i", len(self._map)) + self._map if kind == wire.MAP else b""

    def parts(self, count: int) -> Iterator[bytes]:
        """Return the bodies of the map's parts; the last runs past the map's end ("Translation from the robot")."""
        size = len(self._map) // count + 1
        for start in range(0, len(self._map), size):
            yield struct.pack("<ii", start, start + size) + self._map[start : start + size].ljust(size, b"\0")

    def unasked(
        self, version: str, features: Collection[FeatureFlag], hq_features: Collection[FeatureFlag]
    ) -> Iterator[tuple[int, bytes]]:
        """Yield what the robot sends unasked, forever; once a debugMessage with two headers.

        An empty body: ask :meth:`body` for it when it is sent. Source: "Decisions where the document is silent".
        """
        due = [(wire.DEBUG, packet(wire.DEBUG, string("two headers")))]
        kinds = (
            [wire.DEBUG] + [wire.CAMERA] * (FeatureFlag.CAM in features) + [wire.CHAT] * (FeatureFlag.CHAT in features)
        )
        kinds += [wire.LIDAR_STATUS] * (FeatureFlag.LIDAR in features)
        if wire.maps(version, features):
            kinds += [wire.POSITION] + [wire.MAP] * (version != "1.4")
        kinds += [wire.GET_SCAN] * (FeatureFlag.LIDAR_SIM in features and FeatureFlag.LIDAR_SIM in hq_features)
        while True:
            due += [(kind, b"") for kind in kinds]
            self._random.shuffle(due)
            yield from due
            due = []
