"""The UDP probe and its fallbacks in both roles: which bytes leave when and by which channel."""

import contextlib
import itertools

import pytest

from gateways.tcpudp.messages import (
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientLidarMode,
    ClientSimulatedLidarData,
    DebugMessage,
    Packet,
    ServerGetSimulatedLidarData,
    ServerLidarStatus,
    ServerPosition,
    ServerSLAMMap,
    ServerSLAMMapPart,
    encode_packet,
)
from gateways.tcpudp.session import HqRole, RobotRole, limits
from gateways.tcpudp.settings import RobotSettings13
from tests.gateways.tcpudp.frames import (
    ALL,
    ANSWER_FALSE,
    ANSWER_TRUE,
    LISTED,
    MOVE,
    POSITION,
    PROBE,
    ROTATE,
    SIZE_100_10,
    START,
    STATUS_FALSE,
    STATUS_TRUE,
    STOP,
    Timed,
    client_settings,
    counted,
    framed,
    server_settings,
)
from zbridge.errors import NotReady, Refused
from zbridge.protocol.session import State

POSE = ServerPosition(1.5, -2.25, 90.0)
PORT = 11000
"""What deployed HQ programs bind."""
HQ_ANSWER = framed(5, 3, counted(LISTED) + bytes.fromhex("01000000000100"))


# The gateway as HQ. The settings come at 0.1, the 4 at 0.2.


def greeted() -> Timed:
    timed = Timed(HqRole(limits(0.01)))
    timed.stream(server_settings(), 0.1)
    return timed


def started() -> Timed:
    timed = greeted()
    timed.stream(START, 0.2)
    return timed


def probed(answer: bytes | None, at: float = 0.3) -> Timed:
    """An HQ whose probe was answered by UDP, or never; 3 s on."""
    timed = started()
    if answer is not None:
        timed.datagram(answer, at)
    timed.until(3.0)
    return timed


def assert_silence(timed: Timed, *, start: float = 0.2) -> None:
    """Nothing by TCP but one 7 in the 2.5 s after the 4, nothing by UDP but one 5."""
    quiet = timed.frames("tcp", start, start + 2.499)
    assert len(quiet) <= 1
    assert all(frame in (STATUS_TRUE, STATUS_FALSE) for frame in quiet)
    assert [frame[5] for frame in timed.frames("tcp")].count(7) == 1
    assert timed.frames("udp", 0.0, start + 2.499) == [PROBE]


def test_an_hq_waits_with_its_datagram_until_the_robot_asks_for_it() -> None:
    timed = greeted()
    timed.until(0.19)
    assert timed.frames("tcp") == [HQ_ANSWER]
    assert timed.frames("udp") == []
    assert timed.session.state is State.HANDSHAKING


def test_an_hq_probes_once_and_answers_success_at_once_and_is_silent_for_two_and_a_half_seconds() -> None:
    timed = started()
    assert [(sent.at, sent.by, sent.frame) for sent in timed.sent[1:]] == [(0.2, "udp", PROBE)]
    timed.datagram(ANSWER_TRUE, 0.3)
    assert [(sent.at, sent.by, sent.frame) for sent in timed.sent[2:]] == [(0.3, "tcp", STATUS_TRUE)]
    timed.until(2.69)
    assert timed.session.state is State.HANDSHAKING
    timed.until(2.71)
    assert timed.session.state is State.ESTABLISHED
    assert timed.session.version == "1.3"
    assert timed.session.features == ("udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map")
    assert timed.session.transport == "udp"
    assert_silence(timed)
    assert timed.session.traffic.malformed == 0


def test_a_probe_that_is_never_answered_is_reported_after_two_seconds() -> None:
    timed = probed(None)
    (status,) = [sent for sent in timed.sent if sent.frame[5] == 7]
    assert status.frame == STATUS_FALSE
    assert status.by == "tcp"
    assert status.at == pytest.approx(2.2, abs=0.011)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert_silence(timed)


def test_an_answer_after_the_report_changes_nothing() -> None:
    timed = started()
    timed.until(2.21)
    assert timed.frames("tcp")[1:] == [STATUS_FALSE]
    timed.datagram(ANSWER_TRUE, 2.22)
    timed.until(5.0)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert_silence(timed)


def test_a_refusal_after_the_report_changes_nothing() -> None:
    timed = started()
    timed.stream(ANSWER_FALSE, 2.22)
    timed.until(5.0)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert_silence(timed)


@pytest.mark.parametrize("answer", [ANSWER_FALSE, ANSWER_TRUE])
def test_an_answer_by_tcp_says_that_the_datagram_did_not_arrive(answer: bytes) -> None:
    timed = started()
    timed.stream(answer, 2.0)
    timed.until(5.0)
    assert timed.frames("tcp", 2.0, 2.02) == [STATUS_FALSE]
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert_silence(timed)


def test_a_datagram_that_says_no_is_no_success() -> None:
    timed = probed(ANSWER_FALSE)
    assert timed.frames("tcp")[1:] == [STATUS_FALSE]
    assert timed.session.transport == "tcp"


def test_a_second_answer_is_not_answered_again() -> None:
    timed = started()
    timed.datagram(ANSWER_TRUE, 0.3)
    timed.datagram(ANSWER_TRUE, 0.4)
    timed.stream(ANSWER_FALSE, 0.5)
    timed.until(5.0)
    assert timed.session.transport == "udp"
    assert_silence(timed)


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"\x03",
        ANSWER_TRUE[:-1],
        ANSWER_TRUE + b"\x00",
        bytes.fromhex("04000000 01 06 01"),
        bytes.fromhex("02000000 01 06 01"),
        bytes.fromhex("03000000 05 06 01"),
        bytes.fromhex("03000000 00 06 01"),
        bytes.fromhex("ffffffff 01 06 01"),
        PROBE,
    ],
)
def test_an_answer_that_is_none_is_counted_and_waited_past(datagram: bytes) -> None:
    timed = started()
    assert timed.datagram(datagram, 0.3) == []
    assert timed.session.traffic.malformed == 1
    assert timed.frames("tcp", 0.2) == []
    timed.datagram(ANSWER_TRUE, 0.4)
    assert timed.frames("tcp", 0.2) == [STATUS_TRUE]


def test_a_datagram_with_a_packet_and_a_half_gives_none() -> None:
    timed = probed(ANSWER_TRUE)
    assert timed.datagram(POSITION + POSITION[:3], 3.1) == []
    assert timed.datagram(POSITION, 3.2) == [POSE]
    assert timed.session.state is State.ESTABLISHED


@pytest.mark.parametrize("flags", ["00010101010101", ALL])
def test_a_start_that_nobody_offered_is_obeyed_without_datagrams(flags: str) -> None:
    """The robot sleeps all the same, and wants its 7."""
    timed = Timed(HqRole(limits(0.01), udp=flags != ALL))
    timed.stream(server_settings(block=flags + SIZE_100_10), 0.1)
    assert timed.session.state is State.ESTABLISHED
    timed.stream(START, 0.2)
    assert timed.session.busy == "handshaking"
    timed.until(6.0)
    assert timed.frames("udp") == []
    assert timed.frames("tcp")[1:] == [bytes.fromhex("03000000 05 07 00")]
    assert (timed.session.state, timed.session.busy) == (State.ESTABLISHED, None)
    assert timed.session.traffic.malformed == 0


def test_a_start_before_the_settings_is_not_due() -> None:
    timed = Timed(HqRole(limits(0.01)))
    timed.stream(START, 0.05)
    timed.stream(server_settings(), 0.1)
    timed.until(0.2)
    assert timed.frames("udp") == []
    assert timed.frames("tcp") == [HQ_ANSWER]


def test_a_start_in_the_read_of_the_settings_finds_them_answered_first_and_alone() -> None:
    timed = Timed(HqRole(limits(0.01)))
    timed.stream(server_settings() + START, 0.1)
    timed.until(5.0)
    assert timed.frames("tcp")[0] == HQ_ANSWER
    assert timed.sent[0].frame == HQ_ANSWER
    assert timed.sent[0].at == 0.1
    assert [frame[5] for frame in timed.frames("tcp")].count(7) <= 1


def test_a_start_that_comes_late_is_followed_by_the_same_silence() -> None:
    timed = greeted()
    timed.until(3.0)
    assert timed.session.state is State.ESTABLISHED
    timed.stream(START, 3.0)
    with contextlib.suppress(Refused):
        timed.session.send(ClientControllMode(2))
    timed.datagram(ANSWER_TRUE, 3.1)
    timed.until(8.0)
    assert_silence(timed, start=3.0)
    assert timed.session.state is State.ESTABLISHED
    assert timed.session.busy is None


def test_a_second_start_does_not_probe_again() -> None:
    timed = started()
    timed.stream(START, 0.25)
    timed.datagram(ANSWER_TRUE, 0.3)
    timed.stream(START, 0.35)
    timed.until(5.0)
    assert timed.session.transport == "udp"
    assert_silence(timed)


def test_a_robot_that_announces_udp_and_never_starts_it_is_established_by_tcp_after_two_seconds() -> None:
    timed = greeted()
    timed.until(2.05)
    assert timed.session.state is State.HANDSHAKING
    timed.until(2.15)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert timed.sent[1:] == []


def test_what_the_robot_sends_during_the_silence_is_delivered() -> None:
    timed = started()
    assert timed.stream(POSITION, 0.25) == [POSE]
    timed.datagram(ANSWER_TRUE, 0.3)
    assert timed.datagram(POSITION, 0.4) == [POSE]
    assert timed.stream(POSITION, 0.5) == [POSE]
    assert timed.session.state is State.HANDSHAKING


def test_datagrams_are_taken_although_the_probe_failed() -> None:
    """What an HQ announces never limits what a robot may send it."""
    timed = probed(None)
    assert timed.datagram(POSITION, 3.1) == [POSE]


def test_a_robot_that_is_lost_during_the_silence_gets_nothing_more() -> None:
    timed = started()
    timed.session.lost("closed by peer")
    timed.until(10.0)
    assert timed.session.state is State.CLOSED
    assert [sent.frame for sent in timed.sent] == [HQ_ANSWER, PROBE]


COMMANDS = [
    (DebugMessage("hi"), "tcp"),
    (ClientControllMode(2), "tcp"),
    (ClientJoystickMove(0.0, 1.0, 0.5), "udp"),
    (ClientJoystickRotate(-0.75), "udp"),
    (ClientJoystickStop(), "tcp"),
    (ClientLidarMode(1), "tcp"),
    (ClientGetSLAMMap(), "tcp"),
    (ClientGetPosition(), "tcp"),
    (ClientSimulatedLidarData([1.0] * 360), "udp"),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("command", "channel"), COMMANDS, ids=lambda value: type(value).__name__)
def test_a_command_goes_by_the_channel_of_the_table(command: Packet, channel: str) -> None:
    """Before the probe there is only TCP; so there is after one that failed."""
    failed, works = probed(None), probed(ANSWER_TRUE)
    for timed, by in ((failed, "tcp"), (works, channel)):
        timed.session.send(command)
        timed.until(3.5)
        (sent,) = [sent for sent in timed.sent if sent.at >= 3.0]
        assert sent.by == by
        assert sent.frame[5] == command.spec.id


def test_motion_goes_by_udp_and_its_stop_by_tcp_byte_by_byte_as_the_page_says() -> None:
    timed = probed(ANSWER_TRUE)
    for command in (ClientJoystickMove(0.0, 1.0, 0.5), ClientJoystickRotate(-0.75), ClientJoystickStop()):
        timed.session.send(command)
    timed.until(4.0)
    assert timed.frames("udp", 3.0) == [MOVE, ROTATE]
    assert timed.frames("tcp", 3.0) == [STOP]


def test_the_gap_is_kept_between_datagrams_and_segments_too() -> None:
    timed = probed(ANSWER_TRUE)
    for _ in range(5):
        timed.session.send(ClientJoystickRotate(-0.75))
        timed.session.send(ClientJoystickStop())
    timed.until(4.0)
    times = [sent.at for sent in timed.sent if sent.at >= 3.0]
    assert len(times) == 10
    assert all(later - earlier >= 0.00999 for earlier, later in itertools.pairwise(times))


def test_an_hq_claims_no_datagram_of_an_unknown_source() -> None:
    assert not started().session.claims(ANSWER_TRUE, PORT)


# The gateway as robot. Its settings leave at 0.0, those of the HQ come at 0.1 and its 4 leaves.

ANNOUNCED = RobotSettings13(
    udp=True, lidar_sim=True, slam_map=True, joystick=True, slam_map_size=1000, slam_map_interval=10
)


def waiting() -> Timed:
    timed = Timed(RobotRole(limits(0.0), ANNOUNCED, 5))
    timed.stream(client_settings(), 0.1)
    return timed


def served() -> Timed:
    """A robot whose probe succeeded."""
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    timed.stream(STATUS_TRUE, 0.3)
    return timed


def test_a_robot_asks_for_the_datagram_and_answers_it_by_udp() -> None:
    timed = waiting()
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.session.claims(PROBE, PORT)
    timed.datagram(PROBE, 0.2)
    assert timed.frames("udp") == [ANSWER_TRUE]
    assert timed.session.state is State.HANDSHAKING
    timed.stream(STATUS_TRUE, 0.3)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "udp")
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.session.traffic.malformed == 0


def test_a_robot_without_udp_and_an_hq_without_it_are_established_at_once() -> None:
    timed = Timed(RobotRole(limits(0.0), RobotSettings13(), 5))
    timed.stream(client_settings(), 0.1)
    assert timed.session.state is State.ESTABLISHED
    timed = Timed(RobotRole(limits(0.0), ANNOUNCED, 5))
    timed.stream(client_settings(block="00000000000100"), 0.1)
    assert timed.session.state is State.ESTABLISHED
    timed.until(6.0)
    assert len(timed.sent) == 1
    assert timed.session.transport == "tcp"


@pytest.mark.parametrize("status", [STATUS_FALSE, STATUS_TRUE])
def test_a_robot_that_gets_no_datagram_sends_no_6_at_all(status: bytes) -> None:
    """Any 6, false too, makes programs of 1.1 and 1.2 believe in datagrams; without one they fall back to TCP."""
    timed = waiting()
    timed.until(2.2)
    assert timed.session.state is State.HANDSHAKING
    timed.stream(status, 2.2)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    timed.until(10.0)
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.frames("udp") == []
    assert timed.session.traffic.malformed == 0


@pytest.mark.parametrize("status", [STATUS_FALSE, STATUS_TRUE])
def test_a_report_ends_the_wait_for_the_datagram(status: bytes) -> None:
    """A 5 counts between our 4 and its 7 only: who has reported sent its own before that."""
    timed = waiting()
    timed.stream(status, 1.9)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert timed.session.traffic.malformed == 0
    assert not timed.session.claims(PROBE, PORT + 1)
    timed.until(10.0)
    assert [frame[5] for frame in timed.frames("tcp", 0.1)] == [4]
    assert timed.frames("udp") == []


def test_a_true_status_is_not_believed_when_no_datagram_arrived() -> None:
    timed = waiting()
    timed.until(2.15)
    timed.stream(STATUS_TRUE, 2.2)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    timed.session.send(POSE)
    timed.until(3.0)
    assert timed.frames("tcp", 2.2) == [POSITION]


def test_a_false_status_is_believed_although_the_datagram_arrived() -> None:
    """The 6 was lost: the HQ would not hear what is sent it by UDP."""
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    timed.stream(STATUS_FALSE, 2.15)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    assert timed.session.drops_source, "who got no 6 may not have sent that 5"
    timed.session.send(POSE)
    timed.until(3.0)
    assert timed.frames("tcp", 2.15) == [POSITION]


def test_a_false_status_has_two_seconds_and_the_way_to_come() -> None:
    """An HQ whose 6 was lost says so 2 s after its 5: more than 2 s after the 6 left."""
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    timed.stream(STATUS_FALSE, 2.35)
    assert timed.session.traffic.malformed == 0
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")


def test_an_hq_that_never_reports_is_established_all_the_same() -> None:
    for datagrams in ((PROBE,), ()):
        timed = waiting()
        for datagram in datagrams:
            timed.datagram(datagram, 0.2)
        timed.until(10.0)
        assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
        assert timed.session.drops_source is bool(datagrams), "nobody said that this 5 was its own"


def test_a_datagram_that_comes_late_is_not_answered() -> None:
    timed = waiting()
    timed.until(2.15)
    assert not timed.session.claims(PROBE, PORT)
    timed.stream(STATUS_TRUE, 2.3)
    timed.until(10.0)
    assert timed.frames("udp") == []
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.session.transport == "tcp"


def test_a_second_datagram_is_not_answered_again() -> None:
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    timed.datagram(PROBE, 0.25)
    timed.stream(STATUS_TRUE, 0.3)
    timed.datagram(PROBE, 0.35)
    timed.until(10.0)
    assert timed.frames("udp") == [ANSWER_TRUE]
    assert timed.frames("tcp", 0.1) == [START]
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "udp")


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        PROBE[:-1],
        PROBE + b"\x00",
        bytes.fromhex("03000000 05 05"),
        bytes.fromhex("02000000 06 05"),
        bytes.fromhex("02000000 ff 05"),
        bytes.fromhex("02000000 05 04"),
        *(bytes.fromhex(length) + PROBE[4:] for length in ("01000000", "00000000", "ffffffff", "00000080")),
        MOVE,
        STOP,
    ],
)
def test_a_datagram_that_is_no_probe_is_not_claimed(datagram: bytes) -> None:
    assert not waiting().session.claims(datagram, PORT)


@pytest.mark.parametrize("sender", [5, 0, 1])
def test_a_probe_is_claimed_with_the_id_that_was_given_or_one_that_nobody_has(sender: int) -> None:
    """Recorded HQ programs write 1, others 0 until they have read the settings."""
    probe = bytes.fromhex("02000000") + bytes([sender, 5])
    timed = waiting()
    assert timed.session.claims(probe, PORT)
    timed.datagram(probe, 0.2)
    assert timed.frames("udp") == [ANSWER_TRUE]
    assert timed.session.traffic.malformed == 0


@pytest.mark.parametrize("datagram", [b"", PROBE[:-1], PROBE + b"\x00", bytes.fromhex("03000000 05 05")])
def test_a_probe_that_is_none_is_counted_and_waited_past(datagram: bytes) -> None:
    timed = waiting()
    timed.datagram(datagram, 0.2)
    assert timed.session.traffic.malformed == 1
    assert timed.frames("udp") == []
    timed.datagram(PROBE, 0.3)
    assert timed.frames("udp") == [ANSWER_TRUE]


def test_nothing_is_claimed_before_the_settings_of_the_hq() -> None:
    before = Timed(RobotRole(limits(0.0), ANNOUNCED, 5))
    assert not any(before.session.claims(datagram, PORT) for datagram in (PROBE, MOVE, ROTATE, STOP))


def test_nothing_is_claimed_for_an_hq_that_has_no_datagrams() -> None:
    timed = Timed(RobotRole(limits(0.0), ANNOUNCED, 5))
    timed.stream(client_settings(block="00000000000100"), 0.1)
    assert timed.session.state is State.ESTABLISHED
    assert not any(timed.session.claims(datagram, PORT) for datagram in (PROBE, MOVE, ROTATE, STOP))


def unheard(*, client_port: int = PORT) -> Timed:
    """A robot whose HQ's 5 was lost, and which has reported."""
    timed = Timed(RobotRole(limits(0.0), ANNOUNCED, 5, client_port=client_port))
    timed.stream(client_settings(), 0.1)
    timed.stream(STATUS_TRUE, 2.2)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
    return timed


def test_motion_by_datagram_of_an_hq_whose_probe_was_lost_is_claimed_and_taken() -> None:
    """Deployed HQ programs of 1.3 send 11, 12 and 61 by UDP whatever was agreed, and bind port 11000."""
    timed = unheard()
    assert timed.session.claims(MOVE, PORT)
    assert timed.datagram(MOVE, 2.3) == [ClientJoystickMove(0.0, 1.0, 0.5)]
    assert timed.session.transport == "tcp", "what it can hear is not known by that"
    assert not timed.session.claims(MOVE, PORT), "it has its source now"


@pytest.mark.parametrize("port", [1, 10999, 11001, 40000])
def test_motion_by_datagram_from_another_port_is_nobodys(port: int) -> None:
    timed = unheard()
    assert not timed.session.claims(MOVE, port)
    assert not timed.session.claims(PROBE, port)
    with pytest.raises(NotReady, match=r"another port than this client's are not taken \(client_port = 11000\)"):
        timed.session.stray(MOVE)
    assert timed.session.traffic.foreign == 1


def test_the_port_of_the_clients_is_an_option() -> None:
    timed = unheard(client_port=40000)
    assert not timed.session.claims(MOVE, PORT)
    assert timed.session.claims(MOVE, 40000)
    assert not any(unheard(client_port=0).session.claims(MOVE, port) for port in (1, PORT))


def test_nothing_is_bound_by_port_before_the_handshake_is_over() -> None:
    timed = waiting()
    assert not timed.session.claims(MOVE, PORT)
    timed.until(2.15)
    assert not timed.session.claims(MOVE, PORT)


@pytest.mark.parametrize("datagram", [b"", MOVE[:-1], MOVE[:4] + b"\x06" + MOVE[5:], PROBE[:4] + b"\x00" + PROBE[5:]])
def test_a_stray_datagram_that_does_not_bear_the_id_is_not_told(datagram: bytes) -> None:
    unheard().session.stray(datagram)
    served().session.stray(datagram)


def test_a_stray_datagram_is_told_to_who_has_a_source_too_but_to_nobody_during_the_handshake() -> None:
    with pytest.raises(NotReady):
        served().session.stray(MOVE)
    waiting().session.stray(PROBE)
    waiting().session.stray(MOVE)


# A rival source


def test_a_probe_of_a_second_source_is_claimed_until_the_report() -> None:
    """So it is seen that there are two of them."""
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    assert timed.session.claims(PROBE, PORT + 1)
    timed.stream(STATUS_TRUE, 0.3)
    assert not timed.session.claims(PROBE, PORT + 1)


def rivalled(*datagrams: bytes, gap_s: float = 0.0) -> Timed:
    """A robot that was sent a 5 by another source at 0.2, after these by the first at 0.199."""
    timed = Timed(RobotRole(limits(gap_s), ANNOUNCED, 5))
    timed.stream(client_settings(), 0.195)
    for datagram in datagrams:
        timed.datagram(datagram, 0.199)
    timed.session.rivalled(0.2)
    return timed


def test_of_two_sources_that_came_before_the_6_neither_is_heard_and_no_6_is_sent() -> None:
    """The 6 waits for the gap that the 4 began."""
    for timed in (rivalled(PROBE, gap_s=0.01), rivalled()):
        assert not timed.session.claims(PROBE, PORT)
        timed.until(1.0)
        assert timed.session.state is State.HANDSHAKING
        timed.stream(STATUS_TRUE, 2.2)
        assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")
        assert timed.frames("udp") == []
        assert [frame[5] for frame in timed.frames("tcp")] == [2, 4]
        assert timed.session.left_out == {"another source of datagrams claims to be this client": 1}
        assert timed.session.claims(MOVE, PORT), "by the port of deployed programs it may drive"


def test_an_hq_that_was_told_that_its_datagram_came_is_let_go_when_a_second_source_claims_to_be_it() -> None:
    timed = rivalled(PROBE)
    assert timed.frames("udp") == [ANSWER_TRUE]
    timed.until(1.0)
    assert timed.session.state is State.CLOSED
    assert timed.session.reason == "another source of datagrams claims to be this client"
    assert not timed.session.claims(MOVE, PORT)


def test_a_packet_from_the_port_of_deployed_programs_shows_that_the_source_may_be_somebody_elses() -> None:
    """A 5 of 1.3 was lost, somebody else's was answered, and the 7 is true whatever happened."""
    timed = waiting()
    assert timed.session.claims(PROBE, PORT + 1)
    timed.datagram(PROBE, 0.2)
    timed.stream(STATUS_TRUE, 0.3)
    assert not timed.session.claims(MOVE, PORT + 2), "of no port but that one"
    assert timed.session.claims(MOVE, PORT)
    timed.session.rivalled(0.4)
    assert not timed.session.claims(MOVE, PORT), "neither is heard any more"
    assert not timed.session.claims(MOVE, PORT + 1)
    assert (timed.session.state, timed.session.transport) == (State.ESTABLISHED, "tcp")


def test_nothing_but_a_probe_is_taken_by_datagram_before_the_report() -> None:
    """Whose source it is only the 7 tells: until then nobody drives by it, in whoever's name."""
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    assert timed.datagram(MOVE, 0.25) == []
    assert timed.datagram(STOP, 0.26) == []
    assert timed.session.traffic.malformed == 2
    timed.stream(STATUS_TRUE, 0.3)
    assert timed.datagram(MOVE, 0.4) == [ClientJoystickMove(0.0, 1.0, 0.5)]


@pytest.mark.parametrize("sender", [0, 1])
def test_a_source_may_leave_the_id_out_but_not_bear_another(sender: int) -> None:
    timed = served()
    assert timed.datagram(MOVE[:4] + bytes([sender]) + MOVE[5:], 0.4) == [ClientJoystickMove(0.0, 1.0, 0.5)]
    assert timed.datagram(MOVE[:4] + b"\x06" + MOVE[5:], 0.5) == []
    assert timed.session.traffic.malformed == 1


@pytest.mark.parametrize("sender", [0, 1, 4, 6, 255])
def test_motion_by_datagram_with_another_id_is_nobodys_after_the_probe(sender: int) -> None:
    timed = unheard()
    assert not timed.session.claims(MOVE[:4] + bytes([sender]) + MOVE[5:], PORT)
    assert not timed.session.claims(PROBE[:4] + bytes([sender]) + PROBE[5:], PORT)


@pytest.mark.parametrize("packet_id", [2, 4, 6, 31, 51, 53, 55, 60])
def test_a_datagram_of_our_own_side_is_never_claimed(packet_id: int) -> None:
    for timed in (waiting(), served(), unheard()):
        assert not timed.session.claims(bytes.fromhex("02000000 05") + bytes([packet_id]), PORT)


def test_a_probe_by_tcp_is_refused() -> None:
    timed = waiting()
    timed.stream(PROBE, 0.2)
    assert timed.session.traffic.malformed == 1
    timed.until(6.0)
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.frames("udp") == []


def test_a_report_that_was_not_due_is_counted() -> None:
    again = served()
    again.stream(STATUS_FALSE, 0.5)
    assert again.session.traffic.malformed == 1
    assert again.session.transport == "udp"


def test_motion_is_taken_by_either_channel_after_the_report() -> None:
    timed = waiting()
    timed.datagram(PROBE, 0.2)
    move, rotate = ClientJoystickMove(0.0, 1.0, 0.5), ClientJoystickRotate(-0.75)
    assert timed.stream(MOVE, 0.25) == [move]
    timed.stream(STATUS_TRUE, 0.3)
    assert timed.datagram(MOVE, 0.4) == [move]
    assert timed.stream(ROTATE, 0.5) == [rotate]
    assert timed.stream(STOP, 0.6) == [ClientJoystickStop()]


TELEMETRY = [
    (DebugMessage("bye"), "tcp"),
    (ServerLidarStatus(1), "tcp"),
    (ServerSLAMMap(bytes(400)), "udp"),
    (ServerSLAMMap(), "udp"),
    (POSE, "udp"),
    (ServerSLAMMapPart(0, 3, b"\x00\x01\x02"), "udp"),
    (ServerGetSimulatedLidarData(), "tcp"),
]


@pytest.mark.parametrize(("message", "channel"), TELEMETRY, ids=lambda value: type(value).__name__)
def test_telemetry_goes_by_the_channel_of_the_table(message: Packet, channel: str) -> None:
    failed = waiting()
    failed.until(2.15)
    failed.stream(STATUS_FALSE, 2.2)
    for timed, by in ((failed, "tcp"), (served(), channel)):
        now = timed.now
        timed.session.send(message)
        timed.until(now + 1.0)
        (sent,) = [sent for sent in timed.sent if sent.at >= now and sent.frame[5] not in (6, 4)]
        assert (sent.by, sent.frame) == (by, encode_packet(message, 1))


# Both


@pytest.mark.parametrize("play_hq", [True, False])
def test_a_closing_session_asks_for_no_timer_that_does_nothing(play_hq: bool) -> None:
    """A link that takes nothing keeps it closing for a while; a timer in the past would fire without end."""
    session = (started() if play_hq else waiting()).session
    session.send(DebugMessage("last words"))
    session.close("enough", 2.0)
    session.expire(2.4)
    assert session.state is State.CLOSING
    assert session.deadline(writing=False) == 2.5
