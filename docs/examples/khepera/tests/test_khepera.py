"""The Khepera protocol: golden lines, a conversation with the simulated robot without a link, units and axes."""

from __future__ import annotations

import math

import pytest
from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Switch
from zbridge.protocol import State
from zbridge.simulation import STEP_S, Scene

from khepera import PROTOCOL
from khepera.messages import LINES, Positions, Proximity, SetLed, SetSpeeds, Speeds, Version
from khepera.session import KheperaSession
from khepera.simulator import Khepera
from khepera.translate import KheperaRobot, Options


@pytest.fixture
def scene() -> Scene:
    """Connect a gateway's robot and a simulated one."""
    scene = Scene(PROTOCOL, Khepera())
    scene.establish()
    return scene


def test_golden_lines() -> None:
    assert LINES.write(SetSpeeds(10, -10)) == b"D,10,-10\n"
    assert LINES.write(SetLed(0, 1)) == b"L,0,1\n"
    assert LINES.read(b"b,5,1\r\n") == Version(5, 1)
    assert LINES.read(b"h,-100,2147483647\n") == Positions(-100, 2**31 - 1)
    assert LINES.read(b"n,0,1,2,3,4,5,6,1023\n") == Proximity(0, 1, 2, 3, 4, 5, 6, 1023)


@pytest.mark.parametrize("line", [b"\n", b"z\n", b"e,1\n", b"e,1,128\n", b"n,0,1,2,3,4,5,6,1024\n", b"e,1,x\n"])
def test_an_invalid_line_raises_protocol_error(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        LINES.read(line)


def test_a_speed_out_of_range_is_not_encoded() -> None:
    with pytest.raises(EncodeError):
        LINES.write(SetSpeeds(128, 0))


def test_the_version_is_the_handshake_and_polls_follow_at_20_hz(scene: Scene) -> None:
    assert (scene.written[0], scene.session.version) == (b"B\n", "5.1")
    scene.written.clear()
    scene.run(1.0)
    for poll in (b"H\n", b"E\n", b"N\n"):
        assert 15 <= scene.written.count(poll) <= 20


def test_a_robot_that_does_not_answer_is_lost() -> None:
    scene = Scene(PROTOCOL, Khepera())
    scene.answers = False
    scene.run(6.0)
    assert (scene.session.state, scene.session.version) == (State.CLOSED, None)


def test_forward_is_along_x_and_a_left_turn_counter_clockwise(scene: Scene) -> None:
    scene.drive(0.4)
    scene.run(1.0)
    pose = scene.shown["pose"]
    assert pose.x == pytest.approx(0.2, abs=0.02)
    assert (pose.y, pose.heading) == (0.0, 0.0)
    assert scene.shown["motion"].speed == pytest.approx(0.4, abs=0.02)
    scene.drive(turn=1.0)
    scene.run(1.0)
    assert scene.shown["pose"].heading == pytest.approx(1.0, abs=0.2)
    assert scene.simulated.body.heading == pytest.approx(scene.shown["pose"].heading, abs=0.1)


def test_a_stop_precedes_queued_requests_and_the_robot_stops(scene: Scene) -> None:
    scene.drive(1.0)
    scene.run(0.5)
    scene.command(topics.CMD_LIGHT, Switch(on=True))
    scene.drive(0.5)
    scene.written.clear()
    scene.stop()
    scene.run(1.5)
    assert scene.written[0] == b"D,0,0\n"
    assert {line for line in scene.written if line.startswith(b"D")} == {b"D,0,0\n"}
    assert scene.simulated.speeds == SetSpeeds(0, 0)
    assert scene.simulated.leds == {0: True}


def test_a_robot_that_falls_silent_gets_no_commands_and_is_finally_lost(scene: Scene) -> None:
    scene.drive(1.0)
    scene.answers = False
    scene.run(0.6)
    assert (scene.session.busy, scene.robot.ready) == ("the robot does not answer", False)
    scene.run(2.0)
    assert scene.session.reason == "no answer to 10 requests in a row"


def test_the_simulated_robot_stops_during_a_silence() -> None:
    robot = Khepera()
    assert robot.receive(b"D,100,100\n") == b"d\n"
    assert robot.receive(b"nonsense\n") == b""
    for _ in range(101):
        robot.step(STEP_S)
    assert robot.speeds == SetSpeeds(0, 0)


def test_a_near_obstacle_is_a_short_range_at_its_bearing() -> None:
    ((topic, scan),) = KheperaRobot(Options()).telemetry(Proximity(0, 0, 0, 0, 700, 0, 0, 0), 1)
    assert topic is topics.SCAN
    (place,) = [place for place, metres in enumerate(scan.ranges) if not math.isnan(metres)]
    assert math.degrees(scan.angle_min + place * scan.angle_increment) == pytest.approx(15.0)
    assert scan.ranges[place] == pytest.approx(0.01)


def test_an_unsupported_command_is_refused_with_a_reason(scene: Scene) -> None:
    for topic, command in ((topics.CMD_DRIVE, Drive(left=1.0)), (topics.CMD_MODE, Mode(mode="manual"))):
        with pytest.raises(Refused):
            scene.command(topic, command)
    outcome = scene.drive(0.1, left=0.1)
    assert outcome.left_out == "left: it does not move sideways"
    with pytest.raises(Refused):
        scene.robot.ask(topics.POSE)


def test_before_a_connection_everything_is_refused() -> None:
    robot = KheperaRobot(Options())
    for call in (lambda: robot.stop(0.0, 0.0), lambda: robot.command(topics.CMD_DRIVE, Drive(forward=1.0), 0.0)):
        with pytest.raises(Refused):
            call()


def test_a_new_connection_does_not_move_the_pose() -> None:
    robot = KheperaRobot(Options())
    robot.session("robot", "")
    robot.telemetry(Positions(5000, 5000), 1)
    ((_, pose),) = robot.telemetry(Positions(6250, 6250), 1)
    robot.session("robot", "")
    ((_, again),) = robot.telemetry(Positions(0, 0), 1)
    assert pose.x == again.x == pytest.approx(0.1)


def test_speeds_over_full_scale_are_published_as_full_scale() -> None:
    ((_, motion),) = KheperaRobot(Options()).telemetry(Speeds(127, 127), 1)
    assert motion.speed == 1.0


def test_the_protocol_names_its_parts() -> None:
    assert (PROTOCOL.name, PROTOCOL.links, PROTOCOL.hq) == ("khepera", 1, None)
    assert isinstance(PROTOCOL.robot(PROTOCOL.options(), 1, None), KheperaRobot)
    assert isinstance(PROTOCOL.robot(Options(), 1, None).session("robot", ""), KheperaSession)
