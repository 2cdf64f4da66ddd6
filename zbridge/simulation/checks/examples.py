"""Conformance of examples: the bytes of the maker's manual mean what the protocol's author says."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

from zbridge.errors import ProtocolError
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Codec, Example, Protocol
from zbridge.simulation.checks.finding import CheckFinding, brief
from zbridge.simulation.checks.rehearsal import PEER, Rehearsal, Transcript, robot_of

GUIDE = "8. The protocol: Examples"
_STAMP_NS = 10**18
_SETTLED_S = 0.5


def check_examples(protocol: Protocol) -> Iterator[CheckFinding]:
    """Check every example both ways, and list the messages that have none."""
    codecs = {codec.name: codec for codec in protocol.codecs}
    for number, example in enumerate(protocol.examples, 1):
        claim = f"example {number}, {example.source or 'without a source'}: {type(example.message).__qualname__}"
        codec = codecs.get(example.codec)
        if codec is None:
            problem = f"Example.codec is {example.codec!r}, expected one of {', '.join(codecs)}"
            yield CheckFinding(claim, problem, guide=GUIDE)
            continue
        find = partial(_compare, protocol, codec, example)
        yield CheckFinding.tried(claim, find, "the message and the frame of the example", GUIDE)
    for codec in protocol.codecs:
        known = {type(example.message) for example in protocol.examples if example.codec == codec.name}
        kinds = {each if isinstance(each, type) else type(each) for each in codec.messages}
        lacking = sorted(kind.__qualname__ for kind in kinds - known)
        if lacking:
            claim = f"{codec.name}: bytes and scales are the maker's: {', '.join(lacking)}"
            why = "no example in Protocol.examples; a fault that session and simulated robot share is not detectable"
            yield CheckFinding.not_checked(claim, why, GUIDE)


def check_example_commands(protocol: Protocol, recording: Transcript) -> Iterator[CheckFinding]:
    """Check that each command of an example makes the robot side write the example's frame."""
    for number, example in enumerate(protocol.examples, 1):
        if example.command is not None:
            claim = (
                f"example {number}, {example.source or 'without a source'}: {brief(example.command)} writes this frame"
            )
            yield CheckFinding.tried(claim, partial(_commanded, protocol, recording, example), "a drive", GUIDE)


def _compare(protocol: Protocol, codec: Codec, example: Example) -> list[str]:
    problems, frame = [], example.frame
    end = codec.frame_end(frame, 0)
    if end != len(frame):
        problems.append(f"frame_end({frame!r}, 0) is {end}, expected {len(frame)}")
    try:
        found = codec.read(frame)
    except ProtocolError as error:
        return [*problems, f"{frame!r} is read as ProtocolError: {error}; expected {example.message}"]
    if found != example.message:
        problems.append(f"{frame!r} is read as {found}, expected {example.message}")
    written = codec.write(example.message)
    if written != frame:
        problems.append(f"{example.message} is written as {written!r}, expected {frame!r}")
    return problems + (_compare_shown(protocol, found, example) if example.shown else [])


def _compare_shown(protocol: Protocol, message: Any, example: Example) -> list[str]:
    robot = robot_of(protocol)
    for name in robot.link_names:
        robot.session(name, PEER)
    codec = next(codec for codec in protocol.codecs if codec.name == example.codec)
    for at_s, earlier in enumerate(example.before):
        list(robot.telemetry(codec.read(earlier), _STAMP_NS + at_s * 10**9))
    shown = dict(numbers(robot.telemetry(message, _STAMP_NS + len(example.before) * 10**9)))
    problems = []
    for name, expected in example.shown.items():
        if name not in shown:
            problems.append(
                f"{message} does not show {name}, but {', '.join(shown) or 'nothing'}; expected {expected:g}"
            )
        elif not math.isclose(shown[name], expected, rel_tol=1e-3, abs_tol=1e-6):
            problems.append(f"{message} shows {name} = {shown[name]:g}, expected {expected:g}")
    return problems


def _commanded(protocol: Protocol, recording: Transcript, example: Example) -> str | None:
    assert example.command is not None
    rehearsal = Rehearsal.established(protocol, recording)
    rehearsal.run(_SETTLED_S)
    written, outcome = rehearsal.drive(example.command, _SETTLED_S)
    if outcome is None:
        return f"{brief(example.command)} is refused"
    return (
        None
        if rehearsal.session.undated(example.frame) in written
        else f"{sorted(set(written))} is written, expected {example.frame!r} among it"
    )


def numbers(telemetry: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of telemetry by path and field: ``("battery.voltage", 12.1)``; those of a scan one by one."""
    pairs: list[tuple[Topic, FleetMessage]] = list(telemetry)
    for topic, message in pairs:
        for name in set(message.__struct_fields__) - {"stamp_ns", "seq", "device_ms"}:
            value = getattr(message, name)
            values = value.ravel().tolist() if hasattr(value, "ravel") else value
            for each in values if isinstance(values, tuple | list) else (values,):
                if isinstance(each, int | float):
                    yield f"{topic.path}.{name}", float(each)
