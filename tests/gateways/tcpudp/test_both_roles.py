"""Both roles back to back over a network that delays, loses, reorders and doubles, on a simulated clock."""

import heapq
import itertools
import random
from dataclasses import dataclass, field

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import RobotSettings13, Settings, Settings12
from tests.gateways.tcpudp.frames import ANSWER_TRUE, framed, server_settings
from zbridge.protocol.session import Datagram, State

VERSIONS = {
    "1.1": (("1.1",), Settings(joystick=True, lidar=True)),
    "1.2": (("1.2",), Settings12(joystick=True, lidar=True)),
    "1.3": (("1.1", "1.2", "1.3"), RobotSettings13(joystick=True, slam_map=True)),
    "1.4": (("1.1", "1.2", "1.3", "1.4"), RobotSettings13(joystick=True, slam_map=True)),
}


@dataclass(frozen=True)
class Weather:
    """How bad the network is: shares of datagrams lost, doubled and late."""

    seed: int = 1
    lost: float = 0.0
    doubled: float = 0.0
    late: float = 0.0


@dataclass(eq=False)
class End:
    """One session, what left it and what came to it, and when."""

    session: HqRole | RobotRole
    sent: list[tuple[float, bytes]] = field(default_factory=list)
    heard: list[tuple[float, bytes]] = field(default_factory=list)
    claimed: bool = False
    arrived_until: float = 0.0

    def count(self, packet_id: int) -> int:
        return [frame[5] for _, frame in self.sent].count(packet_id)


class Network:
    """Carries frames between two ends, earliest first."""

    def __init__(self, version: str, weather: Weather, *, robot_udp: bool, hq_udp: bool) -> None:
        versions, announced = VERSIONS[version]
        announced = msgspec.structs.replace(announced, udp=robot_udp)
        self.robot = End(RobotRole(limits(0.0), announced, 5, versions))
        self.hq = End(HqRole(limits(0.01), udp=hq_udp), claimed=True)
        self.ends = {self.robot: self.hq, self.hq: self.robot}
        self.weather, self.rng, self.now = weather, random.Random(weather.seed), 0.0
        self.events: list[tuple[float, int, End, bytes]] = []
        self.numbers = itertools.count()
        for end in self.ends:
            end.session.open(0.0)

    def run(self, until: float) -> None:
        for _ in range(20_000):
            for end in self.ends:
                self._write(end)
            dues = [deadline for end in self.ends if (deadline := end.session.deadline()) is not None]
            due, event = min(dues, default=1e9), self.events[0][0] if self.events else 1e9
            if min(due, event) > until:
                self.now = until
                return
            self.now = max(self.now, min(due, event))
            if event <= due:
                _, _, end, frame = heapq.heappop(self.events)
                self.arrive(end, frame)
            else:
                for end in self.ends:
                    end.session.expire(self.now)
        raise AssertionError("a timer fires again and again")

    def arrive(self, end: End, frame: bytes) -> None:
        """Let something come to an end, whether its peer sent it or not."""
        end.heard.append((self.now, frame))
        if not isinstance(frame, Datagram):
            end.session.receive(frame, self.now)
            return
        if end.session.drops_source:
            end.session.drops_source = end.claimed = False
        end.claimed = end.claimed or end.session.claims(frame, 11000)
        if end.claimed:  # a listener drops what no session has claimed
            end.session.receive_datagram(frame, self.now)

    def _write(self, end: End) -> None:
        other, rng, weather = self.ends[end], self.rng, self.weather
        while (frame := end.session.outgoing(self.now)) is not None:
            end.sent.append((self.now, frame))
            if type(frame) is not Datagram:
                other.arrived_until = max(other.arrived_until, self.now + rng.uniform(0.001, 0.2))
                self._at(other.arrived_until, other, frame)
            elif rng.random() >= weather.lost:
                for _ in range(1 + (rng.random() < weather.doubled)):
                    late_s = rng.uniform(0.5, 3.0) if rng.random() < weather.late else 0.0
                    self._at(self.now + rng.uniform(0.001, 0.4) + late_s, other, frame)

    def _at(self, when: float, end: End, frame: bytes) -> None:
        heapq.heappush(self.events, (when, next(self.numbers), end, frame))


SHARES = st.sampled_from([0.0, 0.3, 1.0])
weathers = st.builds(Weather, st.integers(0, 2**32), lost=SHARES, doubled=SHARES, late=SHARES)
mostly = st.sampled_from([True, True, True, False])


@pytest.mark.parametrize("version", VERSIONS)
@given(robot_udp=mostly, hq_udp=mostly, weather=weathers)
@example(robot_udp=True, hq_udp=True, weather=Weather())
@example(robot_udp=True, hq_udp=True, weather=Weather(lost=1.0))
@example(robot_udp=True, hq_udp=True, weather=Weather(doubled=1.0))
@example(robot_udp=True, hq_udp=True, weather=Weather(late=1.0))
def test_both_agree_whatever_the_network_does(version, robot_udp, hq_udp, weather) -> None:
    network = Network(version, weather, robot_udp=robot_udp, hq_udp=hq_udp)
    robot, hq, offered = network.robot, network.hq, robot_udp and hq_udp
    network.run(12.0)
    if weather.late and (robot.session.transport, hq.session.transport) == ("tcp", "udp"):
        return  # its 7 came so late that it might have been of an HQ that heard no 6
    assert (robot.session.state, hq.session.state) == (State.ESTABLISHED, State.ESTABLISHED)
    # An HQ lists no "1.4", so a robot of that version cannot tell one that knows it.
    assert (hq.session.version, robot.session.version) == (version, "1.3" if version == "1.4" else version)
    assert robot.session.transport == hq.session.transport
    if not offered or weather.lost == 1.0:
        assert hq.session.transport == "tcp"
    elif weather.lost == weather.late == 0.0:
        assert hq.session.transport == "udp"
    assert (robot.count(4), hq.count(5), hq.count(7)) == (int(offered),) * 3
    answers = [frame for _, frame in robot.sent if frame[5] == 6]
    assert answers in ([], [ANSWER_TRUE]), "a 6 that says no makes old programs believe in UDP"
    assert len(answers) <= len([frame for _, frame in robot.heard if frame[5] == 5])
    for start in [at for at, frame in hq.heard if frame[5] == 4]:
        quiet = [frame for at, frame in hq.sent if start <= at <= start + 2.0]
        assert [frame[5] for frame in quiet if type(frame) is Datagram] == [5]
        assert [frame[5] for frame in quiet if type(frame) is not Datagram] in ([], [7])
    if weather == Weather(weather.seed):
        assert (robot.session.traffic.malformed, hq.session.traffic.malformed) == (0, 0)


FRAMES = st.builds(framed, st.sampled_from([0, 1, 5]), st.integers(0, 80) | st.integers(0, 255), st.binary(max_size=20))
LISTS = st.lists(st.sampled_from(["1.1", "1.2", "1.3", "1.4", "2.0", "", " ", "9" * 3000]), max_size=6)
SETTINGS = LISTS.map(lambda listed: server_settings(",".join(listed).encode()))
DATA = FRAMES | SETTINGS | st.binary(max_size=30)


@pytest.mark.parametrize("version", VERSIONS)
@given(
    udp=st.booleans(),
    weather=weathers,
    rubbish=st.lists(st.tuples(st.floats(0, 0.05) | st.floats(0, 6), st.booleans(), st.booleans(), DATA), max_size=12),
)
def test_rubbish_costs_at_most_the_session(version, udp, weather, rubbish) -> None:
    network = Network(version, weather, robot_udp=udp, hq_udp=True)
    for at, to_hq, by_datagram, data in sorted(rubbish):
        network.run(at)
        session = (network.hq if to_hq else network.robot).session
        (session.receive_datagram if by_datagram else session.receive)(data, network.now)
    network.run(20.0)
    for end in network.ends:
        assert end.session.state in (State.ESTABLISHED, State.CLOSED)
        assert end.session.state is State.ESTABLISHED or end.session.reason
    assert max(network.hq.count(7), network.hq.count(5)) <= 1
