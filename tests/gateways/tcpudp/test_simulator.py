"""The simulated robot itself: what packets make it do, and what it sees."""

import math

import numpy as np
import pytest

from gateways.tcpudp import messages as m
from gateways.tcpudp.simulator import SIDE, SILENCE_S, SPEED_M_S, TURN_RAD_S, Vehicle
from zbridge.simulation.simulator import STEP_S
from zbridge.simulation.world import BOXES, HALF_SIDE_M

FORWARD = m.ClientJoystickMove(0.0, 1.0, 1.0)


def vehicle(x: float = 0.0, y: float = 0.0, heading: float = math.pi / 2) -> Vehicle:
    made = Vehicle(1)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def live(moved: Vehicle, seconds: float, packet: m.Packet | None = None) -> None:
    """Let it live, repeating ``packet`` every half second as HQ programs do."""
    for step in range(round(seconds / STEP_S)):
        if packet is not None and step % 25 == 0:
            moved.take(packet)
        moved.step(STEP_S)


def drawn(told: Vehicle) -> np.ndarray:
    """The map as [x, y]."""
    return np.frombuffer(told.map().cells, np.uint8).reshape(SIDE, SIDE)


def story(seed: int) -> tuple[m.ServerPosition, bytes]:
    told = Vehicle(seed)
    told.sweep_lidar()
    live(told, 2.0, FORWARD)
    told.sweep_lidar()
    live(told, 1.0, m.ClientJoystickRotate(0.7))
    return told.position(), told.map().cells


def test_the_same_seed_and_packets_give_the_same_world_and_another_seed_another() -> None:
    assert story(7) == story(7)
    assert story(7)[0] != story(8)[0]
    for seed in range(20):
        made = Vehicle(seed)
        made.body.step(0.0, 0.0, 0.0, STEP_S)
        assert not made.body.blocked, "it begins in free space"
        assert not made.moving


@pytest.mark.parametrize(
    ("packet", "x", "y", "turned"),
    [
        # x is to the right: heading along y, that is along x
        (m.ClientJoystickMove(0.0, 1.0, 1.0), 0.0, SPEED_M_S, 0.0),
        (m.ClientJoystickMove(0.0, -1.0, 0.5), 0.0, -SPEED_M_S / 2, 0.0),
        (m.ClientJoystickMove(1.0, 0.0, 1.0), SPEED_M_S, 0.0, 0.0),
        (m.ClientJoystickMove(-0.6, 0.8, 1.0), -0.6 * SPEED_M_S, 0.8 * SPEED_M_S, 0.0),
        (m.ClientJoystickRotate(0.5), 0.0, 0.0, -0.5 * TURN_RAD_S),  # a positive rotation turns to the right
        # the motors go no faster than full speed, and keep a direction that is longer than it may be
        *((m.ClientJoystickMove(0.0, 1.0, speed), 0.0, SPEED_M_S, 0.0) for speed in (1.5, 3e38)),
        *((m.ClientJoystickRotate(-speed), 0.0, 0.0, TURN_RAD_S) for speed in (1.0, 3e38)),
        (m.ClientJoystickMove(30.0, 40.0, 1.0), 0.6 * SPEED_M_S, 0.8 * SPEED_M_S, 0.0),
        # motion that is no number is a stop
        *((m.ClientJoystickMove(0.0, 1.0, value), 0.0, 0.0, 0.0) for value in (math.nan, math.inf)),
        *((m.ClientJoystickMove(value, 1.0, 1.0), 0.0, 0.0, 0.0) for value in (math.nan, -math.inf)),
        *((m.ClientJoystickRotate(value), 0.0, 0.0, 0.0) for value in (math.nan, math.inf)),
        (m.ClientJoystickStop(), 0.0, 0.0, 0.0),
    ],
)
def test_a_second_of_motion_goes_along_x_right_and_y_forward_at_most_at_full_speed(packet, x, y, turned) -> None:
    moved = vehicle()
    moved.take(FORWARD)
    live(moved, 1.0, packet)
    assert (moved.body.x, moved.body.y) == pytest.approx((x, y), abs=1e-6)
    assert moved.body.heading == pytest.approx(math.pi / 2 + turned)
    assert moved.moving is any((x, y, turned))


def test_it_stops_by_itself_after_a_second_of_silence_which_only_motion_breaks() -> None:
    moved = vehicle()
    moved.take(FORWARD)
    live(moved, SILENCE_S - STEP_S, m.ClientGetPosition())
    assert moved.moving
    live(moved, 2 * STEP_S, m.ClientGetPosition())
    assert not moved.moving
    assert moved.body.y == pytest.approx(SPEED_M_S * SILENCE_S, abs=2 * STEP_S)
    moved = vehicle(y=-4.0)
    live(moved, 5.0, FORWARD)
    assert moved.moving


@pytest.mark.parametrize("heading", [0.0, 0.8, math.pi / 2, 2.4, 3.1, -0.8, -1.6, -2.4])
def test_walls_and_boxes_stop_it_however_fast_it_is_told_to_go(heading: float) -> None:
    moved = vehicle(heading=heading)
    live(moved, 30.0, m.ClientJoystickMove(0.0, 1.0, 3e38))
    assert moved.body.blocked
    assert max(abs(moved.body.x), abs(moved.body.y)) <= HALF_SIDE_M - moved.body.radius + 1e-9
    assert not any(box.near(moved.body.x, moved.body.y, moved.body.radius) for box in BOXES)
    assert len(m.encode_packet(moved.position(), 1)) == 18


@pytest.mark.parametrize(
    ("packet", "answers"),
    [
        *((m.ClientLidarMode(mode), (m.ServerLidarStatus(status),)) for mode, status in ((1, 1), (2, 2), (7, 2))),
        (m.ClientGetPosition(), (m.ServerPosition(100.0, 200.0, 90.0),)),  # centimetres, degrees from y
        (m.DebugMessage("hi"), (m.DebugMessage("echo: hi"),)),
        (m.ChatMessage(b"\x01"), (m.ChatMessage(b"\x01"),)),
        (m.ClientMoveAI(b"\x01"), (m.DebugMessage("clientMoveAI taken"),)),
        (m.ClientGetSLAMMap(), (m.ServerSLAMMap(bytes(SIDE * SIDE)),)),
        (m.ClientControllMode(3), ()),
        (m.ClientUDPConnectionStatus(True), ()),
        (m.OpaquePacket(70, b"\x01"), ()),
    ],
)
def test_packets_are_answered(packet: m.Packet, answers: tuple[m.Packet, ...]) -> None:
    told = vehicle(1.0, 2.0, math.pi)
    assert told.take(packet) == answers
    assert told.lidar is (packet not in (m.ClientLidarMode(2), m.ClientLidarMode(7)))
    assert told.mode == (3 if packet == m.ClientControllMode(3) else 1)


def test_the_map_is_x_major_and_shows_the_walls() -> None:
    told = vehicle(x=3.5, y=0.0)
    told.sweep_lidar()
    assert drawn(told)[85, 50] == 1, "where it stands is free"
    assert 2 in drawn(told)[98:, 50], "the wall at x = 5 m"
    assert drawn(told)[10, 50] == 0, "out of its lidar's range"


def test_simulated_lidar_data_are_entered_into_the_map() -> None:
    told = vehicle()
    ranges = np.zeros(360, np.float32)
    ranges[90] = 200.0  # 2 m to its left: heading along y, that is at x = -2 m
    assert told.take(m.ClientSimulatedLidarData(ranges)) == ()
    (occupied,) = np.argwhere(drawn(told) == 2)
    assert (occupied + 0.5) * 0.1 - 5.0 == pytest.approx((-2.0, 0.0), abs=0.11)
    for bad in (ranges[:359], np.append(ranges, 1.0), np.array([math.nan, math.inf, -1.0, 3e38] * 90)):
        told.take(m.ClientSimulatedLidarData(bad.astype(np.float32)))
    assert len(np.argwhere(drawn(told) == 2)) == 1, "what is no scan of numbers enters nothing"
