"""The recorded session of the field through the sessions of both roles, each segment at its time, and on to the fleet.

The values are read off the bytes by hand: twelve registrations, then twenty rounds of six readings, and one more.
"""

from gateways.wc2ec.messages import Dialect, RegisterSensor, SensorData
from gateways.wc2ec.session import ControllerRole, ExternalRole
from gateways.wc2ec.settings import Options
from gateways.wc2ec.translate import Wc2EcRobot
from tests.captures import payloads, stream
from tests.gateways.wc2ec.golden import NODE_TYPES
from zbridge.fleet import topics
from zbridge.fleet.messages import Device, Devices, FleetMessage, Reading
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

NAME, PORT = "wc2ec-deployed.hex", 27515
BEGAN_NS = 1_700_000_000_000_000_000
RECORDED = (
    *(Device(f"wheel{number + 1}", number, "rotational") for number in range(4)),
    Device("slider_curb_lf", 4, "linear"),
    Device("slider_curb_lf2", 5, "linear"),
    *(
        Device(name, 6 + at, "distance")
        for at, name in enumerate(("dist_c", "dist_ir_c", "inf_left", "inf_cent", "inf_right", "curb_lf"))
    ),
)
REGISTRATIONS = [RegisterSensor(NODE_TYPES[each.kind], each.number, each.name.encode()) for each in RECORDED]
VALUES = {6: 1000.0, 7: 750.5, 8: 123.456, 9: 0.0, 10: -1.0, 11: 0.001}
ROUND = [SensorData(37, number, value) for number, value in VALUES.items()]
ROUNDS = 20
READINGS = ROUND * ROUNDS + [SensorData(37, 6, 1000.0)]


def told(robot: Wc2EcRobot) -> list[tuple[Topic, FleetMessage]]:
    """What the fleet is told of everything the controller sent, each segment at its recorded time."""
    session = robot.session("robot", "tcp://robot.test:1")
    session.open(0.0)
    telemetry: list[tuple[Topic, FleetMessage]] = []
    for record in payloads(NAME, source=PORT):
        assert (session.state is State.ESTABLISHED) == (record.seconds > 0.0220 or session.traffic.frames_in > 12)
        for message in session.receive(record.payload, record.seconds):
            telemetry += robot.telemetry(message, BEGAN_NS + round(record.seconds * 1e9))
    assert (session.state, session.traffic.malformed) == (State.ESTABLISHED, 0)
    return telemetry


def test_what_is_read_as_external_controller_is_written_as_controller_to_the_same_bytes() -> None:
    reader, writer, written = ExternalRole(Dialect.DEPLOYED), ControllerRole(Dialect.DEPLOYED), b""
    reader.open(0.0)
    writer.open(0.0)
    recorded = stream(NAME, source=PORT)
    messages = reader.receive(recorded, 0.0)
    assert messages == [*REGISTRATIONS, *READINGS]
    assert (len(messages), reader.traffic.malformed) == (133, 0)
    for message in messages:
        writer.send(message)
        written += writer.outgoing(0.0) or b""
    assert written == recorded
    assert stream(NAME, destination=PORT) == b"", "the recorded external controller sent nothing"


def test_the_recorded_devices_are_the_device_table() -> None:
    tables = [message for topic, message in told(Wc2EcRobot(Options())) if topic is topics.DEVICES]
    assert isinstance(tables[-1], Devices)
    assert tables[-1].devices == RECORDED
    assert tables[-1].stamp_ns == BEGAN_NS + 1_800_000


def test_the_recorded_readings_are_on_the_keys_of_their_names() -> None:
    metrics = Metrics()
    robot = Wc2EcRobot(Options(bounds_default=(0.0, 1000.0)), 1, metrics)
    readings = [(topic.path, message) for topic, message in told(robot) if isinstance(message, Reading)]
    names = ("dist_c", "dist_ir_c", "inf_left", "inf_cent", "inf_right", "curb_lf")
    assert [path for path, _ in readings] == [f"sensor/{name}" for name in names] * ROUNDS + ["sensor/dist_c"]
    assert [reading.value for _, reading in readings] == [*VALUES.values()] * ROUNDS + [1000.0]
    assert [reading.device for _, reading in readings] == [*VALUES] * ROUNDS + [6]
    assert {reading.kind for _, reading in readings} == {"distance"}
    assert {path for path, reading in readings if reading.fault} == {"sensor/inf_right"}, "-1 is outside 0..1000"
    assert metrics.total("sensor_faults") == ROUNDS
    assert metrics.total("sensor_unregistered") == 0
    assert readings[0][1].stamp_ns == BEGAN_NS + 22_000_000
    assert readings[-1][1].stamp_ns == BEGAN_NS + 425_900_000
