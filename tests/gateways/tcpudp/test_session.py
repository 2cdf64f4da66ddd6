"""Sessions of the TCP/UDP package protocol in both roles. Bytes come from the protocol page, by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateways.tcpudp.messages import (
    ChatMessage,
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientLidarMode,
    ClientMoveAI,
    ClientSimulatedLidarData,
    DebugMessage,
    OpaquePacket,
    Packet,
    ServerPosition,
    ServerSLAMMap,
)
from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import Feature, RobotSettings13
from zbridge.errors import EncodeError, Refused
from zbridge.protocol.session import Role, State

LISTED = b"\x0b\x00\x00\x001.1,1.2,1.3"
ALL = "00010101010101"  # UDP, Cam, Joystick, Chat, Lidar, LidarSim, SLAMMap
NONE = "00000000000000"
ROBOT_SETTINGS = bytes.fromhex("21000000 01 02 05") + LISTED + bytes.fromhex(ALL + "e8030000 0a000000")
HQ_SETTINGS = bytes.fromhex("18000000 05 03") + LISTED + bytes.fromhex("00000000000100")
POSITION = bytes.fromhex("0e000000 01 37 0000c03f 000010c0 0000b442")
FEATURES = ("cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map")


def robot_settings(versions: bytes = b"1.1,1.2,1.3", client_id: int = 5, flags: str = ALL) -> bytes:
    body = bytes([client_id]) + len(versions).to_bytes(4, "little") + versions
    body += bytes.fromhex(flags + "e8030000 0a000000")
    return (2 + len(body)).to_bytes(4, "little") + b"\x01\x02" + body


def hq_settings(versions: bytes = b"1.1,1.2,1.3", sender: int = 5, flags: str = "00000000000100") -> bytes:
    body = len(versions).to_bytes(4, "little") + versions + bytes.fromhex(flags)
    return (2 + len(body)).to_bytes(4, "little") + bytes([sender, 3]) + body


def opened_hq(*force: Feature | int) -> HqRole:
    session = HqRole(limits(0.01), force=force)
    session.open(0.0)
    return session


def established_hq(*force: Feature | int, flags: str = ALL) -> HqRole:
    session = opened_hq(*force)
    assert session.receive(robot_settings(flags=flags), 0.1) == []
    assert session.outgoing(0.1) == HQ_SETTINGS
    return session


def opened_robot() -> RobotRole:
    announced = RobotSettings13(
        cam=True,
        joystick=True,
        chat=True,
        lidar=True,
        lidar_sim=True,
        slam_map=True,
        slam_map_size=1000,
        slam_map_interval=10,
    )
    session = RobotRole(limits(0.0), announced, client_id=5)
    session.open(0.0)
    return session


def established_robot() -> RobotRole:
    session = opened_robot()
    assert session.outgoing(0.0) == ROBOT_SETTINGS
    assert session.receive(HQ_SETTINGS, 0.1) == []
    return session


# We play HQ


def test_an_hq_says_nothing_before_the_robot_has_spoken() -> None:
    session = opened_hq()
    assert session.role is Role.HQ
    assert session.state is State.HANDSHAKING
    assert session.outgoing(0.0) is None


def test_an_hq_answers_the_settings_with_the_list_that_robots_take_safely_and_its_client_id() -> None:
    session = opened_hq()
    assert session.receive(ROBOT_SETTINGS, 0.1) == []
    assert session.outgoing(0.1) == HQ_SETTINGS
    assert session.outgoing(0.2) is None
    assert session.state is State.ESTABLISHED
    assert session.version == "1.3"
    assert session.features == FEATURES


def test_the_handshake_of_an_hq_may_come_byte_by_byte_with_packets_behind_it() -> None:
    session = opened_hq()
    messages: list[Packet] = []
    for byte in ROBOT_SETTINGS + POSITION:
        messages += session.receive(bytes([byte]), 0.1)
    assert messages == [ServerPosition(1.5, -2.25, 90.0)]
    assert session.outgoing(0.1) == HQ_SETTINGS


@pytest.mark.parametrize("cut", range(len(ROBOT_SETTINGS + POSITION)))
def test_the_handshake_of_an_hq_may_be_cut_anywhere(cut: int) -> None:
    stream = ROBOT_SETTINGS + POSITION
    session = opened_hq()
    messages = session.receive(stream[:cut], 0.1) + session.receive(stream[cut:], 0.2)
    assert messages == [ServerPosition(1.5, -2.25, 90.0)]


def test_settings_with_an_unknown_tail_are_read() -> None:
    body = ROBOT_SETTINGS[4:] + b"\x01\x02\x03"
    session = opened_hq()
    session.receive(len(body).to_bytes(4, "little") + body, 0.1)
    assert session.state is State.ESTABLISHED


def test_a_robot_without_a_common_version_is_told_so_whatever_its_settings_block() -> None:
    session = opened_hq()
    session.receive(bytes.fromhex("0f000000 01 02 05 03000000") + b"9.9" + bytes(5), 0.1)
    assert session.reason is not None
    assert session.reason.startswith("no common version: the peer speaks '9.9'")
    assert session.traffic.malformed == 0
    told = session.outgoing(0.1)
    assert told is not None
    assert told[4:6] == bytes([5, 1])


@pytest.mark.parametrize("length", [81, 5000, 60_000])
def test_a_long_version_list_of_a_robot_is_quoted_shortly(length: int) -> None:
    session = opened_hq()
    session.receive(robot_settings(b"9" * length), 0.1)
    assert session.state is State.CLOSING
    told = session.outgoing(0.1)
    assert told is not None
    assert len(told) < 200
    assert b"no common version: the peer speaks '" + b"9" * 80 + b"'" in told


def test_a_silent_robot_is_given_up_with_the_reason_that_its_connection_may_be_used_up() -> None:
    session = opened_hq()
    session.expire(4.99)
    assert session.state is State.HANDSHAKING
    assert session.deadline() == 5.0
    session.expire(5.0)
    assert session.state is State.CLOSED
    assert session.reason == (
        "connected, but no settings within 5 s: its one connection may be used up, restart the robot program"
    )


def test_packets_before_the_settings_are_malformed_and_not_delivered() -> None:
    session = opened_hq()
    assert session.receive(POSITION, 0.1) == []
    assert session.traffic.malformed == 1
    assert session.state is State.HANDSHAKING
    session.receive(ROBOT_SETTINGS, 0.2)
    assert session.receive(POSITION, 0.3) == [ServerPosition(1.5, -2.25, 90.0)]


def test_settings_that_come_again_change_nothing() -> None:
    session = established_hq()
    session.receive(robot_settings(client_id=9, flags=NONE), 0.2)
    assert session.traffic.malformed == 1
    assert session.sender_id == 5
    assert session.features == FEATURES
    assert session.outgoing(0.3) is None


def test_malformed_settings_leave_the_handshake_open_to_its_limit() -> None:
    session = opened_hq()
    session.receive(bytes.fromhex("04000000 01 02 05ff"), 0.1)
    assert session.traffic.malformed == 1
    assert session.outgoing(0.1) is None
    session.expire(5.0)
    assert session.state is State.CLOSED


@pytest.mark.parametrize("sender", [0, 2, 5, 255])
def test_an_hq_takes_packets_with_the_servers_id_only(sender: int) -> None:
    session = established_hq()
    assert session.receive(POSITION[:4] + bytes([sender]) + POSITION[5:], 0.2) == []
    assert session.traffic.malformed == 1
    assert session.state is State.ESTABLISHED


@pytest.mark.parametrize("packet_id", [3, 5, 7, 10, 11, 12, 13, 21, 50, 52, 54, 61])
def test_an_hq_takes_no_packet_of_its_own_side(packet_id: int) -> None:
    session = established_hq()
    assert session.receive(bytes.fromhex("02000000 01") + bytes([packet_id]), 0.2) == []
    assert session.last_malformed is not None
    assert "from the wrong side" in session.last_malformed


def test_packets_of_both_sides_and_unknown_ones_are_taken() -> None:
    session = established_hq()
    stream = bytes.fromhex("09000000 01 01 03000000 627965 03000000 01 28 aa 03000000 01 4f bb 02000000 01 ff")
    assert session.receive(stream, 0.2) == [
        DebugMessage("bye"),
        ChatMessage(b"\xaa"),
        OpaquePacket(79, b"\xbb"),
        OpaquePacket(255),
    ]


def test_a_map_of_twelve_bytes_that_is_three_floats_is_a_position() -> None:
    session = established_hq()
    assert session.receive(bytes.fromhex("0e000000 01 35 00001643 000048c2 0000b442"), 0.2) == [
        ServerPosition(150.0, -50.0, 90.0)
    ]
    assert session.receive(bytes.fromhex("0e000000 01 35 08000000 0001020001020001"), 0.3) == [
        ServerSLAMMap(bytes.fromhex("0001020001020001"))
    ]
    assert session.traffic.malformed == 0


@pytest.mark.parametrize("length", ["00000000", "01000000", "ffffffff", "00000080", "ffffff7f", "41004000"])
def test_an_impossible_length_ends_the_session(length: str) -> None:
    session = established_hq()
    assert session.receive(POSITION + bytes.fromhex(length) + b"\x01\x37", 0.2) == [ServerPosition(1.5, -2.25, 90.0)]
    assert session.state is State.CLOSED
    assert session.reason is not None
    assert session.reason.startswith("broken stream")


@pytest.mark.parametrize(
    ("message", "frame"),
    [
        (DebugMessage("hi there"), "0e000000 05 01 08000000 6869207468657265"),
        (ClientControllMode(2), "06000000 05 0a 02000000"),
        (ClientJoystickMove(0.6, 0.8, 1.5), "0e000000 05 0b 9a99193f cdcc4c3f 0000c03f"),
        (ClientJoystickRotate(-0.75), "06000000 05 0c 000040bf"),
        (ClientJoystickStop(), "02000000 05 0d"),
        (ClientMoveAI(b"\x01\x02"), "04000000 05 15 0102"),
        (ChatMessage(b"\x03"), "03000000 05 28 03"),
        (ClientLidarMode(1), "06000000 05 32 01000000"),
        (ClientGetSLAMMap(), "02000000 05 34"),
        (ClientGetPosition(), "02000000 05 36"),
    ],
)
def test_what_an_hq_sends_carries_its_client_id(message: Packet, frame: str) -> None:
    session = established_hq()
    session.send(message)
    assert session.outgoing(1.0) == bytes.fromhex(frame)


def test_simulated_lidar_data_is_sent_as_360_floats() -> None:
    session = established_hq()
    session.send(ClientSimulatedLidarData(np.full(360, 200.0, np.float32)))
    assert session.outgoing(1.0) == bytes.fromhex("a6050000 05 3d 68010000") + bytes.fromhex("00004843") * 360


NEEDS = [
    (ClientControllMode(1), (Feature.JOYSTICK,)),
    (ClientJoystickMove(0, 0, 0), (Feature.JOYSTICK,)),
    (ClientJoystickRotate(0), (Feature.JOYSTICK,)),
    (ClientJoystickStop(), (Feature.JOYSTICK,)),
    (ClientMoveAI(), (Feature.JOYSTICK,)),
    (ChatMessage(), (Feature.CHAT,)),
    (ClientLidarMode(1), (Feature.LIDAR,)),
    (ClientGetSLAMMap(), (Feature.SLAM_MAP,)),
    (ClientGetPosition(), (Feature.SLAM_MAP,)),
    (ClientSimulatedLidarData(np.zeros(360, np.float32)), (Feature.LIDAR_SIM,)),
]


@pytest.mark.parametrize(("message", "needs"), NEEDS, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("feature", [feature for feature in Feature if feature is not Feature.UDP])
def test_a_packet_is_sent_only_to_a_robot_that_announces_its_feature(message, needs, feature) -> None:
    flags = "".join("01" if each is feature else "00" for each in Feature)
    session = established_hq(flags=flags)
    if feature in needs:
        session.send(message)
        assert session.outgoing(1.0) is not None
    else:
        with pytest.raises(Refused, match="does not announce"):
            session.send(message)
        assert session.outgoing(1.0) is None


@pytest.mark.parametrize(("message", "needs"), NEEDS, ids=lambda value: type(value).__name__)
def test_a_forced_feature_is_used_although_the_robot_does_not_announce_it(message, needs) -> None:
    session = established_hq(*needs, flags=NONE)
    session.send(message)
    assert session.outgoing(1.0) is not None
    assert session.features == (), "features shows what the robot announces, not what is forced"


def test_a_forced_packet_id_is_used_alone() -> None:
    session = established_hq(10, flags=NONE)
    session.send(ClientControllMode(1))
    with pytest.raises(Refused):
        session.send(ClientJoystickStop())


def test_a_text_needs_no_feature() -> None:
    session = established_hq(flags=NONE)
    session.send(DebugMessage("hi"))
    assert session.outgoing(1.0) is not None


def test_a_packet_the_table_does_not_know_is_sent_only_if_forced() -> None:
    with pytest.raises(Refused, match=r"packet 75 may crash the robot; list it in options\.force"):
        established_hq().send(OpaquePacket(75, b"\x01"))
    session = established_hq(75)
    session.send(OpaquePacket(75, b"\x01"))
    assert session.outgoing(1.0) == bytes.fromhex("03000000 05 4b 01")


def test_an_empty_text_is_never_sent() -> None:
    session = established_hq(1)
    with pytest.raises(Refused, match="empty text"):
        session.send(DebugMessage(""))
    assert session.outgoing(1.0) is None


def test_nothing_over_4096_bytes_is_sent() -> None:
    session = established_hq()
    session.send(DebugMessage("x" * (4096 - 6 - 4)))
    longest = session.outgoing(1.0)
    assert longest is not None
    assert len(longest) == 4096
    with pytest.raises(EncodeError, match="4097 bytes"):
        session.send(DebugMessage("x" * (4096 - 6 - 4 + 1)))
    with pytest.raises(EncodeError):
        session.send(ClientSimulatedLidarData(np.zeros(2000, np.float32)))
    assert session.outgoing(2.0) is None


def test_a_text_that_is_not_ascii_is_not_sent() -> None:
    with pytest.raises(EncodeError):
        established_hq().send(DebugMessage("Grüße"))


# We play the robot


def test_a_robot_speaks_first_and_waits_for_the_settings() -> None:
    session = opened_robot()
    assert session.role is Role.ROBOT
    assert session.outgoing(0.0) == ROBOT_SETTINGS
    assert session.state is State.HANDSHAKING


@pytest.mark.parametrize("sender", [0, 5])
def test_the_settings_of_an_hq_end_the_handshake(sender: int) -> None:
    session = opened_robot()
    assert session.receive(hq_settings(sender=sender), 0.1) == []
    assert session.state is State.ESTABLISHED
    assert session.version == "1.3"
    assert session.features == ("lidar_sim",)


def test_the_handshake_of_a_robot_may_come_byte_by_byte_with_packets_behind_it() -> None:
    session = opened_robot()
    messages: list[Packet] = []
    for byte in HQ_SETTINGS + bytes.fromhex("06000000 05 0a 02000000"):
        messages += session.receive(bytes([byte]), 0.1)
    assert messages == [ClientControllMode(2)]


@pytest.mark.parametrize(
    ("stream", "messages"),
    [
        ("0e000000 05 0b 9a99193f cdcc4c3f 0000c03f", [ClientJoystickMove(*np.float32([0.6, 0.8, 1.5]).tolist())]),
        ("06000000 05 0c 000040bf", [ClientJoystickRotate(-0.75)]),
        ("02000000 05 0d 02000000 05 0d", [ClientJoystickStop(), ClientJoystickStop()]),
        ("02000000 00 36", [ClientGetPosition()]),
        ("02000000 05 34", [ClientGetSLAMMap()]),
    ],
)
def test_what_an_hq_sends_is_delivered(stream: str, messages: list[Packet]) -> None:
    assert established_robot().receive(bytes.fromhex(stream), 0.2) == messages


def test_packets_before_the_settings_of_an_hq_are_malformed() -> None:
    session = opened_robot()
    assert session.receive(bytes.fromhex("02000000 00 0d"), 0.1) == []
    assert session.traffic.malformed == 1
    assert session.state is State.HANDSHAKING


@pytest.mark.parametrize("sender", [0, 1, 2, 4, 5, 6, 255])
def test_a_robot_knows_a_client_by_its_connection_and_not_by_the_id_it_writes(sender: int) -> None:
    """Recorded HQ programs write 1, others 0 until they have read the settings."""
    session = established_robot()
    assert session.receive(bytes.fromhex("02000000") + bytes([sender, 13]), 0.2) == [ClientJoystickStop()]
    assert session.traffic.malformed == 0
    assert session.state is State.ESTABLISHED


@pytest.mark.parametrize("sender", [0, 1, 5, 6])
def test_a_robot_takes_the_settings_whatever_id_they_carry(sender: int) -> None:
    session = opened_robot()
    session.receive(HQ_SETTINGS[:4] + bytes([sender]) + HQ_SETTINGS[5:], 0.1)
    assert (session.state, session.traffic.malformed) == (State.ESTABLISHED, 0)


@pytest.mark.parametrize("packet_id", [2, 4, 6, 31, 51, 53, 55, 60])
def test_a_robot_takes_no_packet_of_its_own_side(packet_id: int) -> None:
    session = established_robot()
    assert session.receive(bytes.fromhex("02000000 05") + bytes([packet_id]), 0.2) == []
    assert session.traffic.malformed == 1


def test_settings_of_an_hq_that_come_again_change_nothing() -> None:
    session = established_robot()
    session.receive(hq_settings(flags="01010101010101"), 0.2)
    assert session.features == ("lidar_sim",)
    assert session.traffic.malformed == 1


def test_a_long_version_list_of_an_hq_is_quoted_shortly() -> None:
    session = opened_robot()
    session.outgoing(0.0)
    session.receive(hq_settings(b"7" * 9000), 0.1)
    assert session.state is State.CLOSING
    told = session.outgoing(0.1)
    assert told is not None
    assert len(told) < 200
    assert b"'" + b"7" * 80 + b"'" in told


def test_what_a_robot_sends_carries_the_servers_id() -> None:
    session = established_robot()
    session.send(ServerPosition(1.5, -2.25, 90.0))
    assert session.outgoing(0.2) == POSITION


def test_an_hq_that_never_answers_is_given_up() -> None:
    session = opened_robot()
    session.expire(5.0)
    assert session.state is State.CLOSED
    assert session.reason == "no handshake within 5 s"


# Both


FRAMES = st.builds(
    lambda sender, packet_id, body: (2 + len(body)).to_bytes(4, "little") + bytes([sender, packet_id]) + body,
    st.sampled_from([0, 1, 5]),
    st.integers(0, 255),
    st.binary(max_size=40),
)


@given(st.lists(FRAMES | st.binary(max_size=20), max_size=10), st.booleans())
def test_random_packets_never_raise(reads: list[bytes], play_hq: bool) -> None:
    session = established_hq() if play_hq else established_robot()
    for step, data in enumerate(reads):
        for message in session.receive(data, 0.2 + step):
            assert isinstance(message, Packet)


@given(st.lists(FRAMES | st.binary(max_size=20), max_size=10), st.booleans())
def test_random_packets_during_the_handshake_never_raise(reads: list[bytes], play_hq: bool) -> None:
    session = opened_hq() if play_hq else opened_robot()
    for step, data in enumerate(reads):
        session.receive(data, step * 0.1)
