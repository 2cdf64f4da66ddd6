"""Both recorded sessions: what the gateway makes of them for the fleet, and from there for an HQ program."""

import numpy as np
import pytest

from gateways.alf.hq import AlfHq, AlfHqOptions
from gateways.alf.messages import DriveCommand
from gateways.alf.session import AlfHqRole
from gateways.alf.translate import AlfOptions, AlfRobot
from tests.captures import payloads, stream
from tests.gateways.alf.golden import END, TEXT
from tests.gateways.rig import HqScene, drained
from zbridge.fleet import payload as fleet_payload
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

DRIVE, DRIVE_PORT = "alf-drive.hex", 16668
LASER, LASER_PORT = "alf-laser.hex", 16667
BEGAN_NS = 1_700_000_000_000_000_000


def told(robot: AlfRobot, name: str, port: int) -> list[tuple[Topic, FleetMessage]]:
    """What the fleet is told of everything a vehicle sent, each at its recorded time."""
    link = robot.session("drive", "tcp://robot.test:1")
    link.open(0.0)
    telemetry: list[tuple[Topic, FleetMessage]] = []
    for record in payloads(name, source=port):
        for message in link.receive(record.payload, record.seconds):
            telemetry += robot.telemetry(message, BEGAN_NS + round(record.seconds * 1e9))
    assert (link.traffic.malformed, link.reason) == (0, "ended")
    return telemetry


def test_the_gateway_as_hq_drives_as_the_recorded_hq_did_and_answers_the_end() -> None:
    link = AlfHqRole(TEXT)
    link.at_first = DriveCommand(0, 0, 0, False)
    link.open(0.0006)
    sent: list[bytes] = []
    now = 0.0006
    for until in (0.5049, 2.3019):
        while now < until:
            sent += drained(link, now)
            now = min(link.deadline(), until)
        link.drive(DriveCommand(80, 0, 30, True), now)
    assert sent == [b"3|0|0|0|0;"] * 26 + [b"3|80|0|30|1;"] * 90, "the recorded one was a little slower at first"
    link.receive(stream(DRIVE, source=DRIVE_PORT), 2.3019)
    assert drained(link, 2.3019) == [END[TEXT]]
    assert (link.state, link.reason) == (State.CLOSED, "ended")


def test_the_recorded_scanner_and_its_measurements_are_in_radians_seconds_and_metres() -> None:
    metrics = Metrics()
    (topic, scanner), *scans = told(AlfRobot(AlfOptions(), 2, metrics), LASER, LASER_PORT)
    assert topic is topics.SCANNER
    assert scanner.angle_min == pytest.approx(-2.356194490192345)  # -135 degrees
    assert scanner.angle_max == pytest.approx(2.092349785949368)  # 119.882812 degrees
    assert scanner.angle_increment == pytest.approx(0.006135914424896305)  # 0.351562 degrees
    assert (scanner.time_increment_s, scanner.range_min, scanner.range_max) == pytest.approx((0.1, 0.02, 5.6))
    assert (scanner.points, scanner.stamp_ns) == (769, BEGAN_NS + 400_000)
    assert len(scans) == 6
    for number, (topic, scan) in enumerate(scans):
        assert topic is topics.SCAN
        assert (scan.seq, scan.device_ms) == (number, 5000 + 100 * number)
        assert (scan.angle_min, scan.angle_increment) == (scanner.angle_min, scanner.angle_increment)
        assert (scan.range_min, scan.range_max) == (scanner.range_min, scanner.range_max)
        assert (scan.ranges.dtype, len(scan.ranges)) == (np.float32, 769)
        assert np.isnan(scan.ranges[:44]).all()
        assert np.isnan(scan.ranges[726:]).all()
        valid = [1.044 + 0.001 * (place + number) for place in range(682)]  # points 44 to 725
        assert scan.ranges[44:726].tolist() == pytest.approx(valid, rel=1e-6)
        arrived_ns = BEGAN_NS + 101_300_000 + number * 100_300_000
        assert 0 <= arrived_ns - scan.stamp_ns < 2_000_000, "100 ms of the counter, 100.3 ms between arrivals"
    assert metrics.total("sequence_gaps") == metrics.total("sequence_duplicates") == 0


def test_the_recorded_drive_infos_are_motions_in_si_units() -> None:
    motions = told(AlfRobot(AlfOptions(), 2), DRIVE, DRIVE_PORT)
    arrived_us = (300, 300_600, 800_900, 1_301_100, 1_801_500, 2_301_700)
    forward_m_s2 = (2.4516625, 12.2583125, 22.0649625, 31.8716125, 41.6782625, 51.4849125)  # n + 0.25 times 9.80665
    for number, (topic, motion) in enumerate(motions):
        assert topic is topics.MOTION
        assert motion.speed == pytest.approx((10 + number) / 100)
        assert motion.acceleration == pytest.approx((forward_m_s2[number], 4.903325, 9.6855770991))
        assert motion.gyro == pytest.approx((0.026179938779915, -0.047996554429844, 2.154713698795412))
        assert (motion.temperature, motion.stamp_ns) == (36.529999, BEGAN_NS + arrived_us[number] * 1000)
    assert len(motions) == 6


def test_the_recorded_hq_says_neutral_and_then_drives_to_the_right() -> None:
    scene = HqScene(AlfHq(AlfHqOptions(), RobotView()), RobotView())
    scene.connect()
    said = scene.says(stream(DRIVE, destination=DRIVE_PORT))
    neutral, right = Drive(light=False), Drive(forward=80 / 255, turn=-30 / 90, light=True)
    assert said == [(topics.CMD_DRIVE, neutral)] * 25 + [(topics.CMD_DRIVE, right)] * 90


@pytest.mark.parametrize(("name", "port"), [(DRIVE, DRIVE_PORT), (LASER, LASER_PORT)])
def test_what_a_recorded_vehicle_sent_passes_the_bus_and_reaches_an_hq_as_it_was(name: str, port: int) -> None:
    """All but the points outside the valid indices: on the bus they have no range, here they are 0."""
    view = RobotView()
    scene = HqScene(AlfHq(AlfHqOptions(serve="both"), view), view)
    client = scene.connect()
    shown = b""
    for topic, telemetry in told(AlfRobot(AlfOptions(), 2), name, port):
        carried = fleet_payload.decode(topic.message, fleet_payload.encode(telemetry))
        view.note(topic, carried)
        scene.send(scene.side.show(topic, carried))
        shown += b"".join(drained(client))
    client.close("robot gone", 3.0)
    expected = []
    for frame in stream(name, source=port).split(b";"):
        fields = frame.split(b"|")
        if fields[0] == b"1":
            fields[3:47], fields[729:772] = [b"0"] * 44, [b"0"] * 43
        expected.append(b"|".join(fields))
    assert shown + b"".join(drained(client, 3.0)) == b";".join(expected)
