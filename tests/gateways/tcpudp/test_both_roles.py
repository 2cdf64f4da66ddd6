"""Both roles back to back over a network that cuts, delays, loses, reorders and doubles, on a simulated clock."""

import heapq
import random
from collections.abc import Callable, Iterable

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateways.tcpudp.messages import (
    ClientControllMode,
    ClientGetPosition,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    DebugMessage,
    Packet,
    ServerLidarStatus,
    ServerPosition,
    ServerSLAMMap,
)
from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import RobotSettings13, Settings, Settings12
from tests.gateways.tcpudp.frames import server_settings
from zbridge.protocol.session import Datagram, State

VERSIONS = {
    "1.1": (("1.1",), Settings(joystick=True, lidar=True)),
    "1.2": (("1.2",), Settings12(joystick=True, lidar=True)),
    "1.3": (("1.1", "1.2", "1.3"), RobotSettings13(joystick=True, slam_map=True)),
    "1.4": (("1.1", "1.2", "1.3", "1.4"), RobotSettings13(joystick=True, slam_map=True)),
}
BY_UDP = {11, 12, 53, 55, 56, 61}
"""The table's ``UDP*``."""
TCP_DELAY_S = 0.2
UDP_DELAY_S = 0.4
STEPS = 20_000


class Weather:
    """How bad the network is: shares of datagrams lost, doubled and late."""

    def __init__(self, seed: int, *, lost: float = 0.0, doubled: float = 0.0, late: float = 0.0) -> None:
        self.seed, self.lost, self.doubled, self.late = seed, lost, doubled, late
        self.rng = random.Random(seed)

    def __repr__(self) -> str:
        return f"Weather({self.seed}, lost={self.lost}, doubled={self.doubled}, late={self.late})"

    def datagram(self) -> list[float]:
        """The delays with which one datagram arrives."""
        if self.rng.random() < self.lost:
            return []
        copies = 2 if self.rng.random() < self.doubled else 1
        return [self._delay() for _ in range(copies)]

    def segment(self) -> float:
        return self.rng.uniform(0.001, TCP_DELAY_S)

    def cut(self, data: bytes) -> Iterable[bytes]:
        while data:
            size = self.rng.choice((1, 3, len(data)))
            yield data[:size]
            data = data[size:]

    def _delay(self) -> float:
        late_s = self.rng.uniform(0.5, 3.0) if self.rng.random() < self.late else 0.0
        return self.rng.uniform(0.001, UDP_DELAY_S) + late_s


class End:
    """One session on the network, and everything that left it and came out of it."""

    def __init__(self, session: HqRole | RobotRole) -> None:
        self.session = session
        self.sent: list[tuple[float, bytes]] = []
        self.by_stream: list[Packet] = []
        self.by_datagram: list[Packet] = []
        self.heard: list[tuple[float, bytes]] = []
        self.arrived_until = 0.0
        self.claimed = isinstance(session, HqRole)


class Network:
    """Carries frames between two ends, earliest first."""

    def __init__(self, robot: End, hq: End, weather: Weather) -> None:
        self.ends = {robot: hq, hq: robot}
        self.weather = weather
        self.now = 0.0
        weather.rng.seed(weather.seed)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        for end in self.ends:
            end.session.tap = self._tap(end)
            end.session.open(0.0)

    def run(self, until: float) -> None:
        for _ in range(STEPS):
            for end in self.ends:
                self._write(end)
            due = min([deadline for end in self.ends if (deadline := end.session.deadline()) is not None], default=1e9)
            event = self._events[0][0] if self._events else 1e9
            if min(due, event) > until:
                self.now = until
                return
            self.now = max(self.now, min(due, event))
            if event <= due:
                heapq.heappop(self._events)[2]()
            else:
                for end in self.ends:
                    end.session.expire(self.now)
        raise AssertionError("a timer fires again and again")

    def inject(self, end: End, data: bytes, *, datagram: bool) -> None:
        """Let something come to an end that its peer did not send."""
        if datagram:
            end.session.receive_datagram(data, self.now)
        else:
            end.session.receive(data, self.now)

    def _tap(self, end: End) -> Callable[[str, bytes], None]:
        return lambda direction, frame: end.heard.append((self.now, frame)) if direction == "in" else None

    def _write(self, end: End) -> None:
        other = self.ends[end]
        while (frame := end.session.outgoing(self.now)) is not None:
            end.sent.append((self.now, frame))
            if type(frame) is Datagram:
                for delay in self.weather.datagram():
                    self._at(self.now + delay, lambda frame=bytes(frame): self._datagram(other, frame))
            else:
                for piece in self.weather.cut(frame):
                    other.arrived_until = max(other.arrived_until, self.now + self.weather.segment())
                    self._at(other.arrived_until, lambda piece=piece: self._piece(other, piece))

    def _piece(self, end: End, piece: bytes) -> None:
        end.by_stream += end.session.receive(piece, self.now)

    def _datagram(self, end: End, datagram: bytes) -> None:
        if end.session.drops_source:
            end.session.drops_source = end.claimed = False
        end.claimed = end.claimed or end.session.claims(datagram, 11000)
        if end.claimed:  # a listener drops what no session has claimed
            end.by_datagram += end.session.receive_datagram(datagram, self.now)

    def _at(self, when: float, what: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._events, (when, self._count, what))


def ends(version: str, *, robot_udp: bool, hq_udp: bool) -> tuple[End, End]:
    versions, announced = VERSIONS[version]
    fields = {name: getattr(announced, name) for name in announced.__struct_fields__}
    announced = type(announced)(**{**fields, "udp": robot_udp})
    robot = RobotRole(limits(0.0), announced, 5, versions)
    return End(robot), End(HqRole(limits(0.01), udp=hq_udp))


def frames(end: End, packet_id: int, *, channel: type | None = None) -> list[bytes]:
    return [frame for _, frame in end.sent if frame[5] == packet_id and channel in (None, type(frame))]


def assert_agreed(robot: End, hq: End, version: str, *, offered: bool) -> None:
    assert (robot.session.state, hq.session.state) == (State.ESTABLISHED, State.ESTABLISHED)
    # An HQ lists no "1.4", so a robot of that version cannot tell one that knows it.
    assert (hq.session.version, robot.session.version) == (version, "1.3" if version == "1.4" else version)
    assert robot.session.transport == hq.session.transport
    assert len(frames(hq, 7)) == int(offered)
    assert len(frames(hq, 5)) == int(offered)
    assert len(frames(robot, 4)) == int(offered)
    answers = frames(robot, 6)
    assert len(answers) <= len([frame for _, frame in robot.heard if frame[5] == 5])
    assert answers in ([], [bytes.fromhex("03000000 01 06 01")]), "a 6 that says no makes old programs believe in UDP"
    for end in (robot, hq):
        assert not [frame for _, frame in end.sent if type(frame) is Datagram and frame[5] not in {5, 6} | BY_UDP]


def assert_silent(hq: End) -> None:
    """Nothing by TCP but one 7 for two seconds after the 4, and nothing by UDP but one 5."""
    for start, heard in hq.heard:
        if heard[5] == 4:
            quiet = [frame for at, frame in hq.sent if start <= at <= start + 2.0]
            assert [frame[5] for frame in quiet if type(frame) is Datagram] == [5]
            assert [frame[5] for frame in quiet if type(frame) is not Datagram] in ([], [7])


COMMANDS: list[Packet] = [
    ClientControllMode(2),
    ClientJoystickMove(0.0, 1.0, 0.5),
    ClientJoystickRotate(-0.75),
    ClientJoystickStop(),
    ClientGetPosition(),
    DebugMessage("hi there"),
]
TELEMETRY: list[Packet] = [
    ServerPosition(1.5, -2.25, 90.0),
    ServerSLAMMap(bytes(100)),
    ServerLidarStatus(1),
    DebugMessage("bye"),
]
messages = st.lists(st.tuples(st.booleans(), st.integers(0, 11)), max_size=24)


def talk(network: Network, robot: End, hq: End, said: list[tuple[bool, int]]) -> None:
    """Let both sides say things and all of it arrive or be lost; check that it did."""
    before = {end: len(end.sent) for end in (robot, hq)}
    heard = {end: (len(end.by_stream), len(end.by_datagram)) for end in (robot, hq)}
    told: dict[End, list[Packet]] = {robot: [], hq: []}
    for by_hq, number in said:
        source, choice = (hq, COMMANDS) if by_hq else (robot, TELEMETRY)
        message = choice[number % len(choice)]
        source.session.send(message)
        told[source].append(message)
        network.run(network.now + 0.05)
    network.run(network.now + 10.0)
    for source, sink in ((robot, hq), (hq, robot)):
        udp = source.session.transport == "udp"
        by_udp = [message for message in told[source] if udp and message.spec.id in BY_UDP]
        by_tcp = [message for message in told[source] if not (udp and message.spec.id in BY_UDP)]
        written = [frame for _, frame in source.sent[before[source] :]]
        assert [frame[5] for frame in written if type(frame) is Datagram] == [message.spec.id for message in by_udp]
        streamed, datagrams = heard[sink]
        assert sink.by_stream[streamed:] == by_tcp
        for message in sink.by_datagram[datagrams:]:
            assert message in by_udp
        if network.weather.lost == 0:
            assert all(message in sink.by_datagram[datagrams:] for message in by_udp)


SHARES = st.sampled_from([0.0, 0.3, 1.0])
weathers = st.builds(Weather, st.integers(0, 2**32), lost=SHARES, doubled=SHARES, late=SHARES)
mostly = st.sampled_from([True, True, True, False])
SAID = [(True, 1), (False, 0)]


@pytest.mark.parametrize("version", VERSIONS)
@given(robot_udp=mostly, hq_udp=mostly, weather=weathers, said=messages)
@example(robot_udp=True, hq_udp=True, weather=Weather(1), said=SAID)
@example(robot_udp=True, hq_udp=True, weather=Weather(1, lost=1.0), said=SAID)
@example(robot_udp=True, hq_udp=True, weather=Weather(1, doubled=1.0), said=SAID)
@example(robot_udp=True, hq_udp=True, weather=Weather(1, late=1.0), said=SAID)
def test_both_agree_whatever_the_network_does(version, robot_udp, hq_udp, weather, said) -> None:
    robot, hq = ends(version, robot_udp=robot_udp, hq_udp=hq_udp)
    network = Network(robot, hq, weather)
    network.run(12.0)
    offered = robot_udp and hq_udp
    if weather.late and (robot.session.transport, hq.session.transport) == ("tcp", "udp"):
        return  # its 7 came so late that it might have been of an HQ that heard no 6
    assert_agreed(robot, hq, version, offered=offered)
    assert_silent(hq)
    if not offered or weather.lost == 1.0:
        assert hq.session.transport == "tcp"
    elif weather.lost == weather.late == 0.0:
        assert hq.session.transport == "udp"
    if not weather.lost and not weather.doubled and not weather.late:
        assert (robot.session.traffic.malformed, hq.session.traffic.malformed) == (0, 0)
    talk(network, robot, hq, said)


FRAMES = st.builds(
    lambda sender, packet_id, body: (2 + len(body)).to_bytes(4, "little") + bytes([sender, packet_id]) + body,
    st.sampled_from([0, 1, 5]),
    st.integers(0, 80) | st.integers(0, 255),
    st.binary(max_size=20),
)
LISTS = st.lists(st.sampled_from(["1.1", "1.2", "1.3", "1.4", "2.0", "", " ", "9" * 3000]), max_size=6)
SETTINGS = LISTS.map(lambda listed: server_settings(",".join(listed).encode()))
RUBBISH = st.tuples(
    st.floats(0, 0.05) | st.floats(0, 6), st.booleans(), st.booleans(), FRAMES | SETTINGS | st.binary(max_size=30)
)


@pytest.mark.parametrize("version", VERSIONS)
@given(udp=st.booleans(), weather=weathers, rubbish=st.lists(RUBBISH, max_size=12))
def test_rubbish_costs_at_most_the_session(version, udp, weather, rubbish) -> None:
    robot, hq = ends(version, robot_udp=udp, hq_udp=True)
    network = Network(robot, hq, weather)
    for at, to_hq, by_datagram, data in sorted(rubbish):
        network.run(at)
        network.inject(hq if to_hq else robot, data, datagram=by_datagram)
    network.run(20.0)
    for end in (robot, hq):
        assert end.session.state in (State.ESTABLISHED, State.CLOSED)
        assert end.session.state is State.ESTABLISHED or end.session.reason
    assert len(frames(hq, 7)) <= 1
    assert len(frames(hq, 5)) <= 1
