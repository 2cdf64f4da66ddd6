"""Sessions of the TCP/UDP package protocol in both roles. Bytes come from the protocol page, by hand."""

from collections.abc import Callable

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
from tests.gateways.tcpudp.frames import NO_UDP, POSITION, SIZE_100_10, client_settings, framed, server_settings
from zbridge.errors import EncodeError, Refused
from zbridge.protocol.session import Role, State

NONE = "00000000000000"
ROBOT_SETTINGS = server_settings(block=NO_UDP + SIZE_100_10)
HQ_SETTINGS = client_settings(block="00000000000100")
POSE = ServerPosition(1.5, -2.25, 90.0)
FEATURES = ("cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map")
Session = HqRole | RobotRole


def opened_hq(*force: Feature | int) -> HqRole:
    session = HqRole(limits(0.01), force=force)
    session.open(0.0)
    return session


def established_hq(*force: Feature | int, flags: str = NO_UDP) -> HqRole:
    session = opened_hq(*force)
    assert session.receive(server_settings(block=flags + SIZE_100_10), 0.1) == []
    assert session.outgoing(0.1) == HQ_SETTINGS
    return session


def opened_robot() -> RobotRole:
    announced = RobotSettings13(**dict.fromkeys(FEATURES, True), slam_map_size=1000, slam_map_interval=10)  # type: ignore[arg-type]
    session = RobotRole(limits(0.0), announced, client_id=5)
    session.open(0.0)
    return session


def established_robot() -> RobotRole:
    session = opened_robot()
    assert session.outgoing(0.0) == ROBOT_SETTINGS
    assert session.receive(HQ_SETTINGS, 0.1) == []
    return session


OPENED: dict[str, Callable[[], Session]] = {"hq": opened_hq, "robot": opened_robot}
ESTABLISHED: dict[str, Callable[[], Session]] = {"hq": established_hq, "robot": established_robot}
SETTINGS = {"hq": ROBOT_SETTINGS, "robot": HQ_SETTINGS}
"""What each of our roles is sent."""
each_role = pytest.mark.parametrize("role", OPENED)


def test_an_hq_answers_the_settings_with_the_list_that_robots_take_safely_and_its_client_id() -> None:
    session = opened_hq()
    assert session.role is Role.HQ
    assert session.state is State.HANDSHAKING
    assert session.outgoing(0.0) is None
    assert session.receive(ROBOT_SETTINGS, 0.1) == []
    assert session.outgoing(0.1) == HQ_SETTINGS
    assert session.outgoing(0.2) is None
    assert session.state is State.ESTABLISHED
    assert session.version == "1.3"
    assert session.features == FEATURES


@pytest.mark.parametrize("sender", [0, 1, 5, 6])
def test_a_robot_speaks_first_and_the_settings_of_an_hq_end_the_handshake_whatever_id_they_carry(sender: int) -> None:
    session = opened_robot()
    assert session.role is Role.ROBOT
    assert session.outgoing(0.0) == ROBOT_SETTINGS
    assert session.state is State.HANDSHAKING
    assert session.receive(client_settings(block="00000000000100", sender=sender), 0.1) == []
    assert (session.state, session.traffic.malformed) == (State.ESTABLISHED, 0)
    assert session.version == "1.3"
    assert session.features == ("lidar_sim",)


@pytest.mark.parametrize(
    ("role", "behind", "messages"),
    [("hq", POSITION, [POSE]), ("robot", bytes.fromhex("06000000 05 0a 02000000"), [ClientControllMode(2)])],
)
def test_the_handshake_may_be_cut_anywhere_with_packets_behind_it(role, behind, messages) -> None:
    stream = SETTINGS[role] + behind
    cuts = [[stream[:cut], stream[cut:]] for cut in range(len(stream))] + [[bytes([byte]) for byte in stream]]
    for pieces in cuts:
        session = OPENED[role]()
        assert [message for piece in pieces for message in session.receive(piece, 0.1)] == messages
        assert session.state is State.ESTABLISHED


@pytest.mark.parametrize(("role", "length"), [("hq", 81), ("hq", 5000), ("hq", 60_000), ("robot", 9000)])
def test_a_long_version_list_is_quoted_shortly(role: str, length: int) -> None:
    session = OPENED[role]()
    session.outgoing(0.0)
    session.receive(server_settings(b"9" * length) if role == "hq" else client_settings(b"9" * length), 0.1)
    assert session.state is State.CLOSING
    told = session.outgoing(0.1)
    assert told is not None
    assert len(told) < 200
    assert b"no common version: the peer speaks '" + b"9" * 80 + b"'" in told


@pytest.mark.parametrize(
    ("role", "reason"),
    [
        ("hq", "connected, but no settings within 5 s: its one connection may be used up, restart the robot program"),
        ("robot", "no handshake within 5 s"),
    ],
)
def test_a_silent_peer_is_given_up_with_the_reason_of_its_role(role: str, reason: str) -> None:
    session = OPENED[role]()
    session.outgoing(0.0)
    session.expire(4.99)
    assert session.state is State.HANDSHAKING
    assert session.deadline() == 5.0
    session.expire(5.0)
    assert (session.state, session.reason) == (State.CLOSED, reason)


@pytest.mark.parametrize(
    ("role", "packet", "messages"),
    [("hq", POSITION, [POSE]), ("robot", bytes.fromhex("02000000 00 0d"), [ClientJoystickStop()])],
)
def test_packets_before_the_settings_are_malformed_and_not_delivered(role, packet, messages) -> None:
    session = OPENED[role]()
    assert session.receive(packet, 0.1) == []
    assert session.traffic.malformed == 1
    assert session.state is State.HANDSHAKING
    session.receive(SETTINGS[role], 0.2)
    assert session.receive(packet, 0.3) == messages


def test_settings_that_come_again_change_nothing() -> None:
    hq = established_hq()
    hq.receive(server_settings(block=NONE + SIZE_100_10, client_id=9), 0.2)
    assert (hq.traffic.malformed, hq.sender_id, hq.features) == (1, 5, FEATURES)
    assert hq.outgoing(0.3) is None
    robot = established_robot()
    robot.receive(client_settings(block="01010101010101"), 0.2)
    assert (robot.traffic.malformed, robot.features) == (1, ("lidar_sim",))


@pytest.mark.parametrize("sender", [0, 2, 5, 255])
def test_an_hq_takes_packets_with_the_servers_id_only(sender: int) -> None:
    session = established_hq()
    assert session.receive(POSITION[:4] + bytes([sender]) + POSITION[5:], 0.2) == []
    assert session.traffic.malformed == 1
    assert session.state is State.ESTABLISHED


@pytest.mark.parametrize("sender", [0, 1, 2, 4, 5, 6, 255])
def test_a_robot_knows_a_client_by_its_connection_and_not_by_the_id_it_writes(sender: int) -> None:
    """Recorded HQ programs write 1, others 0 until they have read the settings."""
    session = established_robot()
    assert session.receive(framed(sender, 13), 0.2) == [ClientJoystickStop()]
    assert session.traffic.malformed == 0
    assert session.state is State.ESTABLISHED


@pytest.mark.parametrize(
    ("role", "sender", "packet_id"),
    [
        *(("hq", 1, packet_id) for packet_id in (3, 5, 7, 10, 11, 12, 13, 21, 50, 52, 54, 61)),
        *(("robot", 5, packet_id) for packet_id in (2, 4, 6, 31, 51, 53, 55, 60)),
    ],
)
def test_no_role_takes_a_packet_of_its_own_side(role: str, sender: int, packet_id: int) -> None:
    session = ESTABLISHED[role]()
    assert session.receive(framed(sender, packet_id), 0.2) == []
    assert session.traffic.malformed == 1
    assert "from the wrong side" in str(session.last_malformed)


@pytest.mark.parametrize(
    ("role", "stream", "messages"),
    [
        # packets of both sides and unknown ones
        (
            "hq",
            "09000000 01 01 03000000 627965 03000000 01 28 aa 03000000 01 4f bb 02000000 01 ff",
            [DebugMessage("bye"), ChatMessage(b"\xaa"), OpaquePacket(79, b"\xbb"), OpaquePacket(255)],
        ),
        # a map of twelve bytes that is three floats is a position
        ("hq", "0e000000 01 35 00001643 000048c2 0000b442", [ServerPosition(150.0, -50.0, 90.0)]),
        ("hq", "0e000000 01 35 08000000 0001020001020001", [ServerSLAMMap(b"\0\1\2\0\1\2\0\1")]),
        (
            "robot",
            "0e000000 05 0b 9a99193f cdcc4c3f 0000c03f",
            [ClientJoystickMove(*np.float32([0.6, 0.8, 1.5]).tolist())],
        ),
        ("robot", "06000000 05 0c 000040bf", [ClientJoystickRotate(-0.75)]),
        ("robot", "02000000 05 0d 02000000 05 0d", [ClientJoystickStop(), ClientJoystickStop()]),
        ("robot", "02000000 00 36 02000000 05 34", [ClientGetPosition(), ClientGetSLAMMap()]),
    ],
)
def test_what_the_peer_sends_is_delivered(role: str, stream: str, messages: list[Packet]) -> None:
    session = ESTABLISHED[role]()
    assert session.receive(bytes.fromhex(stream), 0.2) == messages
    assert session.traffic.malformed == 0


@each_role
@pytest.mark.parametrize("length", ["00000000", "01000000", "ffffffff", "00000080", "ffffff7f", "41004000"])
def test_an_impossible_length_ends_the_session(role: str, length: str) -> None:
    session = ESTABLISHED[role]()
    before = framed(1, 1, bytes.fromhex("02000000 6869"))
    assert session.receive(before + bytes.fromhex(length) + b"\x01\x37", 0.2) == [DebugMessage("hi")]
    assert session.state is State.CLOSED
    assert str(session.reason).startswith("broken stream")


@pytest.mark.parametrize(
    ("role", "message", "frame"),
    [
        ("hq", DebugMessage("hi there"), "0e000000 05 01 08000000 6869207468657265"),
        ("hq", ClientControllMode(2), "06000000 05 0a 02000000"),
        ("hq", ClientJoystickMove(0.6, 0.8, 1.5), "0e000000 05 0b 9a99193f cdcc4c3f 0000c03f"),
        ("hq", ClientJoystickRotate(-0.75), "06000000 05 0c 000040bf"),
        ("hq", ClientJoystickStop(), "02000000 05 0d"),
        ("hq", ClientMoveAI(b"\x01\x02"), "04000000 05 15 0102"),
        ("hq", ChatMessage(b"\x03"), "03000000 05 28 03"),
        ("hq", ClientLidarMode(1), "06000000 05 32 01000000"),
        ("hq", ClientGetSLAMMap(), "02000000 05 34"),
        ("hq", ClientGetPosition(), "02000000 05 36"),
        (
            "hq",
            ClientSimulatedLidarData(np.full(360, 200.0, np.float32)),
            "a6050000 05 3d 68010000" + "00004843" * 360,
        ),
        ("robot", POSE, "0e000000 01 37 0000c03f 000010c0 0000b442"),
    ],
)
def test_what_is_sent_carries_the_id_of_its_side(role: str, message: Packet, frame: str) -> None:
    session = ESTABLISHED[role]()
    session.send(message)
    assert session.outgoing(1.0) == bytes.fromhex(frame)


NEEDS = [
    (ClientControllMode(1), Feature.JOYSTICK),
    (ClientJoystickMove(0, 0, 0), Feature.JOYSTICK),
    (ClientJoystickRotate(0), Feature.JOYSTICK),
    (ClientJoystickStop(), Feature.JOYSTICK),
    (ClientMoveAI(), Feature.JOYSTICK),
    (ChatMessage(), Feature.CHAT),
    (ClientLidarMode(1), Feature.LIDAR),
    (ClientGetSLAMMap(), Feature.SLAM_MAP),
    (ClientGetPosition(), Feature.SLAM_MAP),
    (ClientSimulatedLidarData(np.zeros(360, np.float32)), Feature.LIDAR_SIM),
    (DebugMessage("hi"), None),
]


@pytest.mark.parametrize(("message", "needed"), NEEDS, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("feature", [feature for feature in Feature if feature is not Feature.UDP])
def test_a_packet_is_sent_only_to_a_robot_that_announces_its_feature_or_where_it_is_forced(
    message: Packet, needed: Feature | None, feature: Feature
) -> None:
    announcing = established_hq(flags="".join("01" if each is feature else "00" for each in Feature))
    if needed in (feature, None):
        forced = established_hq(feature, flags=NONE)
        for session in (announcing, forced):
            session.send(message)
            assert session.outgoing(1.0) is not None
        assert forced.features == (), "features shows what the robot announces, not what is forced"
    else:
        with pytest.raises(Refused, match="does not announce"):
            announcing.send(message)
        assert announcing.outgoing(1.0) is None


def test_a_forced_packet_id_is_used_alone() -> None:
    session = established_hq(10, flags=NONE)
    session.send(ClientControllMode(1))
    with pytest.raises(Refused):
        session.send(ClientJoystickStop())


def test_a_packet_the_table_does_not_know_is_sent_only_if_forced() -> None:
    with pytest.raises(Refused, match=r"packet 75 may crash the robot; list it in options\.force"):
        established_hq().send(OpaquePacket(75, b"\x01"))
    session = established_hq(75)
    session.send(OpaquePacket(75, b"\x01"))
    assert session.outgoing(1.0) == bytes.fromhex("03000000 05 4b 01")


@pytest.mark.parametrize(
    ("message", "error", "reason"),
    [
        (DebugMessage(""), Refused, "empty text"),
        (DebugMessage("x" * (4096 - 6 - 4 + 1)), EncodeError, "4097 bytes"),
        (ClientSimulatedLidarData(np.zeros(2000, np.float32)), EncodeError, "bytes"),
        (DebugMessage("Grüße"), EncodeError, ""),
    ],
    ids=["empty text", "over 4096 bytes", "many ranges", "no ASCII"],
)
def test_what_a_robot_cannot_take_is_never_sent(message: Packet, error: type[Exception], reason: str) -> None:
    session = established_hq(1)
    with pytest.raises(error) as raised:
        session.send(message)
    assert reason in str(raised.value)
    assert session.outgoing(1.0) is None
    session.send(DebugMessage("x" * (4096 - 6 - 4)))
    assert len(session.outgoing(2.0) or b"") == 4096


FRAMES = st.builds(framed, st.sampled_from([0, 1, 5]), st.integers(0, 255), st.binary(max_size=40))


@each_role
@pytest.mark.parametrize("sessions", [OPENED, ESTABLISHED], ids=["opened", "established"])
@given(reads=st.lists(FRAMES | st.binary(max_size=20), max_size=10))
def test_random_packets_never_raise(role: str, sessions: dict[str, Callable[[], Session]], reads: list[bytes]) -> None:
    session = sessions[role]()
    for step, data in enumerate(reads):
        for message in session.receive(data, 0.2 + step * 0.1):
            assert isinstance(message, Packet)
