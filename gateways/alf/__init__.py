"""ALF: a vehicle with a laser scanner, in the document's binary form or the field's text form.

``messages`` declares the five messages for both dialects; ``session`` holds the conversation in both roles;
``translate`` is the device side, ``hq`` the HQ side. ``simulator`` is a simulated vehicle; ``conformance`` has peers as
fragile as legacy ones, which share no code with the rest.
"""

from __future__ import annotations

from gateways.alf.hq import AlfHq, AlfHqOptions
from gateways.alf.messages import AlfDialect, codecs
from gateways.alf.translate import NAME, AlfOptions, AlfRobot
from zbridge.protocol import ConfigError, HqSimulation, Protocol, Simulation

LINKS = 2

TEMPLATE = """\
[device]
protocol = "alf"
connect = ["tcp://127.0.0.1:6666"]      # the vehicle; or its drive server, then its laser server

[device.options]
dialect = "text"                        # what vehicles in the field speak; "binary": the document's packed fields
points = 769                            # points of a measurement; binary framing depends on it
points_from_scanner = false             # reckon them from scanner init instead (the legacy scanner's is wrong)
speed_full = 100                        # the speed that is full scale
# acceleration_m_s2 = 9.80665           # one unit of acceleration; left out: 1 g in text, 0.001 g in binary
# gyro_rad_s = 0.017453292519943295     # one unit of gyro; left out: 1 degree/s in text, 0.1 in binary
gap_s = 0.0                             # least time between two messages
"""
HQ_TEMPLATE = """\
protocol = "alf"
listen = "tcp://127.0.0.1:6667"
[hq.options]
dialect = "text"                        # what programs in the field speak; "binary": the document's packed fields
serve = "auto"                          # 1 and 2 until a client sends its first 3, from then on 4 and no 1; or always
                                        # "drive", "laser", "both": no legacy program tolerates both
points = 769                            # points of a measurement; scans of another number are resampled by angle
# acceleration_m_s2 = 9.80665           # one unit of acceleration; left out: 1 g in text, 0.001 g in binary
# gyro_rad_s = 0.017453292519943295     # one unit of gyro; left out: 1 degree/s in text, 0.1 in binary
gap_s = 0.0                             # least time between two messages
"""


def _dialect(name: str | None) -> AlfDialect:
    try:
        return AlfDialect(name or "text")
    except ValueError:
        names = ", ".join(dialect.value for dialect in AlfDialect)
        raise ConfigError(f"dialect {name!r}: expected one of {names}") from None


async def _simulate(simulation: Simulation) -> None:
    if simulation.version is not None or simulation.udp:
        raise ConfigError("an ALF vehicle has no versions and no datagrams")
    if len(simulation.addresses) > LINKS:
        raise ConfigError(f"an ALF vehicle has at most {LINKS} links")
    dialect = _dialect(simulation.dialect)
    if simulation.fragile:
        from gateways.alf.conformance.fragile_robot import fragile_vehicle

        links = len(simulation.addresses)
        first, *others = fragile_vehicle(dialect.value, servers=links, seed=simulation.seed)
        await first.simulate(simulation.addresses, simulation.ready, *others)
    else:
        from gateways.alf.simulator import VehicleSimulator

        await VehicleSimulator(simulation.seed, dialect, len(simulation.addresses)).run(simulation)


async def _simulate_hq(simulation: HqSimulation) -> None:
    from gateways.alf.conformance.fragile_hq import FragileAlfHq

    if simulation.version is not None or simulation.udp:
        raise ConfigError("ALF HQ programs have no versions and no datagrams")
    dialect, address = _dialect(simulation.dialect), simulation.address
    # What the listener is configured to serve is not known here.
    hq = FragileAlfHq(dialect=dialect.value, serves="both", deployed="driving")
    await hq.simulate(address.host, address.port, simulation.drive)


PROTOCOL = Protocol(
    name=NAME,
    summary="ALF: a vehicle with a laser scanner",
    options=AlfOptions,
    links=LINKS,
    robot=AlfRobot,
    simulate=_simulate,
    hq=AlfHq,
    hq_options=AlfHqOptions,
    simulate_hq=_simulate_hq,
    template=TEMPLATE,
    codecs=codecs(),
    hq_template=HQ_TEMPLATE,
    plausible={"motion.temperature": (-40.0, 125.0)},
)
