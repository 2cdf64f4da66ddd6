"""Both recorded sessions through the sessions of both roles, each segment and datagram at its recorded time."""

from gateways.tcpudp.messages import (
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientSimulatedLidarData,
    DebugMessage,
    Packet,
    ServerGetSimulatedLidarData,
    ServerPosition,
    ServerSLAMMap,
)
from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import RobotSettings13, Settings
from tests.captures import payloads
from tests.gateways.tcpudp.frames import Timed
from zbridge.protocol.session import State

OLD, NEW = "tcpudp-1.1-tcp.hex", "tcpudp-1.3-udp.hex"
ROBOT = 11001
POSE = ServerPosition(1.5, -2.25, 90.0)
MAP = ServerSLAMMap(bytes((0, 1, 2) * 133 + (0,)))
MOVE = ClientJoystickMove(0.6000000238418579, 0.800000011920929, 1.5)
COMMANDS: list[Packet] = [
    DebugMessage("hi there"),
    ClientControllMode(2),
    MOVE,
    ClientJoystickRotate(-0.75),
    ClientJoystickStop(),
    ClientGetPosition(),
    ClientGetSLAMMap(),
]


def replay(timed: Timed, name: str, *, from_robot: bool) -> list[tuple[float, Packet]]:
    """Feed what one side sent; return each message with the time it was delivered."""
    delivered: list[tuple[float, Packet]] = []
    for record in payloads(name, source=ROBOT) if from_robot else payloads(name, destination=ROBOT):
        if record.transport == "TCP":
            messages = timed.stream(record.payload, record.seconds)
        else:
            if record.payload[5] == 5:
                assert timed.session.claims(record.payload, record.source)
            messages = timed.datagram(record.payload, record.seconds)
        delivered += [(record.seconds, message) for message in messages]
    assert timed.session.traffic.malformed == 0
    return delivered


def recorded(name: str, index: int, *, from_robot: bool) -> bytes:
    """The payload of one record of a side."""
    return (payloads(name, source=ROBOT) if from_robot else payloads(name, destination=ROBOT))[index].payload


def test_the_gateway_as_hq_understands_a_robot_of_1_1() -> None:
    timed = Timed(HqRole(limits(0.01)))
    delivered = replay(timed, OLD, from_robot=True)
    assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, "1.1")
    assert (timed.session.transport, timed.session.features) == ("tcp", ())
    assert timed.frames("tcp") == [bytes.fromhex("0e000000 01 03 03000000 312e31 0000000000")]
    assert timed.frames("udp") == []
    assert delivered == [(6.4158, POSE), (6.7163, ServerSLAMMap()), (7.0166, DebugMessage("bye"))]


def test_the_gateway_as_robot_of_1_1_understands_its_hq() -> None:
    timed = Timed(RobotRole(limits(0.0), Settings(), 1, ("1.1",)))
    delivered = replay(timed, OLD, from_robot=False)
    assert timed.frames("tcp") == [recorded(OLD, 0, from_robot=True)]
    assert timed.frames("udp") == []
    assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, "1.1")
    assert (timed.session.transport, timed.session.features) == ("tcp", ("udp",))
    times = [4.1193, 4.4285, 4.7242, 5.0322, 5.3240, 5.6314, 5.9225]
    assert delivered == list(zip(times, COMMANDS, strict=True))


def test_the_gateway_as_hq_understands_a_robot_of_1_3() -> None:
    timed = Timed(HqRole(limits(0.01)))
    delivered = replay(timed, NEW, from_robot=True)
    assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, "1.3")
    assert (timed.session.transport, timed.session.features) == ("udp", ("udp", "lidar_sim", "slam_map"))
    assert timed.frames("tcp") == [recorded(NEW, 0, from_robot=False), bytes.fromhex("03000000 01 07 01")]
    assert timed.frames("udp") == [bytes.fromhex("02000000 01 05")]
    assert delivered == [
        (5.6253, POSE),
        (5.9346, MAP),
        (6.1171, ServerGetSimulatedLidarData()),
        (6.4174, POSE),
        (6.7181, MAP),
        (7.0182, DebugMessage("bye")),
    ]


def test_the_gateway_as_robot_of_1_3_understands_its_hq() -> None:
    announced = RobotSettings13(udp=True, lidar_sim=True, slam_map=True, slam_map_size=2048, slam_map_interval=1)
    timed = Timed(RobotRole(limits(0.0), announced, 1))
    delivered = replay(timed, NEW, from_robot=False)
    assert timed.frames("tcp") == [recorded(NEW, 0, from_robot=True), bytes.fromhex("02000000 01 04")]
    assert timed.frames("udp") == [bytes.fromhex("03000000 01 06 01")]
    assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, "1.3")
    assert (timed.session.transport, timed.session.features) == ("udp", ("udp", "lidar_sim"))
    *others, (at, scan) = delivered
    times = [4.1288, 4.4204, 4.7293, 5.0221, 5.3328, 5.6252, 5.9344]
    assert others == list(zip(times, COMMANDS, strict=True))
    assert isinstance(scan, ClientSimulatedLidarData)
    assert at == 6.1298
    assert scan.ranges.tolist() == [100.0 + degree / 2 for degree in range(360)]
