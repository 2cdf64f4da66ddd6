"""The simulated vehicle itself: what commands make it do, what it sees, and what it says of itself."""

import math

import numpy as np
import pytest

from gateways.alf import PROTOCOL
from gateways.alf.messages import Dialect, DriveCommand, DriveInfo, Measurement, ScannerInit
from gateways.alf.session import HqRole, VehicleRole
from gateways.alf.simulator import SCANNER, SPEED_M_S, TEMPERATURE, Car
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation
from zbridge.simulation.simulator import STEP_S
from zbridge.simulation.world import BOXES, HALF_SIDE_M

TEXT, BINARY = Dialect.TEXT, Dialect.BINARY
STRAIGHT = {TEXT: 0, BINARY: 90}
CYCLE_S = 0.02
"""An HQ program repeats its command every 20 ms."""


def car(x: float = 0.0, y: float = 0.0, heading: float = 0.0, dialect: Dialect = TEXT) -> Car:
    made = Car(1, dialect)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def command(speed: int, right_deg: int = 0, *, backward: bool = False, dialect: Dialect = TEXT) -> DriveCommand:
    return DriveCommand(speed, int(backward), STRAIGHT[dialect] + right_deg, False)


def live(moved: Car, seconds: float, repeated: DriveCommand | None = None) -> None:
    """Let it live, repeating a command every 20 ms as HQ programs do."""
    assert STEP_S == CYCLE_S
    for _ in range(round(seconds / CYCLE_S)):
        if repeated is not None:
            moved.take(repeated)
        moved.step(CYCLE_S)


def turned(moved: Car, seconds: float, repeated: DriveCommand) -> float:
    """By how much a command turns it, radians, to the left positive; less than half a turn."""
    before = moved.body.heading
    live(moved, seconds, repeated)
    return math.remainder(moved.body.heading - before, 2 * math.pi)


def point(angle_deg: float) -> int:
    """The point of a measurement that is nearest to an angle, by the geometry of the deployed scanner."""
    return round((angle_deg + 135.0) / 0.351562)


def seen_m(by: Car, angle_deg: float) -> float:
    return float(by.measure().points[point(angle_deg)]) / 1000


# Determinism


def story(seed: int, dialect: Dialect) -> list[object]:
    told = Car(seed, dialect)
    live(told, 1.0, command(60, -45, dialect=dialect))
    first = told.measure()
    live(told, 1.0, command(40, 30, backward=True, dialect=dialect))
    second = told.measure()
    places = (told.body.x, told.body.y, told.body.heading)
    return [places, first.points.tolist(), second.points.tolist(), second.timestamp_ms, told.info()]


def test_the_same_seed_and_commands_give_the_same_world_in_both_dialects_and_another_seed_another() -> None:
    text, binary = story(7, TEXT), story(7, BINARY)
    assert (text, binary) == (story(7, TEXT), story(7, BINARY))
    assert text[:4] == binary[:4]
    place, first, *_ = story(8, TEXT)
    assert place != text[0]
    assert first != text[1]


# Steering


@pytest.mark.parametrize("dialect", Dialect)
def test_it_goes_straight_ahead_and_straight_back_and_says_its_speed_without_the_sign(dialect: Dialect) -> None:
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
    assert (moved.body.y, moved.body.heading) == (0.0, 0.0)


@pytest.mark.parametrize("dialect", Dialect)
@pytest.mark.parametrize("right_deg", [-90, -45, -10, 10, 45, 90])
def test_it_turns_to_where_the_wheels_point_and_backwards_to_the_other_side(right_deg: int, dialect: Dialect) -> None:
    moved = car(dialect=dialect)
    ahead = turned(moved, 1.0, command(50, right_deg, dialect=dialect))
    back = turned(car(dialect=dialect), 1.0, command(50, right_deg, backward=True, dialect=dialect))
    left = right_deg < 0
    assert (ahead > 0.01) if left else (ahead < -0.01), "to the left is counter-clockwise"
    assert back == pytest.approx(-ahead)
    assert (moved.body.y > 0) is left
    assert moved.body.x > 0


def test_more_steering_turns_more_and_binary_0_is_full_left_and_180_full_right() -> None:
    turns = [turned(car(), 1.0, command(50, right_deg)) for right_deg in (0, -20, -40, -60, -90)]
    assert turns == sorted(turns)
    assert turns[0] == 0.0
    binary = [turned(car(dialect=BINARY), 1.0, DriveCommand(50, 0, steering, False)) for steering in (0, 180, 255)]
    assert binary == pytest.approx([turns[-1], -turns[-1], -turns[-1]])
    assert turns[-1] > 0.1


def test_it_is_a_car_it_never_turns_on_the_spot_and_stands_until_it_is_driven() -> None:
    stands = car(1.0, -2.0, 0.5)
    live(stands, 5.0)
    live(stands, 1.0, command(0, -90))
    assert (stands.body.x, stands.body.y, stands.body.heading) == (1.0, -2.0, 0.5)
    assert repr(stands).startswith("<Car <Body x=1.00 y=-2.00")


def test_the_circle_it_drives_does_not_depend_on_its_speed() -> None:
    radii = []
    for speed in (20, 50, 80):
        moved = car()
        live(moved, 1.0, command(speed, -90))  # until the speed is steady
        before = (moved.body.x, moved.body.y, moved.body.heading)
        turn = turned(moved, 0.2, command(speed, -90))
        chord = math.hypot(moved.body.x - before[0], moved.body.y - before[1])
        radii.append(chord / 2 / math.sin(turn / 2))
    assert radii == pytest.approx([radii[0]] * 3, rel=0.02)
    assert 0.2 < radii[0] < 3.0


# Speed


@pytest.mark.parametrize("dialect", Dialect)
def test_speed_is_percent_and_above_100_without_clamping_in_text_and_100_in_binary(dialect: Dialect) -> None:
    speeds = []
    for percent in (25, 50, 100, 101, 255):
        moved = car(-4.0, dialect=dialect)
        live(moved, 2.0, command(percent, dialect=dialect))
        speeds.append(moved.speed_m_s / SPEED_M_S)
    assert speeds == pytest.approx([0.25, 0.5, 1.0, *([1.01, 2.55] if dialect is TEXT else [1.0, 1.0])])


def test_speed_0_stops_it() -> None:
    moved = car()
    live(moved, 0.5, command(50))
    live(moved, 1.0, command(0))
    assert moved.speed_m_s == 0.0
    x = moved.body.x
    live(moved, 1.0, command(0))
    assert moved.body.x == x


def test_its_motor_stops_after_some_20_cycles_of_silence_and_not_much_earlier() -> None:
    moved = car(-4.5)
    live(moved, 1.0, command(50))
    full = moved.speed_m_s
    for _ in range(10):
        live(moved, 18 * CYCLE_S)
        assert moved.speed_m_s == full, "a command now and then keeps it going"
        moved.take(command(50))
    live(moved, 30 * CYCLE_S)
    assert moved.speed_m_s < full
    live(moved, 2.0)
    assert moved.speed_m_s == 0.0


@pytest.mark.parametrize("heading", [0.0, 0.8, 1.6, 2.4, 3.1, -0.8, -1.6, -2.4])
def test_walls_and_boxes_stop_it(heading: float) -> None:
    moved = car(heading=heading)
    live(moved, 15.0, command(100))
    assert moved.body.blocked
    assert max(abs(moved.body.x), abs(moved.body.y)) <= HALF_SIDE_M - moved.body.radius + 1e-9
    assert not any(box.near(moved.body.x, moved.body.y, moved.body.radius) for box in BOXES)
    live(moved, 2.0, command(100, backward=True))
    assert not moved.body.blocked


def test_the_light_is_what_it_was_told() -> None:
    lit = car()
    assert not lit.light
    lit.take(DriveCommand(0, 0, 0, True))
    assert lit.light
    live(lit, 1.0)
    assert lit.light
    lit.take(DriveCommand(0, 0, 0, False))
    assert not lit.light


# The laser


def test_its_scanner_is_the_deployed_one_and_of_769_points_44_to_725_are_valid() -> None:
    assert ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600) == SCANNER
    scan = car().measure()
    assert scan.points.dtype == np.int64
    assert len(scan.points) == 769
    assert (scan.first_valid, scan.last_valid) == (44, 725)
    assert not scan.points[:44].any()
    assert not scan.points[726:].any()
    assert (scan.points >= 0).all()
    assert (scan.points <= 5700).all()
    assert scan.points[44:726].astype(bool).mean() > 0.5


def test_measurements_are_numbered_and_their_counter_is_in_milliseconds() -> None:
    told = car()
    scans: list[Measurement] = []
    for _ in range(5):
        live(told, 0.1)
        scans.append(told.measure())
    first = scans[0]
    assert [scan.sequence - first.sequence for scan in scans] == [0, 1, 2, 3, 4]
    assert [scan.timestamp_ms - first.timestamp_ms for scan in scans] == [0, 100, 200, 300, 400]


@pytest.mark.parametrize(
    ("x", "y", "heading_deg", "angle_deg", "range_m"),
    [
        (0.0, 0.0, 0, 0, 5.0),  # the wall at x = 5
        (0.0, 0.0, 0, 90, 5.0),  # to the left: the wall at y = 5
        (0.0, 0.0, 0, -90, 5.0),  # to the right: the wall at y = -5
        (4.0, 0.0, 0, 0, 1.0),
        (4.0, 0.0, 90, -90, 1.0),  # looking along y, the wall at x = 5 is to the right
        (4.0, 0.0, -90, 90, 1.0),
        (0.0, 4.0, 0, 90, 1.0),
        (0.0, 0.0, 0, 45, 2.1213),  # the box from (1.5, 1) to (2.5, 2.5), hit at (1.5, 1.5)
        (0.0, 2.0, 0, 0, 1.5),  # the same from the side
        (2.0, 0.0, 0, 90, 1.0),
        (3.0, 2.0, 180, 0, 0.5),
        (-4.0, 0.0, 0, 0, 0.0),  # farther than the scanner reaches
        (4.0, 0.0, 180, 0, 0.0),
    ],
)
def test_ranges_are_those_to_the_walls_and_boxes_as_far_as_the_scanner_reaches(
    x: float, y: float, heading_deg: float, angle_deg: float, range_m: float
) -> None:
    assert seen_m(car(x, y, math.radians(heading_deg)), angle_deg) == pytest.approx(range_m, abs=0.04 * bool(range_m))


def test_measurements_are_a_little_noisy() -> None:
    stands = car()
    ranges = np.array([stands.measure().points[point(0)] for _ in range(200)])
    assert 0.5 < ranges.std() < 20
    assert abs(ranges.mean() - 5000) < 5


# Drive info


def test_info_of_a_vehicle_at_rest_feels_1_g_upwards_and_binary_is_in_integers() -> None:
    assert car().info() == DriveInfo(0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, TEMPERATURE)
    assert math.isfinite(TEMPERATURE)
    moved = car(dialect=BINARY)
    assert moved.info() == DriveInfo(0, 0, 0, 1000, 0, 0, 0, TEMPERATURE)
    live(moved, 0.3, command(70, -45, dialect=BINARY))
    told = moved.info()
    values = (told.longitudinal, told.lateral, told.vertical, told.gyro_x, told.gyro_y, told.gyro_z)
    assert all(isinstance(value, int) for value in values)


def test_info_says_the_acceleration_along_the_car_in_g() -> None:
    moved = car()
    live(moved, 0.1, command(100))
    before = moved.speed_m_s
    live(moved, 0.1, command(100))
    assert moved.info().longitudinal == pytest.approx((moved.speed_m_s - before) / 0.1 / 9.80665, rel=1e-3)
    live(moved, 0.1, command(0))
    assert moved.info().longitudinal < -0.05
    live(moved, 2.0, command(0))
    assert moved.info().longitudinal == 0.0


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("right_deg", [-90, 90])
def test_info_says_how_fast_it_turns_and_what_pulls_it_to_the_side(right_deg: int, backward: bool) -> None:
    for dialect, degrees, g in ((TEXT, 1.0, 1.0), (BINARY, 10.0, 1000.0)):
        moved = car(dialect=dialect)
        steady = command(60, right_deg, backward=backward, dialect=dialect)
        live(moved, 1.0, steady)
        rate = turned(moved, 0.1, steady) / 0.1
        told = moved.info()
        assert told.gyro_z == pytest.approx(math.degrees(rate) * degrees, rel=0.01)
        # On a circle it is accelerated towards the centre, where the wheels point: to the right positive.
        assert told.lateral == pytest.approx(
            math.copysign(abs(moved.speed_m_s * rate), right_deg) / 9.80665 * g, rel=0.02
        )
        assert told.vertical == pytest.approx(g)


@pytest.mark.parametrize("dialect", Dialect)
@pytest.mark.parametrize("speed", [0, 60, 100, 255])
def test_everything_it_says_can_be_sent_and_is_read_back(speed: int, dialect: Dialect) -> None:
    told = car(dialect=dialect)
    sender, reader = VehicleRole(dialect), HqRole(dialect)
    for session in (sender, reader):
        session.open(0.0)
    for right_deg in (-90, 90):
        for backward in (False, True):
            live(told, 0.5, command(speed, right_deg, backward=backward, dialect=dialect))
            for message in (SCANNER, told.measure(), told.info()):
                sender.send(message)
                got = reader.receive(sender.outgoing(0.0) or b"", 0.0)
                assert [type(one) for one in got] == [type(message)]
    assert reader.traffic.malformed == 0


@pytest.mark.parametrize(
    ("simulation", "what"),
    [
        (Simulation((Address("127.0.0.1", 0),), version="1.3"), "no versions"),
        (Simulation((Address("127.0.0.1", 0),), udp=True), "no datagrams"),
        (Simulation((Address("127.0.0.1", 0),), dialect="morse"), "'morse': expected one of binary, text"),
        (Simulation((Address("127.0.0.1", 0),) * 3), "at most 2 links"),
    ],
)
async def test_what_a_vehicle_has_not_is_refused(simulation: Simulation, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        await PROTOCOL.simulate(simulation)
