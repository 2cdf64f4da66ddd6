"""The conformance kit: a sound protocol passes, and each check fails for a protocol that is broken in its way."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.clock import at_once
from tests.e2e.other_package import toyrobot as toy
from zbridge.errors import ConfigError
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Switch
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Outcome, Protocol, Simulation
from zbridge.protocol.session import Session
from zbridge.simulation import check as kit
from zbridge.simulation.checks.commands import check_commands
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.messages import check_messages
from zbridge.simulation.checks.motion import check_motion
from zbridge.simulation.checks.package import check_package
from zbridge.simulation.checks.rehearsal import Transcript
from zbridge.simulation.checks.sessions import check_sessions
from zbridge.simulation.checks.stage import live, record
from zbridge.simulation.checks.stops import check_stops

TOY: Protocol = toy.PROTOCOL


waiting = asyncio.run


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the kit and the toy on a clock that jumps."""
    monkeypatch.setattr(asyncio, "run", at_once)


@pytest.fixture(scope="module")
def heard() -> Transcript:
    """What the sound robot says."""
    return at_once(record(TOY, 5.0))


def failed(findings: Iterable[CheckFinding]) -> dict[str, str]:
    return {finding.claim: finding.problem for finding in findings if finding.problem is not None}


def assert_found(findings: Iterable[CheckFinding], expected: dict[str, str]) -> None:
    """Each claim with these words failed for a problem that says so, and no other claim failed."""
    found = failed(findings)
    for claim, problem in expected.items():
        assert any(claim in one and problem in found[one] for one in found), found
    assert [one for one in found if not any(claim in one for claim in expected)] == []


def motion(protocol: Protocol) -> list[CheckFinding]:
    async def drive() -> list[CheckFinding]:
        async with live(protocol) as stage:
            assert await stage.established(5.0)
            return await check_motion(protocol, stage)

    return at_once(drive())


def claims(value: object) -> str:
    """Name a row of a table by the claims that fail."""
    return "; ".join(value) or "sound" if isinstance(value, dict) else ""


toy_end = TOY.codecs[0].frame_end
broken = partial(msgspec.structs.replace, TOY)
"""The toy with other parts."""


def with_codec(**parts: Any) -> Protocol:
    return broken(codecs=(msgspec.structs.replace(TOY.codecs[0], **parts),))


def with_robot(**methods: Callable[..., Any]) -> Protocol:
    return broken(robot=type("BrokenRobot", (toy.ToyRobot,), methods))


def with_session(**methods: Any) -> Protocol:
    session_class = type("BrokenSession", (toy.ToySession,), methods)

    def session(self: Any, link: str, peer: str) -> Session[Any]:
        self._session = session_class(toy.Limits(frame_bytes=100, handshake_s=5.0))
        return self._session

    return with_robot(session=session)


# The protocol object, and its messages


class Listed(msgspec.Struct):
    """A message with a field of which the kit knows no example."""

    names: list[str]


def breaks_on_noise(frame: bytes) -> Any:
    return {b"at": toy.read}[frame.split(b" ")[0]](frame)


ROUND_TRIP, CUTS, NOISE = "lines: 1 messages round-trip", "lines: whole, byte by byte", "lines: random bytes"
TRUNCATED, NAME = "lines: what is cut off", "the protocol has the name of its entry point"
DAMAGED = "lines: any fields behind a right checksum"
TEMPLATE, SHOWN = "the template is a configuration of this protocol", "a session can be shown"


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [
        (TOY, {}),
        (broken(name="toys"), {NAME: "the entry point is 'toy', Protocol.name is 'toys'", TEMPLATE: "not 'toys'"}),
        (broken(template=""), {TEMPLATE: "it has no table [device]"}),
        (broken(template='[device]\nprotocol = "toy"\n'), {TEMPLATE: "it has no connect"}),
        (broken(template=toy.TEMPLATE + "[device.options]\nx = 1\n"), {TEMPLATE: "unknown field `x`"}),
        (with_session(role=None), {SHOWN: "role is None, not Role.HQ"}),
        (with_session(version=property(lambda self: 1 / 0)), {SHOWN: "Error"}),
        (broken(codecs=()), {"messages are declared": "codecs is empty"}),
        (with_codec(read=lambda frame: toy.At(toy.read(frame).x, 0.0, 0.0)), {ROUND_TRIP: "which is read as"}),
        (with_codec(write=lambda message: 1 / 0), {ROUND_TRIP: "ZeroDivisionError"}),
        (with_codec(messages=(object,)), {ROUND_TRIP: "object: the kit can make no example"}),
        (
            with_codec(messages=(Listed,)),
            {
                ROUND_TRIP: "Listed: the kit can make no example (Listed.names: list[str]: "
                "expected one of int, float, bool, str, bytes, or a default): list an instance in Codec.messages"
            },
        ),
        (with_codec(frame_end=lambda data, start: start + 1000), {CUTS: "is cut to []"}),
        (with_codec(read=breaks_on_noise), {NOISE: "test_check.py:", DAMAGED: "KeyError"}),
        (
            with_codec(frame_end=lambda data, start: start if data[start] == 0 else toy_end(data, start)),
            {NOISE: "tests.simulation.test_check.<lambda> returned a frame of 0 bytes, expected 1 or more"},
        ),
        (
            with_codec(
                frame_end=lambda data, start: len(data),
                read=lambda frame: toy.read(frame) if frame.endswith(b"\n") else 1 / 0,
            ),
            {
                CUTS: "byte by byte is cut to",
                TRUNCATED: "ZeroDivisionError",
                NOISE: "ZeroDivisionError",
                DAMAGED: "ZeroDi",
            },
        ),
        (
            with_codec(
                frame_end=lambda data, start: len(data) + (not data.endswith(b"\n")),
                messages=(toy.At(1, 2, 3), toy.At(4, 5, 6)),
            ),
            {"lines: whole, byte by byte": "all messages joined"},
        ),
    ],
    ids=claims,
)
def test_a_broken_protocol_object_and_broken_messages_are_found(protocol: Protocol, expected: dict[str, str]) -> None:
    assert_found([*check_package(protocol, "toy"), *check_messages(protocol)], expected)


# Sessions

ESTABLISHED = "the session with the simulated robot is established"


@pytest.mark.parametrize(
    ("opened", "problem"),
    [
        (
            lambda self, now: None,
            "link robot (BrokenSession): still handshaking after 0.3 s; last written: nothing; last received: b'at 0.0",
        ),
        (lambda self, now: self.fail("I do not like it"), "link robot (BrokenSession): ended: I do not like it"),
        (lambda self, now: {}[1], "ended: a fault of the protocol: KeyError: 1 in <lambda> (test_check.py:"),
    ],
    ids=["never established", "ends at once", "raises"],
)
def test_a_session_that_is_not_established_is_found_with_its_reason(opened: Any, problem: str) -> None:
    protocol = with_session(opened=opened)
    assert_found(check_sessions(protocol, at_once(record(protocol, 0.3))), {ESTABLISHED: problem})


class Hasty(toy.ToySession):
    """Reads a field that nobody has set."""

    def opened(self, now: float) -> None:
        self.establish({"y": "1.0"}["x"], ())


def test_what_ends_a_session_names_class_field_and_expectation_and_no_time_that_nobody_waited() -> None:
    protocol = with_session(opened=Hasty.opened)
    (problem,) = failed(check_sessions(protocol, at_once(record(protocol, 10.0)))).values()
    assert re.sub(r":\d+", "", problem) == (
        "link robot (BrokenSession): ended: a fault of the protocol: KeyError: 'x' in Hasty.opened (test_check.py); "
        "last written: nothing; last received: nothing; "
        "expected ProtocolError for what a robot must not say, and no other exception"
    )


def test_a_robot_with_other_links_than_its_protocol_is_found() -> None:
    expected = "ValueError: BrokenRobot.link_names: (), expected 1 of them (Protocol.links)"
    assert_found(kit.check(with_robot(link_names=()), "toy"), {ESTABLISHED: expected})


GARBAGE, SILENCE, END = "garbage at", "silence at", "the end of the connection at"
SILENT = "a robot that falls silent is not driven"
TRANSLATED = "messages of the robot are translated"


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [
        (TOY, {}),
        (with_session(decode=lambda self, frame: breaks_on_noise(frame)), {GARBAGE: "KeyError"}),
        (
            with_session(
                opened=lambda self, now: self.lift_limit(),
                accept=lambda self, message, now: self.establish("7.0", ()),
            ),
            {SILENCE: "still handshaking after 6 s"},
        ),
        (
            with_session(fail=lambda self, reason: None),
            {END: "still does something", SILENCE: "deadline() is always due"},
        ),
        (
            with_session(timers=lambda self: 0.0),
            {"what the robot said establishes a session": "BrokenSession.timers() is always due: 0"},
        ),
        (
            with_robot(pose=lambda self, message, stamp_ns: {}[message.x]),
            {TRANSLATED: "KeyError", GARBAGE: "KeyError", SILENT: "KeyError"},
        ),
        (with_robot(pose=lambda *_: ((topics.POSE, Switch(on=True)),)), {TRANSLATED: "PayloadError"}),
        (
            with_robot(pose=lambda self, message, stamp_ns: toy.ToyRobot.pose(self, message, 0)),
            {TRANSLATED: "pose has the stamp 0, given was"},
        ),
    ],
    ids=claims,
)
def test_a_session_that_breaks_is_found(heard: Transcript, protocol: Protocol, expected: dict[str, str]) -> None:
    assert_found(check_sessions(protocol, heard), expected)


def test_a_silent_robot_and_requests_without_an_answer_are_found(heard: Transcript) -> None:
    lacking = msgspec.structs.replace(heard, messages=[], unanswered=3)
    expected = {"0 messages": "the simulated robot sent none", "the simulated robot answers": "3 had no answer"}
    assert_found(check_sessions(TOY, lacking), expected)


# Commands

STOP_FIRST = "the stop goes before all that waits, and no motion after it"
REPEATED = "a stop is repeated until its time is over"
STOP_EARLY = "a stop before the first connection is refused or ignored"
STILL = b"go 0.000000 0.000000\n"


@pytest.mark.parametrize(
    ("stop", "expected"),
    [
        (toy.ToyRobot.stop, {}),
        (lambda self, now, until: None, {STOP_FIRST: "BrokenRobot.stop writes nothing"}),
        (
            lambda self, now, until: self._session.outbox.put(STILL),
            {STOP_FIRST: "is written before the stop", REPEATED: "", STOP_EARLY: "AttributeError"},
        ),
        (
            lambda self, now, until: toy.ToyRobot._go(self, 0.0, 0.0, now, until=until),
            {STOP_FIRST: "b'what waits' is written before the stop"},
        ),
        (
            lambda self, now, until: toy.ToyRobot._go(self, 0.0, 0.0, now, until=now, urgent=True),
            {REPEATED: "is not written again"},
        ),
        (
            lambda self, now, until: self._session.outbox.set(
                "beside", (STILL,), now, period_s=0.1, until=until, urgent=True
            ),
            {STOP_FIRST: "moves the robot after its stop", STOP_EARLY: "AttributeError"},
        ),
    ],
    ids=["sound", "nothing", "last", "after what waits", "once", "beside the motion"],
)
def test_a_stop_that_is_not_first_or_does_not_last_is_found(heard: Transcript, stop, expected: dict[str, str]) -> None:
    assert_found(check_stops(with_robot(stop=stop), heard), expected)


DROPPED = "no part of a drive is dropped"
OTHERS = [f"@cmd/{name}" for name in ("mode", "light", "lidar", "camera", "text", "scan", "motor", "sensor", "raw")]
QUESTIONS = ("a question for map is answered", "a question for pose is answered")


def only_drives(self: Any, topic: Any, command: Any, now: float) -> Outcome:
    return toy.ToyRobot.command(self, topic, command, now) if isinstance(command, Drive) else Outcome()


@pytest.mark.parametrize(
    ("methods", "expected"),
    [
        ({}, {}),
        ({"command": only_drives}, dict.fromkeys(OTHERS, "accepted, but nothing is")),
        (
            {"command": lambda self, topic, command, now: {Drive: Outcome()}[type(command)]},
            {
                "@cmd/": "KeyError",
                DROPPED: "writes what Drive(forward=0.5",
            },
        ),
        ({"ask": lambda self, topic: None}, dict.fromkeys(QUESTIONS, "nothing is written for it")),
        (
            {"_go": lambda self, forward, turn, now: self._session.outbox.put({False: b"go"}[forward + turn == 2])},
            {
                "drives at full scale": "KeyError: True in <lambda> (test_check.py:",
                DROPPED: "expected one that names turn",
            },
        ),
    ],
    ids=claims,
)
def test_a_command_that_is_neither_carried_out_nor_refused_is_found(heard: Transcript, methods, expected) -> None:
    assert_found(check_commands(with_robot(**methods), heard), expected)


# Motion


def with_wheels(forwards: float, leftwards: float) -> Protocol:
    """The toy whose wheels do something else than they are told."""

    def go(self: Any, forward: float, turn: float, now: float, **more: Any) -> None:
        toy.ToyRobot._go(self, forward * forwards, turn * leftwards, now, **more)

    return with_robot(_go=go)


class Sized(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a robot that knows its full scale."""

    speed_full_m_s: float = 1.0
    turn_full_rad_s: float = 1.0


DRIVES, TURNS = "the simulated robot drives", "a turn of the simulated robot is counter-clockwise"
STANDS, WHOLE = "the simulated robot stands after its stop", "a stop ends a drive and a turn alike"
AHEAD, SPEED, RATE = "it drives ahead after a turn", "it drives as fast as", "it turns as fast as"


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [
        (with_wheels(0, 0), {DRIVES: "it moved 0.000 m", TURNS: "its heading changed by 0.", AHEAD: "0.000 m"}),
        (with_robot(stop=lambda self, now, until: None), {STANDS: "it moves on", WHOLE: "it moves on"}),
        (with_wheels(-1, -1), {DRIVES: "it moved -0.", TURNS: "its heading changed by -0.", AHEAD: "it moved -0."}),
        (broken(options=Sized), {}),
        (
            broken(options=Sized, simulated={"speed_full_m_s": 10.0, "turn_full_rad_s": 10.0}),
            {SPEED: "m/s, the options say 0.333 m/s", RATE: "rad/s, the options say 2.500 rad/s"},
        ),
    ],
    ids=["does not move", "does not stand", "goes the other way", "as the options say", "not as the options say"],
)
def test_a_simulated_robot_that_does_not_move_as_it_should_is_found(protocol: Protocol, expected) -> None:
    assert_found(motion(protocol), expected)


def test_a_simulation_that_cannot_start_is_found() -> None:
    async def simulate(simulation: Simulation) -> None:
        raise ConfigError("no")

    assert_found(kit.check(broken(simulate=simulate), "toy"), {ESTABLISHED: "ConfigError: no"})


# The command


def test_the_whole_check_passes_for_a_sound_protocol(monkeypatch, capsys) -> None:
    monkeypatch.setattr(kit, "find_protocol", lambda name: TOY)
    assert kit.main(["toy"]) == 0
    out = capsys.readouterr().out
    assert out.endswith("hold, 0 do not, 9 not checked\n")
    assert "ok    the simulated robot drives" in out


def test_what_does_not_hold_is_printed_and_is_the_exit_status(monkeypatch, capsys) -> None:
    findings = [
        CheckFinding("one"),
        CheckFinding("two", "it does not"),
        CheckFinding.of("three", ["a", "b", "c", "d"], "tried"),
    ]
    monkeypatch.setattr(kit, "find_protocol", lambda name: TOY)
    monkeypatch.setattr(kit, "check", lambda protocol, name: findings)
    assert kit.main(["toy"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        *("ok    one", "FAIL  two", "      it does not"),
        *("FAIL  three (tried)", "      a; b; c (and 1 more)", "toy: 1 hold, 2 do not, 0 not checked"),
    ]


@pytest.mark.parametrize(
    ("arguments", "status", "said"), [(["nobody"], 2, "expected one of"), ([], 2, "usage"), (["--help"], 0, "NAME")]
)
def test_a_wrong_command_line_is_a_clear_error(capsys, arguments: list[str], status: int, said: str) -> None:
    assert kit.main(arguments) == status
    printed = capsys.readouterr()
    assert said in (printed.err if status else printed.out)


# What helps


async def raises_later(simulation: Simulation) -> None:
    """Be a robot that raises an exception for its first client."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)
        {}["it"]

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        simulation.ready((Address(*server.sockets[0].getsockname()[:2]),))
        await server.serve_forever()


async def ends_at_once(simulation: Simulation) -> None:
    simulation.ready((Address("127.0.0.1", 1),))


def never_established(self: Any, now: float) -> None:
    self.send(toy.At(0, 0, 0))


@pytest.mark.parametrize(
    ("simulate", "problem"),
    [
        (raises_later, "the simulated robot raised KeyError: 'it' in serve (test_check.py:"),
        (ends_at_once, "Connect call failed"),
    ],
)
def test_what_the_simulated_robot_raises_is_told_at_once(monkeypatch, simulate: Any, problem: str) -> None:
    monkeypatch.setattr(asyncio, "run", waiting)
    begun = time.monotonic()
    protocol = msgspec.structs.replace(with_session(opened=never_established), simulate=simulate)
    assert_found(kit.check(protocol, "toy"), {ESTABLISHED: problem})
    assert time.monotonic() - begun < 5.0  # not after the 10 s that a handshake may take


GUIDE = (Path(__file__).parents[2] / "docs" / "how-to" / "add-a-protocol.md").read_text()


def test_the_guide_has_every_paragraph_that_a_finding_names() -> None:
    folder = Path(kit.__file__).parent
    sources = [path.read_text() for path in (folder / "check.py", *(folder / "checks").glob("*.py"))]
    named = {name for source in sources for name in re.findall(r'"(\d\. [A-Z][^"]*)"', source)}
    assert len(named) > 8
    for name in named:
        step, _, paragraph = name.partition(": ")
        section = GUIDE.partition(f"\n## {step}\n")[2].partition("\n## ")[0]
        assert section, step
        assert not paragraph or f"**{paragraph}" in section, name
