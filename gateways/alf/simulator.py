"""A simulated ALF vehicle: steers like a car, measures the small world with its laser, stops when nobody drives it.

It speaks either dialect, on one port or two. Deterministic with a seed: the same commands at the same times give
the same world. Source: the message table and "Dialect `text`" of the protocol page.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import random
from collections.abc import Callable

import numpy as np

from gateways.alf.messages import AlfMessage, Dialect, DriveCommand, DriveInfo, Measurement, ScannerInit
from gateways.alf.session import VehicleRole
from gateways.alf.translate import DRIVE, LASER
from zbridge.protocol import EncodeError, Refused, Simulation, State
from zbridge.simulation.world import Body, cast
from zbridge.transport.conversation import Accepted, Conversation
from zbridge.transport.link import Link, Receiver
from zbridge.transport.tcp import listen

log = logging.getLogger("gateways.alf.simulator")

STEP_S = 0.02
SPEED_M_S = 1.0
"""Speed over ground at 100 percent."""
WHEELBASE_M = 0.35
LOCK_RAD = math.radians(30.0)
"""Steering angle at full lock."""
ACCELERATION_M_S2 = 2.0
SILENT_CYCLES = 20
"""Cycles without a drive command after which the motor stops."""
SCANNER = ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600)
POINTS, FIRST_VALID, LAST_VALID = 769, 44, 725
NOISE_MM = 5.0
STANDARD_GRAVITY = 9.80665
TEMPERATURE = 36.5
_SCAN_EVERY, _INFO_EVERY = 5, 50
_ANGLES = np.radians(SCANNER.angle_min_deg + SCANNER.angle_increment_deg * np.arange(POINTS))
_FULL_LOCK_DEG = 90
_MOST_SPEED, _MOST_TEXT_SPEED = 100, 255


class Car:
    """The simulated vehicle: obeys commands, moves, measures. Knows no connection."""

    def __init__(self, seed: int, dialect: Dialect) -> None:
        rng = random.Random(seed)
        self.body = Body(rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3), radius=0.25)
        self.light = False
        self.speed_m_s = 0.0
        self._dialect = dialect
        self._noise = np.random.default_rng(seed)
        self._wanted_m_s = 0.0
        self._wheels_rad = 0.0
        self._silent = 0
        self._sequence = 0
        self._clock_ms = 0
        self._acceleration = 0.0
        self._turn_rad_s = 0.0

    def __repr__(self) -> str:
        return f"<Car {self.body} at {self.speed_m_s:.2f} m/s>"

    def take(self, command: DriveCommand) -> None:
        """Obey a drive command."""
        straight = _FULL_LOCK_DEG if self._dialect is Dialect.BINARY else 0
        right_deg = max(-_FULL_LOCK_DEG, min(_FULL_LOCK_DEG, command.steering - straight))
        most = _MOST_SPEED if self._dialect is Dialect.BINARY else _MOST_TEXT_SPEED
        speed = min(most, command.speed) / _MOST_SPEED * SPEED_M_S
        self._wanted_m_s = -speed if command.direction else speed
        self._wheels_rad = -right_deg / _FULL_LOCK_DEG * LOCK_RAD
        self.light = command.light
        self._silent = 0

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds: Ackermann steering, limited acceleration, walls."""
        self._clock_ms += round(dt * 1000)
        self._silent += 1
        wanted = self._wanted_m_s if self._silent <= SILENT_CYCLES else 0.0
        change = max(-ACCELERATION_M_S2 * dt, min(ACCELERATION_M_S2 * dt, wanted - self.speed_m_s))
        self.speed_m_s += change
        self._acceleration = change / dt
        self._turn_rad_s = self.speed_m_s / WHEELBASE_M * math.tan(self._wheels_rad)
        self.body.step(self.speed_m_s, 0.0, self._turn_rad_s, dt)
        if self.body.blocked:
            self.speed_m_s = 0.0

    def measure(self) -> Measurement:
        """Sweep with the laser: mm, 0 for no measurement."""
        self._sequence += 1
        range_max = SCANNER.range_max_mm / 1000
        ranges = cast(self.body.x, self.body.y, self.body.heading + _ANGLES, range_max)
        noise = self._noise.normal(0.0, NOISE_MM, POINTS)
        points = np.where(ranges < range_max, np.rint(ranges * 1000 + noise), 0).astype(np.int64)
        points[:FIRST_VALID] = points[LAST_VALID + 1 :] = 0
        return Measurement(self._sequence, self._clock_ms, np.maximum(points, 0), FIRST_VALID, LAST_VALID)

    def info(self) -> DriveInfo:
        """Describe the motion, in the units of the dialect."""
        g, degrees = STANDARD_GRAVITY, math.degrees(self._turn_rad_s)
        lateral = -self.speed_m_s * self._turn_rad_s / g
        values = (self._acceleration / g, lateral, 1.0, 0.0, 0.0, degrees)
        if self._dialect is Dialect.BINARY:
            values = tuple(round(value * (1000 if place < 3 else 10)) for place, value in enumerate(values))  # type: ignore[assignment]
        return DriveInfo(round(abs(self.speed_m_s) / SPEED_M_S * _MOST_SPEED), *values, TEMPERATURE)


class Simulator:
    """Serves one car on its ports: the first drives, the last measures."""

    def __init__(self, seed: int, dialect: Dialect) -> None:
        self.car = Car(seed, dialect)
        self._dialect = dialect
        self._peers: dict[str, set[Conversation]] = {DRIVE: set(), LASER: set()}
        self._loop = asyncio.get_running_loop()

    def __repr__(self) -> str:
        return f"<Simulator {self.car}>"

    async def run(self, simulation: Simulation) -> None:
        """Listen and simulate until cancelled; then send END."""
        parts = [{DRIVE}, {LASER}] if len(simulation.addresses) > 1 else [{DRIVE, LASER}]
        async with contextlib.AsyncExitStack() as stack:
            addresses = [
                await stack.enter_async_context(listen(address, self._accepting(part)))
                for address, part in zip(simulation.addresses, parts, strict=True)
            ]
            simulation.ready(tuple(addresses))
            try:
                await self._live()
            finally:
                for conversation in set().union(*self._peers.values()):
                    conversation.close("simulator ended")

    def _accepting(self, parts: set[str]) -> Callable[[], Receiver]:
        return lambda: Accepted(lambda link: self._admit(link, parts))

    def _admit(self, link: Link, parts: set[str]) -> Conversation:
        session = VehicleRole(self._dialect)
        session.name = f"hq {link.peer}"
        conversation = Conversation(session, self._loop, deliver=self._deliver)
        log.info("%s: connected for %s", link.peer, " and ".join(sorted(parts)))
        self._loop.call_soon(self._greet, conversation, parts)
        return conversation

    def _greet(self, conversation: Conversation, parts: set[str]) -> None:
        """Describe the scanner; from then on send measurements."""
        if LASER in parts:
            _send(conversation, SCANNER)
        for part in () if conversation.ended.done() else parts:
            self._peers[part].add(conversation)
            conversation.ended.add_done_callback(lambda _, peers=self._peers[part]: peers.discard(conversation))  # type: ignore[misc]

    def _deliver(self, messages: list[AlfMessage]) -> None:
        for message in messages:
            if isinstance(message, DriveCommand):
                self.car.take(message)

    def _tell(self, part: str, message: AlfMessage) -> None:
        for conversation in tuple(self._peers[part]):
            _send(conversation, message)

    async def _live(self) -> None:
        due, steps = self._loop.time(), 0
        while True:
            due = max(due + STEP_S, self._loop.time() - 1.0)
            await asyncio.sleep(due - self._loop.time())
            steps += 1
            self.car.step(STEP_S)
            if steps % _SCAN_EVERY == 0:
                self._tell(LASER, self.car.measure())
            if steps % _INFO_EVERY == 0:
                self._tell(DRIVE, self.car.info())


def _send(conversation: Conversation, message: AlfMessage) -> None:
    if conversation.session.state is State.ESTABLISHED:
        try:
            conversation.session.send(message)
        except (Refused, EncodeError) as error:
            log.debug("%s: not sent, %s", conversation.session.name, error)
        conversation.pump()


async def simulate(simulation: Simulation) -> None:
    """Run a simulated vehicle until cancelled."""
    await Simulator(simulation.seed, Dialect(simulation.dialect or "text")).run(simulation)
