"""The version table of the protocol page, row by row and in both roles."""

import contextlib

import msgspec
import numpy as np
import pytest

from gateways.tcpudp.messages import (
    PACKETS,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientSimulatedLidarData,
    OpaquePacket,
    Packet,
)
from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import RobotSettings13, Settings, Settings12
from gateways.tcpudp.translate import Options, TcpUdpRobot
from tests.gateways.tcpudp.frames import (
    ALL,
    LISTED,
    NO_UDP,
    SIZE_100_10,
    Timed,
    client_settings,
    counted,
    framed,
    server_settings,
)
from zbridge.errors import Refused
from zbridge.protocol.session import State

LISTED_14 = LISTED + b",1.4"


def hq(versions: bytes, block: str, *, udp: bool = True) -> Timed:
    timed = Timed(HqRole(limits(0.01), udp=udp))
    timed.stream(server_settings(versions, block), 0.1)
    return timed


# The gateway as HQ: what the robot sends, what it understands, what is agreed.
# Rows: list of the robot, its block, list of our answer, block of our answer, version, features.

ROWS = [
    pytest.param(b"1.1", "0001010101", b"1.1", "0000000000", "1.1", "cam joystick chat lidar", id="robot 1.1"),
    pytest.param(b"1.1", "0000000000", b"1.1", "0000000000", "1.1", "", id="robot 1.1 with nothing"),
    pytest.param(b"1.2", "000001000001", b"1.2", "000000000001", "1.2", "joystick lidar_sim", id="robot 1.2"),
    pytest.param(
        LISTED, "00000100000001" + SIZE_100_10, LISTED, "00000000000100", "1.3", "joystick slam_map", id="robot 1.3"
    ),
    pytest.param(
        LISTED_14,
        "00000000010101" + SIZE_100_10,
        LISTED,
        "00000000000100",
        "1.4",
        "lidar lidar_sim slam_map",
        id="robot 1.4",
    ),
    # Odd lists: robots of 1.1 and 1.2 understand nothing but their own list, those of 1.3 and "1.4" the safe one.
    pytest.param(b"1.1,1.2", "000001000001", b"1.1,1.2", "000000000001", "1.2", "joystick lidar_sim", id="1.1 and 1.2"),
    pytest.param(b"1.2,1.1", "000000000001", b"1.2,1.1", "000000000001", "1.2", "lidar_sim", id="1.2 before 1.1"),
    pytest.param(b"1.3", "00000000000001" + SIZE_100_10, LISTED, "00000000000100", "1.3", "slam_map", id="1.3 alone"),
    pytest.param(b"1.4", "00000000000001" + SIZE_100_10, LISTED, "00000000000100", "1.4", "slam_map", id="1.4 alone"),
    pytest.param(b"1.3,1.2,1.1", "00" * 6 + "01" + SIZE_100_10, LISTED, "00000000000100", "1.3", "slam_map", id="down"),
    pytest.param(b"2.0,1.3", "00" * 6 + "01" + SIZE_100_10, LISTED, "00000000000100", "1.3", "slam_map", id="2.0, 1.3"),
    pytest.param(b" 1.1 , 1.2 ", "000000000001", b" 1.1 , 1.2 ", "000000000001", "1.2", "lidar_sim", id="spaces"),
    pytest.param(b"1.1,1.1", "0000000001", b"1.1,1.1", "0000000000", "1.1", "lidar", id="duplicates"),
    pytest.param(b",1.1,", "0000000001", b",1.1,", "0000000000", "1.1", "lidar", id="empty entries"),
    pytest.param(b"beta,1.2", "000000000001", b"beta,1.2", "000000000001", "1.2", "lidar_sim", id="a word"),
]


@pytest.mark.parametrize(("listed", "block", "answer", "answered", "version", "features"), ROWS)
def test_a_robot_is_answered_with_what_it_understands_and_with_udp_unless_either_switches_it_off(
    listed: bytes, block: str, answer: bytes, answered: str, version: str, features: str
) -> None:
    plain = framed(5, 3, counted(answer) + bytes.fromhex(answered))
    with_udp = framed(5, 3, counted(answer) + bytes.fromhex("01" + answered[2:]))
    neither, ours_off = hq(listed, block), hq(listed, "01" + block[2:], udp=False)
    for timed, announced in ((neither, features.split()), (ours_off, ["udp", *features.split()])):
        assert timed.frames("tcp") == [plain]
        assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, version)
        assert timed.session.features == tuple(announced)
        assert timed.session.traffic.malformed == 0
    assert hq(listed, "01" + block[2:]).frames("tcp") == [with_udp]


@pytest.mark.parametrize("listed", [b"", b"2.0", b"1.0", b"1", b"1.10", b"1.1.0", b"v1.1", b"1,1", b"1.1;1.2", b",,"])
def test_a_robot_without_a_common_version_is_told_reported_and_left(listed: bytes) -> None:
    timed = hq(listed, "01" * 7 + SIZE_100_10)
    timed.until(1.0)
    text = f"no common version: the peer speaks {listed.decode()!r}, this gateway 1.1, 1.2, 1.3, 1.4"
    assert timed.frames("tcp") == [framed(5, 1, counted(text.encode()))]
    assert timed.frames("udp") == []
    assert timed.session.state is State.CLOSED
    assert timed.session.reason == text
    assert timed.session.version is None


def test_a_version_list_that_cannot_be_answered_does_no_harm() -> None:
    timed = hq(b"1.1," + b"9" * 5000, "0001010101")
    timed.until(10.0)
    assert timed.session.state is State.CLOSED


@pytest.mark.parametrize(
    ("listed", "block"), [(b"1.1", "00000000"), (b"1.2", "0000000000"), (LISTED, "00" * 14), (LISTED_14, "00" * 7)]
)
def test_a_settings_block_that_is_too_short_for_its_version_is_malformed(listed: bytes, block: str) -> None:
    timed = hq(listed, block)
    assert timed.session.traffic.malformed == 1
    assert timed.sent == []
    assert timed.session.state is State.HANDSHAKING


# What is announced, as far as the block that the robot understands has a flag for it


@pytest.mark.parametrize(
    ("announce", "listed", "block", "answered"),
    [
        ((), LISTED, ALL + SIZE_100_10, "00000000000000"),
        (("udp",), LISTED, ALL + SIZE_100_10, "01000000000000"),
        (("lidar_sim",), LISTED, ALL + SIZE_100_10, "00000000000100"),
        (
            ("udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"),
            LISTED,
            ALL + SIZE_100_10,
            "01010101010101",
        ),
        (("cam", "slam_map"), LISTED_14, ALL + SIZE_100_10, "00010000000001"),
        (("cam", "lidar_sim", "slam_map"), b"1.2", ALL[:12], "000100000001"),
        (("chat", "lidar_sim", "slam_map"), b"1.1", ALL[:10], "0000000100"),
        (("udp", "chat"), LISTED, NO_UDP + SIZE_100_10, "00000001000000"),  # a robot without datagrams: none of ours
    ],
)
def test_the_gateway_announces_what_it_is_told(announce, listed, block, answered) -> None:
    timed = Timed(TcpUdpRobot(msgspec.convert({"announce": announce}, Options)).session("robot", ""))
    timed.stream(server_settings(listed, block), 0.1)
    answer = LISTED if listed == LISTED_14 else listed
    assert timed.frames("tcp") == [framed(5, 3, counted(answer) + bytes.fromhex(answered))]
    if "udp" not in announce or block[:2] == "00":
        assert timed.session.state is State.ESTABLISHED
        timed.until(10.0)
        assert timed.frames("udp") == [], "it neither waits for datagrams nor sends any"


@pytest.mark.parametrize("announce", [["lidarsim"], [50], "udp"])
def test_a_feature_nobody_knows_cannot_be_announced(announce: object) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"announce": announce}, Options)


# 52 and 54 go by SLAMMap where the version has the flag, else by Lidar; 61 by LidarSim, which 1.1 has not


MAP, POSITION = ClientGetSLAMMap(), ClientGetPosition()
SCAN = ClientSimulatedLidarData(np.zeros(360, np.float32))


@pytest.mark.parametrize(
    ("listed", "block", "messages", "reason"),
    [
        (b"1.1", "0000000001", (MAP, POSITION), None),
        (b"1.1", "0001010100", (MAP, POSITION), "does not announce"),
        (b"1.2", "000000000100", (MAP, POSITION), None),
        (b"1.2", "000101010001", (MAP, POSITION), "does not announce"),
        (LISTED, "00000000000001" + SIZE_100_10, (MAP, POSITION), None),
        (LISTED, "00010101010100" + SIZE_100_10, (MAP, POSITION), "does not announce"),
        (LISTED_14, "00000000000001" + SIZE_100_10, (MAP, POSITION), None),
        (LISTED_14, "00010101010100" + SIZE_100_10, (MAP, POSITION), "does not announce"),
        (b"1.1", "0101010101", (SCAN,), r"version 1\.1 has no lidar_sim"),
        (b"1.2", "000101010100", (SCAN,), "does not announce lidar_sim"),
        (b"1.2", "000000000001", (SCAN,), None),
    ],
)
def test_questions_and_simulated_lidar_data_go_to_robots_that_know_them(listed, block, messages, reason) -> None:
    for message in messages:
        timed = hq(listed, block, udp=False)
        if reason is None:
            timed.session.send(message)
            timed.until(1.0)
            assert [frame[5] for frame in timed.frames("tcp")] == [3, message.spec.id]
        else:
            with pytest.raises(Refused, match=reason):
                timed.session.send(message)


# The gateway as robot

ROBOTS = {
    "1.1": (b"1.1", Settings(cam=True, lidar=True), "0001000001"),
    "1.2": (b"1.2", Settings12(joystick=True, lidar_sim=True), "000001000001"),
    "1.3": (
        LISTED,
        RobotSettings13(chat=True, slam_map=True, slam_map_size=1000, slam_map_interval=10),
        "00000001000001" + SIZE_100_10,
    ),
    "1.4": (
        LISTED_14,
        RobotSettings13(slam_map=True, slam_map_size=1000, slam_map_interval=10),
        "00000000000001" + SIZE_100_10,
    ),
}
HQS = {"1.1": (b"1.1", "0100000000"), "1.2": (b"1.2", "010000000001"), "1.3": (LISTED, "01000000000100")}


def robot(version: str) -> Timed:
    listed, settings, _ = ROBOTS[version]
    return Timed(RobotRole(limits(0.0), settings, 5, listed.decode().split(",")))


@pytest.mark.parametrize("version", ROBOTS)
def test_a_robot_lists_its_versions_to_the_letter_and_announces_their_block(version: str) -> None:
    listed, _, block = ROBOTS[version]
    assert robot(version).frames("tcp") == [server_settings(listed, block)]


@pytest.mark.parametrize(
    ("ours", "theirs", "agreed"),
    [
        ("1.1", HQS["1.1"], "1.1"),
        ("1.1", HQS["1.3"], "1.1"),
        ("1.2", HQS["1.2"], "1.2"),
        ("1.2", HQS["1.3"], "1.2"),
        *((ours, theirs, agreed) for ours in ("1.3", "1.4") for agreed, theirs in HQS.items()),
        # odd lists
        ("1.3", (b" 1.2 , 1.1", "010000000001"), "1.2"),
        ("1.3", (b"1.1,1.1", "0100000000"), "1.1"),
        ("1.3", (b"2.0,1.3", "01000000000100"), "1.3"),
        ("1.3", (b"1.2,1.2.9", "010000000001"), "1.2"),
    ],
)
def test_an_hq_of_any_version_and_a_robot_of_any_version_agree_on_the_highest_common_one(ours, theirs, agreed) -> None:
    timed = robot(ours)
    timed.stream(client_settings(*theirs), 0.1)
    assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, agreed)
    five_flags = len(theirs[1]) == 10
    assert timed.session.features == (("udp",) if five_flags else ("udp", "lidar_sim"))
    assert len(timed.sent) == 1
    assert timed.session.traffic.malformed == 0


@pytest.mark.parametrize(
    ("ours", "theirs"), [("1.1", b"1.2"), ("1.2", b"1.1"), ("1.3", b"2.0"), ("1.4", b""), ("1.3", b"1.3.1")]
)
def test_an_hq_without_a_common_version_is_told_reported_and_left(ours: str, theirs: bytes) -> None:
    timed = robot(ours)
    timed.stream(client_settings(theirs, "01000000000100"), 0.1)
    timed.until(1.0)
    listed = ROBOTS[ours][0].decode().replace(",", ", ")
    text = f"no common version: the peer speaks {theirs.decode()!r}, this gateway {listed}"
    assert timed.frames("tcp")[1:] == [framed(1, 1, counted(text.encode()))]
    assert timed.session.state is State.CLOSED
    assert timed.session.reason == text


KNOWN = {
    "1.1": {1, 2, 4, 6, 51, 53, 55},
    "1.2": {1, 2, 4, 6, 51, 53, 55, 60},
    "1.3": {1, 2, 4, 6, 51, 53, 55, 60},
    "1.4": {1, 2, 4, 6, 51, 53, 55, 56, 60},
}
_FIELDS = {1: ("hi",), 2: (5, "1.1", b""), 6: (True,), 31: (1,), 51: (1,), 53: (b"",), 55: (0, 0, 0), 56: (0, 0, b"")}


def robot_packet(packet_id: int) -> Packet:
    spec = PACKETS.get(packet_id)
    if spec is None or spec.sender.value == "hq":
        return OpaquePacket(packet_id)
    return spec.packet(*_FIELDS.get(packet_id, ()))


@pytest.mark.parametrize("version", KNOWN)
def test_an_hq_is_sent_no_packet_that_its_version_does_not_know(version: str) -> None:
    session = RobotRole(limits(0.0), Settings(), 5, LISTED_14.decode().split(","))
    session.open(0.0)
    session.receive(client_settings(version.encode(), "00000000000000"), 0.1)
    assert session.version == version
    sendable = set()
    for packet_id in range(256):
        with contextlib.suppress(Refused):
            session.may_send(robot_packet(packet_id))
            sendable.add(packet_id)
    assert sendable == KNOWN[version]
    with pytest.raises(Refused, match=f"version {version} does not know packet 31"):
        session.may_send(robot_packet(31))
