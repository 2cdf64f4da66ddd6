"""A robot of the TCP/UDP package protocol to play with: moves, measures walls, builds a map, answers every packet.

It speaks any version, with or without UDP. Deterministic with a seed: the same packets at the same times give the
same world. Source: "Versions and dialects" and "Translation from the robot" of the protocol page.
"""

from __future__ import annotations

import logging
import math
import random

import msgspec
import numpy as np

from gateways.tcpudp import messages as packets
from gateways.tcpudp.session import limits
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.settings import ROBOT_BLOCKS, VERSIONS, Feature, RobotSettings13, Settings
from zbridge.protocol import ClientIds, Session, Truth
from zbridge.simulation.simulator import STEP_S, Simulator
from zbridge.simulation.world import Body, Grid, cast
from zbridge.transport import Conversation

log = logging.getLogger("gateways.tcpudp.simulator")

SPEED_M_S = 0.5
"""Speed over ground at packet speed 1."""
TURN_RAD_S = 1.0
"""Rate of turn at packet speed 1."""
SILENCE_S = 1.0
"""Legacy simulators stop by themselves after so long without 11, 12 or 13."""
UNIT_M = 0.01
CELL = 10
"""Side of a map cell in the robot's unit."""
SIDE = 100
"""Cells along a side of the map."""
LIDAR_RANGE_M = 4.0
_DEGREES = np.radians(np.arange(360.0))
_POSE_EVERY, _MAP_EVERY, _ASK_EVERY = 5, 50, 50
CLIENTS = range(2, 256)
QUIET_S = 2.0
"""Seconds before a client id is given again ("Limits of a listener" in ``translation.md``)."""
PARTS = 4
"""Packets in which a robot of version "1.4" sends its map, one a second, again and again; legacy ones make 4096."""


def settings_of(version: str, *, udp: bool) -> Settings:
    """Return what a simulated robot of a version announces: every flag its version has."""
    block = ROBOT_BLOCKS.get(version, RobotSettings13)
    flags: dict[str, int] = {feature.value: True for feature in Feature if hasattr(block, feature.value)}
    if block is RobotSettings13:
        flags |= {"slam_map_size": SIDE * CELL, "slam_map_interval": CELL}
    return msgspec.convert({**flags, "udp": udp}, block)


class Vehicle:
    """The robot itself: what packets make it do, and what it measures. Knows no connection."""

    def __init__(self, seed: int) -> None:
        rng = random.Random(seed)
        self.body = Body.somewhere(rng, heading=math.pi / 2)
        self.grid = Grid(SIDE, CELL * UNIT_M)
        self.mode = 1
        self.lidar = True
        self._rng = rng
        self._motion = (0.0, 0.0, 0.0)
        self._idle_s = 0.0

    def __repr__(self) -> str:
        return f"<Vehicle {self.body} moving {self._motion}>"

    @property
    def moving(self) -> bool:
        return any(self._motion)

    def step(self, dt: float) -> None:
        self._idle_s += dt
        if self._idle_s > SILENCE_S:
            self._motion = (0.0, 0.0, 0.0)
        self.body.step(*self._motion, dt)

    def sweep_lidar(self) -> None:
        """Enter one sweep of its own lidar into the map."""
        angles = self.body.heading + _DEGREES
        ranges = cast(self.body.x, self.body.y, angles, LIDAR_RANGE_M)
        noise = np.array([self._rng.gauss(0.0, 0.005) for _ in range(len(ranges))])
        self.grid.see(self.body.x, self.body.y, angles, ranges + noise * (ranges < LIDAR_RANGE_M), LIDAR_RANGE_M)

    def position(self) -> packets.ServerPosition:
        """Return its place: x, y in its unit, heading in degrees with 0 along y."""
        heading_deg = math.degrees(self.body.heading - math.pi / 2)
        return packets.ServerPosition(self.body.x / UNIT_M, self.body.y / UNIT_M, heading_deg)

    def map(self) -> packets.ServerSLAMMap:
        """Return the map, x-major."""
        return packets.ServerSLAMMap(self.grid.cells.tobytes())

    def take(self, message: packets.Packet) -> tuple[packets.Packet, ...]:
        """Obey or answer one packet of an HQ."""
        match message:
            case packets.ClientJoystickMove():
                self._move(message.y * message.speed * SPEED_M_S, -message.x * message.speed * SPEED_M_S, 0.0)
            case packets.ClientJoystickRotate():
                self._move(0.0, 0.0, -message.speed * TURN_RAD_S)
            case packets.ClientJoystickStop():
                self._move(0.0, 0.0, 0.0)
            case packets.ClientControllMode():
                self.mode = message.mode
            case packets.ClientLidarMode():
                self.lidar = message.mode == 1
                return (packets.ServerLidarStatus(1 if self.lidar else 2),)
            case packets.ClientGetPosition():
                return (self.position(),)
            case packets.ClientGetSLAMMap():
                return (self.map(),)
            case packets.DebugMessage():
                return (packets.DebugMessage(f"echo: {message.text}"),)
            case packets.ChatMessage():
                return (message,)
            case packets.ClientMoveAI():
                return (packets.DebugMessage("clientMoveAI taken"),)
            case packets.ClientSimulatedLidarData():
                self._see(message)
        return ()

    def _move(self, forward: float, left: float, turn: float) -> None:
        """Take a speed over ground and a rate of turn, as far as the motors go."""
        finite = all(math.isfinite(value) for value in (forward, left, turn))
        scale = max(math.hypot(forward, left) / SPEED_M_S, abs(turn) / TURN_RAD_S, 1.0)
        self._motion = (forward / scale, left / scale, turn / scale) if finite else (0.0, 0.0, 0.0)
        self._idle_s = 0.0

    def _see(self, message: packets.ClientSimulatedLidarData) -> None:
        ranges = message.ranges.astype(np.float64) * UNIT_M
        if len(ranges) == len(_DEGREES):
            known = np.isfinite(ranges) & (ranges > 0)
            angles = (self.body.heading + _DEGREES)[known]
            self.grid.see(self.body.x, self.body.y, angles, ranges[known], LIDAR_RANGE_M)


class RobotSimulator(Simulator[packets.Packet]):
    """Serves one vehicle to the HQ programs that connect."""

    def __init__(self, seed: int, version: str = "1.3", *, udp: bool = False) -> None:
        super().__init__(log, datagrams=udp)
        self.vehicle = Vehicle(seed)
        self.body = self.vehicle.body
        self.vehicle.sweep_lidar()
        self._versions = VERSIONS[version].listed.split(",")
        self._settings = settings_of(version, udp=udp)
        self._parts = version == "1.4"
        self._ids = ClientIds(CLIENTS, QUIET_S)

    def session(self, peer: str, link: str) -> RobotRole | None:
        client_id = self._ids.take(self._loop.time())
        if client_id is None:
            return None
        session = RobotRole(limits(0.0), self._settings, client_id, self._versions)
        session.name = f"hq {client_id}"
        return session

    def truth(self) -> Truth:
        body = self.vehicle.body
        return Truth(body.x, body.y, body.heading, neutral=not self.vehicle.moving)

    def dismiss(self, client: Conversation) -> None:
        assert isinstance(client.session, RobotRole)
        self._ids.release(client.session.client_id, self._loop.time())

    def check(self, session: Session[packets.Packet], message: packets.Packet) -> None:
        """Refuse what the HQ does not know; legacy robots send parts of the map without that check."""
        assert isinstance(session, RobotRole)
        if not isinstance(message, packets.ServerSLAMMapPart):
            session.may_send(message)

    def take(self, client: Conversation, message: packets.Packet) -> None:
        """Let the vehicle obey and answer; the handler of 52 is empty in robots that send parts."""
        if not (self._parts and isinstance(message, packets.ClientGetSLAMMap)):
            for answer in self.vehicle.take(message):
                self.send(client, answer)

    def step(self, steps: int) -> None:
        self.vehicle.step(STEP_S)
        if steps % _POSE_EVERY == 0:
            self.tell(self.vehicle.position())
        if steps % _MAP_EVERY == 0:
            if self.vehicle.lidar:
                self.vehicle.sweep_lidar()
            if self._parts:
                self._send_part(steps // _MAP_EVERY)
            else:
                self.tell(self.vehicle.map())
        if steps % _ASK_EVERY == _ASK_EVERY // 2:
            self.tell(packets.ServerGetSimulatedLidarData())
        if steps == _ASK_EVERY:
            self.tell(packets.ServerCamMode(2))
            self.tell(packets.ServerLidarStatus(1))

    def _send_part(self, number: int) -> None:
        """Send a part of the map to every HQ that announced LidarSim, as legacy robots do."""
        cells = self.vehicle.grid.cells.tobytes()
        size = -(-len(cells) // PARTS)
        start = number % PARTS * size
        part = packets.ServerSLAMMapPart(start, min(start + size, len(cells)), cells[start : start + size])
        for client in self.clients():
            if Feature.LIDAR_SIM.value in client.session.features:
                self.send(client, part)
