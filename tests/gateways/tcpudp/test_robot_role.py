"""The gateway as robot of an HQ program: what it says and when, and whose datagrams it takes."""

import contextlib

import pytest

from gateways.tcpudp import messages as m
from gateways.tcpudp.session import limits
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.settings import RobotSettings13, Settings, Settings12
from tests.gateways.tcpudp import frames as f
from tests.gateways.tcpudp.golden import GOLDEN
from zbridge.errors import NotReady, Refused
from zbridge.protocol.session import State

POSE = m.ServerPosition(1.5, -2.25, 90.0)
MOVES, ROTATES = m.ClientJoystickMove(0.0, 1.0, 0.5), m.ClientJoystickRotate(-0.75)
PORT = 11000
"""What legacy HQ programs bind."""
RIVAL = "another source of datagrams claims to be this client"
BY_TCP = (State.ESTABLISHED, "tcp")
SIZED = {"slam_map": True, "slam_map_size": 1000, "slam_map_interval": 10}
ANNOUNCED = RobotSettings13(udp=True, lidar_sim=True, joystick=True, **SIZED)


def robot(announced: RobotSettings13 = ANNOUNCED, *, client_port: int = PORT, gap_s: float = 0.0) -> f.Timed:
    return f.Timed(RobotRole(limits(gap_s), announced, 5, client_port=client_port))


def waiting(heard: str = "") -> f.Timed:
    return robot().come((0.1, "tcp", f.client_settings())).hear(heard)


def served() -> f.Timed:
    """A robot whose probe succeeded."""
    return waiting("0.2 u5 0.3 t7+")


def unheard(*, client_port: int = PORT) -> f.Timed:
    """A robot whose HQ's 5 was lost, and which has reported."""
    timed = robot(client_port=client_port).come((0.1, "tcp", f.client_settings())).hear("2.2 t7+")
    assert agreed(timed) == BY_TCP
    return timed


def agreed(timed: f.Timed) -> tuple[State, str | None]:
    return timed.session.state, timed.session.transport


# The settings, and what is agreed

ROBOTS = {
    "1.1": (b"1.1", Settings(cam=True, lidar=True), "0001000001"),
    "1.2": (b"1.2", Settings12(joystick=True, lidar_sim=True), "000001000001"),
    "1.3": (f.LISTED, RobotSettings13(chat=True, **SIZED), "00000001000001"),
    "1.4": (f.LISTED_14, RobotSettings13(**SIZED), "00000000000001"),
}
HQS = {"1.1": (b"1.1", "0100000000"), "1.2": (b"1.2", "010000000001"), "1.3": (f.LISTED, "01000000000100")}


def of_version(version: str) -> f.Timed:
    listed, settings, _ = ROBOTS[version]
    return f.Timed(RobotRole(limits(0.0), settings, 5, listed.decode().split(",")))


@pytest.mark.parametrize(
    ("ours", "theirs", "agreed"),
    [
        ("1.1", HQS["1.1"], "1.1"),
        ("1.1", HQS["1.3"], "1.1"),
        ("1.2", HQS["1.2"], "1.2"),
        ("1.2", HQS["1.3"], "1.2"),
        *((ours, theirs, agreed) for ours in ("1.3", "1.4") for agreed, theirs in HQS.items()),
        ("1.3", (b" 1.2 , 1.1,1.1", "010000000001"), "1.2"),
        ("1.3", (b"2.0,1.3", "01000000000100"), "1.3"),
    ],
)
def test_a_robot_lists_its_versions_to_the_letter_and_agrees_on_the_highest_common_one(ours, theirs, agreed) -> None:
    timed = of_version(ours)
    listed, _, block = ROBOTS[ours]
    assert timed.session.state is State.HANDSHAKING
    for sender in (0, 1, 5, 6):  # which id the settings carry makes no difference
        timed = of_version(ours).come((0.1, "tcp", f.client_settings(*theirs, sender=sender)))
        assert timed.frames("tcp") == [f.server_settings(listed, block)]
        assert (timed.session.state, timed.session.version) == (State.ESTABLISHED, agreed)
        assert timed.session.features == (("udp",) if len(theirs[1]) == 10 else ("udp", "lidar_sim"))
        assert timed.session.traffic.malformed == 0


@pytest.mark.parametrize(("ours", "theirs"), [("1.1", b"1.2"), ("1.3", b"2.0"), ("1.4", b""), ("1.3", b"9" * 9000)])
def test_an_hq_without_a_common_version_is_told_reported_and_left(ours: str, theirs: bytes) -> None:
    timed = of_version(ours).come((0.1, "tcp", f.client_settings(theirs)))
    timed.until(1.0)
    listed = ROBOTS[ours][0].decode().replace(",", ", ")
    text = f"no common version: the peer speaks {theirs.decode()[:80]!r}, this gateway {listed}"
    assert timed.frames("tcp")[1:] == [f.framed(1, 1, f.counted(text.encode()))]
    assert (timed.session.state, timed.session.reason) == (State.CLOSED, text)


OURS = {message.spec.id: message for message, sender, _ in GOLDEN if sender == 1} | {56: m.ServerSLAMMapPart(0, 0, b"")}


@pytest.mark.parametrize(("version", "later"), [("1.1", set()), ("1.2", {60}), ("1.3", {60}), ("1.4", {60, 56})])
def test_an_hq_is_sent_no_packet_that_its_version_does_not_know(version: str, later: set[int]) -> None:
    session = RobotRole(limits(0.0), Settings(), 5, f.LISTED_14.decode().split(","))
    session.open(0.0)
    session.receive(f.client_settings(version.encode(), "00000000000000"), 0.1)
    assert session.version == version
    sendable = set()
    for packet_id in range(256):
        with contextlib.suppress(Refused):
            session.may_send(OURS.get(packet_id, m.OpaquePacket(packet_id)))
            sendable.add(packet_id)
    assert sendable == {1, 2, 4, 6, 51, 53, 55} | later
    with pytest.raises(Refused, match=f"version {version} does not know packet 31"):
        session.may_send(m.ServerCamMode(1))


def test_what_comes_before_the_settings_is_malformed_and_settings_that_come_again_change_nothing() -> None:
    timed = robot()
    assert timed.stream(f.framed(0, 13) + f.STATUS_TRUE, 0.05) == []
    assert not any(timed.session.claims(datagram, PORT) for datagram in (f.PROBE, f.MOVE, f.ROTATE, f.STOP))
    assert (timed.session.traffic.malformed, timed.session.state) == (2, State.HANDSHAKING)
    timed.stream(f.client_settings(block="00000000000100") + f.client_settings(block="01010101010101"), 0.1)
    assert (timed.session.traffic.malformed, timed.session.features) == (3, ("lidar_sim",))
    assert agreed(timed) == BY_TCP


# What is taken by TCP, and what ends the session


def test_a_robot_takes_packets_of_the_other_side_with_whatever_id() -> None:
    """Recorded HQ programs write 1, others 0 until they have read the settings: the connection identifies them."""
    timed = served()
    for sender in (0, 1, 2, 4, 5, 6, 255):
        assert timed.stream(f.framed(sender, 13), 0.4) == [m.ClientJoystickStop()]
    assert timed.session.traffic.malformed == 0
    for packet_id in (2, 4, 6, 31, 51, 53, 55, 60):
        assert timed.stream(f.framed(5, packet_id), 0.5) == []
        assert "from the wrong side" in str(timed.session.last_malformed)
        for session in (waiting().session, served().session, unheard().session):
            assert not session.claims(f.framed(5, packet_id), PORT)
    assert (timed.session.traffic.malformed, timed.session.state) == (8, State.ESTABLISHED)


# The probe


@pytest.mark.parametrize(("announced", "flags"), [(RobotSettings13(), "01"), (ANNOUNCED, "00")])
def test_a_robot_without_udp_and_an_hq_without_it_are_established_at_once(announced, flags) -> None:
    timed = robot(announced).come((0.1, "tcp", f.client_settings(block=flags + "000000000100")))
    assert agreed(timed) == BY_TCP
    assert not any(timed.session.claims(datagram, PORT) for datagram in (f.PROBE, f.MOVE, f.ROTATE, f.STOP))
    timed.until(6.0)
    assert len(timed.sent) == 1


@pytest.mark.parametrize(
    ("heard", "answered", "transport", "malformed"),
    [
        # Without the datagram no 6 at all: any, false too, makes programs of 1.1 and 1.2 believe in datagrams; without
        # one they fall back to TCP. A status that says true is not believed then.
        pytest.param("2.2 t7-", "", "tcp", 0, id="no 5, false"),
        pytest.param("2.2 t7+", "", "tcp", 0, id="no 5, true"),
        # A 5 counts between our 4 and its 7 only: who has reported sent its own before that.
        pytest.param("1.9 t7-", "", "tcp", 0, id="no 5, false before it could come"),
        pytest.param("1.9 t7+", "", "tcp", 0, id="no 5, true before it could come"),
        pytest.param("", "", "tcp", 0, id="nothing"),
        pytest.param("0.2 u5 0.3 t7+", " 0.2 u6+", "udp", 0, id="success"),
        # The 6 was lost, and the HQ would not hear what is sent it by UDP. It says so 2 s after its 5.
        pytest.param("0.2 u5 2.15 t7-", " 0.2 u6+", "tcp", 0, id="a lost 6"),
        pytest.param("0.2 u5 2.35 t7-", " 0.2 u6+", "tcp", 0, id="a lost 6, told late"),
        pytest.param("0.2 u5", " 0.2 u6+", "tcp", 0, id="no report"),
        pytest.param("0.2 u5 0.25 u5 0.3 t7+ 0.35 u5", " 0.2 u6+", "udp", 2, id="more 5"),
        pytest.param("0.2 t5", "", "tcp", 1, id="a 5 by TCP"),
        pytest.param("0.2 u5 0.3 t7+ 0.5 t7-", " 0.2 u6+", "udp", 1, id="a report that was not due"),
    ],
)
def test_a_robot_answers_the_datagram_once_and_believes_a_report(
    heard: str, answered: str, transport, malformed
) -> None:
    timed = waiting()
    timed.until(float((heard or "2.1")[:3]))
    assert timed.session.state is State.HANDSHAKING
    if not heard.startswith("0"):
        assert timed.session.claims(f.PROBE, PORT) is (timed.now < 2.0), "a 5 that comes late is not answered"
        assert not timed.session.claims(f.MOVE, PORT), "nothing is bound by port before the handshake is over"
    timed.hear(heard)
    if "7" in heard:
        assert agreed(timed) == (State.ESTABLISHED, transport), "at once"
        assert not timed.session.claims(f.PROBE, PORT + 1)
    timed.until(10.0)
    assert agreed(timed) == (State.ESTABLISHED, transport)
    lost = bool(answered) and transport == "tcp"
    assert timed.session.drops_source is lost, "who got no 6 may not have sent that 5"
    assert timed.session.traffic.malformed == malformed
    timed.session.send(POSE)
    timed.until(11.0)
    assert timed.told() == f"0.0 t2 0.1 t4{answered} 10.0 {transport[0]}55"


NO_PROBES = [b"", f.PROBE[:-1], f.PROBE + b"\x00", f.bearing(f.PROBE, 6), f.bearing(f.PROBE, 255), f.MOVE, f.STOP]
LENGTHS = ("01000000", "00000000", "03000000", "ffffffff", "00000080")


@pytest.mark.parametrize("datagram", [*NO_PROBES, *(bytes.fromhex(length) + f.PROBE[4:] for length in LENGTHS)])
def test_a_datagram_that_is_no_probe_is_not_claimed_but_counted_and_waited_past(datagram: bytes) -> None:
    timed = waiting()
    assert not timed.session.claims(datagram, PORT)
    timed.datagram(datagram, 0.2)
    assert timed.session.traffic.malformed == 1
    for sender in (5, 0, 1):  # its own, or one that nobody has
        assert timed.session.claims(f.bearing(f.PROBE, sender), PORT)
    assert timed.hear("0.3 u5").told() == "0.0 t2 0.1 t4 0.3 u6+"
    for sender in (0, 1):  # recorded HQ programs write 1, others 0 until they have read the settings
        timed = waiting()
        assert timed.datagram(f.bearing(f.PROBE, sender), 0.3) == []
        assert timed.told() == "0.0 t2 0.1 t4 0.3 u6+"


# After the handshake


def test_motion_is_taken_by_either_channel_after_the_report_and_before_it_by_tcp_only() -> None:
    """Whose source it is only the 7 tells: until then nobody drives by it, in whoever's name."""
    timed = waiting("0.2 u5")
    assert timed.datagram(f.MOVE, 0.25) == timed.datagram(f.STOP, 0.26) == []
    assert timed.session.traffic.malformed == 2
    assert timed.stream(f.MOVE, 0.27) == [MOVES]
    timed.stream(f.STATUS_TRUE, 0.3)
    assert timed.datagram(f.MOVE, 0.4) == timed.datagram(f.bearing(f.MOVE, 0), 0.4) == [MOVES]
    assert timed.stream(f.ROTATE + f.STOP, 0.5) == [ROTATES, m.ClientJoystickStop()]
    assert timed.datagram(f.bearing(f.MOVE, 6), 0.6) == [], "a source may leave the id out but not bear another"
    assert timed.session.traffic.malformed == 3


def test_motion_by_datagram_of_an_hq_whose_probe_was_lost_is_claimed_and_taken() -> None:
    """Legacy HQ programs of 1.3 send 11, 12 and 61 by UDP whatever was agreed, and bind port 11000."""
    timed = unheard()
    for sender in (0, 1, 4, 6, 255):
        assert not timed.session.claims(f.bearing(f.MOVE, sender), PORT)
        assert not timed.session.claims(f.bearing(f.PROBE, sender), PORT)
    assert timed.session.claims(f.MOVE, PORT)
    assert timed.datagram(f.MOVE, 2.3) == [MOVES]
    assert timed.session.transport == "tcp", "what it can hear is not known by that"
    assert not timed.session.claims(f.MOVE, PORT), "it has its source now"


def test_motion_by_datagram_from_another_port_is_nobodys_and_told_to_whose_id_it_bears() -> None:
    for port in (1, 10999, 11001, 40000):
        timed = unheard()
        assert not timed.session.claims(f.MOVE, port)
        assert not timed.session.claims(f.PROBE, port)
        assert unheard(client_port=port).session.claims(f.MOVE, port), "but the port is an option"
        assert not unheard(client_port=port).session.claims(f.MOVE, PORT)
        assert not unheard(client_port=0).session.claims(f.MOVE, port)
    for timed in (unheard(), served()):
        with pytest.raises(NotReady, match=r"another port than this client's are not taken \(client_port = 11000\)"):
            timed.session.stray(f.MOVE)
        for datagram in (b"", f.MOVE[:-1], f.bearing(f.MOVE, 6), f.bearing(f.PROBE, 0)):
            timed.session.stray(datagram)
        assert timed.session.traffic.foreign == 1
    waiting().session.stray(f.MOVE)  # nobody is told during the handshake


@pytest.mark.parametrize(
    ("message", "frame"),
    [(message, frame) for message, sender, frame in GOLDEN if sender == 1 and message.spec.id not in (2, 4, 6)],
)
def test_telemetry_goes_by_the_channel_of_the_table(message: m.Packet, frame: str) -> None:
    by_datagram = "udp" if message.spec.id in (53, 55) else "tcp"
    for timed, by in ((waiting("2.2 t7-"), "tcp"), (served(), by_datagram)):
        now = timed.now
        timed.session.send(message)
        timed.until(now + 1.0)
        assert [(sent.by, sent.frame) for sent in timed.sent][-1] == (by, bytes.fromhex(frame))


# A rival source


def rivalled(*datagrams: bytes, gap_s: float = 0.0) -> f.Timed:
    """A robot that was sent a 5 by another source at 0.2, after these by the first at 0.199."""
    timed = robot(gap_s=gap_s).come((0.195, "tcp", f.client_settings()), *((0.199, "udp", data) for data in datagrams))
    timed.session.rivalled(0.2)
    return timed


def test_of_two_sources_that_came_before_the_6_neither_is_heard_and_no_6_is_sent() -> None:
    """The 6 waits for the gap that the 4 began."""
    for timed in (rivalled(f.PROBE, gap_s=0.01), rivalled()):
        assert not timed.session.claims(f.PROBE, PORT)
        timed.until(1.0)
        assert timed.session.state is State.HANDSHAKING
        timed.stream(f.STATUS_TRUE, 2.2)
        assert agreed(timed) == BY_TCP
        assert timed.frames("udp") == []
        assert [frame[5] for frame in timed.frames("tcp")] == [2, 4]
        assert timed.session.left_out == {RIVAL: 1}
        assert timed.session.claims(f.MOVE, PORT), "by the port of legacy programs it may drive"


def test_an_hq_that_was_told_that_its_datagram_came_is_let_go_when_a_second_source_claims_to_be_it() -> None:
    timed = waiting("0.2 u5")
    assert timed.session.claims(f.PROBE, PORT + 1), "so it is seen that there are two of them"
    timed = rivalled(f.PROBE)
    assert timed.frames("udp") == [f.ANSWER_TRUE]
    timed.until(1.0)
    assert (timed.session.state, timed.session.reason) == (State.CLOSED, RIVAL)
    assert not timed.session.claims(f.MOVE, PORT)


def test_a_packet_from_the_port_of_deployed_programs_shows_that_the_source_may_be_somebody_elses() -> None:
    """A 5 of 1.3 was lost, somebody else's was answered, and the 7 is true whatever happened."""
    timed = waiting()
    assert timed.session.claims(f.PROBE, PORT + 1)
    timed.hear("0.2 u5 0.3 t7+")
    assert not timed.session.claims(f.MOVE, PORT + 2), "of no port but that one"
    assert timed.session.claims(f.MOVE, PORT)
    timed.session.rivalled(0.4)
    assert not timed.session.claims(f.MOVE, PORT), "neither is heard any more"
    assert not timed.session.claims(f.MOVE, PORT + 1)
    assert agreed(timed) == BY_TCP
