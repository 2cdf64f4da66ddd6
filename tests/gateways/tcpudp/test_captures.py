"""Both recorded sessions through the sessions of both roles, each segment and datagram at its recorded time."""

import pytest

from gateways.tcpudp.messages import Packet
from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import RobotSettings13, Settings
from tests.captures import payloads
from tests.conformance.side import plain
from tests.gateways.tcpudp.frames import Timed
from tests.gateways.tcpudp.golden import TCP_SESSION_MESSAGES, UDP_SESSION_MESSAGES
from zbridge.protocol.session import State

OLD, NEW = "tcpudp-1.1-tcp.hex", "tcpudp-1.3-udp.hex"
MESSAGES = {OLD: TCP_SESSION_MESSAGES, NEW: UDP_SESSION_MESSAGES}
ROBOT = 11001
SETTINGS_13 = RobotSettings13(udp=True, lidar_sim=True, slam_map=True, slam_map_size=2048, slam_map_interval=1)
ANSWER_11 = bytes.fromhex("0e000000 01 03 03000000 312e31 0000000000")
"""What the gateway answers a robot of 1.1; the captured HQ announces datagrams and sends none."""


def recorded(name: str, index: int, *, from_robot: bool) -> bytes:
    """The payload of one record of a side."""
    return (payloads(name, source=ROBOT) if from_robot else payloads(name, destination=ROBOT))[index].payload


@pytest.mark.parametrize(
    ("session", "name", "by_tcp", "by_udp", "outcome", "times"),
    [
        pytest.param(
            HqRole(limits(0.01)),
            OLD,
            [ANSWER_11],
            [],
            ("1.1", "tcp", ()),
            [6.4158, 6.7163, 7.0166],
            id="hq of a robot of 1.1",
        ),
        pytest.param(
            RobotRole(limits(0.0), Settings(), 1, ("1.1",)),
            OLD,
            [recorded(OLD, 0, from_robot=True)],
            [],
            ("1.1", "tcp", ("udp",)),
            [4.1193, 4.4285, 4.7242, 5.0322, 5.3240, 5.6314, 5.9225],
            id="robot of 1.1",
        ),
        pytest.param(
            HqRole(limits(0.01)),
            NEW,
            [recorded(NEW, 0, from_robot=False), bytes.fromhex("03000000 01 07 01")],
            [bytes.fromhex("02000000 01 05")],
            ("1.3", "udp", ("udp", "lidar_sim", "slam_map")),
            [5.6253, 5.9346, 6.1171, 6.4174, 6.7181, 7.0182],
            id="hq of a robot of 1.3",
        ),
        pytest.param(
            RobotRole(limits(0.0), SETTINGS_13, 1),
            NEW,
            [recorded(NEW, 0, from_robot=True), bytes.fromhex("02000000 01 04")],
            [bytes.fromhex("03000000 01 06 01")],
            ("1.3", "udp", ("udp", "lidar_sim")),
            [4.1288, 4.4204, 4.7293, 5.0221, 5.3328, 5.6252, 5.9344, 6.1298],
            id="robot of 1.3",
        ),
    ],
)
def test_the_gateway_in_either_role_understands_the_recorded_peer(
    session: HqRole | RobotRole,
    name: str,
    by_tcp: list[bytes],
    by_udp: list[bytes],
    outcome: tuple[str, str, tuple[str, ...]],
    times: list[float],
) -> None:
    from_robot = isinstance(session, HqRole)
    timed = Timed(session)
    delivered: list[tuple[float, Packet]] = []
    expected = []
    for record, message in zip(payloads(name), MESSAGES[name], strict=True):
        if from_robot != (record.source == ROBOT):
            continue
        if record.transport == "UDP" and record.payload[5] == 5:
            assert session.claims(record.payload, record.source)
        receive = timed.stream if record.transport == "TCP" else timed.datagram
        delivered += [(record.seconds, message) for message in receive(record.payload, record.seconds)]
        if record.payload[5] not in range(2, 8):  # the handshake
            expected.append(plain(message))
    assert [plain(message) for _, message in delivered] == expected
    assert [at for at, _ in delivered] == times
    assert timed.frames("tcp") == by_tcp
    assert timed.frames("udp") == by_udp
    assert session.state is State.ESTABLISHED
    assert (session.version, session.transport, session.features) == outcome
    assert session.traffic.malformed == 0
