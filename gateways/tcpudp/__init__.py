"""The TCP/UDP package protocol: an HQ program with a joystick, a lidar, a SLAM map.

``messages`` declares the packets, ``settings`` the settings blocks and versions; ``session`` holds the conversation in
both roles; ``translate`` and ``telemetry`` are the device side, ``hq``, ``hq_client`` and ``maps`` the HQ side,
``options`` the options of both. ``simulator`` is a simulated robot; ``conformance`` has peers as fragile as legacy
ones, which share no code with the rest.
"""

from __future__ import annotations

from gateways.tcpudp.advice import ADVICE
from gateways.tcpudp.hq import TcpUdpHq
from gateways.tcpudp.messages import codecs
from gateways.tcpudp.options import NAME, TcpUdpHqOptions, TcpUdpOptions
from gateways.tcpudp.settings import HQ_BLOCKS, VERSIONS
from gateways.tcpudp.translate import TcpUdpRobot
from zbridge.protocol import ConfigError, HqSimulation, Protocol, Simulation

TEMPLATE = """\
[device]
protocol = "tcpudp"
connect = ["tcp://127.0.0.1:11001"]     # the robot's address

[device.options]
udp = true                              # use datagrams where the robot offers them and they get through
gap_s = 0.01                            # least time between two packets: robots take one read as one packet
force = []                              # features to use although the robot does not announce them, for
                                        # example ["joystick", "lidar"], and ids of raw packets it knows
announce = ["udp", "lidar_sim"]         # features the gateway announces; without "lidar_sim" a 1.4 robot sends no map
combine = "exclusive"                   # drive that moves and turns: "exclusive" sends the larger, "both" both
speed_full = 1.0                        # packet speed at full scale
turn_full = 1.0                         # packet turn speed at full scale
length_unit_m = 0.01                    # the robot's unit of length in metres
heading_offset = 1.5707963267948966     # added to the robot's heading, radians
map_cell_m = 0.01                       # side of a map cell where the robot does not announce it
# map_origin = [0.0, 0.0]               # x, y of map cell (0, 0) in metres; left out: the map is centred
"""
HQ_TEMPLATE = """\
protocol = "tcpudp"
listen = "tcp://127.0.0.1:11002"        # clients bind UDP 11000, and receive datagrams from this address and port only
[hq.options]
versions = ["1.1", "1.2", "1.3"]        # sent verbatim; programs of 1.1 or 1.2 understand only ["1.1"] or ["1.2"]
udp = true                              # offer datagrams: 1.3 programs drive by nothing else
client_port = 11000                     # the UDP port that programs bind: one whose packet 5 was lost is accepted
                                        # from there alone; 0: from nowhere
gap_s = 0.01                            # least time between two packets: programs take one read as one packet
quiet_s = 2.0                           # time before the id of a client that left is given to another one
known = []                              # packet ids that these programs know besides those of their version
unasked = false                         # maps and positions (53, 55) also to programs of 1.1 that asked for none
                                        # (52, 54): its first ones have no handlers for them
skip_map_flag = false                   # leave out the byte that some 1.3 programs skip, so that they see the map size
slam_map_size = 1000                    # map size announced while the robot's map is unknown, in its unit of length
slam_map_interval = 10                  # cell size announced while the robot's map is unknown
speed_full = 1.0                        # packet speed at full scale
turn_full = 1.0                         # packet turn speed at full scale
length_unit_m = 0.01                    # the programs' unit of length in metres
heading_offset = 1.5707963267948966     # what is subtracted from the robot's heading, radians
# map_origin = [0.0, 0.0]               # x, y of map cell (0, 0) in metres, as the programs take it; left out: centred,
                                        # and a robot of this protocol as its own programs see it
"""


async def _simulate(simulation: Simulation) -> None:
    if len(simulation.addresses) > 1 or simulation.dialect is not None:
        raise ConfigError("a TCP/UDP robot has one link and no dialects")
    if simulation.version is not None and simulation.version not in VERSIONS:
        raise ConfigError(f"version {simulation.version!r}: expected one of {', '.join(VERSIONS)}")
    if simulation.fragile:
        from gateways.tcpudp.conformance.fragile_robot import FragileRobot

        robot = FragileRobot(version=simulation.version or "1.3", udp=simulation.udp, seed=simulation.seed)
        await robot.simulate(simulation.addresses, simulation.ready)
    else:
        from gateways.tcpudp.simulator import RobotSimulator

        await RobotSimulator(simulation.seed, simulation.version or "1.3", udp=simulation.udp).run(simulation)


async def _simulate_hq(simulation: HqSimulation) -> None:
    from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq

    version, address = simulation.version or "1.3", simulation.address
    if simulation.dialect is not None:
        raise ConfigError("TCP/UDP HQ programs have no dialects")
    if version not in HQ_BLOCKS:
        raise ConfigError(f"version {version!r}: expected one of {', '.join(HQ_BLOCKS)}")
    udp = simulation.udp or version == "1.3"  # legacy programs of 1.3 drive by nothing else
    await FragileTcpUdpHq(version=version, udp=udp).simulate(address.host, address.port, simulation.drive)


PROTOCOL = Protocol(
    name=NAME,
    summary="TCP/UDP package protocol: joystick, lidar, SLAM map",
    options=TcpUdpOptions,
    links=1,
    robot=TcpUdpRobot,
    simulate=_simulate,
    hq=TcpUdpHq,
    hq_options=TcpUdpHqOptions,
    simulate_hq=_simulate_hq,
    template=TEMPLATE,
    codecs=codecs(),
    hq_template=HQ_TEMPLATE,
    advice=ADVICE,
)
