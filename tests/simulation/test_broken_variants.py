"""Each way in which a protocol was seen to be wrong is noticed by the conformance kit; the sound example passes."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "examples" / "arcos"))

import arcos.session
import arcos.simulator
import arcos.translate
from arcos import PROTOCOL
from arcos.messages import PACKETS, Command, Do, Report, Setting

from tests.clock import at_once
from zbridge.errors import NotReady
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Motion, Pose, Scan
from zbridge.protocol import KEEP_ALIVE, Codec, KeepAlive, Odometry, Outcome, Protocol, Simulation, Truth
from zbridge.simulation import serve
from zbridge.simulation.checks import bearings, handover, journeys, motion
from zbridge.simulation.checks.commands import check_commands
from zbridge.simulation.checks.examples import check_examples
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.messages import check_messages
from zbridge.simulation.checks.rehearsal import Transcript
from zbridge.simulation.checks.sessions import check_sessions
from zbridge.simulation.checks.stage import Stage, live, record
from zbridge.simulation.checks.stops import check_stops
from zbridge.simulation.checks.values import check_values
from zbridge.wire import Packets

Robot, Session, Simulated = arcos.translate.ArcosRobot, arcos.session.ArcosSession, arcos.simulator.Arcos
broken = partial(msgspec.structs.replace, PROTOCOL)


def with_robot(**members: Any) -> Protocol:
    return broken(robot=type("BrokenRobot", (Robot,), members))


def with_session(**members: Any) -> Protocol:
    kind = type("BrokenSession", (Session,), members)

    def session(self: Any, link: str, peer: str) -> Any:
        Robot.session(self, link, peer)
        self.driving = kind(self.driving.limits)
        return self.driving

    return with_robot(session=session)


def with_simulated(**members: Any) -> Protocol:
    kind = type("BrokenSimulated", (Simulated,), members)

    async def simulate(simulation: Simulation) -> None:
        await serve(simulation, kind(simulation.place, at_wrap=simulation.at_wrap))

    return broken(simulate=simulate)


def both(one: Protocol, other: Protocol) -> Protocol:
    return msgspec.structs.replace(one, simulate=other.simulate)


def drives(change: Callable[[Drive], Drive]) -> Callable[..., Outcome]:
    """Command another drive than the one that was commanded."""
    return lambda self, topic, command, now: Robot.command(
        self, topic, change(command) if isinstance(command, Drive) else command, now
    )


def shows(kind: type, change: Callable[[Any], Any]) -> Callable[..., Any]:
    """Show other telemetry than what the robot sent."""

    def report(self: Any, message: Report, stamp_ns: int) -> Iterable[Any]:
        for topic, shown in Robot._report(self, message, stamp_ns):
            yield topic, change(shown) if isinstance(shown, kind) else shown

    return report


replace = msgspec.structs.replace


def scaled(factor: float, *names: str) -> Callable[[Any], Any]:
    return lambda message: replace(message, **{name: getattr(message, name) * factor for name in names})


mirrored_pose = shows(Pose, scaled(-1.0, "y", "heading"))
mirrored_drive = drives(scaled(-1.0, "turn"))

# Scenes with a simulated robot on loopback, on a clock that jumps


async def played(protocol: Protocol, scene: Any, options: dict[str, Any]) -> tuple[list[CheckFinding], Stage]:
    async with live(protocol, **options) as stage:
        assert await stage.established(5.0)
        return await scene(protocol, stage), stage


def play(protocol: Protocol, scene: Any, **options: Any) -> list[CheckFinding]:
    return at_once(played(protocol, scene, options))[0]


drive = partial(play, scene=motion.check_motion)
long = partial(play, scene=journeys.check_long)
again = partial(play, scene=partial(journeys.check_reconnect, establish_s=5.0))
wrap = partial(play, scene=journeys.check_wrap, at_wrap=True)
bearing = partial(play, scene=bearings.check_bearings, place=bearings.PLACE)


def values(protocol: Protocol) -> list[CheckFinding]:
    _, stage = at_once(played(protocol, journeys.check_wrap, {}))
    return [*check_values(protocol, stage.history)]


# Scenes in virtual time


@pytest.fixture(scope="module")
def heard() -> Transcript:
    """What the sound robot says."""
    return at_once(record(PROTOCOL, 5.0))


def turns_on(self: Any) -> tuple[bytes, ...]:
    return Robot.stop_frames(self)[:1]


def stops(slot: str, **how: Any) -> Callable[..., None]:
    def stop(self: Any, now: float, until: float) -> None:
        if self.driving is None:
            raise NotReady("offline")
        self.driving.outbox.set(slot, Robot.stop_frames(self), now, **{"until": until, "urgent": True, **how})

    return stop


def overtaken(self: Any, topic: Any, command: Any, now: float) -> Outcome:
    outcome = Robot.command(self, topic, command, now)
    if command.turn:
        self.driving.send(Setting.of(Do.RVEL, round(math.degrees(command.turn))))
    return outcome


def neutral_ignored(self: Any, topic: Any, command: Any, now: float) -> Outcome:
    return Robot.command(self, topic, command, now) if getattr(command, "moving", True) else Outcome()


def left_dropped(self: Any, topic: Any, command: Any, now: float) -> Outcome:
    Robot.command(self, topic, replace(command, left=0.0) if isinstance(command, Drive) else command, now)
    return Outcome(left_out="light: it has none" if getattr(command, "light", None) is not None else None)


def never_restarted(self: Any, link: str, peer: str) -> Any:
    counted = self._odometry._counted
    session = Robot.session(self, link, peer)
    self._odometry._counted = counted
    return session


class BusyLater(Robot):
    """Its second session, and those after it, are busy once established."""

    def session(self, link: str, peer: str) -> Any:
        later = self.driving is not None
        session = super().session(link, peer)
        establish = session.establish

        def busily(version: str, features: tuple[str, ...]) -> None:
            establish(version, features)
            session.busy = "the bumper is pressed"

        if later:
            session.establish = busily
        return session


class Unwrapped(Robot):
    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._odometry = Odometry(unit_m=0.001)


class Mirrored(Simulated):
    """Turns to the other side than its wheels say, and is sent."""

    def step(self, dt: float) -> bytes:
        self._deg_s = -self._deg_s
        sent = super().step(dt)
        self._deg_s = -self._deg_s
        return sent


def wheels_of_another(self: Any) -> Truth:
    return replace(Simulated.truth(self), wheels_m_s=Simulated._wheels_m_s(self)[::-1])


def in_mm(kind: str) -> Callable[..., Any]:
    def report(self: Any, message: Report, stamp_ns: int) -> Iterable[Any]:
        for topic, shown in Robot._report(self, message, stamp_ns):
            yield topic, scaled(1000.0, "value")(shown) if topic.path.startswith(kind) else shown

    return report


def backwards(scan: Scan) -> Scan:
    return replace(scan, ranges=scan.ranges[::-1].copy())


LIVE: dict[str, tuple[Callable[..., list[CheckFinding]], Protocol, str, str]] = {
    "a stop that leaves the turn going": (
        drive,
        with_robot(stop_frames=turns_on),
        motion.WHOLE,
        "its motors are not neutral",
    ),
    "a neutral that is ignored": (
        drive,
        with_robot(command=neutral_ignored),
        motion.NEUTRAL,
        "its motors are not neutral",
    ),
    "a turn whose sign is wrong in the command": (
        drive,
        with_robot(command=mirrored_drive),
        motion.TURNS,
        "truly its heading changed by -0.",
    ),
    "a turn whose sign is wrong in the pose": (
        drive,
        with_robot(_report=shows(Pose, scaled(-1.0, "heading"))),
        motion.TURNS,
        "as it shows its heading changed by -0.",
    ),
    "both signs of a turn wrong, and it drives ahead after it": (
        drive,
        with_robot(command=mirrored_drive, _report=shows(Pose, scaled(-1.0, "heading"))),
        motion.AHEAD,
        "to the left of it",
    ),
    "left and right mirrored, in commands and on the map": (
        drive,
        with_robot(command=mirrored_drive, _report=mirrored_pose),
        motion.TURNS,
        "truly its heading changed by -0.",
    ),
    "left and right mirrored, and in the simulated robot too": (
        drive,
        both(with_robot(), with_simulated(truth=wheels_of_another)),
        motion.TURNS,
        "its left side is not slower than its right one",
    ),
    "a drive that is 1.3 times too fast": (
        drive,
        with_robot(command=drives(scaled(1.3, "forward"))),
        motion.SPEED,
        "it truly has 0.26",
    ),
    "a turn that is 1.3 times too fast": (
        drive,
        broken(
            options=arcos.translate.Options,
            robot=type("BrokenRobot", (Robot,), {"command": drives(scaled(1.3, "turn"))}),
        ),
        motion.RATE,
        "rad/s, the options say 1.000 rad/s",
    ),
    "a pose that is 1.3 times too far": (
        drive,
        with_robot(_report=shows(Pose, scaled(1.3, "x", "y"))),
        motion.SHOWN,
        "m ahead, it was",
    ),
    "a heading that is 1.3 times too large": (
        drive,
        with_robot(_report=shows(Pose, scaled(1.3, "heading"))),
        motion.SHOWN,
        "rad, it was",
    ),
    "a speed that is 1.3 times too high": (
        drive,
        with_robot(_report=shows(Motion, scaled(1.3, "speed"))),
        motion.SHOWN,
        "motion shows a speed of 0.52",
    ),
    "a keep-alive that is never sent": (
        long,
        with_session(keep_alive=None),
        journeys.LONG,
        "the robot's watchdog acted",
    ),
    "a keep-alive that is slower than the watchdog": (
        long,
        with_session(keep_alive=KeepAlive(Command(Do.PULSE), 5.0, 20.0)),
        journeys.LONG,
        "the robot's watchdog acted",
    ),
    "a pose that jumps at a reconnect": (
        again,
        with_robot(session=never_restarted),
        journeys.CONNECTED_AGAIN,
        "its pose changed by",
    ),
    "a pose that is lost in a restart of the gateway": (
        drive,
        with_robot(restore=lambda self, state: None),
        handover.CLAIM,
        "pose.x shows",
    ),
    "a keep-alive that is lost in a restart of the gateway": (
        drive,
        with_session(restore=lambda self, state: (Session.restore(self, state), self.outbox.clear(KEEP_ALIVE))),
        handover.CLAIM,
        "is written, not Command(number=0)",
    ),
    "a session that stays busy": (
        again,
        broken(robot=BusyLater),
        journeys.CONNECTED_AGAIN,
        "then a drive is refused: not_ready: ArcosSession takes no commands: the bumper is pressed",
    ),
    "a pose that jumps at a wrap": (wrap, broken(robot=Unwrapped), journeys.WRAPS, "the pose shows -6"),
    "a bearing that is mirrored": (
        bearing,
        with_robot(_report=shows(Scan, backwards)),
        bearings.LEFT,
        "the nearest range is at -",
    ),
    "ranges that are 1.4 times too long": (
        bearing,
        with_robot(_report=shows(Scan, lambda scan: replace(scan, ranges=scan.ranges * 1.4))),
        bearings.LEFT,
        "times the distances",
    ),
    "readings in millimetres": (
        values,
        with_robot(_report=in_mm("sensor/sonar")),
        "what it shows is plausible",
        "sensor/sonar0.value = ",
    ),
    "a battery in units of 0.1 V": (
        values,
        with_robot(_report=shows(topics.BATTERY.message, scaled(10.0, "voltage"))),
        "what it shows is plausible",
        "battery.voltage = 125",
    ),
}


@pytest.mark.parametrize("name", LIVE)
def test_a_robot_that_moves_or_shows_otherwise_is_noticed(name: str) -> None:
    scene, protocol, claim, problem = LIVE[name]
    noticed(scene(protocol), claim, problem)


def noticed(findings: Iterable[CheckFinding], claim: str, problem: str) -> None:
    found = {finding.claim: finding.problem for finding in findings if finding.problem is not None}
    assert any(claim in each and problem in found[each] for each in found), found


VIRTUAL: dict[str, tuple[Callable[..., Iterable[CheckFinding]], Protocol, str, str]] = {
    "a stop that is not repeated": (
        check_stops,
        with_robot(stop=stops("drive", until=0.0)),
        "a stop is repeated",
        "is not written again",
    ),
    "a stop in another slot than the motion": (
        check_stops,
        with_robot(stop=stops("stop", period_s=0.1)),
        "the stop goes before all",
        "moves the robot after its stop",
    ),
    "a stop in the slot of the keep-alive": (
        check_stops,
        with_robot(stop=stops(KEEP_ALIVE, period_s=0.1)),
        "what is repeated beside the motion",
        "is repeated before a stop, and not after it",
    ),
    "a motion that overtakes the stop": (
        check_stops,
        with_robot(command=overtaken),
        "the stop goes before all",
        "moves the robot after its stop",
    ),
    "garbage out of stop_frames": (
        check_stops,
        with_robot(stop_frames=lambda self: (b"garbage",), stop=stops("drive", period_s=0.1)),
        "stop_frames() returns",
        "b'garbage' is none of what a stop writes",
    ),
    "a stop that writes nothing": (
        check_stops,
        with_robot(stop=lambda self, now, until: None),
        "the stop goes before all",
        "moves the robot after its stop",
    ),
    "silence after establishment": (
        check_sessions,
        with_session(silent_s=None, lost_s=None),
        "a robot that falls silent",
        "is established and not busy after 60 s without a message",
    ),
    "a silence that is noticed late": (
        check_sessions,
        with_session(receive=lambda self, data, now: Session.receive(self, data, now + 5.0)),
        "a robot that falls silent",
        "expected within silent_s = 0.5",
    ),
    "a keep-alive that is declared too slow": (
        check_sessions,
        with_session(keep_alive=KeepAlive(Command(Do.PULSE), 1.5, 2.0)),
        "the keep-alive is written in time",
        "BrokenSession.keep_alive.period_s is 1.5, expected 1 or less",
    ),
    "a keep-alive that is taken out": (
        check_sessions,
        with_session(
            accept=lambda self, message, now: (Session.accept(self, message, now), self.outbox.clear(KEEP_ALIVE))[0]
        ),
        "the keep-alive is written in time",
        "Command(number=0) b'\\xfa\\xfb\\x03\\x00\\x00\\x00' is not written within 0.6 s",
    ),
    "left dropped without a report": (
        check_commands,
        with_robot(command=left_dropped),
        "no part of a drive is dropped",
        "expected one that names left",
    ),
    "light dropped without a report": (
        check_commands,
        with_robot(command=lambda self, *how: (Robot.command(self, *how), Outcome(left_out="left"))[1]),
        "no part of a drive is dropped",
        "expected one that names light",
    ),
    "a command that is written otherwise than the maker says": (
        check_commands,
        with_robot(command=drives(scaled(1.3, "forward"))),
        "writes this frame",
        "expected b'\\xfa\\xfb",
    ),
}


@pytest.mark.parametrize("name", VIRTUAL)
def test_a_session_or_a_translation_that_is_wrong_is_noticed(heard: Transcript, name: str) -> None:
    check, protocol, claim, problem = VIRTUAL[name]
    noticed(check(protocol, heard), claim, problem)


# Bytes


def breaks_behind(packet: bytes) -> Any:
    body = PACKETS.body(packet)
    return {"\x04": Setting, "\x00": Command}[chr(body[0])]  # any other command is a KeyError


def own_end(data: bytes, start: int) -> int:
    """Frame packets without :class:`Packets`, so that nobody can make a damaged one whole."""
    return PACKETS.end(data, start)


def with_codec(**parts: Any) -> Protocol:
    return broken(codecs=tuple(replace(codec, **parts) for codec in PROTOCOL.codecs[:1]))


def own_sum(data: bytes) -> bytes:
    return (sum(data[3:]) & 0xFFFF).to_bytes(2, "big")


WRONG_SUM = Packets(b"\xfa\xfb", "B", uncounted=3, checksum=own_sum, most=208)


def wrong_sum(codec: Codec) -> Codec:
    """Another checksum than the maker's, for both sides alike."""

    def read(packet: bytes) -> Any:
        return codec.read(PACKETS.packet(WRONG_SUM.body(packet)))

    return replace(
        codec,
        write=lambda message: WRONG_SUM.packet(PACKETS.body(codec.write(message))),
        read=read,
        frame_end=WRONG_SUM.end,
    )


def test_a_framing_that_makes_no_headway_is_noticed() -> None:
    protocol = with_codec(frame_end=lambda data, start: start if data[start] == 0 else PACKETS.end(data, start))
    noticed(check_messages(protocol), "random bytes", "returned a frame of 0 bytes, expected 1 or more")


def test_a_fault_behind_the_checksum_is_found_since_the_kit_computes_it_anew() -> None:
    noticed(check_messages(with_codec(read=breaks_behind)), "any fields behind a right checksum", "KeyError")


def test_without_a_way_to_the_checksum_the_kit_says_that_it_did_not_look_behind_it() -> None:
    findings = {finding.claim: finding for finding in check_messages(with_codec(frame_end=own_end))}
    (damaged,) = (finding for claim, finding in findings.items() if "any fields behind" in claim)
    assert damaged.problem is None
    assert "give Codec.seal" in (damaged.unchecked or "")
    noticed(
        check_messages(with_codec(frame_end=own_end, seal=lambda frame: b"no packet")),
        "any fields behind",
        "Codec.seal",
    )


def test_a_checksum_that_is_wrong_on_both_sides_is_found_by_the_makers_bytes_alone() -> None:
    wrong = broken(codecs=tuple(map(wrong_sum, PROTOCOL.codecs)))
    assert [finding.problem for finding in check_messages(wrong) if finding.problem] == []
    noticed(check_examples(wrong), "example", "is read as ProtocolError: checksum 053b, expected")


def test_what_only_the_makers_bytes_could_tell_is_listed_as_not_detectable() -> None:
    findings = [finding for finding in check_examples(broken(examples=())) if finding.unchecked]
    assert all("is not detectable" in (finding.unchecked or "") for finding in findings)
    assert {name for finding in findings for name in finding.claim.partition("maker's: ")[2].split(", ")} == {
        *("Command", "Setting", "Synced", "Report"),
    }


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"frame": b"\xfa\xfb\x03\x00\x00\x01"}, "is read as ProtocolError: checksum 0001, expected 0000"),
        ({"message": Command(1)}, "is read as Command(number=0), expected Command(number=1)"),
        ({"codec": "nothing"}, "Example.codec is 'nothing', expected one of "),
    ],
)
def test_an_example_that_does_not_hold_is_told_with_both_sides(change: dict[str, Any], problem: str) -> None:
    example = replace(PROTOCOL.examples[0], **change)
    noticed(check_examples(broken(examples=(example,))), "example 1", problem)


def test_a_number_that_is_shown_otherwise_than_an_example_says_is_told() -> None:
    report = next(example for example in PROTOCOL.examples if example.shown)
    scale = with_robot(_report=shows(topics.BATTERY.message, scaled(1.3, "voltage")))
    noticed(check_examples(scale), type(report.message).__name__, "shows battery.voltage = ")
