"""What HQ programs of each version are shown, and what they command. Bytes come from the protocol page, by hand."""

import math
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
from tests.gateways.tcpudp.frames import ANSWER_TRUE, LISTED, POSITION, START, Timed, client_settings, framed
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
CORNER_CELLS = "010000020000000200"
"""x = 0, 1, 2, each from y = 0 to 2."""
CORNER_FRAME = bytes.fromhex("0f000000 01 35 09000000" + CORNER_CELLS)
NO_MAP = Map(0, 0, 0.1, (0.0, 0.0), np.zeros((0, 0), np.uint8))
EMPTY_MAP = bytes.fromhex("06000000 01 35 00000000")
"""n = 0: deployed HQ programs throw for good on a 53 without its int."""
REQUEST = Text("simulated lidar data", "request")
BLOCKS = {"1.1": "0100000000", "1.2": "010000000001", "1.3": "01000000000101"}
"""What HQ programs of each version announce: UDP, LidarSim and SLAMMap as far as they have the flag."""
LISTS = {"1.1": b"1.1", "1.2": b"1.2", "1.3": LISTED}
VERSIONS = [*LISTS]
OLD, NEW = "tcpudp-1.1-tcp.hex", "tcpudp-1.3-udp.hex"
ASK_MAP, ASK_POSE = bytes.fromhex("02000000 02 34"), bytes.fromhex("02000000 02 36")

each_version = pytest.mark.parametrize("version", VERSIONS)
by_either = pytest.mark.parametrize("udp", [False, True], ids=["tcp", "udp"])


def robot(version: str | None, *features: str, protocol: str = "tcpudp") -> RobotView:
    """The view of an established robot."""
    view = RobotView()
    view.alive = True
    view.note(topics.STATUS, Status("established", protocol=protocol, version=version, features=features))
    return view


def knowing(grid: Map | None = None, pose: Pose | None = None, view: RobotView | None = None) -> RobotView:
    """The view of a robot whose map and position, as far as given, are known."""
    view = view or RobotView()
    if grid is not None:
        view.note(topics.MAP, grid)
    if pose is not None:
        view.note(topics.POSE, pose)
    return view


def side(view: RobotView | None = None, **options: Any) -> TcpUdpHq:
    return TcpUdpHq(HqOptions(**options), view or RobotView())


class Client(Timed):
    """A client of a listener; every act gives the frames that left because of it within a second."""

    session: HqClient

    def __init__(self, listener: TcpUdpHq, number: int = 2) -> None:
        self.listener = listener
        super().__init__(listener.session(number, BOUNDS))

    def begun(self) -> list[bytes]:
        self.listener.begin(self.session, self.now)
        return self.left()

    def shown(self, topic: Topic, message: FleetMessage, *, at_once: bool = False) -> list[bytes]:
        """What the client gets of news of the robot."""
        if (send := self.listener.show(topic, message)) is not None:
            send(self.session, self.now)
        return [] if at_once else self.left()

    def answered(self, topic: Topic, message: FleetMessage | None = None) -> list[bytes]:
        self.listener.answer(self.session, topic, message, self.now)
        return self.left()

    def said(self, data: bytes | str, *, datagram: bool = False) -> list[tuple[Topic, FleetMessage]]:
        """What the listener makes of what the client sends."""
        data = bytes.fromhex(data) if isinstance(data, str) else data
        receive = self.datagram if datagram else self.stream
        return [entry for message in receive(data, self.now) for entry in self.listener.take(self.session, message)]

    def left(self) -> list[bytes]:
        before = len(self.sent)
        self.until(self.now + 1.0)
        return [sent.frame for sent in self.sent[before:]]

    def gone(self) -> set[str]:
        """By which channels anything left since the handshake."""
        return {sent.by for sent in self.sent}


def joined(
    version: str = "1.3",
    view: RobotView | None = None,
    *,
    listener: TcpUdpHq | None = None,
    udp: bool = False,
    number: int = 2,
    block: str = "",
    asks: bool = True,
    **options: Any,
) -> Client:
    """A client whose handshake is done, and that asked for map and position; what it was sent so far is forgotten."""
    client = Client(listener or side(view, **options), number)
    flags = ("01" if udp else "00") + (block or BLOCKS[version])[2:]
    assert client.stream(client_settings(LISTS[version], flags, sender=number), 0.1) == []
    if udp:
        assert client.datagram(framed(number, 5), 0.2) == []
        assert client.stream(framed(number, 7, b"\x01"), 0.3) == []
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, version)
    assert client.session.transport == ("udp" if udp else "tcp")
    client.until(1.0)
    if asks:
        client.said(framed(number, 52) + framed(number, 54))
    client.sent.clear()
    return client


def greeting(listener: TcpUdpHq) -> bytes:
    (frame,) = Client(listener).frames("tcp")
    return frame


def flags(listener: TcpUdpHq) -> str:
    """The flags of the settings of 1.3: UDP, Cam, Joystick, Chat, Lidar, LidarSim, SLAMMap."""
    return greeting(listener)[-15:-8].hex()


def announced(listener: TcpUdpHq) -> tuple[int, int]:
    """SLAMMapSize and SLAMMapIntervall of the settings of 1.3, which end with them."""
    frame = greeting(listener)
    return int.from_bytes(frame[-8:-4], "little"), int.from_bytes(frame[-4:], "little")


def cells_of(frame: bytes) -> bytes:
    """The cells of packet 53."""
    assert frame[4:6] == b"\x01\x35"
    assert int.from_bytes(frame[:4], "little") == len(frame) - 4
    assert int.from_bytes(frame[6:10], "little") == len(frame) - 10
    return frame[10:]


def ids(frames: list[bytes]) -> list[int]:
    return [frame[5] for frame in frames]


def wall(side_cells: int, cell_m: float = 0.1) -> Map:
    """A free square with one obstacle in its far corner."""
    cells = np.ones((side_cells, side_cells), np.uint8)
    cells[-1, -1] = 2
    return Map(side_cells, side_cells, cell_m, (0.0, 0.0), cells)


# The settings, which the robot sends first

SEEN = robot("1.3", "joystick", "lidar_sim")


@pytest.mark.parametrize(
    ("options", "view", "expected"),
    [
        ({}, None, "21000000 01 02 02 0b000000 312e312c312e322c312e33 01010101010101 e8030000 0a000000"),
        ({"versions": ("1.1",)}, None, "0f000000 01 02 02 03000000 312e31 0101010101"),
        ({"versions": ("1.2",)}, None, "10000000 01 02 02 03000000 312e32 010101010101"),
        ({"versions": ("1.2", "1.1")}, None, "14000000 01 02 02 07000000 312e322c312e31 010101010101"),
        ({"versions": ("1.3",)}, None, "19000000 01 02 02 03000000 312e33 01010101010101 e8030000 0a000000"),
        (
            {"versions": ("1.1", "1.2", "1.3", "1.4")},
            None,
            "25000000 01 02 02 0f000000 312e312c312e322c312e332c312e34 01010101010101 e8030000 0a000000",
        ),
        ({"versions": ("1.1",)}, SEEN, "0f000000 01 02 02 03000000 312e31 0100010000"),
        # the byte that some HQ programs skip is left out where the listener says so
        (
            {"skip_map_flag": True},
            SEEN,
            "20000000 01 02 02 0b000000 312e312c312e322c312e33 010001000001 e8030000 0a000000",
        ),
        ({"skip_map_flag": True, "versions": ("1.2",)}, SEEN, "10000000 01 02 02 03000000 312e32 010001000001"),
    ],
)  # fmt: skip
def test_a_client_is_greeted_with_its_id_the_versions_verbatim_and_the_settings_of_the_newest(
    options: dict[str, Any], view: RobotView | None, expected: str
) -> None:
    assert greeting(side(view, **options)) == bytes.fromhex(expected)


@pytest.mark.parametrize(
    ("view", "expected"),
    [
        (RobotView(), "01010101010101"),  # all while no robot was seen
        (robot("1.1", "udp", "joystick"), "01000100000000"),
        (robot("1.1", "joystick", "lidar"), "01000100010001"),  # no flag of its own for the map: Lidar says it
        (robot("1.2", "cam", "chat", "lidar", "lidar_sim"), "01010001010101"),
        (robot("1.3", "udp", "lidar_sim", "slam_map"), "01000000000101"),
        (robot("1.3", "joystick", "lidar"), "01000100010000"),
        (robot("1.4", "joystick", "slam_map"), "01000100000001"),
        (robot("1.3"), "01000000000000"),
        (robot("1.3", "joystick", "of tomorrow"), "01000100000000"),
        # a robot of another protocol can be driven, and has a map where there is one
        (robot(None, "lidar", "chat", protocol="alf"), "01000100000000"),
        (knowing(CORNER, view=robot(None, "lidar", "chat", protocol="alf")), "01000100000001"),
    ],
)
def test_a_robot_is_announced_as_it_announced_itself(view: RobotView, expected: str) -> None:
    listener = side(view)
    assert flags(listener) == expected
    assert listener.datagrams
    without = side(view, udp=False)
    assert flags(without) == "00" + expected[2:]
    assert not without.datagrams


@pytest.mark.parametrize(
    ("version", "options", "left_out"),
    [
        ("1.1", {}, {"feature lidar_sim": 1, "feature slam_map": 1}),
        ("1.1", {"versions": ("1.1",)}, {"feature lidar_sim": 1, "feature slam_map": 1}),
        ("1.2", {}, {"feature slam_map": 1}),
        ("1.3", {}, {}),
    ],
)
def test_a_feature_that_the_version_agreed_has_no_flag_for_is_counted_as_left_out(version, options, left_out) -> None:
    client = joined(version, robot("1.3", "joystick", "lidar_sim", "slam_map"), **options)
    client.begun()
    assert client.session.left_out == left_out


def test_each_client_is_announced_the_robot_as_it_is_when_it_connects() -> None:
    view = robot("1.3", "joystick")
    listener = side(view)
    assert flags(listener) == "01000100000000"
    view.note(topics.STATUS, Status("established", protocol="tcpudp", version="1.3", features=("cam",)))
    assert flags(listener) == "01010000000000"
    view.note(topics.STATUS, Status("offline", protocol="tcpudp"))
    assert flags(listener) == "01010000000000"  # away for a moment, the same robot


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"slam_map_size": 5, "slam_map_interval": 10}, "slam_map_size is smaller than slam_map_interval"),
        *[({"versions": versions}, "version") for versions in ([], ["one"], ["1.1,1.2"], [""])],
    ],
)
def test_a_map_of_no_cells_and_versions_that_are_none_cannot_be_configured(options: object, reason: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=reason):
        msgspec.convert(options, HqOptions)


# The size of the map, announced before the client is known


@pytest.mark.parametrize(
    ("view", "options", "expected"),
    [
        (knowing(wall(50, 0.1)), {}, (500, 10)),  # in its own cells
        # not known yet: as configured, but no larger than fits
        (RobotView(), {"slam_map_size": 300, "slam_map_interval": 3}, (300, 3)),
        (RobotView(), {"slam_map_size": 1000, "slam_map_interval": 1}, (244, 1)),
        (RobotView(), {"slam_map_size": 1000, "slam_map_interval": 1, "udp": False}, (46, 1)),
    ],
)
def test_the_map_is_announced_in_its_own_cells_or_as_configured(view, options, expected) -> None:
    assert announced(side(view, **options)) == expected


@pytest.mark.parametrize("cell", [0.0, -0.1, math.nan, math.inf, 1e-300, 1e9, 1e300])
def test_a_map_with_absurd_cells_keeps_no_client_from_connecting(cell: float) -> None:
    absurd = Map(1, 1, cell, (0.0, 0.0), np.array([[2]], np.uint8))
    client = joined(view=knowing(absurd, POSE))
    assert announced(client.listener) == (1000, 10)
    assert client.begun() == [POSITION]
    assert client.session.left_out == {"map": 1}
    with pytest.raises(EncodeError):
        client.shown(topics.MAP, absurd)


# Handshakes


def test_a_client_of_1_3_shakes_hands_with_datagrams() -> None:
    client = Client(side(robot("1.3", "joystick")), 5)
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


@pytest.mark.parametrize(("options", "port"), [({}, 11000), ({"client_port": 40000}, 40000)])
def test_a_client_whose_datagram_is_lost_is_shown_the_robot_by_tcp_and_may_send_its_own(options, port) -> None:
    client = Client(side(**options), 5)
    client.stream(client_settings(), 0.1)
    client.until(2.0)
    assert client.frames("tcp", 0.05) == [START]
    client.stream(framed(5, 7, b"\x01"), 2.3)  # "their 7 is always true"
    assert (client.session.state, client.session.transport) == (State.ESTABLISHED, "tcp")
    assert client.shown(topics.POSE, POSE) == [POSITION]
    assert client.frames("udp") == []
    assert not client.session.claims(bytes.fromhex("02000000 05 0d"), port + 1)
    assert client.session.claims(bytes.fromhex("02000000 05 0d"), port)
    assert client.said("06000000 05 0c 0000003f", datagram=True) == [(topics.CMD_DRIVE, Drive(turn=-0.5))]


def test_a_client_that_does_not_answer_the_settings_is_let_go() -> None:
    client = Client(side())
    client.until(6.0)
    assert client.session.state is State.CLOSED
    assert "5 s" in str(client.session.reason)


# What clients are shown


def test_the_last_map_and_position_are_sent_once_after_the_handshake_if_there_are_any() -> None:
    assert joined(view=knowing(CORNER, POSE)).begun() == [CORNER_FRAME, POSITION]
    assert joined().begun() == []


@each_version
@by_either
def test_positions_go_to_clients_of_every_version_by_what_was_agreed(version: str, udp: bool) -> None:
    client = joined(version, udp=udp)
    assert client.shown(topics.POSE, POSE) == [POSITION]
    assert client.gone() == {"udp" if udp else "tcp"}


def test_positions_are_scaled_and_turned_as_configured() -> None:
    client = joined(length_unit_m=1.0, heading_offset=0.0)
    assert client.shown(topics.POSE, Pose(1.5, -2.25, math.pi / 2)) == [POSITION]


@pytest.mark.parametrize(
    "pose", [Pose(math.nan, 0.0, 0.0), Pose(0.0, math.inf, 0.0), Pose(0.0, 0.0, -math.inf), Pose(1e300, 0.0, 0.0)]
)
def test_a_position_that_is_no_number_is_not_shown(pose: Pose) -> None:
    client = joined(view=knowing(CORNER, pose))
    with pytest.raises(EncodeError):
        client.listener.show(topics.POSE, pose)
    assert ids(client.begun()) == [53]
    assert client.session.left_out == {"pose": 1}


def test_of_positions_that_could_not_be_written_yet_only_the_newest_is() -> None:
    client = joined()
    for x in (1.0, 2.0, 3.0):
        client.shown(topics.POSE, Pose(x, 0.0, math.pi / 2), at_once=True)
    assert client.left() == [bytes.fromhex("0e000000 01 37 00009643 00000000 00000000")]


def test_packets_are_never_written_together() -> None:
    client = joined(gap_s=0.05)
    news = ((topics.POSE, POSE), (topics.MAP, CORNER), (topics.LIDAR, Switch(True)))
    for topic, message in (*news, (topics.TEXT, Text("one")), (topics.TEXT, Text("two"))):
        client.shown(topic, message, at_once=True)
    assert len(client.left()) == 5
    assert min(later.at - earlier.at for earlier, later in pairwise(client.sent)) >= 0.05 - 1e-9


ALL_OF_A_ROBOT: tuple[tuple[Topic, FleetMessage], ...] = (
    (topics.POSE, POSE),
    (topics.MAP, CORNER),
    (topics.LIDAR, Switch(True)),
    (topics.CAMERA, Switch(True)),
    (topics.TEXT, Text("bye")),
    (topics.TEXT, REQUEST),
    (topics.RAW("tcpudp"), Raw(40, b"chat")),
    (topics.RAW("tcpudp"), Raw(70, b"led")),
    (topics.RAW("tcpudp"), Raw(70, b"led")),
)


@pytest.mark.parametrize(
    ("version", "known"), [("1.1", [1, 51, 53, 55]), ("1.2", [1, 51, 53, 55, 60]), ("1.3", [1, 51, 53, 55, 60])]
)
@by_either
def test_a_client_gets_the_packets_that_its_version_knows_and_the_rest_is_counted(version, known, udp) -> None:
    client = joined(version, udp=udp)
    assert sorted(ids([frame for news in ALL_OF_A_ROBOT for frame in client.shown(*news)])) == known
    assert client.session.left_out["serverCamMode (31)"] == 1
    assert client.session.left_out["chatMessage (40)"] == 1
    assert client.session.left_out["packet 70"] == 2


@pytest.mark.parametrize(
    ("topic", "message", "expected"),
    [
        (topics.LIDAR, Switch(True), "06000000 01 33 01000000"),
        (topics.LIDAR, Switch(False), "06000000 01 33 02000000"),
        (topics.CAMERA, Switch(True), "06000000 01 1f 01000000"),
        (topics.RAW("tcpudp"), Raw(40, b"chat"), "06000000 01 28 63686174"),
        (topics.RAW("tcpudp"), Raw(70, b"led"), "05000000 01 46 6c6564"),
        (topics.TEXT, Text("bye"), "09000000 01 01 03000000 627965"),
        # texts are shown in ASCII
        (topics.TEXT, Text("grün"), "0d000000 01 01 07000000 67725c7866636e"),
        (topics.TEXT, Text("\N{ROBOT FACE}"), "10000000 01 01 0a000000 5c553030303166393136"),
        (topics.TEXT, Text("\udcff"), "0c000000 01 01 06000000 5c7564636666"),
    ],
)
def test_news_go_by_tcp_to_clients_that_know_their_packet_or_are_said_to_know_it(topic, message, expected) -> None:
    for client in (joined(udp=True, known=(31, 40, 70)), joined("1.1", known=(31, 40, 70))):
        assert client.shown(topic, message) == [bytes.fromhex(expected)]
        assert client.gone() == {"tcp"}


def test_raw_packets_are_none_that_a_fleet_message_holds_none_beyond_a_byte_and_none_that_clients_lose() -> None:
    client = joined(known=(2, 13, 40, 55))
    raw = topics.RAW("tcpudp")
    for held in (1, 2, 13, 53, 55):
        assert client.listener.show(raw, Raw(held, b"")) is None
    for packet_id in (256, -1):
        with pytest.raises(EncodeError):
            client.listener.show(raw, Raw(packet_id))
    assert [len(frame) for frame in client.shown(raw, Raw(40, bytes(2193)))] == [2199]
    with pytest.raises(EncodeError):  # they lose packets of 2.2 kB
        client.listener.show(raw, Raw(40, bytes(2194)))


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
    expected = [bytes.fromhex("02000000 01 3c")] if asked else []
    assert joined(version, block=block).shown(topics.TEXT, REQUEST) == expected


def test_empty_texts_scans_and_readings_have_no_packet() -> None:
    assert side().show(topics.TEXT, Text("")) is None
    assert side().show(topics.SCAN, Scan(0.0, 0.1, 0.0, 1.0, np.ones(3, np.float32))) is None


@pytest.mark.parametrize("text", ["a" * 100_000, "ü" * 5000])
def test_a_long_text_is_cut_so_that_clients_do_not_lose_it(text: str) -> None:
    client = joined()
    (shown,) = client.shown(topics.TEXT, Text(text))
    client.listener.tell(client.session, text, client.now)
    assert client.left() == [shown]
    assert 500 < len(shown) < 2200


def test_texts_are_queued_and_none_replaces_another_until_too_many_wait() -> None:
    client = joined()
    with pytest.raises(Refused):  # noqa: PT012
        for number in range(1000):
            client.shown(topics.TEXT, Text(f"{number:03}"), at_once=True)
    client.until(client.now + 10.0)
    texts = [frame[10:].decode() for frame in client.frames("tcp")]
    assert texts == [f"{number:03}" for number in range(len(texts))]
    assert len(texts) >= 16


# Maps


@each_version
@by_either
def test_a_map_goes_by_what_was_agreed_and_one_that_is_not_there_yet_has_a_count_of_no_cells(version, udp) -> None:
    size = {"slam_map_size": 30, "slam_map_interval": 10} if version == "1.3" else {}
    client = joined(version, udp=udp, **size)  # type: ignore[arg-type]
    assert client.shown(topics.MAP, NO_MAP) == [EMPTY_MAP]
    assert client.shown(topics.MAP, CORNER) == [CORNER_FRAME], "the smallest square for those who are told no size"
    assert client.gone() == {"udp" if udp else "tcp"}


@pytest.mark.parametrize("version", ["1.1", "1.3"])
@by_either
def test_a_map_of_the_captured_robot_is_passed_on_as_it_was(version: str, udp: bool) -> None:
    recorded = next(record.payload for record in payloads(NEW, source=11001) if record.payload[5] == 53)
    grid = Map(20, 20, 0.01, (-0.1, -0.1), np.frombuffer(recorded[10:], np.uint8).reshape(20, 20).T)
    client = joined(version, knowing(grid, view=robot("1.3", "udp", "lidar_sim", "slam_map")), udp=udp)
    assert announced(client.listener) == (20, 1)
    assert client.begun() == [recorded]
    assert client.gone() == {"udp" if udp else "tcp"}


@each_version
@pytest.mark.parametrize(("udp", "limit"), [(False, 2199), (True, 60_000)])
@pytest.mark.parametrize("side_cells", [20, 46, 47, 100, 244, 245, 400, 2048])
def test_a_map_of_any_size_fits_and_keeps_its_obstacle(version: str, udp: bool, limit: int, side_cells: int) -> None:
    client = joined(version, knowing(wall(side_cells)), udp=udp)
    size, interval = announced(client.listener)
    assert size >= side_cells * 10
    (frame,) = client.begun()
    assert client.gone() == {"udp" if udp else "tcp"}
    assert len(frame) <= limit
    cells = cells_of(frame)
    root = math.isqrt(len(cells))
    assert root * root == len(cells)
    assert cells.count(2) == 1
    if version == "1.3" and udp:
        assert root == size // interval
    if side_cells**2 + 10 <= limit:
        assert root == side_cells
    elif not udp:
        assert root == 46, "the largest that fits, for 1.3 too where the announced one does not"
        assert cells[-1] == 2


def test_a_listener_without_datagrams_announces_a_map_that_fits_by_tcp() -> None:
    client = joined(listener=side(knowing(wall(100)), udp=False))
    size, interval = announced(client.listener)
    (frame,) = client.begun()
    assert len(frame) < 2200
    assert len(cells_of(frame)) == (size // interval) ** 2
    assert size >= 1000


def drawn(rows: int, columns: int, cell_m: float, origin: tuple[float, float], **cells: tuple[int, int]) -> Map:
    """A map whose cells are unknown but for one that is free and those that are obstacles: (row, column) of each."""
    values = np.zeros((rows, columns), np.uint8)
    for name, place in cells.items():
        values[place] = 1 if name == "free" else 2
    return Map(rows, columns, cell_m, origin, values)


@pytest.mark.parametrize(
    ("grid", "shown", "left_out"),
    [
        # The obstacle at x 5 to 10 cm, y 0 to 5 cm: in the cell (0, 0). Free at x 10 to 15, y 25 to 30: in x 1, y 2.
        (drawn(6, 6, 0.05, (0.0, 0.0), obstacle=(0, 1), free=(5, 2)), "020000000001000000", {}),
        # larger than the client was told: shown whole in larger cells
        (
            drawn(6, 6, 0.1, (0.0, 0.0), obstacle=(0, 0), another=(5, 5), free=(3, 4)),
            "020000000000000102",
            {"map to scale": 1},
        ),
    ],
)
def test_a_client_of_1_3_gets_every_later_map_in_the_cells_it_was_announced(grid, shown, left_out) -> None:
    client = joined(view=knowing(CORNER), udp=True)
    assert [cells_of(frame).hex() for frame in client.shown(topics.MAP, grid)] == [shown]
    assert client.session.left_out == left_out


CENTRED = {"rows": 40, "columns": 40, "cell_m": 0.1, "obstacle": (20, 20)}
OFF_CENTRE = drawn(20, 10, 0.1, (-1.0, -1.5), obstacle=(5, 9))  # x -0.1 to 0, y -1 to -0.9


@pytest.mark.parametrize(
    ("view", "options", "grid", "cell"),
    [
        # the zero of a robot of the same protocol stays where its programs see it
        (robot("1.3", "joystick"), {}, drawn(**CENTRED, origin=(-2.0, -2.0)), (50, 50)),  # type: ignore[arg-type]
        (robot("1.3", "joystick"), {}, drawn(**CENTRED, origin=(0.0, 0.0)), (20, 20)),  # type: ignore[arg-type]
        # a map of another robot is centred on zero or placed as the option says
        (robot(None, protocol="alf"), {}, OFF_CENTRE, (49, 40)),
        (robot(None, protocol="alf"), {"map_origin": (-2.0, -3.0)}, OFF_CENTRE, (19, 20)),
    ],
)
def test_a_map_lies_where_the_programs_of_its_robot_see_it(view, options, grid, cell) -> None:
    (frame,) = joined(view=view, udp=True, **options).shown(topics.MAP, grid)
    shown = np.frombuffer(cells_of(frame), np.uint8).reshape(100, 100)
    assert [tuple(at) for at in np.argwhere(shown == 2).tolist()] == [cell]


def test_clients_that_came_at_different_times_each_get_what_they_were_announced() -> None:
    view = RobotView()
    early = joined(view=view, udp=True, slam_map_size=20, slam_map_interval=10)
    knowing(CORNER, view=view)
    late = joined(listener=early.listener, udp=True, number=3)
    assert [cells_of(frame).hex() for frame in early.shown(topics.MAP, CORNER)] == ["01000202"]
    assert [cells_of(frame).hex() for frame in late.shown(topics.MAP, CORNER)] == [CORNER_CELLS]


# The first programs of 1.1 have no handlers for 53 and 55: who asks (52, 54) has


def unasked(version: str = "1.1", **options: Any) -> Client:
    """A client that never asked, of a robot whose map and position are known."""
    return joined(version, knowing(CORNER, POSE, robot("1.1", "lidar", "joystick")), asks=False, **options)


def kinds_shown(client: Client) -> list[int]:
    """Which packets a client gets of a new map and a new position."""
    return ids(client.shown(topics.MAP, CORNER) + client.shown(topics.POSE, POSE))


@by_either
@pytest.mark.parametrize("versions", [("1.1",), ("1.1", "1.2", "1.3")])
def test_a_client_of_1_1_that_never_asked_gets_no_map_and_no_position(versions: tuple[str, ...], udp: bool) -> None:
    client = unasked(udp=udp, versions=versions)
    assert client.begun() == []
    assert kinds_shown(client) == []
    assert client.session.left_out["servertSLAMMap (53) unasked"] == 2
    assert client.session.left_out["serverPosition (55) unasked"] == 2


@pytest.mark.parametrize(
    ("asked", "topic", "shown"), [(ASK_MAP, topics.RPC_MAP, [53]), (ASK_POSE, topics.RPC_POSE, [55])]
)
def test_a_client_of_1_1_that_asked_for_one_gets_that_one_from_then_on(asked, topic, shown) -> None:
    client = unasked()
    assert client.said(asked) == [(topic, Query())]
    assert ids(client.answered(topic)) == shown
    assert kinds_shown(client) == shown
    other = joined("1.1", listener=client.listener, number=3, asks=False)
    assert kinds_shown(other) == [], "each for itself"
    client.said(ASK_POSE + ASK_MAP)
    assert kinds_shown(client) == [53, 55], "who asked for both gets both"


@pytest.mark.parametrize(("version", "options"), [("1.1", {"unasked": True}), ("1.2", {}), ("1.3", {})])
def test_clients_of_later_versions_and_those_said_to_take_them_need_not_ask(version, options) -> None:
    client = unasked(version, **options)
    assert ids(client.begun()) == [53, 55]
    assert kinds_shown(client) == [53, 55]


# Questions


def test_questions_are_answered_with_what_the_robot_says_else_with_what_it_said_last() -> None:
    view = RobotView()
    client = joined(view=view, slam_map_size=30, slam_map_interval=10)
    assert client.answered(topics.RPC_POSE, POSE) == [POSITION]
    assert client.answered(topics.RPC_MAP, CORNER) == [CORNER_FRAME]
    knowing(CORNER, POSE, view)
    assert client.answered(topics.RPC_POSE) == [POSITION]
    assert client.answered(topics.RPC_MAP) == [CORNER_FRAME]


def test_a_map_that_nobody_has_is_answered_with_an_empty_one_and_a_position_with_a_text() -> None:
    client = joined("1.1")
    assert client.answered(topics.RPC_MAP) == [EMPTY_MAP]
    (text,) = client.answered(topics.RPC_POSE)
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
    client = joined()
    frame = framed(sender, bytes.fromhex(packet)[0], bytes.fromhex(packet)[1:])
    if drive is None:
        with pytest.raises(ProtocolError):
            client.said(frame)
    else:
        assert client.said(frame) == [(topics.CMD_DRIVE, drive)]


def test_a_direction_longer_than_one_keeps_its_direction() -> None:
    ((_, drive),) = joined().said("0e000000 02 0b 00004040 00008040 0000803f")
    assert isinstance(drive, Drive)
    assert (drive.forward, drive.left, drive.turn) == pytest.approx((0.8, -0.6, 0.0))


def test_full_scale_is_what_the_listener_says() -> None:
    client = joined(speed_full=2.0, turn_full=4.0)
    assert client.said("0e000000 02 0b 00000000 0000803f 0000803f") == [(topics.CMD_DRIVE, Drive(forward=0.5))]
    assert client.said("06000000 02 0c 0000803f") == [(topics.CMD_DRIVE, Drive(turn=-0.25))]


@given(st.binary(min_size=12, max_size=12), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
@example(bytes.fromhex("ffff7f7f ffff7fff ffff7f7f"), 1.0, 1.0)
@example(bytes.fromhex("01000000 01000000 01000000"), 1000.0, 1000.0)
def test_whatever_a_stick_says_the_bus_takes_the_drive_or_there_is_none(body, speed_full, turn_full) -> None:
    client = joined(speed_full=speed_full, turn_full=turn_full)
    for packet in (framed(2, 11, body), framed(2, 12, body[:4])):
        try:
            ((topic, drive),) = client.said(packet)
        except ProtocolError:
            continue
        assert topic is topics.CMD_DRIVE
        assert payloads_codec.decode(Drive, payloads_codec.encode(drive)) == drive


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        ("06000000 02 0a 01000000", [(topics.CMD_MODE, Mode("none"))]),
        ("06000000 02 0a 02000000", [(topics.CMD_MODE, Mode("manual"))]),
        ("06000000 02 0a 03000000", [(topics.CMD_MODE, Mode("autonomous"))]),
        ("06000000 02 32 01000000", [(topics.CMD_LIDAR, Switch(True))]),
        ("06000000 02 32 02000000", [(topics.CMD_LIDAR, Switch(False))]),
        ("02000000 02 34", [(topics.RPC_MAP, Query())]),
        ("02000000 02 36", [(topics.RPC_POSE, Query())]),
        # texts carry the name of the session, and empty ones are nothing
        ("0e000000 01 01 08000000 6869207468657265", [(topics.CMD_TEXT, Text("hi there", sender="hq.2"))]),
        ("07000000 02 01 01000000 fc", [(topics.CMD_TEXT, Text("\\xfc", sender="hq.2"))]),
        ("06000000 02 01 00000000", []),
    ],
)
def test_a_packet_becomes_its_command(packet: str, expected: list[tuple[Topic, FleetMessage]]) -> None:
    client = joined()
    client.session.name = "hq.2"
    assert client.said(packet) == expected


@pytest.mark.parametrize("packet_id", [21, 40, *range(70, 80), 99, 255])
@pytest.mark.parametrize("body", [b"", b"\x00", b"\x01\x02\x03\x04\x05\x06\x07\x08"])
def test_packets_that_no_fleet_message_holds_are_raw(packet_id: int, body: bytes) -> None:
    assert joined().said(framed(2, packet_id, body)) == [(topics.CMD_RAW("tcpudp"), Raw(packet_id, body))]


def scan_of(ranges: str, count: int, **options: Any) -> Scan:
    ((topic, scan),) = joined(**options).said(framed(2, 61, count.to_bytes(4, "little") + bytes.fromhex(ranges)))
    assert topic is topics.CMD_SCAN
    assert isinstance(scan, Scan)
    return scan


def test_simulated_lidar_data_is_a_turn_of_ranges_in_metres() -> None:
    scan = scan_of("0000c842" * 359 + "00004843", 360)
    assert (scan.angle_min, scan.angle_increment, scan.range_min) == pytest.approx((0.0, math.radians(1.0), 0.0))
    assert scan.range_max == pytest.approx(2.0)
    assert scan.ranges.tolist() == pytest.approx([1.0] * 359 + [2.0])


@pytest.mark.parametrize(
    ("ranges", "unit_m", "expected", "range_max"),
    [
        # 0, -1, NaN, a signalling NaN, infinity, 100 cm
        ("00000000 000080bf 0000c07f 0100807f 0000807f 0000c842", 0.01, [math.nan] * 5 + [1.0], 1.0),
        ("00000000", 0.01, [math.nan], 0.0),
        ("ffff7f7f 0000803f", 1e6, [math.nan, 1e6], 1e6),
    ],
)
def test_a_range_of_nothing_is_none(ranges, unit_m, expected, range_max) -> None:
    scan = scan_of(ranges, len(expected), length_unit_m=unit_m)
    assert scan.ranges.tolist() == pytest.approx(expected, nan_ok=True)
    assert scan.range_max == pytest.approx(range_max)


MALFORMED = {
    "a mode of nobody": "06000000 02 0a 04000000",
    "mode 0": "06000000 02 0a 00000000",
    "a stop with a body": "03000000 02 0d 00",
    "lidar mode 3": "06000000 02 32 03000000",
    "simulated lidar data without a range": "06000000 02 3d 00000000",
    "a second answer to the settings": "18000000 02 03 0b000000" + LISTED.hex() + "00000000000100",
    "the datagram of the probe by TCP": "02000000 02 05",
    "a packet that robots send": "0e000000 01 37 0000c03f 000010c0 0000b442",
}


@pytest.mark.parametrize("packet", MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_packet_is_no_command_and_the_next_one_is(packet: str) -> None:
    client = joined()
    refused = 0
    try:
        assert client.said(packet) == []
    except ProtocolError:
        refused += 1
    assert refused + client.session.traffic.malformed == 1
    assert client.said("02000000 02 0d") == [(topics.CMD_DRIVE, Drive())]
    assert client.session.state is State.ESTABLISHED
    assert client.sent == []


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=8), st.booleans())
def test_whatever_a_client_sends_gives_commands_the_bus_takes_or_counts_as_malformed(sent, by_datagram) -> None:
    client = joined(udp=by_datagram)
    for packet_id, body in sent:
        try:
            commands = client.said(framed(2, packet_id, body), datagram=by_datagram)
        except ProtocolError:
            continue
        for topic, command in commands:
            assert type(command) is topic.message
            payloads_codec.decode(topic.message, payloads_codec.encode(command))


# Each message is encoded once


class Crowd:
    """Five clients of each version by each channel, and how often the code under test encodes for them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, view: RobotView | None = None, **options: Any) -> None:
        self.listener = side(view, **options)
        kinds = [(version, udp) for version in VERSIONS for udp in (False, True)] * 5
        self.clients = [joined(version, listener=self.listener, udp=udp) for version, udp in kinds]
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

    def shown(self, topic: Topic, message: FleetMessage) -> int:
        """Show news of the robot to all; give how many frames they got."""
        send = self.listener.show(topic, message)
        assert send is not None
        for client in self.clients:
            send(client.session, client.now)
        return sum(len(client.left()) for client in self.clients)


@pytest.mark.parametrize(
    ("topic", "message", "encoded", "sent"),
    [
        (topics.POSE, POSE, 1, 30),
        (topics.LIDAR, Switch(True), 1, 30),
        (topics.CAMERA, Switch(True), 1, 30),
        (topics.TEXT, Text("bye"), 1, 30),
        (topics.RAW("tcpudp"), Raw(40, b"chat"), 1, 30),
        (topics.RAW("tcpudp"), Raw(70, b"led"), 1, 30),
        (topics.TEXT, REQUEST, 0, 20),  # it is always the same
        # squares for what was told no size, by TCP and by UDP (the one by TCP also for 1.3), and the size announced
        (topics.MAP, wall(100), 3, 30),
    ],
)
def test_a_message_is_encoded_once_for_clients_of_all_versions(topic, message, encoded, sent, monkeypatch) -> None:
    crowd = Crowd(monkeypatch, knowing(wall(100)), known=(31, 40, 70))
    assert crowd.shown(topic, message) == sent
    assert len(crowd.packets) == encoded
    assert crowd.maps == (encoded if topic is topics.MAP else 0)


def test_a_map_is_not_made_where_there_is_no_client(monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = Crowd(monkeypatch)
    assert crowd.listener.show(topics.MAP, wall(244)) is not None
    assert crowd.maps == 0


def test_clients_that_come_or_ask_later_are_shown_what_was_encoded_already(monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = Crowd(monkeypatch, knowing(wall(100), POSE))
    assert [len(client.begun()) for client in crowd.clients] == [2] * 30
    assert crowd.maps == 3
    assert sorted(crowd.packets) == ["ServerPosition", *["ServerSLAMMap"] * 3]
    for topic, message in ((topics.RPC_MAP, wall(100)), (topics.RPC_POSE, Pose(1.0, 2.0, 0.0))):
        assert [len(client.answered(topic, message)) for client in crowd.clients] == [1] * 30
    assert (crowd.maps, len(crowd.packets)) == (6, 8)


# The captured HQ programs

Commands = list[tuple[float, Topic, FleetMessage]]


def replay(client: Client, name: str, late: float = 0.0) -> Commands:
    """Feed what the HQ of a capture sent, ``late`` seconds after it did; the handshake of one that is done is left out.

    Return what it commanded, and when.
    """
    client.session.name = "hq.2"
    commands: Commands = []
    done = client.session.state is State.ESTABLISHED
    for record in payloads(name, destination=11001):
        at, packet_id = record.seconds + late, record.payload[5]
        if done and packet_id < 10 and packet_id != 1:
            continue
        if record.transport == "UDP" and packet_id == 5:
            assert client.session.claims(record.payload, record.source)
        receive = client.datagram if record.transport == "UDP" else client.stream
        for message in receive(record.payload, at):
            commands += [(at, topic, command) for topic, command in client.listener.take(client.session, message)]
    assert client.session.traffic.malformed == 0
    return commands


def check_documented(commands: Commands, *more: Topic) -> None:
    """A text, control mode 2, move, rotate, stop, position, map, and ``more``."""
    motion = [topics.CMD_DRIVE] * 3
    expected = [topics.CMD_TEXT, topics.CMD_MODE, *motion, topics.RPC_POSE, topics.RPC_MAP, *more]
    assert [topic for _, topic, _ in commands] == expected
    text, mode, move, rotate, stop, *_ = (command for _, _, command in commands)
    assert (text, mode) == (Text("hi there", sender="hq.2"), Mode("manual"))
    assert isinstance(move, Drive)
    # x 0.6, y 0.8 at 1.5: half more than full scale
    assert (move.forward, move.left, move.turn) == pytest.approx((0.8, -0.6, 0.0))
    assert math.hypot(move.forward, move.left) <= 1.0
    assert (rotate, stop) == (Drive(turn=0.75), Drive())


def captured(name: str) -> Client:
    """A captured HQ that has just connected to the listener it meets."""
    if name == OLD:
        return Client(side(robot("1.1", "joystick"), versions=("1.1",), udp=False))
    return Client(side(robot("1.3", "udp", "lidar_sim", "slam_map"), slam_map_size=2048, slam_map_interval=16))


@pytest.mark.parametrize("anew", [False, True], ids=["its own listener", "a listener of all versions"])
def test_the_captured_hq_of_1_1_commands_what_is_documented(anew: bool) -> None:
    client = Client(side()) if anew else captured(OLD)
    check_documented(replay(client, OLD))
    greeted, *more = client.frames("tcp")
    assert anew or greeted == bytes.fromhex("0f000000 01 02 02 03000000 312e31 0000010000")
    assert more == [START] * anew, "it announces datagrams and sends none: nothing it says is lost"
    assert client.frames("udp") == []
    client.until(10.0)
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, "1.1")


def test_the_captured_hq_of_1_3_commands_what_is_documented() -> None:
    client = captured(NEW)
    commands = replay(client, NEW)
    check_documented(commands, topics.CMD_SCAN)
    greeted = "21000000 01 02 02 0b000000" + LISTED.hex() + "01000000000101 00080000 10000000"
    assert client.frames("tcp") == [bytes.fromhex(greeted), START]
    assert client.frames("udp") == [ANSWER_TRUE]
    assert (client.session.version, client.session.transport) == ("1.3", "udp")
    scan = commands[-1][2]
    assert isinstance(scan, Scan)
    assert scan.ranges.tolist() == pytest.approx([1.0 + degree * 0.005 for degree in range(360)])
    assert scan.range_max == pytest.approx(2.795)


each_capture = pytest.mark.parametrize("name", [OLD, NEW])


@each_capture
def test_the_shown_robot_is_what_the_captured_one_showed(name: str) -> None:
    client = captured(name)
    replay(client, name)
    client.sent.clear()
    for topic, message in (
        (topics.POSE, POSE),
        (topics.TEXT, Text("bye")),
        (topics.TEXT, REQUEST),
        (topics.MAP, NO_MAP),
    ):
        client.shown(topic, message)
    from_robot = [record for record in payloads(name, source=11001) if record.payload[5] not in (2, 4, 6)]
    recorded = {(record.transport.lower(), record.payload) for record in from_robot if len(record.payload) < 400}
    if name == OLD:  # whose robot leaves out the int that HQ programs need
        recorded = recorded - {("tcp", bytes.fromhex("02000000 01 35"))} | {("tcp", EMPTY_MAP)}
    assert recorded <= {(sent.by, sent.frame) for sent in client.sent}


def carry_out(intent: Intent, commands: Commands) -> list[Action | str]:
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


@each_capture
def test_a_captured_hq_drives_only_after_it_has_said_neutral_once(name: str) -> None:
    client = captured(name)
    assert client.listener.deadman_s == 1.3
    assert client.listener.initial_commands() == ((topics.CMD_MODE, Mode("none")),)
    intent = Intent(client.listener.deadman_s)
    assert intent.choose("none", 0.0) is Action.NOTHING
    owed = "connected: release the stick first"
    assert carry_out(intent, replay(client, name)) == [Action.NOTHING, owed, owed, Action.NOTHING]
    again = replay(client, name, late=10.0)
    assert carry_out(intent, again) == [Action.NOTHING, Action.ACQUIRE, Action.WAIT, Action.WAIT]
    intent.granted(3.0)
    assert carry_out(intent, replay(client, name, late=20.0)) == [Action.SEND] * 4


def test_ids_are_those_of_clients() -> None:
    listener = side(quiet_s=7.0)
    numbers = listener.numbers(10)
    assert [numbers.take(0.0) for _ in range(255)] == [*range(2, 256), None]
    numbers.release(9, 100.0)
    assert [numbers.take(now) for now in (106.9, 107.0)] == [None, 9]
    assert HqOptions().quiet_s == 2.0
    assert Client(listener, 255).frames("tcp")[0][6] == 255
