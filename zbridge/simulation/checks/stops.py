"""Conformance of stops: written first, repeated, in the slot of the motion, and nothing moves the robot after them."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import partial

from zbridge.errors import EncodeError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive
from zbridge.protocol.plugin import Protocol
from zbridge.simulation.checks.commands import DRIVES, commands_of
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.rehearsal import Rehearsal, Transcript, named, robot_of

STOP_S = 0.5
"""Seconds for which the stop is repeated."""
WATCHED_S = 0.4
"""Virtual seconds within which a command must have an effect."""
LATER_S = 2.5
"""Virtual seconds after a stop for which nothing may move the robot."""
LATE_S = 0.1
WAITING = b"what waits"
GUIDE = "6. Commands: Stops"


def check_stops(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check that the stop is written next, and that waiting motion is not sent after it."""
    expected = "a stop that is put into the outbox"
    for claim, find in (
        ("the stop goes before all that waits, and no motion after it", _stop),
        ("a stop is repeated until its time is over", _repeated),
        ("what is repeated beside the motion is repeated after a stop", _beside),
        ("a stop before the first connection is refused or ignored", _early),
        ("stop_frames() returns what a stop writes, and changes nothing", _frames),
    ):
        yield CheckFinding.tried(claim, partial(find, protocol, recording), expected, GUIDE)


def _early(protocol: Protocol, _: Transcript) -> None:
    with contextlib.suppress(Refused):
        robot_of(protocol).stop(0.0, 0.0)


class _Frames:
    """What is written of itself, for each drive, and for a stop after it."""

    def __init__(self, protocol: Protocol, recording: Transcript) -> None:
        standing = Rehearsal.established(protocol, recording)
        self.idle = set(standing.run(WATCHED_S))
        standing.robot.stop(standing.now, standing.now)
        after = [set(standing.run(WATCHED_S))]
        self.motion: set[bytes] = set()
        for drive in DRIVES:
            driven = Rehearsal.established(protocol, recording)
            driven.run(WATCHED_S)
            self.motion |= set(driven.drive(drive, WATCHED_S)[0]) - self.idle - after[0]
            driven.robot.stop(driven.now, driven.now)
            after.append(set(driven.run(WATCHED_S)))
        stops = [frames - self.motion for frames in after]
        self.stop = {frame for frames in stops for frame in frames - self.idle or frames}


def _stop(protocol: Protocol, recording: Transcript) -> list[str]:
    frames = _Frames(protocol, recording)
    if not frames.stop:
        return [f"{type(robot_of(protocol)).__qualname__}.stop writes nothing"]
    if not frames.motion:
        return ["a drive writes nothing that a stop does not write: nothing can be told from it"]
    problems = []
    for drive in DRIVES:
        for taken in (0, 1):
            queued = _crowd(protocol, recording, frames.idle, drive, taken)
            queued.robot.stop(queued.now, queued.now + STOP_S)
            first, *later = queued.run(LATER_S) or [b""]
            if first not in frames.stop:
                problems.append(f"{named(protocol, first)} is written before the stop")
            moving = (frame for frame in later if frame in frames.motion)
            problems += [f"{named(protocol, frame)} moves the robot after its stop" for frame in moving]
    return list(dict.fromkeys(problems))


def _crowd(protocol: Protocol, recording: Transcript, idle: set[bytes], drive: Drive, taken: int) -> Rehearsal:
    """Queue commands, a request and polls. taken: how many are then written, as slots and queue alternate."""
    queued = Rehearsal.established(protocol, recording)
    for topic, commands in commands_of(protocol):
        for command in commands if topic is not topics.CMD_MODE else ():
            with contextlib.suppress(Refused, EncodeError):
                queued.command(topic, command)
    with contextlib.suppress(Refused):
        queued.command(topics.CMD_DRIVE, drive)
    for _ in range(2):
        queued.session.outbox.put(next(iter(idle), WAITING))
    queued.now += LATE_S  # a poll is due too
    for _ in range(taken):
        queued.session.outgoing(queued.now)
        queued.session.outbox.written(queued.now)
    return queued


def _repeated(protocol: Protocol, recording: Transcript) -> str | None:
    frames = _Frames(protocol, recording)
    stopped = Rehearsal.established(protocol, recording)
    stopped.drive(DRIVES[0], WATCHED_S)
    stopped.robot.stop(stopped.now, stopped.now + STOP_S)
    stopped.run(STOP_S / 2)
    again = frames.stop.intersection(stopped.run(STOP_S / 2))
    if again or not frames.stop:
        return None
    return f"{_list(protocol, frames.stop)} is not written again in the second half of {STOP_S:g} s"


def _beside(protocol: Protocol, recording: Transcript) -> list[str]:
    """Find polls and keep-alives whose slot the stop took."""
    watched_s = 2.0
    standing, stopped = Rehearsal.established(protocol, recording), Rehearsal.established(protocol, recording)
    standing.run(WATCHED_S)
    stopped.run(WATCHED_S)
    repeated = {frame for frame, count in Counter(standing.run(watched_s)).items() if count > 1}
    stopped.drive(DRIVES[0], WATCHED_S)
    stopped.robot.stop(stopped.now, stopped.now + STOP_S)
    stopped.run(STOP_S)
    written = set(stopped.run(watched_s))
    return [f"{named(protocol, frame)} is repeated before a stop, and not after it" for frame in repeated - written]


def _frames(protocol: Protocol, recording: Transcript) -> CheckFinding | list[str]:
    claim = "stop_frames() returns what a stop writes, and changes nothing"
    frames = _Frames(protocol, recording)
    driven, other = Rehearsal.established(protocol, recording), Rehearsal.established(protocol, recording)
    for each in (driven, other):
        each.drive(DRIVES[0], WATCHED_S)
    returned = driven.robot.stop_frames()
    if not returned:
        kind = type(driven.robot).__qualname__
        return CheckFinding.not_checked(claim, f"{kind}.stop_frames() is empty: nobody stops it if its gateway dies")
    foreign = [frame for frame in returned if driven.session.undated(frame) not in frames.stop | frames.idle]
    problems = [f"{frame!r} is none of what a stop writes: {_list(protocol, frames.stop)}" for frame in foreign]
    if driven.run(WATCHED_S) != other.run(WATCHED_S):
        problems.append("calling it changes what is written next")
    return problems


def _list(protocol: Protocol, frames: Iterable[bytes]) -> str:
    return ", ".join(named(protocol, frame) for frame in sorted(frames))
