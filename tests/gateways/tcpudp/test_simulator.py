"""The simulated robot itself: what packets make it do, and what it sees."""

import math

import numpy as np
import pytest

from gateways.tcpudp.messages import (
    PACKETS,
    ChatMessage,
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientLidarMode,
    ClientMoveAI,
    ClientSimulatedLidarData,
    DebugMessage,
    OpaquePacket,
    Packet,
    ServerLidarStatus,
    ServerPosition,
    ServerSLAMMap,
    encode_packet,
)
from gateways.tcpudp.simulator import SIDE, SILENCE_S, SPEED_M_S, TURN_RAD_S, Vehicle
from zbridge.simulation.simulator import STEP_S
from zbridge.simulation.world import BOXES, HALF_SIDE_M

FORWARD = ClientJoystickMove(0.0, 1.0, 1.0)


def vehicle(x: float = 0.0, y: float = 0.0, heading: float = math.pi / 2) -> Vehicle:
    made = Vehicle(1)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def live(moved: Vehicle, seconds: float, packet: Packet | None = None) -> None:
    """Let it live, repeating ``packet`` every half second as HQ programs do."""
    for step in range(round(seconds / STEP_S)):
        if packet is not None and step % 25 == 0:
            moved.take(packet)
        moved.step(STEP_S)


def story(seed: int) -> tuple[ServerPosition, bytes]:
    told = Vehicle(seed)
    told.look()
    live(told, 2.0, FORWARD)
    told.look()
    live(told, 1.0, ClientJoystickRotate(0.7))
    told.look()
    cells = told.map().cells
    assert cells
    return told.position(), cells


def test_the_same_seed_and_packets_give_the_same_world() -> None:
    assert story(7) == story(7)


def test_another_seed_gives_another_world() -> None:
    assert story(7)[0] != story(8)[0]


@pytest.mark.parametrize("seed", range(20))
def test_a_robot_begins_in_free_space(seed: int) -> None:
    made = Vehicle(seed)
    made.body.step(0.0, 0.0, 0.0, STEP_S)
    assert not made.body.blocked
    assert not made.moving


@pytest.mark.parametrize(
    ("packet", "x", "y"),
    [
        (ClientJoystickMove(0.0, 1.0, 1.0), 0.0, SPEED_M_S),
        (ClientJoystickMove(0.0, -1.0, 0.5), 0.0, -SPEED_M_S / 2),
        (ClientJoystickMove(1.0, 0.0, 1.0), SPEED_M_S, 0.0),  # x is to the right: heading along y, that is along x
        (ClientJoystickMove(-0.6, 0.8, 1.0), -0.6 * SPEED_M_S, 0.8 * SPEED_M_S),
    ],
)
def test_a_move_goes_along_x_right_and_y_forward(packet: Packet, x: float, y: float) -> None:
    moved = vehicle()
    live(moved, 1.0, packet)
    assert (moved.body.x, moved.body.y) == pytest.approx((x, y), abs=1e-6)
    assert moved.moving


def test_a_positive_rotation_turns_to_the_right() -> None:
    moved = vehicle()
    live(moved, 1.0, ClientJoystickRotate(0.5))
    assert moved.body.heading == pytest.approx(math.pi / 2 - 0.5 * TURN_RAD_S)
    assert (moved.body.x, moved.body.y) == (0.0, 0.0)


def test_a_stop_stops_it() -> None:
    moved = vehicle()
    live(moved, 0.4, FORWARD)
    moved.take(ClientJoystickStop())
    assert not moved.moving
    y = moved.body.y
    live(moved, 1.0)
    assert moved.body.y == y


def test_it_stops_by_itself_after_a_second_of_silence() -> None:
    moved = vehicle()
    moved.take(FORWARD)
    live(moved, SILENCE_S - STEP_S)
    assert moved.moving
    live(moved, 2 * STEP_S)
    assert not moved.moving
    assert moved.body.y == pytest.approx(SPEED_M_S * SILENCE_S, abs=2 * STEP_S)


def test_other_packets_do_not_break_the_silence() -> None:
    moved = vehicle()
    moved.take(FORWARD)
    live(moved, SILENCE_S + 2 * STEP_S, ClientGetPosition())
    assert not moved.moving


def test_repeated_motion_breaks_the_silence() -> None:
    moved = vehicle(y=-4.0, x=0.0)
    live(moved, 5.0, FORWARD)
    assert moved.moving


@pytest.mark.parametrize("heading", [0.0, 0.8, 1.6, 2.4, 3.1, -0.8, -1.6, -2.4])
def test_walls_and_boxes_stop_it(heading: float) -> None:
    moved = vehicle(heading=heading)
    live(moved, 30.0, FORWARD)
    assert moved.body.blocked
    assert max(abs(moved.body.x), abs(moved.body.y)) <= HALF_SIDE_M - moved.body.radius + 1e-9
    assert not any(box.near(moved.body.x, moved.body.y, moved.body.radius) for box in BOXES)


@pytest.mark.parametrize("speed", [1.0, 1.5, 1e4, 3e38])
def test_its_motors_go_no_faster_than_full_speed(speed: float) -> None:
    moved = vehicle()
    live(moved, 1.0, ClientJoystickMove(0.0, 1.0, speed))
    assert (moved.body.x, moved.body.y) == pytest.approx((0.0, SPEED_M_S), abs=1e-6)
    turned = vehicle()
    live(turned, 1.0, ClientJoystickRotate(-speed))
    assert turned.body.heading == pytest.approx(math.pi / 2 + TURN_RAD_S)


def test_a_direction_longer_than_it_may_be_is_kept_at_full_speed() -> None:
    moved = vehicle()
    live(moved, 1.0, ClientJoystickMove(30.0, 40.0, 1.0))
    assert (moved.body.x, moved.body.y) == pytest.approx((0.6 * SPEED_M_S, 0.8 * SPEED_M_S), abs=1e-6)


@pytest.mark.parametrize("speed", [1e4, 1e38, 3e38])
def test_walls_stop_it_however_fast_it_is_told_to_go_and_its_position_can_be_sent(speed: float) -> None:
    moved = vehicle()
    live(moved, 30.0, ClientJoystickMove(0.0, 1.0, speed))
    assert moved.body.blocked
    assert HALF_SIDE_M - 1.0 < moved.body.y < HALF_SIDE_M
    frame = encode_packet(moved.position(), 1)
    assert frame[:6] == bytes.fromhex("0e000000 01 37")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_motion_that_is_no_number_is_a_stop(value: float) -> None:
    moved = vehicle()
    for packet in (
        ClientJoystickMove(0.0, 1.0, value),
        ClientJoystickMove(value, 1.0, 1.0),
        ClientJoystickRotate(value),
    ):
        moved.take(FORWARD)
        moved.take(packet)
        assert not moved.moving
        moved.step(STEP_S)
        assert math.isfinite(moved.body.x + moved.body.y + moved.body.heading)


def test_the_position_is_in_centimetres_and_degrees_from_y() -> None:
    assert vehicle(1.5, -0.5).position() == ServerPosition(150.0, -50.0, 0.0)
    turned = vehicle(heading=math.pi).position()
    assert turned.heading_deg == pytest.approx(90.0)


@pytest.mark.parametrize(("mode", "status"), [(1, 1), (2, 2), (7, 2)])
def test_the_lidar_is_switched_and_says_so(mode: int, status: int) -> None:
    told = vehicle()
    assert told.take(ClientLidarMode(mode)) == (ServerLidarStatus(status),)
    assert told.lidar is (status == 1)


def test_questions_are_answered() -> None:
    told = vehicle(1.0, 2.0)
    assert told.take(ClientGetPosition()) == (told.position(),)
    (shown,) = told.take(ClientGetSLAMMap())
    assert isinstance(shown, ServerSLAMMap)
    assert shown.cells is not None
    assert len(shown.cells) == SIDE * SIDE


def test_texts_and_opaque_packets_are_answered() -> None:
    told = vehicle()
    assert told.take(DebugMessage("hi")) == (DebugMessage("echo: hi"),)
    assert told.take(ChatMessage(b"\x01")) == (ChatMessage(b"\x01"),)
    assert told.take(ClientMoveAI(b"\x01")) == (DebugMessage("clientMoveAI taken"),)


def test_the_control_mode_is_remembered() -> None:
    told = vehicle()
    assert told.take(ClientControllMode(3)) == ()
    assert told.mode == 3


def test_every_packet_of_the_table_and_every_other_is_taken() -> None:
    told = vehicle()
    arguments = {"ClientSimulatedLidarData": (np.zeros(360, np.float32),), "DebugMessage": ("hi",)}
    for spec in PACKETS.values():
        if spec.sender.value != "robot":
            count = len(spec.packet.__struct_fields__)
            values = arguments.get(spec.packet.__name__, (1,) * count)
            assert all(isinstance(answer, Packet) for answer in told.take(spec.packet(*values)))
    assert told.take(OpaquePacket(70, b"\x01")) == ()


def test_the_map_is_x_major_and_shows_the_walls() -> None:
    told = vehicle(x=3.5, y=0.0)
    told.look()
    cells = told.map().cells
    assert cells is not None
    shown = np.frombuffer(cells, np.uint8).reshape(SIDE, SIDE)  # [x, y]
    assert shown[85, 50] == 1, "where it stands is free"
    assert set(shown[98:, 50]) >= {2}, "the wall at x = 5 m"
    assert shown[10, 50] == 0, "out of its lidar's range"


def test_simulated_lidar_data_are_entered_into_the_map() -> None:
    told = vehicle()
    ranges = np.zeros(360, np.float32)
    ranges[90] = 200.0  # 2 m to its left: heading along y, that is at x = -2 m
    assert told.take(ClientSimulatedLidarData(ranges)) == ()
    shown = np.frombuffer(told.map().cells or b"", np.uint8).reshape(SIDE, SIDE)
    occupied = np.argwhere(shown == 2)
    assert len(occupied) == 1
    x, y = (occupied[0] + 0.5) * 0.1 - 5.0
    assert (x, y) == pytest.approx((-2.0, 0.0), abs=0.11)


@pytest.mark.parametrize("count", [0, 1, 359, 361])
def test_simulated_lidar_data_of_another_length_are_ignored(count: int) -> None:
    told = vehicle()
    told.take(ClientSimulatedLidarData(np.full(count, 100.0, np.float32)))
    assert not told.grid.cells.any()


def test_simulated_lidar_data_that_are_no_numbers_are_ignored() -> None:
    told = vehicle()
    values = np.array([math.nan, math.inf, -math.inf, -1.0, 3e38] * 72, np.float32)
    told.take(ClientSimulatedLidarData(values))
    assert 2 not in told.grid.cells


def test_a_vehicle_prints_where_it_is() -> None:
    assert repr(vehicle()).startswith("<Vehicle <Body x=0.00 y=0.00")
