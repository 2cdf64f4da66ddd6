"""A rehearsal: the robot side of a protocol without a link, in virtual time, with the bytes of a recording.

So each step of a handshake can fail on purpose, and hours pass at once.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

import msgspec

from zbridge.errors import ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.exchange import ExchangeSession
from zbridge.protocol.plugin import Outcome, Protocol, RobotSide, Telemetry
from zbridge.protocol.session import Session, State
from zbridge.simulation.scene import PEER as PEER

STEP_S = 0.01
"""Virtual seconds between two frames of a rehearsal."""
AGAIN_S = 0.1
"""Virtual seconds between two frames of a robot that sends by itself."""
BEGUN_NS = 10**18
"""The time at which a rehearsal begins, as stamps show it."""
MORE_FRAMES = 20
"""Frames of the robot after the handshake."""
_MOST_WRITES = 10_000


class Transcript(msgspec.Struct):
    """The frames of the driving link, and whether all links were established. ``answers``: what followed a frame.

    repeated: what the robot sent of itself within a second; empty: the last frame that was received stands for it.
    unanswered: requests without an answer; None: the session sends none.
    """

    received: list[bytes] = []
    repeated: list[bytes] = []
    answers: dict[bytes, list[bytes]] = {}
    messages: list[Any] = []
    established: bool = False
    reason: str | None = None
    unanswered: int | None = None


def robot_of(protocol: Protocol) -> RobotSide:
    """Make the robot side that fits the simulated robot."""
    return protocol.robot(msgspec.convert(protocol.simulated, protocol.options), protocol.links, Metrics())


def named(protocol: Protocol, frame: bytes) -> str:
    """Show a frame, with the message that it is, if one of the protocol's codecs can read it."""
    for codec in protocol.codecs:
        with contextlib.suppress(Exception):  # a codec of the other side, or one that is broken: the bytes are shown
            message = codec.read(frame)
            if type(message) in {each if isinstance(each, type) else type(each) for each in codec.messages}:
                return f"{message} {frame!r}"
    return repr(frame)


class Rehearsal:
    """The first link of a new robot object, without a link. ``now``: its time, seconds."""

    def __init__(self, protocol: Protocol, recording: Transcript) -> None:
        self._protocol = protocol
        self.robot = robot_of(protocol)
        self.now = 0.0
        self.shown: list[Telemetry] = []
        """Telemetry of all that was received."""
        sessions = [self.robot.session(name, PEER) for name in self.robot.link_names]
        self.session: Session[Any] = sessions[0]
        self._recording = recording
        self._begun = False
        self._repeated = 0
        """How many frames of the robot's stream were repeated."""
        self._heard_at = self.now
        self.session.open(self.now)

    @classmethod
    def established(cls, protocol: Protocol, recording: Transcript) -> Rehearsal:
        """Return a rehearsal whose session is established; raise RuntimeError if it is not."""
        rehearsal = cls(protocol, recording)
        frames = rehearsal.establish()
        rehearsal.play(recording.received[frames : frames + MORE_FRAMES])
        if rehearsal.session.state is not State.ESTABLISHED:
            raise RuntimeError(f"{rehearsal.session!r} after what established it before")
        return rehearsal

    def play(self, frames: list[bytes]) -> list[bytes]:
        """Play these frames of the robot, one after the other; return what was written."""
        written = []
        for frame in frames:
            written += self.run(STEP_S)
            self._hear(frame)
        return written

    def hand_over(self) -> None:
        """Go on with new objects, as another process does with the state of these; raise ProtocolError."""
        states = msgspec.msgpack.encode((self.session.export(), self.robot.export()))
        session, robot = msgspec.msgpack.decode(states)
        self.robot = robot_of(self._protocol)
        self.session, *_ = (self.robot.session(name, PEER) for name in self.robot.link_names)
        self.session.restore(session)
        self.robot.restore(robot)

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

        ``answers``: the robot repeats what it sent after the same frame, once the session is established, and what it
        sent of itself: a part every :data:`AGAIN_S`, all of it in a second.
        """
        written: list[bytes] = []
        end, session = self.now + seconds, self.session
        for _ in range(_MOST_WRITES):
            heard_at = self._repeat_stream() if answers else math.inf
            session.expire(self.now)
            frame = session.outgoing(self.now)
            if frame is not None:
                written.append(session.undated(frame))
                session.outbox.written(self.now)
                if answers and session.state is State.ESTABLISHED:
                    for answer in self._recording.answers.get(frame, ()):
                        self._hear(answer)
                continue
            deadline = min(heard_at, math.inf if (due := session.deadline()) is None else due)
            if deadline > end:
                self.now = end
                return written
            self.now = max(self.now + 1e-6, deadline)
        raise RuntimeError(self._restless(written))

    def command(self, topic: Topic, command: FleetMessage) -> Outcome:
        """Command the robot; raise Refused, EncodeError."""
        return self.robot.command(topic, command, self.now)

    def written_for(self, topic: Topic, command: FleetMessage, seconds: float) -> tuple[list[bytes], Outcome | None]:
        """Return what is written within ``seconds`` of a command, and its outcome; None: it is refused."""
        try:
            outcome = self.command(topic, command)
        except Refused:
            return [], None
        return self.run(seconds), outcome

    def drive(self, command: FleetMessage, seconds: float) -> tuple[list[bytes], Outcome | None]:
        """Do the same for a drive."""
        return self.written_for(topics.CMD_DRIVE, command, seconds)

    def _repeat_stream(self) -> float:
        """Let a robot that sends by itself send some frames again if that is due; return when the next ones are."""
        session, frames = self.session, self._recording.repeated or self._recording.received[-1:]
        if isinstance(session, ExchangeSession) or session.state is not State.ESTABLISHED or not frames:
            return math.inf
        if self.now >= self._heard_at + AGAIN_S:
            for _ in range(math.ceil(len(frames) * AGAIN_S)):
                self._hear(frames[self._repeated % len(frames)])
                self._repeated += 1
        return self._heard_at + AGAIN_S

    def _restless(self, written: list[bytes]) -> str:
        """Say what never rests: a timer that is due again and again, or a slot that repeats without a pause."""
        kind = type(self.session)
        if not written and self.session.timers() <= self.now:
            timer = next((base for base in kind.__mro__ if "timers" in vars(base)), kind)
            return f"{timer.__qualname__}.timers() is always due: {self.session.timers():g}, and it is {self.now:g} now"
        if not written:
            return f"{kind.__qualname__}.deadline() is always due: {self.session!r} does not change at {self.now:g} s"
        return f"{kind.__qualname__} writes without a pause: {written[-1]!r}, {len(written)} frames at {self.now:g} s"

    def _hear(self, frame: bytes) -> None:
        """Pass the robot's frames to the session and the translation."""
        self._heard_at = self.now
        for message in self.session.receive(frame, self.now):
            with contextlib.suppress(ProtocolError):
                self.shown += self.robot.telemetry(message, BEGUN_NS + round(self.now * 1e9))
        if self.session.state is State.ESTABLISHED and not self._begun:
            self._begun = True
            self.robot.begun(1)
