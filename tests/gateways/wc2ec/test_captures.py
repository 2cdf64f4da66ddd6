"""The recorded session of the field, each segment at its time, on to the fleet; ``test_hq`` continues to a controller.

The values are read off the bytes by hand: twelve registrations, then twenty rounds of six readings, and one more.
"""

from gateways.wc2ec.options import Wc2EcOptions
from gateways.wc2ec.translate import Wc2EcRobot
from tests.captures import payloads
from zbridge.fleet.messages import Device, Devices, Reading
from zbridge.metrics import Metrics
from zbridge.protocol.session import State

NAME, PORT = "wc2ec-deployed.hex", 27515
BEGAN_NS = 1_700_000_000_000_000_000
SENSORS = ("dist_c", "dist_ir_c", "inf_left", "inf_cent", "inf_right", "curb_lf")
RECORDED = (
    *(Device(f"wheel{number + 1}", number, "rotational") for number in range(4)),
    Device("slider_curb_lf", 4, "linear"),
    Device("slider_curb_lf2", 5, "linear"),
    *(Device(name, 6 + at, "distance") for at, name in enumerate(SENSORS)),
)
VALUES = {6: 1000.0, 7: 750.5, 8: 123.456, 9: 0.0, 10: -1.0, 11: 0.001}


def test_the_recorded_devices_are_the_device_table_and_their_readings_on_the_keys_of_their_names() -> None:
    metrics, tables, readings = Metrics(), list[Devices](), list[tuple[str, Reading]]()
    robot = Wc2EcRobot(Wc2EcOptions(bounds_default=(0.0, 1000.0)), 1, metrics)
    session = robot.session("robot", "tcp://robot.test:1")
    session.open(0.0)
    for record in payloads(NAME, source=PORT):
        assert (session.state is State.ESTABLISHED) == (session.traffic.frames_in > 12)
        for message in session.receive(record.payload, record.seconds):
            for topic, told in robot.telemetry(message, BEGAN_NS + round(record.seconds * 1e9)):
                if isinstance(told, Reading):
                    readings.append((topic.path, told))
                else:
                    assert isinstance(told, Devices)
                    tables.append(told)
    assert tables[-1] == Devices(RECORDED, stamp_ns=BEGAN_NS + 1_800_000)
    assert [path for path, _ in readings] == [f"sensor/{name}" for name in SENSORS * 20] + ["sensor/dist_c"]
    assert [(told.device, told.value) for _, told in readings] == [*VALUES.items()] * 20 + [(6, 1000.0)]
    assert {path for path, told in readings if told.fault} == {"sensor/inf_right"}, "-1 is outside 0..1000"
    assert (metrics.total("sensor_faults"), metrics.total("sensor_unregistered")) == (20, 0)
    assert [readings[at][1].stamp_ns - BEGAN_NS for at in (0, -1)] == [22_000_000, 425_900_000]
