"""What ground stations are told and what they order; pymavlink is the ground station, and shares no code with us."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import pytest

from gateways.mavlink.station.driving import VELOCITY_ONLY
from gateways.mavlink.station.hq import MavlinkHq
from gateways.mavlink.station.options import MavlinkHqOptions, Origin
from zbridge.fleet import topics
from zbridge.fleet.messages import Battery, Control, Drive, FleetMessage, Latch, Motion, Pose, Scan, Status, Stop, Text
from zbridge.fleet.view import RobotView
from zbridge.lease.stick import StickRules
from zbridge.protocol import Limits, Telemetry

os.environ["MAVLINK20"] = "1"
mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
BOUNDS = Limits(frame_bytes=65536, handshake_s=5.0)
ESTABLISHED = Status("established", protocol="alf")
HOLD, MANUAL, GUIDED, AUTO = 4, 0, 15, 10
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
ARM, SET_MODE, REQUEST, INTERVAL, TERMINATE = 400, 176, 512, 511, 185
SYSTEM = 7
VELOCITY = 0x5C7


class Ground:
    """One ground station: pymavlink at the other end of a session."""

    def __init__(self, scene: Scene, number: int, system: int) -> None:
        self.scene = scene
        self.session = scene.side.session(number, BOUNDS)
        self.session.name = f"mavlink:5760.{number}"
        self.told: list[Any] = []
        self._link = mavlink.MAVLink(self, srcSystem=system, srcComponent=190)
        self._written = b""
        self.session.open(scene.now)
        scene.side.begin(self.session, scene.now)

    def write(self, data: bytes) -> None:
        self._written += data

    def says(self, *messages: Any) -> list[Telemetry]:
        """Send messages at once; return what the robot is ordered."""
        for message in messages:
            self._link.send(message)
        data, self._written = self._written, b""
        frames = self.session.receive(data, self.scene.now)
        return [ordered for frame in frames for ordered in self.scene.side.take(self.session, frame)]

    def commands(self, command: int, *values: float, target: int = SYSTEM) -> list[Telemetry]:
        padded = (*values, *[0.0] * (7 - len(values)))
        return self.says(mavlink.MAVLink_command_long_message(target, 1, command, 0, *padded))

    def mode(self, mode: int) -> list[Telemetry]:
        return self.commands(SET_MODE, 1, mode)

    def aims(self, forward: float, yaw_rate: float = 0.0, *, frame: int = 8, mask: int = VELOCITY) -> list[Telemetry]:
        return self.says(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, SYSTEM, 1, frame, mask, 0, 0, 0, forward, 0, 0, 0, 0, 0, 0, yaw_rate
            )
        )

    def stick(self, z: int, y: int = 0, target: int = SYSTEM) -> list[Telemetry]:
        return self.says(mavlink.MAVLink_manual_control_message(target, 0, y, z, 0, 0))

    def hears(self) -> list[Any]:
        """Return what was written since the last time."""
        data = b""
        while (frame := self.session.outgoing(self.scene.now)) is not None:
            data += frame
        heard = self._link.parse_buffer(data) or []
        self.told += heard
        return heard

    def heard(self, name: str) -> list[Any]:
        return [message for message in self.hears() if message.get_type() == name]

    @property
    def shown(self) -> tuple[int, bool]:
        """Mode and arming of the last heartbeat."""
        self.hears()
        beat = [message for message in self.told if message.get_type() == "HEARTBEAT"][-1]
        return beat.custom_mode, bool(beat.base_mode & 128)

    @property
    def acknowledged(self) -> list[tuple[int, int]]:
        self.hears()
        return [(ack.command, ack.result) for ack in self.told if ack.get_type() == "COMMAND_ACK"]

    @property
    def texts(self) -> list[str]:
        self.hears()
        return [message.text for message in self.told if message.get_type() == "STATUSTEXT"]


class Scene:
    """One listener, its robot as it was seen last, and its ground stations."""

    def __init__(self, stations: int = 1, *, status: Status = ESTABLISHED, **options: Any) -> None:
        self.now = 100.0
        self.view = RobotView()
        self.view.alive = True
        self.view.note(topics.STATUS, status)
        self.side = MavlinkHq(MavlinkHqOptions(SYSTEM, **options), self.view)
        self.stations = [Ground(self, number + 1, 255) for number in range(stations)]

    def publishes(self, path: str, message: FleetMessage) -> None:
        topic = topics.find(path)
        assert topic is not None
        assert path in self.side.follows or path == "status"
        self.view.note(topic, message)
        self.send(self.side.show(topic, message))

    def send(self, send: Any) -> None:
        for ground in self.stations:
            if send is not None:
                send(ground.session, self.now)

    def runs(self, seconds: float) -> None:
        """Let time pass in steps of 50 ms."""
        for _ in range(round(seconds / 0.05)):
            self.now += 0.05
            for ground in self.stations:
                if ground.session.timers() <= self.now:
                    ground.session.expire(self.now)


def drives(ordered: list[Telemetry]) -> list[Drive]:
    assert all(topic is topics.CMD_DRIVE for topic, _ in ordered)
    return [message for _, message in ordered if isinstance(message, Drive)]


def guided(**options: Any) -> tuple[Scene, Ground]:
    """A station in GUIDED, armed, whose setpoints count."""
    scene = Scene(**options)
    (ground,) = scene.stations
    ground.commands(ARM, 1)
    ground.mode(GUIDED)
    for _ in range(7):
        assert not drives(ground.aims(0.5))[0].moving
        scene.runs(0.05)
    scene.runs(0.05)
    return scene, ground


# What a station hears


def test_a_station_hears_a_heartbeat_first_though_it_said_nothing() -> None:
    first, *_ = Scene().stations[0].hears()
    assert (first.get_type(), first.get_srcSystem(), first.get_srcComponent()) == ("HEARTBEAT", SYSTEM, 1)
    assert (first.type, first.autopilot, first.custom_mode, first.base_mode & 128) == (10, 3, HOLD, 0)


def test_heartbeats_come_every_second_while_the_robot_is_there() -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.hears()
    scene.runs(3.0)
    assert len(ground.heard("HEARTBEAT")) == 1  # only the newest waits
    scene.send(scene.side.presence(False))
    scene.runs(3.0)
    assert not ground.hears()
    scene.send(scene.side.presence(True))
    assert ground.heard("HEARTBEAT")


def test_a_station_of_a_robot_that_is_away_hears_nothing_but_answers() -> None:
    scene = Scene(status=Status("offline", reason="no route"))
    (ground,) = scene.stations
    assert not ground.hears()
    ground.commands(ARM, 1)
    assert ground.acknowledged == [(ARM, REJECTED)]


def test_every_frame_of_a_client_has_the_next_number() -> None:
    scene = Scene(2)
    for ground in scene.stations:
        ground.commands(REQUEST, 148)
    scene.publishes("pose", Pose(1.0, 2.0, 0.0, stamp_ns=1))
    scene.runs(2.0)
    for ground in scene.stations:
        heard = ground.hears()
        assert [message.get_seq() for message in heard] == list(range(len(heard)))
        assert len(heard) > 5


def test_a_pose_is_shown_north_east_and_clockwise() -> None:
    scene = Scene()
    (ground,) = scene.stations
    scene.publishes("motion", Motion(speed=0.5, gyro=(0.0, 0.0, 0.25)))
    scene.publishes("pose", Pose(3.0, 2.0, math.radians(30), stamp_ns=5_000_000))
    heard = {message.get_type(): message for message in ground.hears()}
    local, attitude = heard["LOCAL_POSITION_NED"], heard["ATTITUDE"]
    assert (local.x, local.y) == (pytest.approx(2.0), pytest.approx(3.0))
    assert (local.vx, local.vy) == (pytest.approx(0.25), pytest.approx(0.5 * math.cos(math.radians(30))))
    assert (attitude.yaw, attitude.yawspeed) == (pytest.approx(math.radians(60)), pytest.approx(-0.25))
    assert "GLOBAL_POSITION_INT" not in heard
    hud = heard["VFR_HUD"]
    assert (hud.heading, hud.groundspeed, hud.throttle) == (60, pytest.approx(0.5), 50)


@pytest.mark.parametrize(("compass", "north", "east"), [(90.0, 0.0, 10.0), (0.0, 10.0, 0.0), (180.0, -10.0, 0.0)])
def test_an_origin_gives_degrees(compass: float, north: float, east: float) -> None:
    scene = Scene(origin=Origin(60.0, 10.0, 20.0, compass))
    (ground,) = scene.stations
    scene.publishes("pose", Pose(10.0, 0.0, 0.0))
    (position,) = ground.heard("GLOBAL_POSITION_INT")
    assert position.lat == pytest.approx(60e7 + north * 89.832, abs=1)  # 1e-7 degrees of a metre to the north
    assert position.lon == pytest.approx(10e7 + east * 179.66, abs=1)  # at 60 degrees a degree is half as long
    assert (position.alt, position.hdg) == (20_000, round(compass * 100) % 36000)


def test_a_scan_is_shown_clockwise_where_it_was_asked_for() -> None:
    scene = Scene()
    (ground,) = scene.stations
    ranges = np.full(360, np.nan, np.float32)
    ranges[180], ranges[270], ranges[90] = 2.0, 1.0, 9.0  # ahead, to the left, to the right
    scan = Scan(-math.pi, math.radians(1), 0.1, 6.0, ranges)
    scene.publishes("scan", scan)
    assert not ground.heard("OBSTACLE_DISTANCE")
    ground.says(mavlink.MAVLink_request_data_stream_message(SYSTEM, 1, 12, 4, 1))
    scene.publishes("scan", scan)
    (seen,) = ground.heard("OBSTACLE_DISTANCE")
    assert (seen.distances[0], seen.distances[54], seen.distances[18]) == (200, 100, 601)
    assert set(seen.distances) == {200, 100, 601, 65535}
    assert (seen.min_distance, seen.max_distance, seen.increment_f, seen.frame) == (10, 600, 5.0, 12)


def test_a_battery_is_shown_in_its_units() -> None:
    scene = Scene()
    (ground,) = scene.stations
    scene.publishes("battery", Battery(level=0.5, voltage=12.6, current=-1.5))
    (shown,) = ground.heard("BATTERY_STATUS")
    assert (shown.voltages[:2], shown.current_battery, shown.battery_remaining) == ([12600, 65535], 150, 50)
    scene.runs(1.05)
    (status,) = ground.heard("SYS_STATUS")
    assert (status.voltage_battery, status.battery_remaining) == (12600, 50)
    assert status.onboard_control_sensors_health & 1 << 28


def test_streams_come_as_often_as_they_were_asked_for() -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.commands(INTERVAL, 30, 100_000)
    ground.commands(INTERVAL, 32, -1)
    ground.commands(INTERVAL, 9999, 100_000)
    assert ground.acknowledged == [(INTERVAL, ACCEPTED), (INTERVAL, ACCEPTED), (INTERVAL, FAILED)]
    counts = {"ATTITUDE": 0, "LOCAL_POSITION_NED": 0, "VFR_HUD": 0}
    for _ in range(40):
        scene.runs(0.05)
        scene.publishes("pose", Pose(0.0, 0.0, 0.0))
        for message in ground.hears():
            if message.get_type() in counts:
                counts[message.get_type()] += 1
    assert counts == {"ATTITUDE": 21, "LOCAL_POSITION_NED": 0, "VFR_HUD": 9}  # the first one comes at once


def test_texts_of_the_robot_are_shown_in_chunks() -> None:
    scene = Scene()
    scene.publishes("text", Text("simulated lidar data", kind="request"))  # it is for programs
    scene.publishes("text", Text("a" * 60))
    texts = scene.stations[0].heard("STATUSTEXT")
    assert [(text.severity, len(text.text), text.chunk_seq) for text in texts] == [(6, 50, 0), (6, 10, 1)]


# What it asks for


def test_all_parameters_come_and_none_is_changed() -> None:
    scene = Scene(speed_full_m_s=0.7)
    (ground,) = scene.stations
    ground.says(mavlink.MAVLink_param_request_list_message(SYSTEM, 1))
    values = []
    for _ in range(30):
        values += ground.heard("PARAM_VALUE")
        scene.now += 0.011
    assert [value.param_index for value in values] == list(range(values[0].param_count))
    assert {value.param_count for value in values} == {len(values)}
    assert len(values) >= 12
    named = {value.param_id: value.param_value for value in values}
    assert (named["SYSID_THISMAV"], named["WP_SPEED"]) == (7.0, pytest.approx(0.7))
    ground.says(mavlink.MAVLink_param_set_message(SYSTEM, 1, b"WP_SPEED", 9.0, 9))
    ground.says(mavlink.MAVLink_param_request_read_message(SYSTEM, 1, b"WP_SPEED", -1))
    ground.says(mavlink.MAVLink_param_request_read_message(SYSTEM, 1, b"", 0))
    assert [value.param_id for value in ground.heard("PARAM_VALUE")] == ["WP_SPEED", "WP_SPEED", values[0].param_id]
    assert all(value.param_value != 9.0 for value in values)


def test_what_would_hang_a_program_is_answered() -> None:
    (ground,) = Scene().stations
    payload = bytearray(251)
    payload[:6] = (5, 0, 3, 4, 0, 0)  # number 5, transfer 3, open a file
    ground.says(
        mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, 2),
        mavlink.MAVLink_file_transfer_protocol_message(0, SYSTEM, 1, list(payload)),
        mavlink.MAVLink_ping_message(77, 5, 0, 0),
        mavlink.MAVLink_timesync_message(0, 123),
    )
    told = {message.get_type(): message for message in ground.hears()}
    assert (told["MISSION_COUNT"].count, told["MISSION_COUNT"].mission_type) == (0, 2)
    refusal = told["FILE_TRANSFER_PROTOCOL"]
    assert refusal.payload[:13] == [6, 0, 3, 129, 1, 4, 0, 0, 0, 0, 0, 0, 10]
    assert (refusal.target_system, told["PING"].time_usec, told["PING"].target_system) == (255, 77, 255)
    assert (told["TIMESYNC"].ts1, told["TIMESYNC"].tc1 > 0) == (123, True)


def test_every_command_is_answered_once_to_its_asker() -> None:
    (ground,) = Scene().stations
    expected = [(REQUEST, ACCEPTED), (REQUEST, FAILED), (REQUEST, FAILED), (31000, UNSUPPORTED), (410, FAILED)]
    ground.commands(REQUEST, 148)
    ground.commands(REQUEST, 435)
    ground.commands(REQUEST, 242)  # there is no home without an origin
    ground.says(mavlink.MAVLink_command_int_message(SYSTEM, 1, 0, 31000, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    ground.commands(410)
    assert ground.acknowledged == expected
    (version,) = [told for told in ground.told if told.get_type() == "AUTOPILOT_VERSION"]
    assert not version.capabilities & (4 | 32 | 16)  # missions, files, parameters as bytes
    acks = [told for told in ground.told if told.get_type() == "COMMAND_ACK"]
    assert {(ack.target_system, ack.target_component) for ack in acks} == {(255, 190)}


def test_what_is_meant_for_another_vehicle_is_counted() -> None:
    (ground,) = Scene().stations
    assert not ground.commands(ARM, 0, target=8)
    assert not ground.stick(1000, target=8)
    assert not ground.acknowledged
    assert ground.session.left_out == {"messages to another vehicle": 2}


# Driving


def test_setpoints_drive_once_they_have_come_for_a_while() -> None:
    _, ground = guided(speed_full_m_s=2.0, turn_full_rad_s=0.5)
    assert drives(ground.aims(1.0, 0.25)) == [Drive(forward=0.5, turn=-0.5)]
    assert drives(ground.aims(-4.0)) == [Drive(forward=-1.0)]
    assert drives(ground.aims(1.0, 0.25, frame=9, mask=VELOCITY | 2048)) == [Drive(forward=0.5)]
    assert not ground.aims(1.0, frame=1)
    assert not ground.aims(1.0, mask=0xDF8)
    assert ground.texts == ["only velocity setpoints, frame 8 or 9"]
    assert ground.shown == (GUIDED, True)


def test_setpoints_that_waited_in_the_network_move_nothing() -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.commands(ARM, 1)
    ground.mode(GUIDED)
    assert not any(drive.moving for _ in range(50) for drive in drives(ground.aims(1.0)))
    scene.runs(0.6)
    assert not drives(ground.aims(1.0))[0].moving
    assert ground.texts == ["send setpoints at 4 Hz or more"]


@pytest.mark.parametrize("armed", [False, True])
def test_sticks_count_while_armed_in_manual(armed: bool) -> None:
    (ground,) = Scene().stations
    if armed:
        ground.commands(ARM, 1)
    ground.mode(MANUAL)
    expected = [Drive(), Drive(forward=0.5, turn=-0.25), Drive(), Drive(forward=-1.0)]
    said = [ground.stick(0), ground.stick(500, 250), ground.stick(60, -60), ground.stick(-1000)]
    assert [drives(each) for each in said] == [[drive] if armed else [] for drive in expected]
    override = mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 1750, 65535, 1400, 0, 0, 0, 0, 0)
    steering = mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 0, 65535, 65535, 0, 0, 0, 0, 0)
    if armed:
        assert drives(ground.says(override, steering)) == [Drive(forward=-0.2, turn=-0.5), Drive(forward=-0.2)]


def test_a_stick_that_rests_at_half_throttle_moves_nothing() -> None:
    scene = Scene()
    (ground,) = scene.stations
    for mode, result in ((MANUAL, FAILED), (GUIDED, FAILED)):
        ground.mode(mode)
        for _ in range(20):
            assert not ground.stick(500)
            scene.runs(0.05)
        ground.commands(ARM, 1)
        assert ground.acknowledged[-1] == (ARM, result)
    assert ground.texts[-1] == "release the stick (QGC: centre is zero throttle)"
    assert not ground.shown[1]


@pytest.mark.parametrize("rests_at", [0, 500])
def test_entering_guided_is_no_neutral_of_the_stick(rests_at: int) -> None:
    _, ground = guided()
    ground.stick(0)
    ground.stick(rests_at)
    assert drives(ground.mode(MANUAL)) == []
    assert drives(ground.stick(500)) == ([] if rests_at else [Drive(forward=0.5)])
    if rests_at:
        assert (ground.shown, ground.texts[-1]) == ((HOLD, False), "release the stick (QGC: centre is zero throttle)")


def test_a_stick_that_was_not_heard_before_must_be_released() -> None:
    _, ground = guided()
    ground.mode(MANUAL)
    assert not ground.stick(500)
    assert ground.shown == (HOLD, False)


def test_changing_the_mode_ends_the_motion_of_the_one_before() -> None:
    _, ground = guided()
    assert drives(ground.aims(1.0))[0].moving
    assert drives(ground.mode(MANUAL)) == [Drive()]
    assert not ground.aims(1.0)


@pytest.mark.parametrize("command", [(SET_MODE, 1, HOLD), (ARM, 0), (ARM, 0, 21196), (TERMINATE, 1)])
def test_anybody_may_stop(command: tuple[float, ...]) -> None:
    scene = Scene()
    scene.publishes("control", Control("held", holder="ann"))
    (ground,) = scene.stations
    ((topic, stop),) = ground.commands(int(command[0]), *command[1:])
    assert topic is topics.CMD_STOP
    assert isinstance(stop, Stop)
    assert ground.acknowledged == [(command[0], ACCEPTED)]


def test_the_older_way_to_set_a_mode() -> None:
    (ground,) = Scene().stations
    ground.says(mavlink.MAVLink_set_mode_message(SYSTEM, 1, MANUAL))
    assert ground.shown == (MANUAL, False)
    assert ground.acknowledged == [(11, ACCEPTED)]


@pytest.mark.parametrize("mode", [1, 3, 5, AUTO, 11, 99])
def test_other_modes_are_denied(mode: int) -> None:
    (ground,) = Scene().stations
    ground.mode(mode)
    assert ground.acknowledged == [(SET_MODE, DENIED)]
    assert ground.shown == (HOLD, False)


# Who may


@pytest.mark.parametrize(
    ("control", "text"),
    [
        (Control("held", holder="hq.tcpudp:27015.3", priority=0), "held by hq.tcpudp:27015.3"),
        (Control("held", holder="n" * 60, priority=0), "held by " + "n" * 42),
        (Control("latched", latches=(Latch(bytes(16), "ann", "wet"),)), "stop latched by ann (wet)"),
    ],
)
def test_a_second_client_is_told_who_holds_the_robot(control: Control, text: str) -> None:
    scene = Scene()
    (ground,) = scene.stations
    scene.publishes("control", control)
    for command in ((ARM, 1), (SET_MODE, 1, GUIDED), (SET_MODE, 1, MANUAL)):
        assert not ground.commands(int(command[0]), *command[1:])
        assert ground.acknowledged[-1] == (command[0], REJECTED)
        assert ground.texts[-1] == text
    assert ground.shown == (HOLD, False)


def test_a_takeover_and_a_stop_show_every_client_that_it_does_not_drive() -> None:
    scene = Scene(2)
    first, second = scene.stations
    for ground in scene.stations:
        ground.commands(ARM, 1)
        ground.mode(GUIDED)
    scene.publishes("control", Control("held", holder="hq.mavlink:5760.1", priority=0))
    assert (first.shown, second.shown) == ((GUIDED, True), (HOLD, False))
    scene.publishes("control", Control("held", holder="ann", priority=5))
    assert first.shown == (HOLD, False)
    scene.publishes("control", Control("free"))
    first.commands(ARM, 1)
    scene.publishes("control", Control("stopped"))
    assert first.shown == (HOLD, False)
    first.commands(ARM, 1)
    scene.publishes("control", Control("stopped"))  # it is repeated every second
    assert first.shown == (HOLD, True)


def test_nobody_arms_until_the_stop_that_they_asked_for_is_shown() -> None:
    scene, ground = guided()
    scene.publishes("control", Control("held", holder="hq.mavlink:5760.1", priority=0))
    ground.mode(HOLD)
    scene.side.tell(ground.session, "not driving: the lease has ended (stop)", scene.now)
    news = (
        lambda: scene.publishes("control", Control("stopped")),
        lambda: scene.side.not_driving(ground.session, scene.now),  # its lease has ended, which it learns later
    )
    for told in news:
        for command in ((ARM, 1), (SET_MODE, 1, GUIDED)):
            assert not ground.commands(int(command[0]), *command[1:])
            assert ground.acknowledged[-1] == (command[0], REJECTED)
            assert ground.texts[-1] == "stopping"
        told()
    ground.commands(ARM, 1)
    assert ground.shown == (HOLD, True)
    ground.mode(HOLD)
    scene.runs(1.1)  # a stop that is never shown is not waited for any longer
    ground.commands(ARM, 1)
    assert ground.shown == (HOLD, True)


def test_a_stop_of_which_no_news_comes_hides_no_later_text() -> None:
    scene, ground = guided()
    ground.mode(HOLD)
    scene.side.tell(ground.session, "not driving: stopped", scene.now)
    assert ground.texts == []
    scene.runs(1.1)
    scene.side.tell(ground.session, "offline", scene.now)
    assert ground.texts == ["offline"]


def test_refused_motion_is_shown_by_the_armed_bit_at_once() -> None:
    scene, ground = guided()
    assert ground.shown == (GUIDED, True)
    scene.side.tell(ground.session, "not driving: held by ann", scene.now)
    scene.side.not_driving(ground.session, scene.now)
    beat = ground.heard("HEARTBEAT")[0]
    assert (beat.custom_mode, beat.base_mode & 128) == (HOLD, 0)
    assert ground.texts[-1] == "held by ann"
    assert not ground.aims(1.0)


@pytest.mark.parametrize(
    ("mode", "text"),
    [(GUIDED, "deadman: choose GUIDED again"), (MANUAL, "release the stick (QGC: centre is zero throttle)")],
)
def test_a_client_that_owes_neutral_is_told_what_to_do(mode: int, text: str) -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.mode(mode)
    scene.side.tell(ground.session, f"deadman{StickRules().advice}", scene.now)
    assert ground.texts == [text]


def test_motion_that_does_not_change_may_be_ended() -> None:
    scene, ground = guided(stale_s=2.0)
    for _ in range(39):
        assert drives(ground.aims(0.5))[0].moving
        scene.runs(0.05)
    scene.runs(0.2)
    assert drives(ground.aims(0.5)) == [Drive()]
    assert ground.shown == (HOLD, False)
    assert not ground.aims(0.5)


# What a review found


def test_heartbeats_go_on_in_another_process() -> None:
    scene, ground = guided()
    scene.publishes("pose", Pose(0.0, 0.0, 0.0, stamp_ns=1_000_000_000))
    heir = Scene()
    heir.side.restore(scene.side.export())
    session = heir.side.session(1, BOUNDS)
    session.restore(ground.session.export())
    ground.session, ground.scene, heir.stations = session, heir, [ground]
    ground.hears()
    heir.runs(1.1)
    assert ground.shown == (GUIDED, True)
    heir.publishes("pose", Pose(0.0, 0.0, 0.0, stamp_ns=3_000_000_000))
    assert ground.heard("ATTITUDE")[-1].time_boot_ms == 2000


def test_an_override_of_long_ago_is_no_throttle() -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.says(mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 1500, 65535, 2000, 0, 0, 0, 0, 0))
    scene.runs(3.5)
    ground.mode(MANUAL)
    ground.commands(ARM, 1)
    centre = mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 1500, 65535, 65535, 0, 0, 0, 0, 0)
    steering = mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 1600, 65535, 65535, 0, 0, 0, 0, 0)
    assert drives(ground.says(centre, steering)) == [Drive(), Drive(turn=-0.2)]


@pytest.mark.parametrize("through", ["stick", "mode"])
def test_an_override_does_not_outlast_what_came_in_its_place(through: str) -> None:
    (ground,) = Scene().stations
    ground.mode(MANUAL)
    ground.commands(ARM, 1)
    ground.says(mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 1500, 65535, 1800, 0, 0, 0, 0, 0))
    if through == "stick":
        ground.stick(0)
    else:
        ground.mode(MANUAL)
    steering = mavlink.MAVLink_rc_channels_override_message(SYSTEM, 1, 1600, 65535, 65535, 0, 0, 0, 0, 0)
    assert drives(ground.says(steering)) == [Drive(turn=-0.2)]


def test_a_station_of_which_nothing_is_heard_is_not_armed_any_more() -> None:
    scene, ground = guided()
    scene.runs(4.9)
    assert ground.shown == (GUIDED, True)
    scene.runs(1.1)
    assert ground.shown == (HOLD, False)


def test_another_stop_disarms_who_armed_since() -> None:
    scene = Scene()
    (ground,) = scene.stations
    scene.publishes("control", Control("stopped"))
    ground.commands(ARM, 1)
    scene.publishes("control", Control("stopped", stops=(bytes(16),)))
    assert ground.shown == (HOLD, False)


def test_a_holder_of_less_priority_does_not_keep_a_station_from_arming() -> None:
    scene = Scene()
    (ground,) = scene.stations
    for _ in range(2):
        scene.publishes("control", Control("held", holder="patrol", priority=-1))
        ground.commands(ARM, 1)
        assert ground.shown == (HOLD, True)


@pytest.mark.parametrize("speaks_first", [False, True])
def test_a_source_of_datagrams_must_speak_mavlink_first(speaks_first: bool) -> None:
    scene = Scene(0)
    session = scene.side.session(1, BOUNDS)
    session.by_datagrams(speaks_first=speaks_first)
    session.open(scene.now)
    for noise in (b"x", bytes.fromhex("fd000000000000ffff000000")):  # a message of an unknown id
        session.receive(noise, scene.now)
    assert (session.state.value == "established") is speaks_first
    session.receive(bytes.fromhex("fd0900000001010000000f0000000a03c10403ac7c"), scene.now)
    assert session.state.value == "established"


@pytest.mark.parametrize("most", [math.inf, math.nan, 0.0])
def test_a_scan_without_a_range_hides_no_obstacle(most: float) -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.says(mavlink.MAVLink_request_data_stream_message(SYSTEM, 1, 12, 4, 1))
    scene.publishes("scan", Scan(0.0, 0.1, math.nan, most, np.array([2.0], np.float32)))
    (seen,) = ground.heard("OBSTACLE_DISTANCE")
    assert (seen.distances[0], seen.min_distance, seen.max_distance) == (200, 0, 65534)
    scene.publishes("scan", Scan(math.nan, 0.1, 0.1, 6.0, np.array([2.0], np.float32)))
    assert not ground.heard("OBSTACLE_DISTANCE")


def test_a_battery_that_is_not_known_is_not_empty() -> None:
    scene = Scene()
    (ground,) = scene.stations
    scene.publishes("battery", Battery(level=math.nan, voltage=math.inf, current=math.nan))
    (shown,) = ground.heard("BATTERY_STATUS")
    assert (shown.voltages[0], shown.current_battery, shown.battery_remaining) == (65535, -1, -1)


def test_a_position_with_a_velocity_is_no_velocity() -> None:
    _, ground = guided()
    assert not ground.aims(0.7, frame=9, mask=0)
    assert ground.texts == [VELOCITY_ONLY]


def test_messages_of_unknown_ids_are_counted_under_one_name() -> None:
    (ground,) = Scene().stations
    for _ in range(3):
        ground.says(mavlink.MAVLink_system_time_message(1, 1), mavlink.MAVLink_attitude_quaternion_message(1, *[0] * 7))
    assert ground.session.left_out == {"messages of unknown ids": 6}


def test_noise_ends_no_session() -> None:
    scene = Scene()
    (ground,) = scene.stations
    ground.session.receive(bytes(range(256)) * 20, scene.now)
    assert not ground.session.over
    ground.mode(MANUAL)
    assert ground.shown == (MANUAL, False)
