"""Conformance of sessions: established against the simulated robot; garbage, silence and the end at each step."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

from zbridge.errors import ProtocolError
from zbridge.fleet import payload as payloads
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import State
from zbridge.simulation.check_stage import CheckFinding, Rehearsal, Transcript, raised, robot_of

STEPS = 12
"""Steps of a long handshake at which something goes wrong."""
SEEDS = 4
GARBAGE_BYTES = 80
STAMP_NS, STAMP_WITHIN_NS = 10**18, 10**10
"""When the robot's messages arrive, and the tolerance of their stamps: a robot may have its own clock."""


def check_sessions(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check the session of the driving link."""
    yield CheckFinding("the session with the simulated robot is established", recording.reason)
    if not recording.established:
        return
    yield CheckFinding.of(
        f"{len(recording.messages)} messages of the robot are translated", _translated(protocol, recording)
    )
    count = recording.unanswered
    without = f"{count} had no answer in time: see expects, answers and frame_end" if count else None
    yield CheckFinding("the simulated robot answers every request", without)
    try:
        steps = _steps(protocol, recording)
    except Exception as error:
        problem = raised(error, "the same session again")
        yield CheckFinding("what the robot said establishes a session again", problem)
        return
    tried = f"each step of the handshake ({len(steps)})"
    for claim, go_wrong in (("garbage", _garbage), ("silence", _silence), ("the end of the connection", _lost)):
        problems = [problem for step in steps for problem in _at(step, protocol, recording, go_wrong)]
        yield CheckFinding.of(f"{claim} at {tried} ends or spares the session", problems)


def _steps(protocol: Protocol, recording: Transcript) -> list[int]:
    """List the numbers of frames after which a fault occurs: 0, all of the handshake, and some between."""
    rehearsal = Rehearsal(protocol, recording)
    frames = rehearsal.establish()
    if rehearsal.session.state is not State.ESTABLISHED:
        raise ProtocolError(f"{rehearsal.session!r} after the {frames} frames that established it before")
    return sorted({round(frames * step / STEPS) for step in range(STEPS + 1)} | {frames})


def _at(
    step: int,
    protocol: Protocol,
    recording: Transcript,
    go_wrong: Callable[[Rehearsal, list[bytes]], Iterator[str]],
) -> Iterator[str]:
    try:
        for seed in range(SEEDS):
            rehearsal = Rehearsal(protocol, recording)
            rehearsal.play(recording.received[:step])
            noise = random.Random(seed).randbytes(GARBAGE_BYTES)
            for problem in go_wrong(rehearsal, [noise, *recording.received[step : step + 3]]):
                yield f"after {step} frames: {problem}"
    except Exception as error:  # whatever the protocol's own code raises is a finding
        yield f"after {step} frames: {raised(error, 'a session that continues, or Session.fail with a reason')}"


def _garbage(rehearsal: Rehearsal, frames: list[bytes]) -> Iterator[str]:
    rehearsal.play(frames)
    rehearsal.run(1.0)
    yield from _without_reason(rehearsal)


def _silence(rehearsal: Rehearsal, frames: list[bytes]) -> Iterator[str]:
    limit_s = rehearsal.session.limits.handshake_s + 1.0
    rehearsal.run(limit_s, answers=False)
    if rehearsal.session.state in (State.CONNECTING, State.HANDSHAKING):
        yield f"still {rehearsal.session.state.value} after {limit_s:g} s of silence"
    yield from _without_reason(rehearsal)


def _lost(rehearsal: Rehearsal, frames: list[bytes]) -> Iterator[str]:
    session = rehearsal.session
    session.fail("closed by peer")
    rehearsal.run(1.0)
    if session.state is not State.CLOSED or session.deadline() is not None or session.receive(frames[0], rehearsal.now):
        yield f"{session!r} still does something when its connection is gone"
    yield from _without_reason(rehearsal)


def _without_reason(rehearsal: Rehearsal) -> Iterator[str]:
    if rehearsal.session.over and not rehearsal.session.reason:
        yield "ended without a reason"


def _translated(protocol: Protocol, recording: Transcript) -> list[str]:
    """Translate what the robot sent; telemetry must have its topic's message."""
    robot, problems = robot_of(protocol), []
    for name in robot.link_names:
        robot.session(name, "tcp://robot.test:1")
    if not recording.messages:
        problems.append("the simulated robot sent none")
    for stamp_ns, message in enumerate(recording.messages, STAMP_NS):
        try:
            for topic, shown in robot.telemetry(message, stamp_ns):
                payloads.decode(topic.message, payloads.encode(shown))
                stamped = getattr(shown, "stamp_ns", None)
                if stamped is not None and abs(stamped - stamp_ns) > STAMP_WITHIN_NS:
                    problems.append(f"{topic.path} has the stamp {stamped}, given was {stamp_ns}")
        except ProtocolError:
            continue
        except Exception as error:
            problems.append(f"{message}: {raised(error, 'telemetry of its topics, or ProtocolError')}")
    return problems
