"""Both recorded sessions through the sessions of both roles, each segment and datagram at its recorded time."""

import pytest

from gateways.tcpudp.session import limits
from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.session.robot_role import RobotRole
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
SETTINGS = {OLD: Settings(), NEW: SETTINGS_13}


HQ_OLD, HQ_NEW = HqRole(limits(0.01)), HqRole(limits(0.01))
ROBOT_OLD, ROBOT_NEW = RobotRole(limits(0.0), Settings(), 1, ("1.1",)), RobotRole(limits(0.0), SETTINGS_13, 1)
FROM_HQ, FROM_ROBOT = payloads(NEW, destination=ROBOT), payloads(NEW, source=ROBOT)
ANSWER_11 = bytes.fromhex("0e000000 01 03 03000000 312e31 0000000000")
"""Ours; the captured HQ announces datagrams and sends none."""


@pytest.mark.parametrize(
    ("session", "name", "first", "said", "outcome"),
    [
        (HQ_OLD, OLD, ANSWER_11, ["tcp 3"], ("1.1", "tcp", ())),
        (ROBOT_OLD, OLD, payloads(OLD, source=ROBOT)[0].payload, ["tcp 2"], ("1.1", "tcp", ("udp",))),
        (
            HQ_NEW,
            NEW,
            FROM_HQ[0].payload,
            ["tcp 3", "udp 5", "tcp 7"],
            ("1.3", "udp", ("udp", "lidar_sim", "slam_map")),
        ),
        (ROBOT_NEW, NEW, FROM_ROBOT[0].payload, ["tcp 2", "tcp 4", "udp 6"], ("1.3", "udp", ("udp", "lidar_sim"))),
    ],
    ids=["hq of a robot of 1.1", "robot of 1.1", "hq of a robot of 1.3", "robot of 1.3"],
)
def test_the_gateway_in_either_role_understands_the_recorded_peer(session, name, first, said, outcome) -> None:
    timed = Timed(session)
    messages = iter(MESSAGES[name])
    for record in payloads(name):
        expected = [] if record.payload[5] in range(2, 8) else [plain(next(messages))]  # the handshake
        if isinstance(session, HqRole) != (record.source == ROBOT):
            continue
        if record.transport == "UDP" and record.payload[5] == 5:
            assert session.claims(record.payload, record.source)
        receive = timed.stream if record.transport == "TCP" else timed.datagram
        assert [plain(message) for message in receive(record.payload, record.seconds)] == expected
    assert timed.sent[0].frame == first
    assert [f"{sent.by} {sent.frame[5]}" for sent in timed.sent] == said
    assert (session.version, session.transport, session.features) == outcome
    assert (session.state, session.traffic.malformed) == (State.ESTABLISHED, 0)
    assert session.settings == SETTINGS[name]
