"""The UDP probe and its fallbacks in both roles: which bytes leave when and by which channel."""

import contextlib
import itertools

import numpy as np
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
    NO_UDP,
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
MOVES, ROTATES = ClientJoystickMove(0.0, 1.0, 0.5), ClientJoystickRotate(-0.75)
SCAN = ClientSimulatedLidarData(np.ones(360, np.float32))
PORT = 11000
"""What deployed HQ programs bind."""
HQ_ANSWER = framed(5, 3, counted(LISTED) + bytes.fromhex("01000000000100"))
FIVE, SIX, SEVEN = (0.2, "udp", PROBE), (0.3, "udp", ANSWER_TRUE), (0.3, "tcp", STATUS_TRUE)
"""What comes in time, when and by which channel."""
BY_TCP, BY_UDP = (State.ESTABLISHED, "tcp"), (State.ESTABLISHED, "udp")


def agreed(timed: Timed) -> tuple[State, str | None]:
    return timed.session.state, timed.session.transport


def come(timed: Timed, *coming: tuple[float, str, bytes]) -> Timed:
    """Let frames come, each at its time and by its channel."""
    for at, by, data in coming:
        (timed.stream if by == "tcp" else timed.datagram)(data, at)
    return timed


def bearing(frame: bytes, sender: int) -> bytes:
    """The same frame with another id."""
    return frame[:4] + bytes([sender]) + frame[5:]


# The gateway as HQ. The settings come at 0.1, the 4 at 0.2.


def hq(*coming: tuple[float, str, bytes], udp: bool = True, flags: str = ALL) -> Timed:
    timed = Timed(HqRole(limits(0.01), udp=udp))
    return come(timed, (0.1, "tcp", server_settings(block=flags + SIZE_100_10)), *coming)


def started(*coming: tuple[float, str, bytes]) -> Timed:
    return hq((0.2, "tcp", START), *coming)


def probed(answer: bytes | None) -> Timed:
    """An HQ whose probe was answered by UDP, or never; 3 s on."""
    timed = started() if answer is None else started((0.3, "udp", answer))
    timed.until(3.0)
    return timed


def assert_silence(timed: Timed, *, start: float = 0.2) -> None:
    """Nothing by TCP but one 7 in the 2.5 s after the 4, nothing by UDP but one 5."""
    quiet = timed.frames("tcp", start, start + 2.499)
    assert len(quiet) <= 1
    assert all(frame in (STATUS_TRUE, STATUS_FALSE) for frame in quiet)
    assert [frame[5] for frame in timed.frames("tcp")].count(7) == 1
    assert timed.frames("udp", 0.0, start + 2.499) == [PROBE]


def test_an_hq_waits_with_its_datagram_until_the_robot_asks_and_is_established_by_tcp_where_it_never_does() -> None:
    timed = hq()
    timed.until(2.05)
    assert timed.frames("tcp") == [HQ_ANSWER]
    assert timed.session.state is State.HANDSHAKING
    timed.until(2.15)
    assert agreed(timed) == BY_TCP
    assert len(timed.sent) == 1


def test_an_hq_probes_once_and_answers_success_at_once_and_is_silent_for_two_and_a_half_seconds() -> None:
    timed = started()
    assert [(sent.at, sent.by, sent.frame) for sent in timed.sent[1:]] == [(0.2, "udp", PROBE)]
    timed.datagram(ANSWER_TRUE, 0.3)
    assert [(sent.at, sent.by, sent.frame) for sent in timed.sent[2:]] == [(0.3, "tcp", STATUS_TRUE)]
    timed.until(2.69)
    assert timed.session.state is State.HANDSHAKING
    timed.until(2.71)
    assert agreed(timed) == BY_UDP
    assert timed.session.version == "1.3"
    assert timed.session.features == ("udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map")
    assert timed.session.traffic.malformed == 0


@pytest.mark.parametrize(
    ("coming", "status", "at", "outcome"),
    [
        pytest.param([], STATUS_FALSE, 2.2, BY_TCP, id="no answer within two seconds"),
        pytest.param([SIX], STATUS_TRUE, 0.3, BY_UDP, id="success"),
        pytest.param([(2.22, "udp", ANSWER_TRUE)], STATUS_FALSE, 2.2, BY_TCP, id="an answer after the report"),
        pytest.param([(2.22, "tcp", ANSWER_FALSE)], STATUS_FALSE, 2.2, BY_TCP, id="a refusal after the report"),
        # an answer by TCP says that the datagram did not arrive
        pytest.param([(2.0, "tcp", ANSWER_FALSE)], STATUS_FALSE, 2.0, BY_TCP, id="a refusal by TCP"),
        pytest.param([(2.0, "tcp", ANSWER_TRUE)], STATUS_FALSE, 2.0, BY_TCP, id="an answer by TCP"),
        pytest.param([(0.3, "udp", ANSWER_FALSE)], STATUS_FALSE, 0.3, BY_TCP, id="a datagram that says no"),
        pytest.param(
            [SIX, (0.4, "udp", ANSWER_TRUE), (0.5, "tcp", ANSWER_FALSE)], STATUS_TRUE, 0.3, BY_UDP, id="more answers"
        ),
        pytest.param([(0.25, "tcp", START), SIX, (0.35, "tcp", START)], STATUS_TRUE, 0.3, BY_UDP, id="more starts"),
    ],
)
def test_an_hq_reports_the_answer_to_its_probe_once_and_is_silent_whatever_follows(coming, status, at, outcome) -> None:
    timed = started(*coming)
    timed.until(5.0)
    (report,) = [sent for sent in timed.sent if sent.frame[5] == 7]
    assert (report.by, report.frame) == ("tcp", status)
    assert report.at == pytest.approx(at, abs=0.011)
    assert agreed(timed) == outcome
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


@pytest.mark.parametrize(("flags", "udp"), [(NO_UDP, True), (ALL, False)])
def test_a_start_that_nobody_offered_is_obeyed_without_datagrams(flags: str, udp: bool) -> None:
    """The robot sleeps all the same, and wants its 7."""
    timed = hq(udp=udp, flags=flags)
    assert timed.session.state is State.ESTABLISHED
    timed.stream(START, 0.2)
    assert timed.session.busy == "handshaking"
    timed.until(6.0)
    assert timed.frames("udp") == []
    assert timed.frames("tcp")[1:] == [bytes.fromhex("03000000 05 07 00")]
    assert (timed.session.state, timed.session.busy) == (State.ESTABLISHED, None)
    assert timed.session.traffic.malformed == 0


def test_a_start_before_the_settings_is_not_due_and_one_in_the_same_read_finds_them_answered_first() -> None:
    early = come(Timed(HqRole(limits(0.01))), (0.05, "tcp", START), (0.1, "tcp", server_settings()))
    early.until(0.2)
    assert [(sent.by, sent.frame) for sent in early.sent] == [("tcp", HQ_ANSWER)]
    together = come(Timed(HqRole(limits(0.01))), (0.1, "tcp", server_settings() + START))
    together.until(5.0)
    assert (together.sent[0].at, together.sent[0].frame) == (0.1, HQ_ANSWER)
    assert [frame[5] for frame in together.frames("tcp")].count(7) <= 1


def test_a_start_that_comes_late_is_followed_by_the_same_silence() -> None:
    timed = hq((3.0, "tcp", START))
    with contextlib.suppress(Refused):
        timed.session.send(ClientControllMode(2))
    timed.datagram(ANSWER_TRUE, 3.1)
    timed.until(8.0)
    assert_silence(timed, start=3.0)
    assert timed.session.state is State.ESTABLISHED
    assert timed.session.busy is None


def test_what_the_robot_sends_during_the_silence_is_delivered() -> None:
    timed = started()
    assert timed.stream(POSITION, 0.25) == [POSE]
    timed.datagram(ANSWER_TRUE, 0.3)
    assert timed.datagram(POSITION, 0.4) == [POSE]
    assert timed.stream(POSITION, 0.5) == [POSE]
    assert timed.session.state is State.HANDSHAKING


def test_datagrams_are_taken_although_the_probe_failed_from_a_source_that_is_known() -> None:
    """What an HQ announces never limits what a robot may send it."""
    assert probed(None).datagram(POSITION, 3.1) == [POSE]
    assert not started().session.claims(ANSWER_TRUE, PORT)


def test_a_robot_that_is_lost_during_the_silence_gets_nothing_more() -> None:
    timed = started()
    timed.session.lost("closed by peer")
    timed.until(10.0)
    assert timed.session.state is State.CLOSED
    assert [sent.frame for sent in timed.sent] == [HQ_ANSWER, PROBE]


@pytest.mark.parametrize(
    ("command", "channel", "frame"),
    [
        (DebugMessage("hi"), "tcp", bytes.fromhex("08000000 05 01 02000000 6869")),
        (ClientControllMode(2), "tcp", bytes.fromhex("06000000 05 0a 02000000")),
        (MOVES, "udp", MOVE),
        (ROTATES, "udp", ROTATE),
        (ClientJoystickStop(), "tcp", STOP),
        (ClientLidarMode(1), "tcp", bytes.fromhex("06000000 05 32 01000000")),
        (ClientGetSLAMMap(), "tcp", bytes.fromhex("02000000 05 34")),
        (ClientGetPosition(), "tcp", bytes.fromhex("02000000 05 36")),
        (SCAN, "udp", bytes.fromhex("a6050000 05 3d 68010000" + "0000803f" * 360)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_command_goes_by_the_channel_of_the_table(command: Packet, channel: str, frame: bytes) -> None:
    """Before the probe there is only TCP; so there is after one that failed."""
    for timed, by in ((probed(None), "tcp"), (probed(ANSWER_TRUE), channel)):
        timed.session.send(command)
        timed.until(3.5)
        assert [(sent.by, sent.frame) for sent in timed.sent if sent.at >= 3.0] == [(by, frame)]


def test_the_gap_is_kept_between_datagrams_and_segments_too() -> None:
    timed = probed(ANSWER_TRUE)
    for _ in range(5):
        timed.session.send(ROTATES)
        timed.session.send(ClientJoystickStop())
    timed.until(4.0)
    times = [sent.at for sent in timed.sent if sent.at >= 3.0]
    assert len(times) == 10
    assert all(later - earlier >= 0.00999 for earlier, later in itertools.pairwise(times))


# The gateway as robot. Its settings leave at 0.0, those of the HQ come at 0.1 and its 4 leaves.

ANNOUNCED = RobotSettings13(
    udp=True, lidar_sim=True, slam_map=True, joystick=True, slam_map_size=1000, slam_map_interval=10
)


def robot(announced: RobotSettings13 = ANNOUNCED, *, client_port: int = PORT, gap_s: float = 0.0) -> Timed:
    return Timed(RobotRole(limits(gap_s), announced, 5, client_port=client_port))


def waiting(*coming: tuple[float, str, bytes]) -> Timed:
    return come(robot(), (0.1, "tcp", client_settings()), *coming)


def served() -> Timed:
    """A robot whose probe succeeded."""
    return waiting(FIVE, SEVEN)


def unheard(*, client_port: int = PORT) -> Timed:
    """A robot whose HQ's 5 was lost, and which has reported."""
    timed = come(robot(client_port=client_port), (0.1, "tcp", client_settings()), (2.2, "tcp", STATUS_TRUE))
    assert agreed(timed) == BY_TCP
    return timed


def test_a_robot_asks_for_the_datagram_and_answers_it_by_udp() -> None:
    timed = waiting()
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.session.claims(PROBE, PORT)
    timed.datagram(PROBE, 0.2)
    assert timed.frames("udp") == [ANSWER_TRUE]
    assert timed.session.state is State.HANDSHAKING
    timed.stream(STATUS_TRUE, 0.3)
    assert agreed(timed) == BY_UDP


@pytest.mark.parametrize(("announced", "flags"), [(RobotSettings13(), "01"), (ANNOUNCED, "00")])
def test_a_robot_without_udp_and_an_hq_without_it_are_established_at_once(announced, flags) -> None:
    timed = come(robot(announced), (0.1, "tcp", client_settings(block=flags + "000000000100")))
    assert agreed(timed) == BY_TCP
    assert not any(timed.session.claims(datagram, PORT) for datagram in (PROBE, MOVE, ROTATE, STOP))
    timed.until(6.0)
    assert len(timed.sent) == 1


@pytest.mark.parametrize(
    ("coming", "answered", "outcome", "malformed"),
    [
        # Without the datagram no 6 at all: any, false too, makes programs of 1.1 and 1.2 believe in datagrams; without
        # one they fall back to TCP. A status that says true is not believed then.
        pytest.param([(2.2, "tcp", STATUS_FALSE)], False, BY_TCP, 0, id="no 5, false"),
        pytest.param([(2.2, "tcp", STATUS_TRUE)], False, BY_TCP, 0, id="no 5, true"),
        # A 5 counts between our 4 and its 7 only: who has reported sent its own before that.
        pytest.param([(1.9, "tcp", STATUS_FALSE)], False, BY_TCP, 0, id="no 5, false before it could come"),
        pytest.param([(1.9, "tcp", STATUS_TRUE)], False, BY_TCP, 0, id="no 5, true before it could come"),
        pytest.param([], False, BY_TCP, 0, id="nothing"),
        pytest.param([FIVE, SEVEN], True, BY_UDP, 0, id="success"),
        # The 6 was lost, and the HQ would not hear what is sent it by UDP. It says so 2 s after its 5.
        pytest.param([FIVE, (2.15, "tcp", STATUS_FALSE)], True, BY_TCP, 0, id="a lost 6"),
        pytest.param([FIVE, (2.35, "tcp", STATUS_FALSE)], True, BY_TCP, 0, id="a lost 6, told late"),
        pytest.param([FIVE], True, BY_TCP, 0, id="no report"),
        pytest.param([FIVE, (0.25, "udp", PROBE), SEVEN, (0.35, "udp", PROBE)], True, BY_UDP, 2, id="more 5"),
        pytest.param([(0.2, "tcp", PROBE)], False, BY_TCP, 1, id="a 5 by TCP"),
        pytest.param([FIVE, SEVEN, (0.5, "tcp", STATUS_FALSE)], True, BY_UDP, 1, id="a report that was not due"),
    ],
)
def test_a_robot_answers_the_datagram_once_and_believes_the_report_if_it_came(
    coming: list[tuple[float, str, bytes]], answered: bool, outcome: tuple[State, str], malformed: int
) -> None:
    timed = waiting()
    for at, *_ in coming[:1]:
        timed.until(at)
        assert timed.session.state is State.HANDSHAKING
    come(timed, *coming)
    if any(data in (STATUS_FALSE, STATUS_TRUE) for _, _, data in coming):
        assert agreed(timed) == outcome, "at once"
        assert not timed.session.claims(PROBE, PORT + 1)
    timed.until(10.0)
    assert agreed(timed) == outcome
    assert timed.session.drops_source is (answered and outcome == BY_TCP), "who got no 6 may not have sent that 5"
    assert timed.frames("tcp", 0.1) == [START]
    assert timed.frames("udp") == [ANSWER_TRUE] * answered
    assert timed.session.traffic.malformed == malformed
    timed.session.send(POSE)
    timed.until(11.0)
    assert timed.frames(outcome[1], 10.0) == [POSITION]


def test_a_datagram_that_comes_late_is_not_answered() -> None:
    timed = waiting()
    timed.until(2.15)
    assert not timed.session.claims(PROBE, PORT)
    assert not timed.session.claims(MOVE, PORT), "nothing is bound by port before the handshake is over"
    timed.stream(STATUS_TRUE, 2.3)
    timed.until(10.0)
    assert timed.frames("udp") == []
    assert timed.frames("tcp", 0.1) == [START]


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        PROBE[:-1],
        PROBE + b"\x00",
        bytes.fromhex("03000000 05 05"),
        bytes.fromhex("02000000 06 05"),
        bytes.fromhex("02000000 ff 05"),
        *(bytes.fromhex(length) + PROBE[4:] for length in ("01000000", "00000000", "ffffffff", "00000080")),
        MOVE,
        STOP,
    ],
)
def test_a_datagram_that_is_no_probe_is_not_claimed_but_counted_and_waited_past(datagram: bytes) -> None:
    timed = waiting()
    assert not timed.session.claims(datagram, PORT)
    timed.datagram(datagram, 0.2)
    assert timed.session.traffic.malformed == 1
    assert timed.frames("udp") == []
    timed.datagram(PROBE, 0.3)
    assert timed.frames("udp") == [ANSWER_TRUE]


@pytest.mark.parametrize("sender", [5, 0, 1])
def test_a_probe_is_claimed_with_the_id_that_was_given_or_one_that_nobody_has(sender: int) -> None:
    """Recorded HQ programs write 1, others 0 until they have read the settings."""
    timed = waiting()
    assert timed.session.claims(bearing(PROBE, sender), PORT)
    timed.datagram(bearing(PROBE, sender), 0.2)
    assert timed.frames("udp") == [ANSWER_TRUE]
    assert timed.session.traffic.malformed == 0


def test_nothing_is_claimed_before_the_settings_of_the_hq() -> None:
    assert not any(robot().session.claims(datagram, PORT) for datagram in (PROBE, MOVE, ROTATE, STOP))


def test_motion_by_datagram_of_an_hq_whose_probe_was_lost_is_claimed_and_taken() -> None:
    """Deployed HQ programs of 1.3 send 11, 12 and 61 by UDP whatever was agreed, and bind port 11000."""
    timed = unheard()
    assert timed.session.claims(MOVE, PORT)
    assert timed.datagram(MOVE, 2.3) == [MOVES]
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
    assert unheard(client_port=port).session.claims(MOVE, port), "but the port is an option"
    assert not unheard(client_port=port).session.claims(MOVE, PORT)
    assert not unheard(client_port=0).session.claims(MOVE, port)


@pytest.mark.parametrize("datagram", [b"", MOVE[:-1], bearing(MOVE, 6), bearing(PROBE, 0)])
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
    timed = waiting(FIVE)
    assert timed.session.claims(PROBE, PORT + 1)
    timed.stream(STATUS_TRUE, 0.3)
    assert not timed.session.claims(PROBE, PORT + 1)


def rivalled(*datagrams: bytes, gap_s: float = 0.0) -> Timed:
    """A robot that was sent a 5 by another source at 0.2, after these by the first at 0.199."""
    timed = come(robot(gap_s=gap_s), (0.195, "tcp", client_settings()), *((0.199, "udp", data) for data in datagrams))
    timed.session.rivalled(0.2)
    return timed


def test_of_two_sources_that_came_before_the_6_neither_is_heard_and_no_6_is_sent() -> None:
    """The 6 waits for the gap that the 4 began."""
    for timed in (rivalled(PROBE, gap_s=0.01), rivalled()):
        assert not timed.session.claims(PROBE, PORT)
        timed.until(1.0)
        assert timed.session.state is State.HANDSHAKING
        timed.stream(STATUS_TRUE, 2.2)
        assert agreed(timed) == BY_TCP
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
    come(timed, FIVE, SEVEN)
    assert not timed.session.claims(MOVE, PORT + 2), "of no port but that one"
    assert timed.session.claims(MOVE, PORT)
    timed.session.rivalled(0.4)
    assert not timed.session.claims(MOVE, PORT), "neither is heard any more"
    assert not timed.session.claims(MOVE, PORT + 1)
    assert agreed(timed) == BY_TCP


def test_motion_is_taken_by_either_channel_after_the_report_and_before_it_by_tcp_only() -> None:
    """Whose source it is only the 7 tells: until then nobody drives by it, in whoever's name."""
    timed = waiting(FIVE)
    assert timed.datagram(MOVE, 0.25) == []
    assert timed.datagram(STOP, 0.26) == []
    assert timed.session.traffic.malformed == 2
    assert timed.stream(MOVE, 0.27) == [MOVES]
    timed.stream(STATUS_TRUE, 0.3)
    assert timed.datagram(MOVE, 0.4) == [MOVES]
    assert timed.stream(ROTATE, 0.5) == [ROTATES]
    assert timed.stream(STOP, 0.6) == [ClientJoystickStop()]


@pytest.mark.parametrize("sender", [0, 1])
def test_a_source_may_leave_the_id_out_but_not_bear_another(sender: int) -> None:
    timed = served()
    assert timed.datagram(bearing(MOVE, sender), 0.4) == [MOVES]
    assert timed.datagram(bearing(MOVE, 6), 0.5) == []
    assert timed.session.traffic.malformed == 1


@pytest.mark.parametrize("sender", [0, 1, 4, 6, 255])
def test_motion_by_datagram_with_another_id_is_nobodys_after_the_probe(sender: int) -> None:
    timed = unheard()
    assert not timed.session.claims(bearing(MOVE, sender), PORT)
    assert not timed.session.claims(bearing(PROBE, sender), PORT)


@pytest.mark.parametrize("packet_id", [2, 4, 6, 31, 51, 53, 55, 60])
def test_a_datagram_of_our_own_side_is_never_claimed(packet_id: int) -> None:
    for timed in (waiting(), served(), unheard()):
        assert not timed.session.claims(bytes.fromhex("02000000 05") + bytes([packet_id]), PORT)


@pytest.mark.parametrize(
    ("message", "channel"),
    [
        (DebugMessage("bye"), "tcp"),
        (ServerLidarStatus(1), "tcp"),
        (ServerSLAMMap(bytes(400)), "udp"),
        (ServerSLAMMap(), "udp"),
        (POSE, "udp"),
        (ServerSLAMMapPart(0, 3, b"\x00\x01\x02"), "udp"),
        (ServerGetSimulatedLidarData(), "tcp"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_telemetry_goes_by_the_channel_of_the_table(message: Packet, channel: str) -> None:
    for timed, by in ((waiting((2.2, "tcp", STATUS_FALSE)), "tcp"), (served(), channel)):
        now = timed.now
        timed.session.send(message)
        timed.until(now + 1.0)
        (sent,) = [sent for sent in timed.sent if sent.at >= now and sent.frame[5] not in (6, 4)]
        assert (sent.by, sent.frame) == (by, encode_packet(message, 1))


# Both


@pytest.mark.parametrize("timed", [started(), waiting()], ids=["hq", "robot"])
def test_a_closing_session_asks_for_no_timer_that_does_nothing(timed: Timed) -> None:
    """A link that takes nothing keeps it closing for a while; a timer in the past would fire without end."""
    timed.session.send(DebugMessage("last words"))
    timed.session.close("enough", 2.0)
    timed.session.expire(2.4)
    assert timed.session.state is State.CLOSING
    assert timed.session.deadline(writing=False) == 2.5
