"""The session that all protocols share, shown with the smallest protocol there is.

A frame is a length byte and so many bytes; ``welcome`` ends the handshake, ``bye`` the conversation.
"""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError, Refused
from zbridge.protocol.outbox import LIMIT
from zbridge.protocol.session import LINGER_S, Limits, Role, Session, State

LIMITS = Limits(frame_bytes=100, handshake_s=5.0, gap_s=0.01)


def frame_end(data: bytes, start: int) -> int:
    if data[start] == 255:
        raise ProtocolError("length 255")
    return start + 1 + data[start]


class Toy(Session[bytes]):
    role = Role.HQ
    handled = frozenset({bytes})
    frame_end = staticmethod(frame_end)

    def encode(self, message: bytes) -> bytes:
        return bytes([len(message)]) + message

    def decode(self, frame: bytes) -> bytes:
        if frame[1:] == b"?":
            raise ProtocolError("what is ?")
        return frame[1:]

    def opened(self, now: float) -> None:
        self.send(b"hello")

    def accept(self, message: bytes, now: float) -> bool:
        if message == b"welcome":
            self.establish("2.0", ("wings",))
        elif message == b"bye":
            self.send(b"bye too")
            self.close("the peer said bye", now)
        elif message == b"not yet":
            raise ProtocolError("too early")
        else:
            return True
        return False


WELCOME = b"\x07welcome"


@pytest.fixture
def session() -> Toy:
    return Toy(LIMITS, name="robot", peer="tcp://toy.test:1")


@pytest.fixture
def established(session: Toy) -> Toy:
    session.open(0.0)
    assert session.outgoing(0.0) == b"\x05hello"
    assert session.receive(WELCOME, 0.1) == []
    return session


def test_a_new_session_is_connecting_and_waits_for_nothing(session: Toy) -> None:
    assert session.state is State.CONNECTING
    assert session.deadline() is None
    assert session.outgoing(0.0) is None
    assert session.state is State.CONNECTING


def test_opening_begins_the_handshake_with_the_protocols_first_step(session: Toy) -> None:
    session.open(10.0)
    assert session.state is State.HANDSHAKING
    assert session.outgoing(10.0) == b"\x05hello"
    assert session.deadline() == 15.0


def test_the_handshake_ends_with_version_and_features(established: Toy) -> None:
    assert established.state is State.ESTABLISHED
    assert established.version == "2.0"
    assert established.features == ("wings",)
    assert established.deadline() is None


def test_an_established_session_does_not_time_out(established: Toy) -> None:
    established.expire(1e6)
    assert established.state is State.ESTABLISHED


def test_an_unfinished_handshake_fails_at_its_limit_and_not_before(session: Toy) -> None:
    session.open(10.0)
    session.outgoing(10.0)
    session.expire(math.nextafter(15.0, 0))
    assert session.state is State.HANDSHAKING
    session.expire(15.0)
    assert session.state is State.CLOSED
    assert session.reason == "no handshake within 5 s"
    assert session.deadline() is None


def test_messages_of_one_read_are_returned_in_order(established: Toy) -> None:
    assert established.receive(b"\x01a\x01b\x02cd", 1.0) == [b"a", b"b", b"cd"]
    assert established.traffic.frames_in == 4
    assert established.traffic.bytes_in == len(WELCOME) + 7


def test_messages_behind_the_handshake_in_the_same_read_are_delivered(session: Toy) -> None:
    session.open(0.0)
    assert session.receive(WELCOME + b"\x01a", 0.1) == [b"a"]


@pytest.mark.parametrize("cut", range(len(WELCOME) + 5))
def test_a_stream_may_be_cut_anywhere(session: Toy, cut: int) -> None:
    stream = WELCOME + b"\x01a\x02bc"
    session.open(0.0)
    assert session.receive(stream[:cut], 0.1) + session.receive(stream[cut:], 0.2) == [b"a", b"bc"]
    assert session.traffic.frames_in == 3


def test_a_stream_may_come_byte_by_byte(session: Toy) -> None:
    session.open(0.0)
    messages = []
    for byte in WELCOME + b"\x01a\x02bc":
        messages += session.receive(bytes([byte]), 0.1)
    assert messages == [b"a", b"bc"]


def test_a_malformed_body_is_counted_and_skipped(established: Toy) -> None:
    assert established.receive(b"\x01a\x01?\x01b", 1.0) == [b"a", b"b"]
    assert established.state is State.ESTABLISHED
    assert established.traffic.malformed == 1
    assert established.last_malformed == "what is ?"
    assert established.traffic.frames_in == 4


def test_a_message_the_protocol_does_not_accept_now_is_counted_and_skipped(session: Toy) -> None:
    session.open(0.0)
    assert session.receive(b"\x07not yet\x01a", 0.1) == [b"a"]
    assert session.traffic.malformed == 1
    assert session.last_malformed == "too early"


def test_a_broken_stream_ends_the_session_after_the_messages_before_it(established: Toy) -> None:
    assert established.receive(b"\x01a\xff\x01b", 1.0) == [b"a"]
    assert established.state is State.CLOSED
    assert established.reason == "broken stream: length 255"
    assert established.traffic.malformed == 1


def test_a_frame_beyond_the_limit_ends_the_session(established: Toy) -> None:
    assert established.receive(bytes([100]), 1.0) == []
    assert established.state is State.CLOSED
    assert established.reason == "broken stream: frame of 101 bytes exceeds 100"


def test_bytes_after_the_end_are_ignored(established: Toy) -> None:
    established.lost("closed by peer")
    received = established.traffic.bytes_in
    assert established.receive(b"\x01a", 1.0) == []
    assert established.traffic.bytes_in == received


def test_frames_behind_the_peers_farewell_are_ignored(established: Toy) -> None:
    assert established.receive(b"\x01a\x03bye\x01b", 1.0) == [b"a"]
    assert established.state is State.CLOSING


def test_a_closing_session_writes_what_waits_and_then_is_closed(established: Toy) -> None:
    established.receive(b"\x03bye", 1.0)
    assert established.over
    assert established.outgoing(1.0) == b"\x07bye too"
    assert established.outgoing(1.02) is None
    assert established.state is State.CLOSED
    assert established.reason == "the peer said bye"


def test_a_closing_session_waits_for_the_gap_before_its_last_frame(established: Toy) -> None:
    established.send(b"one")
    established.send(b"two")
    established.close("enough", 1.0)
    assert established.outgoing(1.0) == b"\x03one"
    assert established.outgoing(1.001) is None
    assert established.state is State.CLOSING
    assert established.deadline() == pytest.approx(1.01)
    assert established.outgoing(1.01) == b"\x03two"


def test_a_closing_session_writes_an_urgent_frame_that_waits_for_the_gap(established: Toy) -> None:
    established.send(b"one")
    assert established.outgoing(1.0) == b"\x03one"
    established.outbox.set("motion", (b"stop",), 1.001, urgent=True)
    established.close("enough", 1.001)
    assert established.outgoing(1.001) is None
    assert established.state is State.CLOSING
    assert established.deadline() == pytest.approx(1.01)
    assert established.outgoing(1.01) == b"stop"
    assert established.outgoing(1.02) is None
    assert established.state is State.CLOSED


def test_a_session_that_was_ended_before_its_link_was_up_stays_ended(session: Toy) -> None:
    session.close("gateway stopped", 0.0)
    session.open(0.1)
    assert session.over
    assert session.outgoing(0.1) is None, "not even the first step of the handshake"
    assert session.state is State.CLOSED
    session.open(0.2)
    assert session.state is State.CLOSED
    assert session.reason == "gateway stopped"


def test_a_session_is_opened_once(established: Toy) -> None:
    established.open(1.0)
    assert established.state is State.ESTABLISHED
    assert established.outgoing(1.0) is None


def test_a_closing_session_does_not_wait_for_a_peer_that_takes_nothing(established: Toy) -> None:
    established.send(b"one")
    established.close("enough", 1.0)
    assert established.deadline(writing=False) == 1.0 + LINGER_S
    established.expire(1.0 + LINGER_S - 0.01)
    assert established.state is State.CLOSING
    established.expire(1.0 + LINGER_S)
    assert established.state is State.CLOSED


def test_the_first_reason_for_an_end_stands(established: Toy) -> None:
    established.close("enough", 1.0)
    established.close("again", 1.1)
    established.lost("closed by peer")
    established.fail("whatever")
    assert established.state is State.CLOSED
    assert established.reason == "enough"


def test_closing_a_closed_session_does_not_revive_it(established: Toy) -> None:
    established.lost("closed by peer")
    established.close("enough", 1.0)
    assert established.state is State.CLOSED
    assert established.reason == "closed by peer"
    assert established.deadline() is None


def test_a_closed_session_writes_nothing(established: Toy) -> None:
    established.send(b"one")
    established.lost("closed by peer")
    assert established.outgoing(1.0) is None


def test_frames_written_are_counted(established: Toy) -> None:
    established.send(b"abc")
    established.outgoing(1.0)
    assert established.traffic.frames_out == 2
    assert established.traffic.bytes_out == len(b"\x05hello") + len(b"\x03abc")


def test_a_tap_is_shown_every_frame_of_both_directions_malformed_ones_too(established: Toy) -> None:
    shown: list[tuple[str, bytes]] = []
    established.tap = lambda direction, frame: shown.append((direction, frame))
    established.receive(b"\x01a\x01?\x01", 1.0)
    established.send(b"b")
    established.outgoing(1.0)
    established.tap = None
    established.receive(b"c", 1.0)
    assert shown == [("in", b"\x01a"), ("in", b"\x01?"), ("out", b"\x01b")]


def test_the_deadline_is_the_earlier_of_writing_and_limit(session: Toy) -> None:
    session.open(0.0)
    session.send(b"more")
    session.outgoing(0.0)
    assert session.deadline() == 0.01
    assert session.deadline(writing=False) == 5.0


def test_sending_too_much_is_refused(established: Toy) -> None:
    for _ in range(LIMIT):
        established.send(b"x")
    with pytest.raises(Refused, match="64 packets"):
        established.send(b"x")


def test_the_snapshot_does_not_change_with_the_session(established: Toy) -> None:
    established.left_out["wings (7)"] += 2
    shown = established.snapshot()
    established.receive(b"\x01a", 1.0)
    established.left_out["wings (7)"] += 1
    established.traffic.dropped += 1
    established.lost("closed by peer")
    assert (shown.name, shown.peer, shown.role, shown.transport) == ("robot", "tcp://toy.test:1", "hq", "tcp")
    assert (shown.state, shown.version, shown.features, shown.reason) == ("established", "2.0", ("wings",), None)
    assert shown.counters == {
        "frames_in": 1,
        "frames_out": 1,
        "bytes_in": 8,
        "bytes_out": 6,
        "malformed": 0,
        "foreign": 0,
        "dropped": 0,
        "refused": 0,
        "unanswered": 0,
    }
    assert shown.left_out == {"wings (7)": 2}


def test_a_snapshot_says_why_a_session_takes_no_commands_or_has_ended(session: Toy) -> None:
    session.open(0.0)
    session.establish("", ())
    session.busy = "handshaking"
    assert (session.snapshot().reason, session.snapshot().version) == ("handshaking", None)
    session.lost("closed by peer")
    assert (session.snapshot().state, session.snapshot().reason) == ("closed", "closed by peer")


def test_two_doubts_and_not_one_are_a_reason_not_to_move_the_peer(session: Toy) -> None:
    session.open(0.0)
    session.establish("", ())
    assert session.doubtful is None
    session.doubts = ("client id 3",)
    assert session.doubtful is None
    session.doubts = ("client id 3", "malformed packets")
    assert session.doubtful == "connection in doubt: client id 3; malformed packets"
    session.close("enough", 1.0)
    assert (session.doubts, session.doubtful) == ((), None)


def test_a_lost_session_is_in_no_doubt(session: Toy) -> None:
    session.open(0.0)
    session.doubts = ("client id 3", "malformed packets")
    session.lost("closed by peer")
    assert session.doubts == ()


# The peer's rate


def limited(rate_hz: float) -> Toy:
    session = Toy(Limits(frame_bytes=100, handshake_s=5.0, rate_hz=rate_hz))
    session.open(100.0)
    session.receive(WELCOME, 100.0)
    return session


def test_a_peer_may_send_a_seconds_worth_at_once_and_one_more_ends_the_session() -> None:
    session = limited(10.0)
    assert len(session.receive(b"\x01a" * 9, 100.0)) == 9, "the welcome was the tenth"
    assert session.state is State.ESTABLISHED
    assert session.receive(b"\x01a\x01a", 100.0) == []
    assert (session.state, session.reason) == (State.CLOSED, "flood: more than 10 messages a second")


def test_messages_before_the_one_too_many_are_delivered() -> None:
    session = limited(10.0)
    assert len(session.receive(b"\x01a" * 100, 100.0)) == 9
    assert session.state is State.CLOSED


def test_a_peer_at_its_rate_is_served_for_ever() -> None:
    session = limited(10.0)
    for step in range(1, 1001):
        assert session.receive(b"\x01a", 100.0 + step / 10) == [b"a"]
    assert session.state is State.ESTABLISHED


def test_a_peer_at_twice_its_rate_is_cut_within_its_second_of_grace() -> None:
    session = limited(10.0)
    step = 0
    while session.state is State.ESTABLISHED:
        step += 1
        session.receive(b"\x01a", 100.0 + step / 20)
    assert 18 <= step <= 20, "nine were left, and every second one comes back"


def test_silence_saves_up_no_more_than_a_seconds_worth() -> None:
    session = limited(10.0)
    assert len(session.receive(b"\x01a" * 10, 1e6)) == 10
    assert session.state is State.ESTABLISHED
    session.receive(b"\x01a", 1e6)
    assert session.state is State.CLOSED


def test_what_is_malformed_or_of_the_handshake_counts_for_the_rate_too() -> None:
    session = limited(5.0)
    session.receive(b"\x01?" * 4, 100.0)
    assert session.state is State.ESTABLISHED
    session.receive(b"\x01?", 100.0)
    assert session.state is State.CLOSED


def test_half_frames_do_not_count_for_the_rate() -> None:
    session = limited(5.0)
    for _ in range(4):
        for byte in b"\x05hello":
            session.receive(bytes([byte]), 100.0)
    assert session.state is State.ESTABLISHED


def test_datagrams_share_the_rate_with_the_stream() -> None:
    session = limited(5.0)
    assert session.receive(b"\x01a" * 2, 100.0) == [b"a", b"a"]
    assert session.receive_datagram(b"\x01b", 100.0) == [b"b"]
    assert session.receive_datagram(b"no frame", 100.0) == []
    assert session.state is State.ESTABLISHED
    assert session.receive_datagram(b"\x01b", 100.0) == []
    assert (session.state, session.reason) == (State.CLOSED, "flood: more than 5 messages a second")


def test_a_session_without_a_rate_takes_all() -> None:
    session = limited(math.inf)
    assert len(session.receive(b"\x01a" * 10_000, 100.0)) == 10_000
    assert len(session.receive(b"\x01a", 100.0)) == 1


def test_a_session_prints_its_name_state_and_reason(session: Toy) -> None:
    assert repr(session) == "<Toy robot connecting>"
    session.lost("no route")
    assert repr(session) == "<Toy robot closed (no route)>"


@given(st.lists(st.binary(max_size=60), max_size=8))
def test_random_bytes_never_raise_and_the_state_only_moves_down(reads: list[bytes]) -> None:
    session = Toy(LIMITS)
    session.open(0.0)
    order = list(State)
    position = order.index(session.state)
    for step, data in enumerate(reads):
        for message in session.receive(data, step * 0.1):
            assert isinstance(message, bytes)
        session.outgoing(step * 0.1)
        assert order.index(session.state) >= position
        position = order.index(session.state)
