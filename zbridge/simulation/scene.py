"""A scene for the tests of a protocol: its robot side and a simulated robot, without a link, in virtual time."""

from __future__ import annotations

import contextlib
from typing import Any

import msgspec

from zbridge.errors import NeutralFirst, NotReady, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Outcome, Protocol, RobotSide
from zbridge.protocol.session import Session, State
from zbridge.simulation.simulated import STEP_S, SimulatedRobot

PEER = "tcp://robot.test:1"
"""The address that sessions of a scene or a rehearsal are given."""
STOPPED_S = 1.0
"""Seconds for which the gateway repeats a stop."""
_NS_PER_S = 1_000_000_000


class Scene:
    """A protocol's robot side, as a gateway has it, connected to a simulated robot. Time passes in :meth:`run` only.

    As in a gateway, a robot that is not ready takes no command, one that becomes busy is stopped, and motion then needs
    neutral first. There is no lease, deadman or latch. options: ``[device.options]``; None: those that fit the
    simulated robot.
    """

    def __init__(self, protocol: Protocol, simulated: SimulatedRobot, options: dict[str, Any] | None = None) -> None:
        self._protocol = protocol
        self._options = msgspec.convert(protocol.simulated if options is None else options, protocol.options)
        self.robot: RobotSide = protocol.robot(self._options, 1, Metrics())
        self.simulated = simulated
        self.session: Session[Any]
        """The conversation; :meth:`connect` makes a new one."""
        self.now = 0.0
        """Seconds since the scene began; also the time that the stamps show, in ns."""
        self.shown: dict[str, FleetMessage] = {}
        """The newest telemetry, by the paths of its topics: ``pose``, ``sensor/front``."""
        self.written: list[bytes] = []
        """What the gateway's side wrote, frame by frame."""
        self._busy: str | None = None
        self._needs_neutral = self._leased = False
        self.answers = True
        """False: what the robot sends is lost, as by a cable that is cut in one direction."""
        self.connect()

    def __repr__(self) -> str:
        return f"<Scene at {self.now:g} s, {self.session!r}>"

    def connect(self) -> None:
        """Connect, for the first time or anew; the connection before is lost."""
        if self.robot.driving is not None:
            self.robot.driving.fail("closed by peer")
        self.session = self.robot.session(self.robot.link_names[0], PEER)
        self._greeted, self._busy = False, None
        self._needs_neutral = self.now > 0.0
        self.session.open(self.now)
        self._hear(self.simulated.connected())

    def establish(self, within_s: float = 10.0) -> None:
        """Let time pass until the session is established, and the stop that follows is over; raise TimeoutError."""
        until = self.now + within_s
        while self.session.state is not State.ESTABLISHED:
            if self.session.over or self.now >= until:
                raise TimeoutError(f"{self.session!r} after {self.now:g} s")
            self.run(STEP_S)
        self.run(STOPPED_S + STEP_S)

    def lease(self, on: bool) -> None:
        """Tell the robot side that a program has taken the lease, or that nobody has it any more."""
        self._leased = on
        self.robot.leased(on, self.now)

    def restart(self) -> None:
        """Let another process of the gateway take the connection over (``hands_over``)."""
        state = msgspec.msgpack.encode((self.robot.export(), self.session.export()))
        robot, session = msgspec.msgpack.decode(state)
        self.robot = self._protocol.robot(self._options, 1, Metrics())
        self.session = self.robot.session(self.robot.link_names[0], PEER)
        self.session.restore(session)
        self.robot.restore(robot)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            self._hear(self.simulated.step(STEP_S))
            self.session.expire(self.now)
            self._greet()
            self._follow_busy()
            while (frame := self.session.outgoing(self.now)) is not None:
                self.session.outbox.written(self.now)
                self.written.append(frame)
                self._hear(self.simulated.receive(frame))

    def drive(self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0) -> Outcome:
        """Command a drive, fractions of full scale; raise Refused."""
        return self.command(topics.CMD_DRIVE, Drive(forward=forward, left=left, turn=turn))

    def command(self, topic: Topic, command: FleetMessage) -> Outcome:
        """Command the robot as the gateway does; raise Refused where it is not ready, needs neutral, or refuses."""
        if not self.robot.ready:
            raise NotReady(self.session.busy or self.session.reason or "offline")
        moving = isinstance(command, Drive) and command.moving
        if moving and self._needs_neutral:
            raise NeutralFirst("the robot was stopped: neutral must come before motion")
        outcome = self.robot.command(topic, command, self.now)
        self._needs_neutral = self._needs_neutral and not isinstance(command, Drive)
        return outcome

    def stop(self, repeated_s: float = STOPPED_S) -> None:
        """Stop the robot, as the gateway does when somebody orders it."""
        self.robot.stop(self.now, self.now + repeated_s)

    def rest(self, repeated_s: float = STOPPED_S) -> None:
        """Stop the robot, as the gateway does of itself; 0: as once a second while nobody drives."""
        self.robot.rest(self.now, self.now + repeated_s)

    def _follow_busy(self) -> None:
        """Stop a robot that has become busy, or is no longer."""
        if self.session.busy != self._busy and not self.session.over:
            self._busy, self._needs_neutral = self.session.busy, True
            with contextlib.suppress(Refused):
                self.rest()

    def _hear(self, data: bytes) -> None:
        if not self.answers or not data:
            return
        for message in self.session.receive(data, self.now):
            with contextlib.suppress(ProtocolError):
                stamp_ns = round(self.now * _NS_PER_S)
                self.shown |= {topic.path: shown for topic, shown in self.robot.telemetry(message, stamp_ns)}
        self._greet()
        self._follow_busy()

    def _greet(self) -> None:
        """Begin with a session that was just established, as a gateway does."""
        if self.session.state is not State.ESTABLISHED or self._greeted:
            return
        self._greeted = True
        with contextlib.suppress(Refused):
            self.rest()
        with contextlib.suppress(Refused):
            self.robot.leased(self._leased, self.now)
        self.shown |= {topic.path: shown for topic, shown in self.robot.begun(round(self.now * _NS_PER_S))}
