"""ARCOS: Pioneer robots of MobileRobots; two wheels, sonars and bumpers, on a serial line or TCP."""

from zbridge.fleet.messages import Drive
from zbridge.protocol import Codec, Example, Protocol, Simulation

from arcos.messages import PACKETS, Command, Do, Report, Setting, Sonar, Synced, read, read_command, write
from arcos.translate import ArcosRobot, Options

TEMPLATE = """\
[device]
protocol = "arcos"
connect = ["serial:///dev/ttyUSB0?baud=9600"]    # or ["tcp://192.168.1.11:8101"]

[device.options]
speed_full_m_s = 0.5                    # over ground at a drive of 1
turn_full_rad_s = 1.0
track_m = 0.33                          # between the wheels
sonars = 16                             # 8: at the front only
"""
MANUAL = "ARCOS manual"
VEL_FRAME, RVEL_FRAME = bytes.fromhex("FAFB 06 0B 3BC800 D33B"), bytes.fromhex("FAFB 06 15 1B3900 4E1B")
REPORT = Report(0x33, 1000, -500, 1024, 200, 200, 125, 0x0402, 0, 1, 0, (Sonar(3, 850),), bytes(5))
REPORT_FRAME = bytes.fromhex("FAFB 1E 33 E803 0CFE 0004 C800 C800 7D 0204 0000 0100 00 01035203 0000000000 4458")
SHOWN = {"battery.voltage": 12.5, "motion.speed": 0.4, "sensor/sonar3.value": 0.85, "sensor/bumper-front2.value": 1.0}


async def _simulate(simulation: Simulation) -> None:
    from arcos.simulator import simulate  # imported here: only a simulation needs sockets

    await simulate(simulation)


PROTOCOL = Protocol(
    name="arcos",
    summary="ARCOS: Pioneer robots with sonars and bumpers",
    options=Options,
    links=1,
    robot=ArcosRobot,
    simulate=_simulate,
    template=TEMPLATE,
    codecs=(
        Codec("commands", write, read_command, PACKETS.end, (Command(Do.PULSE), Setting.of(Do.VEL, -200))),
        Codec("answers", write, read, PACKETS.end, (Synced(1), Synced(2, b"Robby\0Pioneer\0p3dx\0"), REPORT)),
    ),
    examples=(
        Example("commands", bytes.fromhex("FAFB 03 00 0000"), Command(Do.PULSE), source=MANUAL),
        Example("commands", bytes.fromhex("FAFB 06 04 3B0100 053B"), Setting.of(Do.ENABLE, 1), source=MANUAL),
        Example("commands", VEL_FRAME, Setting.of(Do.VEL, 200), command=Drive(forward=0.4), source=MANUAL),
        Example("commands", RVEL_FRAME, Setting.of(Do.RVEL, -57), command=Drive(turn=-1.0), source=MANUAL),
        Example("answers", bytes.fromhex("FAFB 03 01 0001"), Synced(1), source=MANUAL),
        Example("answers", REPORT_FRAME, REPORT, SHOWN, source=MANUAL),
    ),
    plausible={"battery.voltage": (9.0, 15.0), "sensor/sonar*.value": (0.0, 5.0), "sensor/bumper*.value": (0.0, 1.0)},
)
