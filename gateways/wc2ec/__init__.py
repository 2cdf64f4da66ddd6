"""WC2EC: Webots robots, by the controller program of the simulation, in the field's dialect or the document's.

``messages`` declares the messages of both dialects; ``session`` holds the conversation in both roles; ``devices`` and
``translate`` are the device side, ``hq``, ``hq_client`` and ``device_table`` the HQ side, ``options`` the options of
both. ``simulator`` is a simulated robot; ``conformance`` has peers as fragile as legacy ones, which share no code
with the rest.
"""

from __future__ import annotations

from gateways.wc2ec.hq import Wc2EcHq
from gateways.wc2ec.messages import Wc2EcDialect, codecs
from gateways.wc2ec.options import Wc2EcHqOptions, Wc2EcOptions
from gateways.wc2ec.session import NO_DEVICE
from gateways.wc2ec.translate import NAME, Wc2EcRobot
from zbridge.protocol import Advice, ConfigError, HqSimulation, Protocol, Simulation

TEMPLATE = """\
[device]
protocol = "wc2ec"
connect = ["tcp://127.0.0.1:27015"]     # the Webots controller: one port per robot

[device.options]
dialect = "deployed"                    # what programs in the field speak; "draft": the document's, without names
motor_types = { rotational = [53], linear = [46] }  # type bytes that are motors; they move with the Webots version
# motors = { rotational = ["wheel1"], linear = [] }  # names that are motors, whatever their type byte
# bounds_default = [0.0, 1000.0]        # readings outside are faults; these bounds are the legacy application's
# bounds = { front = [-1.0, 5000.0] }   # bounds of single sensors, in place of bounds_default
# tables = { front = [[0.0, 1.0], [1000.0, 0.02]] }  # from a sensor's value to metres (or irradiance), interpolated
# bearings_deg = { front = 0.0, left = 90.0 }  # directions of distance sensors, counter-clockwise: they make a scan
# scan_range_m = [0.0, 10.0]            # least and most distance that the scan reports
# devices = [{ name = "light0", number = 0 }]  # draft only: the devices there are, kind = "light" by default
# pinned = ["light0"]                   # draft only: sensors that measure though nobody listens
# values = 3                            # draft only: configuration values of a sensor

# [device.options.differential]         # how a drive moves it; or factors = { motor = { forward = 10.0, turn = -3.0 } }
# left = ["left wheel"]
# right = ["right wheel"]
# wheel_radius_m = 0.05
# track_m = 0.3
# speed_full_m_s = 0.5                  # over ground at a drive of 1
# turn_full_rad_s = 1.0
"""
HQ_TEMPLATE = """\
protocol = "wc2ec"
listen = "tcp://127.0.0.1:27016"
[hq.options]
dialect = "deployed"                    # what controllers in the field speak; "draft": the document's, without names
hold = true                             # repeat what a controller set once while its connection lives: one that hangs
                                        # keeps the robot moving; false: it must set values twice a second
join_s = 0.03                           # a controller sets "left" and "right" one after the other: what it sets within
                                        # this time is one drive; a stop never waits
sectors = 8                             # a scan is shown as so many distance sensors, sector0 ahead, counter-clockwise
sector_unit_m = 1.0                     # what their value 1 is in metres
distance_type = 37                      # type byte of distance sensors; it moves with the Webots version
rotational_type = 53                    # type byte of rotational motors; it moves with the Webots version
linear_type = 46                        # type byte of linear motors; it moves with the Webots version
# devices = [{ name = "light0", number = 0 }]  # draft only: the sensors there are, by their names on the bus
values = 3                              # draft only: configuration values of a sensor

[hq.options.wheels]                     # the motors "left" and "right" of a robot that has none of its own
wheel_radius_m = 0.05
track_m = 0.3
speed_full_m_s = 0.5                    # over ground at a drive of 1
turn_full_rad_s = 1.0
"""
SIMULATED = {
    "bounds_default": [0.0, 1000.0],
    "differential": {"left": ["left wheel"], "right": ["right wheel"], "wheel_radius_m": 0.05, "track_m": 0.3},
    "tables": {f"ds{number}": [[0.0, 0.0], [1000.0, 1.0]] for number in range(8)},
    "bearings_deg": {f"ds{number}": 45.0 * number for number in range(8)},
    "scan_range_m": [0.02, 1.0],
}


def _dialect(name: str | None) -> Wc2EcDialect:
    try:
        return Wc2EcDialect(name or "deployed")
    except ValueError:
        names = ", ".join(dialect.value for dialect in Wc2EcDialect)
        raise ConfigError(f"dialect {name!r}: expected one of {names}") from None


async def _simulate(simulation: Simulation) -> None:
    if simulation.version is not None or simulation.udp:
        raise ConfigError("a Webots robot has no versions and no datagrams")
    if len(simulation.addresses) > 1:
        raise ConfigError("a Webots robot has one link")
    dialect = _dialect(simulation.dialect)
    if simulation.fragile:
        from gateways.wc2ec.conformance.fragile_robot import FragileWebotsController

        controller = FragileWebotsController(dialect.value, seed=simulation.seed)
        await controller.simulate(simulation.addresses, simulation.ready)
    else:
        from gateways.wc2ec.simulator import ControllerSimulator

        await ControllerSimulator(simulation.seed, dialect).run(simulation)


async def _simulate_hq(simulation: HqSimulation) -> None:
    from gateways.wc2ec.conformance.fragile_hq import FragileExternalController

    if simulation.version is not None or simulation.udp:
        raise ConfigError("external controllers have no versions and no datagrams")
    dialect, address = _dialect(simulation.dialect), simulation.address
    await FragileExternalController(dialect=dialect.value).simulate(address.host, address.port, simulation.drive)


PROTOCOL = Protocol(
    name=NAME,
    summary="WC2EC: Webots robots, by their controller program",
    options=Wc2EcOptions,
    links=1,
    robot=Wc2EcRobot,
    simulate=_simulate,
    simulated=SIMULATED,
    hq=Wc2EcHq,
    hq_options=Wc2EcHqOptions,
    simulate_hq=_simulate_hq,
    template=TEMPLATE,
    codecs=codecs(),
    hq_template=HQ_TEMPLATE,
    advice=(
        Advice(
            NO_DEVICE,
            "no_device",
            "the robot accepts the connection and registers no device: no Webots controller program answers there, or"
            " one of the other dialect",
            "start the controller anew (it serves one connection for each start), and check options.dialect",
        ),
    ),
)
