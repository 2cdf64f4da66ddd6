"""The ARCOS protocol: golden packets, a conversation with the simulated robot without a link, units and axes."""

from __future__ import annotations

import math

import msgspec
import pytest
from zbridge.errors import ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Switch
from zbridge.protocol import Example, State
from zbridge.simulation import STEP_S, Scene

from arcos import PROTOCOL, REPORT, REPORT_FRAME
from arcos.messages import Command, Do, Setting, Synced, read, read_command, write
from arcos.simulator import REPORT_S, Arcos
from arcos.translate import ArcosRobot, Options

SYNC0, SYNC1, SYNC2 = (write(Command(number)) for number in range(3))
PULSE, OPEN, CLOSE = SYNC0, SYNC1, SYNC2
SONARS, MOTORS_ON, MOTORS_OFF = write(Setting.of(Do.SONAR, 1)), *(write(Setting.of(Do.ENABLE, on)) for on in (1, 0))
STOP = [write(Setting.of(Do.VEL, 0)), write(Setting.of(Do.RVEL, 0))]


def established(simulated: Arcos) -> Scene:
    scene = Scene(PROTOCOL, simulated)
    scene.establish()
    return scene


@pytest.fixture
def scene() -> Scene:
    """Connect a gateway's robot to the simulated one; a program has the lease."""
    scene = established(Arcos())
    scene.lease(True)
    scene.run(STEP_S)
    scene.written.clear()
    return scene


@pytest.mark.parametrize("example", PROTOCOL.examples)
def test_golden_packets(example: Example) -> None:
    codec = next(codec for codec in PROTOCOL.codecs if codec.name == example.codec)
    assert codec.read(example.frame) == example.message
    assert codec.write(example.message) == example.frame


def test_an_odd_last_byte_and_unknown_bytes_at_the_end_of_a_report_are_read() -> None:
    longer = msgspec.structs.replace(REPORT, rest=bytes(6))
    assert read(write(longer)) == longer


@pytest.mark.parametrize("body", ["", "03", "3200", "00", "043B01"])
def test_an_invalid_packet_raises_protocol_error(body: str) -> None:
    packet = write(Synced(0))[:2] + bytes((len(body) // 2 + 2,)) + bytes.fromhex(body)
    with pytest.raises(ProtocolError):
        read(packet + b"\xff\xff")


def test_the_robot_is_synchronised_and_opened() -> None:
    scene = Scene(PROTOCOL, Arcos())
    scene.run(STEP_S)
    assert scene.written[:5] == [SYNC0, SYNC1, SYNC2, OPEN, SONARS]
    assert scene.written[5:7] == STOP
    assert (scene.session.version, scene.simulated.opened) == ("Pioneer p3dx", True)


def test_a_sync_without_an_answer_is_repeated_and_nothing_else_is_sent() -> None:
    scene = Scene(PROTOCOL, Arcos())
    scene.answers = False
    with pytest.raises(Refused):
        scene.stop()
    scene.run(1.2)
    assert scene.written == [SYNC0] * 3
    scene.answers = True
    scene.run(0.4)
    assert scene.session.state is State.ESTABLISHED


def test_a_robot_that_never_answers_is_lost() -> None:
    scene = Scene(PROTOCOL, Arcos())
    scene.answers = False
    scene.run(5.1)
    assert (scene.session.state, scene.session.reason) == (State.CLOSED, "no handshake within 5 s")


def test_a_robot_that_is_open_already_is_closed_and_opened_again(scene: Scene) -> None:
    scene.connect()
    scene.run(1.0)
    closed = scene.written.index(CLOSE)  # with the first report
    assert scene.written[closed : closed + 5] == [CLOSE, SYNC0, SYNC1, SYNC2, OPEN]
    assert scene.session.state is State.ESTABLISHED
    assert (scene.simulated.opened, scene.simulated.motors) == (True, True)  # the program still has the lease


def test_forward_is_along_x_and_a_left_turn_counter_clockwise(scene: Scene) -> None:
    scene.drive(0.4)
    scene.run(1.0)
    pose = scene.shown["pose"]
    assert pose.x == pytest.approx(0.2, abs=0.03)
    assert (pose.y, pose.heading) == (0.0, 0.0)
    assert scene.shown["motion"].speed == pytest.approx(0.4)
    scene.drive(turn=0.5)
    scene.run(2.0)
    body, heading = scene.simulated.body, scene.shown["pose"].heading
    assert heading == pytest.approx(1.0, abs=0.1)
    assert heading == pytest.approx(body.heading, abs=0.06)
    scene.drive(0.4)
    scene.run(1.0)
    pose = scene.shown["pose"]
    assert (pose.x, pose.y) == (pytest.approx(body.x, abs=0.03), pytest.approx(body.y, abs=0.03))


def test_a_stop_precedes_what_waits_is_repeated_and_the_robot_stops(scene: Scene) -> None:
    scene.drive(1.0, turn=0.5)
    scene.run(0.5)
    scene.drive(0.5)
    scene.written.clear()
    scene.stop()
    scene.lease(False)
    scene.run(1.5)
    assert scene.written[:3] == [*STOP, MOTORS_OFF]
    assert scene.written.count(STOP[0]) == scene.written.count(STOP[1]) >= 8
    assert set(scene.written) == {*STOP, MOTORS_OFF, PULSE}
    assert scene.simulated.truth().neutral
    assert scene.robot.stop_frames() == tuple(STOP)


def test_the_motors_are_on_while_a_program_has_the_lease() -> None:
    scene = established(Arcos())
    assert MOTORS_OFF in scene.written
    scene.drive(0.4)
    scene.run(0.5)
    assert scene.shown["pose"].x == 0.0
    scene.lease(True)
    scene.drive(0.4)
    scene.run(0.5)
    assert scene.simulated.motors
    assert scene.shown["pose"].x > 0.05
    scene.lease(False)
    scene.run(STEP_S)
    assert not scene.simulated.motors


def test_motors_are_on_for_a_lease_that_follows_another_one_while_the_line_is_busy(scene: Scene) -> None:
    scene.stop()
    scene.lease(False)
    scene.lease(True)
    scene.run(STEP_S)
    assert scene.written[:3] == [*STOP, MOTORS_ON]
    assert scene.simulated.motors


def test_the_pulse_keeps_the_robot_moving_and_without_it_the_watchdog_stops_it(scene: Scene) -> None:
    scene.drive(0.2)
    scene.run(4.0)
    assert not scene.simulated.truth().neutral
    for _ in range(round(2.1 / STEP_S)):  # the gateway hangs
        scene.simulated.step(STEP_S)
    assert scene.simulated.truth().neutral


def test_a_robot_that_falls_silent_gets_no_commands_and_is_finally_lost(scene: Scene) -> None:
    scene.answers = False
    scene.run(0.6)
    assert (scene.session.busy, scene.robot.ready) == ("nothing came for 0.5 s", False)
    scene.run(2.5)
    assert scene.session.reason == "nothing came for 3 s"


def test_a_robot_that_was_switched_off_and_on_is_lost_although_it_takes_pulses_for_syncs(scene: Scene) -> None:
    scene.simulated = Arcos()
    scene.run(3.1)
    assert scene.session.reason == "nothing came for 3 s"
    assert scene.session.traffic.malformed > 0


def test_noise_costs_one_packet(scene: Scene) -> None:
    noisy = REPORT_FRAME[:10] + b"\x55" + REPORT_FRAME[11:]
    before = scene.session.traffic.malformed
    assert scene.session.receive(REPORT_FRAME + noisy + REPORT_FRAME, scene.now) == [REPORT, REPORT]
    assert scene.session.traffic.malformed == before + 1


def test_the_pose_does_not_jump_where_a_counter_wraps_nor_with_a_new_connection() -> None:
    scene = established(Arcos((0.5, -1.0, 0.7), at_wrap=True))
    for connection in (1, 2):
        scene.lease(True)
        scene.drive()
        scene.drive(0.8)
        scene.run(1.0)
        scene.stop()
        scene.run(1.0)
        assert scene.shown["pose"].x == pytest.approx(0.4 * connection, abs=0.03)
        assert scene.shown["pose"].y == pytest.approx(0.0, abs=0.01)
        assert scene.simulated.truth().wraps == 1
        scene.connect()
        scene.run(1.0)
        assert scene.shown["pose"].x == pytest.approx(0.4 * connection, abs=0.03)


def test_another_process_takes_a_session_and_a_handshake_over() -> None:
    """Nothing is asked again: the robot notices nothing, and the pose stays."""
    scene = Scene(PROTOCOL, Arcos())
    scene.answers = False
    scene.run(REPORT_S)
    scene.restart()
    scene.answers = True
    scene.run(2.0)
    assert scene.session.state is State.ESTABLISHED
    scene.lease(True)
    scene.drive(0.4)
    scene.run(1.0)
    x = scene.shown["pose"].x
    scene.restart()
    scene.written.clear()
    scene.run(1.0)
    assert OPEN not in scene.written
    assert PULSE in scene.written
    assert scene.shown["pose"].x == pytest.approx(x + 0.2, abs=0.03)


def test_what_the_robot_cannot_do_is_refused_or_left_out(scene: Scene) -> None:
    for topic, command in ((topics.CMD_DRIVE, Drive(left=1.0)), (topics.CMD_LIGHT, Switch(on=True))):
        with pytest.raises(Refused):
            scene.command(topic, command)
    outcome = scene.command(topics.CMD_DRIVE, Drive(forward=0.1, left=0.1, light=True))
    assert outcome.left_out == "left: it does not move sideways; light: it has none"
    assert scene.drive(0.1).left_out is None
    with pytest.raises(Refused):
        scene.robot.ask(topics.POSE)


def test_before_a_connection_everything_is_refused() -> None:
    robot = ArcosRobot(Options())
    for call in (lambda: robot.stop(0.0, 0.0), lambda: robot.command(topics.CMD_DRIVE, Drive(forward=1.0), 0.0)):
        with pytest.raises(Refused):
            call()


def test_a_speed_beyond_16_bits_is_clipped() -> None:
    assert read_command(write(Setting.of(Do.VEL, -40_000))) == Setting(Do.VEL, 0x1B, 32_767)


def test_sonars_are_ranges_at_their_bearings_and_no_echo_is_nothing_in_the_scan() -> None:
    robot, scans = ArcosRobot(Options(sonars=8)), []
    for number in range(8):
        sonar = msgspec.structs.replace(REPORT.sonars[0], number=number, range_mm=850 if number == 2 else 5000)
        shown = dict(robot.telemetry(msgspec.structs.replace(REPORT, sonars=(sonar,)), 1))
        assert shown[topics.SENSOR(f"sonar{number}")].value == sonar.range_mm / 1000
        scans += [shown[topics.SCAN]] if topics.SCAN in shown else []
    (scan,) = scans
    (place,) = [place for place, metres in enumerate(scan.ranges) if not math.isnan(metres)]
    assert math.degrees(scan.angle_min + place * scan.angle_increment) == pytest.approx(30.0)
    assert scan.ranges[place] == pytest.approx(0.85)


def test_the_scan_of_a_whole_ring_shows_the_room(scene: Scene) -> None:
    """The walls are 5 m away, 4.8 m from the ring: ahead, behind and beside the robot."""
    scene.run(1.0)
    scan = scene.shown["scan"]
    assert [math.degrees(angle) for angle in (scan.angle_min, scan.angle_increment)] == pytest.approx([-170, 1])
    assert len(scan.ranges) == 341
    for bearing in (-90, 90):
        assert scan.ranges[bearing + 170] == pytest.approx(4.8, abs=0.01)


def test_bumpers_are_switches(scene: Scene) -> None:
    assert scene.shown["sensor/bumper-front1"].value == scene.shown["sensor/bumper-rear5"].value == 0.0
    scene.drive(-1.0)
    scene.run(12.0)
    assert scene.simulated.body.blocked
    assert scene.shown["sensor/bumper-rear5"].value == 1.0
    assert scene.shown["sensor/bumper-front1"].value == 0.0


def test_the_protocol_names_its_parts() -> None:
    assert (PROTOCOL.name, PROTOCOL.links, PROTOCOL.hq) == ("arcos", 1, None)
    assert isinstance(PROTOCOL.robot(PROTOCOL.options(), 1, None), ArcosRobot)
