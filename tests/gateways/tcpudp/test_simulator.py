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
    ("packet", "x", "y", "turned"),
    [
        # x is to the right: heading along y, that is along x
        (ClientJoystickMove(0.0, 1.0, 1.0), 0.0, SPEED_M_S, 0.0),
        (ClientJoystickMove(0.0, -1.0, 0.5), 0.0, -SPEED_M_S / 2, 0.0),
        (ClientJoystickMove(1.0, 0.0, 1.0), SPEED_M_S, 0.0, 0.0),
        (ClientJoystickMove(-0.6, 0.8, 1.0), -0.6 * SPEED_M_S, 0.8 * SPEED_M_S, 0.0),
        # a positive rotation turns to the right
        (ClientJoystickRotate(0.5), 0.0, 0.0, -0.5 * TURN_RAD_S),
        # the motors go no faster than full speed
        *((ClientJoystickMove(0.0, 1.0, speed), 0.0, SPEED_M_S, 0.0) for speed in (1.5, 1e4, 3e38)),
        *((ClientJoystickRotate(-speed), 0.0, 0.0, TURN_RAD_S) for speed in (1.0, 1.5, 1e4, 3e38)),
        # a direction longer than it may be is kept
        (ClientJoystickMove(30.0, 40.0, 1.0), 0.6 * SPEED_M_S, 0.8 * SPEED_M_S, 0.0),
    ],
)
def test_a_second_of_motion_goes_along_x_right_and_y_forward_at_most_at_full_speed(packet, x, y, turned) -> None:
    moved = vehicle()
    live(moved, 1.0, packet)
    assert (moved.body.x, moved.body.y) == pytest.approx((x, y), abs=1e-6)
    assert moved.body.heading == pytest.approx(math.pi / 2 + turned)
    assert moved.moving


def test_a_stop_stops_it() -> None:
    moved = vehicle()
    live(moved, 0.4, FORWARD)
    moved.take(ClientJoystickStop())
    assert not moved.moving
    y = moved.body.y
    live(moved, 1.0)
    assert moved.body.y == y


def test_it_stops_by_itself_after_a_second_of_silence_which_only_motion_breaks() -> None:
    moved = vehicle()
    moved.take(FORWARD)
    live(moved, SILENCE_S - STEP_S, ClientGetPosition())
    assert moved.moving
    live(moved, 2 * STEP_S, ClientGetPosition())
    assert not moved.moving
    assert moved.body.y == pytest.approx(SPEED_M_S * SILENCE_S, abs=2 * STEP_S)
    moved = vehicle(y=-4.0)
    live(moved, 5.0, FORWARD)
    assert moved.moving


@pytest.mark.parametrize("heading", [0.0, 0.8, 1.6, 2.4, 3.1, -0.8, -1.6, -2.4])
def test_walls_and_boxes_stop_it(heading: float) -> None:
    moved = vehicle(heading=heading)
    live(moved, 30.0, FORWARD)
    assert moved.body.blocked
    assert max(abs(moved.body.x), abs(moved.body.y)) <= HALF_SIDE_M - moved.body.radius + 1e-9
    assert not any(box.near(moved.body.x, moved.body.y, moved.body.radius) for box in BOXES)


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


@pytest.mark.parametrize(
    ("packet", "answers"),
    [
        *((ClientLidarMode(mode), (ServerLidarStatus(status),)) for mode, status in ((1, 1), (2, 2), (7, 2))),
        (ClientGetPosition(), (ServerPosition(100.0, 200.0, 0.0),)),
        (DebugMessage("hi"), (DebugMessage("echo: hi"),)),
        (ChatMessage(b"\x01"), (ChatMessage(b"\x01"),)),
        (ClientMoveAI(b"\x01"), (DebugMessage("clientMoveAI taken"),)),
        (ClientControllMode(3), ()),
    ],
)
def test_packets_are_answered(packet: Packet, answers: tuple[Packet, ...]) -> None:
    told = vehicle(1.0, 2.0)
    assert told.take(packet) == answers
    if isinstance(packet, ClientLidarMode):
        assert told.lidar is (packet.mode == 1)
    if isinstance(packet, ClientControllMode):
        assert told.mode == 3


def test_the_question_for_the_map_is_answered_with_all_its_cells() -> None:
    (shown,) = vehicle().take(ClientGetSLAMMap())
    assert isinstance(shown, ServerSLAMMap)
    assert len(shown.cells or b"") == SIDE * SIDE


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


@pytest.mark.parametrize(
    "ranges", [*([100.0] * count for count in (0, 1, 359, 361)), [math.nan, math.inf, -math.inf, -1.0, 3e38] * 72]
)
def test_simulated_lidar_data_of_another_length_or_that_are_no_numbers_are_ignored(ranges: list[float]) -> None:
    told = vehicle()
    told.take(ClientSimulatedLidarData(np.array(ranges, np.float32)))
    assert 2 not in told.grid.cells
    assert len(ranges) == 360 or not told.grid.cells.any()


def test_a_vehicle_prints_where_it_is() -> None:
    assert repr(vehicle()).startswith("<Vehicle <Body x=0.00 y=0.00")
