"""The simulated vehicle itself: what commands make it do, what it sees, and what it says of itself."""

import asyncio
import math

import numpy as np
import pytest

from gateways.alf import PROTOCOL
from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.alf.messages import AlfDialect, DriveCommand, DriveInfo, ScannerInit
from gateways.alf.simulator import SCANNER, SPEED_M_S, TEMPERATURE, Car
from tests.conformance.scene import until
from tests.gateways.alf.golden import BINARY, TEXT
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation
from zbridge.simulation.simulator import STEP_S

CYCLE_S = 0.02
"""An HQ program repeats its command every 20 ms."""


def car(x: float = 0.0, y: float = 0.0, heading: float = 0.0, dialect: AlfDialect = TEXT, seed: int = 1) -> Car:
    made = Car(seed, dialect)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def command(speed: int, right_deg: int = 0, *, backward: bool = False, dialect: AlfDialect = TEXT) -> DriveCommand:
    straight = 0 if dialect is TEXT else 90
    return DriveCommand(speed, int(backward), straight + right_deg, False)


def live(moved: Car, seconds: float, repeated: DriveCommand | None = None) -> float:
    """Let it live, repeating a command as HQ programs do; tell by how much it turned, radians, to the left positive."""
    assert STEP_S == CYCLE_S
    before = moved.body.heading
    for _ in range(round(seconds / CYCLE_S)):
        if repeated is not None:
            moved.take(repeated)
        moved.step(CYCLE_S)
    return math.remainder(moved.body.heading - before, 2 * math.pi)


def seen_m(by: Car, angle_deg: float) -> float:
    """The range at an angle, by the geometry of the legacy scanner."""
    return float(by.measure().points[round((angle_deg + 135.0) / 0.351562)]) / 1000


def test_the_same_seed_and_commands_give_the_same_world_in_both_dialects_and_another_seed_another() -> None:
    def story(seed: int, dialect: AlfDialect) -> list[object]:
        told = Car(seed, dialect)
        live(told, 1.0, command(60, -45, dialect=dialect))
        live(told, 1.0, command(40, 30, backward=True, dialect=dialect))
        return [told.body.x, told.body.y, told.body.heading, told.measure().points.tolist()]

    assert story(7, TEXT) == story(7, TEXT) == story(7, BINARY)
    assert all(one != other for one, other in zip(story(7, TEXT), story(8, TEXT), strict=True))


# How it moves


@pytest.mark.parametrize("dialect", AlfDialect)
def test_it_goes_straight_ahead_and_straight_back_stops_and_shows_speed_unsigned(
    dialect: AlfDialect,
) -> None:
    moved = car(dialect=dialect)
    before = seen_m(moved, 0)
    live(moved, 1.5, command(50, dialect=dialect))
    x = moved.body.x
    assert x > 0.2
    assert seen_m(moved, 0) == pytest.approx(before - x, abs=0.04), "the range ahead is shorter by as much"
    assert moved.info().speed == 50
    live(moved, 2.0, command(50, backward=True, dialect=dialect))
    assert moved.body.x < x - 0.2
    assert moved.info().speed == 50
    live(moved, 1.0, command(0, dialect=dialect))
    stands = (moved.body.x, 0.0, 0.0)
    live(moved, 5.0, command(0, -90 if dialect is TEXT else -45, dialect=dialect))
    live(moved, 5.0)
    assert (moved.body.x, moved.body.y, moved.body.heading) == stands, "a car never turns on the spot"


def test_it_turns_to_where_the_wheels_point_the_more_the_farther_they_do_and_backwards_to_the_other_side() -> None:
    turns = [live(car(), 1.0, command(50, right_deg)) for right_deg in (90, 45, 10, 0, -10, -45, -90)]
    assert turns == sorted(turns)
    assert turns[3] == 0.0
    assert turns[4] > 0.01, "to the left is counter-clockwise"
    assert turns[:3] == pytest.approx([-turn for turn in turns[:3:-1]])
    back = [live(car(), 1.0, command(50, right_deg, backward=True)) for right_deg in (90, 45, 10, 0, -10, -45, -90)]
    assert back == pytest.approx([-turn for turn in turns])
    binary = [live(car(dialect=BINARY), 1.0, DriveCommand(50, 0, steering, False)) for steering in (0, 90, 180, 255)]
    assert binary == pytest.approx([turns[-1], 0.0, turns[0], turns[0]])


@pytest.mark.parametrize("dialect", AlfDialect)
def test_speed_is_percent_and_above_100_without_clamping_in_text_and_100_in_binary(dialect: AlfDialect) -> None:
    speeds = []
    for percent in (25, 100, 101, 255):
        moved = car(-4.0, dialect=dialect)
        live(moved, 2.0, command(percent, dialect=dialect))
        speeds.append(moved.speed_m_s / SPEED_M_S)
    assert speeds == pytest.approx([0.25, 1.0, *([1.01, 2.55] if dialect is TEXT else [1.0, 1.0])])


def test_its_motor_stops_after_2_s_of_silence_and_not_much_earlier() -> None:
    """20 cycles of 20 ticks at 200 Hz ("Translation of commands")."""
    moved = car(-4.5)
    live(moved, 1.0, command(20))
    full = moved.speed_m_s
    for _ in range(10):
        live(moved, 1.9)
        assert moved.speed_m_s == full, "a command now and then keeps it going"
        moved.take(command(20))
    live(moved, 2.1)
    assert moved.speed_m_s < full
    live(moved, 2.0)
    assert moved.speed_m_s == 0.0


def test_a_wall_stops_it_and_it_can_drive_away_from_it() -> None:
    moved = car(heading=math.pi)
    live(moved, 15.0, command(100))
    assert moved.body.blocked
    assert moved.speed_m_s == 0.0
    live(moved, 2.0, command(100, backward=True))
    assert not moved.body.blocked


def test_the_light_is_what_it_was_told() -> None:
    lit = car()
    for light in (True, False):
        lit.take(DriveCommand(0, 0, 0, light))
        live(lit, 1.0)
        assert lit.light is light


# What it says


def test_its_scanner_is_the_deployed_one_and_of_769_points_44_to_725_are_valid() -> None:
    assert ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600) == SCANNER
    scan = car().measure()
    assert (len(scan.points), scan.first_valid, scan.last_valid) == (769, 44, 725)
    assert not scan.points[:44].any()
    assert not scan.points[726:].any()
    assert (scan.points >= 0).all()
    assert (scan.points <= 5700).all()
    assert scan.points[44:726].astype(bool).mean() > 0.5


def test_measurements_are_numbered_a_little_noisy_and_their_counter_is_in_milliseconds() -> None:
    told, scans = car(), []
    for _ in range(200):
        live(told, 0.1)
        scans.append(told.measure())
    first = scans[0]
    assert [scan.sequence - first.sequence for scan in scans] == list(range(200))
    assert [scan.timestamp_ms - first.timestamp_ms for scan in scans] == list(range(0, 20_000, 100))
    ahead = np.array([scan.points[384] for scan in scans])
    assert 0.5 < ahead.std() < 20
    assert abs(ahead.mean() - 5000) < 5


def test_ranges_are_those_to_the_walls_and_boxes_as_far_as_the_scanner_reaches() -> None:
    assert seen_m(car(), 0) == pytest.approx(5.0, abs=0.04), "the wall at x = 5"
    assert seen_m(car(), 45) == pytest.approx(2.1213, abs=0.04), "to the left, a box"
    assert seen_m(car(4.0, 0.0, math.pi / 2), -90) == pytest.approx(1.0, abs=0.04), "looking along y, to the right"
    assert seen_m(car(-4.0), 0) == 0.0, "farther than it reaches"


def test_info_says_the_acceleration_along_the_car_in_g_and_at_rest_only_1_g_upwards() -> None:
    assert car().info() == DriveInfo(0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, TEMPERATURE)
    assert car(dialect=BINARY).info() == DriveInfo(0, 0, 0, 1000, 0, 0, 0, TEMPERATURE)
    moved = car()
    live(moved, 0.1, command(100))
    before = moved.speed_m_s
    live(moved, 0.1, command(100))
    assert moved.info().longitudinal == pytest.approx((moved.speed_m_s - before) / 0.1 / 9.80665, rel=1e-3)
    live(moved, 0.1, command(0))
    assert moved.info().longitudinal < -0.05


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("right_deg", [-90, 90])
def test_info_says_how_fast_it_turns_and_what_pulls_it_to_the_side(right_deg: int, backward: bool) -> None:
    for dialect, degrees, g in ((TEXT, 1.0, 1.0), (BINARY, 10.0, 1000.0)):
        moved = car(dialect=dialect)
        steady = command(60, right_deg, backward=backward, dialect=dialect)
        live(moved, 1.0, steady)
        rate = live(moved, 0.1, steady) / 0.1
        told = moved.info()
        assert told.gyro_z == pytest.approx(math.degrees(rate) * degrees, rel=0.01)
        # On a circle it is accelerated towards the centre, where the wheels point: to the right positive.
        to_the_right = math.copysign(abs(moved.speed_m_s * rate), right_deg) / 9.80665 * g
        assert told.lateral == pytest.approx(to_the_right, rel=0.02)


@pytest.mark.parametrize("dialect", AlfDialect)
async def test_the_judges_find_no_fault_with_its_two_links(dialect: AlfDialect) -> None:
    ready: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    simulation = Simulation((Address("127.0.0.1", 0),) * 2, dialect=dialect.value, ready=ready.set_result)
    driver = FragileAlfHq(dialect=dialect.value, serves="drive")
    viewer = FragileAlfHq(dialect=dialect.value, serves="laser", repeat_s=None)
    driver.drive(50, 0, 45)  # half right in text, half left in binary
    async with asyncio.timeout(20.0), asyncio.TaskGroup() as tasks:
        vehicle = tasks.create_task(PROTOCOL.simulate(simulation))
        for judge, address in zip((driver, viewer), await ready, strict=True):
            tasks.create_task(judge.run(address.host, address.port))
        await until(lambda: driver.infos and driver.infos[-1][0] == 50 and viewer.scans > 2)
        await driver.end()
        await viewer.end()
        vehicle.cancel()
    assert driver.violations == viewer.violations == []


async def test_what_a_vehicle_has_not_is_refused() -> None:
    port = Address("127.0.0.1", 0)
    for simulation, what in (
        (Simulation((port,), version="1.3"), "no versions"),
        (Simulation((port,), udp=True), "no datagrams"),
        (Simulation((port,), dialect="morse"), "'morse': expected one of binary, text"),
        (Simulation((port, port, port)), "at most 2 links"),
    ):
        with pytest.raises(ConfigError, match=what):
            await PROTOCOL.simulate(simulation)
