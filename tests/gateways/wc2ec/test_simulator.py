"""The simulated robot itself: what commands make it do and what it senses, by the kinematics of two wheels."""

import math

import numpy as np
import pytest

from gateways.wc2ec import PROTOCOL
from gateways.wc2ec.messages import (
    ChangeSensor,
    DisableSensor,
    EnableSensor,
    RegisterSensor,
    SensorData,
    SetSensor,
    SetValue,
)
from gateways.wc2ec.simulator import DEVICES, Machine
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation
from zbridge.simulation.simulator import STEP_S
from zbridge.simulation.world import HALF_SIDE_M, SOLID

NUMBERS = {device.name: device.number for device in DEVICES}
LEFT, RIGHT, LIFT = NUMBERS[b"left wheel"], NUMBERS[b"right wheel"], NUMBERS[b"lift"]
RADIUS_M, TRACK_M = 0.05, 0.3
"""What the options of the simulated robot say."""


def machine(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> Machine:
    made = Machine(1)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def wheels(of: Machine, left: float, right: float) -> None:
    of.take(SetValue(53, LEFT, left))
    of.take(SetValue(53, RIGHT, right))


def live(moved: Machine, seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        moved.step(STEP_S)


def seen(by: Machine) -> list[float]:
    return [reading.value for reading in by.distances()]


# What it is


def test_it_steps_every_20_ms_and_registers_each_device_once_motors_included() -> None:
    assert STEP_S == 0.02
    assert all(isinstance(device, RegisterSensor) for device in DEVICES)
    assert len({device.name for device in DEVICES}) == len({device.number for device in DEVICES}) == len(DEVICES)
    assert {device.kind for device in DEVICES} == {37, 46, 53}
    assert all(device.number <= 254 for device in DEVICES)


def test_the_options_of_the_protocol_fit_it() -> None:
    wheels_of = PROTOCOL.simulated["differential"]
    assert (wheels_of["wheel_radius_m"], wheels_of["track_m"]) == (RADIUS_M, TRACK_M)
    names = {device.name.decode() for device in DEVICES}
    assert {*wheels_of["left"], *wheels_of["right"], *PROTOCOL.simulated["bearings_deg"]} <= names


# Determinism


def story(seed: int) -> list[object]:
    told = Machine(seed)
    wheels(told, 5.0, 8.0)
    live(told, 1.0)
    first = seen(told)
    wheels(told, -3.0, 2.0)
    told.take(EnableSensor(0, 1))
    live(told, 1.0)
    places = (told.body.x, told.body.y, told.body.heading)
    return [places, first, seen(told), told.lights()]


def test_the_same_seed_and_commands_give_the_same_world_and_another_seed_another() -> None:
    assert story(7) == story(7)
    assert story(7)[0] != story(8)[0]
    assert story(7)[3] != story(8)[3]


@pytest.mark.parametrize("seed", range(20))
def test_it_begins_in_the_room_and_at_rest(seed: int) -> None:
    begun = Machine(seed)
    before = (begun.body.x, begun.body.y, begun.body.heading)
    live(begun, 1.0)
    assert before == (begun.body.x, begun.body.y, begun.body.heading)
    assert not any(box.near(begun.body.x, begun.body.y, begun.body.radius) for box in SOLID)


# Two wheels


@pytest.mark.parametrize(
    ("left", "right", "x", "y", "heading"),
    [
        *((velocity, velocity, velocity * RADIUS_M, 0.0, 0.0) for velocity in (10.0, 4.0, -6.0)),
        # the right one forward: to the left
        *((-velocity, velocity, 0.0, 0.0, 2 * velocity * RADIUS_M / TRACK_M) for velocity in (3.0, -3.0)),
        # 0.2 and 0.4 m/s: 0.3 m/s, 2/3 rad/s, a radius of 0.45 m
        (4.0, 8.0, 0.45 * math.sin(2 / 3), 0.45 * (1 - math.cos(2 / 3)), 2 / 3),
    ],
)
def test_two_wheels_go_straight_by_their_radius_turn_on_the_spot_or_make_a_circle(left, right, x, y, heading) -> None:
    moved = machine()
    wheels(moved, left, right)
    live(moved, 1.0)
    assert (moved.body.x, moved.body.y) == pytest.approx((x, y), abs=2e-3)
    assert moved.body.heading == pytest.approx(heading)


def test_a_velocity_holds_until_the_next_and_nothing_else_moves_it() -> None:
    moved = machine()
    wheels(moved, 2.0, 2.0)
    live(moved, 10.0)
    assert moved.body.x == pytest.approx(1.0)
    for number in (0, 7, 99, 255):
        moved.take(SetValue(53, number, 9.0))
    wheels(moved, 0.0, 0.0)
    before = moved.body.x
    live(moved, 1.0)
    assert moved.body.x == before


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number_moves_no_motor(value: float) -> None:
    moved = machine()
    for number in (LEFT, RIGHT, LIFT):
        moved.take(SetValue(53, number, value))
    live(moved, 1.0)
    assert (moved.body.x, moved.body.y, moved.body.heading, moved.lift_m) == (0.0, 0.0, 0.0, 0.0)


def test_a_wall_stops_it_however_long_it_drives() -> None:
    moved = machine()
    wheels(moved, 20.0, 20.0)
    live(moved, 30.0)
    assert 4.0 < moved.body.x < HALF_SIDE_M
    assert all(math.isfinite(value) for value in seen(moved))


# Distances


def test_distances_are_0_to_1000_of_a_range_of_a_metre() -> None:
    by = machine(x=4.5)
    values = seen(by)
    assert [reading.number for reading in by.distances()] == list(range(8))
    assert {reading.kind for reading in by.distances()} == {37}
    assert values[0] == pytest.approx(500.0), "the wall at 5 m is half a metre ahead"
    assert [values[1], values[7]] == pytest.approx([707.10678, 707.10678]), "and at 45 degrees on both sides"
    assert values[2:7] == [1000.0] * 5, "elsewhere there is nothing within its range"


def test_sensors_look_counter_clockwise() -> None:
    left, back, right = machine(y=4.5), machine(x=-4.5), machine(y=-4.5)
    assert [int(np.argmin(seen(by))) for by in (left, back, right)] == [2, 4, 6]
    assert int(np.argmin(seen(machine(x=4.5, heading=math.pi / 2)))) == 6, "turned to the left, the wall is right of it"


# Lights


def test_only_what_is_enabled_measures() -> None:
    by = machine()
    assert by.lights() == []
    for number in (2, 0, 200):
        by.take(EnableSensor(0, number))
    assert [(reading.kind, reading.number) for reading in by.lights()] == [(0, 0), (0, 2)]
    for number in (2, 200):
        by.take(DisableSensor(0, number))
    assert [reading.number for reading in by.lights()] == [0]
    assert all(isinstance(reading, SensorData) for reading in [*by.distances(), *by.lights()])


def test_gain_and_offset_are_configuration_values() -> None:
    by = machine()
    by.take(EnableSensor(0, 0))
    by.take(EnableSensor(0, 1))
    plain, other = light(by), light(by, 1)
    for setting, shown in (
        (ChangeSensor(0, 0, 0, 2.0), 2 * plain),
        (ChangeSensor(0, 0, 1, 5.0), 2 * plain + 5),
        (SetSensor(0, 0, np.array([0.5, -1.0, 9.0])), plain / 2 - 1),
        (ChangeSensor(0, 0, 77, 9.0), plain / 2 - 1),
        (ChangeSensor(0, 99, 0, 9.0), plain / 2 - 1),
        (SetSensor(0, 99, np.array([1.0, 2.0, 3.0])), plain / 2 - 1),
    ):
        by.take(setting)
        assert light(by) == pytest.approx(shown)
    assert light(by, 1) == other


def light(by: Machine, number: int = 0) -> float:
    (value,) = [reading.value for reading in by.lights() if reading.number == number]
    return value


def test_light_is_brighter_near_the_lamp() -> None:
    values = []
    for x, y in ((-2.0, 2.0), (0.0, 0.0), (1.5, -1.5)):
        by = machine(x, y)
        by.take(EnableSensor(0, 0))
        values.append(light(by))
    assert 0 < values[0] < values[1] < values[2]


# The lift


def test_the_lift_goes_to_its_position_and_holds_it() -> None:
    by = machine()
    by.take(SetValue(46, LIFT, 0.2))
    live(by, 0.5)
    assert 0 < by.lift_m < 0.2, "not at once"
    live(by, 10.0)
    assert by.lift_m == pytest.approx(0.2)
    wheels(by, 0.0, 0.0)
    live(by, 1.0)
    assert by.lift_m == pytest.approx(0.2), "a stop of the wheels is none of its"
    by.take(SetValue(46, LIFT, -0.1))
    live(by, 10.0)
    assert by.lift_m == pytest.approx(-0.1)
    assert (by.body.x, by.body.y) == (0.0, 0.0)


# How it is started


@pytest.mark.parametrize(
    "more",
    [
        {"version": "1.3"},
        {"udp": True},
        {"dialect": "binary"},
        {"addresses": (Address("127.0.0.1", 0), Address("127.0.0.1", 0))},
    ],
)
async def test_what_a_webots_robot_does_not_have_is_refused(more: dict[str, object]) -> None:
    fields: dict[str, object] = {"addresses": (Address("127.0.0.1", 0),), **more}
    with pytest.raises(ConfigError):
        await PROTOCOL.simulate(Simulation(**fields))  # type: ignore[arg-type]
