"""What HQ programs of each version are shown, and what they command. Bytes come from the protocol page, by hand."""

import math
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateways.tcpudp import messages
from gateways.tcpudp.hq import TcpUdpHq
from gateways.tcpudp.hq_client import TcpUdpClient
from gateways.tcpudp.messages import Packet, encode_packet
from gateways.tcpudp.options import TcpUdpHqOptions
from tests.gateways.tcpudp import frames as f
from zbridge.errors import EncodeError, ProtocolError
from zbridge.fleet import payload as codec
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Map, Mode, Pose, Query, Raw, Scan, Status, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol.session import Limits, State

POSE = Pose(0.015, -0.0225, math.pi)
"""1.5 cm, -2.25 cm, 90 degrees of the robot: what both captures hold."""
CORNER = Map(2, 3, 0.1, (0.0, 0.0), np.array([[1, 2, 0], [0, 0, 2]], np.uint8))
"""Two rows of y, three columns of x."""
CORNER_CELLS = "010000020000000200"
"""x = 0, 1, 2, each from y = 0 to 2."""
CORNER_FRAME = bytes.fromhex("0f000000 01 35 09000000" + CORNER_CELLS)
NO_MAP = Map(0, 0, 0.1, (0.0, 0.0), np.zeros((0, 0), np.uint8))
EMPTY_MAP = bytes.fromhex("06000000 01 35 00000000")
"""n = 0: legacy HQ programs throw for good on a 53 without its int."""
REQUEST = Text("simulated lidar data", "request")
RAW = topics.RAW("tcpudp")
HQS = {"1.1": (b"1.1", "00000000"), "1.2": (b"1.2", "0000000001"), "1.3": (f.LISTED, "000000000101")}
"""What HQ programs of each version list and announce besides UDP: LidarSim and SLAMMap as far as they have the flag."""

each_version = pytest.mark.parametrize("version", HQS)
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
    return TcpUdpHq(TcpUdpHqOptions(**options), view or RobotView())


class Client(f.Timed):
    """A client of a listener; every act gives the frames that left because of it within a second."""

    session: TcpUdpClient

    def __init__(self, listener: TcpUdpHq, number: int = 2) -> None:
        self.listener = listener
        super().__init__(listener.session(number, Limits(frame_bytes=65536, handshake_s=5.0)))

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

    def said(self, data: bytes, *, datagram: bool = False) -> list[tuple[Topic, FleetMessage]]:
        """What the listener makes of what the client sends."""
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
    listed, flags = HQS[version]
    client.stream(f.client_settings(listed, ("01" if udp else "00") + (block or flags), sender=number), 0.1)
    if udp:
        client.come((0.2, "udp", f.framed(number, 5)), (0.3, "tcp", f.framed(number, 7, b"\x01")))
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, version)
    assert client.session.transport == ("udp" if udp else "tcp")
    client.until(1.0)
    if asks:
        client.said(f.framed(number, 52) + f.framed(number, 54))
    client.sent.clear()
    return client


def greeting(listener: TcpUdpHq, number: int = 2) -> bytes:
    (frame,) = Client(listener, number).frames("tcp")
    return frame


def announced(listener: TcpUdpHq) -> tuple[int, int]:
    """SLAMMapSize and SLAMMapIntervall of the settings of 1.3, which end with them."""
    frame = greeting(listener)
    return int.from_bytes(frame[-8:-4], "little"), int.from_bytes(frame[-4:], "little")


def cells_of(frame: bytes) -> bytes:
    """The cells of packet 53."""
    assert frame == f.framed(1, 53, len(frame[10:]).to_bytes(4, "little") + frame[10:])
    return frame[10:]


def ids(frames: list[bytes]) -> list[int]:
    return [frame[5] for frame in frames]


def wall(side_cells: int) -> Map:
    """A free square with one obstacle in its far corner."""
    cells = np.ones((side_cells, side_cells), np.uint8)
    cells[-1, -1] = 2
    return Map(side_cells, side_cells, 0.1, (0.0, 0.0), cells)


# The settings, which the robot sends first

SEEN = robot("1.3", "joystick", "lidar_sim")
ALL = "01010101010101"


@pytest.mark.parametrize(
    ("options", "view", "listed", "block"),
    [
        ({}, None, f.LISTED, ALL),
        ({"versions": ("1.1",)}, None, b"1.1", ALL[:10]),
        ({"versions": ("1.2", "1.1")}, None, b"1.2,1.1", ALL[:12]),
        ({"versions": ("1.3",)}, None, b"1.3", ALL),
        ({"versions": ("1.1", "1.2", "1.3", "1.4")}, None, f.LISTED_14, ALL),
        ({"versions": ("1.1",)}, SEEN, b"1.1", "0100010000"),
        # the size of the map: its own; not known yet: as configured, but no larger than fits
        ({}, knowing(wall(50)), f.LISTED, ALL + "f4010000 0a000000"),
        ({"slam_map_size": 300, "slam_map_interval": 3}, None, f.LISTED, ALL + "2c010000 03000000"),
        ({"slam_map_size": 1000, "slam_map_interval": 1}, None, f.LISTED, ALL + "f4000000 01000000"),
        ({"slam_map_interval": 1, "udp": False}, None, f.LISTED, "00" + ALL[2:] + "2e000000 01000000"),
        # the byte that some HQ programs skip is left out where the listener says so
        ({"skip_map_flag": True}, SEEN, f.LISTED, "010001000001 e8030000 0a000000"),
        ({"skip_map_flag": True, "versions": ("1.2",)}, SEEN, b"1.2", "010001000001"),
    ],
)
def test_a_client_is_greeted_with_the_versions_verbatim_and_the_newest_settings(options, view, listed, block) -> None:
    assert greeting(side(view, **options), 255) == f.server_settings(listed, block, 255)


@pytest.mark.parametrize(
    ("view", "expected"),
    [
        (RobotView(), ALL),  # all while no robot was seen
        (robot("1.1", "udp", "joystick"), "01000100000000"),
        (robot("1.1", "joystick", "lidar"), "01000100010001"),  # no flag of its own for the map: Lidar says it
        (robot("1.2", "cam", "chat", "lidar", "lidar_sim"), "01010001010101"),
        (robot("1.3", "udp", "lidar_sim", "slam_map"), "01000000000101"),
        (robot("1.3", "joystick", "lidar", "of tomorrow"), "01000100010000"),
        (robot("1.4", "joystick", "slam_map"), "01000100000001"),
        # a robot of another protocol can be driven, and has a map where there is one
        (robot(None, "lidar", "chat", protocol="alf"), "01000100000000"),
        (knowing(CORNER, view=robot(None, "lidar", "chat", protocol="alf")), "01000100000001"),
    ],
)
def test_a_robot_is_announced_as_it_announced_itself_when_the_client_connects(view: RobotView, expected: str) -> None:
    listener, without = side(view), side(view, udp=False)
    assert (listener.datagrams, without.datagrams) == (True, False)
    assert greeting(listener)[-15:-8] == bytes.fromhex(expected)
    assert greeting(without)[-15:-8] == bytes.fromhex("00" + expected[2:])
    view.note(topics.STATUS, Status("established", protocol="tcpudp", version="1.3", features=("cam",)))
    view.note(topics.STATUS, Status("offline", protocol="tcpudp"))  # away for a moment, the same robot
    assert greeting(listener)[-15:-8] == bytes.fromhex("01010000000000")


def test_clients_have_ids_of_their_own_a_deadman_and_no_right_to_drive_at_first_and_a_map_has_cells() -> None:
    listener = side(quiet_s=7.0)
    numbers = listener.numbers(10)
    assert [numbers.take(0.0) for _ in range(255)] == [*range(2, 256), None]
    numbers.release(9, 100.0)
    assert [numbers.take(now) for now in (106.9, 107.0)] == [None, 9]
    assert listener.deadman_s == 1.3
    assert listener.initial_commands() == ((topics.CMD_MODE, Mode("none")),)
    with pytest.raises(msgspec.ValidationError, match="slam_map_size is smaller than slam_map_interval"):
        msgspec.convert({"slam_map_size": 5, "slam_map_interval": 10}, TcpUdpHqOptions)


# What clients are shown


@each_version
@by_either
def test_the_robot_is_shown_by_what_was_agreed_once_after_the_handshake_and_as_it_changes(version, udp: bool) -> None:
    size = {"slam_map_size": 30, "slam_map_interval": 10} if version == "1.3" else {}
    client = joined(version, udp=udp, **size)  # type: ignore[arg-type]
    assert client.begun() == []
    assert client.shown(topics.POSE, POSE) == [f.POSITION]
    assert client.shown(topics.MAP, NO_MAP) == [EMPTY_MAP], "a map that is not there yet has a count of no cells"
    assert client.shown(topics.MAP, CORNER) == [CORNER_FRAME], "the smallest square for those who are told no size"
    assert joined(version, knowing(CORNER, POSE), udp=udp).begun() == [CORNER_FRAME, f.POSITION]
    assert client.gone() == {"udp" if udp else "tcp"}


def test_positions_are_scaled_and_turned_as_configured_and_of_those_that_wait_only_the_newest_leaves() -> None:
    client = joined(length_unit_m=1.0, heading_offset=0.0)
    for x in (1.0, 2.0, 1.5):
        client.shown(topics.POSE, Pose(x, -2.25, math.pi / 2), at_once=True)
    assert client.left() == [f.POSITION]


def absurd(cell: float) -> Map:
    return Map(1, 1, cell, (0.0, 0.0), np.array([[2]], np.uint8))


@pytest.mark.parametrize(
    ("grid", "pose", "shown"),
    [
        *((absurd(cell), POSE, 55) for cell in (0.0, -0.1, math.nan, math.inf, 1e-300, 1e9, 1e300)),
        *((CORNER, Pose(x, 0.0, 0.0), 53) for x in (math.nan, math.inf, 1e300)),
        (CORNER, Pose(0.0, math.nan, 0.0), 53),
        (CORNER, Pose(0.0, 0.0, -math.inf), 53),
    ],
)
def test_what_has_no_packet_keeps_no_client_from_connecting_and_the_other_is_shown(grid, pose, shown: int) -> None:
    client = joined(view=knowing(grid, pose))
    assert announced(client.listener) == ((1000, 10) if shown == 55 else (30, 10))
    assert ids(client.begun()) == [shown]
    assert client.session.left_out == {"map" if shown == 55 else "pose": 1}
    with pytest.raises(EncodeError):
        client.shown(*((topics.MAP, grid) if shown == 55 else (topics.POSE, pose)))


def test_packets_are_never_written_together_and_no_text_replaces_another() -> None:
    client = joined(gap_s=0.05)
    news = ((topics.POSE, POSE), (topics.MAP, CORNER), (topics.LIDAR, Switch(True)))
    for topic, message in (*news, (topics.TEXT, Text("one")), (topics.TEXT, Text("two"))):
        client.shown(topic, message, at_once=True)
    assert sorted(ids(client.left())) == [1, 1, 51, 53, 55]
    assert min(later.at - earlier.at for earlier, later in pairwise(client.sent)) >= 0.05 - 1e-9


NEWS: tuple[tuple[Topic, FleetMessage, str], ...] = (
    (topics.LIDAR, Switch(True), "06000000 01 33 01000000"),
    (topics.LIDAR, Switch(False), "06000000 01 33 02000000"),
    (topics.CAMERA, Switch(True), "06000000 01 1f 01000000"),
    (RAW, Raw(40, b"chat"), "06000000 01 28 63686174"),
    (RAW, Raw(70, b"led"), "05000000 01 46 6c6564"),
    (topics.TEXT, Text("bye"), "09000000 01 01 03000000 627965"),
    # texts are shown in ASCII
    (topics.TEXT, Text("grün"), "0d000000 01 01 07000000 67725c7866636e"),
    (topics.TEXT, Text("\N{ROBOT FACE}"), "10000000 01 01 0a000000 5c553030303166393136"),
    (topics.TEXT, Text("\udcff"), "0c000000 01 01 06000000 5c7564636666"),
)


@each_version
def test_news_go_by_tcp_to_clients_that_know_their_packet_or_are_said_to_and_the_rest_is_counted(version: str) -> None:
    for client in (joined(version, udp=True, known=(31, 40, 70)), joined(version, known=(31, 40, 70))):
        for topic, message, expected in NEWS:
            assert client.shown(topic, message) == [bytes.fromhex(expected)]
        assert client.gone() == {"tcp"}
    client = joined(version, udp=True)
    assert {frame[5] for topic, message, _ in NEWS for frame in client.shown(topic, message)} == {1, 51}
    assert client.session.left_out == {"serverCamMode (31)": 1, "chatMessage (40)": 1, "packet 70": 1}
    missing = {"1.1": ("lidar_sim", "slam_map"), "1.2": ("slam_map",), "1.3": ()}[version]
    seen = joined(version, robot("1.3", "joystick", "lidar_sim", "slam_map"))
    seen.begun()
    assert seen.session.left_out == {f"feature {name}": 1 for name in missing}, "its version has no flag for it"


@pytest.mark.parametrize(("version", "flags"), [("1.1", "01010101"), ("1.2", "0101010100"), ("1.3", "010101010001")])
def test_simulated_lidar_data_is_asked_of_those_who_announced_it(version: str, flags: str) -> None:
    client = joined(version, block=flags)
    assert client.shown(topics.TEXT, REQUEST) == []
    assert client.session.left_out == {"serverGetSimulatedLidarData (60)": 1}
    if version != "1.1":
        assert joined(version).shown(topics.TEXT, REQUEST) == [bytes.fromhex("02000000 01 3c")]


def test_raw_packets_are_none_that_a_fleet_message_holds_and_nothing_is_longer_than_clients_take() -> None:
    client = joined(known=(2, 13, 40, 55))
    for held in (1, 2, 13, 53, 55):
        assert client.listener.show(RAW, Raw(held, b"")) is None
    assert [len(frame) for frame in client.shown(RAW, Raw(40, bytes(2193)))] == [2199]
    for unfit in (Raw(256), Raw(-1), Raw(40, bytes(2194))):  # they lose packets of 2.2 kB
        with pytest.raises(EncodeError):
            client.listener.show(RAW, unfit)
    for text in ("a" * 100_000, "ü" * 5000):  # cut, so that they do not lose it
        (shown,) = client.shown(topics.TEXT, Text(text))
        client.listener.tell(client.session, text, client.now)
        assert client.left() == [shown]
        assert 500 < len(shown) < 2200
    assert side().show(topics.TEXT, Text("")) is None
    assert side().show(topics.SCAN, Scan(0.0, 0.1, 0.0, 1.0, np.ones(3, np.float32))) is None


# Maps


@each_version
@pytest.mark.parametrize(("udp", "limit"), [(False, 2199), (True, 60_000)])
@pytest.mark.parametrize("side_cells", [20, 46, 47, 244, 245, 2048])
def test_a_map_of_any_size_fits_and_keeps_its_obstacle(version: str, udp: bool, limit: int, side_cells: int) -> None:
    for without_datagrams in (False,) if udp else (False, True):
        client = joined(version, listener=side(knowing(wall(side_cells)), udp=not without_datagrams), udp=udp)
        size, interval = announced(client.listener)
        assert size >= side_cells * 10
        (frame,) = client.begun()
        assert client.gone() == {"udp" if udp else "tcp"}
        assert len(frame) <= limit
        cells = cells_of(frame)
        root = math.isqrt(len(cells))
        assert root * root == len(cells)
        assert cells.count(2) == 1
        if version == "1.3" and (udp or without_datagrams):
            assert root == size // interval
        elif side_cells**2 + 10 <= limit:
            assert root == side_cells
        elif not udp:
            assert root == 46, "the largest that fits, for 1.3 too where the announced one does not"
            assert cells[-1] == 2


def drawn(side_cells: int, cell_m: float, x: float, y: float, *cells: tuple[int, int, int]) -> Map:
    """A square map that begins at x, y and whose cells are unknown but for these: row, column, value."""
    values = np.zeros((side_cells, side_cells), np.uint8)
    for row, column, value in cells:
        values[row, column] = value
    return Map(side_cells, side_cells, cell_m, (x, y), values)


OTHER = robot(None, protocol="alf")
OFF_CENTRE = drawn(20, 0.1, -1.0, -1.5, (5, 9, 2))  # x -0.1 to 0, y -1 to -0.9


@pytest.mark.parametrize(
    ("view", "options", "grid", "cells", "left_out"),
    [
        # in the cells that it was announced: x 5 to 10 cm, y 0 to 5 cm is in the first one
        (knowing(CORNER), {}, drawn(6, 0.05, 0, 0, (0, 1, 2), (5, 2, 1)), {(0, 0): 2, (1, 2): 1}, {}),
        # larger than the client was told: shown whole in larger cells
        (
            knowing(CORNER),
            {},
            drawn(6, 0.1, 0, 0, (0, 0, 2), (5, 5, 2), (3, 4, 1)),
            {(0, 0): 2, (2, 2): 2, (2, 1): 1},
            {"map to scale": 1},
        ),
        # the zero of a robot of the same protocol stays where its programs see it
        (robot("1.3", "joystick"), {}, drawn(40, 0.1, -2.0, -2.0, (20, 20, 2)), {(50, 50): 2}, {}),
        (robot("1.3", "joystick"), {}, drawn(40, 0.1, 0.0, 0.0, (20, 20, 2)), {(20, 20): 2}, {}),
        # a map of another robot is centred on zero or placed as the option says
        (OTHER, {}, OFF_CENTRE, {(49, 40): 2}, {}),
        (OTHER, {"map_origin": (-2.0, -3.0)}, OFF_CENTRE, {(19, 20): 2}, {}),
    ],
)
def test_a_map_is_shown_in_the_announced_cells_where_the_programs_see_it(view, options, grid, cells, left_out) -> None:
    client = joined(view=view, udp=True, **options)
    (frame,) = client.shown(topics.MAP, grid)
    side_cells = math.isqrt(len(cells_of(frame)))
    shown = np.frombuffer(cells_of(frame), np.uint8).reshape(side_cells, side_cells)
    assert {(x, y): shown[x, y] for x, y in np.argwhere(shown).tolist()} == cells
    assert client.session.left_out == left_out


def test_clients_that_came_at_different_times_each_get_what_they_were_announced() -> None:
    early = joined(view=(view := RobotView()), udp=True, slam_map_size=20, slam_map_interval=10)
    knowing(CORNER, view=view)
    late = joined(listener=early.listener, udp=True, number=3)
    assert [cells_of(frame).hex() for frame in early.shown(topics.MAP, CORNER)] == ["01000202"]
    assert [cells_of(frame).hex() for frame in late.shown(topics.MAP, CORNER)] == [CORNER_CELLS]


# The first programs of 1.1 have no handlers for 53 and 55: who asks (52, 54) has


@pytest.mark.parametrize(
    ("version", "options", "asked", "expected"),
    [
        ("1.1", {}, b"", []),
        ("1.1", {"versions": ("1.1",)}, b"", []),
        ("1.1", {}, f.framed(2, 52), [53]),
        ("1.1", {}, f.framed(2, 54), [55]),
        ("1.1", {}, f.framed(2, 52) + f.framed(2, 54), [53, 55]),
        ("1.1", {"unasked": True}, b"", [53, 55]),
        ("1.2", {}, b"", [53, 55]),
        ("1.3", {}, b"", [53, 55]),
    ],
)
@by_either
def test_a_client_of_1_1_gets_map_and_position_from_when_it_asked_for_them(version, options, asked, expected, udp):
    view = knowing(CORNER, POSE, robot("1.1", "lidar", "joystick"))
    client = joined(version, view, udp=udp, asks=False, **options)
    client.said(asked)
    assert ids(client.begun()) == expected
    assert ids(client.shown(topics.MAP, CORNER) + client.shown(topics.POSE, POSE)) == expected
    missing = {53: "servertSLAMMap (53) unasked", 55: "serverPosition (55) unasked"}
    assert client.session.left_out == {name: 2 for packet_id, name in missing.items() if packet_id not in expected}
    other = joined(version, listener=client.listener, number=3, asks=False)
    assert len(other.shown(topics.POSE, POSE)) == (version != "1.1" or "unasked" in options), "each for itself"


def test_questions_are_answered_with_what_the_robot_says_else_with_what_it_said_last_else_with_what_is() -> None:
    view = RobotView()
    client = joined("1.1", view)
    unknown = f.framed(1, 1, f.counted(b"the robot's map is not known"))
    assert client.answered(topics.RPC_MAP) == [EMPTY_MAP, unknown]
    assert client.answered(topics.RPC_MAP, NO_MAP) == [EMPTY_MAP, unknown]
    (text,) = client.answered(topics.RPC_POSE)
    assert text[4:6] == b"\x01\x01"
    assert b"position" in text
    assert client.answered(topics.RPC_POSE, POSE) == [f.POSITION]
    assert client.answered(topics.RPC_MAP, CORNER) == [CORNER_FRAME]
    knowing(CORNER, POSE, view)
    assert client.answered(topics.RPC_POSE) == [f.POSITION]
    assert client.answered(topics.RPC_MAP) == [CORNER_FRAME]


@pytest.mark.parametrize(
    ("topic", "message", "encoded"),
    [
        *((topic, message, 1) for topic, message, _ in NEWS[:6]),
        (topics.POSE, POSE, 1),
        (topics.TEXT, REQUEST, 0),  # it is always the same
        # squares for what was told no size, by TCP and by UDP (the one by TCP also for 1.3), and the size announced
        (topics.MAP, wall(100), 3),
    ],
)
def test_a_message_is_encoded_once_for_clients_of_all_versions(topic, message, encoded, monkeypatch) -> None:
    listener, written = side(knowing(wall(100)), known=(31, 40, 70)), []
    crowd = [joined(version, listener=listener, udp=udp) for version in HQS for udp in (False, True)] * 2

    def write(packet: Packet, sender_id: int) -> bytes:
        written.append(packet)
        return encode_packet(packet, sender_id)

    monkeypatch.setattr(messages, "encode_packet", write)
    listener.show(topic, message)
    assert topic is not topics.MAP or not written, "a map is not made where there is no client"
    assert sum(len(client.shown(topic, message)) for client in crowd) == (8 if message is REQUEST else 12)
    assert len(written) == encoded


# What clients command

ASKED, RAW_SAID = Query(), topics.CMD_RAW("tcpudp")


@pytest.mark.parametrize(
    ("packet", "topic", "command"),
    [
        ("0b 00000000 0000803f 0000803f", topics.CMD_DRIVE, Drive(forward=1.0)),  # y is forward
        ("0b 00000000 000080bf 0000003f", topics.CMD_DRIVE, Drive(forward=-0.5)),
        ("0b 0000803f 00000000 0000803f", topics.CMD_DRIVE, Drive(left=-1.0)),  # x is right
        ("0b 000080bf 00000000 0000803e", topics.CMD_DRIVE, Drive(left=0.25)),
        ("0b 00000000 0000803f 00000000", topics.CMD_DRIVE, Drive()),
        ("0c 0000803f", topics.CMD_DRIVE, Drive(turn=-1.0)),  # positive to the right
        ("0c 000040bf", topics.CMD_DRIVE, Drive(turn=0.75)),
        ("0d", topics.CMD_DRIVE, Drive()),
        ("0b 00000000 0000803f 0000c03f", topics.CMD_DRIVE, Drive(forward=1.0)),  # clipped to full scale
        ("0b 00000000 0000a040 000080bf", topics.CMD_DRIVE, Drive(forward=-1.0)),
        ("0c ffff7f7f", topics.CMD_DRIVE, Drive(turn=-1.0)),
        ("0c ffff7fff", topics.CMD_DRIVE, Drive(turn=1.0)),
        ("0b ffff7f7f 00000000 ffff7f7f", topics.CMD_DRIVE, Drive(left=-1.0)),
        ("0a 01000000", topics.CMD_MODE, Mode("none")),
        ("0a 02000000", topics.CMD_MODE, Mode("manual")),
        ("0a 03000000", topics.CMD_MODE, Mode("autonomous")),
        ("32 01000000", topics.CMD_LIDAR, Switch(True)),
        ("32 02000000", topics.CMD_LIDAR, Switch(False)),
        ("34", topics.RPC_MAP, ASKED),
        ("36", topics.RPC_POSE, ASKED),
        # texts carry the name of the session, and empty ones are nothing
        ("01 08000000 6869207468657265", topics.CMD_TEXT, Text("hi there", sender="hq.2")),
        ("01 01000000 fc", topics.CMD_TEXT, Text("\\xfc", sender="hq.2")),
        ("01 00000000", None, None),
        # packets that no fleet message holds
        ("15", RAW_SAID, Raw(21)),
        ("15 0102", RAW_SAID, Raw(21, b"\x01\x02")),
        ("28 00", RAW_SAID, Raw(40, b"\x00")),
        *((f"{packet_id:02x} 01", RAW_SAID, Raw(packet_id, b"\x01")) for packet_id in (70, 79, 99, 255)),
        # what has no meaning: no number, a mode of nobody, a stop with a body, a turn without a range
        *((f"0c {value}", None, ProtocolError) for value in ("0000c07f", "0000807f")),
        *((f"0b {value} 0000803f 0000803f", None, ProtocolError) for value in ("0000c07f", "000080ff")),
        ("0b 00000000 0000803f 0000c07f", None, ProtocolError),
        ("0b 00000000 0000807f 00000000", None, ProtocolError),
        *((f"{mode} 000000", None, ProtocolError) for mode in ("0a 04", "0a 00", "32 03", "3d 00")),
        ("0d 00", None, ProtocolError),
    ],
)
def test_a_packet_is_its_command_and_one_without_meaning_costs_nothing_but_itself(packet: str, topic, command) -> None:
    client = joined()
    client.session.name = "hq.2"
    frame = f.framed(2, bytes.fromhex(packet)[0], bytes.fromhex(packet)[1:])
    try:
        assert client.said(frame) == ([(topic, command)] if topic is not None else [])
        refused = client.session.traffic.malformed
    except ProtocolError:
        refused = 1
    assert refused == (command is ProtocolError)
    assert client.said(f.framed(2, 13)) == [(topics.CMD_DRIVE, Drive())]
    assert client.sent == []


def test_full_scale_is_what_the_listener_says_and_a_diagonal_is_no_faster() -> None:
    client = joined(speed_full=2.0, turn_full=4.0)
    ahead = bytes.fromhex("0e000000 02 0b 00000000 0000803f 0000803f")
    assert client.said(ahead) == [(topics.CMD_DRIVE, Drive(forward=0.5))]
    assert client.said(bytes.fromhex("06000000 02 0c 0000803f")) == [(topics.CMD_DRIVE, Drive(turn=-0.25))]
    ((_, drive),) = client.said(bytes.fromhex("0e000000 02 0b 9a99193f cdcc4c3f 00004040"))  # 0.6, 0.8 at 3
    assert isinstance(drive, Drive)
    assert (drive.forward, drive.left) == pytest.approx((0.8, -0.6))


@pytest.mark.parametrize(
    ("ranges", "unit_m", "expected", "range_max"),
    [
        ("0000c842" * 359 + "00004843", 0.01, [1.0] * 359 + [2.0], 2.0),
        # nothing was measured: 0, -1, NaN, a signalling NaN, infinity; 100 cm
        ("00000000 000080bf 0000c07f 0100807f 0000807f 0000c842", 0.01, [math.nan] * 5 + [1.0], 1.0),
        ("00000000", 0.01, [math.nan], 0.0),
        ("ffff7f7f 0000803f", 1e6, [math.nan, 1e6], 1e6),
    ],
)
def test_simulated_lidar_data_is_a_turn_of_ranges_in_metres(ranges, unit_m, expected, range_max) -> None:
    count = len(expected)
    frame = f.framed(2, 61, count.to_bytes(4, "little") + bytes.fromhex(ranges))
    ((topic, scan),) = joined(length_unit_m=unit_m).said(frame)
    assert topic is topics.CMD_SCAN
    assert isinstance(scan, Scan)
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((0.0, math.radians(360.0 / count)))
    assert (scan.range_min, scan.range_max) == pytest.approx((0.0, range_max))
    assert scan.ranges.tolist() == pytest.approx(expected, nan_ok=True)


SAID = st.one_of(
    st.tuples(st.just(11), st.binary(min_size=12, max_size=12)),
    st.tuples(st.sampled_from([10, 12, 50, 61]), st.binary(min_size=4, max_size=4)),
    st.tuples(st.integers(0, 255), st.binary(max_size=40)),
)
FULL = st.floats(1e-3, 1e3)


@given(st.lists(SAID, max_size=8), st.booleans(), FULL, FULL)
@example([(11, bytes.fromhex("ffff7f7f ffff7fff ffff7f7f"))], False, 1.0, 1.0)
@example([(11, bytes.fromhex("01000000 01000000 01000000"))], False, 1000.0, 1000.0)
def test_whatever_a_client_sends_gives_commands_the_bus_takes_or_counts_as_malformed(said, udp, speed, turn) -> None:
    client = joined(udp=udp, speed_full=speed, turn_full=turn)
    for packet_id, body in said:
        try:
            commands = client.said(f.framed(2, packet_id, body), datagram=udp)
        except ProtocolError:
            continue
        for topic, command in commands:
            assert type(command) is topic.message
            codec.decode(topic.message, codec.encode(command))
