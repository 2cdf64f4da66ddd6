"""The simulated rover does what the protocol page says of real ones."""

from __future__ import annotations

import pytest

from gateways.mavlink.frames import LIMIT_BYTES, frame_end, read_frame, write_frame
from gateways.mavlink.messages import MavlinkMessage, control, telemetry
from gateways.mavlink.numbers import Command, Result, RoverMode
from gateways.mavlink.simulator import ArduRover
from zbridge.wire.frames import FrameBuffer

AHEAD = control.SetPositionTargetLocalNed(vx=0.5, yaw_rate=0.0, type_mask=0x5C7, target_system=1, coordinate_frame=8)


class Desk:
    """A ground station of a rover that is armed."""

    def __init__(self, mode: RoverMode = RoverMode.GUIDED, **parameters: float) -> None:
        self.rover = ArduRover(**parameters)
        self.rover.switch_mode(mode)
        self.rover.switch_arming(True)
        self.rover.step(0.05)
        self._frames = FrameBuffer(frame_end, LIMIT_BYTES)

    def say(self, message: MavlinkMessage, system: int = 255) -> list[MavlinkMessage | None]:
        """Send a message; return the answers."""
        return self._read(self.rover.receive(write_frame(message, 0, system, 190)))

    def wait(self, seconds: float) -> list[MavlinkMessage | None]:
        return [message for _ in range(round(seconds / 0.05)) for message in self._read(self.rover.step(0.05))]

    def _read(self, data: bytes) -> list[MavlinkMessage | None]:
        return [read_frame(frame).message for frame in self._frames.feed(data)]


def command(number: Command, *params: float, target: int = 1) -> control.CommandLong:
    return control.CommandLong(*params, command=number, target_system=target)


def results(answers: list[MavlinkMessage | None]) -> list[int]:
    return [answer.result for answer in answers if isinstance(answer, control.CommandAck)]


def texts(answers: list[MavlinkMessage | None]) -> list[str]:
    return [each.text.rstrip(b"\0").decode() for each in answers if isinstance(each, telemetry.Statustext)]


def moves(desk: Desk, seconds: float = 0.5) -> bool:
    before = desk.rover.body.x
    desk.wait(seconds)
    return abs(desk.rover.body.x - before) > 0.05


def test_a_target_is_followed_in_guided_only_and_for_three_seconds() -> None:
    desk = Desk(RoverMode.HOLD)
    assert desk.say(AHEAD) == []
    assert not moves(desk)
    desk.rover.switch_mode(RoverMode.GUIDED)
    desk.say(AHEAD)
    assert moves(desk)
    said = desk.wait(3.0)
    assert texts(said) == ["target not received last 3.0secs, stopping"]
    assert (desk.rover.truth().neutral, desk.rover.truth().watchdog) == (True, True)
    assert (desk.rover.mode, desk.rover.armed) == (RoverMode.GUIDED, True)


@pytest.mark.parametrize(
    ("mask", "frame", "target", "follows"),
    [(0x5C7, 8, 1, True), (0x5E7, 9, 0, True), (0x5C7, 1, 1, False), (0x407, 8, 1, False), (0x5C7, 8, 2, False)],
)
def test_other_targets_are_ignored_in_silence(mask: int, frame: int, target: int, follows: bool) -> None:
    desk = Desk()
    answers = desk.say(
        control.SetPositionTargetLocalNed(vx=0.5, type_mask=mask, coordinate_frame=frame, target_system=target)
    )
    assert (moves(desk), answers) == (follows, [])


def test_backward_without_a_yaw_it_turns_round_and_drives_ahead() -> None:
    desk = Desk()
    desk.say(control.SetPositionTargetLocalNed(vx=-0.5, type_mask=0xDC7, coordinate_frame=8))
    desk.wait(0.5)
    assert desk.rover.body.x > 0.1


@pytest.mark.parametrize(("system", "target", "follows"), [(255, 1, True), (245, 1, False), (255, 2, False)])
def test_a_stick_counts_from_its_own_ground_station_only(system: int, target: int, follows: bool) -> None:
    desk = Desk(RoverMode.MANUAL)
    desk.say(control.ManualControl(z=500, target=target), system)
    assert moves(desk) is follows


def test_a_stick_holds_the_pilot_off_for_three_seconds() -> None:
    desk = Desk(RoverMode.MANUAL)
    desk.rover.stick = (-0.5, 0.0)
    desk.say(control.ManualControl(z=500, target=1))
    desk.wait(2.0)
    assert desk.rover.body.x > 0.5
    desk.wait(1.2)
    before = desk.rover.body.x
    desk.wait(0.5)
    assert desk.rover.body.x < before


@pytest.mark.parametrize("enabled", [0.0, 1.0])
def test_its_failsafe_is_off_unless_set_and_acts_after_a_first_heartbeat(enabled: float) -> None:
    desk = Desk(RoverMode.AUTO, FS_GCS_ENABLE=enabled)
    desk.wait(10.0)
    assert desk.rover.mode is RoverMode.AUTO
    desk.say(telemetry.MavlinkHeartbeat(0, 6, 8, 0, 4, 3))
    desk.wait(6.0)
    assert desk.rover.mode is RoverMode.AUTO
    desk.wait(1.0)
    assert desk.rover.mode is (RoverMode.HOLD if enabled else RoverMode.AUTO)


def test_hold_coasts_and_a_target_of_zero_brakes() -> None:
    ways = []
    for stop in (command(Command.DO_SET_MODE, 1.0, 4.0), control.SetPositionTargetLocalNed(type_mask=0x5C7)):
        desk = Desk()
        desk.say(AHEAD)
        desk.wait(1.0)
        before = desk.rover.body.x
        if isinstance(stop, control.SetPositionTargetLocalNed):
            stop = control.SetPositionTargetLocalNed(type_mask=0x5C7, coordinate_frame=8)
        desk.say(stop)
        desk.wait(1.0)
        ways.append(desk.rover.body.x - before)
    coasted, braked = ways
    assert coasted > 2 * braked


def test_commands_are_answered_and_a_new_mode_is_shown_at_once() -> None:
    desk = Desk()
    shown = desk.say(command(Command.DO_SET_MODE, 1.0, 4.0))
    assert (results(shown), shown[0].custom_mode) == ([Result.ACCEPTED], RoverMode.HOLD)
    desk.rover.switch_arming(False)
    desk.rover.arming_fault = "Throttle (RC3) is not neutral"
    refused = desk.say(command(Command.ARM, 1.0))
    assert (results(refused), texts(refused)) == ([Result.FAILED], ["Arm: Throttle (RC3) is not neutral"])
    assert results(desk.say(command(Command.ARM, 1.0, 2989.0))) == [Result.ACCEPTED]
    assert results(desk.say(command(Command.SET_MESSAGE_INTERVAL, 9999.0, 1e5))) == [Result.FAILED]
    assert results(desk.say(command(Command.FLIGHT_TERMINATION, 1.0))) == [Result.UNSUPPORTED]
    assert desk.say(command(Command.DO_SET_MODE, 1.0, 15.0, target=2)) == []
    assert isinstance(desk.say(command(Command.GET_HOME_POSITION))[0], telemetry.HomePosition)


def test_parameters_are_floats_and_unknown_ones_are_not_answered() -> None:
    desk = Desk()
    (value,) = desk.say(control.ParamRequestRead(-1, 1, 1, b"GUID_TIMEOUT"))
    assert (value.param_value, value.param_id.rstrip(b"\0"), value.param_type) == (3.0, b"GUID_TIMEOUT", 9)
    assert desk.say(control.ParamRequestRead(-1, 1, 1, b"SYSID_MYGCS")) == []
    assert len(desk.say(control.ParamRequestList(1, 1))) == value.param_count
