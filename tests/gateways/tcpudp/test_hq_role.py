"""The gateway as HQ of one robot: what it answers, which bytes leave when and by which channel, what it never sends."""

import contextlib

import msgspec
import numpy as np
import pytest

from gateways.tcpudp import messages as m
from gateways.tcpudp.options import TcpUdpOptions
from gateways.tcpudp.session import limits
from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.settings import Feature
from gateways.tcpudp.translate import TcpUdpRobot
from tests.gateways.tcpudp import frames as f
from tests.gateways.tcpudp.golden import GOLDEN
from zbridge.errors import EncodeError, Refused
from zbridge.protocol.session import State

POSE = m.ServerPosition(1.5, -2.25, 90.0)
SCAN = m.ClientSimulatedLidarData(np.ones(360, np.float32))
THEIRS = {
    message.spec.id: (message, bytes.fromhex(text))
    for message, sender, text in GOLDEN
    if sender in (2, 7) and message.spec.id not in (3, 5, 7)
}
"""A command of each kind, by packet id."""


def hq(listed: bytes = f.LISTED, block: str = f.ALL, *, udp: bool = True, force: tuple = ()) -> f.Timed:
    return f.Timed(HqRole(limits(0.01), udp=udp, force=force)).come((0.1, "tcp", f.server_settings(listed, block)))


def plain(flags: str = f.NO_UDP, *force: Feature | int) -> f.Timed:
    """An HQ of a robot of 1.3, established without datagrams."""
    return hq(block=flags, udp=False, force=force)


def probed(*answer: str) -> f.Timed:
    """An HQ whose probe was answered so, or never; 3 s on."""
    timed = hq().hear(" ".join(["0.2 t4", *answer]))
    timed.until(3.0)
    return timed


# What the robot lists, what it understands, what is agreed


@pytest.mark.parametrize(
    ("listed", "block", "answer", "answered", "version", "features"),
    [
        pytest.param(b"1.1", "0001010101", b"1.1", "0000000000", "1.1", "cam joystick chat lidar", id="robot 1.1"),
        pytest.param(b"1.1", "0000000000", b"1.1", "0000000000", "1.1", "", id="robot 1.1 with nothing"),
        pytest.param(b"1.2", "000001000001", b"1.2", "000000000001", "1.2", "joystick lidar_sim", id="robot 1.2"),
        pytest.param(
            f.LISTED, "00000100000001", f.LISTED, "00000000000100", "1.3", "joystick slam_map", id="robot 1.3"
        ),
        pytest.param(f.LISTED_14, "00000000010001", f.LISTED, "00000000000100", "1.4", "lidar slam_map", id="1.4"),
        # Odd lists: robots of 1.1 and 1.2 understand nothing but their own list, those of 1.3 and "1.4" the safe one.
        pytest.param(b"1.2,1.1", "000000000001", b"1.2,1.1", "000000000001", "1.2", "lidar_sim", id="1.2 and 1.1"),
        pytest.param(b"1.4", "00000000000001", f.LISTED, "00000000000100", "1.4", "slam_map", id="1.4 alone"),
        pytest.param(b"2.0,1.3", "00000000000001", f.LISTED, "00000000000100", "1.3", "slam_map", id="one of tomorrow"),
        pytest.param(b" 1.1 ,, 1.1", "0000000001", b" 1.1 ,, 1.1", "0000000000", "1.1", "lidar", id="spaces"),
    ],
)
def test_a_robot_is_answered_with_what_it_understands(listed, block, answer, answered, version, features) -> None:
    """With UDP unless either side switches it off."""
    without = f.framed(5, 3, f.counted(answer) + bytes.fromhex(answered))
    neither, ours_off = hq(listed, block), hq(listed, "01" + block[2:], udp=False)
    for timed, announced in ((neither, features.split()), (ours_off, ["udp", *features.split()])):
        assert timed.frames("tcp") == [without]
        assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, version)
        assert timed.session.features == tuple(announced)
        assert timed.session.traffic.malformed == 0
    both = f.framed(5, 3, f.counted(answer) + bytes.fromhex("01" + answered[2:]))
    assert hq(listed, "01" + block[2:]).frames("tcp") == [both]


@pytest.mark.parametrize("listed", [b"", b"2.0", b"1.10", b"v1.1", b"1.1;1.2", b"9" * 80, b"9" * 60_000])
def test_a_robot_without_a_common_version_is_told_reported_and_left(listed: bytes) -> None:
    timed = hq(listed)
    timed.until(1.0)
    text = f"no common version: the peer speaks {listed.decode()[:80]!r}, this gateway 1.1, 1.2, 1.3, 1.4"
    assert timed.frames("tcp") == [f.framed(5, 1, f.counted(text.encode()))]
    assert timed.frames("udp") == []
    assert (timed.session.state, timed.session.reason) == (State.CLOSED, text)
    assert timed.session.version is None


def test_a_version_list_that_cannot_be_answered_does_no_harm() -> None:
    timed = hq(b"1.1," + b"9" * 5000, "0001010101")
    timed.until(10.0)
    assert timed.session.state is State.CLOSED


@pytest.mark.parametrize(
    ("announce", "listed", "block", "answered"),
    [
        ((), f.LISTED, f.ALL, "00000000000000"),
        (("lidar_sim",), f.LISTED, f.ALL, "00000000000100"),
        (tuple(feature.value for feature in Feature), f.LISTED, f.ALL, f.ALL),
        # as far as the block that the robot understands has a flag for it
        (("cam", "slam_map"), f.LISTED_14, f.ALL, "00010000000001"),
        (("cam", "lidar_sim", "slam_map"), b"1.2", f.ALL[:12], "000100000001"),
        (("chat", "lidar_sim", "slam_map"), b"1.1", f.ALL[:10], "0000000100"),
        # a robot without datagrams: none of ours
        (("udp", "chat"), f.LISTED, f.NO_UDP, "00000001000000"),
    ],
)
def test_the_gateway_announces_what_it_is_told(announce, listed, block, answered) -> None:
    timed = f.Timed(TcpUdpRobot(msgspec.convert({"announce": announce}, TcpUdpOptions)).session("robot", ""))
    timed.stream(f.server_settings(listed, block), 0.1)
    answer = f.LISTED if listed == f.LISTED_14 else listed
    assert timed.frames("tcp") == [f.framed(5, 3, f.counted(answer) + bytes.fromhex(answered))]
    if not answered.startswith("01"):
        assert timed.session.state is State.ESTABLISHED
        timed.until(10.0)
        assert timed.frames("udp") == [], "it neither waits for datagrams nor sends any"


@pytest.mark.parametrize(
    "early",
    [f.POSITION, f.START, f.ANSWER_FALSE, f.server_settings(b"1.1", "00000000"), f.server_settings(block="00" * 14)],
)
def test_what_comes_before_the_settings_is_malformed_and_settings_come_once(early: bytes) -> None:
    timed = f.Timed(HqRole(limits(0.01), udp=False))
    assert timed.stream(early, 0.05) == []
    assert (timed.session.traffic.malformed, timed.session.state, timed.sent) == (1, State.HANDSHAKING, [])
    assert timed.stream(f.server_settings() + f.POSITION, 0.1) == [POSE]
    timed.stream(f.server_settings(block="00" * 7, client_id=9), 0.2)
    timed.until(1.0)
    assert (timed.session.traffic.malformed, timed.session.sender_id, len(timed.sent)) == (2, 5, 1)
    assert timed.session.features == tuple(feature.value for feature in Feature)


# The probe, and the silence after it


@pytest.mark.parametrize(
    ("heard", "said", "established_at", "transport"),
    [
        pytest.param("", "0.1 t3", 2.1, "tcp", id="no 4 within two seconds"),
        pytest.param("0.2 t4 0.3 u6+", "0.1 t3 0.2 u5 0.3 t7+", 2.7, "udp", id="success"),
        pytest.param("0.2 t4", "0.1 t3 0.2 u5 2.2 t7-", 2.7, "tcp", id="no answer within two seconds"),
        pytest.param("0.2 t4 2.22 u6+", "0.1 t3 0.2 u5 2.2 t7-", 2.7, "tcp", id="an answer after the report"),
        pytest.param("0.2 t4 2.22 t6-", "0.1 t3 0.2 u5 2.2 t7-", 2.7, "tcp", id="a refusal after the report"),
        # an answer by TCP says that the datagram did not arrive
        pytest.param("0.2 t4 2.0 t6-", "0.1 t3 0.2 u5 2.0 t7-", 2.7, "tcp", id="a refusal by TCP"),
        pytest.param("0.2 t4 2.0 t6+", "0.1 t3 0.2 u5 2.0 t7-", 2.7, "tcp", id="an answer by TCP"),
        pytest.param("0.2 t4 0.3 u6-", "0.1 t3 0.2 u5 0.3 t7-", 2.7, "tcp", id="a datagram that says no"),
        pytest.param("0.2 t4 0.3 u6+ 0.4 u6+ 0.5 t6-", "0.1 t3 0.2 u5 0.3 t7+", 2.7, "udp", id="more answers"),
        pytest.param("0.2 t4 0.25 t4 0.3 u6+ 0.35 t4", "0.1 t3 0.2 u5 0.3 t7+", 2.7, "udp", id="more starts"),
        pytest.param("0.1 t4 0.3 u6+", "0.1 t3 0.1 u5 0.3 t7+", 2.6, "udp", id="a 4 with the settings"),
    ],
)
def test_an_hq_probes_and_reports_once_and_is_silent_for_2_5_s(heard: str, said, established_at, transport) -> None:
    timed = hq().hear(heard)
    timed.until(established_at - 0.01)
    assert timed.session.state is State.HANDSHAKING
    assert timed.datagram(f.POSITION, timed.now) == timed.stream(f.POSITION, timed.now) == [POSE], "is delivered"
    timed.until(established_at + 0.01)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, transport)
    timed.until(9.0)
    assert timed.told() == said


def test_a_start_that_comes_late_is_followed_by_the_same_silence() -> None:
    timed = hq().hear("3.0 t4")
    assert (timed.session.state, timed.session.busy) == (State.ESTABLISHED, "handshaking")
    timed.session.send(m.ClientControllMode(2))
    timed.hear("3.1 u6+").until(5.49)
    assert timed.session.busy == "handshaking"
    timed.until(9.0)
    assert (timed.session.busy, timed.session.transport) == (None, "udp")
    assert timed.told() == "0.1 t3 3.0 u5 3.1 t7+ 5.5 t10"


@pytest.mark.parametrize(("flags", "udp"), [(f.NO_UDP, True), (f.ALL, False)])
def test_a_start_that_nobody_offered_is_obeyed_without_datagrams(flags: str, udp: bool) -> None:
    """The robot sleeps all the same, and wants its 7."""
    timed = hq(block=flags, udp=udp)
    assert timed.session.state is State.ESTABLISHED
    timed.hear("0.2 t4")
    assert timed.session.busy == "handshaking"
    timed.until(6.0)
    assert timed.told() == "0.1 t3 2.2 t7-"
    assert (timed.session.state, timed.session.busy) == (State.ESTABLISHED, None)


def test_an_answer_that_is_none_is_counted_and_waited_past() -> None:
    answer = f.ANSWER_TRUE
    lengths = [bytes.fromhex(length) + answer[4:] for length in ("04000000", "02000000", "ffffffff")]
    wrong = [b"", b"\x03", answer[:-1], answer + b"\x00", f.PROBE, f.bearing(answer, 0), f.bearing(answer, 5), *lengths]
    timed = hq().hear("0.2 t4")
    assert [timed.datagram(datagram, 0.3) for datagram in wrong] == [[]] * len(wrong)
    assert timed.session.traffic.malformed == len(wrong)
    assert timed.hear("0.4 u6+").told() == "0.1 t3 0.2 u5 0.4 t7+"


def test_an_answer_that_the_network_delivers_again_is_no_sign_of_a_bad_connection() -> None:
    timed = probed("0.3 u6+ 0.31 u6+ 0.32 u6+ 0.4 u6+")
    assert timed.told() == "0.1 t3 0.2 u5 0.3 t7+"
    assert timed.session.traffic.malformed == 0
    assert timed.hear("0.5 t6-").session.traffic.malformed == 1, "an answer that says otherwise"


def test_datagrams_hold_one_packet_each_and_are_taken_from_the_robot_although_the_probe_failed() -> None:
    """What an HQ announces never limits what a robot may send it."""
    for timed in (probed("0.3 u6+"), probed()):
        assert timed.datagram(f.POSITION + f.POSITION[:3], 3.1) == []
        assert timed.datagram(f.POSITION, 3.2) == [POSE]
        assert not timed.session.claims(f.ANSWER_TRUE, 11000), "its source is known"


# What is taken, and what ends the session


def test_an_hq_takes_packets_of_the_servers_id_and_side_only() -> None:
    timed = plain()
    for sender in (0, 2, 5, 255):
        assert timed.stream(f.bearing(f.POSITION, sender), 0.2) == []
    for packet_id in (3, 5, 7, 10, 11, 12, 13, 21, 50, 52, 54, 61):
        assert timed.stream(f.framed(1, packet_id), 0.2) == []
        assert "from the wrong side" in str(timed.session.last_malformed)
    assert (timed.session.traffic.malformed, timed.session.state) == (16, State.ESTABLISHED)
    assert timed.stream(f.framed(1, 255) + f.POSITION, 0.3) == [m.OpaquePacket(255), POSE]


# What is sent, and by which channel


def test_a_command_carries_the_clients_id_and_goes_by_the_channel_of_the_table() -> None:
    """Before the probe there is only TCP; so there is after one that failed."""
    for command, frame in THEIRS.values():
        by_datagram = "udp" if command.spec.id in (11, 12, 61) else "tcp"
        for timed, by in ((probed(), "tcp"), (probed("0.3 u6+"), by_datagram)):
            timed.session.send(command)
            timed.until(3.5)
            assert [(sent.by, sent.frame) for sent in timed.sent if sent.at >= 3.0] == [(by, f.bearing(frame, 5))]


# What is never sent: an unregistered packet crashes a robot

NEEDS = {
    Feature.JOYSTICK: (10, 11, 12, 13, 21),
    Feature.CHAT: (40,),
    Feature.LIDAR: (50,),
    Feature.SLAM_MAP: (52, 54),
    Feature.LIDAR_SIM: (61,),
    Feature.CAM: (),
}


@pytest.mark.parametrize("feature", NEEDS)
def test_a_packet_is_sent_only_to_a_robot_that_announces_its_feature_or_where_it_is_forced(feature: Feature) -> None:
    announcing = plain("".join("01" if each is feature else "00" for each in Feature))
    forced = plain("00" * 7, feature)
    assert forced.session.features == (), "features shows what the robot announces, not what is forced"
    for needed, packet_id in [(needed, packet_id) for needed, ids in NEEDS.items() for packet_id in ids]:
        message, _ = THEIRS[packet_id]
        if needed is feature:
            announcing.session.may_send(message)
            forced.session.may_send(message)
        else:
            with pytest.raises(Refused, match=f"does not announce {needed.value}"):
                announcing.session.may_send(message)
    announcing.session.may_send(m.DebugMessage("hi"))


@pytest.mark.parametrize(
    ("listed", "block", "ids", "reason"),
    [
        # questions by SLAMMap where the version has the flag, else by Lidar; simulated lidar data, which 1.1 has not
        (b"1.1", "0000000001", (52, 54), None),
        (b"1.1", "0001010100", (52, 54), "does not announce lidar"),
        (b"1.2", "000000000100", (52, 54), None),
        (b"1.2", "000101010001", (52, 54), "does not announce lidar"),
        (b"1.1", "0101010101", (61,), r"version 1\.1 has no lidar_sim"),
        (b"1.2", "000101010100", (61,), "does not announce lidar_sim"),
        (b"1.2", "000000000001", (61,), None),
    ],
)
def test_questions_and_simulated_lidar_data_go_to_robots_that_know_them(listed, block, ids, reason) -> None:
    for message, _ in [THEIRS[packet_id] for packet_id in ids]:
        timed = hq(listed, block, udp=False)
        with contextlib.nullcontext() if reason is None else pytest.raises(Refused, match=reason):
            timed.session.send(message)


def test_a_forced_packet_is_sent_alone_and_one_that_the_table_does_not_know_only_if_forced() -> None:
    session = plain("00" * 7, 10).session
    session.may_send(m.ClientControllMode(1))
    with pytest.raises(Refused):
        session.may_send(m.ClientJoystickStop())
    led = m.OpaquePacket(75, b"\x01")
    with pytest.raises(Refused, match=r"packet 75 may crash the robot; list it in options\.force"):
        plain().session.send(led)
    assert plain(f.NO_UDP, 75).session.encode(led) == bytes.fromhex("03000000 05 4b 01")


@pytest.mark.parametrize(
    ("message", "error", "reason"),
    [
        (m.DebugMessage(""), Refused, "empty text"),
        (m.DebugMessage("x" * (4096 - 6 - 4 + 1)), EncodeError, "4097 bytes"),
        (m.ClientSimulatedLidarData(np.zeros(2000, np.float32)), EncodeError, "bytes"),
        (m.DebugMessage("Grüße"), EncodeError, "ASCII|ascii"),
    ],
    ids=["empty text", "over 4096 bytes", "many ranges", "no ASCII"],
)
def test_what_a_robot_cannot_take_is_never_sent(message: m.Packet, error: type[Exception], reason: str) -> None:
    timed = plain(f.NO_UDP, 1)
    with pytest.raises(error, match=reason):
        timed.session.send(message)
    timed.session.send(m.DebugMessage("x" * (4096 - 6 - 4)))
    timed.until(1.0)
    assert [len(frame) for frame in timed.frames("tcp")[1:]] == [4096]
