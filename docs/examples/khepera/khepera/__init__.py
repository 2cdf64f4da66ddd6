"""Khepera: a small robot with two wheels, eight proximity sensors and LEDs, on a serial line or TCP."""

from zbridge.fleet.messages import Drive
from zbridge.protocol import Codec, Example, Protocol, Simulation

from khepera.messages import LINES, Positions, Proximity, SetLed, SetSpeeds, Speeds, Version
from khepera.translate import KheperaRobot, Options

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


MANUAL = "Khepera manual, appendix A"
EXAMPLES = (
    Example("lines", b"D,10,-10\n", SetSpeeds(10, -10), source=MANUAL),
    Example("lines", b"D,25,25\n", SetSpeeds(25, 25), command=Drive(forward=0.4), source="25 * 8 mm/s is 0.2 m/s"),
    Example("lines", b"L,0,1\n", SetLed(0, 1), source=MANUAL),
    Example("lines", b"b,5,1\n", Version(5, 1), source=MANUAL),
    Example("lines", b"e,25,25\n", Speeds(25, 25), {"motion.speed": 0.4}, source=MANUAL),
    Example("lines", b"h,-100,2147483647\n", Positions(-100, 2**31 - 1), source=MANUAL),
    Example("lines", b"h,12500,12500\n", Positions(12500, 12500), {"pose.x": 1.0}, before=(b"h,0,0\n",), source=MANUAL),
    Example("lines", b"D,-3,3\n", SetSpeeds(-3, 3), command=Drive(turn=1.0), source="1 rad/s * 26.5 mm is 26.5 mm/s"),
    Example("lines", b"n,0,1,2,3,4,5,6,1023\n", Proximity(0, 1, 2, 3, 4, 5, 6, 1023), source=MANUAL),
)

PROTOCOL = Protocol(
    name="khepera",
    summary="Khepera: two wheels, eight proximity sensors",
    options=Options,
    links=1,
    robot=KheperaRobot,
    simulate=_simulate,
    template=TEMPLATE,
    codecs=(Codec("lines", LINES.write, LINES.read, LINES.end, LINES.messages),),
    examples=EXAMPLES,
)
