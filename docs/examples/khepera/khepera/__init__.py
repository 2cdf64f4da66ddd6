"""Khepera: a small robot with two wheels, eight proximity sensors and LEDs, on a serial line or TCP."""

from __future__ import annotations

from khepera.messages import codecs
from khepera.translate import KheperaRobot, Options
from zbridge.errors import ConfigError
from zbridge.protocol.plugin import Protocol, Simulation

TEMPLATE = """\
[device]
protocol = "khepera"
connect = ["serial:///dev/ttyUSB0?baud=57600"]   # or ["tcp://127.0.0.1:4000"]

[device.options]
speed_full_m_s = 0.5                    # over ground at a drive of 1
turn_full_rad_s = 3.0
track_m = 0.053                         # between the wheels
"""


async def _simulate(simulation: Simulation) -> None:
    from khepera.simulator import simulate  # only who simulates needs sockets

    if simulation.version or simulation.dialect or simulation.udp or simulation.fragile:
        raise ConfigError("a Khepera has no versions, dialects or datagrams, and no fragile robot")
    await simulate(simulation)


PROTOCOL = Protocol(
    name="khepera",
    summary="Khepera: two wheels, eight proximity sensors",
    options=Options,
    links=1,
    robot=KheperaRobot,
    simulate=_simulate,
    template=TEMPLATE,
    codecs=codecs,
)
