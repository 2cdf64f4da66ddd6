"""The stage of the conformance kit: a protocol's simulated robot on loopback, and a conversation with it.

:func:`record` records a conversation with each link; a :class:`Stage` drives the robot and watches it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator
from functools import partial
from typing import Any

from zbridge.errors import FAULT, ProtocolError, Refused, describe
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motion, Pose, Scan
from zbridge.fleet.topics import Topic
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Protocol, Simulation, Truth
from zbridge.protocol.session import Session, State
from zbridge.simulation.checks.finding import SimulatorFault
from zbridge.simulation.checks.rehearsal import Transcript, robot_of
from zbridge.transport import Conversation, ConversationHooks, connect

SHOWN_S = 1.0
"""Seconds that a recording continues after the session was established."""
HANG_UP_S = 0.2
"""Seconds for the simulated robot to detect that its peer is gone."""
AGAIN_S = 0.1
"""Seconds between two drives, as programs repeat them."""
_LOOK_S = 0.01
_HANDLED = "ProtocolError for what a robot must not say, and no other exception"
_MOST_FRAMES = 400
_ANSWER_FRAMES = 8


class Stage:
    """A robot object with a conversation on each link of the simulated robot; what it shows, and how it really is."""

    def __init__(self, protocol: Protocol, simulated: asyncio.Future[Any], truths: list[tuple[float, Truth]]) -> None:
        self._protocol = protocol
        self._simulated = simulated
        self._addresses: tuple[Address, ...] = ()
        self.fault: str | None = None
        """What the simulated robot raised."""
        self.robot = robot_of(protocol)
        self.sessions: list[Session[Any]] = []
        self.frames: list[tuple[str, bytes]] = []
        """The frames of the first link: ``in`` or ``out``, and the frame."""
        self.messages: list[Any] = []
        """The messages that the sessions passed on."""
        self.shown: list[tuple[Topic, FleetMessage]] = []
        """Telemetry since everything was forgotten last."""
        self.history: list[tuple[Topic, FleetMessage]] = []
        """All telemetry."""
        self.truths = truths
        """How the simulated robot was, and when; empty: it does not say."""
        self._conversations: list[Conversation] = []
        self._loop = asyncio.get_running_loop()

    # The conversation

    async def connect(self, addresses: tuple[Address, ...] = ()) -> None:
        """Begin a conversation with each link of the simulated robot; the second time with the same."""
        self._addresses = addresses or self._addresses
        names = self.robot.link_names
        if len(names) != len(self._addresses):
            kind = type(self.robot).__qualname__
            raise ValueError(f"{kind}.link_names: {names}, expected {len(self._addresses)} of them (Protocol.links)")
        self.sessions, self._conversations = [], []
        for name, address in zip(names, self._addresses, strict=True):
            session = self.robot.session(name, str(address))
            if not self.sessions:
                session.tap = lambda direction, frame: self.frames.append((direction, frame))
            self.sessions.append(session)
            self._conversations.append(Conversation(session, self._loop, ConversationHooks(deliver=self._deliver)))
            await connect(self._protocol.device_address(str(address)), self._conversations[-1])

    def _deliver(self, messages: list[Any]) -> None:
        self.messages += messages
        for message in messages:
            with contextlib.suppress(ProtocolError):
                shown = tuple(self.robot.telemetry(message, 1))
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
        if self._simulated.done():
            error = self._simulated.exception()
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
                yield f"{which}: ended: {reason}{expected}"
            elif session.state is not State.ESTABLISHED:
                malformed = f", last malformed: {session.last_malformed}" if session.last_malformed else ""
                still = f"still {session.state.value} after {within_s:g} s{malformed}"
                yield f"{which}: {still}; expected Session.establish"

    def pump(self) -> None:
        for conversation in self._conversations:
            conversation.pump()

    def close(self) -> None:
        for conversation in self._conversations:
            conversation.abandon()

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
        """Repeat a drive for so long; raise Refused."""
        end = self.now() + seconds
        while self.now() < end:
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


@contextlib.asynccontextmanager
async def live(
    protocol: Protocol, *, place: tuple[float, float, float] | None = None, at_wrap: bool = False
) -> AsyncIterator[Stage]:
    """Run the simulated robot on loopback and connect to it."""
    loop = asyncio.get_running_loop()
    ready: asyncio.Future[tuple[Address, ...]] = loop.create_future()
    addresses = tuple(Address("127.0.0.1", 0) for _ in range(protocol.links))
    truths: list[tuple[float, Truth]] = []
    simulation = Simulation(
        addresses,
        ready=ready.set_result,
        place=place,
        at_wrap=at_wrap,
        report=lambda truth: truths.append((loop.time(), truth)),
    )
    simulated = asyncio.ensure_future(protocol.simulate(simulation))
    stage = Stage(protocol, simulated, truths)
    loop.set_exception_handler(partial(_on_fault, stage, loop.get_exception_handler()))
    try:
        parts: tuple[asyncio.Future[Any], ...] = (simulated, ready)
        await asyncio.wait(parts, timeout=5.0, return_when=asyncio.FIRST_COMPLETED)
        if simulated.done():
            simulated.result()
        if not ready.done():
            raise TimeoutError("the simulated robot does not say where it listens (Simulation.ready)")
        await stage.connect(ready.result())
        yield stage
    finally:
        stage.close()
        await asyncio.sleep(HANG_UP_S)
        simulated.cancel()
        await asyncio.wait([simulated])


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
        return Transcript(
            [frame for direction, frame in stage.frames if direction == "in"][:_MOST_FRAMES],
            _answers(stage.frames[handshake:]),
            list(stage.messages),
            established,
            None if established else "; ".join(stage.lacking(establish_s)),
            sum(session.traffic.unanswered for session in stage.sessions),
        )


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
