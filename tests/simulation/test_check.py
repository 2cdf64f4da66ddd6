"""The conformance kit: a sound protocol passes, and each check fails for a protocol that is broken in its way."""

from __future__ import annotations

import asyncio
import importlib.util
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import pytest

from zbridge.errors import ConfigError, ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Switch
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Outcome, Protocol, Robot, Simulation, Telemetry
from zbridge.protocol.session import Session
from zbridge.simulation import check as kit
from zbridge.simulation.check_commands import check_commands, check_stop
from zbridge.simulation.check_messages import check_messages, example
from zbridge.simulation.check_motion import check_motion
from zbridge.simulation.check_plugin import check_plugin
from zbridge.simulation.check_report import Finding
from zbridge.simulation.check_sessions import check_sessions
from zbridge.simulation.check_stage import Recording, record

PACKAGE = Path(__file__).parents[1] / "e2e" / "other_package" / "toyrobot.py"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("toyrobot_checked", PACKAGE)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


toy = load()
TOY: Protocol = toy.PROTOCOL
LINES = TOY.codecs[0]


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Watch the toy for a shorter time: it shows its pose ten times a second."""
    times = {"DRIVE_S": 0.5, "IDLE_S": 0.1, "STAND_S": 0.4, "TURN_S": 0.3, "WATCHED_S": 0.5}
    for name, seconds in times.items():
        monkeypatch.setattr(f"zbridge.simulation.check_motion.{name}", seconds)


@pytest.fixture(scope="module")
def heard() -> Recording:
    """What the sound robot says."""
    return asyncio.run(record(TOY, 5.0))


def failed(findings: Iterable[Finding]) -> dict[str, str]:
    return {finding.claim: finding.problem for finding in findings if finding.problem is not None}


def broken(**parts: Any) -> Protocol:
    """The toy with other parts."""
    return msgspec.structs.replace(TOY, **parts)


def with_robot(**methods: Callable[..., Any]) -> Protocol:
    """The toy with other methods of its robot."""
    return broken(robot=type("BrokenRobot", (toy.ToyRobot,), methods))


def with_session(**methods: Any) -> Protocol:
    """The toy with other methods of its session."""
    session_class = type("BrokenSession", (toy.ToySession,), methods)

    def session(self: Any, link: str, peer: str) -> Session[Any]:
        self._session = session_class(toy.Limits(frame_bytes=100, handshake_s=5.0))
        return self._session

    return with_robot(session=session)


# Messages


def test_sound_messages_pass() -> None:
    assert failed(check_messages(TOY)) == {}


def with_codec(**parts: Any) -> Protocol:
    return broken(codecs=(msgspec.structs.replace(LINES, **parts),))


def reads_half(frame: bytes) -> Any:
    message = toy.read(frame)
    return toy.At(message.x, 0.0, 0.0)


def breaks_on_noise(frame: bytes) -> Any:
    return {b"at": toy.read}[frame.split(b" ")[0]](frame)


def breaks_when_cut(frame: bytes) -> Any:
    assert frame.endswith(b"\n")
    return toy.read(frame)


def ends_early(data: bytes, start: int) -> int:
    return len(data)


def reads_two_lines(data: bytes, start: int) -> int:
    return len(data) if data.endswith(b"\n") else len(data) + 1


@pytest.mark.parametrize(
    ("parts", "claim"),
    [
        ({"read": reads_half}, "messages round-trip"),
        ({"write": lambda message: 1 / 0}, "messages round-trip"),
        ({"messages": (object,)}, "messages round-trip"),
        ({"frame_end": ends_early}, "byte by byte"),
        ({"frame_end": lambda data, start: start + 1000}, "byte by byte"),
        ({"read": breaks_on_noise}, "random bytes"),
        ({"frame_end": ends_early, "read": breaks_when_cut}, "what is cut off"),
    ],
)
def test_broken_messages_are_found(parts: dict[str, Any], claim: str) -> None:
    assert any(claim in found for found in failed(check_messages(with_codec(**parts))))


def test_joined_messages_that_are_one_frame_are_found() -> None:
    protocol = with_codec(frame_end=reads_two_lines, messages=(toy.At(1, 2, 3), toy.At(4, 5, 6)))
    (problem,) = failed(check_messages(protocol)).values()
    assert "all messages joined" in problem


def test_a_protocol_that_declares_no_messages_is_told_so() -> None:
    assert "codecs is empty" in failed(check_messages(broken(codecs=())))["messages are declared"]


def test_the_example_of_a_class_has_a_value_for_each_field() -> None:
    assert example(toy.At) == toy.At(0.5, 0.5, 0.5)


# Sessions


def test_a_sound_session_passes(heard: Recording) -> None:
    assert failed(check_sessions(TOY, heard)) == {}
    assert failed(check_stop(TOY, heard)) == {}
    assert failed(check_commands(TOY, heard)) == {}


def test_a_session_that_is_never_established_is_found() -> None:
    protocol = with_session(opened=lambda self, now: None)
    recording = asyncio.run(record(protocol, 0.3))
    assert "handshaking after 0.3 s" in failed(check_sessions(protocol, recording))[ESTABLISHED]


ESTABLISHED = "the session with the simulated robot is established"


def test_a_session_that_ends_at_once_is_found_with_its_reason() -> None:
    protocol = with_session(opened=lambda self, now: self.fail("I do not like it"))
    recording = asyncio.run(record(protocol, 5.0))
    assert "I do not like it" in failed(check_sessions(protocol, recording))[ESTABLISHED]


def test_a_session_that_breaks_on_garbage_is_found(heard: Recording) -> None:
    (claim,) = failed(check_sessions(with_session(decode=lambda self, frame: breaks_on_noise(frame)), heard))
    assert claim.startswith("garbage at")


def test_a_session_that_waits_for_ever_is_found(heard: Recording) -> None:
    def open_for_ever(self: Session[Any], now: float) -> None:
        Session.open(self, now)
        self._limit_at = float("inf")

    def accept(self: Session[Any], message: Any, now: float) -> bool:
        self.establish("7.0", ())
        return True

    protocol = with_session(open=open_for_ever, opened=lambda self, now: None, accept=accept)
    (claim, problem), *others = failed(check_sessions(protocol, heard)).items()
    assert claim.startswith("silence at")
    assert "still handshaking after 6 s" in problem
    assert not others


def test_a_timer_that_never_ends_is_found(heard: Recording) -> None:
    protocol = with_session(timers=lambda self: 0.0)
    assert any("writes and timers" in problem for problem in failed(check_sessions(protocol, heard)).values())


def test_a_session_that_lives_on_without_a_connection_is_found(heard: Recording) -> None:
    (claim,) = failed(check_sessions(with_session(lost=lambda self, reason: None), heard))
    assert claim.startswith("the end of the connection at")


def test_a_translation_that_raises_is_found(heard: Recording) -> None:
    def at(self: Robot, message: Any, stamp_ns: int) -> Iterable[Telemetry]:
        raise KeyError(message.x)

    assert "messages of the robot are translated" in str(failed(check_sessions(with_robot(_at=at), heard)))


def test_telemetry_that_is_not_what_its_topic_promises_is_found(heard: Recording) -> None:
    def at(self: Robot, message: Any, stamp_ns: int) -> Iterable[Telemetry]:
        return ((topics.POSE, Switch(on=True)),)

    assert "messages of the robot are translated" in str(failed(check_sessions(with_robot(_at=at), heard)))


def test_a_silent_robot_is_found(heard: Recording) -> None:
    silent = msgspec.structs.replace(heard, messages=[])
    assert "the simulated robot sent none" in failed(check_sessions(TOY, silent)).values()


# Commands


def stop_last(self: Any, now: float, until: float) -> None:
    self._session.outbox.put(b"go 0.000000 0.000000\n")


def stop_nothing(self: Any, now: float, until: float) -> None:
    return


def stop_beside(self: Any, now: float, until: float) -> None:
    self._session.outbox.set("stop", (b"go 0.000000 0.000000\n",), now, period_s=0.1, until=until, urgent=True)


@pytest.mark.parametrize(
    ("stop", "problem"),
    [
        (stop_last, "is written before the stop"),
        (stop_nothing, "a stop writes nothing"),
        (stop_beside, "moves the robot after its stop"),
    ],
)
def test_a_stop_that_is_not_first_or_does_not_last_is_found(heard: Recording, stop, problem) -> None:
    claims = failed(check_stop(with_robot(stop=stop), heard))
    assert next(iter(claims)) == "the stop goes before all that waits, and no motion after it"
    assert problem in claims["the stop goes before all that waits, and no motion after it"]


def test_a_stop_that_breaks_before_the_first_connection_is_found(heard: Recording) -> None:
    def stop(self: Any, now: float, until: float) -> None:
        assert self._session is not None
        toy.ToyRobot.stop(self, now, until)

    assert list(failed(check_stop(with_robot(stop=stop), heard))) == [
        "a stop before the first connection is refused or ignored"
    ]


def test_a_command_that_is_ignored_is_found(heard: Recording) -> None:
    def command(self: Any, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        return toy.ToyRobot.command(self, topic, command, now) if isinstance(command, Drive) else Outcome()

    claims = failed(check_commands(with_robot(command=command), heard))
    assert "@cmd/light is carried out or refused with a code" in claims
    assert "@cmd/drive is carried out or refused with a code" not in claims


def test_a_command_that_raises_anything_but_a_refusal_is_found(heard: Recording) -> None:
    def command(self: Any, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        return {Drive: Outcome()}[type(command)]

    claims = failed(check_commands(with_robot(command=command), heard))
    assert "KeyError" in claims["@cmd/mode is carried out or refused with a code"]


def test_a_command_that_raises_a_protocol_error_is_found(heard: Recording) -> None:
    def command(self: Any, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        raise ProtocolError("no")

    assert (
        "ProtocolError: no"
        in failed(check_commands(with_robot(command=command), heard))["@cmd/text is carried out or refused with a code"]
    )


def test_a_question_that_is_ignored_is_found(heard: Recording) -> None:
    claims = failed(check_commands(with_robot(ask=lambda self, topic: None), heard))
    assert claims["a question for pose is answered, asked or refused"] == "nothing is written for it"


# Motion


def test_a_simulated_robot_that_does_not_move_is_found() -> None:
    async def simulate(simulation: Simulation) -> None:
        await deaf(simulation, 0.0)

    drives, turns = failed(check_motion(broken(simulate=simulate), 5.0))
    assert (drives, turns) == ("the simulated robot drives", "a turn of the simulated robot is counter-clockwise")


def test_a_robot_that_drives_backwards_and_turns_clockwise_is_found() -> None:
    def go(self: Any, forward: float, turn: float, now: float, **more: Any) -> None:
        toy.ToyRobot._go(self, -forward, -turn, now, **more)

    drives, turns = failed(check_motion(with_robot(_go=go), 5.0)).values()
    assert drives.startswith("it moved -0.")
    assert turns.startswith("its heading changed by -0.")


def test_a_simulated_robot_that_does_not_stand_is_found() -> None:
    async def simulate(simulation: Simulation) -> None:
        await deaf(simulation, 0.1)

    assert "the simulated robot stands after its stop" in failed(check_motion(broken(simulate=simulate), 5.0))


async def deaf(simulation: Simulation, step_m: float) -> None:
    """Be a robot that moves as it likes."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        x = 0.0
        try:
            while not writer.is_closing():
                x += step_m
                writer.write(b"at %f 0 0\n" % x)
                await asyncio.sleep(0.1)
        finally:
            writer.close()

    (address,) = simulation.addresses
    async with await asyncio.start_server(serve, address.host, address.port) as server:
        simulation.ready((type(address)(*server.sockets[0].getsockname()[:2]),))
        await server.serve_forever()


def test_a_simulation_that_cannot_start_is_found() -> None:
    async def simulate(simulation: Simulation) -> None:
        raise ConfigError("no")

    (*_, last) = kit.check(broken(simulate=simulate), "toy")
    assert (last.claim, last.problem is not None and "ConfigError: no" in last.problem) == (ESTABLISHED, True)


# The command


def test_the_whole_check_passes_for_a_sound_protocol(monkeypatch, capsys) -> None:
    monkeypatch.setattr(kit, "find_protocol", lambda name: TOY)
    assert kit.main(["toy"]) == 0
    out = capsys.readouterr().out
    assert out.endswith("hold, 0 do not\n")
    assert "ok    the simulated robot drives" in out


def test_what_does_not_hold_is_printed_and_is_the_exit_status(monkeypatch, capsys) -> None:
    findings = [Finding("one"), Finding("two", "it does not"), Finding.of("three", ["a", "b", "c", "d"], "tried")]
    monkeypatch.setattr(kit, "find_protocol", lambda name: TOY)
    monkeypatch.setattr(kit, "check", lambda protocol, name: findings)
    assert kit.main(["toy"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        *("ok    one", "FAIL  two", "      it does not"),
        *("FAIL  three (tried)", "      a; b; c (and 1 more)", "toy: 1 hold, 2 do not"),
    ]


def test_a_protocol_that_is_not_installed_is_a_clear_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert kit.main(["nobody"]) == 2
    assert "expected one of" in capsys.readouterr().err
    assert kit.main([]) == 2
    assert "usage" in capsys.readouterr().err
    assert kit.main(["--help"]) == 0
    assert "NAME" in capsys.readouterr().out


# The protocol object


class Sized(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a robot that knows its full scale."""

    speed_full_m_s: float = 1.0
    turn_full_rad_s: float = 1.0


def test_a_sound_protocol_object_passes() -> None:
    assert failed(check_plugin(TOY, "toy")) == {}


@pytest.mark.parametrize(
    ("protocol", "name", "problem"),
    [
        (TOY, "toys", "the entry point is 'toys', Protocol.name is 'toy'"),
        (broken(template=""), "toy", "it has no table [device]"),
        (broken(template=toy.TEMPLATE.replace("toy", "tom")), "toy", "its protocol is 'tom', not 'toy'"),
        (broken(template='[device]\nprotocol = "toy"\n'), "toy", "it has no connect"),
        (broken(template=toy.TEMPLATE + "[device.options]\nx = 1\n"), "toy", "unknown field `x`"),
        (with_session(role=None), "toy", "role is None, not Role.HQ"),
        (with_session(version=property(lambda self: 1 / 0)), "toy", "Error"),
    ],
)
def test_a_broken_protocol_object_is_found(protocol: Protocol, name: str, problem: str) -> None:
    (found,) = failed(check_plugin(protocol, name)).values()
    assert problem in found


def test_requests_without_an_answer_are_found(heard: Recording) -> None:
    claims = failed(check_sessions(TOY, msgspec.structs.replace(heard, unanswered=3)))
    assert "3 had no answer" in claims["the simulated robot answers every request"]


def test_a_stamp_that_was_not_given_is_found(heard: Recording) -> None:
    def at(self: Robot, message: Any, stamp_ns: int) -> Iterable[Telemetry]:
        return toy.ToyRobot._at(self, message, 0)

    assert "pose has the stamp 0, given was" in str(failed(check_sessions(with_robot(_at=at), heard)))


def test_a_stop_that_is_not_repeated_is_found(heard: Recording) -> None:
    def stop(self: Any, now: float, until: float) -> None:
        self._session.outbox.set("motion", (b"go 0.000000 0.000000\n",), now, urgent=True)

    assert "a stop is repeated until its time is over" in failed(check_stop(with_robot(stop=stop), heard))


def test_a_stop_that_waits_for_what_was_queued_is_found(heard: Recording) -> None:
    def stop(self: Any, now: float, until: float) -> None:
        self._session.outbox.set("motion", (b"go 0.000000 0.000000\n",), now, period_s=0.1, until=until)

    problem, *_ = failed(check_stop(with_robot(stop=stop), heard)).values()
    assert "b'what waits' is written before the stop" in problem


def test_a_drive_at_full_scale_that_raises_is_found(heard: Recording) -> None:
    def go(self: Any, forward: float, turn: float, now: float, **more: Any) -> None:
        assert forward + turn < 2, 1 / 0
        toy.ToyRobot._go(self, forward, turn, now, **more)

    (problem,) = failed(check_commands(with_robot(_go=go), heard)).values()
    assert "ZeroDivisionError" in problem
    assert "test_check.py:" in problem


def test_ways_and_turns_that_are_not_what_the_options_say_are_found() -> None:
    assert failed(check_motion(broken(options=Sized), 5.0)) == {}
    protocol = broken(options=Sized, simulated={"speed_full_m_s": 10.0, "turn_full_rad_s": 10.0})
    drives, turns = failed(check_motion(protocol, 5.0)).values()
    assert "m, but the options say" in drives
    assert "rad, but the options say" in turns


def test_a_session_that_raises_when_it_opens_is_found_with_the_place() -> None:
    recording = asyncio.run(record(with_session(opened=lambda self, now: {}[1]), 5.0))
    assert "KeyError: 1 (test_check.py:" in (recording.reason or "")
