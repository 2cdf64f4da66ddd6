"""Khepera: a small robot with two wheels, eight proximity sensors and LEDs, on a serial line or TCP."""

from khepera.messages import LINES
from khepera.translate import KheperaRobot, Options
from zbridge.protocol import Codec, Protocol, Simulation

TEMPLATE = """\
[device]
protocol = "khepera"
connect = ["serial:///dev/ttyUSB0?baud=57600"]   # or ["tcp://127.0.0.1:4000"]

[device.options]
speed_full_m_s = 0.5                    # over ground at a drive of 1
turn_full_rad_s = 1.0
track_m = 0.053                         # between the wheels
"""


async def _simulate(simulation: Simulation) -> None:
    from khepera.simulator import simulate  # imported here: only a simulation needs sockets

    await simulate(simulation)


PROTOCOL = Protocol(
    name="khepera",
    summary="Khepera: two wheels, eight proximity sensors",
    options=Options,
    links=1,
    robot=KheperaRobot,
    simulate=_simulate,
    template=TEMPLATE,
    codecs=(Codec("lines", LINES.write, LINES.read, LINES.end, LINES.messages),),
)
