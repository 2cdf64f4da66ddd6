"""Conformance of commands: the stop goes first, and each command is carried out or refused with a code."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from functools import partial

import numpy as np

from zbridge.errors import EncodeError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw, Scan, SensorSetting, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import State
from zbridge.simulation.check_stage import STEP_S, CheckFinding, Rehearsal, Transcript, raised, robot_of

STOP_S = 0.5
"""Seconds for which the stop is repeated."""
WATCHED_S = 0.4
"""Virtual seconds within which a command must have an effect."""
LATE_S = 0.1
WAITING = b"what waits"
MORE_FRAMES = 20
"""Frames of the robot after the handshake."""


def check_stop(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check that the stop is written next, and that waiting motion is not sent after it."""
    for claim, find, expected in (
        ("the stop goes before all that waits, and no motion after it", _stop, "a stop that is put into the outbox"),
        ("a stop is repeated until its time is over", _repeated, "a stop that is put into the outbox"),
        ("a stop before the first connection is refused or ignored", _early, "nothing, or Refused"),
    ):
        yield CheckFinding.tried(claim, partial(find, protocol, recording), expected)


def _early(protocol: Protocol, _: Transcript) -> None:
    with contextlib.suppress(Refused):
        robot_of(protocol).stop(0.0, 0.0)


def _stop(protocol: Protocol, recording: Transcript) -> list[str]:
    standing, driven = _established(protocol, recording), _established(protocol, recording)
    idle = set(standing.run(WATCHED_S))
    standing.robot.stop(standing.now, standing.now)
    written = set(standing.run(WATCHED_S))
    stop = written - idle or written
    if not stop:
        return ["a stop writes nothing"]
    _give(driven, topics.CMD_DRIVE, FORWARD)
    motion = set(driven.run(WATCHED_S)) - idle - stop
    if not motion:
        return ["a drive writes nothing that a stop does not write: nothing can be told from it"]
    return [problem for taken in (0, 1) for problem in _crowded(_crowd(protocol, recording, idle, taken), stop, motion)]


def _crowd(protocol: Protocol, recording: Transcript, idle: set[bytes], taken: int) -> Rehearsal:
    """Queue commands, a request and polls. taken: how many are then written, as slots and queue alternate."""
    queued = _established(protocol, recording)
    for topic, commands in _commands(protocol):
        for command in commands if topic is not topics.CMD_MODE else ():
            _give(queued, topic, command)
    _give(queued, topics.CMD_DRIVE, FORWARD)
    for _ in range(2):
        queued.session.outbox.put(next(iter(idle), WAITING))
    queued.now += LATE_S  # a poll is due too
    for _ in range(taken):
        queued.session.outgoing(queued.now)
        queued.session.outbox.written(queued.now)
    return queued


def _crowded(queued: Rehearsal, stop: set[bytes], motion: set[bytes]) -> list[str]:
    queued.robot.stop(queued.now, queued.now + STOP_S)
    first, *later = queued.run(WATCHED_S) or [b""]
    problems = [] if first in stop else [f"{first!r} is written before the stop"]
    return problems + [f"{frame!r} moves the robot after its stop" for frame in later if frame in motion]


def _repeated(protocol: Protocol, recording: Transcript) -> str | None:
    standing, stopped = _established(protocol, recording), _established(protocol, recording)
    idle = set(standing.run(WATCHED_S))
    standing.robot.stop(standing.now, standing.now)
    stop = set(standing.run(WATCHED_S)) - idle
    stopped.robot.stop(stopped.now, stopped.now + STOP_S)
    stopped.run(STOP_S / 2)
    again = stop.intersection(stopped.run(STOP_S / 2))
    return None if again or not stop else f"it is not written again in the second half of {STOP_S:g} s"


def check_commands(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check that every fleet command and query has an effect or is refused."""
    for topic, commands in _commands(protocol):
        claim = f"{topic.path} is carried out or refused with a code"
        obey = partial(_obeyed, protocol, recording, topic, commands, claim)
        yield CheckFinding.tried(claim, obey, "an Outcome, or Refused")
    yield _corners(protocol, recording)
    for topic in (topics.MAP, topics.POSE):
        claim = f"a question for {topic.path} is answered, asked or refused"
        ask = partial(_question, protocol, recording, topic, claim)
        yield CheckFinding.tried(claim, ask, "a question to the robot, or Refused")


def _obeyed(
    protocol: Protocol, recording: Transcript, topic: Topic, commands: tuple[FleetMessage, ...], claim: str
) -> CheckFinding:
    rehearsal = _established(protocol, recording)
    results = [_carry_out(rehearsal, topic, command) for command in commands]
    silent = None if any(results) else "accepted, but nothing is written, shown, refused or left out"
    return CheckFinding(claim, silent, next(filter(None, results), ""))


def _corners(protocol: Protocol, recording: Transcript) -> CheckFinding:
    claim, problems = "drives at full scale are carried out or refused", []
    for forward, left, turn in itertools.product((-1.0, 0.0, 1.0), repeat=3):
        drive = Drive(forward=forward, left=left, turn=turn)
        try:
            rehearsal = _established(protocol, recording)
            with contextlib.suppress(Refused):
                rehearsal.robot.command(topics.CMD_DRIVE, drive, rehearsal.now)
            rehearsal.run(STEP_S)
        except Exception as error:
            problems.append(f"{drive}: {raised(error, 'an Outcome, or Refused')}")
    return CheckFinding.of(claim, problems)


def _commands(protocol: Protocol) -> tuple[tuple[Topic, tuple[FleetMessage, ...]], ...]:
    return (*COMMANDS, (topics.CMD_RAW(protocol.name), (Raw(200, b"body"), Raw(1, b""))))


def _question(protocol: Protocol, recording: Transcript, topic: Topic, claim: str) -> CheckFinding:
    rehearsal = _established(protocol, recording)
    idle = set(rehearsal.run(WATCHED_S))
    try:
        if rehearsal.robot.known(topic) is not None:
            return CheckFinding(claim, None, "answered")
        rehearsal.robot.ask(topic)
    except Refused as refusal:
        return CheckFinding(claim, None, refusal.code)
    asked = set(rehearsal.run(WATCHED_S)) - idle
    return CheckFinding(claim, None, "asked") if asked else CheckFinding(claim, "nothing is written for it")


def _carry_out(rehearsal: Rehearsal, topic: Topic, command: FleetMessage) -> str:
    """Return the outcome of a command; empty if it had none."""
    idle = set(rehearsal.run(WATCHED_S))
    outcome = _give(rehearsal, topic, command)
    if outcome:
        return outcome
    if set(rehearsal.run(WATCHED_S)) - idle:
        return "carried out"
    if rehearsal.session.over:
        raise RuntimeError(f"the session ended: {rehearsal.session.reason}")
    return ""


def _give(rehearsal: Rehearsal, topic: Topic, command: FleetMessage) -> str:
    """Send a command; return its code if it is refused, and what it publishes or leaves out."""
    try:
        outcome = rehearsal.robot.command(topic, command, rehearsal.now)
    except Refused as refusal:
        return str(refusal.code)
    except EncodeError:
        return "malformed"
    return "left out" if outcome.left_out else "shown" if outcome.telemetry else ""


def _established(protocol: Protocol, recording: Transcript) -> Rehearsal:
    rehearsal = Rehearsal(protocol, recording)
    frames = rehearsal.establish()
    rehearsal.play(recording.received[frames : frames + MORE_FRAMES])
    if rehearsal.session.state is not State.ESTABLISHED:
        raise RuntimeError(f"{rehearsal.session!r} after what established it before")
    return rehearsal


FORWARD = Drive(forward=0.5)
COMMANDS: tuple[tuple[Topic, tuple[FleetMessage, ...]], ...] = (
    (topics.CMD_DRIVE, (FORWARD, Drive(turn=0.5), Drive(left=0.5), Drive(forward=-0.5, left=0.1, light=True), Drive())),
    (topics.CMD_MODE, (Mode(mode="manual"), Mode(mode="autonomous"), Mode(mode="none"))),
    (topics.CMD_LIGHT, (Switch(on=True), Switch(on=False))),
    (topics.CMD_LIDAR, (Switch(on=True), Switch(on=False))),
    (topics.CMD_CAMERA, (Switch(on=True), Switch(on=False))),
    (topics.CMD_TEXT, (Text(text="hello"), Text(text="Grüße"), Text(text=""))),
    (topics.CMD_SCAN, (Scan(-1.0, 0.5, 0.1, 10.0, np.array([1.0, 2.0, np.nan], np.float32)),)),
    (topics.CMD_MOTOR("nobody"), (Motor(1.0), Motor(0.0))),
    (topics.CMD_SENSOR("nobody"), (SensorSetting(enable=True), SensorSetting(index=0, value=1.0))),
    (topics.CMD_RAW("nobody"), (Raw(1, b"body"),)),
)
"""Every fleet command but the protocol's own raw ones."""
