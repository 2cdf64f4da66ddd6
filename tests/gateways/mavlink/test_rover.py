"""A rover and its gateway: found, driven, stopped, and left to others."""

from __future__ import annotations

import msgspec
import pytest

from gateways.mavlink.frames import numbered, read_frame, write_frame
from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import (
    AutopilotVersion,
    CommandLong,
    ManualControl,
    ParamSet,
    SetPositionTargetLocalNed,
)
from gateways.mavlink.messages.telemetry import Attitude, MavlinkHeartbeat
from gateways.mavlink.numbers import Command, RoverMode
from gateways.mavlink.rover.helm import Helm, HelmAction, HelmState
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.rover.session import RoverSession
from gateways.mavlink.simulator import ArduRover
from tests.gateways.mavlink.rover_scene import (
    HOLD,
    DeafRover,
    MuteRover,
    RefusingRover,
    begin,
    drive,
    modes,
    plain,
    sent,
)
from zbridge.errors import NeutralFirst, NotReady, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode
from zbridge.protocol import State

STICK = bytes.fromhex("fd0b000000ffbe450000000006fff401000000000146e7")
"""The page's vector: y -250, z 500, to system 1."""
ROVER = MavlinkHeartbeat(4, 10, 3, 1, 4, 3)
STATION = MavlinkHeartbeat(0, 6, 8, 0x80, 4, 3)
COPTER = MavlinkHeartbeat(0, 2, 3, 1, 4, 3)
PX4 = MavlinkHeartbeat(0, 10, 12, 1, 4, 3)
GIMBAL = MavlinkHeartbeat(0, 26, 8, 0, 4, 3)


def driven() -> Helm:
    """Return the helm of rover 1 that we drive since 0.0."""
    helm = Helm(RoverMode.GUIDED, arms=False)
    helm.found(1)
    helm.show(4, armed=True, now=0.0)
    helm.move(0.0)
    helm.show(15, armed=True, now=0.1)
    return helm


def opened(**options: int) -> RoverSession:
    settings = RoverOptions(**options)
    session = RoverSession(settings, Helm(settings.mode, arms=False))
    session.open(0.0)
    return session


def hears(session: RoverSession, message: MavlinkMessage, system: int, component: int = 1, now: float = 0.1) -> object:
    return session.receive(write_frame(message, 0, system, component), now)


# Which system is the rover


def test_a_rover_is_found_among_all_that_speak_on_the_link() -> None:
    session = opened()
    hears(session, ROVER, 81)  # an ArduPilot that does not know its id yet
    for message, system, component in ((STATION, 255, 190), (COPTER, 2, 1), (GIMBAL, 1, 154), (ROVER, 1, 154)):
        for _ in range(3):
            hears(session, message, system, component)
    hears(session, ROVER, 1)
    assert (session.state, session.outgoing(0.1)) == (State.HANDSHAKING, None)
    hears(session, ROVER, 1)
    assert (session.state, session.vehicle) == (State.ESTABLISHED, 1)
    assert session.left_out == {"frames of other systems": 12}


def test_a_configured_rover_is_the_only_one() -> None:
    session = opened(vehicle_id=7)
    hears(session, ROVER, 1)
    hears(session, ROVER, 1)
    assert session.state is State.HANDSHAKING
    hears(session, ROVER, 7)
    assert (session.state, session.vehicle) == (State.ESTABLISHED, 7)


@pytest.mark.parametrize(
    ("beat", "options", "reason"),
    [
        (PX4, {"vehicle_id": 1}, "vehicle 1 has a PX4 (autopilot 12): only ArduPilot is supported"),
        (COPTER, {"vehicle_id": 1}, "vehicle 1 is of type 2, autopilot 3: expected an ArduRover"),
    ],
)
def test_what_is_no_ardurover_is_refused_with_the_reason(beat, options, reason) -> None:
    session = opened(**options)
    hears(session, beat, 1)
    assert (session.state, session.reason) == (State.CLOSED, reason)


@pytest.mark.parametrize(
    ("beat", "what"),
    [
        (PX4, "vehicle 9 has a PX4 (autopilot 12): only ArduPilot is supported"),
        (MavlinkHeartbeat(0, 10, 8, 1, 4, 3), "vehicle 9 is of type 10, autopilot 8: expected an ArduRover"),
    ],
)
def test_a_rover_that_is_no_ardurover_is_named_and_does_not_hide_the_one_beside_it(beat, what: str) -> None:
    session = opened()
    hears(session, beat, 9)
    assert session.state is State.HANDSHAKING
    session.expire(10.0)
    assert session.reason == what
    session = opened()
    for heard, system in ((beat, 9), (ROVER, 1), (beat, 9), (ROVER, 1)):
        hears(session, heard, system)
    assert (session.state, session.vehicle) == (State.ESTABLISHED, 1)


def test_what_comes_of_system_0_is_not_the_rovers() -> None:
    session = opened()
    assert [hears(session, message, 0) for message in (Attitude(yaw=1.0), ROVER, ROVER)] == [[], [], []]
    assert (session.state, session.helm.mode) == (State.HANDSHAKING, None)


def test_a_process_drives_the_rover_that_it_found_first_and_no_other() -> None:
    scene = begin()
    drive(scene, 1.0)
    scene.simulated = ArduRover(system=7)
    scene.simulated.switch_mode(RoverMode.GUIDED)
    scene.simulated.switch_arming(True)
    scene.connect()
    scene.run(10.1)
    assert scene.session.reason.endswith("expected system 1")
    assert scene.simulated.mode is RoverMode.GUIDED


def test_a_mode_belongs_to_one_vehicle() -> None:
    helm = driven()
    helm.found(7)
    assert (helm.vehicle, helm.ours, helm.mode) == (7, False, None)


def test_a_link_without_a_rover_says_what_was_heard() -> None:
    session = opened()
    hears(session, STATION, 255, 190)
    session.expire(10.0)
    assert session.reason == "no HEARTBEAT but 1 frames of others within 10 s: expected a rover or boat"


def test_others_are_not_translated_obeyed_or_taken_for_the_rover() -> None:
    scene = begin()
    drive(scene, 1.0)
    shown = dict(scene.shown)
    for message, system, component in ((COPTER, 2, 1), (ROVER, 2, 1), (GIMBAL, 1, 154), (Attitude(yaw=2.0), 1, 191)):
        assert scene.session.receive(write_frame(message, 0, system, component), scene.now) == []
    assert (scene.robot.helm.state, scene.shown) == (HelmState.DRIVING, shown)
    assert scene.session.left_out == {"frames of other systems": 4}


def test_a_rover_without_heartbeat_is_lost_after_three_seconds_whatever_else_comes() -> None:
    session, now = opened(vehicle_id=1), 0.1
    hears(session, ROVER, 1, now=now)
    hears(session, ROVER, 1, now=now)
    while now < 3.0:
        now += 0.1
        hears(session, Attitude(yaw=1.0), 1, now=now)
        session.expire(now)
    assert session.state is State.ESTABLISHED
    session.expire(3.2)
    assert (session.state, session.reason) == (State.CLOSING, "nothing came for 3 s")


def test_a_rover_that_is_lost_while_we_drive_it_is_sent_a_stop_behind_all_motion() -> None:
    rover = MuteRover()
    scene = begin(rover)
    drive(scene, 1.0)
    rover.mute = True
    drive(scene, 2.0)
    assert not scene.session.over
    scene.run(1.2)
    assert scene.session.state is State.CLOSED
    setpoint, hold = plain(scene)[-2:]
    assert (read_frame(setpoint).message.vx, hold) == (0.0, HOLD)  # type: ignore[union-attr]
    assert rover.mode is RoverMode.HOLD


def test_a_rover_that_is_lost_in_the_mode_of_its_pilot_is_left_alone() -> None:
    rover = MuteRover()
    scene = begin(rover)
    rover.switch_mode(RoverMode.AUTO)
    scene.run(0.1)
    rover.mute, before = True, len(scene.written)
    scene.run(3.5)
    assert scene.session.over
    assert modes(scene, before) == []


def test_two_vehicles_with_one_id_are_not_driven() -> None:
    rover = ArduRover()
    scene = begin(rover)
    rover.send(AutopilotVersion(uid=0x5678))
    scene.run(0.1)
    with pytest.raises(NotReady, match="two vehicles have the id 1"):
        scene.drive(0.5)


# Driving


def test_the_first_motion_asks_for_guided_and_arms_and_is_repeated() -> None:
    scene = begin()
    since = len(scene.written)
    scene.drive(0.5, turn=0.25)
    scene.run(1.01)
    commands = [each.command for each in sent(scene, CommandLong, since)]
    assert commands == [Command.DO_SET_MODE, Command.ARM]
    assert modes(scene, since) == [RoverMode.GUIDED]
    setpoints = sent(scene, SetPositionTargetLocalNed, since)
    assert len(setpoints) in (5, 6)
    assert set(setpoints) == {
        SetPositionTargetLocalNed(
            vx=0.5, yaw_rate=-0.25, type_mask=0x5C7, target_system=1, target_component=1, coordinate_frame=8
        )
    }
    assert scene.simulated.truth().heading > 0.2
    assert scene.simulated.truth().x > 0.3
    scene.drive(0.0)
    scene.run(0.7)
    assert sent(scene, SetPositionTargetLocalNed)[-1].vx == 0.0
    assert scene.simulated.truth().neutral


def test_backward_turns_are_counter_clockwise_too_and_motion_has_the_sign_of_the_drive() -> None:
    scene = begin()
    drive(scene, 1.0, -0.5, 0.5)
    truth = scene.simulated.truth()
    assert truth.x < -0.2
    assert truth.heading > 0.2
    assert scene.shown["motion"].speed == pytest.approx(-0.5, abs=0.02)
    assert scene.shown["motion"].gyro[2] == pytest.approx(0.5)


@pytest.mark.parametrize(("steer_type", "y"), [(0, 500), (1, -500), (2, 500)])
def test_a_stick_is_mirrored_backward_where_the_rover_reverses_its_steering(steer_type: int, y: int) -> None:
    scene = begin(ArduRover(PILOT_STEER_TYPE=float(steer_type)), drive="manual")
    drive(scene, 1.0, -0.5, 0.5)
    assert sent(scene, ManualControl)[-1] == ManualControl(y=y, z=-500, target=1)
    assert scene.simulated.truth().heading > 0.2
    assert modes(scene) == [RoverMode.MANUAL]


def test_a_stick_is_that_of_the_page_and_repeated_ten_times_a_second() -> None:
    scene = begin(drive="manual")
    since = len(scene.written)
    scene.drive(0.5, turn=0.25)
    scene.run(1.01)
    assert plain(scene, since).count(STICK) in (10, 11)
    assert scene.simulated.truth().heading > 0.2


def test_what_a_rover_cannot_do_is_refused_or_left_out() -> None:
    scene = begin()
    with pytest.raises(Unsupported, match="left"):
        scene.drive(left=1.0)
    with pytest.raises(Unsupported):
        scene.command(topics.CMD_MODE, Mode(mode="autonomous"))
    assert scene.drive(0.5, left=0.5).left_out == "left: a rover does not move sideways"
    assert "light" in scene.command(topics.CMD_DRIVE, Drive(light=True)).left_out


# Arming


def test_a_rover_that_its_operator_arms_is_not_ready_before_and_not_touched() -> None:
    scene = begin(arm="operator")
    since = len(scene.written)
    with pytest.raises(NotReady, match=r"^disarmed$"):
        scene.drive(0.5)
    scene.run(0.5)
    assert modes(scene, since) == []
    scene.simulated.switch_arming(True)
    scene.run(0.1)
    drive(scene, 1.0)
    assert scene.simulated.truth().x > 0.2
    assert Command.ARM not in [each.command for each in sent(scene, CommandLong)]
    scene.simulated.switch_arming(False)
    scene.run(0.1)
    with pytest.raises(NotReady, match=r"^disarmed$"):
        scene.drive(0.5)


def test_a_refused_arming_is_told_with_the_rovers_own_reason_until_neutral() -> None:
    scene = begin()
    scene.simulated.arming_fault = "Throttle (RC3) is not neutral"
    scene.drive(0.5)
    scene.run(0.3)
    with pytest.raises(NotReady, match=r"^arming refused: Arm: Throttle \(RC3\) is not neutral$"):
        scene.drive(0.5)
    scene.run(3.0)
    assert (scene.simulated.mode, modes(scene).count(RoverMode.GUIDED)) == (RoverMode.HOLD, 1)
    scene.simulated.arming_fault = None
    scene.drive(0.0)
    drive(scene, 0.5)
    assert scene.robot.helm.state is HelmState.DRIVING


def test_a_mode_that_is_never_shown_is_asked_for_four_times_and_then_not_ready() -> None:
    scene = begin(rover := DeafRover())
    rover.deaf = {Command.DO_SET_MODE: 99}
    drive(scene, 1.9)
    assert modes(scene) == [RoverMode.GUIDED] * 4
    scene.run(0.2)
    with pytest.raises(NotReady, match=r"^mode HOLD$"):
        scene.drive(0.5)
    scene.run(3.0)
    assert modes(scene) == [RoverMode.GUIDED] * 4


def test_nothing_is_armed_in_the_mode_of_a_mission() -> None:
    scene = begin(rover := DeafRover())
    rover.deaf = {Command.DO_SET_MODE: 2}
    rover.switch_mode(RoverMode.AUTO)  # a mission begins when the rover is armed
    scene.run(0.1)
    scene.drive(0.5)
    scene.run(0.9)
    assert (rover.mode, rover.armed, rover.speed_m_s) == (RoverMode.AUTO, False, 0.0)
    scene.run(0.5)
    assert (rover.mode, rover.armed, scene.robot.helm.state) == (RoverMode.GUIDED, True, HelmState.DRIVING)


def test_what_the_rover_accepted_is_asked_for_no_more() -> None:
    scene = begin(rover := MuteRover())
    rover.switch_arming(True)
    rover.switch_mode(RoverMode.STEERING)
    scene.run(0.1)
    rover.mute = True  # it may show a new mode a second later
    scene.drive(0.5)
    scene.run(0.1)
    assert rover.mode is RoverMode.GUIDED
    rover.switch_mode(RoverMode.STEERING)
    scene.run(1.0)
    assert (rover.mode, modes(scene)) == (RoverMode.STEERING, [RoverMode.GUIDED])
    rover.mute = False
    scene.run(3.0)
    assert (rover.mode, scene.robot.helm.state) == (RoverMode.STEERING, HelmState.OTHERS)


def test_a_rover_that_accepted_our_mode_has_time_to_show_it() -> None:
    helm = Helm(RoverMode.GUIDED, arms=False)
    helm.show(4, armed=True, now=0.0)
    helm.move(0.0)
    helm.wait(1.0)  # the answer of a slow link
    assert helm.expire(2.5) is HelmAction.NOTHING
    helm.show(15, armed=True, now=2.6)
    assert helm.state is HelmState.DRIVING


def test_our_own_hold_that_is_shown_late_refuses_no_motion() -> None:
    helm = Helm(RoverMode.MANUAL, arms=False)
    helm.show(3, armed=True, now=0.0)
    helm.move(0.0)
    assert helm.neutral(0.1) is HelmAction.STOP
    helm.show(3, armed=True, now=0.5)  # it was sent before
    assert helm.state is HelmState.OTHERS
    helm.move(1.4)
    assert helm.show(4, armed=True, now=1.5) is HelmAction.NOTHING
    helm.show(0, armed=True, now=2.5)
    assert helm.state is HelmState.DRIVING


def test_a_mode_that_was_accepted_late_is_still_ours_when_it_is_shown() -> None:
    helm = Helm(RoverMode.MANUAL, arms=False)
    helm.show(4, armed=True, now=0.0)
    helm.move(0.0)
    helm.wait(1.8)
    helm.show(3, armed=True, now=2.0)  # as it seems, its pilot has it
    assert helm.show(0, armed=True, now=2.5) is HelmAction.STOP


# Stops


def test_a_stop_is_neutral_then_hold_and_nothing_is_ever_disarmed_or_written_to_its_parameters() -> None:
    scene = begin()
    drive(scene, 0.5)
    since = len(scene.written)
    scene.stop()
    scene.run(2.0)
    first, second, *_ = plain(scene, since)
    assert (second, sent(scene, SetPositionTargetLocalNed, since)[0].vx) == (HOLD, 0.0)
    assert first == numbered(scene.written[since], 0)
    assert (scene.simulated.mode, scene.simulated.armed) == (RoverMode.HOLD, True)
    assert (scene.simulated.truth().neutral, scene.robot.helm.state) == (True, HelmState.HELD)
    assert sent(scene, ParamSet) == []
    assert [each for each in sent(scene, CommandLong) if each.command == Command.ARM and each.param1 != 1.0] == []
    drive(scene, 0.5)  # the next motion asks again
    assert (scene.simulated.mode, scene.robot.helm.state) == (RoverMode.GUIDED, HelmState.DRIVING)


def test_a_stop_is_repeated_until_the_rover_shows_it_and_no_longer() -> None:
    scene = begin(rover := DeafRover())
    drive(scene, 0.5)
    since, rover.deaf = len(scene.written), {Command.DO_SET_MODE: 2}
    scene.stop()
    scene.run(2.0)
    assert modes(scene, since) == [RoverMode.HOLD] * 3
    assert (rover.mode, scene.robot.helm.warning) == (RoverMode.HOLD, None)


@pytest.mark.parametrize("phase_s", [0.1, 0.4, 0.7])
def test_a_stop_takes_the_request_for_our_mode_back(phase_s: float) -> None:
    scene = begin(rover := DeafRover())
    scene.run(phase_s)
    rover.deaf = {Command.DO_SET_MODE: 99}
    scene.drive(0.5)
    scene.run(0.05)
    scene.stop()
    scene.run(3.0)
    assert modes(scene)[0] is RoverMode.GUIDED
    assert set(modes(scene)[1:]) == {RoverMode.HOLD}


def test_a_stop_that_is_not_confirmed_ends_after_a_second_and_is_warned_of_until_it_is() -> None:
    scene = begin(rover := DeafRover())
    drive(scene, 0.5)
    since, rover.deaf = len(scene.written), {Command.DO_SET_MODE: 99}
    scene.stop(3.0)
    scene.run(2.5)
    assert modes(scene, since) in ([RoverMode.HOLD] * 5, [RoverMode.HOLD] * 6)
    assert "HOLD was not confirmed: mode GUIDED" in scene.session.warnings
    rover.deaf = {}
    scene.rest(0.0)  # our own mode: idle stops go on
    scene.run(1.5)
    assert (rover.mode, scene.robot.helm.state) == (RoverMode.HOLD, HelmState.HELD)
    assert "HOLD" not in " ".join(scene.session.warnings)


def test_a_heartbeat_from_before_the_stop_does_not_confirm_it() -> None:
    helm = Helm(RoverMode.GUIDED, arms=True)
    helm.show(4, armed=True, now=0.0)
    helm.move(0.1)
    helm.stop(0.2, ordered=True)
    helm.show(4, armed=True, now=0.25)  # sent before GUIDED was obeyed
    helm.show(15, armed=True, now=0.3)
    assert helm.state is HelmState.STOPPING
    helm.show(4, armed=True, now=1.2)
    assert helm.state is HelmState.HELD


def test_a_dying_gateway_leaves_a_stop_only_while_it_drives() -> None:
    scene = begin()
    assert scene.robot.stop_frames() == ()
    drive(scene, 0.5)
    neutral, hold = scene.robot.stop_frames()
    assert (numbered(hold, 0), scene.robot.helm.state) == (HOLD, HelmState.DRIVING)
    scene.simulated.receive(neutral + hold)
    assert scene.simulated.mode is RoverMode.HOLD
    scene.run(2.1)  # to the HEARTBEAT that confirms our own stop
    assert scene.robot.stop_frames() == ()
    scene.session.fail("gone")
    assert scene.robot.stop_frames() == ()


# Stops of what the rover may be doing by our order


def test_a_rover_whose_heartbeats_are_lost_while_we_ask_is_stopped(monkeypatch) -> None:
    scene = begin()
    with monkeypatch.context() as lost:
        lost.setattr(scene.simulated, "send", lambda *messages: None)
        scene.drive(0.5)
        scene.run(2.1)
    with pytest.raises(NotReady, match=r"^mode GUIDED was not shown$"):
        scene.drive(0.5)
    scene.run(1.0)
    assert (scene.simulated.mode, scene.simulated.speed_m_s) == (RoverMode.HOLD, 0.0)


def test_a_rover_that_is_disarmed_does_not_drive_on_when_it_is_armed_again() -> None:
    scene = begin(arm="operator", status_hz=0)
    scene.simulated.switch_arming(True)
    scene.run(0.1)
    drive(scene, 1.0)
    scene.simulated.switch_arming(False)
    scene.run(0.6)
    scene.simulated.switch_arming(True)
    scene.run(0.5)
    assert (scene.simulated.mode, scene.simulated.speed_m_s) == (RoverMode.HOLD, 0.0)


@pytest.mark.parametrize(("shown", "state"), [(4, HelmState.OTHERS), (3, HelmState.OTHERS), (15, HelmState.DRIVING)])
def test_nothing_is_in_flight_on_a_new_connection(shown: int, state: HelmState) -> None:
    helm = driven()
    helm.stop(1.0, ordered=False)
    helm.move(1.1)  # lost with the connection, or not
    helm.found(1)
    helm.show(shown, armed=True, now=1.5)
    assert helm.state is state


def test_our_own_hold_that_is_shown_late_is_no_reason_to_send_nothing() -> None:
    helm = driven()
    helm.stop(2.0, ordered=False)
    helm.neutral(2.1)
    assert helm.move(2.1) is HelmAction.ASK
    helm.show(15, armed=True, now=2.2)  # of before the stop
    assert helm.state is HelmState.ASKED
    helm.show(15, armed=True, now=3.2)
    assert helm.state is HelmState.DRIVING
    assert helm.show(4, armed=True, now=3.3) is HelmAction.STOP


@pytest.mark.parametrize(("shown_at", "action"), [(3.0, HelmAction.STOP), (9.0, HelmAction.LEAVE)])
def test_our_mode_that_is_shown_after_a_stop_is_ours_for_some_seconds(shown_at: float, action: HelmAction) -> None:
    helm = driven()
    helm.stop(1.0, ordered=False)
    helm.show(4, armed=True, now=1.1)
    assert helm.state is HelmState.HELD
    assert helm.show(15, armed=True, now=shown_at) is action


@pytest.mark.parametrize("stops", [False, True])
@pytest.mark.parametrize("leaves", [False, True])
def test_a_driver_who_lets_go_takes_no_mode_arms_nothing_and_leaves_the_pilots_stick_alone(stops, leaves) -> None:
    scene = begin(rover := DeafRover(), drive="manual")
    rover.deaf = {Command.DO_SET_MODE: 1, Command.ARM: 1} if leaves else {}
    rover.stick = (0.5, 0.0)
    rover.switch_mode(RoverMode.STEERING)
    scene.run(0.1)
    scene.drive(1.0)
    if leaves:
        scene.run(0.1)
    scene.stop() if stops else scene.drive(0.0)
    scene.run(3.0)
    assert sent(scene, ManualControl) == []
    assert (rover.mode, rover.armed) == (RoverMode.HOLD, False)
    assert scene.robot.helm.state is HelmState.HELD


def test_a_pilot_whose_rover_refuses_our_mode_keeps_it() -> None:
    scene = begin(rover := RefusingRover(), drive="manual")
    rover.stick = (0.5, 0.0)
    rover.switch_mode(RoverMode.STEERING)
    rover.switch_arming(True)
    scene.run(0.1)
    scene.drive(1.0)
    scene.run(3.0)
    assert (modes(scene), sent(scene, ManualControl)) == ([RoverMode.MANUAL], [])
    assert rover.speed_m_s == pytest.approx(0.5)


def test_a_warning_of_a_stop_ends_with_the_mode_and_with_the_connection() -> None:
    helm = driven()
    helm.stop(1.0, ordered=True)
    helm.show(0, armed=True, now=2.5)
    assert helm.warning == "HOLD was not confirmed: mode MANUAL"
    helm.show(0, armed=True, now=3.5)
    assert helm.warning
    helm.show(3, armed=True, now=4.5)
    assert helm.warning is None
    helm.stop(5.0, ordered=True)
    helm.show(3, armed=True, now=6.5)
    assert helm.warning
    helm.found(1)
    assert helm.warning is None


def test_what_a_rover_says_later_is_not_why_it_refused() -> None:
    helm = driven()
    helm.show(0, armed=True, now=1.0)
    helm.say("EKF variance")
    helm.show(0, armed=True, now=2.0)
    helm.say("target not received last 3.0secs, stopping")
    with pytest.raises(NotReady, match=r"^mode MANUAL: EKF variance$"):
        helm.move(2.1)


# Others drive it too


def test_a_pilot_gets_the_stick_back_though_a_message_is_lost() -> None:
    scene = begin(drive="manual")
    drive(scene, 1.0)
    scene.simulated.switch_mode(RoverMode.STEERING)
    scene.simulated.parameters["MAV_GCS_SYSID"] = 1.0  # our next stick is lost
    scene.run(0.1)
    assert not scene.simulated.truth().neutral
    scene.simulated.parameters["MAV_GCS_SYSID"] = 255.0
    scene.run(0.4)
    assert scene.simulated.truth().neutral


@pytest.mark.parametrize("mode", [RoverMode.AUTO, RoverMode.MANUAL, RoverMode.GUIDED])
@pytest.mark.parametrize("how", ["guided", "manual"])
def test_a_rover_of_others_is_left_alone_by_all_stops_but_an_order(mode: RoverMode, how: str) -> None:
    rover = ArduRover()
    rover.switch_mode(mode)
    rover.switch_arming(True)
    rover.stick = (0.3, 0.0)
    scene = begin(rover, drive=how)
    for _ in range(5):
        scene.rest(0.0)
        scene.run(0.5)
    scene.drive(0.0)  # nor does a neutral go there
    scene.run(0.5)
    assert (rover.mode, modes(scene), scene.robot.stop_frames()) == (mode, [], ())
    assert sent(scene, ManualControl) + sent(scene, SetPositionTargetLocalNed) == []
    scene.stop()
    scene.run(1.0)
    assert (rover.mode, rover.truth().neutral) == (RoverMode.HOLD, True)
    assert sent(scene, ManualControl) == []


@pytest.mark.parametrize("how", ["guided", "manual"])
def test_a_pilot_who_takes_the_rover_keeps_it_until_the_driver_sent_neutral(how: str) -> None:
    scene = begin(drive=how)
    drive(scene, 0.5)
    rover, pilots = scene.simulated, RoverMode.STEERING
    rover.stick = (0.4, 0.0)
    rover.switch_mode(pilots)
    scene.run(0.1)
    since = len(scene.written)
    for _ in range(5):
        with pytest.raises(NotReady, match=r"^mode STEERING$"):
            scene.drive(0.5)
        scene.run(0.1)
    scene.rest()  # the deadman
    scene.run(5.0)
    assert (rover.mode, modes(scene, since)) == (pilots, [])
    assert {(each.y, each.z) for each in sent(scene, ManualControl, since)} <= {(32767, 32767)}
    assert sent(scene, SetPositionTargetLocalNed, since) == []
    assert rover.speed_m_s == pytest.approx(0.4)  # our last stick counts no more
    scene.drive(0.0)
    scene.run(0.5)
    assert rover.mode is pilots
    drive(scene, 0.5)
    assert rover.mode is scene.robot.helm.driving


@pytest.mark.parametrize("ordered", [False, True])
def test_a_pilot_who_takes_the_rover_during_a_stop_keeps_it_unless_the_stop_is_an_order(ordered: bool) -> None:
    scene = begin(rover := DeafRover())
    drive(scene, 0.5)
    rover.deaf = {Command.DO_SET_MODE: 1}
    scene.stop() if ordered else scene.rest()
    scene.run(0.1)
    rover.switch_mode(RoverMode.MANUAL)
    scene.run(2.0)
    assert rover.mode is (RoverMode.HOLD if ordered else RoverMode.MANUAL)


@pytest.mark.parametrize("held", [False, True])
def test_our_last_stick_does_not_hold_the_pilots_off(held: bool) -> None:
    scene = begin(drive="manual")
    drive(scene, 0.5)
    if held:
        scene.stop()
        scene.run(0.5)
    scene.simulated.stick = (-0.4, 0.0)
    scene.simulated.switch_mode(RoverMode.STEERING)
    scene.run(0.5)
    assert sent(scene, ManualControl)[-1] == ManualControl(y=32767, z=32767, target=1)
    assert scene.simulated.speed_m_s == pytest.approx(-0.4)


def test_a_stick_is_given_back_by_the_next_connection_and_by_stops_that_are_latched() -> None:
    scene = begin(drive="manual")
    drive(scene, 0.5)
    scene.simulated.switch_mode(RoverMode.STEERING)
    scene.connect()
    scene.establish()
    assert sent(scene, ManualControl)[-1] == ManualControl(y=32767, z=32767, target=1)
    for _ in range(3):
        scene.stop(0.0)
        scene.run(1.0)
    assert sent(scene, ManualControl)[-1] == ManualControl(y=32767, z=32767, target=1)


def test_a_pilot_may_take_a_rover_that_we_hold() -> None:
    scene = begin()
    drive(scene, 0.5)
    scene.stop()
    scene.run(1.5)
    scene.simulated.switch_mode(RoverMode.MANUAL)
    since = len(scene.written)
    for _ in range(5):
        scene.rest(0.0)
        scene.run(1.0)
    assert (scene.simulated.mode, modes(scene, since)) == (RoverMode.MANUAL, [])
    assert scene.robot.helm.state is HelmState.OTHERS


def test_a_new_connection_stops_a_rover_that_is_still_in_our_mode() -> None:
    scene = begin()
    drive(scene, 0.5)
    scene.connect()
    scene.establish()
    assert scene.simulated.mode is RoverMode.HOLD
    with pytest.raises(NeutralFirst):
        scene.drive(0.5)


# Requests


def test_a_command_is_sent_four_times_numbered_and_then_reported() -> None:
    rover = DeafRover()
    rover.deaf = {Command.REQUEST_MESSAGE: 4}
    scene = begin(rover)
    scene.run(3.0)
    versions = [each for each in sent(scene, CommandLong) if each.command == 512 and each.param1 == 148.0]
    assert [each.confirmation for each in versions] == [0, 1, 2, 3]
    assert scene.session.left_out == {"command 512 (148) without an answer": 1}
    assert scene.shown["scan"]  # the others were asked for all the same


def test_a_stream_that_stops_is_asked_for_again_after_five_seconds() -> None:
    scene = begin()
    before = sent(scene, CommandLong)
    off = CommandLong(30.0, -1.0, command=Command.SET_MESSAGE_INTERVAL, target_system=1)
    scene.simulated.receive(write_frame(off, 0, 245, 190))  # another ground station's
    scene.run(4.5)
    assert sent(scene, CommandLong) == before
    scene.run(2.5)
    (again,) = sent(scene, CommandLong)[len(before) :]
    assert (again.command, again.param1, again.param2) == (511, 30.0, 200000.0)


def test_requests_do_not_pile_up_where_nothing_is_answered(monkeypatch) -> None:
    scene = begin()
    scene.simulated.connected()  # streams no more
    send = scene.simulated.send
    beats = lambda *messages: send(*(each for each in messages if isinstance(each, MavlinkHeartbeat)))  # noqa: E731
    monkeypatch.setattr(scene.simulated, "send", beats)
    scene.run(60.0)
    assert int(repr(scene.session.requests).split()[1]) <= 9


@pytest.mark.parametrize("rate", [1e-40, 0.009, -1.0, 51.0])
def test_rates_are_bounded(rate: float) -> None:
    with pytest.raises(ValueError, match=r"[Ee]xpected"):
        msgspec.convert({"position_hz": rate}, RoverOptions)
    assert msgspec.convert({"position_hz": 0, "ranges_hz": 0.01}, RoverOptions).ranges_hz == 0.01


@pytest.mark.parametrize(
    ("parameters", "options", "warnings"),
    [
        ({}, {}, ("GUID_TIMEOUT is 3 s: the rover drives on for so long if the gateway dies",)),
        ({"GUID_TIMEOUT": 1.0}, {}, ()),
        (
            {"MAV_GCS_SYSID": 250.0, "FS_GCS_TIMEOUT": 2.0},
            {"drive": "manual"},
            (
                "FS_GCS_ENABLE is 0: no failsafe acts if the gateway dies",
                "RC_OVERRIDE_TIME is 3 s: the rover drives on for so long if the gateway dies",
                "MAV_GCS_SYSID is 250: the rover ignores the sticks of system 255",
            ),
        ),
        ({"FS_GCS_ENABLE": 1.0, "FS_GCS_TIMEOUT": 2.0, "RC_OVERRIDE_TIME": 1.0}, {"drive": "manual"}, ()),
    ],
)
def test_status_warns_where_a_rover_would_drive_on(parameters, options, warnings) -> None:
    assert begin(ArduRover(**parameters), **options).session.warnings == warnings


# A restart


def test_another_process_takes_a_driving_rover_over_and_can_stop_it() -> None:
    scene = begin()
    drive(scene, 0.5)
    scene.restart()
    assert scene.session.warnings == ("GUID_TIMEOUT is 3 s: the rover drives on for so long if the gateway dies",)
    since = len(scene.written)
    drive(scene, 5.0, 0.1)
    assert (modes(scene, since), scene.robot.helm.state) == ([], HelmState.DRIVING)
    scene.restart()
    scene.rest()
    scene.run(0.5)
    assert scene.simulated.mode is RoverMode.HOLD


def test_a_second_gateway_leaves_the_rover_as_its_heartbeat_would_hide_a_lost_one() -> None:
    assert begin().robot.closing_harmless


def test_status_says_why_a_drive_would_be_refused() -> None:
    scene = begin(rover := ArduRover(GUID_TIMEOUT=1.0), arm="operator")
    assert scene.session.warnings == ("disarmed",)
    rover.switch_arming(True)
    scene.run(0.1)
    assert scene.session.warnings == ()
    drive(scene, 1.0)
    rover.switch_mode(RoverMode.AUTO)
    scene.run(0.1)
    assert scene.session.warnings == ("mode AUTO",)
    scene.drive()
    scene.run(1.1)
    assert scene.session.warnings == ()
