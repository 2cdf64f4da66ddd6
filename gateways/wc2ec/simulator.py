"""A simulated Webots robot, in either dialect: two wheels, a lift, a ring of distance sensors, or light sensors.

Deterministic with a seed: the same commands at the same times give the same world. Source: the dialects of the protocol
page.
"""

from __future__ import annotations

import asyncio
import logging
import math
import random

import numpy as np

from gateways.wc2ec.messages import (
    ChangeSensor,
    Dialect,
    DisableSensor,
    EnableSensor,
    RegisterSensor,
    SensorData,
    SetSensor,
    SetValue,
    Wc2EcMessage,
)
from gateways.wc2ec.session import ControllerRole
from zbridge.protocol import EncodeError, Refused, Simulation, State
from zbridge.simulation.world import Body, cast
from zbridge.transport.conversation import Accepted, Conversation
from zbridge.transport.link import Link
from zbridge.transport.tcp import listen

log = logging.getLogger("gateways.wc2ec.simulator")

STEP_S = 0.02
WHEEL_RADIUS_M, TRACK_M = 0.05, 0.3
FASTEST_RAD_S = 20.0
LIFT_M_S = 0.1
RANGE_M = 1.0
FULL = 1000.0
"""A distance sensor's value at the end of its range."""
VALUES = 3
"""Configuration values of a light sensor: gain, offset, and an unused one."""
LAMP = (2.0, -2.0, 50.0)
"""Position of the lamp (m), and its irradiance at a metre."""
_DISTANCE, _LINEAR, _ROTATIONAL, _LIGHT = 37, 46, 53, 0
_RING = 8
_LIGHTS = 4
_LEFT, _RIGHT, _LIFT = _RING, _RING + 1, _RING + 2
_BEARINGS = np.arange(_RING) * 2 * math.pi / _RING
DEVICES = (
    *(RegisterSensor(_DISTANCE, number, b"ds%d" % number) for number in range(_RING)),
    RegisterSensor(_ROTATIONAL, _LEFT, b"left wheel"),
    RegisterSensor(_ROTATIONAL, _RIGHT, b"right wheel"),
    RegisterSensor(_LINEAR, _LIFT, b"lift"),
)


class Machine:
    """The simulated robot: obeys commands, moves, senses. Knows no connection."""

    def __init__(self, seed: int) -> None:
        rng = random.Random(seed)
        self.body = Body(rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3))
        self.velocities = {_LEFT: 0.0, _RIGHT: 0.0}
        self.lift_m = 0.0
        self.settings = {number: [1.0, 0.0, 0.0] for number in range(_LIGHTS)}
        self.enabled: set[int] = set()
        self._lift_to_m = 0.0

    def __repr__(self) -> str:
        return f"<Machine {self.body} wheels {self.velocities}>"

    def take(self, message: Wc2EcMessage) -> None:
        """Obey one command of an external controller."""
        match message:
            case SetValue(number=number, value=value) if number in self.velocities and math.isfinite(value):
                self.velocities[number] = max(-FASTEST_RAD_S, min(FASTEST_RAD_S, value))
            case SetValue(number=number, value=value) if number == _LIFT and math.isfinite(value):
                self._lift_to_m = value
            case EnableSensor(number=number) if number in self.settings:
                self.enabled.add(number)
            case DisableSensor(number=number):
                self.enabled.discard(number)
            case ChangeSensor(number=number, index=index, value=value) if number in self.settings and index < VALUES:
                self.settings[number][index] = value
            case SetSensor(number=number, values=values) if number in self.settings:
                self.settings[number] = values.tolist()

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        left, right = self.velocities[_LEFT] * WHEEL_RADIUS_M, self.velocities[_RIGHT] * WHEEL_RADIUS_M
        self.body.step((left + right) / 2, 0.0, (right - left) / TRACK_M, dt)
        way = self._lift_to_m - self.lift_m
        self.lift_m += max(-LIFT_M_S * dt, min(LIFT_M_S * dt, way))

    def distances(self) -> list[SensorData]:
        """Read the distance sensors: 0 at the sensor, FULL at the end of the range."""
        ranges = cast(self.body.x, self.body.y, self.body.heading + _BEARINGS, RANGE_M)
        return [SensorData(_DISTANCE, number, value) for number, value in enumerate((ranges / RANGE_M * FULL).tolist())]

    def lights(self) -> list[SensorData]:
        """Read the enabled light sensors: irradiance times gain plus offset."""
        x, y, power = LAMP
        readings = []
        for number in sorted(self.enabled):
            angle = self.body.heading + number * math.pi / 2
            away = math.hypot(x - self.body.x - 0.1 * math.cos(angle), y - self.body.y - 0.1 * math.sin(angle))
            gain, offset, _ = self.settings[number]
            readings.append(SensorData(_LIGHT, number, power / (away * away + 0.01) * gain + offset))
        return readings


class Simulator:
    """Serves one machine to the external controllers that connect."""

    def __init__(self, seed: int, dialect: Dialect) -> None:
        self.machine = Machine(seed)
        self._dialect = dialect
        self._peers: set[Conversation] = set()
        self._loop = asyncio.get_running_loop()

    def __repr__(self) -> str:
        return f"<Simulator {self.machine}>"

    async def run(self, simulation: Simulation) -> None:
        """Listen and simulate until cancelled."""
        (wanted,) = simulation.addresses
        async with listen(wanted, lambda: Accepted(self._admit)) as address:
            simulation.ready((address,))
            await self._live()

    def _admit(self, link: Link) -> Conversation:
        session = ControllerRole(self._dialect, values=VALUES)
        session.name = f"controller {link.peer}"
        conversation = Conversation(session, self._loop, deliver=self._deliver)
        conversation.ended.add_done_callback(lambda _: self._peers.discard(conversation))
        log.info("%s: connected", link.peer)
        self._loop.call_soon(self._greet, conversation)
        return conversation

    def _greet(self, conversation: Conversation) -> None:
        """Register the devices; from then on send their data."""
        if self._dialect is Dialect.DEPLOYED:
            _send(conversation, list(DEVICES))
        if not conversation.ended.done():
            self._peers.add(conversation)

    def _deliver(self, messages: list[Wc2EcMessage]) -> None:
        for message in messages:
            self.machine.take(message)

    async def _live(self) -> None:
        due = self._loop.time()
        while True:
            due = max(due + STEP_S, self._loop.time() - 1.0)
            await asyncio.sleep(due - self._loop.time())
            self.machine.step(STEP_S)
            sensed = self.machine.distances() if self._dialect is Dialect.DEPLOYED else self.machine.lights()
            for conversation in tuple(self._peers):
                _send(conversation, sensed)


def _send(conversation: Conversation, messages: list[SensorData] | list[RegisterSensor]) -> None:
    if conversation.session.state is State.ESTABLISHED:
        try:
            for message in messages:
                conversation.session.send(message)
        except (Refused, EncodeError) as error:
            log.debug("%s: not sent, %s", conversation.session.name, error)
        conversation.pump()


async def simulate(simulation: Simulation) -> None:
    """Run a simulated robot until cancelled."""
    await Simulator(simulation.seed, Dialect(simulation.dialect or "deployed")).run(simulation)
