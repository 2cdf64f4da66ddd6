"""What HQ programs of each version are shown, and what they command. Bytes come from the protocol page, by hand."""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateways.tcpudp.hq import HqClient, HqOptions, TcpUdpHq, display
from gateways.tcpudp.hq import client as client_module
from gateways.tcpudp.maps import resampled, squared
from gateways.tcpudp.messages import Packet, encode_packet
from tests.captures import payloads
from tests.gateways.tcpudp.frames import ANSWER_TRUE, LISTED, POSITION, START, Timed, client_settings, counted, framed
from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet import payload as payloads_codec
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Map, Mode, Pose, Query, Raw, Scan, Status, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.hq.intent import Action, Intent
from zbridge.protocol.session import Limits, State

BOUNDS = Limits(frame_bytes=65536, handshake_s=5.0)
POSE = Pose(0.015, -0.0225, math.pi)
"""1.5 cm, -2.25 cm, 90 degrees of the robot: what both captures hold."""
CORNER = Map(2, 3, 0.1, (0.0, 0.0), np.array([[1, 2, 0], [0, 0, 2]], np.uint8))
"""Two rows of y, three columns of x."""
CORNER_CELLS = "010000 020000 000200"
"""x = 0, 1, 2, each from y = 0 to 2."""
EMPTY_MAP = bytes.fromhex("06000000 01 35 00000000")
"""n = 0: deployed HQ programs throw for good on a 53 without its int."""
BLOCKS = {"1.1": "0100000000", "1.2": "010000000001", "1.3": "01000000000101"}
"""What HQ programs of each version announce: UDP, LidarSim and SLAMMap as far as they have the flag."""
LISTS = {"1.1": b"1.1", "1.2": b"1.2", "1.3": LISTED}
OLD, NEW = "tcpudp-1.1-tcp.hex", "tcpudp-1.3-udp.hex"


def robot(version: str | None, *features: str, protocol: str = "tcpudp") -> RobotView:
    """The view of an established robot."""
    view = RobotView()
    view.alive = True
    view.note(topics.STATUS, Status("established", protocol=protocol, version=version, features=features))
    return view


def side(view: RobotView | None = None, **options: Any) -> TcpUdpHq:
    return TcpUdpHq(HqOptions(**options), view if view is not None else RobotView())


def connected(listener: TcpUdpHq, number: int = 2) -> Timed:
    return Timed(listener.session(number, BOUNDS))


def joined(
    listener: TcpUdpHq, version: str = "1.3", *, udp: bool = False, number: int = 2, block: str = "", asks: bool = True
) -> Timed:
    """A client whose handshake is done, and that asked for map and position; what it was sent so far is forgotten."""
    client = connected(listener, number)
    flags = block or BLOCKS[version]
    flags = ("01" if udp else "00") + flags[2:]
    assert client.stream(client_settings(LISTS[version], flags, sender=number), 0.1) == []
    if udp:
        assert client.datagram(framed(number, 5), 0.2) == []
        assert client.stream(framed(number, 7, b"\x01"), 0.3) == []
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, version)
    assert client.session.transport == ("udp" if udp else "tcp")
    client.until(1.0)
    if asks:
        said(listener, client, framed(number, 52) + framed(number, 54))
    client.sent.clear()
    return client


def show(listener: TcpUdpHq, topic: Topic, message: FleetMessage, *clients: Timed) -> None:
    """What the listener does with news of the robot."""
    send = listener.show(topic, message)
    for client in clients:
        if send is not None:
            send(client.session, client.now)
        client.until(client.now + 1.0)


def begin(listener: TcpUdpHq, client: Timed) -> None:
    assert isinstance(client.session, HqClient)
    listener.begin(client.session, client.now)
    client.until(client.now + 1.0)


def answer(listener: TcpUdpHq, client: Timed, topic: Topic, message: FleetMessage | None) -> None:
    assert isinstance(client.session, HqClient)
    listener.answer(client.session, topic, message, client.now)
    client.until(client.now + 1.0)


def said(listener: TcpUdpHq, client: Timed, data: bytes, *, datagram: bool = False) -> list[tuple[Topic, FleetMessage]]:
    """What the listener makes of what a client sent."""
    assert isinstance(client.session, HqClient)
    receive = client.datagram if datagram else client.stream
    return [entry for message in receive(data, client.now) for entry in listener.take(client.session, message)]


def greeting(listener: TcpUdpHq) -> bytes:
    (frame,) = connected(listener).frames("tcp")
    return frame


def flags(listener: TcpUdpHq) -> str:
    """The flags of the settings of 1.3: UDP, Cam, Joystick, Chat, Lidar, LidarSim, SLAMMap."""
    return greeting(listener)[-15:-8].hex()


def announced(frame: bytes) -> tuple[int, int]:
    """SLAMMapSize and SLAMMapIntervall of the settings of 1.3, which end with them."""
    return int.from_bytes(frame[-8:-4], "little"), int.from_bytes(frame[-4:], "little")


def cells_of(frame: bytes) -> bytes:
    """The cells of packet 53."""
    assert frame[4:6] == b"\x01\x35"
    assert int.from_bytes(frame[:4], "little") == len(frame) - 4
    assert int.from_bytes(frame[6:10], "little") == len(frame) - 10
    return frame[10:]


def wall(side_cells: int, cell_m: float = 0.1) -> Map:
    """A free square with one obstacle in its far corner."""
    cells = np.ones((side_cells, side_cells), np.uint8)
    cells[-1, -1] = 2
    return Map(side_cells, side_cells, cell_m, (0.0, 0.0), cells)


# The settings, which the robot sends first


def test_a_client_is_greeted_with_its_id_the_versions_and_all_features_while_no_robot_was_seen() -> None:
    expected = bytes.fromhex("21000000 01 02 07 0b000000") + LISTED + bytes.fromhex("01010101010101 e8030000 0a000000")
    assert connected(side(), 7).frames("tcp") == [expected]


@pytest.mark.parametrize(
    ("versions", "expected"),
    [
        (("1.1",), "0f000000 01 02 02 03000000 312e31 0101010101"),
        (("1.2",), "10000000 01 02 02 03000000 312e32 010101010101"),
        (("1.2", "1.1"), "14000000 01 02 02 07000000 312e322c312e31 010101010101"),
        (("1.3",), "19000000 01 02 02 03000000 312e33 01010101010101 e8030000 0a000000"),
        (
            ("1.1", "1.2", "1.3", "1.4"),
            "25000000 01 02 02 0f000000 312e312c312e322c312e332c312e34 01010101010101 e8030000 0a000000",
        ),
    ],
)
def test_versions_are_sent_verbatim_with_the_settings_of_the_newest(versions: tuple[str, ...], expected: str) -> None:
    assert greeting(side(versions=versions)) == bytes.fromhex(expected)


def test_a_listener_without_datagrams_does_not_announce_them() -> None:
    listener = side(udp=False)
    assert flags(listener) == "00010101010101"
    assert not listener.datagrams
    assert side().datagrams


@pytest.mark.parametrize(
    ("version", "features", "expected"),
    [
        ("1.1", ("udp", "joystick"), "01000100000000"),
        ("1.1", ("joystick", "lidar"), "01000100010001"),  # no flag of its own for the map: Lidar says it
        ("1.2", ("cam", "chat", "lidar", "lidar_sim"), "01010001010101"),
        ("1.3", ("udp", "lidar_sim", "slam_map"), "01000000000101"),
        ("1.3", ("joystick", "lidar"), "01000100010000"),
        ("1.4", ("joystick", "slam_map"), "01000100000001"),
        ("1.3", (), "01000000000000"),
        ("1.3", ("joystick", "of tomorrow"), "01000100000000"),
    ],
)
def test_a_robot_of_the_same_protocol_is_announced_as_it_announced_itself(version, features, expected) -> None:
    assert flags(side(robot(version, *features))) == expected


def test_a_robot_of_another_protocol_can_be_driven_and_has_a_map_where_there_is_one() -> None:
    view = robot(None, "lidar", "chat", protocol="alf")
    assert flags(side(view)) == "01000100000000"
    view.note(topics.MAP, CORNER)
    assert flags(side(view)) == "01000100000001"


def test_a_feature_that_the_version_agreed_has_no_flag_for_is_counted_as_left_out() -> None:
    view = robot("1.3", "joystick", "lidar_sim", "slam_map")

    def left_out(version: str, **options: Any) -> dict[str, int]:
        listener = side(view, **options)
        client = joined(listener, version)
        begin(listener, client)
        return dict(client.session.left_out)

    assert left_out("1.1") == left_out("1.1", versions=("1.1",)) == {"feature lidar_sim": 1, "feature slam_map": 1}
    assert left_out("1.2") == {"feature slam_map": 1}
    assert left_out("1.3") == {}
    assert greeting(side(view, versions=("1.1",)))[-5:].hex() == "0100010000"


def test_each_client_is_announced_the_robot_as_it_is_when_it_connects() -> None:
    view = robot("1.3", "joystick")
    listener = side(view)
    assert flags(listener) == "01000100000000"
    view.note(topics.STATUS, Status("established", protocol="tcpudp", version="1.3", features=("cam",)))
    assert flags(listener) == "01010000000000"
    view.note(topics.STATUS, Status("offline", protocol="tcpudp"))
    assert flags(listener) == "01010000000000"  # away for a moment, the same robot


def test_the_byte_that_some_hq_programs_skip_is_left_out_where_the_listener_says_so() -> None:
    view = robot("1.3", "joystick", "lidar_sim")
    expected = "20000000 01 02 02 0b000000" + LISTED.hex() + "010001000001 e8030000 0a000000"
    assert greeting(side(view, skip_map_flag=True)) == bytes.fromhex(expected)
    twelve = "10000000 01 02 02 03000000 312e32 010001000001"
    assert greeting(side(view, skip_map_flag=True, versions=("1.2",))) == bytes.fromhex(twelve)


def test_a_map_of_no_cells_cannot_be_configured() -> None:
    with pytest.raises(msgspec.ValidationError, match="slam_map_size is smaller than slam_map_interval"):
        msgspec.convert({"slam_map_size": 5, "slam_map_interval": 10}, HqOptions)


@pytest.mark.parametrize("versions", [[], ["one"], ["1.1,1.2"], [""]])
def test_versions_that_are_none_cannot_be_configured(versions: list[str]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"versions": versions}, HqOptions)


# The size of the map, announced before the client is known


def test_the_map_is_announced_in_its_own_cells() -> None:
    view = RobotView()
    view.note(topics.MAP, wall(50, 0.1))
    assert announced(greeting(side(view))) == (500, 10)


def test_a_map_that_is_not_known_yet_is_announced_as_configured_but_no_larger_than_fits() -> None:
    assert announced(greeting(side(slam_map_size=300, slam_map_interval=3))) == (300, 3)
    assert announced(greeting(side(slam_map_size=1000, slam_map_interval=1))) == (244, 1)
    assert announced(greeting(side(slam_map_size=1000, slam_map_interval=1, udp=False))) == (46, 1)


@pytest.mark.parametrize("cell", [0.0, -0.1, math.nan, math.inf, 1e-300, 1e9, 1e300])
def test_a_map_with_absurd_cells_keeps_no_client_from_connecting(cell: float) -> None:
    view = RobotView()
    view.note(topics.MAP, Map(1, 1, cell, (0.0, 0.0), np.array([[2]], np.uint8)))
    view.note(topics.POSE, POSE)
    listener = side(view)
    assert announced(greeting(listener)) == (1000, 10)
    client = joined(listener)
    begin(listener, client)
    assert client.frames("tcp") == [POSITION]
    assert client.session.left_out == {"map": 1}
    with pytest.raises(EncodeError):
        show(listener, topics.MAP, view.map or CORNER, client)


# Handshakes


def test_a_client_of_1_3_shakes_hands_with_datagrams() -> None:
    client = connected(side(robot("1.3", "joystick")), 5)
    client.stream(client_settings(sender=0), 0.1)  # before it has read the settings its id is 0
    assert client.frames("tcp", 0.05) == [START]
    assert client.session.claims(framed(0, 5), 11000)
    client.datagram(framed(5, 5), 0.2)
    assert client.frames("udp") == [ANSWER_TRUE]
    assert client.session.state is State.HANDSHAKING
    client.stream(framed(5, 7, b"\x01"), 0.3)
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, "1.3")
    assert (client.session.transport, client.session.features) == ("udp", ("udp", "lidar_sim"))
    assert client.session.traffic.malformed == 0


def test_a_client_whose_datagram_is_lost_is_shown_the_robot_by_tcp() -> None:
    listener = side()
    client = connected(listener, 5)
    client.stream(client_settings(), 0.1)
    client.until(2.0)
    assert client.frames("tcp", 0.05) == [START]
    client.stream(framed(5, 7, b"\x01"), 2.3)  # "their 7 is always true"
    assert (client.session.state, client.session.transport) == (State.ESTABLISHED, "tcp")
    show(listener, topics.POSE, POSE, client)
    assert client.frames("tcp", 2.3) == [POSITION]
    assert client.frames("udp") == []


@pytest.mark.parametrize(("options", "port"), [({}, 11000), ({"client_port": 40000}, 40000)])
def test_a_client_that_sends_its_datagrams_all_the_same_is_understood(options: dict[str, Any], port: int) -> None:
    listener = side(**options)
    client = connected(listener, 5)
    client.stream(client_settings(), 0.1)
    client.stream(framed(5, 7, b"\x01"), 2.3)
    assert not client.session.claims(bytes.fromhex("02000000 05 0d"), port + 1)
    assert client.session.claims(bytes.fromhex("02000000 05 0d"), port)
    assert said(listener, client, bytes.fromhex("06000000 05 0c 0000003f"), datagram=True) == [
        (topics.CMD_DRIVE, Drive(turn=-0.5))
    ]


@pytest.mark.parametrize("version", ["1.1", "1.2", "1.3"])
def test_one_listener_shakes_hands_with_clients_of_each_version(version: str) -> None:
    joined(side(), version)
    joined(side(), version, udp=True)


def test_a_client_of_1_1_at_its_own_port_is_greeted_as_by_a_robot_of_1_1() -> None:
    listener = side(robot("1.1", "lidar", "joystick"), versions=("1.1",), udp=False)
    client = connected(listener)
    assert client.frames("tcp") == [bytes.fromhex("0f000000 01 02 02 03000000 312e31 0000010001")]
    client.stream(bytes.fromhex("0e000000 00 03 03000000 312e31 0100000000"), 0.1)
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, "1.1")
    assert client.frames("tcp", 0.05) == []


def test_a_client_without_a_common_version_is_told_why_and_let_go() -> None:
    client = connected(side(versions=("1.3",)))
    client.stream(client_settings(b"1.1", "0100000000"), 0.1)
    client.until(1.0)
    (told,) = client.frames("tcp", 0.05)
    assert told[4:6] == b"\x01\x01"
    assert b"1.1" in told
    assert b"1.3" in told
    assert client.session.state is State.CLOSED
    assert "no common version" in str(client.session.reason)


def test_a_client_that_does_not_answer_the_settings_is_let_go() -> None:
    client = connected(side())
    client.until(6.0)
    assert client.session.state is State.CLOSED
    assert "5 s" in str(client.session.reason)


# What clients are shown


def test_the_last_map_and_position_are_sent_once_after_the_handshake() -> None:
    view = RobotView()
    view.note(topics.MAP, CORNER)
    view.note(topics.POSE, POSE)
    listener = side(view)
    client = joined(listener)
    begin(listener, client)
    map_frame, position = client.frames("tcp")
    assert map_frame == bytes.fromhex("0f000000 01 35 09000000" + CORNER_CELLS)
    assert position == POSITION


def test_a_client_of_a_robot_that_said_nothing_yet_is_sent_nothing_after_the_handshake() -> None:
    listener = side()
    client = joined(listener)
    begin(listener, client)
    assert client.sent == []


@pytest.mark.parametrize("version", ["1.1", "1.2", "1.3"])
@pytest.mark.parametrize("udp", [False, True])
def test_positions_go_to_clients_of_every_version_by_what_was_agreed(version: str, udp: bool) -> None:
    listener = side()
    client = joined(listener, version, udp=udp)
    show(listener, topics.POSE, POSE, client)
    assert client.frames("udp" if udp else "tcp") == [POSITION]
    assert len(client.sent) == 1


def test_positions_are_scaled_and_turned_as_configured() -> None:
    listener = side(length_unit_m=1.0, heading_offset=0.0)
    client = joined(listener)
    show(listener, topics.POSE, Pose(1.5, -2.25, math.pi / 2), client)
    assert client.frames("tcp") == [POSITION]


@pytest.mark.parametrize(
    "pose", [Pose(math.nan, 0.0, 0.0), Pose(0.0, math.inf, 0.0), Pose(0.0, 0.0, -math.inf), Pose(1e300, 0.0, 0.0)]
)
def test_a_position_that_is_no_number_is_not_shown(pose: Pose) -> None:
    view = RobotView()
    view.note(topics.POSE, pose)
    view.note(topics.MAP, CORNER)
    listener = side(view)
    client = joined(listener)
    with pytest.raises(EncodeError):
        listener.show(topics.POSE, pose)
    begin(listener, client)
    assert [frame[5] for frame in client.frames("tcp")] == [0x35]
    assert client.session.left_out == {"pose": 1}


def test_of_positions_that_could_not_be_written_yet_only_the_newest_is() -> None:
    listener = side()
    client = joined(listener)
    for x in (1.0, 2.0, 3.0):
        send = listener.show(topics.POSE, Pose(x, 0.0, math.pi / 2))
        assert send is not None
        send(client.session, client.now)
    client.until(client.now + 1.0)
    assert client.frames("tcp") == [bytes.fromhex("0e000000 01 37 00009643 00000000 00000000")]


def test_packets_are_never_written_together() -> None:
    listener = side(gap_s=0.05)
    client = joined(listener)
    for topic, message in ((topics.POSE, POSE), (topics.MAP, CORNER), (topics.LIDAR, Switch(True))):
        send = listener.show(topic, message)
        assert send is not None
        send(client.session, client.now)
    for text in ("one", "two"):
        send = listener.show(topics.TEXT, Text(text))
        assert send is not None
        send(client.session, client.now)
    client.until(client.now + 1.0)
    times = [sent.at for sent in client.sent]
    assert len(times) == 5
    assert min(later - earlier for earlier, later in pairwise(times)) >= 0.05 - 1e-9


@pytest.mark.parametrize(("on", "expected"), [(True, "06000000 01 33 01000000"), (False, "06000000 01 33 02000000")])
def test_the_state_of_the_lidar_goes_by_tcp(on: bool, expected: str) -> None:
    listener = side()
    client = joined(listener, udp=True)
    show(listener, topics.LIDAR, Switch(on), client)
    assert client.frames("tcp") == [bytes.fromhex(expected)]
    assert client.frames("udp") == []


ALL_OF_A_ROBOT: tuple[tuple[Topic, FleetMessage], ...] = (
    (topics.POSE, POSE),
    (topics.MAP, CORNER),
    (topics.LIDAR, Switch(True)),
    (topics.CAMERA, Switch(True)),
    (topics.TEXT, Text("bye")),
    (topics.TEXT, Text("simulated lidar data", "request")),
    (topics.RAW("tcpudp"), Raw(40, b"chat")),
    (topics.RAW("tcpudp"), Raw(70, b"led")),
    (topics.RAW("tcpudp"), Raw(70, b"led")),
)


@pytest.mark.parametrize(
    ("version", "ids"), [("1.1", [1, 51, 53, 55]), ("1.2", [1, 51, 53, 55, 60]), ("1.3", [1, 51, 53, 55, 60])]
)
@pytest.mark.parametrize("udp", [False, True])
def test_a_client_gets_the_packets_that_its_version_knows_and_the_rest_is_counted(version, ids, udp) -> None:
    listener = side()
    client = joined(listener, version, udp=udp)
    for topic, message in ALL_OF_A_ROBOT:
        show(listener, topic, message, client)
    assert sorted(sent.frame[5] for sent in client.sent) == ids
    assert client.session.left_out["serverCamMode (31)"] == 1
    assert client.session.left_out["chatMessage (40)"] == 1
    assert client.session.left_out["packet 70"] == 2


def test_packets_that_a_listener_says_its_clients_know_are_passed_on() -> None:
    listener = side(known=(31, 40, 70))
    client = joined(listener, "1.1")
    for topic, message in ALL_OF_A_ROBOT[:-1]:
        show(listener, topic, message, client)
    frames = {frame[5]: frame for frame in client.frames("tcp")}
    assert frames[31] == bytes.fromhex("06000000 01 1f 01000000")
    assert frames[40] == bytes.fromhex("06000000 01 28 63686174")
    assert frames[70] == bytes.fromhex("05000000 01 46 6c6564")


def test_raw_packets_are_none_that_a_fleet_message_holds_none_beyond_a_byte_and_none_that_clients_lose() -> None:
    listener = side(known=(2, 13, 40, 55))
    raw = topics.RAW("tcpudp")
    for held in (1, 2, 13, 53, 55):
        assert listener.show(raw, Raw(held, b"")) is None
    for packet_id in (256, -1):
        with pytest.raises(EncodeError):
            listener.show(raw, Raw(packet_id))
    client = joined(listener)
    show(listener, raw, Raw(40, bytes(2193)), client)
    assert [len(frame) for frame in client.frames("tcp")] == [2199]
    with pytest.raises(EncodeError):  # they lose packets of 2.2 kB
        listener.show(raw, Raw(40, bytes(2194)))


@pytest.mark.parametrize(
    ("version", "block", "asked"),
    [
        ("1.2", "010000000001", True),
        ("1.3", "01000000000101", True),
        ("1.3", "01010101010001", False),
        ("1.2", "010101010100", False),
        ("1.1", "0101010101", False),
    ],
)
def test_simulated_lidar_data_is_asked_of_those_who_announced_it(version: str, block: str, asked: bool) -> None:
    listener = side()
    client = joined(listener, version, block=block)
    show(listener, topics.TEXT, Text("simulated lidar data", "request"), client)
    assert client.frames("tcp") == ([bytes.fromhex("02000000 01 3c")] if asked else [])


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("bye", "627965"),
        ("grün", "67725c7866636e"),
        ("\N{ROBOT FACE}", "5c553030303166393136"),
        ("\udcff", "5c7564636666"),
    ],
)
def test_texts_are_shown_in_ascii(text: str, shown: str) -> None:
    listener = side()
    client = joined(listener, udp=True)
    show(listener, topics.TEXT, Text(text), client)
    body = bytes.fromhex(shown)
    assert client.frames("tcp") == [framed(1, 1, counted(body))]


def test_an_empty_text_is_shown_to_nobody() -> None:
    assert side().show(topics.TEXT, Text("")) is None


@pytest.mark.parametrize("text", ["a" * 100_000, "ü" * 5000])
def test_a_long_text_is_cut_so_that_clients_do_not_lose_it(text: str) -> None:
    listener = side()
    client = joined(listener)
    show(listener, topics.TEXT, Text(text), client)
    assert isinstance(client.session, HqClient)
    listener.tell(client.session, text, client.now)
    client.until(client.now + 1.0)
    shown, told = client.frames("tcp")
    assert shown == told
    assert 500 < len(shown) < 2200


def test_texts_are_queued_and_none_replaces_another_until_too_many_wait() -> None:
    listener = side()
    client = joined(listener)
    with pytest.raises(Refused):  # noqa: PT012
        for number in range(1000):
            send = listener.show(topics.TEXT, Text(f"{number:03}"))
            assert send is not None
            send(client.session, client.now)
    client.until(client.now + 10.0)
    texts = [frame[10:].decode() for frame in client.frames("tcp")]
    assert texts == [f"{number:03}" for number in range(len(texts))]
    assert len(texts) >= 16


def test_scans_and_readings_have_no_packet() -> None:
    scan = Scan(0.0, 0.1, 0.0, 1.0, np.ones(3, np.float32))
    assert side().show(topics.SCAN, scan) is None


# Maps


@pytest.mark.parametrize("version", ["1.1", "1.2", "1.3"])
def test_a_map_that_is_not_there_yet_has_a_count_of_no_cells(version: str) -> None:
    listener = side()
    client = joined(listener, version)
    show(listener, topics.MAP, Map(0, 0, 0.1, (0.0, 0.0), np.zeros((0, 0), np.uint8)), client)
    assert client.frames("tcp") == [EMPTY_MAP]


@pytest.mark.parametrize("version", ["1.1", "1.2"])
def test_clients_that_were_told_no_size_get_the_smallest_square_around_the_map(version: str) -> None:
    listener = side()
    client = joined(listener, version, udp=True)
    show(listener, topics.MAP, CORNER, client)
    assert client.frames("udp") == [bytes.fromhex("0f000000 01 35 09000000" + CORNER_CELLS)]
    assert client.frames("tcp") == []


def test_a_map_of_the_captured_robot_is_passed_on_as_it_was() -> None:
    recorded = next(record.payload for record in payloads(NEW, source=11001) if record.payload[5] == 53)
    cells = np.frombuffer(recorded[10:], np.uint8).reshape(20, 20).T
    view = robot("1.3", "udp", "lidar_sim", "slam_map")
    view.note(topics.MAP, Map(20, 20, 0.01, (-0.1, -0.1), cells))
    listener = side(view)
    assert announced(greeting(listener)) == (20, 1)
    for version in ("1.1", "1.3"):
        for udp in (False, True):
            client = joined(listener, version, udp=udp)
            begin(listener, client)
            assert client.frames("udp" if udp else "tcp") == [recorded]


@pytest.mark.parametrize("version", ["1.1", "1.2", "1.3"])
@pytest.mark.parametrize(("udp", "limit"), [(False, 2199), (True, 60_000)])
@pytest.mark.parametrize("side_cells", [20, 46, 47, 244, 245, 400, 2048])
def test_a_map_of_any_size_fits_and_keeps_its_obstacle(version: str, udp: bool, limit: int, side_cells: int) -> None:
    view = RobotView()
    view.note(topics.MAP, wall(side_cells))
    listener = side(view)
    size, interval = announced(greeting(listener))
    assert size >= side_cells * 10
    client = joined(listener, version, udp=udp)
    begin(listener, client)
    (frame,) = client.frames("udp" if udp else "tcp")
    assert len(frame) <= limit
    cells = cells_of(frame)
    root = math.isqrt(len(cells))
    assert root * root == len(cells)
    assert cells.count(2) == 1
    if version == "1.3" and udp:
        assert root == size // interval
    if side_cells**2 + 10 <= limit:
        assert root == side_cells


def test_a_client_of_1_3_gets_every_later_map_in_the_cells_it_was_announced() -> None:
    view = RobotView()
    view.note(topics.MAP, CORNER)
    listener = side(view)
    client = joined(listener, udp=True)
    finer = np.zeros((8, 8), np.uint8)
    finer[0, 1] = 2  # at x 5 to 10 cm, y 0 to 5 cm: in the cell (0, 0)
    finer[5, 2] = 1  # at x 10 to 15 cm, y 25 to 30 cm: in the cell x 1, y 2
    show(listener, topics.MAP, Map(6, 6, 0.05, (0.0, 0.0), finer[:6, :6]), client)
    assert [cells_of(frame).hex() for frame in client.frames("udp")] == ["020000000001000000"]
    assert client.session.left_out == {}


def test_a_map_larger_than_a_client_was_told_is_shown_whole_in_larger_cells_and_that_is_counted() -> None:
    view = RobotView()
    view.note(topics.MAP, CORNER)
    listener = side(view)
    client = joined(listener, udp=True)
    cells = np.zeros((6, 6), np.uint8)
    cells[0, 0], cells[5, 5], cells[3, 4] = 2, 2, 1
    show(listener, topics.MAP, Map(6, 6, 0.1, (0.0, 0.0), cells), client)
    assert [cells_of(frame).hex() for frame in client.frames("udp")] == ["020000000000000102"]
    assert client.session.left_out == {"map to scale": 1}


def test_the_zero_of_a_robot_of_the_same_protocol_stays_where_its_programs_see_it() -> None:
    centred = np.zeros((40, 40), np.uint8)
    centred[20, 20] = 2  # at (0, 0) of a map of 4 m around it
    for origin, cell in (((-2.0, -2.0), (50, 50)), ((0.0, 0.0), (20, 20))):
        listener = side(robot("1.3", "joystick"))
        client = joined(listener, udp=True)
        show(listener, topics.MAP, Map(40, 40, 0.1, origin, centred), client)
        (frame,) = client.frames("udp")
        shown = np.frombuffer(cells_of(frame), np.uint8).reshape(100, 100)
        assert [tuple(at) for at in np.argwhere(shown == 2).tolist()] == [cell]


def test_a_map_of_another_robot_is_centred_on_zero_or_placed_as_the_option_says() -> None:
    cells = np.zeros((20, 10), np.uint8)
    cells[5, 10 - 1] = 2  # x -0.1 to 0, y -1 to -0.9
    grid = Map(20, 10, 0.1, (-1.0, -1.5), cells)
    for options, cell in (({}, (49, 40)), ({"map_origin": (-2.0, -3.0)}, (19, 20))):
        listener = side(robot(None, protocol="alf"), **options)
        client = joined(listener, udp=True)
        show(listener, topics.MAP, grid, client)
        (frame,) = client.frames("udp")
        shown = np.frombuffer(cells_of(frame), np.uint8).reshape(100, 100)
        assert [tuple(at) for at in np.argwhere(shown == 2).tolist()] == [cell]


def test_clients_that_came_at_different_times_each_get_what_they_were_announced() -> None:
    view = RobotView()
    listener = side(view, slam_map_size=20, slam_map_interval=10)
    early = joined(listener, udp=True)
    view.note(topics.MAP, CORNER)
    late = joined(listener, udp=True, number=3)
    show(listener, topics.MAP, CORNER, early, late)
    assert [cells_of(frame).hex() for frame in early.frames("udp")] == ["01000202"]
    assert [cells_of(frame).hex() for frame in late.frames("udp")] == [CORNER_CELLS.replace(" ", "")]


def test_a_client_of_1_3_whose_datagrams_fail_gets_a_square_by_tcp_where_the_announced_one_does_not_fit() -> None:
    view = RobotView()
    view.note(topics.MAP, wall(100))
    listener = side(view)
    client = joined(listener)
    begin(listener, client)
    (frame,) = client.frames("tcp")
    assert len(cells_of(frame)) == 46 * 46
    assert frame[-1] == 2


def test_a_listener_without_datagrams_announces_a_map_that_fits_by_tcp() -> None:
    view = RobotView()
    view.note(topics.MAP, wall(100))
    listener = side(view, udp=False)
    size, interval = announced(greeting(listener))
    client = joined(listener)
    begin(listener, client)
    (frame,) = client.frames("tcp")
    assert len(frame) < 2200
    assert len(cells_of(frame)) == (size // interval) ** 2
    assert size >= 1000


# The first programs of 1.1 have no handlers for 53 and 55: who asks (52, 54) has


ASK_MAP, ASK_POSE = bytes.fromhex("02000000 02 34"), bytes.fromhex("02000000 02 36")


def seen() -> RobotView:
    """A robot whose map and position are known."""
    view = robot("1.1", "lidar", "joystick")
    view.note(topics.MAP, CORNER)
    view.note(topics.POSE, POSE)
    return view


def kinds_shown(listener: TcpUdpHq, client: Timed) -> list[int]:
    """Which packets a client gets of a new map and a new position."""
    client.sent.clear()
    show(listener, topics.MAP, CORNER, client)
    show(listener, topics.POSE, POSE, client)
    return [sent.frame[5] for sent in client.sent]


@pytest.mark.parametrize("udp", [False, True])
@pytest.mark.parametrize("versions", [("1.1",), ("1.1", "1.2", "1.3")])
def test_a_client_of_1_1_that_never_asked_gets_no_map_and_no_position(versions: tuple[str, ...], udp: bool) -> None:
    listener = side(seen(), versions=versions)
    client = joined(listener, "1.1", udp=udp, asks=False)
    begin(listener, client)
    assert client.sent == []
    assert kinds_shown(listener, client) == []
    assert client.session.left_out["servertSLAMMap (53) unasked"] == 2
    assert client.session.left_out["serverPosition (55) unasked"] == 2


@pytest.mark.parametrize(
    ("asked", "topic", "shown"), [(ASK_MAP, topics.RPC_MAP, [53]), (ASK_POSE, topics.RPC_POSE, [55])]
)
def test_a_client_of_1_1_that_asked_for_one_gets_that_one_from_then_on(asked, topic, shown) -> None:
    listener = side(seen())
    client = joined(listener, "1.1", asks=False)
    assert said(listener, client, asked) == [(topic, Query())]
    answer(listener, client, topic, None)
    assert [sent.frame[5] for sent in client.sent] == shown
    assert kinds_shown(listener, client) == shown
    other = joined(listener, "1.1", number=3, asks=False)
    assert kinds_shown(listener, other) == [], "each for itself"


def test_a_client_of_1_1_that_asked_for_both_gets_both() -> None:
    listener = side(seen())
    client = joined(listener, "1.1", asks=False)
    said(listener, client, ASK_POSE + ASK_MAP)
    assert kinds_shown(listener, client) == [53, 55]


def test_a_listener_may_be_told_that_its_clients_of_1_1_take_them_unasked() -> None:
    listener = side(seen(), unasked=True)
    client = joined(listener, "1.1", asks=False)
    begin(listener, client)
    assert [sent.frame[5] for sent in client.sent] == [53, 55]
    assert kinds_shown(listener, client) == [53, 55]


@pytest.mark.parametrize("version", ["1.2", "1.3"])
def test_clients_of_later_versions_need_not_ask(version: str) -> None:
    listener = side(seen())
    client = joined(listener, version, asks=False)
    begin(listener, client)
    assert [sent.frame[5] for sent in client.sent] == [53, 55]
    assert kinds_shown(listener, client) == [53, 55]


# Questions


def test_questions_are_passed_on() -> None:
    listener = side()
    client = joined(listener)
    assert said(listener, client, bytes.fromhex("02000000 02 34")) == [(topics.RPC_MAP, Query())]
    assert said(listener, client, bytes.fromhex("02000000 02 36")) == [(topics.RPC_POSE, Query())]


def test_questions_are_answered_with_what_the_robot_says_else_with_what_it_said_last() -> None:
    view = RobotView()
    listener = side(view, slam_map_size=30, slam_map_interval=10)
    client = joined(listener)
    answer(listener, client, topics.RPC_POSE, POSE)
    answer(listener, client, topics.RPC_MAP, CORNER)
    asked = [POSITION, bytes.fromhex("0f000000 01 35 09000000" + CORNER_CELLS)]
    assert client.frames("tcp") == asked
    view.note(topics.POSE, POSE)
    view.note(topics.MAP, CORNER)
    answer(listener, client, topics.RPC_POSE, None)
    answer(listener, client, topics.RPC_MAP, None)
    assert client.frames("tcp") == asked * 2


def test_a_map_that_nobody_has_is_answered_with_an_empty_one_and_a_position_with_a_text() -> None:
    listener = side()
    client = joined(listener, "1.1")
    answer(listener, client, topics.RPC_MAP, None)
    answer(listener, client, topics.RPC_POSE, None)
    empty, text = client.frames("tcp")
    assert empty == EMPTY_MAP
    assert text[4:6] == b"\x01\x01"
    assert b"position" in text


# What clients command


@pytest.mark.parametrize("sender", [0, 1, 2, 9])
@pytest.mark.parametrize(
    ("packet", "drive"),
    [
        ("0b 00000000 0000803f 0000803f", Drive(forward=1.0)),  # y is forward
        ("0b 00000000 000080bf 0000003f", Drive(forward=-0.5)),
        ("0b 0000803f 00000000 0000803f", Drive(left=-1.0)),  # x is right
        ("0b 000080bf 00000000 0000803e", Drive(left=0.25)),
        ("0b 00000000 0000803f 00000000", Drive()),
        ("0c 0000803f", Drive(turn=-1.0)),  # positive to the right
        ("0c 000040bf", Drive(turn=0.75)),
        ("0c 0000c07f", None),
        ("0c 0000807f", None),
        ("0d", Drive()),
        ("0b 00000000 0000803f 0000c03f", Drive(forward=1.0)),  # clipped to full scale
        ("0b 00000000 0000a040 000080bf", Drive(forward=-1.0)),
        ("0c ffff7f7f", Drive(turn=-1.0)),
        ("0c ffff7fff", Drive(turn=1.0)),
        ("0b ffff7f7f 00000000 ffff7f7f", Drive(left=-1.0)),
        ("0b 0000c07f 0000803f 0000803f", None),
        ("0b 00000000 000080ff 0000803f", None),
        ("0b 00000000 0000803f 0000c07f", None),
        ("0b 00000000 0000807f 00000000", None),
    ],
)
def test_a_stick_drives(packet: str, drive: Drive | None, sender: int) -> None:
    listener = side()
    client = joined(listener)
    head, body = bytes.fromhex(packet)[0], bytes.fromhex(packet)[1:]
    if drive is None:
        with pytest.raises(ProtocolError):
            said(listener, client, framed(sender, head, body))
    else:
        assert said(listener, client, framed(sender, head, body)) == [(topics.CMD_DRIVE, drive)]


def test_a_direction_longer_than_one_keeps_its_direction() -> None:
    listener = side()
    ((_, drive),) = said(listener, joined(listener), bytes.fromhex("0e000000 02 0b 00004040 00008040 0000803f"))
    assert isinstance(drive, Drive)
    assert (drive.forward, drive.left, drive.turn) == pytest.approx((0.8, -0.6, 0.0))


def test_full_scale_is_what_the_listener_says() -> None:
    listener = side(speed_full=2.0, turn_full=4.0)
    client = joined(listener)
    move = bytes.fromhex("0e000000 02 0b 00000000 0000803f 0000803f")
    assert said(listener, client, move) == [(topics.CMD_DRIVE, Drive(forward=0.5))]
    assert said(listener, client, bytes.fromhex("06000000 02 0c 0000803f")) == [(topics.CMD_DRIVE, Drive(turn=-0.25))]


@given(st.binary(min_size=12, max_size=12), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
@example(bytes.fromhex("ffff7f7f ffff7fff ffff7f7f"), 1.0, 1.0)
@example(bytes.fromhex("01000000 01000000 01000000"), 1000.0, 1000.0)
def test_whatever_a_stick_says_the_bus_takes_the_drive_or_there_is_none(body, speed_full, turn_full) -> None:
    listener = side(speed_full=speed_full, turn_full=turn_full)
    client = joined(listener)
    for packet in (framed(2, 11, body), framed(2, 12, body[:4])):
        try:
            ((topic, drive),) = said(listener, client, packet)
        except ProtocolError:
            continue
        assert topic is topics.CMD_DRIVE
        assert payloads_codec.decode(Drive, payloads_codec.encode(drive)) == drive


@pytest.mark.parametrize(("mode", "meant"), [(1, "none"), (2, "manual"), (3, "autonomous")])
def test_control_modes_are_understood(mode: int, meant: str) -> None:
    listener = side()
    expected = [(topics.CMD_MODE, msgspec.convert({"mode": meant}, Mode))]
    assert said(listener, joined(listener), framed(2, 10, bytes([mode, 0, 0, 0]))) == expected


def test_the_lidar_is_switched() -> None:
    listener = side()
    client = joined(listener)
    assert said(listener, client, bytes.fromhex("06000000 02 32 01000000")) == [(topics.CMD_LIDAR, Switch(True))]
    assert said(listener, client, bytes.fromhex("06000000 02 32 02000000")) == [(topics.CMD_LIDAR, Switch(False))]


def test_texts_carry_the_name_of_the_session_and_empty_ones_are_nothing() -> None:
    listener = side()
    client = joined(listener)
    client.session.name = "hq.2"
    hello = bytes.fromhex("0e000000 01 01 08000000 6869207468657265")
    assert said(listener, client, hello) == [(topics.CMD_TEXT, Text("hi there", sender="hq.2"))]
    assert said(listener, client, bytes.fromhex("06000000 02 01 00000000")) == []
    ((_, odd),) = said(listener, client, bytes.fromhex("07000000 02 01 01000000 fc"))
    assert odd == Text("\\xfc", sender="hq.2")


@pytest.mark.parametrize("packet_id", [21, 40, *range(70, 80), 99, 255])
@pytest.mark.parametrize("body", ["", "00", "0102030405060708"])
def test_packets_that_no_fleet_message_holds_are_raw(packet_id: int, body: str) -> None:
    listener = side()
    content = bytes.fromhex(body)
    raw = said(listener, joined(listener), framed(2, packet_id, content))
    assert raw == [(topics.CMD_RAW("tcpudp"), Raw(packet_id, content))]


def scan_of(listener: TcpUdpHq, ranges: str, count: int) -> Scan:
    body = count.to_bytes(4, "little") + bytes.fromhex(ranges)
    ((topic, scan),) = said(listener, joined(listener), framed(2, 61, body))
    assert topic is topics.CMD_SCAN
    assert isinstance(scan, Scan)
    return scan


def test_simulated_lidar_data_is_a_turn_of_ranges_in_metres() -> None:
    scan = scan_of(side(), "0000c842" * 359 + "00004843", 360)
    assert (scan.angle_min, scan.angle_increment, scan.range_min) == pytest.approx((0.0, math.radians(1.0), 0.0))
    assert scan.range_max == pytest.approx(2.0)
    assert scan.ranges.tolist() == pytest.approx([1.0] * 359 + [2.0])


def test_a_range_of_nothing_is_none() -> None:
    # 0, -1, NaN, a signalling NaN, infinity, 100 cm
    scan = scan_of(side(), "00000000 000080bf 0000c07f 0100807f 0000807f 0000c842", 6)
    assert [math.isnan(value) for value in scan.ranges.tolist()] == [True] * 5 + [False]
    assert scan.range_max == pytest.approx(1.0)
    nothing = scan_of(side(), "00000000", 1)
    assert math.isnan(nothing.ranges[0])
    assert nothing.range_max == 0.0
    absurd = scan_of(side(length_unit_m=1e6), "ffff7f7f 0000803f", 2)
    assert absurd.ranges.tolist()[1] == 1e6
    assert math.isnan(absurd.ranges[0])


MALFORMED = {
    "a mode of nobody": "06000000 02 0a 04000000",
    "mode 0": "06000000 02 0a 00000000",
    "a mode cut short": "05000000 02 0a 020000",
    "a move with a float too few": "0a000000 02 0b 00000000 00000000",
    "a move with a byte too many": "0f000000 02 0b 00000000 00000000 00000000 00",
    "a rotation without speed": "02000000 02 0c",
    "a stop with a body": "03000000 02 0d 00",
    "lidar mode 3": "06000000 02 32 03000000",
    "a text that is shorter than it says": "08000000 02 01 05000000 6869",
    "a text of negative length": "06000000 02 01 ffffffff",
    "simulated lidar data without a range": "06000000 02 3d 00000000",
    "simulated lidar data that is shorter than it says": "0a000000 02 3d 68010000 0000c842",
    "a question with a body": "03000000 02 34 00",
    "a second answer to the settings": "18000000 02 03 0b000000" + LISTED.hex() + "00000000000100",
    "a status nobody waits for": "03000000 02 07 01",
    "the datagram of the probe by TCP": "02000000 02 05",
    "a packet that robots send": "0e000000 01 37 0000c03f 000010c0 0000b442",
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_packet_is_no_command_and_the_next_one_is(name: str) -> None:
    listener = side()
    client = joined(listener)
    assert isinstance(client.session, HqClient)
    stop = bytes.fromhex("02000000 02 0d")
    got: list[tuple[Topic, FleetMessage]] = []
    refused = 0
    for message in client.stream(bytes.fromhex(MALFORMED[name]) + stop, client.now):
        try:
            got += listener.take(client.session, message)
        except ProtocolError:
            refused += 1
    assert got == [(topics.CMD_DRIVE, Drive())]
    assert refused + client.session.traffic.malformed == 1
    assert client.session.state is State.ESTABLISHED
    assert client.sent == []


@pytest.mark.parametrize("length", ["00000000", "01000000", "ffffffff", "ffffff7f"])
def test_a_length_that_cannot_be_ends_the_session(length: str) -> None:
    client = joined(side())
    client.stream(bytes.fromhex(length + "020d"), client.now)
    assert client.session.state is State.CLOSED
    assert "broken stream" in str(client.session.reason)


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=8), st.booleans())
def test_whatever_a_client_sends_gives_commands_the_bus_takes_or_counts_as_malformed(sent, by_datagram) -> None:
    listener = side()
    client = joined(listener, udp=by_datagram)
    for packet_id, body in sent:
        try:
            commands = said(listener, client, framed(2, packet_id, body), datagram=by_datagram)
        except ProtocolError:
            continue
        for topic, command in commands:
            assert type(command) is topic.message
            payloads_codec.decode(topic.message, payloads_codec.encode(command))


# Each message is encoded once


class Counts:
    """How often the code under test encodes a packet, and makes a map of another size."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.packets: list[str] = []
        self.maps = 0

        def count_packet(message: Packet, sender_id: int) -> bytes:
            self.packets.append(type(message).__name__)
            return encode_packet(message, sender_id)

        def count_resampled(grid: Map, side: int, cell_m: float, begin: tuple[float, float]) -> bytes:
            self.maps += 1
            return resampled(grid, side, cell_m, begin)

        def count_squared(grid: Map, most: int) -> bytes:
            self.maps += 1
            return squared(grid, most)

        for module in (client_module, display):
            monkeypatch.setattr(module, "encode_packet", count_packet)
        monkeypatch.setattr(display, "resampled", count_resampled)
        monkeypatch.setattr(display, "squared", count_squared)


def crowd(listener: TcpUdpHq, of_each: int = 5) -> list[Timed]:
    kinds: Iterable[tuple[str, bool]] = [(version, udp) for version in LISTS for udp in (False, True)]
    return [joined(listener, version, udp=udp) for version, udp in kinds for _ in range(of_each)]


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        (topics.POSE, POSE),
        (topics.LIDAR, Switch(True)),
        (topics.CAMERA, Switch(True)),
        (topics.TEXT, Text("bye")),
        (topics.RAW("tcpudp"), Raw(40, b"chat")),
        (topics.RAW("tcpudp"), Raw(70, b"led")),
    ],
)
def test_a_message_is_encoded_once_for_clients_of_all_versions(topic, message, monkeypatch: pytest.MonkeyPatch) -> None:
    listener = side(known=(31, 40, 70))
    clients = crowd(listener)
    counts = Counts(monkeypatch)
    show(listener, topic, message, *clients)
    assert len(counts.packets) == 1
    assert [len(client.sent) for client in clients] == [1] * 30


def test_a_request_is_not_encoded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = side()
    clients = crowd(listener)
    counts = Counts(monkeypatch)
    show(listener, topics.TEXT, Text("simulated lidar data", "request"), *clients)
    assert counts.packets == []
    assert sum(len(client.sent) for client in clients) == 20


def test_a_map_is_made_once_for_each_size_that_it_is_shown_in(monkeypatch: pytest.MonkeyPatch) -> None:
    view = RobotView()
    view.note(topics.MAP, wall(100))
    listener = side(view)
    clients = crowd(listener)
    counts = Counts(monkeypatch)
    show(listener, topics.MAP, wall(100), *clients)
    # squares for what was told no size, by TCP and by UDP (the one by TCP also for 1.3), and the size announced to 1.3
    assert counts.maps == len(counts.packets) == 3
    assert [len(client.sent) for client in clients] == [1] * 30


def test_a_map_is_not_made_where_there_is_no_client(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = Counts(monkeypatch)
    assert side().show(topics.MAP, wall(244)) is not None
    assert counts.maps == 0


def test_clients_that_come_or_ask_later_are_shown_what_was_encoded_already(monkeypatch: pytest.MonkeyPatch) -> None:
    view = RobotView()
    view.note(topics.MAP, wall(100))
    view.note(topics.POSE, POSE)
    listener = side(view)
    clients = crowd(listener)
    counts = Counts(monkeypatch)
    for client in clients:
        begin(listener, client)
    assert counts.maps == 3
    assert sorted(counts.packets) == ["ServerPosition", *["ServerSLAMMap"] * 3]
    fresh, pose = wall(100), Pose(1.0, 2.0, 0.0)
    for client in clients:
        answer(listener, client, topics.RPC_MAP, fresh)
        answer(listener, client, topics.RPC_POSE, pose)
    assert counts.maps == 6
    assert len(counts.packets) == 8
    assert [len(client.sent) for client in clients] == [4] * 30


# The captured HQ programs


def replay(listener: TcpUdpHq, client: Timed, name: str, late: float = 0.0) -> list[tuple[float, Topic, FleetMessage]]:
    """Feed what the HQ of a capture sent, ``late`` seconds after it did; the handshake of one that is done is left out.

    Return what it commanded, and when.
    """
    assert isinstance(client.session, HqClient)
    client.session.name = "hq.2"
    commands: list[tuple[float, Topic, FleetMessage]] = []
    done = client.session.state is State.ESTABLISHED
    for record in payloads(name, destination=11001):
        at = record.seconds + late
        if done and record.payload[5] < 10 and record.payload[5] != 1:
            continue
        if record.transport == "UDP" and record.payload[5] == 5:
            assert record.payload[5] != 5 or client.session.claims(record.payload, record.source)
        receive = client.datagram if record.transport == "UDP" else client.stream
        for message in receive(record.payload, at):
            commands += [(at, topic, command) for topic, command in listener.take(client.session, message)]
    assert client.session.traffic.malformed == 0
    return commands


DOCUMENTED = [topics.CMD_TEXT, topics.CMD_MODE, *[topics.CMD_DRIVE] * 3, topics.RPC_POSE, topics.RPC_MAP]
"""The captures: a text, control mode 2, move, rotate, stop, position, map; 1.3 also simulated lidar data."""


def check_documented(commands: list[tuple[float, Topic, FleetMessage]]) -> None:
    text, mode, move, rotate, stop, *_ = (command for _, _, command in commands)
    assert text == Text("hi there", sender="hq.2")
    assert mode == Mode("manual")
    assert isinstance(move, Drive)
    # x 0.6, y 0.8 at 1.5: half more than full scale
    assert (move.forward, move.left, move.turn) == pytest.approx((0.8, -0.6, 0.0))
    assert math.hypot(move.forward, move.left) <= 1.0
    assert rotate == Drive(turn=0.75)
    assert stop == Drive()


def captured(name: str) -> tuple[TcpUdpHq, Timed]:
    """The listener that each captured HQ meets, and its session."""
    if name == OLD:
        listener = side(robot("1.1", "joystick"), versions=("1.1",), udp=False)
    else:
        listener = side(robot("1.3", "udp", "lidar_sim", "slam_map"), slam_map_size=2048, slam_map_interval=16)
    return listener, connected(listener)


def test_the_captured_hq_of_1_1_commands_what_is_documented() -> None:
    listener, client = captured(OLD)
    commands = replay(listener, client, OLD)
    assert client.frames("tcp") == [bytes.fromhex("0f000000 01 02 02 03000000 312e31 0000010000")]
    assert client.session.version == "1.1"
    assert [topic for _, topic, _ in commands] == DOCUMENTED
    check_documented(commands)


def test_the_captured_hq_of_1_3_commands_what_is_documented() -> None:
    listener, client = captured(NEW)
    commands = replay(listener, client, NEW)
    greeted = "21000000 01 02 02 0b000000" + LISTED.hex() + "01000000000101 00080000 10000000"
    assert client.frames("tcp") == [bytes.fromhex(greeted), START]
    assert client.frames("udp") == [ANSWER_TRUE]
    assert (client.session.version, client.session.transport) == ("1.3", "udp")
    assert [topic for _, topic, _ in commands] == [*DOCUMENTED, topics.CMD_SCAN]
    check_documented(commands)
    scan = commands[-1][2]
    assert isinstance(scan, Scan)
    assert scan.ranges.tolist() == pytest.approx([1.0 + degree * 0.005 for degree in range(360)])
    assert scan.range_max == pytest.approx(2.795)


def test_the_captured_hq_of_1_1_is_served_by_a_listener_of_all_versions_too() -> None:
    listener = side()
    client = connected(listener)
    commands = replay(listener, client, OLD)
    # It announces datagrams and sends none: nothing it says is lost.
    assert client.frames("tcp", 0.01)[0] == START
    assert 6 not in [sent.frame[5] for sent in client.sent]
    assert [topic for _, topic, _ in commands] == DOCUMENTED
    check_documented(commands)
    client.until(10.0)
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, "1.1")


@pytest.mark.parametrize("name", [OLD, NEW])
def test_the_shown_robot_is_what_the_captured_one_showed(name: str) -> None:
    listener, client = captured(name)
    replay(listener, client, name)
    client.sent.clear()
    show(listener, topics.POSE, POSE, client)
    show(listener, topics.TEXT, Text("bye"), client)
    show(listener, topics.TEXT, Text("simulated lidar data", "request"), client)
    empty = Map(0, 0, 0.01, (0.0, 0.0), np.zeros((0, 0), np.uint8))
    show(listener, topics.MAP, empty, client)
    from_robot = [record for record in payloads(name, source=11001) if record.payload[5] not in (2, 4, 6)]
    recorded = {(record.transport.lower(), record.payload) for record in from_robot if len(record.payload) < 400}
    if name == OLD:  # whose robot leaves out the int that HQ programs need
        recorded = recorded - {("tcp", bytes.fromhex("02000000 01 35"))} | {("tcp", EMPTY_MAP)}
    shown = {(sent.by, sent.frame) for sent in client.sent}
    assert recorded <= shown


def carry_out(intent: Intent, commands: list[tuple[float, Topic, FleetMessage]]) -> list[Action | str]:
    """What the intent makes of motion and modes; a refusal by its reason."""
    done: list[Action | str] = []
    for at, _, command in commands:
        try:
            match command:
                case Mode():
                    done.append(intent.choose(command.mode, at))
                case Drive():
                    done.append(intent.motion(at) if command.moving else intent.neutral(at))
        except Refused as refusal:
            done.append(str(refusal))
    return done


def intent_of(listener: TcpUdpHq) -> Intent:
    """The intent of a client that has just connected."""
    intent = Intent(listener.deadman_s)
    for topic, command in listener.initial_commands():
        assert (topic, command) == (topics.CMD_MODE, Mode("none"))
        assert intent.choose("none", 0.0) is Action.NOTHING
    return intent


@pytest.mark.parametrize("name", [OLD, NEW])
def test_a_captured_hq_drives_only_after_it_has_said_neutral_once(name: str) -> None:
    listener, client = captured(name)
    assert listener.deadman_s == 1.3
    intent = intent_of(listener)
    owed = "connected: release the stick first"
    assert carry_out(intent, replay(listener, client, name)) == [Action.NOTHING, owed, owed, Action.NOTHING]
    again = replay(listener, client, name, late=10.0)
    assert carry_out(intent, again) == [Action.NOTHING, Action.ACQUIRE, Action.WAIT, Action.WAIT]
    intent.granted(3.0)
    third = replay(listener, client, name, late=20.0)
    assert carry_out(intent, third) == [Action.SEND] * 4


@pytest.mark.parametrize("name", [OLD, NEW])
def test_a_captured_hq_does_not_drive_without_its_control_mode(name: str) -> None:
    listener, client = captured(name)
    intent = intent_of(listener)
    intent.neutral(0.0)
    commands = [entry for entry in replay(listener, client, name) if not isinstance(entry[2], Mode)]
    moved, rotated, stopped = carry_out(intent, commands)
    assert moved == "control mode is none"
    assert str(rotated).startswith("control mode is none")
    assert stopped is Action.NOTHING


def test_ids_are_those_of_clients() -> None:
    listener = side(quiet_s=7.0)
    numbers = listener.numbers(10)
    assert [numbers.take(0.0) for _ in range(255)] == [*range(2, 256), None]
    numbers.release(9, 100.0)
    assert [numbers.take(now) for now in (106.9, 107.0)] == [None, 9]
    assert HqOptions().quiet_s == 2.0
    assert connected(listener, 255).frames("tcp")[0][6] == 255
