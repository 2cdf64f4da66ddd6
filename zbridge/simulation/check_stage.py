"""The stage of the conformance kit: a protocol's simulated robot on loopback, and rehearsals of what it sent.

:func:`record` runs the simulated robot and a conversation with each of its links, and records them. A
:class:`Rehearsal` plays the record to a new session without any link, in virtual time: so each step of a handshake can
fail on purpose, and hours pass at once.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import msgspec

from zbridge.errors import FAULT, ProtocolError, describe
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Protocol, RobotSide, Simulation
from zbridge.protocol.session import Session, State
from zbridge.transport import Conversation, ConversationHooks, connect


class CheckFinding(msgspec.Struct, frozen=True):
    """One line of the report. ``problem`` None: the claim holds. ``note``: a remark for the reader."""

    claim: str
    problem: str | None = None
    note: str = ""

    @classmethod
    def of(cls, claim: str, problems: list[str], note: str = "") -> CheckFinding:
        """Make the finding of a claim that was tested in many ways; it shows the first problems."""
        if not problems:
            return cls(claim, None, note)
        more = f" (and {len(problems) - _SHOWN} more)" if len(problems) > _SHOWN else ""
        return cls(claim, "; ".join(problems[:_SHOWN]) + more, note)

    @classmethod
    def tried(
        cls, claim: str, find: Callable[[], str | list[str] | CheckFinding | None], expected: str = ""
    ) -> CheckFinding:
        """Make the finding of a check that returns a problem, several, or none, or raises an exception.

        expected: what should have happened instead.
        """
        try:
            found = find()
        except Exception as error:  # whatever the protocol's own code raises is a finding
            return cls(claim, raised(error, expected))
        if isinstance(found, CheckFinding):
            return found
        return cls.of(claim, found) if isinstance(found, list) else cls(claim, found)

    def __str__(self) -> str:
        note = f" ({self.note})" if self.note else ""
        return (
            f"ok    {self.claim}{note}" if self.problem is None else f"FAIL  {self.claim}{note}\n      {self.problem}"
        )


def raised(error: BaseException, expected: str = "") -> str:
    """Return what the protocol's own code raised, in which class and line, and what was expected instead."""
    return f"{describe(error)}; expected {expected}" if expected else describe(error)


_SHOWN = 3


SHOWN_S = 1.0
"""Seconds that a recording continues after the session was established."""
HANG_UP_S = 0.2
"""Seconds for the simulated robot to detect that its peer is gone."""
STEP_S = 0.01
"""Virtual seconds between two frames of a rehearsal."""
_HANDLED = "ProtocolError for what a robot must not say, and no other exception"
_MOST_WRITES = 10_000
_MOST_FRAMES = 400
_ANSWER_FRAMES = 8


class Transcript(msgspec.Struct):
    """The frames of the driving link, and whether all links were established. ``answers``: what followed a frame."""

    received: list[bytes] = []
    answers: dict[bytes, list[bytes]] = {}
    messages: list[Any] = []
    established: bool = False
    reason: str | None = None
    unanswered: int = 0


def robot_of(protocol: Protocol) -> RobotSide:
    """Make the robot side that fits the simulated robot."""
    return protocol.robot(msgspec.convert(protocol.simulated, protocol.options), protocol.links, Metrics())


class Stage:
    """A robot object with a conversation on each link of the simulated robot."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self.robot = robot_of(protocol)
        self.sessions: list[Session[Any]] = []
        self.frames: list[tuple[str, bytes]] = []
        """The frames of the first link: ``in`` or ``out``, and the frame."""
        self.messages: list[Any] = []
        """The messages that the sessions passed on."""
        self.shown: list[tuple[Topic, FleetMessage]] = []
        self._conversations: list[Conversation] = []

    async def connect(self, addresses: tuple[Address, ...]) -> None:
        """Begin a conversation with each link of the simulated robot."""
        loop, names = asyncio.get_running_loop(), self.robot.link_names
        if len(names) != len(addresses):
            kind = type(self.robot).__qualname__
            raise ValueError(f"{kind}.link_names: {names}, expected {len(addresses)} of them (Protocol.links)")
        for name, address in zip(names, addresses, strict=True):
            session = self.robot.session(name, str(address))
            if not self.sessions:
                session.tap = lambda direction, frame: self.frames.append((direction, frame))
            self.sessions.append(session)
            self._conversations.append(Conversation(session, loop, ConversationHooks(deliver=self._deliver)))
            await connect(self._protocol.device_address(str(address)), self._conversations[-1])

    def _deliver(self, messages: list[Any]) -> None:
        self.messages += messages
        for message in messages:
            with contextlib.suppress(ProtocolError):
                self.shown += self.robot.telemetry(message, 1)

    async def established(self, within_s: float) -> bool:
        """Wait until all links are established, for at most ``within_s`` seconds."""
        deadline = asyncio.get_running_loop().time() + within_s
        while asyncio.get_running_loop().time() < deadline and not any(session.over for session in self.sessions):
            if all(session.state is State.ESTABLISHED for session in self.sessions):
                return True
            await asyncio.sleep(STEP_S)
        return False

    def lacking(self, within_s: float) -> Iterator[str]:
        """Return for each link that is not established its state, or why its session ended."""
        for name, session in zip(self.robot.link_names, self.sessions, strict=True):
            which = f"link {name} ({type(session).__qualname__})"
            if session.over:
                reason = session.reason or "no reason given"
                expected = f"; expected {_HANDLED}" if reason.startswith(FAULT) else ""
                yield f"{which}: ended: {reason}{expected}"
            elif session.state is not State.ESTABLISHED:
                yield f"{which}: still {session.state.value} after {within_s:g} s; expected Session.establish"

    def pump(self) -> None:
        for conversation in self._conversations:
            conversation.pump()

    def close(self) -> None:
        for conversation in self._conversations:
            conversation.abandon()


@contextlib.asynccontextmanager
async def live(protocol: Protocol) -> AsyncIterator[Stage]:
    """Run the simulated robot on loopback and connect to it."""
    ready: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    addresses = tuple(Address("127.0.0.1", 0) for _ in range(protocol.links))
    simulated = asyncio.ensure_future(protocol.simulate(Simulation(addresses, ready=ready.set_result)))
    scene = Stage(protocol)
    try:
        parts: tuple[asyncio.Future[Any], ...] = (simulated, ready)
        await asyncio.wait(parts, timeout=5.0, return_when=asyncio.FIRST_COMPLETED)
        if simulated.done():
            simulated.result()
        if not ready.done():
            raise TimeoutError("the simulated robot does not say where it listens (Simulation.ready)")
        await scene.connect(ready.result())
        yield scene
    finally:
        scene.close()
        await asyncio.sleep(HANG_UP_S)
        simulated.cancel()
        await asyncio.wait([simulated])


async def record(protocol: Protocol, establish_s: float) -> Transcript:
    """Run the conversations until a while after all links are established; record them."""
    async with live(protocol) as scene:
        established = await scene.established(establish_s)
        if established:
            await asyncio.sleep(SHOWN_S)
        return Transcript(
            [frame for direction, frame in scene.frames if direction == "in"][:_MOST_FRAMES],
            _answers(scene.frames),
            list(scene.messages),
            established,
            None if established else "; ".join(scene.lacking(establish_s)),
            sum(session.traffic.unanswered for session in scene.sessions),
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


class Rehearsal:
    """The first link of a new robot object, without a link. ``now``: its time, seconds."""

    def __init__(self, protocol: Protocol, recording: Transcript) -> None:
        self.robot = robot_of(protocol)
        self.now = 0.0
        sessions = [self.robot.session(name, "tcp://robot.test:1") for name in self.robot.link_names]
        self.session: Session[Any] = sessions[0]
        self._recording = recording
        self._begun = False
        self.session.open(self.now)

    def play(self, frames: list[bytes]) -> None:
        """Play these frames of the robot, one after the other."""
        for frame in frames:
            self.run(STEP_S)
            self._hear(frame)

    def establish(self) -> int:
        """Play the robot's frames until the session is established; return how many frames that took."""
        for count, frame in enumerate(self._recording.received):
            self.run(STEP_S)
            if self.session.state is not State.HANDSHAKING:
                return count
            self._hear(frame)
        self.run(1.0)
        return len(self._recording.received)

    def run(self, seconds: float, *, answers: bool = True) -> list[bytes]:
        """Advance the time and write what is due; return what was written. Raise RuntimeError if that never ends.

        ``answers``: the robot repeats what it sent after the same frame, once the session is established.
        """
        written: list[bytes] = []
        end, session = self.now + seconds, self.session
        for _ in range(_MOST_WRITES):
            session.expire(self.now)
            frame = session.outgoing(self.now)
            if frame is not None:
                written.append(session.undated(frame))
                session.outbox.written(self.now)
                if answers and session.state is State.ESTABLISHED:
                    for answer in self._recording.answers.get(frame, ()):
                        self._hear(answer)
                continue
            deadline = session.deadline()
            if deadline is None or deadline > end:
                self.now = end
                return written
            self.now = max(self.now + 1e-6, deadline)
        raise RuntimeError(f"{_MOST_WRITES} writes and timers within {seconds:g} s")

    def _hear(self, frame: bytes) -> None:
        """Pass the robot's frames to the session and the translation."""
        for message in self.session.receive(frame, self.now):
            with contextlib.suppress(ProtocolError):
                list(self.robot.telemetry(message, 1))
        if self.session.state is State.ESTABLISHED and not self._begun:
            self._begun = True
            self.robot.begun(1)
