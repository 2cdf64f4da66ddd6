"""Both recorded sessions through the sessions of both roles, each segment at its recorded time, and on to the fleet."""

import numpy as np
import pytest

from gateways.alf.messages import AlfMessage, Dialect, DriveCommand, DriveInfo, Measurement, ScannerInit
from gateways.alf.session import AlfSession, HqRole, VehicleRole
from gateways.alf.translate import AlfRobot, Options
from tests.captures import payloads, stream
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Motion, Scan, Scanner
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

DRIVE, DRIVE_PORT = "alf-drive.hex", 16668
LASER, LASER_PORT = "alf-laser.hex", 16667
BEGAN_NS = 1_700_000_000_000_000_000
INIT = ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600)
NEUTRAL, RIGHT = DriveCommand(0, 0, 0, False), DriveCommand(80, 0, 30, True)
NEUTRALS, RIGHTS = 25, 90
"""How often the recorded HQ sent each."""
END = b"255|1;"
RIGHT_ANGLE_THIRD = -1 / 3
"""30 of 90 degrees, to the right."""


def session_of(session: AlfSession) -> AlfSession:
    session.open(0.0)
    return session


def replay(session: AlfSession, name: str, *, source: int | None = None, destination: int | None = None) -> list[float]:
    """Feed what one side sent; tell when each message was delivered."""
    times = []
    for record in payloads(name, source=source, destination=destination):
        times += [record.seconds] * len(session.receive(record.payload, record.seconds))
    assert session.traffic.malformed == 0
    return times


def delivered(session: AlfSession, data: bytes) -> list[AlfMessage]:
    messages = session.receive(data, 0.0)
    assert session.traffic.malformed == 0
    return messages


def written(session: AlfSession, messages: list[AlfMessage]) -> bytes:
    """What a session writes of messages, and of END behind them."""
    data = b""
    for message in messages:
        session.send(message)
        data += session.outgoing(0.0) or b""
    session.close("done", 0.0)
    while (frame := session.outgoing(0.0)) is not None:
        data += frame
    return data


def told(robot: AlfRobot, link: str, name: str, port: int) -> list[tuple[Topic, FleetMessage]]:
    """What the fleet is told of everything a vehicle sent on one link, each at its recorded time."""
    session = robot.session(link, "tcp://robot.test:1")
    session.open(0.0)
    telemetry: list[tuple[Topic, FleetMessage]] = []
    for record in payloads(name, source=port):
        for message in session.receive(record.payload, record.seconds):
            telemetry += robot.telemetry(message, BEGAN_NS + round(record.seconds * 1e9))
    assert session.traffic.malformed == 0
    assert session.reason == "ended"
    return telemetry


# Byte for byte


@pytest.mark.parametrize(("name", "port", "count"), [(DRIVE, DRIVE_PORT, 6), (LASER, LASER_PORT, 7)])
def test_what_a_vehicle_sent_is_read_as_hq_and_written_as_vehicle_to_the_same_bytes(name, port, count) -> None:
    recorded = stream(name, source=port)
    reader = session_of(HqRole(Dialect.TEXT))
    messages = delivered(reader, recorded)
    assert len(messages) == count
    assert (reader.state, reader.reason) == (State.CLOSING, "ended")
    assert written(session_of(VehicleRole(Dialect.TEXT)), messages) == recorded


def test_what_an_hq_sent_is_read_as_vehicle_and_written_as_hq_to_the_same_bytes() -> None:
    recorded = stream(DRIVE, destination=DRIVE_PORT)
    messages = delivered(session_of(VehicleRole(Dialect.TEXT)), recorded)
    assert messages == [NEUTRAL] * NEUTRALS + [RIGHT] * RIGHTS
    assert written(session_of(HqRole(Dialect.TEXT)), messages) == recorded + END


def test_the_messages_of_the_recorded_vehicle_are_what_it_says() -> None:
    infos = delivered(session_of(HqRole(Dialect.TEXT)), stream(DRIVE, source=DRIVE_PORT))
    assert infos == [
        DriveInfo(10 + number, number + 0.25, -0.5, 0.987654, 1.5, -2.75, 123.456001, 36.529999) for number in range(6)
    ]
    init, *measurements = delivered(session_of(HqRole(Dialect.TEXT)), stream(LASER, source=LASER_PORT))
    assert init == INIT
    for number, message in enumerate(measurements):
        assert isinstance(message, Measurement)
        assert (message.sequence, message.timestamp_ms) == (number, 5000 + 100 * number)
        assert message.points.tolist() == list(range(1000 + number, 1769 + number))
        assert (message.first_valid, message.last_valid) == (44, 725)


# In time


def test_the_gateway_as_hq_drives_as_the_recorded_hq_did_and_answers_the_end() -> None:
    session = HqRole(Dialect.TEXT, drives=NEUTRAL)
    session.open(0.0006)
    sent: list[bytes] = []
    now = 0.0006
    for until, command in ((0.5049, RIGHT), (2.3019, None)):
        while now < until:
            while (frame := session.outgoing(now)) is not None:
                sent.append(frame)
            now = min(session.deadline() or until, until)
        if command is not None:
            session.drive(command, now)
    assert set(sent) == {b"3|0|0|0|0;", b"3|80|0|30|1;"}
    assert sent[:26] == [b"3|0|0|0|0;"] * 26, "every 20 ms of half a second; the recorded one was a little slower"
    assert len(sent[26:]) == 90
    assert replay(session, DRIVE, source=DRIVE_PORT) == [0.0003, 0.3006, 0.8009, 1.3011, 1.8015, 2.3017]
    assert session.outgoing(2.3019) == END
    assert session.outgoing(2.3019) is None
    assert (session.state, session.reason) == (State.CLOSED, "ended")


def test_the_gateway_as_vehicle_hears_its_hq_and_takes_its_answer_to_the_end() -> None:
    session = session_of(VehicleRole(Dialect.TEXT))
    times = replay(session, DRIVE, destination=DRIVE_PORT)
    assert (times[0], times[-1], len(times)) == (0.0006, 2.3017, NEUTRALS + RIGHTS)
    laser = session_of(VehicleRole(Dialect.TEXT))
    laser.close("vehicle stopped", 0.7032)
    assert laser.outgoing(0.7032) == END
    assert replay(laser, LASER, destination=LASER_PORT) == []
    assert laser.outgoing(0.7039) is None
    assert (laser.state, laser.reason) == (State.CLOSED, "vehicle stopped")


# On to the fleet


@pytest.mark.parametrize("link", ["drive", "laser"])
def test_the_recorded_scanner_and_its_measurements_are_in_radians_seconds_and_metres_on_either_link(link: str) -> None:
    metrics = Metrics()
    (topic, scanner), *scans = told(AlfRobot(Options(), 2, metrics), link, LASER, LASER_PORT)
    assert topic is topics.SCANNER
    assert isinstance(scanner, Scanner)
    assert scanner.angle_min == pytest.approx(-2.356194490192345)  # -135 degrees
    assert scanner.angle_max == pytest.approx(2.092349785949368)  # 119.882812 degrees
    assert scanner.angle_increment == pytest.approx(0.006135914424896305)  # 0.351562 degrees
    assert scanner.time_increment_s == pytest.approx(0.1)
    assert (scanner.range_min, scanner.range_max) == pytest.approx((0.02, 5.6))
    assert scanner.points == 769
    assert scanner.stamp_ns == BEGAN_NS + 400_000
    for number, arrived_s in enumerate((0.1013, 0.2016, 0.3019, 0.4022, 0.5025, 0.6028)):
        topic, scan = scans.pop(0)
        assert topic is topics.SCAN
        assert isinstance(scan, Scan)
        assert (scan.seq, scan.device_ms) == (number, 5000 + 100 * number)
        assert scan.angle_min == pytest.approx(-2.356194490192345)
        assert scan.angle_increment == pytest.approx(0.006135914424896305)
        assert (scan.range_min, scan.range_max) == pytest.approx((0.02, 5.6))
        assert scan.ranges.dtype == np.float32
        assert len(scan.ranges) == 769
        assert np.isnan(scan.ranges[:44]).all()
        assert np.isnan(scan.ranges[726:]).all()
        valid = [1.044 + 0.001 * (place + number) for place in range(682)]  # points 44 to 725
        assert scan.ranges[44:726].tolist() == pytest.approx(valid, rel=1e-6)
        assert isinstance(scan.stamp_ns, int)
        late_s = (BEGAN_NS + round(arrived_s * 1e9) - scan.stamp_ns) / 1e9
        assert 0 <= late_s < 0.002, "100 ms of the counter, 100.3 ms between arrivals"
    assert scans == []
    assert metrics.total("sequence_gaps") == metrics.total("sequence_duplicates") == 0


def test_the_recorded_drive_infos_are_motions_in_si_units() -> None:
    motions = told(AlfRobot(Options(), 2), "drive", DRIVE, DRIVE_PORT)
    forward_m_s2 = (2.4516625, 12.2583125, 22.0649625, 31.8716125, 41.6782625, 51.4849125)  # n + 0.25 times 9.80665
    speeds = (0.10, 0.11, 0.12, 0.13, 0.14, 0.15)
    arrived_us = (300, 300_600, 800_900, 1_301_100, 1_801_500, 2_301_700)
    assert len(motions) == 6
    for number, (topic, motion) in enumerate(motions):
        assert topic is topics.MOTION
        assert isinstance(motion, Motion)
        assert motion.speed == pytest.approx(speeds[number])
        assert motion.acceleration == pytest.approx((forward_m_s2[number], 4.903325, 9.6855770991))
        assert motion.gyro == pytest.approx((0.026179938779915, -0.047996554429844, 2.154713698795412))
        assert motion.temperature == 36.529999
        assert motion.stamp_ns == BEGAN_NS + arrived_us[number] * 1000
