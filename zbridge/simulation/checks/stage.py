"""The stage of the conformance kit: a protocol's simulated robot on loopback, and a conversation with it.

:func:`record` records a conversation with each link; a :class:`Stage` drives the robot and watches it.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Iterator
from functools import partial
from typing import Any

from zbridge.errors import FAULT, NotReady, ProtocolError, Refused, describe
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motion, Pose, Scan
from zbridge.fleet.topics import Topic
from zbridge.protocol.address import Address
from zbridge.protocol.exchange import ExchangeSession
from zbridge.protocol.plugin import Protocol, Simulation, Truth
from zbridge.protocol.session import Session, State
from zbridge.simulation.checks.finding import SimulatorFault
from zbridge.simulation.checks.rehearsal import Transcript, robot_of
from zbridge.transport import Conversation, ConversationHooks, Link, connect

SHOWN_S = 1.0
"""Seconds that a recording continues after the session was established."""
HANG_UP_S = 0.2
"""Seconds for the simulated robot to detect that its peer is gone."""
AGAIN_S = 0.1
"""Seconds between two drives, as programs repeat them."""
_LOOK_S = 0.01
_HANDLED = "ProtocolError for what a robot must not say, and no other exception"
MOST_RECEIVED = 600
_MOST_FRAMES = 400
_MOST_REPEATED = 100
_ANSWER_FRAMES = 8
_LAST = 3


class Stage:
    """A robot object with a conversation on each link of the simulated robot; what it shows, and how it really is."""

    def __init__(self, protocol: Protocol, device: RunningRobot) -> None:
        self._protocol = protocol
        self.device = device
        self.fault: str | None = None
        """What the simulated robot raised."""
        self.robot = robot_of(protocol)
        self.sessions: list[Session[Any]] = []
        self.frames: list[tuple[str, bytes]] = []
        """The frames of the first link: ``in`` or ``out``, and the frame."""
        self.received: list[bytes] = []
        """The frames of the first link's first connection, up to :data:`MOST_RECEIVED`."""
        self.messages: list[Any] = []
        """The messages that the sessions passed on."""
        self.shown: list[tuple[Topic, FleetMessage]] = []
        """Telemetry since everything was forgotten last."""
        self.history: list[tuple[Topic, FleetMessage]] = []
        """All telemetry."""
        self.truths = device.truths
        """How the simulated robot was, and when; empty: it does not say."""
        self._conversations: list[Conversation] = []
        self._links: list[Link] = []
        self._loop = asyncio.get_running_loop()

    # The conversation

    async def connect(self) -> None:
        """Begin a conversation with each link of the simulated robot."""
        addresses, names = await self.device.listens(), self.robot.link_names
        if len(names) != len(addresses):
            kind = type(self.robot).__qualname__
            raise ValueError(f"{kind}.link_names: {names}, expected {len(addresses)} of them (Protocol.links)")
        self.sessions, self._conversations, self._links = [], [], []
        for name, address in zip(names, addresses, strict=True):
            session = self.robot.session(name, str(address))
            if not self.sessions:
                session.tap = partial(self._tapped, keep=not self.received)
            self.sessions.append(session)
            self._conversations.append(Conversation(session, self._loop, ConversationHooks(deliver=self._deliver)))
            self._links.append(await connect(self._protocol.device_address(str(address)), self._conversations[-1]))

    def _tapped(self, direction: str, frame: bytes, *, keep: bool) -> None:
        self.frames.append((direction, frame))
        if keep and direction == "in" and len(self.received) < MOST_RECEIVED:
            self.received.append(frame)

    def _deliver(self, messages: list[Any]) -> None:
        self.messages += messages
        for message in messages:
            with contextlib.suppress(ProtocolError):
                shown = tuple(self.robot.telemetry(message, time.time_ns()))
                self.shown += shown
                self.history += shown

    async def established(self, within_s: float) -> bool:
        """Wait until all links are established, for at most ``within_s`` seconds; raise SimulatorFault."""
        deadline = self._loop.time() + within_s
        while self._loop.time() < deadline and not any(session.over for session in self.sessions):
            if all(session.state is State.ESTABLISHED for session in self.sessions):
                return True
            self.raise_fault()
            await asyncio.sleep(_LOOK_S)
        self.raise_fault()
        return False

    def raise_fault(self) -> None:
        """Raise SimulatorFault if the simulated robot raised an exception, or ended."""
        if self.device.running.done():
            error = self.device.running.exception()
            self.fault = f"raised {describe(error)}" if error is not None else "ended: simulate() returned"
        if self.fault is not None:
            raise SimulatorFault(f"the simulated robot {self.fault}; expected it to serve until it is cancelled")

    def lacking(self, within_s: float) -> Iterator[str]:
        """Return for each link that is not established its state, or why its session ended."""
        for name, session in zip(self.robot.link_names, self.sessions, strict=True):
            which = f"link {name} ({type(session).__qualname__})"
            if session.over:
                reason = session.reason or "no reason given"
                expected = f"; expected {_HANDLED}" if reason.startswith(FAULT) else ""
                yield f"{which}: ended: {reason}; {self._exchanged()}{expected}"
            elif session.state is not State.ESTABLISHED:
                malformed = f", last malformed: {session.last_malformed}" if session.last_malformed else ""
                still = f"still {session.state.value} after {within_s:g} s{malformed}"
                yield f"{which}: {still}; {self._exchanged()}; expected Session.establish"

    def _exchanged(self) -> str:
        """Show the last frames of both directions."""
        last = {way: [frame for direction, frame in self.frames if direction == way][-_LAST:] for way in ("out", "in")}
        written, received = (", ".join(map(repr, last[way])) or "nothing" for way in ("out", "in"))
        return f"last written: {written}; last received: {received}"

    @property
    def trouble(self) -> str | None:
        """Why the robot takes no commands now."""
        kinds = ((type(each).__qualname__, each.busy or (each.over and each.reason)) for each in self.sessions)
        return next((f"{kind} takes no commands: {why}" for kind, why in kinds if why), None)

    def pump(self) -> None:
        for conversation in self._conversations:
            conversation.pump()

    async def close(self) -> None:
        """End the conversations, and wait until no thread of their links runs.

        Two sessions of Zenoh in one process, robot and gateway, that close at the same time may wait for each other.
        """
        for conversation in self._conversations:
            conversation.abandon()
        for link in self._links:
            await link.ended()

    # Driving

    def now(self) -> float:
        return self._loop.time()

    def prepare(self) -> None:
        """Prepare the robot for driving, as a gateway does when a program takes the lease."""
        self.robot.begun(1)
        self.robot.leased(True, self.now())
        with contextlib.suppress(Refused):  # where a mode is needed or known
            self.robot.command(topics.CMD_MODE, Mode(mode="manual"), self.now())
        self.pump()

    async def drive(self, seconds: float, forward: float = 0.0, turn: float = 0.0) -> None:
        """Repeat a drive for so long; raise Refused, as a gateway does where the robot is busy."""
        end = self.now() + seconds
        while self.now() < end:
            if not self.robot.ready:
                raise NotReady(self.trouble or "the session is not established")
            self.robot.command(topics.CMD_DRIVE, Drive(forward=forward, turn=turn), self.now())
            await self.watch(min(AGAIN_S, max(0.0, end - self.now())))

    async def stop(self, seconds: float) -> None:
        """Stop the robot, and watch it for so long."""
        self.robot.stop(self.now(), self.now() + seconds / 2)
        await self.watch(seconds)

    async def watch(self, seconds: float) -> None:
        """Let the robot and the conversation run."""
        self.pump()
        await asyncio.sleep(seconds)
        self.raise_fault()

    def forget(self) -> None:
        """Forget what was shown and written before; how it is now stays known."""
        self.shown.clear()
        self.frames.clear()

    # What was seen

    def of(self, kind: type[FleetMessage]) -> list[Any]:
        """Return what was shown of one class of messages."""
        return [shown for _, shown in self.shown if isinstance(shown, kind)]

    @property
    def poses(self) -> list[Pose]:
        return self.of(Pose)

    @property
    def last_pose(self) -> Pose | None:
        """The newest pose of all: a robot may show it only when it changes."""
        return next((shown for _, shown in reversed(self.history) if isinstance(shown, Pose)), None)

    @property
    def speeds(self) -> list[float]:
        return [motion.speed for motion in self.of(Motion) if motion.speed is not None]

    @property
    def scans(self) -> list[Scan]:
        return self.of(Scan)

    @property
    def written(self) -> set[bytes]:
        return {frame for direction, frame in self.frames if direction == "out"}

    @property
    def truth(self) -> Truth | None:
        """How the simulated robot is now; None: it does not say."""
        return self.truths[-1][1] if self.truths else None


class RunningRobot:
    """The simulated robot of a protocol, running: it can be switched off and on. ``truths``: how it was, and when."""

    def __init__(self, protocol: Protocol, place: tuple[float, float, float] | None, *, at_wrap: bool) -> None:
        self._loop = asyncio.get_running_loop()
        self._protocol, self._at_wrap = protocol, at_wrap
        self.truths: list[tuple[float, Truth]] = []
        self.addresses = tuple(Address("127.0.0.1", 0) for _ in range(protocol.links))
        self.switch_on(place)

    def switch_on(self, place: tuple[float, float, float] | None) -> None:
        """Start it, at the addresses that it had before."""
        self.ready: asyncio.Future[tuple[Address, ...]] = self._loop.create_future()
        simulation = Simulation(
            self.addresses,
            ready=self._on_ready,
            place=place,
            at_wrap=self._at_wrap,
            report=lambda truth: self.truths.append((self._loop.time(), truth)),
        )
        self.running = asyncio.ensure_future(self._protocol.simulate(simulation))

    def _on_ready(self, bound: tuple[Address, ...]) -> None:
        if not self.ready.done():
            self.ready.set_result(bound)

    async def listens(self) -> tuple[Address, ...]:
        """Wait until it listens, and return where; raise what it raises, TimeoutError if it never says."""
        parts: tuple[asyncio.Future[Any], ...] = (self.running, self.ready)
        await asyncio.wait(parts, timeout=5.0, return_when=asyncio.FIRST_COMPLETED)
        if self.running.done():
            self.running.result()
        if not self.ready.done():
            raise TimeoutError("the simulated robot does not say where it listens (Simulation.ready)")
        self.addresses = self.ready.result()
        return self.addresses

    async def switch_off(self) -> None:
        """End it."""
        self.running.cancel()
        await asyncio.wait([self.running])


@contextlib.asynccontextmanager
async def live(
    protocol: Protocol, *, place: tuple[float, float, float] | None = None, at_wrap: bool = False
) -> AsyncIterator[Stage]:
    """Run the simulated robot on loopback and connect to it."""
    device = RunningRobot(protocol, place, at_wrap=at_wrap)
    stage, loop = Stage(protocol, device), asyncio.get_running_loop()
    loop.set_exception_handler(partial(_on_fault, stage, loop.get_exception_handler()))
    try:
        await stage.connect()
        yield stage
    finally:
        await stage.close()
        await asyncio.sleep(HANG_UP_S)
        await device.switch_off()


def _on_fault(stage: Stage, other: Any, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Note what the tasks of the simulated robot raise, which nobody waits for."""
    error = context.get("exception")
    if error is not None and not isinstance(error, ConnectionError):
        stage.fault = f"raised {describe(error)}"
    if other is not None:
        other(loop, context)


async def record(protocol: Protocol, establish_s: float) -> Transcript:
    """Run the conversations until a while after all links are established; record them."""
    async with live(protocol) as stage:
        established = await stage.established(establish_s)
        handshake = len(stage.frames)
        if established:
            await stage.watch(SHOWN_S)
        told = len(stage.frames)
        received = [frame for direction, frame in stage.frames if direction == "in"][:_MOST_FRAMES]
        messages = list(stage.messages)
        if established:
            await _command(stage)
        return Transcript(
            received,
            [frame for direction, frame in stage.frames[handshake:told] if direction == "in"][-_MOST_REPEATED:],
            _answers(stage.frames[handshake:]),
            messages,
            established,
            None if established else "; ".join(stage.lacking(establish_s)),
            _unanswered(stage),
        )


async def _command(stage: Stage) -> None:
    """Let the robot answer drives and a stop, for rehearsals."""
    stage.prepare()
    for forward, turn in ((0.5, 0.0), (0.0, 0.5), (0.0, -0.5), (-0.5, 0.0), (0.5, 0.5)):
        with contextlib.suppress(Refused):
            await stage.drive(AGAIN_S, forward, turn)
    with contextlib.suppress(Refused):
        await stage.stop(2 * AGAIN_S)


def _unanswered(stage: Stage) -> int | None:
    """Count the requests without an answer; None: no session sends requests."""
    asking = [session for session in stage.sessions if isinstance(session, ExchangeSession)]
    return sum(session.traffic.unanswered for session in asking) if asking else None


def _answers(frames: list[tuple[str, bytes]]) -> dict[bytes, list[bytes]]:
    """Return what the robot sent after each frame and before the next one."""
    answers: dict[bytes, list[bytes]] = {}
    asked = b""
    for direction, frame in frames:
        if direction == "out":
            asked = frame
        elif len(answers.setdefault(asked, [])) < _ANSWER_FRAMES:
            answers[asked].append(frame)
    return answers
