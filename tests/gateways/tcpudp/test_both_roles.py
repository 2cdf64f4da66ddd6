"""Both roles back to back over a network that delays, loses, reorders and doubles, on a simulated clock."""

import heapq
import itertools
import random
from dataclasses import dataclass

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateways.tcpudp.session import limits
from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.settings import RobotSettings13, Settings, Settings12
from tests.gateways.tcpudp.frames import ANSWER_TRUE, Sent, Timed, framed, server_settings
from zbridge.protocol.session import State

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


class Network:
    """Carries what leaves two sessions, earliest first."""

    def __init__(self, version: str, weather: Weather, *, robot_udp: bool, hq_udp: bool) -> None:
        versions, announced = VERSIONS[version]
        announced = msgspec.structs.replace(announced, udp=robot_udp)
        self.robot = Timed(RobotRole(limits(0.0), announced, 5, versions))
        self.hq = Timed(HqRole(limits(0.01), udp=hq_udp))
        self.now, self.weather, self.rng = 0.0, weather, random.Random(weather.seed)
        self.heard: list[tuple[float, Timed, Sent]] = []
        self._carried = {self.robot: 0, self.hq: 0}
        self._arrived_until = {self.robot: 0.0, self.hq: 0.0}
        self._claimed = {self.robot: False, self.hq: True}
        self._events: list[tuple[float, int, Timed, Sent]] = []
        self._numbers = itertools.count()

    def run(self, until: float) -> None:
        for _ in range(20_000):
            self._carry(self.robot, self.hq)
            self._carry(self.hq, self.robot)
            dues = [due for end in (self.robot, self.hq) if (due := end.session.deadline()) is not None]
            self.now = max(self.now, min([until, *dues, *(event[0] for event in self._events[:1])]))
            for end in (self.robot, self.hq):
                end.until(self.now)
            if self._events and self._events[0][0] <= self.now:
                _, _, end, frame = heapq.heappop(self._events)
                self._arrive(end, frame)
            elif self.now >= until:
                return
        raise AssertionError("a timer fires again and again")

    def _carry(self, end: Timed, other: Timed) -> None:
        """Send what left on its way."""
        rng, weather = self.rng, self.weather
        for sent in end.sent[self._carried[end] :]:
            if sent.by == "tcp":
                self._arrived_until[other] = max(self._arrived_until[other], self.now + rng.uniform(0.001, 0.2))
                self._at(self._arrived_until[other], other, sent)
            elif rng.random() >= weather.lost:
                for _ in range(1 + (rng.random() < weather.doubled)):
                    late_s = rng.uniform(0.5, 3.0) if rng.random() < weather.late else 0.0
                    self._at(self.now + rng.uniform(0.001, 0.4) + late_s, other, sent)
        self._carried[end] = len(end.sent)

    def _at(self, when: float, end: Timed, sent: Sent) -> None:
        heapq.heappush(self._events, (when, next(self._numbers), end, sent))

    def _arrive(self, end: Timed, sent: Sent) -> None:
        self.heard.append((self.now, end, sent))
        if end is self.robot and end.session.drops_source:
            end.session.drops_source = self._claimed[end] = False
        claimed = sent.by == "tcp" or self._claimed[end] or end.session.claims(sent.frame, 11000)
        if claimed:  # a listener drops what no session has claimed
            self._claimed[end] |= sent.by == "udp"
            end.come((self.now, sent.by, sent.frame))


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
    assert [sorted(sent.frame[5] for sent in end.sent) for end in (robot, hq)] in (
        [[2, 4, *six], [3, 5, 7]] if offered else [[2], [3]] for six in ([], [6])
    )
    assert {sent.frame for sent in robot.sent if sent.frame[5] == 6} <= {ANSWER_TRUE}, (
        "a 6(false) misleads old programs"
    )
    assert ANSWER_TRUE not in robot.frames("udp") or any(sent.frame[5] == 5 for _, _, sent in network.heard)
    for start in [at for at, _, sent in network.heard if sent.frame[5] == 4]:
        assert [frame[5] for frame in hq.frames("udp", start, start + 2.0)] == [5]
        assert [frame[5] for frame in hq.frames("tcp", start, start + 2.0)] in ([], [7])
    if weather == Weather(weather.seed):
        assert (robot.session.traffic.malformed, hq.session.traffic.malformed) == (0, 0)


FRAMES = st.builds(framed, st.sampled_from([0, 1, 5]), st.integers(0, 80) | st.integers(0, 255), st.binary(max_size=20))
ENTRIES = st.sampled_from([b"1.1", b"1.2", b"1.3", b"1.4", b"2.0", b"", b" ", b"9" * 3000])
SETTINGS = st.lists(ENTRIES, max_size=6).map(lambda listed: server_settings(b",".join(listed)))
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
    for end in (network.robot, network.hq):
        assert end.session.state in (State.ESTABLISHED, State.CLOSED)
        assert end.session.state is State.ESTABLISHED or end.session.reason
    kinds = [sent.frame[5] for sent in network.hq.sent]
    assert max(kinds.count(7), kinds.count(5)) <= 1
