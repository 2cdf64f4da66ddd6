"""Conformance of commands: each is carried out or refused with a code, and nothing of it is dropped in silence."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from functools import partial

import msgspec
import numpy as np

from zbridge.errors import EncodeError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw, Scan, SensorSetting, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Protocol
from zbridge.simulation.checks.examples import check_example_commands
from zbridge.simulation.checks.finding import CheckFinding, brief, raised
from zbridge.simulation.checks.rehearsal import STEP_S, Rehearsal, Transcript

WATCHED_S = 0.4
"""Virtual seconds within which a command must have an effect."""


def check_commands(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check that every fleet command and query has an effect or is refused."""
    for topic, commands in commands_of(protocol):
        claim = f"{topic.path} is carried out or refused with a code"
        obey = partial(_obeyed, protocol, recording, topic, commands, claim)
        yield CheckFinding.tried(claim, obey, "an Outcome, or Refused", GUIDE)
    yield _corners(protocol, recording)
    claim = "no part of a drive is dropped without Outcome.left_out"
    yield CheckFinding.tried(claim, partial(_dropped, protocol, recording), "an Outcome, or Refused", GUIDE)
    yield from check_example_commands(protocol, recording)
    for topic in (topics.MAP, topics.POSE):
        claim = f"a question for {topic.path} is answered, asked or refused"
        ask = partial(_question, protocol, recording, topic, claim)
        yield CheckFinding.tried(claim, ask, "a question to the robot, or Refused", "6. Commands: Queries")


def _obeyed(
    protocol: Protocol, recording: Transcript, topic: Topic, commands: tuple[FleetMessage, ...], claim: str
) -> CheckFinding:
    rehearsal = Rehearsal.established(protocol, recording)
    results = [_carry_out(rehearsal, topic, command) for command in commands]
    silent = None if any(results) else "accepted, but nothing is written, shown, refused or left out"
    return CheckFinding(claim, silent, next(filter(None, results), ""))


def _corners(protocol: Protocol, recording: Transcript) -> CheckFinding:
    claim, problems = "drives at full scale are carried out or refused", []
    for forward, left, turn in itertools.product((-1.0, 0.0, 1.0), repeat=3):
        drive = Drive(forward=forward, left=left, turn=turn)
        try:
            rehearsal = Rehearsal.established(protocol, recording)
            with contextlib.suppress(Refused):
                rehearsal.robot.command(topics.CMD_DRIVE, drive, rehearsal.now)
            rehearsal.run(STEP_S)
        except Exception as error:
            problems.append(f"{brief(drive)}: {raised(error, 'an Outcome, or Refused')}")
    return CheckFinding.of(claim, problems, guide=GUIDE)


def _dropped(protocol: Protocol, recording: Transcript) -> list[str]:
    """Find parts of a drive that change nothing of what is written, and are not reported."""
    base = Drive(forward=0.5)
    without, _ = _settled(protocol, recording).drive(base, WATCHED_S)
    problems = []
    for part, values in (("left", (0.5, -0.5)), ("turn", (0.5, -0.5)), ("light", (True, False))):
        drives = [msgspec.structs.replace(base, **{part: value}) for value in values]
        results = [_settled(protocol, recording).drive(drive, WATCHED_S) for drive in drives]
        same = all(outcome is not None and set(written) == set(without) for written, outcome in results)
        reported = any(outcome is not None and part in (outcome.left_out or "") for _, outcome in results)
        if same and not reported:
            found = results[0][1]
            said = found.left_out if found is not None else None
            same_as = f"{brief(drives[0])} writes what {brief(base)} writes"
            problems.append(f"{same_as}, and left_out is {said!r}; expected one that names {part}")
    return problems


def _settled(protocol: Protocol, recording: Transcript) -> Rehearsal:
    rehearsal = Rehearsal.established(protocol, recording)
    rehearsal.run(WATCHED_S)
    return rehearsal


def commands_of(protocol: Protocol) -> tuple[tuple[Topic, tuple[FleetMessage, ...]], ...]:
    """List every command that the kit tries, with examples."""
    return (*COMMANDS, (topics.CMD_RAW(protocol.name), (Raw(200, b"body"), Raw(1, b""))))


def _question(protocol: Protocol, recording: Transcript, topic: Topic, claim: str) -> CheckFinding:
    rehearsal = Rehearsal.established(protocol, recording)
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


GUIDE = "6. Commands: Commands"
FORWARD = Drive(forward=0.5)
DRIVES = (FORWARD, Drive(turn=0.5), Drive(turn=-0.5), Drive(forward=-0.5), Drive(forward=0.5, turn=0.5))
"""Drives that move a robot in different ways."""
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
