"""Conformance of sessions: they are established; garbage, silence and the end at each step end or spare them."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from functools import partial

from zbridge.errors import ProtocolError
from zbridge.fleet import payload as payloads
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import State
from zbridge.simulation.checks.finding import CheckFinding, raised
from zbridge.simulation.checks.rehearsal import PEER, Rehearsal, Transcript, named, robot_of

ESTABLISHED = "the session with the simulated robot is established"
STEPS = 12
"""Steps of a long handshake at which something goes wrong."""
SEEDS = 4
GARBAGE_BYTES = 80
STAMP_NS, APART_NS, STAMP_WITHIN_NS = 10**18, 10**8, 10**10
"""When the robot's messages arrive, and the tolerance of their stamps: a robot may have its own clock."""


SILENT_S = 60.0
"""Virtual seconds of silence after which an established session must have noticed."""
_TICK_S = 0.25
_GUIDE, _STREAMING = "3. The session", "4. A robot that sends by itself"


def check_sessions(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check the session of the driving link."""
    yield CheckFinding(ESTABLISHED, recording.reason, guide=_GUIDE)
    if not recording.established:
        return
    claim, guide = f"{len(recording.messages)} messages of the robot are translated", "5. Telemetry"
    if recording.messages or Rehearsal(protocol, recording).session.silent_s != math.inf:
        yield CheckFinding.of(claim, _translated(protocol, recording), guide=guide)
    else:
        yield CheckFinding.not_checked(claim, "the simulated robot sent none, which it may", guide)
    count = recording.unanswered
    if count is not None:
        without = f"{count} had no answer in time: see expects, answers and frame_end" if count else None
        yield CheckFinding("the simulated robot answers every request", without, guide=_GUIDE)
    try:
        steps = _steps(protocol, recording)
    except Exception as error:
        problem = raised(error, "the same session again")
        yield CheckFinding("what the robot said establishes a session again", problem, guide=_GUIDE)
        return
    tried = f"each step of the handshake ({len(steps)})"
    for claim, go_wrong in (("garbage", _garbage), ("silence", _silence), ("the end of the connection", _lost)):
        problems = [problem for step in steps for problem in _at(step, protocol, recording, go_wrong)]
        yield CheckFinding.of(f"{claim} at {tried} ends or spares the session", problems, guide=_GUIDE)
    claim = "a robot that falls silent is not driven"
    find = partial(_falls_silent, claim, protocol, recording)
    yield CheckFinding.tried(claim, find, "Session.busy, or its end", _STREAMING)
    claim = "the keep-alive is written in time for the robot's watchdog"
    if Rehearsal(protocol, recording).session.keep_alive is not None:
        yield CheckFinding.tried(claim, partial(_kept_alive, claim, protocol, recording), "a keep-alive", _STREAMING)


def _falls_silent(claim: str, protocol: Protocol, recording: Transcript) -> CheckFinding:
    rehearsal = Rehearsal.established(protocol, recording)
    session, begun = rehearsal.session, rehearsal.now
    kind = type(session).__qualname__
    if session.busy is not None:
        return CheckFinding.not_checked(claim, f"{kind} is busy from the start: {session.busy}")
    while rehearsal.now < begun + SILENT_S and not session.over and session.busy is None:
        rehearsal.run(_TICK_S, answers=False)
    if session.over or session.busy is not None:
        after_s, silent_s = rehearsal.now - begun, session.silent_s
        note = f"after {after_s:g} s: {session.busy or session.reason}"
        late = silent_s is not None and after_s > silent_s + 2 * _TICK_S
        return CheckFinding(
            claim, f"{note}; expected within silent_s = {silent_s:g}" if late else None, "" if late else note
        )
    if session.silent_s == math.inf:
        return CheckFinding.not_checked(claim, f"{kind}.silent_s is inf: a healthy robot may be silent")
    problem = f"{kind} is established and not busy after {SILENT_S:g} s without a message: set silent_s and lost_s"
    return CheckFinding(claim, problem)


def _kept_alive(claim: str, protocol: Protocol, recording: Transcript) -> CheckFinding:
    rehearsal = Rehearsal.established(protocol, recording)
    session, keep_alive = rehearsal.session, rehearsal.session.keep_alive
    kind = type(session).__qualname__
    assert keep_alive is not None
    if keep_alive.period_s > keep_alive.watchdog_s / 2:
        problem = (
            f"{kind}.keep_alive.period_s is {keep_alive.period_s:g}, expected {keep_alive.watchdog_s / 2:g} or less"
        )
        return CheckFinding(claim, f"{problem}, half of watchdog_s: one may be lost")
    frame = session.undated(session.encode(keep_alive.message))
    for _ in range(3):
        written = rehearsal.run(keep_alive.period_s * 1.2)
        if frame not in written:
            seen = ", ".join(sorted({named(protocol, each) for each in written})) or "nothing"
            problem = f"{named(protocol, frame)} is not written within {keep_alive.period_s * 1.2:g} s, but {seen}"
            return CheckFinding(claim, problem)
    return CheckFinding(claim)


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
        robot.session(name, PEER)
    if not recording.messages:
        problems.append("the simulated robot sent none")
    for number, message in enumerate(recording.messages):
        stamp_ns = STAMP_NS + number * APART_NS
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
