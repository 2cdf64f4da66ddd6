"""The simulated robot itself: what commands make it do and what it senses, by the kinematics of two wheels."""

import math

import numpy as np
import pytest

from gateways.wc2ec import PROTOCOL
from gateways.wc2ec.messages import ChangeSensor, DisableSensor, EnableSensor, SetSensor, SetValue
from gateways.wc2ec.simulator import DEVICES, WebotsMachine
from tests.gateways.rig import planned
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation
from zbridge.simulation.simulator import STEP_S
from zbridge.simulation.world import HALF_SIDE_M, SOLID

NUMBERS = {device.name: device.number for device in DEVICES}
LEFT, RIGHT, LIFT = NUMBERS[b"left wheel"], NUMBERS[b"right wheel"], NUMBERS[b"lift"]
RADIUS_M, TRACK_M = 0.05, 0.3
"""What the options of the simulated robot say."""


def machine(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> WebotsMachine:
    made = WebotsMachine(1)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def place(of: WebotsMachine) -> tuple[float, float, float]:
    return (of.body.x, of.body.y, of.body.heading)


def drive(moved: WebotsMachine, left: float, right: float, seconds: float) -> None:
    """Set both wheels, and let time pass."""
    moved.take(SetValue(53, LEFT, left))
    moved.take(SetValue(53, RIGHT, right))
    live(moved, seconds)


def live(moved: WebotsMachine, seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        moved.step(STEP_S)


def seen(by: WebotsMachine) -> list[float]:
    return [reading.value for reading in by.distances()]


def test_it_registers_each_device_once_motors_included_and_its_options_fit_them() -> None:
    assert STEP_S == 0.02
    assert len({device.name for device in DEVICES}) == len({device.number for device in DEVICES}) == len(DEVICES)
    assert {device.kind for device in DEVICES} == {37, 46, 53}
    assert all(device.number <= 254 for device in DEVICES)
    options = planned("wc2ec", **PROTOCOL.simulated).options
    wheels = options.differential
    assert (wheels.wheel_radius_m, wheels.track_m) == (RADIUS_M, TRACK_M)
    assert {*wheels.left, *wheels.right, *options.bearings_deg} <= {device.name.decode() for device in DEVICES}


def test_the_same_seed_and_commands_give_the_same_world_and_another_seed_another() -> None:
    def story(seed: int) -> list[object]:
        told = WebotsMachine(seed)
        drive(told, 5.0, 8.0, 1.0)
        told.take(EnableSensor(0, 1))
        return [place(told), seen(told), told.lights()]

    assert story(7) == story(7)
    assert story(7)[0] != story(8)[0]
    assert story(7)[2] != story(8)[2]


def test_it_begins_in_the_room_and_at_rest() -> None:
    for seed in range(20):
        begun = WebotsMachine(seed)
        before = place(begun)
        live(begun, 1.0)
        assert before == place(begun)
        assert not any(box.near(begun.body.x, begun.body.y, begun.body.radius) for box in SOLID)


@pytest.mark.parametrize(
    ("left", "right", "x", "y", "heading"),
    [
        *((velocity, velocity, velocity * RADIUS_M, 0.0, 0.0) for velocity in (10.0, -6.0)),
        # the right one forward: to the left
        *((-velocity, velocity, 0.0, 0.0, 2 * velocity * RADIUS_M / TRACK_M) for velocity in (3.0, -3.0)),
        # 0.2 and 0.4 m/s: 0.3 m/s, 2/3 rad/s, a radius of 0.45 m
        (4.0, 8.0, 0.45 * math.sin(2 / 3), 0.45 * (1 - math.cos(2 / 3)), 2 / 3),
        (math.nan, math.inf, 0.0, 0.0, 0.0),
    ],
)
def test_two_wheels_go_straight_by_their_radius_turn_on_the_spot_or_make_a_circle(left, right, x, y, heading) -> None:
    moved = machine()
    drive(moved, left, right, 1.0)
    assert (moved.body.x, moved.body.y) == pytest.approx((x, y), abs=2e-3)
    assert moved.body.heading == pytest.approx(heading)


def test_a_velocity_holds_until_the_next_or_a_wall_and_nothing_else_moves_it() -> None:
    moved = machine()
    drive(moved, 2.0, 2.0, 10.0)
    assert moved.body.x == pytest.approx(1.0)
    for number in (0, 7, 99, 255):
        moved.take(SetValue(53, number, 9.0))
    drive(moved, 0.0, 0.0, 1.0)
    assert moved.body.x == pytest.approx(1.0)
    drive(moved, 20.0, 20.0, 30.0)
    assert 4.0 < moved.body.x < HALF_SIDE_M
    assert all(math.isfinite(value) for value in seen(moved))


def test_the_lift_goes_to_its_position_and_holds_it() -> None:
    by = machine()
    for position, seconds, expected in ((0.2, 0.5, 0.05), (0.2, 10.0, 0.2), (math.nan, 1.0, 0.2), (-0.1, 10.0, -0.1)):
        by.take(SetValue(46, LIFT, position))
        drive(by, 0.0, 0.0, seconds)
        assert by.lift_m == pytest.approx(expected), "10 cm/s, whatever the wheels do"
    assert place(by) == (0.0, 0.0, 0.0)


def test_distances_are_0_to_1000_of_a_range_of_a_metre_counter_clockwise() -> None:
    by = machine(x=4.5)
    assert [(reading.kind, reading.number) for reading in by.distances()] == [(37, number) for number in range(8)]
    # the wall at 5 m is half a metre ahead
    assert seen(by) == pytest.approx([500.0, 707.10678, *[1000.0] * 5, 707.10678])
    left, back, right = machine(y=4.5), machine(x=-4.5), machine(y=-4.5)
    turned_left = machine(x=4.5, heading=math.pi / 2)
    assert [int(np.argmin(seen(by))) for by in (left, back, right, turned_left)] == [2, 4, 6, 6]


def test_light_sensors_measure_while_enabled_by_their_gain_and_offset() -> None:
    by = machine()
    assert by.lights() == []
    for number in (2, 0, 200):
        by.take(EnableSensor(0, number))
    assert [(reading.kind, reading.number) for reading in by.lights()] == [(0, 0), (0, 2)]
    plain, other = (reading.value for reading in by.lights())
    for setting, shown in (
        (ChangeSensor(0, 0, 0, 2.0), 2 * plain),
        (ChangeSensor(0, 0, 1, 5.0), 2 * plain + 5),
        (SetSensor(0, 0, np.array([0.5, -1.0, 9.0])), plain / 2 - 1),
        (ChangeSensor(0, 0, 77, 9.0), plain / 2 - 1),
        (ChangeSensor(0, 99, 0, 9.0), plain / 2 - 1),
        (SetSensor(0, 99, np.array([1.0, 2.0, 3.0])), plain / 2 - 1),
    ):
        by.take(setting)
        assert [reading.value for reading in by.lights()] == pytest.approx([shown, other])
    for number in (0, 200):
        by.take(DisableSensor(0, number))
    assert [reading.number for reading in by.lights()] == [2]


def test_light_is_brighter_near_the_lamp() -> None:
    values = []
    for x, y in ((-2.0, 2.0), (0.0, 0.0), (1.5, -1.5)):
        by = machine(x, y)
        by.take(EnableSensor(0, 0))
        values += [reading.value for reading in by.lights()]
    assert 0 < values[0] < values[1] < values[2]


HERE = Address("127.0.0.1", 0)


@pytest.mark.parametrize(
    "more", [{"version": "1.3"}, {"udp": True}, {"dialect": "binary"}, {"addresses": (HERE, HERE)}], ids=str
)
async def test_what_a_webots_robot_does_not_have_is_refused(more: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        await PROTOCOL.simulate(Simulation(**{"addresses": (HERE,), **more}))  # type: ignore[arg-type]
